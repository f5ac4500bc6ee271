"""The command line for rigs: calibrate three sensors or more, print and save the result."""

import argparse
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.results.document import summary, transforms_of
from hand_eye_calib.offline.beside_motion import switched_off, with_measurements
from hand_eye_calib.offline.cli.config_file import options_from
from hand_eye_calib.offline.cli.options import (
    note,
    print_result,
    refuse_options_of_bags,
    waiting_for,
)
from hand_eye_calib.offline.cli.present import (
    allowance_lines,
    end,
    publish_lines,
    transform_lines,
    verdict_lines,
    wrapped,
)
from hand_eye_calib.offline.cli.reading import (
    read_files,
    refuse_offset_without_stamps,
    span_from,
)

if TYPE_CHECKING:
    from hand_eye_calib.core.base.plain import Document
    from hand_eye_calib.core.engine.snapshot import Snapshot
    from hand_eye_calib.core.geometry.trajectory import Trajectory
    from hand_eye_calib.extras.rig.rig import RigCalibration
    from hand_eye_calib.formats.remote import RestoreUrls


def calibrate_rig(
    arguments: argparse.Namespace, restore_urls: "RestoreUrls"
) -> int:
    """Calibrate a rig, print it, and save it if ``--out`` is set; return the exit code.

    The arguments name a trajectory file for each sensor, or topics of bags. ``restore_urls``
    replaces the paths of downloaded bags by their URLs, in plain values.
    """
    from hand_eye_calib.extras.rig import rig as of_rig
    from hand_eye_calib.formats.results import keep_earlier_results, save_rig

    if arguments.installed or arguments.base_frame:
        raise ConfigError(
            "--installed and --base-frame apply to two sensors, not to a rig"
        )
    readings = (
        _read_topics(arguments) if arguments.topics else _read_files(arguments)
    )
    sensors = _by_frame(readings)
    inputs = restore_urls(readings.inputs) | {
        "options": options_from(arguments)
    }
    if arguments.label:
        inputs["labels"] = dict(arguments.label)
    snapshots: dict[str, Snapshot] = {}
    complete = partial(_completed, arguments, snapshots)
    with waiting_for(f"solving for {len(sensors)} sensors"):
        rig = of_rig.calibrated(sensors, inputs["options"], complete)
    rig = rig.with_warnings(restore_urls(readings.warnings))
    if arguments.out:
        kept = keep_earlier_results(arguments.out)
        file = save_rig(rig.to_dict(), rig.calibrations, arguments.out, inputs)
        note(f"wrote {file}{kept}")
    document = rig.to_dict() | {"inputs": inputs} if arguments.json else None
    try:
        print_result(as_lines(rig, arguments.verbose), document)
    finally:
        # The report is written even if printing fails, for example after the end of a pager.
        if arguments.out:
            from hand_eye_calib.extras.rig.page import write_rig_report

            write_rig_report(
                arguments.out, rig, readings.names, snapshots=snapshots
            )
    return end(rig.calibrations)


def _completed(
    arguments: argparse.Namespace,
    snapshots: "dict[str, Snapshot]",
    snapshot: "Snapshot",
) -> "Snapshot":
    """Add the measurements of a bag that need no motion to the snapshot of two sensors.

    Returns the snapshot, and stores it in ``snapshots`` by the frame of the child.
    """
    if not arguments.topics:
        return snapshot
    without = switched_off(vars(arguments))
    snapshot, notes = with_measurements(snapshot, arguments.paths, without)
    for text in notes:
        note(f"{snapshot.child_frame} in {snapshot.parent_frame}: {text}")
    snapshots[snapshot.child_frame] = snapshot
    return snapshot


class _Readings(NamedTuple):
    """Input of a rig: trajectories, names of their files or topics, provenance, and warnings."""

    trajectories: "list[Trajectory]"
    names: list[str]
    inputs: "Document"
    warnings: list[str]


def _read_topics(arguments: argparse.Namespace) -> _Readings:
    """Read the trajectories of a rig from the topics of bags."""
    from hand_eye_calib.formats.bags.reader import PoseBag
    from hand_eye_calib.formats.bags.sources import source_of
    from hand_eye_calib.formats.results import fingerprint
    from hand_eye_calib.offline.cli.bags import read_sources, refuse_recordings

    topics = arguments.topics
    sources = [*map(source_of, topics)]
    refuse_recordings(arguments.paths, sources)
    stamps = arguments.stamps or "header"
    with PoseBag(*arguments.paths) as bag:
        trajectories, repairs = read_sources(
            bag,
            [(source, "auto", stamps) for source in sources],
            span_from(arguments),
        )
        inputs: Document = {"bag": str(bag), "topics": topics}
        if arguments.out:
            inputs["files"] = [fingerprint(file) for file in bag.files]
        warnings = [*bag.warnings]
    note(*repairs)
    return _Readings(trajectories, topics, inputs, warnings)


def _read_files(arguments: argparse.Namespace) -> _Readings:
    """Read the trajectories of a rig from a file for each sensor."""
    refuse_options_of_bags(arguments)
    refuse_offset_without_stamps(arguments, options_from(arguments))
    names = [*map(str, arguments.paths)]
    files = read_files(arguments, arguments.paths, {})
    note(*files.repairs)
    return _Readings(
        files.trajectories, names, {"files": names}, files.warnings
    )


def _by_frame(readings: _Readings) -> "dict[str, Trajectory]":
    """Return the trajectories by the frames of their sensors.

    Raises a ConfigError if two frames are equal.
    """
    sensors: dict[str, Trajectory] = {}
    for trajectory, name in zip(
        readings.trajectories, readings.names, strict=True
    ):
        frame = trajectory.sensor_frame or name
        if frame in sensors:
            raise ConfigError(
                f"two trajectories of the rig have the sensor name {frame!r}: "
                "the names of their frames or files must differ"
            )
        sensors[frame] = trajectory
    return sensors


def as_lines(rig: "RigCalibration", with_details: bool = False) -> list[str]:
    """Return the lines for the terminal: extrinsics and closures.

    With details, the quaternion and a summary of each result are added.
    """
    from hand_eye_calib.extras.rig.rig import advice_for_pair

    lines = [rig.headline, ""]
    for calibration in rig.calibrations:
        first, *others = verdict_lines(calibration)
        lines += [
            f"{calibration.child_frame} in {calibration.parent_frame}: {first}",
            *others,
            *wrapped(advice_for_pair(calibration), "  -> ", "     "),
        ]
        transform = transforms_of(calibration)["T_parent_child"]
        lines += transform_lines(
            transform, calibration.out_of_reach, with_details
        )
        lines += allowance_lines(calibration)
        lines += [f"  {line}" for line in publish_lines(calibration)]
        if with_details:
            for name, value in summary(calibration).items():
                lines += wrapped(f"{name}: {value}", "  ", "    ")
        lines.append("")
    lines.append("Results for two sensors at a time")
    for closure in rig.closures:
        lines += wrapped(closure.sentence, "  ", "    ")
    return lines
