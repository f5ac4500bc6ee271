"""The process that writes ``report.html`` of a session of the node: it reads the result from
standard input, as ``ros/report_process.py`` writes it. The results of further child sensors go to
standard output.
"""

import os
import pickle
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hand_eye_calib.cli.console import fail
from hand_eye_calib.errors import HandEyeCalibError, InputError

if TYPE_CHECKING:
    from hand_eye_calib.calibration import Calibration
    from hand_eye_calib.geometry.trajectory import Trajectory
    from hand_eye_calib.ros.report_process import SessionResult

# Frame of a child sensor that names none: in a rig it has the name of its input.
_NAMELESS = "child_sensor"

# Every other program goes first.
_NICENESS = 15


def main() -> None:
    """Write the report into the directory that is the only argument."""
    os.nice(_NICENESS)
    result: SessionResult = pickle.load(sys.stdin.buffer)
    try:
        write(Path(sys.argv[1]), result)
    except HandEyeCalibError as error:
        sys.exit(fail(error, 1))


def write(directory: Path, result: "SessionResult") -> None:
    """Check the streams, cross-check the result, and write the page.

    Raises
    ------
    HandEyeCalibError
        If it cannot be written.
    """
    if result.others:
        pickle.dump(write_rig(directory / "rig", result), sys.stdout.buffer)
    if not result.with_report:
        return
    from hand_eye_calib.cli.findings import with_findings
    from hand_eye_calib.cli.reporting import with_cross_check, write_report

    calibration, _ = with_findings(result.calibration, result.snapshot)
    calibration, evidence = with_cross_check(calibration, result.snapshot)
    config, inputs = result.snapshot.config, result.inputs
    write_report(directory, calibration, evidence, config, inputs)


def write_rig(directory: Path, result: "SessionResult") -> "list[Calibration]":
    """Solve for all sensors of the session together, and write the files and the page; returns the
    results of the further child sensors.

    Raises
    ------
    HandEyeCalibError
        If they cannot be solved together, or nothing can be written.
    """
    from hand_eye_calib.cli.reporting import write_rig_report
    from hand_eye_calib.io.rig_files import save_rig
    from hand_eye_calib.rig.calibrate import solve_rig

    rig = solve_rig(*rig_of(result))
    inputs = {**result.inputs, "sensors": list(rig.sensors)}
    save_rig(rig.to_dict(), rig.calibrations, directory, inputs)
    write_rig_report(directory, rig, rig.sensors)
    return [*rig.calibrations[1:]]


def rig_of(result: "SessionResult") -> "tuple[dict[str, Trajectory], dict[str, Any]]":
    """The trajectories of all sensors by their frames, and the options to solve them with.

    A time offset and a scale in numbers are the child's, which has them; the others have none.
    """
    snapshot = result.snapshot
    parent, child = snapshot.streams
    config, options = snapshot.config, snapshot.config.to_options()
    of_all = ["method", "max_gap", "target.translation", "target.rotation"]
    if isinstance(config.time_offset, str):
        of_all.append("time_offset")
    else:
        child = child.shifted(config.time_offset)
    if isinstance(config.scale, str):
        of_all.append("scale")
    else:
        child = child.scaled(config.scale)
    found = {snapshot.parent_frame: parent, snapshot.child_frame: child}
    for name, other in result.others.items():
        if other.config.child_measures not in ("auto", "poses"):
            raise InputError(f"{name} has {other.config.child_measures}: a rig takes poses")
        frame = other.child_frame
        found[name if frame in found or frame == _NAMELESS else frame] = other.streams[1]
    return found, {name: options[name] for name in of_all}
