"""``check BAG`` or ``check PARENT CHILD``: check both streams before they are calibrated."""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.spelling import Interface
from hand_eye_calib.core.base.text import angle, length
from hand_eye_calib.offline.cli import options
from hand_eye_calib.offline.cli.config_file import options_from
from hand_eye_calib.offline.cli.options import (
    STREAMS,
    fail,
    not_typed,
    note,
    print_result,
    typed_options,
    waiting_for,
)

if TYPE_CHECKING:
    from hand_eye_calib.core.checks.findings import Finding
    from hand_eye_calib.core.geometry.trajectory import Trajectory
    from hand_eye_calib.offline.report.evidence import StreamSummary

_EPILOG = """\
examples:
  hand_eye_calib check my_bag
  hand_eye_calib check my_bag --parent-topic /lidar/odometry --child-topic /vio
  hand_eye_calib check lidar.txt camera.txt
  hand_eye_calib check lidar.txt gnss.csv"""

# Short help that fits on one screen.
_BRIEF = f"""\
PATH:
  my_bag                   a bag of ROS 2 or ROS 1 with two pose topics
  lidar.tum camera.tum     trajectory files of parent and child: TUM, KITTI, EuRoC, CSV

most used options:
  --parent-topic, --child-topic TOPIC   pose topics of the bag, if it has more than two
  --time-offset estimate   the sensors' clocks differ
  --scale estimate         the child's lengths have no unit (a single camera)
  --json                   print one JSON document

{_EPILOG}"""

