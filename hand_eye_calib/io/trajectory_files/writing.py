"""Writing a trajectory to a text file."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.files import write_atomically
from hand_eye_calib.io.trajectory_files.poses import seconds
from hand_eye_calib.io.trajectory_files.reading import TUM_COLUMNS


def write_trajectory(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory to a text file in the format tum, which evo reads, too, replacing it if it
    exists. Reading it back gives the same stamps and poses.

    Parameters
    ----------
    path : str or path-like
    trajectory : Trajectory

    Raises
    ------
    InputError
        If the file cannot be written.

    Examples
    --------
    >>> hec.write_trajectory("moved.tum", child.shifted(result.time_offset_s))
    """
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
