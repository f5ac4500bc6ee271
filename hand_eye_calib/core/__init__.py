"""Two pose streams in, a judged extrinsic out: no file, no ROS."""

from typing import Any

from hand_eye_calib.core.base.registry import (
    FINDING_WORDS,
    KINDS,
    MEASURES,
    OUT_OF_REACH,
    Measure,
)


def register() -> None:
    """Register two streams of poses, their findings, and what messages and files contain."""
    FINDING_WORDS["core"] = _words
    KINDS["poses"] = _poses
    MEASURES["poses"] = Measure("poses")
    MEASURES["positions"] = Measure(
        "positions",
        "positions determine a lever arm only beside poses of the other sensor; give "
        "positions with orientations for one of the two",
    )
    MEASURES["rotations"] = Measure("rotations")
    MEASURES["rates"] = Measure("rotations")
    OUT_OF_REACH["rotations"] = ("x", "y", "z")
    OUT_OF_REACH["positions"] = ("roll", "pitch", "yaw")


def _words() -> Any:
    from hand_eye_calib.core.checks.words import WORDS

    return WORDS


def _poses() -> Any:
    from hand_eye_calib.core.engine.poses import POSES

    return POSES
