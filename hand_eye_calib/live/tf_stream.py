"""Poses of one frame in another from live transforms, as a replay takes them from a bag."""

from collections import deque
from collections.abc import Iterator

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.frames import FrameTree, checked_pose
from hand_eye_calib.io.limits import MOST_FRAMES
from hand_eye_calib.io.transforms import PoseFields, TfSource

# An edge's stamps that jump back by more begin a new session (ns).
_JUMP_BACK_NS = 1_000_000_000

# Transforms of each moving edge from which its rate is taken, and most that are kept.
_RATE_FROM, _MOST_KEPT = 5, 2000

# The newest stamps and poses of a moving edge, in order.
_MovingEdge = deque[tuple[int, FloatArray]]


class TfStream:
    """Composes the poses of a sensor from the edges of a transform tree as they arrive.

    There is one pose for each transform of the moving edge with the lowest rate. The other moving
    edges are interpolated there, never extrapolated and never across more than ``max_gap_s``.

    Parameters
    ----------
    source : TfSource
    max_gap_s : float
        May be changed.
    """

    def __init__(self, source: TfSource, max_gap_s: float) -> None:
        self.source, self.max_gap_s = source, max_gap_s
        self._tree = FrameTree("/tf and /tf_static")
        self._up: list[str] = []
        self._down: list[str] = []
        self._moving: dict[str, _MovingEdge] = {}
        self._slowest = ""

    def add(self, transform: PoseFields, is_static: bool) -> Iterator[PoseFields]:
        """Take a transform; yields the poses that are known with it.

        Raises
        ------
        InputError
            If it is no pose, its frame has another parent already, or there are too many frames.
        """
        frame, edges = transform.sensor_frame or "", self._tree.edges
        before = edges[frame].is_static if frame in edges else None
        pose = _matrix(transform) if is_static else None
        is_fixed = self._tree.add(transform.world_frame, frame, pose, is_static).is_static
        if len(edges) > MOST_FRAMES:
            raise InputError(f"the transforms have more than {MOST_FRAMES} frames")
        if before != is_fixed:
            self._find_chain()
        if frame in self._moving and not is_static:
            yield from self._move(frame, transform.stamp_ns, _matrix(transform))

    def describe_missing(self) -> str:
        """Why there is no pose yet."""
        try:
            up, down = self._tree.route(*self.source)
        except InputError as error:
            return str(error)
        if all(self._tree.edges[frame].is_static for frame in up + down):
            return f"all of its transforms are static; {self._tree.listing()}"
        return "its transforms do not come at the same times"

    def _find_chain(self) -> None:
        self._slowest = ""
        try:
            self._up, self._down = self._tree.route(*self.source)
        except InputError:
            self._up = self._down = []
        frames = [each for each in self._up + self._down if not self._tree.edges[each].is_static]
        self._moving = {each: self._moving.get(each, deque(maxlen=_MOST_KEPT)) for each in frames}

    def _move(self, frame: str, stamp_ns: int, T: FloatArray) -> Iterator[PoseFields]:
        if len(self._moving) == 1:  # the usual case, for which nothing is kept
            yield self._composed(stamp_ns, {frame: T})
            return
        edge = self._moving[frame]
        if edge and stamp_ns < edge[-1][0] - _JUMP_BACK_NS:
            self._slowest = ""
            for each in self._moving.values():  # their stamps begin anew
                each.clear()
        # Of repeated ones the first counts, and late ones are left out.
        if not edge or stamp_ns > edge[-1][0]:
            edge.append((stamp_ns, T))
        if not self._slowest and all(len(each) >= _RATE_FROM for each in self._moving.values()):
            self._slowest = max(self._moving, key=lambda name: _interval_ns(self._moving[name]))
        if not self._slowest:
            return
        # The poses at the waiting stamps of the slowest edge that no other edge keeps waiting.
        base = self._moving[self._slowest]
        others = {name: each for name, each in self._moving.items() if each is not base}
        while base and all(each and each[-1][0] >= base[0][0] for each in others.values()):
            at_ns, T_base = base.popleft()
            Ts = {name: _at(each, at_ns, self.max_gap_s) for name, each in others.items()}
            known = {name: T for name, T in Ts.items() if T is not None}
            if len(known) == len(Ts):
                yield self._composed(at_ns, {self._slowest: T_base, **known})

    def _composed(self, stamp_ns: int, moving: dict[str, FloatArray]) -> PoseFields:
        T_world_sensor = np.eye(4)
        for frame in self._up + self._down:
            T = moving.get(frame, self._tree.edges[frame].pose)
            assert T is not None
            T_world_sensor = T_world_sensor @ (se3.inverse(T) if frame in self._up else T)
        x, y, z = T_world_sensor[:3, 3].tolist()
        qx, qy, qz, qw = se3.to_quat_xyzw(T_world_sensor).tolist()
        return PoseFields(stamp_ns, *self.source, (x, y, z), (qx, qy, qz, qw))


def _interval_ns(edge: _MovingEdge) -> float:
    """Median time between transforms."""
    return float(np.median(np.diff([stamp_ns for stamp_ns, _ in edge])))


def _at(edge: _MovingEdge, stamp_ns: int, max_gap_s: float) -> FloatArray | None:
    """The pose at a stamp that is not after the last one; None if it is not known. What is asked
    for next is later.
    """
    while len(edge) > 1 and edge[1][0] <= stamp_ns:
        edge.popleft()
    start_ns, T_start = edge[0]
    if start_ns == stamp_ns:
        return T_start
    if start_ns > stamp_ns:
        return None
    end_ns, T_end = edge[1]
    if end_ns - start_ns > max_gap_s * 1e9:
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
