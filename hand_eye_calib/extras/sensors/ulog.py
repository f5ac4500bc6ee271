"""Poses in a log of PX4 (ULog)."""

import io
from collections.abc import Mapping
from typing import Any

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.errors import required
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.trajectory_files.columns import POSITION

# Topics of a log that may contain the poses.
_TOPICS = ["vehicle_odometry", "vehicle_local_position", "vehicle_attitude"]


def logged_poses(data: bytes) -> tuple[IntArray, FloatArray]:
    """Return stamps (N,), us, and poses (N, 4, 4) of a log.

    The axes of the vehicle are forward, right, down. Those of its world are north, east, down.

    Raises
    ------
    ValueError
        If the log is damaged, or contains no poses.
    """
    pyulog = required("pyulog", "a log of PX4", "px4")
    try:
        log = pyulog.ULog(io.BytesIO(data), _TOPICS)
        first_instances = [
            logged for logged in log.data_list if logged.multi_id == 0
        ]
        return _poses_of_topics(
            {logged.name: logged.data for logged in first_instances}
        )
    except KeyError:
        reason = ""
    # Damaged logs raise errors of many kinds.
    except Exception as error:
        reason = f", {type(error).__name__}: {error}"
    raise ValueError(
        f"the log of PX4 does not contain {' or '.join(_TOPICS[:2])}{reason}"
    )


def _poses_of_topics(data: Mapping[str, Any]) -> tuple[IntArray, FloatArray]:
    """Return stamps (N,), us, and poses (N, 4, 4) from the topics of a log of PX4."""
    quaternion = ["q[1]", "q[2]", "q[3]", "q[0]"]
    if "vehicle_odometry" in data:
        odometry = data["vehicle_odometry"]
        place = [*POSITION]
        if "x" not in odometry:
            place = ["position[0]", "position[1]", "position[2]"]
        stamps_us, values = _logged(odometry, *place, *quaternion)
        return stamps_us, se3.from_quat_xyzw(values[:, :3], values[:, 3:])
    stamps_us, positions = _logged(data["vehicle_local_position"], *POSITION)
    times_us, quats_xyzw = _logged(data["vehicle_attitude"], *quaternion)
    no_positions = np.zeros((len(times_us), 3))
    attitudes = Trajectory.from_quat_xyzw(
        1000 * times_us, no_positions, quats_xyzw
    )
    is_inside = (stamps_us >= times_us[0]) & (stamps_us <= times_us[-1])
    stamps_us = stamps_us[is_inside]
    Ts = attitudes.at(1000 * stamps_us)
    Ts[:, :3, 3] = positions[is_inside]
    return stamps_us, Ts


def _logged(
    data: Mapping[str, Any], *names: str
) -> tuple[IntArray, FloatArray]:
    """Return the valid values of a topic in a log of PX4, and their increasing stamps (us)."""
    values = np.stack([data[name] for name in names], axis=1).astype(float)
    is_valid = np.isfinite(values).all(axis=1)
    # Local positions have these flags.
    for flag in {"xy_valid", "z_valid"} & data.keys():
        is_valid &= data[flag] > 0
    if not is_valid.any():
        raise ValueError(f"none of {', '.join(names)} is valid")
    sampled_us = data.get("timestamp_sample", data["timestamp"])
    valid_us = sampled_us[is_valid].astype(np.int64)
    stamps_us, first = np.unique(valid_us, return_index=True)
    return stamps_us, values[is_valid][first]
