"""Poses of a sensor's frame in a world frame, composed from the transforms of ``/tf``.

An edge is the transform between a frame and its parent in the tree. The transforms arrive live or
are read from a bag.
"""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import STAMP_UNITS
from hand_eye_calib.core.base.errors import InputError, located
from hand_eye_calib.core.base.text import split_frames
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import FrameTree, check_pose

# A new recording begins if the stamps of an edge jump back by more than this (ns).
_JUMP_BACK_NS = STAMP_UNITS["s"]

# Number of transforms after which the rate of an edge is estimated.
_RATE_FROM = 5
# Largest number of stored transforms per moving edge, while other edges have not reached their
# stamps.
_MOST_KEPT = 2000

# Pose x y z qx qy qz qw of a frame in its parent.
_Row = tuple[float, ...]
# Newest stamps (ns) and poses of a moving edge, in order of time.
_MovingEdge = deque[tuple[int, _Row]]


class TfSource(NamedTuple):
    """Pair of frames: the world frame of the poses, and the frame of the sensor."""

    world_frame: str
    sensor_frame: str

    def __str__(self) -> str:
        return f"transform {self.world_frame}:{self.sensor_frame}"

    @classmethod
    def parse(cls, text: str) -> "TfSource":
        """Parse ``world:sensor``. Raise a ConfigError unless it names two different frames."""
        return cls(*split_frames("a transform", text))


class PoseFields(NamedTuple):
    """Stamped pose or transform from a message; the position is in m.

    ``world_frame`` and ``sensor_frame`` of a transform are its parent and child frame.
    ``sensor_frame`` is None if the message type has no such field.
    """

    stamp_ns: int
    world_frame: str
    sensor_frame: str | None
    position: Sequence[float]
    quat_xyzw: Sequence[float]


