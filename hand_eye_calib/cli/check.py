"""``check BAG`` or ``check PARENT CHILD``: look at both streams before believing them."""

import json
import math
from pathlib import Path

from hand_eye_calib.cli.calibrate import add_file_arguments, read_files
from hand_eye_calib.cli.console import fail, note, waiting_for, with_progress
from hand_eye_calib.cli.options import add_config_arguments, add_json_argument, config_from
from hand_eye_calib.errors import ConfigError

STREAMS = ("parent", "child")


def add_arguments(parser):
    """Declare the command's arguments."""
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
        help="write check.html into this directory: the findings, and a picture of both streams",
    )
    add_json_argument(parser)


def run(arguments):
    """Print what was found; returns 1 where something is wrong with the streams, otherwise 0."""
    from hand_eye_calib.checks.check import check_streams
    from hand_eye_calib.checks.findings import Severity
    from hand_eye_calib.checks.streams import summarise
    from hand_eye_calib.engine.calibrator import ESTIMATE

    if len(arguments.inputs) > 2:
        raise ConfigError(f"expected one bag or two trajectory files; got {len(arguments.inputs)}")
    config = config_from(arguments)
    trajectories, findings = (
        _read_bag(arguments) if len(arguments.inputs) == 1 else _read_files(arguments)
    )
    parent, child = (trajectories[stream] for stream in STREAMS)
    # What is to be estimated is not known yet: the checks say what it is.
    offset_s = 0.0 if config.time_offset == ESTIMATE else config.time_offset
    scale = config.scale if isinstance(config.scale, float) else 1.0
    with waiting_for("checking"):
        agreement = check_streams(parent, child, offset_s, scale, config.max_gap)
    findings = [*agreement.findings, *findings]
    streams = {
        name: summarise(trajectory)
        for name, trajectory in trajectories.items()
        if len(trajectory) > 1
    }
    if arguments.json:
        print(json.dumps(_document(streams, findings, agreement), indent=2, allow_nan=False))
    else:
        print(_text(streams, findings, agreement))
    if arguments.out:
        from hand_eye_calib.cli.reporting import write_check

        corrected = child.shifted(offset_s).scaled(scale)
        write_check(
            arguments.out, parent, corrected, agreement, findings, arguments.inputs, config.max_gap
        )
    if all(finding.severity is Severity.NOTE for finding in findings):
        return 0
    return fail(f"{findings[0].what}; {findings[0].advice}", 1)


def _read_files(arguments):
    from hand_eye_calib.checks.findings import repaired_file

    arguments.parent, arguments.child = arguments.inputs
    arguments.repair_stamps = True
    trajectories, notes = read_files(arguments)
    return trajectories, [repaired_file(text) for text in notes]


def _read_bag(arguments):
    import numpy as np

    from hand_eye_calib.checks.streams import tidy
    from hand_eye_calib.io.bags import PoseBag

    columns = {stream: ([], [], []) for stream in STREAMS}
    with PoseBag(arguments.inputs[0]) as bag:
        sources = bag.select_topics(arguments.parent_topic, arguments.child_topic)
        poses = bag.poses(*sources)
        for pose in with_progress(poses, bag.expected(*sources), f"reading {bag}"):
            for column, value in zip(
                columns[pose.stream], (pose.stamp_ns, pose.position, pose.quat_xyzw), strict=True
            ):
                column.append(value)
        for text in bag.warnings:
            note(text)
    trajectories, findings = {}, []
    for stream, (stamps_ns, positions, quats_xyzw) in columns.items():
        trajectories[stream], found = tidy(
            np.array(stamps_ns, dtype=np.int64),
            np.reshape(positions, (-1, 3)),
            np.reshape(quats_xyzw, (-1, 4)),
            stream,
        )
        findings += found
    return trajectories, findings


def _document(streams, findings, agreement):
    return {
        "streams": {name: vars(summary) for name, summary in streams.items()},
        "turning": {
            "time_offset_s": agreement.correlation.offset_s,
            "correlation": agreement.correlation.correlation,
            "distinctness": agreement.correlation.distinctness,
            "rms_rad_in_3_s": agreement.rms_rotation,
        },
        "findings": [finding.to_dict() for finding in findings],
    }


def _text(streams, findings, agreement):
    from hand_eye_calib.cli.findings import table

    lines = [
        f"{'':<8} {'poses':>8} {'seconds':>9} {'per s':>7} {'longest gap':>12} {'way':>10} {'turned':>10}"
    ]
    for name, summary in streams.items():
        lines.append(
            f"{name:<8} {summary.poses:8d} {summary.duration_s:9.1f} {summary.rate_hz:7.1f} {summary.longest_interval_s:10.3f} s "
            f"{summary.path_m:8.1f} m {math.degrees(summary.rotation_rad):6.0f} deg"
        )
    if agreement.rms_rotation:
        turned = "  ".join(
            f"{axis} {math.degrees(angle):.2f}" for axis, angle in agreement.rms_rotation.items()
        )
        lines.append(
            f"The parent turns about its axes, in 3 s and root mean square:  {turned}  deg"
        )
    return "\n".join([*lines, "", table(findings)])
