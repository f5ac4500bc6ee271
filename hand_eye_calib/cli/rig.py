"""A rig of three sensors or more: calibrated, printed and saved."""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from hand_eye_calib.cli.console import fail, note, print_result, waiting_for
from hand_eye_calib.cli.options import options_from
from hand_eye_calib.cli.parts import refuse_recordings
from hand_eye_calib.cli.present import exit_code, transform_lines, wrapped
from hand_eye_calib.cli.reading import file_settings, read_files, source_of
from hand_eye_calib.cli.reporting import rendered_rig, write_report
from hand_eye_calib.errors import ConfigError, printable
from hand_eye_calib.plain import json_text

if TYPE_CHECKING:
    from hand_eye_calib.geometry.trajectory import Trajectory
    from hand_eye_calib.io.remote import AsGiven
    from hand_eye_calib.rig.result import RigCalibration


def calibrate_files(arguments: argparse.Namespace) -> int:
    """Calibrate a rig from a trajectory file of each sensor; returns the exit code."""
    trajectories, repairs = read_files(arguments.paths, file_settings(arguments), {})
    for text in repairs:
        note(text)
    return _calibrate(trajectories, arguments, {"files": [*map(str, arguments.paths)]})


def calibrate_bag(arguments: argparse.Namespace, as_given: "AsGiven") -> int:
    """Calibrate a rig from the topics of a bag; returns the exit code.

    ``as_given`` puts the name of a remote bag back into plain values.
    """
    from hand_eye_calib.io.bags import PoseBag, trajectory_of
    from hand_eye_calib.io.results import fingerprint

    trajectories = []
    with PoseBag(*arguments.paths) as bag:
        for topic in arguments.topics:
            with waiting_for(f"reading {topic}"):
                trajectory, notes = trajectory_of(bag, source_of(topic))
            for text in notes:
                note(text)
            frame = trajectory.sensor_frame or topic
            trajectories.append(replace(trajectory, sensor_frame=frame))
        refuse_recordings(bag.paths, dict.fromkeys(map(source_of, arguments.topics), "auto"))
        for text in bag.warnings:
            note(text)
        inputs: dict[str, Any] = {"bag": str(bag), "topics": arguments.topics}
        if arguments.out:
            inputs["files"] = [fingerprint(file) for file in bag.files()]
    return _calibrate(trajectories, arguments, as_given(inputs))


def _calibrate(
    trajectories: "Sequence[Trajectory]", arguments: argparse.Namespace, inputs: dict[str, Any]
) -> int:
    """Calibrate a rig, print it and save it if ``--out`` asks for that; returns the exit code."""
    from hand_eye_calib.io.results import save_rig
    from hand_eye_calib.rig.calibrate import solve_rig

    if arguments.installed or arguments.base_frame:
        raise ConfigError("--installed and --base-frame are of two sensors, not of a rig")
    frames = [each.sensor_frame for each in trajectories]
    if twice := [each for each in frames if frames.count(each) > 1]:
        raise ConfigError(
            f"two trajectories of the rig are of one sensor, {twice[0]!r}: sensors have the names "
            "of their frames or files, which must differ"
        )
    sensors = dict(zip(frames, trajectories, strict=True))
    inputs |= {"options": options_from(arguments)}
    with waiting_for(f"solving for {len(sensors)} sensors"):
        rig = solve_rig(sensors, inputs["options"])

    if arguments.out:
        note(f"wrote {save_rig(rig.to_dict(), rig.calibrations, arguments.out, inputs)}")
    if arguments.json:
        print(json_text(rig.to_dict() | {"inputs": inputs}), flush=True)
    else:
        print_result("\n".join(printable(line) for line in as_lines(rig)))
    if arguments.out:
        names = inputs.get("topics") or inputs["files"]
        write_report(arguments.out, lambda: rendered_rig(rig, names))
    failed = [each for each in rig.calibrations if each.status.failure]
    for each in failed:
        fail(f"{each.child_frame}: {each.headline}", 1)
    return 1 if failed else max(map(exit_code, rig.calibrations))


def as_lines(rig: "RigCalibration") -> list[str]:
    """What a person needs to see of a rig: tree, extrinsics, closure."""
    lines = [f"{rig.verdict.value}: {len(rig.sensors)} sensors", "", *rig.tree(), ""]
    for each in rig.calibrations:
        lines += [f"{each.child_frame} in {each.parent_frame}: {each.headline}"]
        for reason in each.reasons:
            lines += wrapped(f"{reason.sentence}: {reason.what_to_do}", "- ", "  ")
        for text in each.warnings:
            lines += wrapped(f"Note: {text}", "", "  ")
        lines += [*transform_lines(each.to_dict()["T_parent_child"]), ""]
    lines += ["Results for two sensors at a time"]
    for one in rig.closures:
        lines += wrapped(one.sentence, "  ", "    ")
    return lines
