"""Calibrate a sensor in the frame of its vehicle."""

from argparse import Namespace
from dataclasses import replace
from typing import Any

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry.trajectory import Trajectory, TrajectoryLike
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.formats.trajectory_files.reading import read_trajectories
from hand_eye_calib.offline.calibrate import calibrate
from hand_eye_calib.offline.cli import reading
from hand_eye_calib.offline.cli.config_file import options_from
from hand_eye_calib.offline.cli.options import note
from hand_eye_calib.offline.cli.present import deliver


def calibrate_vehicle(
    sensor: TrajectoryLike, wheels: TrajectoryLike | None = None, **options: Any
) -> Calibration:
    """Estimate the pose of a sensor in the frame of its vehicle, and the size of the wheels.

    The origin of the vehicle frame is in the middle of the driven or rear axle: x ahead, y left, z
    up. A drive on a flat floor does not determine z. A drive without wheel data does not determine
    y, either.

    Parameters
    ----------
    sensor : Trajectory, path, array or DataFrame
        Poses of the sensor in its own world, m.
    wheels : Trajectory or path, optional
        Csv file of wheel data, or the result of :func:`hand_eye_calib.wheel_trajectory`. For poses
        of a wheel odometry, set ``parent_measures`` to ``wheel_odometry`` or ``omni``.
    **options
        Options of :func:`hand_eye_calib.calibrate`; the parent is the vehicle, the child the
        sensor.

    Returns
    -------
    Calibration
        ``result.wheels`` contains the parameters of the wheels.

    Raises
    ------
    ConfigError, InputError, NotEnoughDataError
        As :func:`hand_eye_calib.calibrate`.

    Examples
    --------
    >>> hec.calibrate_vehicle("lidar.tum").out_of_reach  # doctest: +SKIP
    ('y', 'z')
    """
    if wheels is not None:
        return calibrate(wheels, sensor, **options)
    if not isinstance(sensor, Trajectory):
        (sensor,) = read_trajectories(sensor)
    return calibrate(_driving(sensor), sensor, **options)


def _driving(sensor: Trajectory) -> Trajectory:
    """Return the parent stream for a sensor without wheel data.

    Its kind of data is "driving": the poses of the stream are not used, only the limits of a
    vehicle's motion.
    """
    return replace(
        sensor, sensor_frame="base_link", world_frame="", measures="driving"
    )


def calibrate_alone(arguments: Namespace) -> int:
    """Calibrate the sensor of a trajectory file on its vehicle, and return the exit code."""
    (path,) = arguments.paths
    if reading.looks_like_bag(path):
        raise ConfigError(
            f"{path} is a bag: --on-vehicle takes the trajectory file of one sensor. Choose the "
            "wheels and the sensor with --parent-topic and --child-topic, or write the sensor's "
            "poses into a file"
        )
    options = options_from(arguments)
    files = reading.read_files(arguments, arguments.paths, options)
    note(*files.repairs)
    sensor = files.trajectories[0]
    recording = reading.Recording(
        whole_snapshot(_driving(sensor), sensor, options),
        {"child": {"file": str(arguments.paths[0]), "poses": len(sensor)}},
        [*arguments.paths],
        tuple(files.warnings),
    )
    calibration = recording.solved(with_fingerprints=bool(arguments.out))
    return deliver(calibration, recording.inputs, arguments, recording.snapshot)
