"""``check BAG`` or ``check PARENT CHILD``: check both streams before they are calibrated."""

import argparse
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hand_eye_calib.cli.calibrate import STREAMS, add_file_arguments, read_files
from hand_eye_calib.cli.console import note, typed_options, waiting_for, with_progress
from hand_eye_calib.cli.options import (
    add_config_arguments,
    add_json_argument,
    config_from,
    options_from,
)
from hand_eye_calib.errors import ConfigError, printable

if TYPE_CHECKING:
    from hand_eye_calib.checks.check import CheckResult
    from hand_eye_calib.checks.findings import Finding
    from hand_eye_calib.checks.streams import StreamSummary
    from hand_eye_calib.geometry.trajectory import Trajectory

EXAMPLES = """\
examples:
  hand_eye_calib check my_bag
  hand_eye_calib check my_bag --parent-topic /lidar/odometry --child-topic /vio --out checked
  hand_eye_calib check lidar.txt camera.txt
  hand_eye_calib check lidar.txt gnss.csv"""

_HEADINGS = ("", "poses", "seconds", "per s", "longest gap", "path length", "rotation")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = EXAMPLES
    parser.add_argument(
        "inputs", metavar="BAG | PARENT CHILD", nargs="+", help="a bag, or two trajectory files"
    )
    for stream in STREAMS:
        parser.add_argument(
            f"--{stream}-topic", metavar="TOPIC", help=f"of a bag: poses of the {stream} sensor"
        )
    add_file_arguments(parser)
    add_config_arguments(parser)
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="write check.html into this directory: the findings, and figures of both streams",
    )
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Print what was found; returns 1 if a result from these streams would be unusable, else 0."""
    from hand_eye_calib.checks.findings import answered, gravest_first
    from hand_eye_calib.checks.streams import summarise
    from hand_eye_calib.cli.present import show

    if len(arguments.inputs) > 2:
        raise ConfigError(f"expected one bag or two trajectory files; got {len(arguments.inputs)}")
    config = config_from(arguments)
    read = _read_bag if len(arguments.inputs) == 1 else _read_files
    trajectories, sources, of_files = read(arguments)
    parent, child = (trajectories[stream] for stream in STREAMS)
    # What is to be estimated is not known yet: the checks say what it is.
    offset_s = config.time_offset if isinstance(config.time_offset, float) else 0.0
    scale = config.scale if isinstance(config.scale, float) else 1.0
    with waiting_for("checking the streams"):
        checked = _checked(parent, child, (offset_s, scale), arguments)
    findings = gravest_first(answered([*checked.findings, *of_files], config))
    streams = {name: summarise(one) for name, one in trajectories.items() if len(one) > 1}
    said = _verdict(findings)

    def draw() -> str:
        from hand_eye_calib.report.check_page import render_check

        named = _named(sources, is_bag=len(arguments.inputs) == 1)
        corrected = child.shifted(offset_s).scaled(scale)
        return render_check(parent, corrected, checked, findings, named, said, config.max_gap)

    def finish() -> None:
        from hand_eye_calib.cli.reporting import CHECK, write_page

        if arguments.out:
            write_page(arguments.out / CHECK, draw)

    errors = [str(finding) for finding in findings[:1] if finding.makes_unusable]
    return show(
        arguments,
        lambda: _document(sources, streams, findings, checked),
        lambda: "\n".join([said, "", *_table(findings), "", *_lines(sources, streams, checked)]),
        finish=finish,
        errors=errors,
        code=len(errors),
    )


def _checked(
    parent: "Trajectory",
    child: "Trajectory",
    known: tuple[float, float],
    arguments: argparse.Namespace,
) -> "CheckResult":
    """What the checks say of two streams with a ``known`` time offset and scale."""
    config = config_from(arguments)
    if {parent.measures, child.measures} == {"poses"}:
        from hand_eye_calib.checks.check import check_streams

        return check_streams(parent, child, *known, config.max_gap)
    from hand_eye_calib.engine.checking import check_partial
    from hand_eye_calib.engine.offline import offline_config, whole_snapshot

    config = offline_config(parent, child, options_from(arguments))
    return check_partial(whole_snapshot(config, parent, child))


def _named(sources: Mapping[str, str], is_bag: bool) -> list[str]:
    """Streams with their topics, or with the names of their files."""
    return [
        f"{stream}: {source if is_bag else Path(source).name}" for stream, source in sources.items()
    ]


_Read = tuple[dict[str, "Trajectory"], dict[str, str], "list[Finding]"]


def _read_files(arguments: argparse.Namespace) -> _Read:
    from hand_eye_calib.checks.findings import finding

    arguments.parent, arguments.child = arguments.inputs
    trajectories, repairs = read_files(arguments, options_from(arguments))
    findings = [finding("repaired_file", text=text) for text in repairs]
    return trajectories, dict(zip(STREAMS, arguments.inputs, strict=True)), findings


def _read_bag(arguments: argparse.Namespace) -> _Read:
    import numpy as np

    from hand_eye_calib.checks.streams import tidy
    from hand_eye_calib.io.bags import PoseBag

    config = config_from(arguments)
    columns: dict[str, list[Any]] = {stream: [] for stream in STREAMS}
    with PoseBag(arguments.inputs[0]) as bag:
        sources = bag.select_topics(arguments.parent_topic, arguments.child_topic)
        measures = {
            stream: bag.measured(source, getattr(config, f"{stream}_measures"))
            for stream, source in zip(STREAMS, sources, strict=True)
        }
        blocks = bag.blocks(*sources, measures=measures)
        for block in with_progress(blocks, bag.expected(*sources), f"reading {bag}", len):
            for stream in STREAMS:
                columns[stream].append(block[block.streams == stream])
        for text in bag.warnings:
            note(text)
    trajectories, findings = {}, []
    for stream, parts in columns.items():
        stamps_ns = np.concatenate([np.empty(0, np.int64), *(part.stamps_ns for part in parts)])
        poses = np.concatenate([np.empty((0, 7)), *(part.poses for part in parts)])
        tidied, found = tidy(stamps_ns, poses[:, :3], poses[:, 3:], stream)
        trajectories[stream] = replace(tidied, measures=measures[stream])
        findings += found
    return trajectories, dict(zip(STREAMS, map(str, sources), strict=True)), findings


def _document(
    sources: Mapping[str, str],
    streams: "Mapping[str, StreamSummary]",
    findings: "Sequence[Finding]",
    checked: "CheckResult",
) -> dict[str, Any]:
    from hand_eye_calib.plain import plain

    return {
        "streams": {
            name: {"source": sources[name], **vars(summary)} for name, summary in streams.items()
        },
        "turning": {
            "time_offset_s": checked.correlation.offset_s,
            "correlation": checked.correlation.correlation,
            "distinctness": checked.correlation.distinctness,
            "rms_rad_in_3_s": checked.rms_rotation,
        },
        "findings": plain(findings),
    }


def _lines(
    sources: Mapping[str, str], streams: "Mapping[str, StreamSummary]", checked: "CheckResult"
) -> list[str]:
    """Both streams, and how much the parent turns."""
    lines = [f"{stream} is {printable(source)}" for stream, source in sources.items()]
    lines.append("{:<8} {:>8} {:>9} {:>7} {:>12} {:>12} {:>10}".format(*_HEADINGS))
    for name, summary in streams.items():
        path, rotation = summary.path_m, summary.rotation_rad
        lines.append(
            f"{name:<8} {summary.poses:8d} {summary.duration_s:9.1f} {summary.rate_hz:7.1f} "
            f"{summary.longest_interval_s:10.3f} s "
            f"{'none' if path is None else f'{path:.1f} m':>12} "
            f"{'none' if rotation is None else f'{math.degrees(rotation):.0f} deg':>10}"
        )
    if checked.rms_rotation:
        turned = "  ".join(
            f"{axis} {math.degrees(angle):.2f}" for axis, angle in checked.rms_rotation.items()
        )
        lines.append(
            f"Rotation of the parent in 3 s about its axes, root mean square: {turned} deg"
        )
    return lines


def _verdict(findings: "Sequence[Finding]") -> str:
    """What the findings mean for a calibration with these streams, in one sentence."""
    from hand_eye_calib.results.verdict import Verdict

    serious = [finding for finding in findings if finding.severity.value != "note"]
    if not serious:
        return f"{Verdict.USE.value}: nothing speaks against calibrating with these streams."
    errors = [finding for finding in serious if finding.makes_unusable]
    word = (Verdict.DO_NOT_USE if errors else Verdict.USE_WITH_CARE).value
    if all(finding.options for finding in serious):
        options = " ".join(typed_options(finding.options.items()) for finding in serious)
        return f"{word}: not as they are; calibrate with {options}."
    codes = ", ".join(finding.code for finding in errors or serious if not finding.options)
    if not errors:
        return f"{word}: look at the findings first ({codes})."
    return f"{word}: no result from these streams is right ({codes or errors[0].code})."


def _table(findings: "Sequence[Finding]") -> Iterator[str]:
    """Lines of the findings, in their order."""
    from hand_eye_calib.cli.present import wrapped

    if not findings:
        yield "No findings."
    for finding in findings:
        mark = finding.severity.value
        mark = mark if mark == "note" else mark.upper()
        yield f"{mark:<8} {finding.code:<17} {finding.stream:<7} {finding.confidence.value}"
        options = typed_options(finding.options.items())
        for text in (finding.what, f"-> {finding.advice}{options and f': {options}'}"):
            yield from wrapped(text, "    ", "    ")
