"""Several recordings: compare their results, combine them, or calibrate a batch."""

import re
from typing import Any

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.registry import (
    COMMANDS,
    EXTRA_RULES,
    PUBLIC_NAMES,
    RESULT_PARTS,
    ROUTES,
    SEVERAL_RECORDINGS,
    Command,
    ExtraRule,
    Route,
)

# Position of the vehicle's name in a pattern of paths.
_PLACEHOLDER = "{vehicle}"


def register() -> None:
    """Register the commands, the rules, and the routes of ``calibrate`` for several recordings."""
    PUBLIC_NAMES["calibrate_many"] = "hand_eye_calib.extras.fleet.together"
    PUBLIC_NAMES["calibrate_together"] = "hand_eye_calib.extras.fleet.together"
    COMMANDS["compare"] = Command(
        "compare results with the installed transform, or with each other",
        _compare,
    )
    COMMANDS["batch"] = Command(
        "calibrate many recordings, such as those of a fleet", _batch
    )
    RESULT_PARTS["together"] = _together
    EXTRA_RULES["recordings_differ"] = ExtraRule(
        after="nothing_known",
        forbids=True,
        when="of several recordings two differ and there is no third, all differ, or the mount has "
        "moved between them",
        find=_recordings_differ,
    )
    EXTRA_RULES["recordings"] = ExtraRule(
        after="warning_finding",
        forbids=False,
        when="of several recordings one is off and left out, or all scatter more than usual",
        find=_recordings,
    )
    ROUTES["batch"] = Route(_add_arguments, _is_batch, _run_batch)
    SEVERAL_RECORDINGS["one rig"] = _run_together


def _compare() -> Any:
    from hand_eye_calib.extras.fleet import compare

    return compare


def _batch() -> Any:
    from hand_eye_calib.extras.fleet.job import BATCH

    return BATCH


def _add_arguments(parser: Any) -> None:
    from hand_eye_calib.offline.cli.options import at_least

    add = parser.add_argument_group("many recordings").add_argument
    batch = "bags, folders of bags, or patterns of bags in quotes, such as 'fleet/*/drive'"
    add("--batch", metavar="BAG", nargs="+", help=batch)
    vehicle = (
        "the vehicle's name, or its position in the paths of --batch, such "
        "as 'fleet/{vehicle}/*': recordings of one vehicle become one result"
    )
    add("--vehicle", metavar="PATTERN", type=_vehicle, help=vehicle)
    no_report = "omit the page of each recording, which takes most of the time"
    add("--no-report", action="store_true", help=no_report)
    jobs = "number of worker processes. Default: one for each core"
    add("--jobs", metavar="N", type=at_least(1), help=jobs)
    dask = "use a Dask cluster in place of local processes: address of its scheduler, tcp://..."
    add("--dask", metavar="ADDRESS", help=dask)


def _vehicle(text: str) -> str:
    """Return the option ``--vehicle``: a name, or a pattern of paths with ``{vehicle}``.

    Raises
    ------
    ArgumentTypeError
        If the text has another placeholder, or is a pattern without a placeholder.
    """
    from argparse import ArgumentTypeError

    rest = text.replace(_PLACEHOLDER, "")
    if other := re.search(r"[{<][^{}<>/]*[}>]?|[}>]", rest):
        example = text.replace(other[0], _PLACEHOLDER if rest == text else "*")
        raise ArgumentTypeError(
            f"unknown placeholder {other[0]}; the placeholder is {_PLACEHOLDER}, such as "
            f"'{example}'"
        )
    if rest == text and re.search(r"[/*?]", text):
        raise ArgumentTypeError(
            f"'{text}' is a path without {_PLACEHOLDER}; put {_PLACEHOLDER} in place of the "
            "vehicle's name"
        )
    return text


def _is_batch(arguments: Any) -> bool:
    for name in ("vehicle", "dask"):
        value = getattr(arguments, name)
        if value and not arguments.batch:
            raise ConfigError(
                f"--{name} is an option of batch: hand_eye_calib batch BAG ... --{name} {value}"
            )
    return bool(arguments.batch)


def _run_batch(arguments: Any, _: Any) -> int:
    from hand_eye_calib.extras.fleet.batch import run_batch

    return run_batch(arguments)


def _run_together(arguments: Any, groups: Any) -> int:
    from hand_eye_calib.extras.fleet.batch import run_together

    return run_together(arguments, groups)


def _together() -> Any:
    from hand_eye_calib.core.results.parts import Part
    from hand_eye_calib.extras.fleet.records import Together, details

    return Part("together", lambda: Together, details)


def _recordings_differ(result: Any) -> Any:
    from hand_eye_calib.extras.fleet.records import find_kinds

    return find_kinds("recordings_differ", result)


def _recordings(result: Any) -> Any:
    from hand_eye_calib.extras.fleet.records import find_kinds

    return find_kinds("recordings", result)