class TfStream:
    """Stream of a sensor's poses, composed from the edges of a transform tree as they arrive.

    Each transform of the slowest moving edge becomes a pose. The other moving edges are
    interpolated at its stamp: without extrapolation, and only between transforms that are at most
    ``max_gap_s`` apart. A transform is skipped if its stamp is not later than the last stamp of its
    edge.

    Parameters
    ----------
    source : TfSource
    max_gap_s : float
        Largest time (s) between two transforms that are interpolated. The attribute with this name
        may be changed later.
    tree : FrameTree, optional
        Edges that are known before the first transform arrives.
    """

    def __init__(
        self, source: TfSource, max_gap_s: float, tree: FrameTree | None = None
    ) -> None:
        self.source = source
        self.max_gap_s = max_gap_s
        self._tree = tree or FrameTree("/tf and /tf_static")
        self._moving: dict[str, _MovingEdge] = {}
        self._last_ns: dict[str, int] = {}
        self._find_chain()

    def add(
        self, transform: PoseFields, is_static: bool
    ) -> Iterator[PoseFields]:
        """Add a transform. Yield the poses of the sensor for which all edges are now known.

        Raises the errors of :meth:`edges_at`.
        """
        for stamp_ns, rows in self.edges_at(transform, is_static):
            T_world_sensor = self.composed(
                {name: np.array(row) for name, row in rows.items()}
            )
            x, y, z, *quat_xyzw = _row(T_world_sensor)
            yield PoseFields(stamp_ns, *self.source, (x, y, z), quat_xyzw)

    def edges_at(
        self, transform: PoseFields, is_static: bool
    ) -> Iterator[tuple[int, dict[str, _Row]]]:
        """Add a transform. Yield the stamps at which all edges are now known.

        Yields
        ------
        stamp_ns : int
        rows : dict of str to tuple of float
            Pose x y z qx qy qz qw of each moving edge at the stamp.

        Raises
        ------
        InputError
            If the transform is not a valid pose, or its frame has another parent.
        """
        parent = transform.world_frame
        frame = transform.sensor_frame or ""
        edges = self._tree.edges
        was_static = edges[frame].is_static if frame in edges else None
        row = (*transform.position, *transform.quat_xyzw)
        if is_static or frame in self._moving:
            with located(f"transform {parent}:{frame}"):
                check_pose(*row)
        pose = _matrices(row) if is_static else None
        # The chain of edges changes if an edge is new, or if a static edge begins to move.
        if (
            was_static
            != self._tree.add(parent, frame, pose, is_static).is_static
        ):
            self._find_chain()
        if frame in self._moving and not is_static:
            yield from self._move(frame, transform.stamp_ns, row)

    def composed(self, moving: Mapping[str, FloatArray]) -> FloatArray:
        """Return the sensor's poses (..., 4, 4) from the poses (..., 7) of the moving edges."""
        matrices = {frame: _matrices(rows) for frame, rows in moving.items()}
        return self._tree.pose(*self.source, matrices)

    def describe_missing(self) -> str:
        """Return the reason why there is no pose yet, as text for the user."""
        try:
            up, down = self._tree.route(*self.source)
        except InputError as error:
            return str(error)
        if all(self._tree.edges[frame].is_static for frame in up + down):
            return (
                "it does not move, because all of its transforms are static; "
                f"{self._tree.listing()}"
            )
        return "its transforms have no common time"

    def _find_chain(self) -> None:
        """Update the moving edges between both frames; none if the frames are unconnected."""
        self._slowest = ""
        frames = []
        with suppress(InputError):
            up, down = self._tree.route(*self.source)
            frames = [
                frame
                for frame in up + down
                if not self._tree.edges[frame].is_static
            ]
        self._moving = {
            frame: self._moving.get(frame, deque(maxlen=_MOST_KEPT))
            for frame in frames
        }

    def _move(
        self, frame: str, stamp_ns: int, row: _Row
    ) -> Iterator[tuple[int, dict[str, _Row]]]:
        """Add a pose of a moving edge; yield as :meth:`edges_at`."""
        last_ns = self._last_ns.get(frame, stamp_ns - 1)
        if last_ns - _JUMP_BACK_NS <= stamp_ns <= last_ns:
            return
        if stamp_ns < last_ns:
            # The recording has started again.
            self._slowest = ""
            self._last_ns.clear()
            for edge in self._moving.values():
                edge.clear()
        self._last_ns[frame] = stamp_ns
        self._moving[frame].append((stamp_ns, row))
        self._slowest = self._slowest or self._find_slowest()
        if self._slowest:
            yield from self._completed()

    def _completed(self) -> Iterator[tuple[int, dict[str, _Row]]]:
        """Yield the stamps of the slowest edge that all other edges have passed.

        Each stamp comes with the poses of the moving edges at this stamp, see :meth:`edges_at`.
        Stamps at which an edge cannot be interpolated are skipped.
        """
        slowest = self._moving[self._slowest]
        others = {
            name: edge
            for name, edge in self._moving.items()
            if edge is not slowest
        }
        while slowest and all(
            edge and edge[-1][0] >= slowest[0][0] for edge in others.values()
        ):
            at_ns, slowest_row = slowest.popleft()
            rows = {self._slowest: slowest_row}
            for name, edge in others.items():
                other_row = _interpolated(edge, at_ns, self.max_gap_s)
                if other_row is not None:
                    rows[name] = other_row
            if len(rows) == len(self._moving):
                yield at_ns, rows

    def _find_slowest(self) -> str:
        """Return the moving edge with the lowest rate; empty until all rates can be estimated."""
        # Usually a single edge moves. Its poses need not wait for an estimate of rates.
        if len(self._moving) == 1:
            return next(iter(self._moving))
        if any(len(edge) < _RATE_FROM for edge in self._moving.values()):
            return ""
        intervals_ns = {
            name: np.median(np.diff([stamp_ns for stamp_ns, _ in edge]))
            for name, edge in self._moving.items()
        }
        return max(intervals_ns, key=lambda name: intervals_ns[name])


def _interpolated(
    edge: _MovingEdge, stamp_ns: int, max_gap_s: float
) -> _Row | None:
    """Return the interpolated pose of an edge at a stamp (ns).

    The result is None before the first pose, and in gaps of more than ``max_gap_s``. The stamp must
    not be later than the last pose. Poses before the stamp are removed from ``edge``, so the stamps
    of successive calls must not decrease.
    """
    while len(edge) > 1 and edge[1][0] <= stamp_ns:
        edge.popleft()
    start_ns, row = edge[0]
    if start_ns == stamp_ns:
        return row
    if start_ns > stamp_ns or edge[1][0] - start_ns > max_gap_s * 1e9:
        return None
    end_ns, end = edge[1]
    fraction = np.array([float(stamp_ns - start_ns) / float(end_ns - start_ns)])
    (T,) = se3.interpolate(_matrices([row]), _matrices([end]), fraction)
    return _row(T)


def _row(T: FloatArray) -> _Row:
    """Convert a pose (4, 4) to x y z qx qy qz qw."""
    return tuple(se3.to_rows(T).tolist())


def _matrices(rows: ArrayLike) -> FloatArray:
    """Convert x y z qx qy qz qw (..., 7) to poses (..., 4, 4)."""
    rows = np.asarray(rows)
    return se3.from_quat_xyzw(rows[..., :3], rows[..., 3:])
