"""Writing a trajectory to a text file."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.files import write_atomically
from hand_eye_calib.io.trajectory_files.poses import seconds
from hand_eye_calib.io.trajectory_files.reading import TUM_COLUMNS


def write_trajectory(
    path: str | Path, trajectory: Trajectory, format: str = "tum", topic: str = "/odometry"
) -> None:
    """Write a trajectory to a text file, replacing it if it exists, or to a new bag. Reading it
    back gives the same stamps and poses.

    Parameters
    ----------
    path : str or path-like
    trajectory : Trajectory
    format : str
        "tum", which evo reads, too; or a bag: "mcap", "sqlite3" or "rosbag1".
    topic : str
        Of a bag, for messages of type nav_msgs/msg/Odometry.

    Raises
    ------
    InputError
        If the file cannot be written, or a bag exists.
    ConfigError
        For any other format.

    Examples
    --------
    >>> hec.write_trajectory("moved.tum", child.shifted(result.time_offset_s))
    """
    if format != "tum":
        from hand_eye_calib.io.bags import STORAGES, write_bag

        if format not in STORAGES:
            known = ", ".join(("tum", *STORAGES))
            raise ConfigError(f"trajectories are written in one of {known}; got {format!r}")
        return write_bag(path, {topic: (trajectory, "nav_msgs/msg/Odometry")}, format)
    try:
        quats_xyzw = se3.to_quat_xyzw(trajectory.poses)
        values = np.concatenate([trajectory.poses[:, :3, 3], quats_xyzw], axis=1).tolist()
        lines = map(tum_line, trajectory.stamps_ns.tolist(), values)
        write_atomically({Path(path): "\n".join([f"# {TUM_COLUMNS}", *lines, ""])})
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from None


def tum_line(stamp_ns: int, pose: Iterable[float]) -> str:
    """The line of a pose x y z qx qy qz qw, which keeps every digit."""
    return f"{seconds(stamp_ns)} {' '.join(map(repr, pose))}"
