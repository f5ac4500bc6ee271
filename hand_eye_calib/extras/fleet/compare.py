"""Command ``compare RESULT...``: compare results with the installed transform or each other."""

import argparse
from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.base.registry import COMPARISONS
from hand_eye_calib.core.base.text import amount, distinct_names
from hand_eye_calib.offline.cli.options import (
    Exit,
    add_json_argument,
    note,
    print_result,
    waiting_for,
)

if TYPE_CHECKING:
    from hand_eye_calib.core.results.calibration import Calibration
    from hand_eye_calib.core.results.context import Comparison

_EPILOG = """\
examples:
  hand_eye_calib compare result --with robot.urdf
  hand_eye_calib compare result --with "0.40 0 1.85 0 0 -90deg"
  hand_eye_calib compare monday/ tuesday/ wednesday/     which one has moved?
  hand_eye_calib compare live/digests/                   the history of a monitored mount
  hand_eye_calib compare robot*/ --fleet fleet.html      a page of all monitored mounts

exit codes: 0 same, 3 cannot tell, 4 moved; 1 bad input, 2 wrong usage"""


# Explanation of a column of the table.
_DETECTABLE = "detectable: the smallest change that would be detected in nine of ten cases"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.usage = "%(prog)s [OPTION ...] RESULT ..."
    parser.epilog = _EPILOG
    results = "extrinsic.yaml, or the directory that contains it; two or more without --with"
    parser.add_argument("results", metavar="RESULT", nargs="+", help=results)
    installed = (
        "installed transform: a URDF, an earlier extrinsic.yaml, a file of another program "
        "(formats of info --as), a file of one pose (.tum), a bag with /tf_static, or "
        '"X Y Z ROLL PITCH YAW" in m and rad'
    )
    parser.add_argument(
        "--with", dest="installed", metavar="SOURCE", help=installed
    )
    fleet = (
        "write a page with the history of the mount of each vehicle; every RESULT is then the "
        "folder of a vehicle with digests of the monitor"
    )
    parser.add_argument("--fleet", metavar="FILE", type=Path, help=fleet)
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Compare results; return the exit code."""
    from hand_eye_calib.core.assessment.comparison import (
        compare,
        scatters_in_words,
    )
    from hand_eye_calib.formats.results import load_result
    from hand_eye_calib.offline.cli.present import wrapped

    for compare_others in COMPARISONS.values():
        code = compare_others(arguments)
        if code is not None:
            return code
    if arguments.fleet:
        raise ConfigError(
            "--fleet needs digests of the monitor, and this installation has none"
        )
    results = [load_result(path) for path in arguments.results]
    for path, result in zip(arguments.results, results, strict=True):
        if result.status.failure:
            raise InputError(
                f"{path}: {result.status.failure}; it cannot be compared"
            )
    installed = None
    if arguments.installed:
        from hand_eye_calib.formats.installed import open_installed

        frames = results[0].parent_frame, results[0].child_frame
        with waiting_for(f"reading {arguments.installed}"):
            installed = open_installed(arguments.installed)(*frames)
    comparison = compare(results, installed, distinct_names(arguments.results))
    lines = [*_lines(comparison, results[0], arguments.installed)]
    lines += wrapped(scatters_in_words(results, installed), "", "  ")
    lines += wrapped(_DETECTABLE, "", "  ")
    print_result(lines, comparison if arguments.json else None)
    if not arguments.installed:
        note(*_repeated_recordings(arguments.results))
    codes = {"same": Exit.GOOD, "moved": Exit.MOVED}
    return codes.get(comparison.verdict, Exit.NOT_ALL)


def _repeated_recordings(paths: Sequence[str]) -> Iterator[str]:
    """Yield a note for each pair of results from one recording."""
    from hand_eye_calib.formats.results import recording_of

    recordings = {path: recording_of(path) for path in paths}
    for first, second in combinations(paths, 2):
        if recordings[first] and recordings[first] == recordings[second]:
            yield (
                f"{first} and {second} are of the same recording, so that their agreement proves "
                "nothing: record a second time"
            )


def _lines(
    comparison: "Comparison", result: "Calibration", installed: str | None
) -> Iterator[str]:
    """Yield the lines of a comparison for a terminal.

    ``installed`` is the installed transform as typed by the user.
    """
    yield f"Mount of {result.child_frame} on {result.parent_frame}: {comparison.sentence}"
    for difference in comparison.differences:
        title = f"{difference.second} minus {installed or difference.first}"
        if len(comparison.differences) > 1:
            title = f"{title}: {difference.sentence}"
        yield title
        yield f"  {'':<6}{'difference':>22}{'+/-':>10}{'detectable':>12}"
        for axis, row in difference.axes.items():
            size = amount(axis, row.difference)
            sigma = amount(axis, row.sigma)
            visible = amount(axis, row.visible)
            yield f"  {axis:<6}{size:>22}{sigma:>10}{visible:>12}  {row.verdict}"
