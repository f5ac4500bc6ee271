"""Synchronisation: poses of two streams at common instants, by interpolation."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.stats import median

# Streams whose intervals differ by less than this factor count as equally fast: they are paired at
# the child's stamps.
_EQUALLY_FAST = 1.2


@dataclass(frozen=True)
class PosePairs:
    """Poses of both sensors at common instants.

    Attributes
    ----------
    stamps_ns : (N,) int64 array
        Parent clock, strictly increasing.
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
        Pose of each sensor in its own world.
    """

    stamps_ns: IntArray
    Ts_pw_p: FloatArray
    Ts_cw_c: FloatArray

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __getitem__(self, index: slice | NDArray[Any]) -> Self:
        return type(self)(self.stamps_ns[index], self.Ts_pw_p[index], self.Ts_cw_c[index])

    @classmethod
    def empty(cls) -> Self:
        """No poses."""
        return cls(np.empty(0, dtype=np.int64), np.empty((0, 4, 4)), np.empty((0, 4, 4)))

    @classmethod
    def concatenate(cls, *parts: Self) -> Self:
        """All parts in the given order."""
        return cls(
            *(
                np.concatenate([getattr(part, name) for part in parts])
                for name in ("stamps_ns", "Ts_pw_p", "Ts_cw_c")
            )
        )


def slower_stream(parent_stamps_ns: IntArray, child_stamps_ns: IntArray) -> str:
    """Choose the stream at whose stamps to pair: "parent" or "child".

    The slower one; the child if both are about equally fast. The typical interval is the median, so
    that a gap or a late start does not make a stream slow.
    """
    if len(parent_stamps_ns) < 2 or len(child_stamps_ns) < 2:
        return "child"
    interval_parent = median(np.diff(parent_stamps_ns))
    interval_child = median(np.diff(child_stamps_ns))
    return "parent" if interval_parent > _EQUALLY_FAST * interval_child else "child"


def synchronise(
    parent: Trajectory, child: Trajectory, max_gap_s: float, at: str | None = None
) -> PosePairs:
    """Interpolate the faster stream at the slower stream's stamps.

    An instant outside the faster stream, or between two of its poses that are more than
    ``max_gap_s`` apart, is left out. An instant at which it has a pose of its own is always kept.

    Parameters
    ----------
    parent, child : Trajectory
        On one clock.
    max_gap_s : float
        Seconds.
    at : {"parent", "child"}, optional
        The stream at whose stamps to pair; the slower one by default.
    """
    if len(parent) == 0 or len(child) == 0:
        return PosePairs.empty()
    at = at or slower_stream(parent.stamps_ns, child.stamps_ns)
    slow, fast = (parent, child) if at == "parent" else (child, parent)
    keep = _interpolable(fast.stamps_ns, slow.stamps_ns, max_gap_s)
    stamps_ns = slow.stamps_ns[keep]
    fast_poses = (
        np.repeat(fast.poses, len(stamps_ns), axis=0) if len(fast) == 1 else fast.at(stamps_ns)
    )
    if at == "parent":
        return PosePairs(stamps_ns, slow.poses[keep], fast_poses)
    return PosePairs(stamps_ns, fast_poses, slow.poses[keep])


def _interpolable(available_ns: IntArray, wanted_ns: IntArray, max_gap_s: float) -> BoolArray:
    """Mask of the wanted stamps at which a stream has a pose or may be interpolated."""
    after = np.searchsorted(available_ns, wanted_ns)
    inside = after < len(available_ns)
    after = np.minimum(after, len(available_ns) - 1)
    exact = available_ns[after] == wanted_ns
    before = np.maximum(after - 1, 0)
    gap_ns = available_ns[after] - available_ns[before]
    return inside & (exact | ((after > 0) & (gap_ns <= max_gap_s * 1e9)))
