"""A rig of three sensors or more: calibrated, printed and saved."""

import argparse
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from hand_eye_calib.cli.console import note, waiting_for
from hand_eye_calib.cli.options import options_from
from hand_eye_calib.cli.present import exit_code, show, transform_lines, wrapped
from hand_eye_calib.cli.reporting import write_rig_report
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import ConfigError, printable

if TYPE_CHECKING:
    from hand_eye_calib.geometry.trajectory import Trajectory
    from hand_eye_calib.io.remote import AsGiven
    from hand_eye_calib.rig.result import RigCalibration


def calibrate_bag(arguments: argparse.Namespace, as_given: "AsGiven") -> int:
    """Calibrate a rig from the topics of a bag; returns the exit code.

    ``as_given`` puts the name of a remote bag back into plain values.
    """
    from hand_eye_calib.cli.replaying import fingerprints, refuse_recordings
    from hand_eye_calib.io.bags import PoseBag, trajectory_of
    from hand_eye_calib.io.transforms import TfSource

    found: dict[str, Trajectory] = {}
    with PoseBag(*arguments.bags) as bag:
        for topic in arguments.topics:
            source = TfSource.parse(topic) if ":" in topic else topic
            refuse_recordings(arguments.bags, {"parent": source}, CalibratorConfig.max_gap)
            with waiting_for(f"reading {topic}"):
                trajectory, notes = trajectory_of(bag, source)
            for text in notes:
                note(text)
            add_sensor(found, trajectory.sensor_frame or topic, trajectory)
        for text in bag.warnings:
            note(text)
        inputs: dict[str, Any] = {"bag": str(bag), "topics": arguments.topics}
        files = bag.files()
    if arguments.out:
        inputs["files"] = fingerprints(files)
    return calibrate_and_deliver(found, arguments, as_given(inputs))


def calibrate_and_deliver(
    trajectories: Mapping[str, "Trajectory"], arguments: argparse.Namespace, inputs: dict[str, Any]
) -> int:
    """Calibrate a rig, print it and save it if ``--out`` asks for that; returns the exit code.

    Parameters
    ----------
    trajectories : mapping of str to Trajectory
        By the sensors' frames.
    arguments : argparse.Namespace
        With the calibration options, ``json`` and ``out``.
    inputs : dict
        Where the data came from, in plain values.
    """
    from hand_eye_calib.io.rig_files import save_rig
    from hand_eye_calib.rig.calibrate import solve_rig

    _refuse_robot(arguments)
    options = options_from(arguments)
    with waiting_for(f"solving for {len(trajectories)} sensors"):
        rig = solve_rig(trajectories, options)
    inputs = {**inputs, "options": dict(options)}

    def finish() -> None:
        if arguments.out:
            write_rig_report(arguments.out, rig, inputs.get("topics") or inputs["files"])

    codes = [exit_code(each) for each in rig.calibrations]
    failed = [each for each in rig.calibrations if each.status.failure]
    return show(
        arguments,
        lambda: rig.to_dict() | {"inputs": inputs},
        lambda: "\n".join(printable(line) for line in as_lines(rig)),
        save=lambda: save_rig(rig.to_dict(), rig.calibrations, arguments.out, inputs),
        finish=finish,
        errors=[f"{each.child_frame}: {each.headline}" for each in failed],
        code=1 if failed else max(codes),
    )


def add_sensor(found: dict[str, "Trajectory"], name: str, trajectory: "Trajectory") -> None:
    """Add the trajectory of a sensor by its name, which no other one has.

    Raises
    ------
    ConfigError
        If another one has it.
    """
    if name in found:
        raise ConfigError(
            f"two trajectories of the rig are of one sensor, {name!r}: sensors have the names of "
            "their frames or files, which must differ"
        )
    found[name] = trajectory


def as_lines(rig: "RigCalibration") -> list[str]:
    """What a person needs to see of a rig: tree, extrinsics, closure, noise."""
    lines = [f"{rig.verdict.value}: {len(rig.sensors)} sensors", "", *rig.tree(), ""]
    for each in rig.calibrations:
        lines += [f"{each.child_frame} in {each.parent_frame}: {each.headline}"]
        lines += [
            line
            for reason in each.reasons
            for line in wrapped(f"{reason.sentence}: {reason.what_to_do}", "- ", "  ")
        ]
        lines += [line for text in each.warnings for line in wrapped(f"Note: {text}", "", "  ")]
        lines += [*transform_lines(each.to_dict()["T_parent_child"]), ""]
    lines.append("Answers for two sensors at a time")
    lines += _indented(closure.sentence for closure in rig.closures)
    if noise := rig.noise_in_words():
        lines += ["", "Noise of every sensor", *_indented(noise)]
    return lines


def _indented(texts: Iterable[str]) -> list[str]:
    return [line for text in texts for line in wrapped(text, "  ", "    ")]


def _refuse_robot(arguments: argparse.Namespace) -> None:
    """Options that compare or write one extrinsic."""
    for name in ("installed", "urdf", "write", "base_frame"):
        if getattr(arguments, name, None):
            raise ConfigError(f"--{name.replace('_', '-')} is of two sensors, not of a rig")
