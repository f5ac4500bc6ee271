"""Poses of one frame in another from live transforms, as a replay takes them from a bag."""

from bisect import bisect_left
from collections import deque
from collections.abc import Iterator

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.frames import checked_pose
from hand_eye_calib.io.transforms import PoseFields, TfSource, TransformTree

# An edge's stamps that jump back by more begin a new session (ns).
_JUMP_BACK_NS = 1_000_000_000

# Transforms of each moving edge from which its rate is taken, and most that are kept.
_RATE_FROM, _MOST_KEPT = 5, 2000


class TfStream:
    """Composes the poses of a sensor from the edges of a transform tree as they arrive.

    There is one pose for each transform of the moving edge with the lowest rate. The other moving
    edges are interpolated there, never extrapolated and never across more than ``max_gap_s``.

    Parameters
    ----------
    source : TfSource
    max_gap_s : float
        May be changed.

    Attributes
    ----------
    left_out : int
        Stamps at which another edge was not known.
    """

    def __init__(self, source: TfSource, max_gap_s: float) -> None:
        self.source, self.max_gap_s = source, max_gap_s
        self.left_out = 0
        self._tree = TransformTree()
        self._static: dict[str, PoseFields] = {}
        self._fixed: dict[str, FloatArray] = {}
        self._up: list[str] = []
        self._down: list[str] = []
        self._moving: dict[str, _MovingEdge] = {}
        self._slowest = ""

    def add(self, transform: PoseFields, is_static: bool) -> Iterator[PoseFields]:
        """Take a transform; yields the poses that are known with it.

        Raises
        ------
        InputError
            If it is no pose, or its frame has another parent already.
        """
        frame, edges = transform.sensor_frame or "", self._tree.edges
        before = edges[frame].is_static if frame in edges else None
        self._tree.note(transform, is_static)
        is_new = before != edges[frame].is_static
        if is_new:
            self._find_chain()
        if edges[frame].is_static:
            self._static[frame] = transform
        if is_new or edges[frame].is_static:
            chain = {*self._up, *self._down} & self._static.keys()
            self._fixed = {each: _matrix(self._static[each]) for each in chain}
        if not edges[frame].is_static and frame in self._moving and not is_static:
            yield from self._move(frame, transform)

    def describe_missing(self) -> str:
        """Why there is no pose yet."""
        try:
            self._tree.chain(self.source)
        except InputError as error:
            return str(error).replace("the bag's transforms", "/tf and /tf_static")
        return "its transforms do not come at the same times"

    def _find_chain(self) -> None:
        self._slowest = ""
        try:
            self._up, self._down = self._tree.chain(self.source)
        except InputError:
            self._moving = {}
            return
        moving = [each for each in self._up + self._down if not self._tree.edges[each].is_static]
        self._moving = {frame: self._moving.get(frame, _MovingEdge()) for frame in moving}

    def _move(self, frame: str, transform: PoseFields) -> Iterator[PoseFields]:
        T = _matrix(transform)
        if len(self._moving) == 1:  # the usual case, for which nothing is kept
            yield self._composed(transform.stamp_ns, {frame: T})
            return
        edge = self._moving[frame]
        if edge and transform.stamp_ns < edge[-1][0] - _JUMP_BACK_NS:
            self._slowest = ""
            for each in self._moving.values():  # their stamps begin anew
                each.clear()
        # Of repeated ones the first counts, and late ones are left out.
        if not edge or transform.stamp_ns > edge[-1][0]:
            edge.append((transform.stamp_ns, T))
        if not self._slowest and all(len(each) >= _RATE_FROM for each in self._moving.values()):
            self._slowest = max(self._moving, key=lambda name: self._moving[name].interval_ns())
        if not self._slowest:
            return
        # The poses at the waiting stamps of the slowest edge that no other edge keeps waiting.
        base = self._moving[self._slowest]
        others = {name: edge for name, edge in self._moving.items() if edge is not base}
        while base and all(each and each[-1][0] >= base[0][0] for each in others.values()):
            stamp_ns, T_base = base.popleft()
            Ts = {name: each.at(stamp_ns, self.max_gap_s) for name, each in others.items()}
            known = {name: T for name, T in Ts.items() if T is not None}
            if len(known) == len(Ts):
                yield self._composed(stamp_ns, {self._slowest: T_base, **known})
            else:
                self.left_out += 1

    def _composed(self, stamp_ns: int, moving: dict[str, FloatArray]) -> PoseFields:
        T_world_sensor, Ts = np.eye(4), self._fixed | moving
        for frame in self._up:
            T_world_sensor = T_world_sensor @ se3.inverse(Ts[frame])
        for frame in self._down:
            T_world_sensor = T_world_sensor @ Ts[frame]
        x, y, z = T_world_sensor[:3, 3].tolist()
        qx, qy, qz, qw = se3.to_quat_xyzw(T_world_sensor).tolist()
        return PoseFields(stamp_ns, *self.source, (x, y, z), (qx, qy, qz, qw))


class _MovingEdge(deque[tuple[int, FloatArray]]):
    """The newest stamps and poses of a moving edge, in order."""

    def __init__(self) -> None:
        super().__init__(maxlen=_MOST_KEPT)

    def interval_ns(self) -> float:
        """Median time between transforms."""
        return float(np.median(np.diff([stamp_ns for stamp_ns, _ in self])))

    def at(self, stamp_ns: int, max_gap_s: float) -> FloatArray | None:
        """The pose at a stamp that is not after the last one; None if it is not known."""
        after = bisect_left(self, stamp_ns, key=lambda each: each[0])
        for _ in range(after - 1):  # what is asked for next is later
            self.popleft()
        (end_ns, T_end) = self[min(after, 1)]
        if end_ns == stamp_ns:
            return T_end
        start_ns, T_start = self[0]
        if after == 0 or end_ns - start_ns > max_gap_s * 1e9:
            return None
        fraction = np.array([float(stamp_ns - start_ns) / float(end_ns - start_ns)])
        matrix: FloatArray = se3.interpolate(T_start[None], T_end[None], fraction)[0]
        return matrix


def _matrix(transform: PoseFields) -> FloatArray:
    """(4, 4) array of a transform.

    Raises
    ------
    InputError
        If it is not a pose.
    """
    try:
        return checked_pose(transform.position, transform.quat_xyzw)
    except InputError as error:
        edge = f"transform {transform.world_frame}:{transform.sensor_frame}"
        raise InputError(f"{edge}: {error}") from None
