"""Report of a rig: the poses of its sensors, and the closure errors."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from hand_eye_calib.core.base.spelling import Interface
from hand_eye_calib.core.engine.session_result import SessionResult
from hand_eye_calib.core.engine.snapshot import Snapshot
from hand_eye_calib.core.results.document import printed_numbers, transforms_of
from hand_eye_calib.extras.rig.rig import (
    KINDS,
    RigCalibration,
    advice_for_pair,
    calibrate_rig,
)
from hand_eye_calib.formats.results import save_rig
from hand_eye_calib.offline.cli.reporting import write_page
from hand_eye_calib.offline.report.report import TONES, page, pictures_of_extras
from hand_eye_calib.offline.report.views import figure_of_views

# Default name of a child sensor's frame. In a rig, such a sensor gets the name of its stream.
_NAMELESS = "child_sensor"


def write_rig_report(
    directory: Path,
    rig: RigCalibration,
    names: Sequence[str],
    interface: Interface = Interface.TERMINAL,
    snapshots: Mapping[str, Snapshot] | None = None,
) -> None:
    """Write the report of a rig; the arguments are those of :func:`render_rig`."""
    write_page(directory, lambda: render_rig(rig, names, interface, snapshots))


def render_rig(
    rig: RigCalibration,
    inputs: Sequence[str],
    interface: Interface = Interface.TERMINAL,
    snapshots: Mapping[str, Snapshot] | None = None,
) -> str:
    """Return the report of a rig as HTML.

    Parameters
    ----------
    rig : RigCalibration
    inputs : sequence of str
        Files, topics or frames of the sensors.
    interface : Interface
    snapshots : mapping of str to Snapshot, optional
        Streams of the first sensor and of each other sensor, by the frame of the other sensor.
    """
    figures = [figure_of_views(rig.calibrations)]
    for number, calibration in enumerate(rig.calibrations, 1):
        snapshot = (snapshots or {}).get(calibration.child_frame)
        figures += pictures_of_extras(calibration, snapshot, f"-{number}")
    return page(
        Path(__file__).with_name("rig.html"),
        TONES[rig.verdict.value],
        rig.verdict.value,
        "",
        interface,
        rig=rig,
        advice_for_pair=advice_for_pair,
        inputs=inputs,
        poses=[
            printed_numbers(
                transforms_of(calibration)["T_parent_child"], (), "±"
            )
            for calibration in rig.calibrations
        ],
        figures=figures,
    )


def write_session_rig(directory: Path, session: SessionResult) -> None:
    """Calibrate all sensors of a session together, and write the files and the report.

    A numeric time offset or scale applies to the first child only, so its trajectory is corrected
    before.
    """
    config = session.snapshot.config
    parent, child = session.snapshot.streams
    # Options that apply to all sensors.
    names = ["method", "max_gap", "target.translation", "target.rotation"]
    names += KINDS
    if isinstance(config.time_offset, str):
        names.append("time_offset")
    else:
        child = child.shifted(config.time_offset)
    if isinstance(config.scale, str):
        names.append("scale")
    else:
        child = child.scaled(config.scale)
    sensors = {
        session.snapshot.parent_frame: parent,
        session.snapshot.child_frame: child,
    }
    for name, other in session.others.items():
        frame = other.child_frame
        sensors[name if frame in {*sensors, _NAMELESS} else frame] = (
            other.streams[1]
        )
    options = config.to_options()
    rig = calibrate_rig(sensors, {name: options[name] for name in names})
    inputs = {**session.inputs, "sensors": list(rig.sensors)}
    save_rig(rig.to_dict(), rig.calibrations, directory / "rig", inputs)
    write_rig_report(directory / "rig", rig, rig.sensors, Interface.NODE)
