"""Frames that are fixed to each other: a tree of static transforms."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory

# Frames that are listed in a message.
_MOST_LISTED = 20


def checked_pose(position: Sequence[float], quat_xyzw: Sequence[float]) -> FloatArray:
    """Pose (4, 4) of a transform as it comes from outside.

    Raises
    ------
    InputError
        If it is not finite, or the quaternion is not of unit length.
    """
    stamps_ns = np.zeros(1, dtype=np.int64)
    poses = Trajectory.from_quat_xyzw(stamps_ns, np.array([position]), np.array([quat_xyzw])).poses
    return np.asarray(poses[0])


@dataclass(frozen=True)
class Frames:
    """Frames with their parents.

    Attributes
    ----------
    fixed : mapping of str to (str, (4, 4) array)
        Frame to its parent, and its pose in it.
    moving : mapping of str to str
        Frame to its parent, where the pose is not constant.
    """

    fixed: Mapping[str, tuple[str, FloatArray]] = field(default_factory=dict)
    moving: Mapping[str, str] = field(default_factory=dict)

    def pose(self, frame: str, of: str) -> FloatArray:
        """Pose (4, 4) of the frame ``of`` in ``frame``.

        Raises
        ------
        InputError
            If one of both is not there, or they are not fixed to each other.
        """
        up, down = self._to_root(frame), self._to_root(of)
        if up[-1] != down[-1]:
            moving = [each for each in (up[-1], down[-1]) if each in self.moving]
            why = f": {moving[0]} moves" if moving else ""
            raise InputError(f"{frame} and {of} are not fixed to each other{why}")
        T_root_frame, T_root_of = self._from_root(up), self._from_root(down)
        return se3.inverse(T_root_frame) @ T_root_of

    def path(self, frame: str, of: str) -> list[str]:
        """Frames whose edges lead down from the last frame that both have above them to ``of``."""
        above = set(self._to_root(frame))
        return [each for each in self._to_root(of) if each not in above][::-1]

    def _to_root(self, frame: str) -> list[str]:
        """The frame, and those above it as far as they are fixed."""
        known = {*self.fixed, *self.moving, *(parent for parent, _ in self.fixed.values())}
        known |= set(self.moving.values())
        if frame not in known:
            names = sorted(known)
            more = f" and {len(names) - _MOST_LISTED} more" if len(names) > _MOST_LISTED else ""
            listed = ", ".join(names[:_MOST_LISTED])
            raise InputError(f"there is no frame {frame!r}; found {listed or 'none'}{more}")
        found = [frame]
        while found[-1] in self.fixed:
            parent = self.fixed[found[-1]][0]
            if parent in found:
                raise InputError(f"the frames form a loop through {parent!r}")
            found.append(parent)
        return found

    def _from_root(self, frames: list[str]) -> FloatArray:
        T = np.eye(4)
        for frame in frames[:-1]:
            T = self.fixed[frame][1] @ T
        return T
