"""Pages: ``report.html`` of a calibration or a rig, ``check.html``, and what they need. And the
process that writes them for a session of the node.
"""

import os
import pickle
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from hand_eye_calib.cli.options import fail, note, waiting_for
from hand_eye_calib.errors import HandEyeCalibError
from hand_eye_calib.io.results import save_text
from hand_eye_calib.plain import Document
from hand_eye_calib.results.calibration import Calibration

if TYPE_CHECKING:
    from hand_eye_calib.engine.snapshot import Snapshot
    from hand_eye_calib.live.saving import SessionResult
    from hand_eye_calib.session.rig import RigCalibration

REPORT = "report.html"
# Frame of a child sensor that names none: in a rig it has the name of its input.
_NAMELESS = "child_sensor"


def write_report(
    directory: Path, calibration: Calibration, snapshot: "Snapshot | None", inputs: Document
) -> None:
    """Write the report of a result, of the poses and options that gave it, and of where the data
    came from in plain values.
    """
    from hand_eye_calib.report.report import render

    _write(directory, lambda: render(calibration, snapshot, inputs))


def write_rig_report(directory: Path, rig: "RigCalibration", names: Sequence[str]) -> None:
    """Write the report of a rig, whose sensors have these files, topics or frames."""
    from hand_eye_calib.report.report import render_rig

    _write(directory, lambda: render_rig(rig, names))


def _write(directory: Path, page: Callable[[], str]) -> None:
    with waiting_for(f"writing {REPORT}"):
        path = save_text(directory / REPORT, page())
    note(f"wrote {path}")


# ----------------------------------------------------------- a session's pages


def write_session() -> None:
    """Write the pages of a session into the directory that is the only argument of this process.

    It reads the result from standard input, as ``live/saving.py`` writes it.
    """
    os.nice(3)  # as the process that solves: with 15 it took half a minute beside busy programs
    result: SessionResult = pickle.load(sys.stdin.buffer)
    directory = Path(sys.argv[1])
    try:
        if result.others:
            _session_rig(directory / "rig", result)
        if result.with_report:
            from hand_eye_calib.engine.examination import check
            from hand_eye_calib.io.results import save_result

            checked = check(result.snapshot, result.calibration)
            found = replace(result.calibration, findings=checked.findings)
            # The file and the report beside it say the same.
            save_result(found, directory, result.inputs)
            write_report(directory, found, result.snapshot, result.inputs)
    except (HandEyeCalibError, OSError) as error:
        sys.exit(fail(error, 1))


def _session_rig(directory: Path, result: "SessionResult") -> None:
    """Solve for all sensors of a session together, and write the files and the page.

    A time offset and a scale in numbers are the child's, which has them; the others have none.
    """
    from hand_eye_calib.io.results import save_rig
    from hand_eye_calib.session.rig import calibrate_rig

    config, (parent, child) = result.snapshot.config, result.snapshot.streams
    of_all = ["method", "max_gap", "target.translation", "target.rotation"]
    if isinstance(config.time_offset, str):
        of_all.append("time_offset")
    else:
        child = child.shifted(config.time_offset)
    if isinstance(config.scale, str):
        of_all.append("scale")
    else:
        child = child.scaled(config.scale)
    sensors = {result.snapshot.parent_frame: parent, result.snapshot.child_frame: child}
    for name, other in result.others.items():
        frame = other.child_frame
        sensors[name if frame in {*sensors, _NAMELESS} else frame] = other.streams[1]
    options = config.to_options()
    rig = calibrate_rig(sensors, {name: options[name] for name in of_all})
    inputs = {**result.inputs, "sensors": list(rig.sensors)}
    save_rig(rig.to_dict(), rig.calibrations, directory, inputs)
    write_rig_report(directory, rig, rig.sensors)