_HEADINGS = (
    "",
    "poses",
    "seconds",
    "per s",
    "longest gap",
    "path length",
    "rotation",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.set_defaults(brief=_BRIEF)
    parser.usage = "%(prog)s [OPTION ...] PATH ..."
    parser.epilog = _EPILOG
    options.add_input_arguments(
        parser, "a bag, or the trajectory files of parent and child"
    )
    options.add_config_arguments(parser)
    options.add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Print the findings about both streams, and return the exit code.

    The code is 1 if a result of these streams would be unusable; otherwise 0.
    """
    from hand_eye_calib.core.base.plain import plain
    from hand_eye_calib.core.checks.findings import finding, gravest_first
    from hand_eye_calib.core.engine.run import examine
    from hand_eye_calib.core.engine.snapshot import whole_snapshot
    from hand_eye_calib.offline.report.evidence import summarise

    settings = options_from(arguments)
    recording = _read_streams(arguments, settings)
    sources = recording.sources
    parent, child = recording.trajectories
    snapshot = whole_snapshot(parent, child, settings)
    with waiting_for("checking the streams"):
        examined = examine(snapshot)
    repairs = [finding("disorder", text=text) for text in recording.repairs]
    findings = gravest_first([*map(_to_solve, examined), *repairs])
    streams = {
        stream: summarise(poses)
        for stream, poses in zip(STREAMS, snapshot.unpaired, strict=True)
        if len(poses) > 1
    }
    summaries = {
        stream: {"source": sources[stream]} | plain(summary)
        for stream, summary in streams.items()
    }
    document = None
    if arguments.json:
        document = {
            "streams": summaries,
            "findings": [item.to_dict() for item in findings],
        }
    lines = [_verdict(findings, arguments.typed), ""]
    if findings:
        lines += [*_finding_lines(findings), ""]
    lines += _stream_lines(sources, streams)
    print_result(lines, document)
    if findings and findings[0].makes_unusable:
        return fail(findings[0], 1)
    return 0


def _to_solve(finding: "Finding") -> "Finding":
    """Replace the options of a finding by the options that repair the streams in a calibration."""
    from hand_eye_calib.core.engine.run import options_to_solve

    return replace(finding, options=options_to_solve(finding))


class _Streams(NamedTuple):
    """Both streams: files or topics by stream, trajectories, and notes on repaired stamps."""

    sources: dict[str, str]
    trajectories: "list[Trajectory]"
    repairs: list[str]


def _read_streams(
    arguments: argparse.Namespace, settings: Mapping[str, Any]
) -> _Streams:
    """Read both streams from a bag or from two trajectory files.

    Raises
    ------
    ConfigError
        If the paths are neither one bag nor two trajectory files.
    """
    from hand_eye_calib.offline.cli import reading

    paths = arguments.paths
    is_bag = reading.are_bags(paths)
    if len(paths) != (1 if is_bag else 2):
        raise ConfigError(
            f"expected one bag or two trajectory files; got {len(paths)}: for example, "
            "hand_eye_calib check sample:lidar.tum sample:camera.tum"
        )
    if not is_bag:
        options.refuse_options_of_bags(arguments)
        names = dict(zip(STREAMS, map(str, paths), strict=True))
        files = reading.read_files(arguments, paths, settings)
        note(*files.warnings)
        return _Streams(names, files.trajectories, files.repairs)
    from hand_eye_calib.core.base.config import CalibratorConfig
    from hand_eye_calib.formats.bags.reader import PoseBag
    from hand_eye_calib.offline.cli import bags

    config = CalibratorConfig.from_options(settings)
    with PoseBag(paths[0]) as bag:
        wanted = options.sources_from(arguments)
        sources, measures = bags.select(bag, wanted, config)
        stamps = bags.stamps_of(wanted)
        names = {stream: str(source) for stream, source in sources.items()}
        readings = [
            (sources[stream], measures[stream], stamps[stream])
            for stream in STREAMS
        ]
        span = reading.span_from(arguments)
        return _Streams(names, *bags.read_sources(bag, readings, span))


def _stream_lines(
    sources: Mapping[str, str], streams: "Mapping[str, StreamSummary]"
) -> Iterator[str]:
    """Yield the source of each stream, and a table with the size and the motion of each stream."""
    yield from (f"{stream} is {source}" for stream, source in sources.items())
    yield "{:<8} {:>8} {:>9} {:>7} {:>12} {:>12} {:>10}".format(*_HEADINGS)
    for name, summary in streams.items():
        path = "none" if summary.path_m is None else length(summary.path_m)
        rotation = (
            "none"
            if summary.rotation_rad is None
            else angle(summary.rotation_rad)
        )
        yield (
            f"{name:<8} {summary.poses:8d} {summary.duration_s:9.1f} {summary.rate_hz:7.1f} "
            f"{summary.longest_interval_s:10.3f} s {path:>12} {rotation:>10}"
        )


def _verdict(findings: "Sequence[Finding]", typed: Sequence[str]) -> str:
    """Return a sentence with the verdict that a calibration would get, and the next step.

    Options that the command ``typed`` sets already are no next step.
    """
    from hand_eye_calib.core.results.reasons import Verdict

    serious = [
        finding for finding in findings if finding.severity.value != "note"
    ]
    if not serious:
        return "No fault found in these streams; run calibrate to see how good the result is."
    errors = [finding for finding in serious if finding.makes_unusable]
    verdict = Verdict.DO_NOT_USE if errors else Verdict.USE_WITH_CARE
    if all(not_typed(typed, finding.options) for finding in serious):
        options = " ".join(
            typed_options(finding.options.items()) for finding in serious
        )
        return f"{verdict.value} these streams unchanged: calibrate with {options}."
    codes = ", ".join(finding.code for finding in errors or serious)
    return f"{verdict.value}: check these findings first: {codes}."


def _finding_lines(findings: "Sequence[Finding]") -> Iterator[str]:
    """Yield severity, code, stream, sentence and advice of each finding."""
    from hand_eye_calib.core.results.records import NO_ACTION
    from hand_eye_calib.offline.cli.present import wrapped

    for finding in findings:
        mark = finding.severity.value
        if mark != "note":
            mark = mark.upper()
        yield f"{mark:<8} {finding.code:<17} {finding.stream}"
        advice = finding.advice_on(Interface.TERMINAL)
        if advice == NO_ACTION:
            yield from wrapped(f"{finding.what}; {advice}", "    ", "    ")
            continue
        for text in (finding.what, f"-> {advice}"):
            yield from wrapped(text, "    ", "    ")
