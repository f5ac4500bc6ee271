"""Rigs on the command line: calibrate three sensors or more, print and save the result."""

import argparse
from typing import TYPE_CHECKING

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.results.document import transforms_of
from hand_eye_calib.offline.cli.options import (
    fail,
    note,
    options_from,
    print_result,
    refuse_stamps,
    waiting_for,
)
from hand_eye_calib.offline.cli.present import (
    allowance_lines,
    exit_code,
    transform_lines,
    verdict_lines,
    wrapped,
)
from hand_eye_calib.offline.cli.reading import read_files

if TYPE_CHECKING:
    from hand_eye_calib.core.base.plain import Document
    from hand_eye_calib.extras.rig.rig import RigCalibration
    from hand_eye_calib.formats.remote import AsGiven


def calibrate_rig(arguments: argparse.Namespace, as_given: "AsGiven") -> int:
    """Calibrate a rig, print it, and save it if ``--out`` is set; return the exit code.

    The data are a trajectory file for each sensor, or topics of bags. ``as_given`` puts the name of
    a remote bag back into plain values.
    """
    from hand_eye_calib.extras.rig import rig as of_rig
    from hand_eye_calib.formats.results import fingerprint, save_rig

    if arguments.installed or arguments.base_frame:
        raise ConfigError("--installed and --base-frame are of two sensors, not of a rig")
    topics = arguments.topics
    if topics:
        from hand_eye_calib.formats.bags.reader import PoseBag
        from hand_eye_calib.formats.bags.sources import source_of
        from hand_eye_calib.offline.cli.bags import read_sources, refuse_recordings

        names = topics
        sources = [*map(source_of, topics)]
        refuse_recordings(arguments.paths, sources)
        with PoseBag(*arguments.paths) as bag:
            stamps = arguments.stamps or "header"
            readings = [(source, "auto", stamps) for source in sources]
            trajectories, notes = read_sources(bag, readings)
            inputs: Document = {"bag": str(bag), "topics": topics}
            if arguments.out:
                inputs["files"] = [fingerprint(file) for file in bag.files]
    else:
        refuse_stamps(arguments)
        names = [*map(str, arguments.paths)]
        trajectories, repairs, doubts = read_files(arguments, arguments.paths, {})
        notes = [*repairs, *doubts]
        inputs = {"files": names}
    note(*notes)
    sensors = {}
    for trajectory, name in zip(trajectories, names, strict=True):
        frame = trajectory.sensor_frame or name
        if frame in sensors:
            raise ConfigError(
                f"two trajectories of the rig are of one sensor, {frame!r}: sensors have the names "
                "of their frames or files, which must differ"
            )
        sensors[frame] = trajectory
    inputs = as_given(inputs) | {"options": options_from(arguments)}
    with waiting_for(f"solving for {len(sensors)} sensors"):
        rig = of_rig.calibrate_rig(sensors, inputs["options"])
    if arguments.out:
        note(f"wrote {save_rig(rig.to_dict(), rig.calibrations, arguments.out, inputs)}")
    try:
        print_result(as_lines(rig), rig.to_dict() | {"inputs": inputs} if arguments.json else None)
    finally:  # also if the reader of the printed lines has ended
        if arguments.out:
            from hand_eye_calib.extras.rig.page import write_rig_report

            write_rig_report(arguments.out, rig, names)
    failed = [calibration for calibration in rig.calibrations if calibration.status.failure]
    for calibration in failed:
        fail(f"{calibration.child_frame}: {calibration.headline}", 1)
    return 1 if failed else max(map(exit_code, rig.calibrations))


def as_lines(rig: "RigCalibration") -> list[str]:
    """Return the lines of a rig for a terminal: extrinsics and closures."""
    lines = [f"{rig.verdict.value}: {len(rig.sensors)} sensors", ""]
    for calibration in rig.calibrations:
        first, *others = verdict_lines(calibration)
        lines += [f"{calibration.child_frame} in {calibration.parent_frame}: {first}", *others]
        lines += transform_lines(transforms_of(calibration)["T_parent_child"])
        lines += [*allowance_lines(calibration), ""]
    lines.append("Results for two sensors at a time")
    for closure in rig.closures:
        lines += wrapped(closure.sentence, "  ", "    ")
    return lines
