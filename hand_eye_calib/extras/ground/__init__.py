"""The ground and gravity: z, roll and pitch of machines that never leave a flat floor."""

from typing import Any

from hand_eye_calib.core.base.registry import (
    BESIDE_MOTION,
    EXTRA_RULES,
    PUBLIC_NAMES,
    RESULT_PARTS,
    BesideMotion,
    ExtraRule,
)


def register() -> None:
    """Register the measurements of the ground: options, results, verdict and public names."""
    RESULT_PARTS["ground"] = _part
    EXTRA_RULES["ground"] = ExtraRule(
        after="warning_finding",
        forbids=False,
        when="the ground or gravity are more than 3 joint standard deviations from the motion",
        find=_disagreements,
    )
    BESIDE_MOTION["ground"] = BesideMotion(_add_arguments, _find, _topics)
    PUBLIC_NAMES["calibrate_on_ground"] = (
        "hand_eye_calib.extras.ground.calibrate"
    )
    for name in (
        "ground_from_clouds",
        "gravity_from_accelerations",
        "gravity_from_attitude",
    ):
        PUBLIC_NAMES[name] = "hand_eye_calib.extras.ground.tracks"


def _part() -> Any:
    from hand_eye_calib.extras.ground.part import GroundPart

    return GroundPart()


def _disagreements(result: Any) -> Any:
    from hand_eye_calib.extras.ground.part import disagreements

    return disagreements(result)


def _add_arguments(parser: Any) -> None:
    words = (
        "auto: if a bag has clouds of a lidar or an IMU in the frames of both sensors, the ground "
        "or gravity also measures z, roll and pitch. off: motion alone. Default: auto"
    )
    parser.add_argument(
        "--ground", choices=("auto", "off"), default="auto", help=words
    )


def _find(paths: Any, snapshot: Any) -> Any:
    from hand_eye_calib.extras.ground.bags import verticals_of_bag

    return verticals_of_bag(paths, snapshot)


def _topics(bag: Any) -> Any:
    from hand_eye_calib.extras.ground.bags import vertical_topics

    return vertical_topics(bag)
