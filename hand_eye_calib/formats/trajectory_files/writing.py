"""Trajectories as text files in the format tum."""

from collections.abc import Iterable
from pathlib import Path

from hand_eye_calib.core.base.errors import require_type
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.files import path_of, write_atomically, writing
from hand_eye_calib.formats.trajectory_files.columns import TUM_COLUMNS
from hand_eye_calib.formats.trajectory_files.dates import seconds


def write_trajectory(path: str | Path, trajectory: Trajectory) -> None:
    """Write a trajectory to a text file in the format tum, which evo also reads.

    An existing file is replaced. A file that is read again has the same stamps and poses.

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
    path = path_of("path", path)
    require_type("trajectory", trajectory, Trajectory)
    stamps_ns = trajectory.stamps_ns.tolist()
    poses = se3.to_rows(trajectory.poses).tolist()
    lines = map(tum_line, stamps_ns, poses)
    text = "\n".join([f"# {TUM_COLUMNS}", *lines, ""])
    with writing(path):
        write_atomically({path: text})


def tum_line(stamp_ns: int, pose: Iterable[float]) -> str:
    """Return the line of the format tum for a pose x y z qx qy qz qw, with all digits."""
    numbers = " ".join(map(repr, pose))
    return f"{seconds(stamp_ns)} {numbers}"
