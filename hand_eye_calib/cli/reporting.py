"""Pages: ``report.html`` of a calibration or a rig, ``check.html``, and what they need. And the
process that writes them for a session of the node.
"""

import os
import pickle
import shlex
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hand_eye_calib.cli.console import fail, note, waiting_for
from hand_eye_calib.errors import HandEyeCalibError, InputError
from hand_eye_calib.results.calibration import Calibration

if TYPE_CHECKING:
    from hand_eye_calib.engine.snapshot import Snapshot
    from hand_eye_calib.live.saving import SessionResult
    from hand_eye_calib.rig.result import RigCalibration

REPORT = "report.html"
# Frame of a child sensor that names none: in a rig it has the name of its input.
_NAMELESS = "child_sensor"


def static_transform_command(calibration: Calibration) -> str:
    """Shell command that publishes the child's pose as a static transform, in the frame that it is
    mounted on.

    Empty if the verdict is DO NOT USE. For an axis that the motion does not determine it has a word
    that static_transform_publisher refuses.
    """
    numbers = calibration.usable_numbers()
    if not numbers:
        return ""
    told = " ".join(
        f"--{name} {value if isinstance(value, str) else f'{round(value, 9) + 0.0:.9f}'}"
        for name, value in numbers.items()
    )
    parent, child = map(shlex.quote, (calibration.mounting[0], calibration.child_frame))
    return (
        f"ros2 run tf2_ros static_transform_publisher {told} "
        f"--frame-id {parent} --child-frame-id {child}"
    )


# ----------------------------------------------------------------------- pages


def rendered(
    calibration: Calibration, snapshot: "Snapshot | None", inputs: Mapping[str, Any]
) -> str:
    """The report as HTML, of a result, the poses and options that gave it, and where the data came
    from in plain values.
    """
    from hand_eye_calib.report.report import render

    command = static_transform_command(calibration)
    return render(calibration, snapshot, inputs=inputs, command=command)


def write_report(directory: Path, render: Callable[[], str]) -> None:
    """Write the report that a function gives, such as :func:`rendered`."""
    from hand_eye_calib.io.results import save_text

    with waiting_for(f"writing {REPORT}"):
        save_text(directory / REPORT, render())
    note(f"wrote {directory / REPORT}")


def rendered_rig(rig: "RigCalibration", names: Any) -> str:
    """The report of a rig, whose sensors have these files, topics or frames."""
    from hand_eye_calib.report.rig_page import render_rig

    return render_rig(rig, names)


# ----------------------------------------------------------- a session's pages


def write_session() -> None:
    """Write the pages of a session into the directory that is the only argument of this process.

    It reads the result from standard input, as ``live/saving.py`` writes it.
    """
    os.nice(15)  # every other program goes first
    result: SessionResult = pickle.load(sys.stdin.buffer)
    directory = Path(sys.argv[1])
    try:
        if result.others:
            _session_rig(directory / "rig", result)
        if result.with_report:
            from hand_eye_calib.engine.run import review
            from hand_eye_calib.io.results import save_result

            found = review(result.calibration, result.snapshot, may_solve=False)
            # The file and the report beside it say the same.
            save_result(found.calibration, directory, result.inputs)
            of = found.calibration, result.snapshot, result.inputs
            write_report(directory, lambda: rendered(*of))
    except (HandEyeCalibError, OSError) as error:
        sys.exit(fail(error, 1))


def _session_rig(directory: Path, result: "SessionResult") -> None:
    """Solve for all sensors of a session together, and write the files and the page.

    A time offset and a scale in numbers are the child's, which has them; the others have none.
    """
    from hand_eye_calib.io.results import save_rig
    from hand_eye_calib.rig.calibrate import solve_rig

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
        if other.config.child_measures not in ("auto", "poses"):
            raise InputError(f"{name} has {other.config.child_measures}: a rig takes poses")
        frame = other.child_frame
        sensors[name if frame in {*sensors, _NAMELESS} else frame] = other.streams[1]
    options = config.to_options()
    rig = solve_rig(sensors, {name: options[name] for name in of_all})
    inputs = {**result.inputs, "sensors": list(rig.sensors)}
    save_rig(rig.to_dict(), rig.calibrations, directory, inputs)
    write_report(directory, lambda: rendered_rig(rig, rig.sensors))
