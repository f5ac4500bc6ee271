"""``check BAG`` or ``check PARENT CHILD``: check both streams before they are calibrated."""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.text import angle, length
from hand_eye_calib.offline.cli import options
from hand_eye_calib.offline.cli.options import (
    STREAMS,
    fail,
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

_HEADINGS = ("", "poses", "seconds", "per s", "longest gap", "path length", "rotation")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.usage = "%(prog)s [OPTION ...] PATH ..."
    parser.epilog = _EPILOG
    options.add_input_arguments(parser, "a bag, or the trajectory files of parent and child")
    options.add_config_arguments(parser)
    options.add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Print what was found; returns 1 if a result from these streams would be unusable, else 0."""
    from hand_eye_calib.core.base.plain import plain
    from hand_eye_calib.core.checks.findings import finding, gravest_first
    from hand_eye_calib.core.engine.run import check
    from hand_eye_calib.core.engine.snapshot import whole_snapshot
    from hand_eye_calib.offline.report.evidence import summarise

    given = options.options_from(arguments)
    sources, (first, second), repairs = _opened(arguments, given)
    snapshot = whole_snapshot(first, second, given)
    config = snapshot.config
    parent, child = snapshot.unpaired
    with waiting_for("checking the streams"):
        checked = check(snapshot, None if config.measured == "poses" else snapshot.estimate())
    of_files = [finding("disorder", text=text) for text in repairs]
    findings = gravest_first([*checked.findings, *of_files])
    both = zip(STREAMS, (parent, child), strict=True)
    streams = {name: summarise(one) for name, one in both if len(one) > 1}
    summaries = {name: {"source": sources[name]} | plain(streams[name]) for name in streams}
    document = {"streams": summaries, "findings": findings} if arguments.json else None
    lines = [_verdict(findings), "", *_table(findings), "", *_lines(sources, streams)]
    print_result(lines, document)
    unusable = [each for each in findings[:1] if each.makes_unusable]
    return fail(unusable[0], 1) if unusable else 0


def _opened(
    arguments: argparse.Namespace, given: Mapping[str, Any]
) -> "tuple[dict[str, str], list[Trajectory], list[str]]":
    """Where both streams are from, their poses, and what was wrong with the stamps."""
    from hand_eye_calib.offline.cli import reading

    paths = arguments.paths
    is_bag = reading.are_bags(paths)
    if len(paths) != (1 if is_bag else 2):
        raise ConfigError(f"expected one bag or two trajectory files; got {len(paths)}")
    if not is_bag:
        options.refuse_stamps(arguments)
        names = dict(zip(STREAMS, map(str, paths), strict=True))
        files = reading.read_files(arguments, paths, given)
        return names, files.trajectories, [*files.repairs, *files.warnings]
    from hand_eye_calib.core.base.config import CalibratorConfig
    from hand_eye_calib.formats.bags.reader import PoseBag
    from hand_eye_calib.offline.cli import bags

    config = CalibratorConfig.from_options(given)
    with PoseBag(paths[0]) as bag:
        wanted = options.sources_from(arguments)
        sources, measures = bags.select(bag, wanted, config)
        stamps = bags.stamps_of(wanted)
        names = {stream: str(source) for stream, source in sources.items()}
        readings = [(sources[stream], measures[stream], stamps[stream]) for stream in STREAMS]
        return names, *bags.read_sources(bag, readings)


def _lines(sources: Mapping[str, str], streams: "Mapping[str, StreamSummary]") -> Iterator[str]:
    """Both streams."""
    yield from (f"{stream} is {source}" for stream, source in sources.items())
    yield "{:<8} {:>8} {:>9} {:>7} {:>12} {:>12} {:>10}".format(*_HEADINGS)
    for name, summary in streams.items():
        path = summary.path_m
        rotation = summary.rotation_rad
        yield (
            f"{name:<8} {summary.poses:8d} {summary.duration_s:9.1f} {summary.rate_hz:7.1f} "
            f"{summary.longest_interval_s:10.3f} s {'none' if path is None else length(path):>12} "
            f"{'none' if rotation is None else angle(rotation):>10}"
        )


def _verdict(findings: "Sequence[Finding]") -> str:
    """What the findings mean for a calibration with these streams, in one sentence."""
    from hand_eye_calib.core.results.verdict import Verdict

    serious = [finding for finding in findings if finding.severity.value != "note"]
    if not serious:
        return f"{Verdict.USE.value}: nothing speaks against calibrating with these streams."
    errors = [finding for finding in serious if finding.makes_unusable]
    told = f"look at the findings first ({', '.join(each.code for each in errors or serious)})"
    if all(finding.options for finding in serious):
        typed = " ".join(typed_options(finding.options.items()) for finding in serious)
        told = f"not as they are; calibrate with {typed}"
    return f"{(Verdict.DO_NOT_USE if errors else Verdict.USE_WITH_CARE).value}: {told}."


def _table(findings: "Sequence[Finding]") -> Iterator[str]:
    """Lines of the findings, in their order."""
    from hand_eye_calib.offline.cli.present import wrapped

    if not findings:
        yield "No findings."
    for finding in findings:
        mark = finding.severity.value
        yield f"{mark if mark == 'note' else mark.upper():<8} {finding.code:<17} {finding.stream}"
        typed = typed_options(finding.options.items())
        for text in (finding.what, f"-> {finding.advice}{typed and f': {typed}'}"):
            yield from wrapped(text, "    ", "    ")
