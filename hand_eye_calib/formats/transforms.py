"""Poses of one frame in another from transforms, as they arrive live or are read from a bag."""

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

# An edge's stamps that jump back by more begin a new session (ns).
_JUMP_BACK_NS = STAMP_UNITS["s"]

# Transforms of each moving edge from which its rate is taken, and most that are kept.
_RATE_FROM = 5
_MOST_KEPT = 2000

# x y z qx qy qz qw of a frame in its parent.
_Row = tuple[float, ...]
# The newest stamps and poses of a moving edge, in order.
_MovingEdge = deque[tuple[int, _Row]]


class TfSource(NamedTuple):
    """A pair of frames: the sensor's, and the fixed frame in which its poses are wanted."""

    world_frame: str
    sensor_frame: str

    def __str__(self) -> str:
        return f"transform {self.world_frame}:{self.sensor_frame}"

    @classmethod
    def parse(cls, text: str) -> "TfSource":
        """From ``world:sensor``; a ConfigError if these are not two different frames."""
        return cls(*split_frames("a transform", text))


class PoseFields(NamedTuple):
    """What is unpacked of a message: a stamped pose or transform, in m. Its frames are the parent
    and child of a transform; the sensor's is None if the type has no place for it.
    """

    stamp_ns: int
    world_frame: str
    sensor_frame: str | None
    position: Sequence[float]
    quat_xyzw: Sequence[float]


class TfStream:
    """Composes the poses of a sensor from the edges of a transform tree as they arrive.

    There is one pose for each transform of the moving edge with the lowest rate. The other moving
    edges are interpolated there, never extrapolated and never across more than ``max_gap_s``. Of
    repeated transforms of an edge the first counts, and those that are late are left out. ``tree``
    has edges that are known before; ``max_gap_s`` may be changed.
    """

    def __init__(self, source: TfSource, max_gap_s: float, tree: FrameTree | None = None) -> None:
        self.source = source
        self.max_gap_s = max_gap_s
        self._tree = tree or FrameTree("/tf and /tf_static")
        self._moving: dict[str, _MovingEdge] = {}
        self._last_ns: dict[str, int] = {}
        self._find_chain()

    def add(self, transform: PoseFields, is_static: bool) -> Iterator[PoseFields]:
        """Take a transform; yields the poses that are known with it. Raises as :meth:`edges_at`."""
        for stamp_ns, rows in self.edges_at(transform, is_static):
            T_world_sensor = self.composed({name: np.array(row) for name, row in rows.items()})
            x, y, z, *quat_xyzw = _row(T_world_sensor)
            yield PoseFields(stamp_ns, *self.source, (x, y, z), quat_xyzw)

    def edges_at(
        self, transform: PoseFields, is_static: bool
    ) -> Iterator[tuple[int, dict[str, _Row]]]:
        """Take a transform; yields stamps (ns) at which the pose is known with it, and the poses
        x y z qx qy qz qw of the moving edges there. An InputError if it is no pose, or its frame
        has another parent already.
        """
        parent = transform.world_frame
        frame = transform.sensor_frame or ""
        edges = self._tree.edges
        before = edges[frame].is_static if frame in edges else None
        row = (*transform.position, *transform.quat_xyzw)
        if is_static or frame in self._moving:
            with located(f"transform {parent}:{frame}"):
                check_pose(*row)
        pose = _matrices(row) if is_static else None
        is_fixed = self._tree.add(parent, frame, pose, is_static).is_static
        if before != is_fixed:
            self._find_chain()
        if frame in self._moving and not is_static:
            yield from self._move(frame, transform.stamp_ns, row)

    def composed(self, moving: Mapping[str, FloatArray]) -> FloatArray:
        """Poses of the sensor (..., 4, 4) from those of the moving edges (..., 7)."""
        matrices = {frame: _matrices(rows) for frame, rows in moving.items()}
        return self._tree.pose(*self.source, matrices)

    def describe_missing(self) -> str:
        """Why there is no pose yet."""
        try:
            up, down = self._tree.route(*self.source)
        except InputError as error:
            return str(error)
        if all(self._tree.edges[frame].is_static for frame in up + down):
            return f"it does not move: all of its transforms are static; {self._tree.listing()}"
        return "its transforms do not come at the same times"

    def _find_chain(self) -> None:
        self._slowest = ""
        frames = []
        with suppress(InputError):
            up, down = self._tree.route(*self.source)
            frames = [each for each in up + down if not self._tree.edges[each].is_static]
        self._moving = {each: self._moving.get(each, deque(maxlen=_MOST_KEPT)) for each in frames}

    def _move(self, frame: str, stamp_ns: int, row: _Row) -> Iterator[tuple[int, dict[str, _Row]]]:
        last_ns = self._last_ns.get(frame, stamp_ns - 1)
        if last_ns - _JUMP_BACK_NS <= stamp_ns <= last_ns:
            return
        if stamp_ns < last_ns:
            self._slowest = ""
            self._last_ns.clear()
            for each in self._moving.values():  # their stamps begin anew
                each.clear()
        self._last_ns[frame] = stamp_ns
        self._moving[frame].append((stamp_ns, row))
        if len(self._moving) == 1:  # the usual case, for which nothing has to wait
            self._slowest = frame
        elif not self._slowest and all(len(each) >= _RATE_FROM for each in self._moving.values()):
            stamps_ns = {name: [row[0] for row in each] for name, each in self._moving.items()}
            self._slowest = max(stamps_ns, key=lambda name: np.median(np.diff(stamps_ns[name])))
        if not self._slowest:
            return
        # The poses at the waiting stamps of the slowest edge that no other edge keeps waiting.
        base = self._moving[self._slowest]
        others = {name: each for name, each in self._moving.items() if each is not base}
        while base and all(each and each[-1][0] >= base[0][0] for each in others.values()):
            at_ns, row = base.popleft()
            rows = {name: _at(each, at_ns, self.max_gap_s) for name, each in others.items()}
            known = {name: each for name, each in rows.items() if each is not None}
            if len(known) == len(rows):
                yield at_ns, {self._slowest: row, **known}


def _at(edge: _MovingEdge, stamp_ns: int, max_gap_s: float) -> _Row | None:
    """The pose at a stamp that is not after the last one; None if it is not known. What is asked
    for next is later.
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
    """x y z qx qy qz qw of a pose (4, 4)."""
    return tuple(se3.to_rows(T).tolist())


def _matrices(rows: ArrayLike) -> FloatArray:
    """(..., 4, 4) of x y z qx qy qz qw (..., 7)."""
    rows = np.asarray(rows)
    return se3.from_quat_xyzw(rows[..., :3], rows[..., 3:])
