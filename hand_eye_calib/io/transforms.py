"""Trajectories from the transform tree: from the edges on ``/tf`` and ``/tf_static`` to the pose of
one frame in another.
"""

from array import array
from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.frames import FrameTree
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.limits import MOST_FRAMES
from hand_eye_calib.text import split_frames


class TfSource(NamedTuple):
    """A pair of frames: the sensor's, and the fixed frame in which its poses are wanted."""

    world_frame: str
    sensor_frame: str

    def __str__(self) -> str:
        return f"transform {self.world_frame}:{self.sensor_frame}"

    @classmethod
    def parse(cls, text: str) -> "TfSource":
        """From ``world:sensor``.

        Raises
        ------
        ConfigError
            If these are not two different frames.
        """
        return cls(*split_frames(text))


class PoseFields(NamedTuple):
    """What is unpacked of a message: a stamped pose or transform.

    Attributes
    ----------
    stamp_ns : int
    world_frame : str
        Of a transform, the parent.
    sensor_frame : str or None
        Of a transform, the child; None if the type has no place for it.
    position : sequence of 3 floats
        m.
    quat_xyzw : sequence of 4 floats
    """

    stamp_ns: int
    world_frame: str
    sensor_frame: str | None
    position: Sequence[float]
    quat_xyzw: Sequence[float]


class _Kept:
    """The poses of a frame in its parent: N bag times, stamps and rows of seven."""

    def __init__(self) -> None:
        self.log_ns, self.stamps_ns, self.values = array("q"), array("q"), array("d")


class TransformTree(FrameTree):
    """The frames of a bag and the edges between them.

    Edges are noted with :meth:`note` in a first pass over the messages. Poses are kept with
    :meth:`keep` in a second one, when it is known which edges are needed.

    Attributes
    ----------
    static : dict of str to PoseFields
        The last static transform of each frame.
    """

    def __init__(self) -> None:
        super().__init__("the bag's transforms")
        self.static: dict[str, PoseFields] = {}
        self._kept: defaultdict[str, _Kept] = defaultdict(_Kept)

    def note(self, transform: PoseFields, is_static: bool) -> None:
        """Add an edge; of a static one the last transform is kept.

        Raises
        ------
        InputError
            If the frame has another parent already, or there are too many frames.
        """
        frame = transform.sensor_frame or ""
        self.add(transform.world_frame, frame, is_static=is_static)
        if is_static:
            self.static[frame] = transform
        if len(self.edges) > MOST_FRAMES:
            raise InputError(f"the transforms have more than {MOST_FRAMES} frames")

    def keep(self, transform: PoseFields, is_static: bool, log_ns: int) -> None:
        """Keep the pose of a transform that is needed; static ones of a moving edge are ignored."""
        frame = transform.sensor_frame or ""
        if self.edges[frame].is_static or not is_static:
            kept = self._kept[frame]
            kept.log_ns.append(log_ns)
            kept.stamps_ns.append(transform.stamp_ns)
            kept.values.extend((*transform.position, *transform.quat_xyzw))

    def chain(self, source: TfSource) -> tuple[list[str], list[str]]:
        """Frames whose edges lead up from the world frame, and down to the sensor's.

        Raises
        ------
        InputError
            If a frame is not there, or nothing moves between the two.
        """
        up, down = self.route(*source)
        if all(self.edges[frame].is_static for frame in up + down):
            raise InputError(
                f"{source} does not move: all of its transforms are static; {self.listing()}"
            )
        return up, down

    def trajectory(self, source: TfSource, max_gap_s: float) -> tuple[Trajectory, IntArray, int]:
        """Poses of the sensor's frame in the world frame, at the stamps of the moving edge with the
        lowest rate.

        The other moving edges are interpolated there, never extrapolated and never across more than
        ``max_gap_s``.

        Returns
        -------
        Trajectory
        log_ns : (N,) int64 array
            Bag time of each pose.
        n_left_out : int
            Stamps at which another edge was not known.

        Raises
        ------
        InputError
            If a transform is not a pose.
        """
        up, down = self.chain(source)
        found = {frame: self._edge(frame) for frame in up + down}
        moving = {frame for frame in found if not self.edges[frame].is_static}
        slowest = max(moving, key=lambda frame: _interval(found[frame][0]))
        base, log_ns = found[slowest]
        known = np.ones(len(base), dtype=bool)
        for frame in moving - {slowest}:
            known &= _is_known(found[frame][0].stamps_ns, base.stamps_ns, max_gap_s)
        base = base[known]

        def at(frame: str) -> FloatArray:
            edge = base if frame == slowest else found[frame][0]
            # As tf2 and the node have them; of a single pose it is that.
            return edge.at(base.stamps_ns, straight=True) if len(edge) > 1 else edge.poses

        Ts_world_sensor = np.broadcast_to(np.eye(4), (len(base), 4, 4))
        for frame in up:
            Ts_world_sensor = Ts_world_sensor @ se3.inverse(at(frame))
        for frame in down:
            Ts_world_sensor = Ts_world_sensor @ at(frame)
        trajectory = Trajectory(base.stamps_ns, Ts_world_sensor, *source[::-1])
        return trajectory, log_ns[known], int((~known).sum())

    def _edge(self, frame: str) -> tuple[Trajectory, IntArray]:
        """Trajectory and bag times of an edge: of repeated transforms the first counts, of static
        ones only the last.
        """
        kept = self._kept[frame]
        stamps_ns, rows = np.unique(np.array(kept.stamps_ns), return_index=True)
        if self.edges[frame].is_static:
            stamps_ns, rows = np.zeros(1, dtype=np.int64), np.array([-1])
        poses = np.reshape(kept.values, (-1, 7))[rows]
        try:
            trajectory = Trajectory.from_quat_xyzw(stamps_ns, poses[:, :3], poses[:, 3:])
        except InputError as error:
            raise InputError(f"transform {self.edges[frame].parent}:{frame}: {error}") from None
        return trajectory, np.array(kept.log_ns)[rows]


def _interval(trajectory: Trajectory) -> float:
    return trajectory.interval_s if len(trajectory) > 1 else np.inf


def _is_known(available_ns: IntArray, wanted_ns: IntArray, max_gap_s: float) -> BoolArray:
    """Mask of the stamps at which an edge has a transform or lies between two that are not too far
    apart.
    """
    after = np.searchsorted(available_ns, wanted_ns)
    inside = after < len(available_ns)
    after = np.minimum(after, len(available_ns) - 1)
    before = np.maximum(after - 1, 0)
    gap_ns = available_ns[after] - available_ns[before]
    is_near = (after > 0) & (gap_ns <= max_gap_s * 1e9)
    return inside & ((available_ns[after] == wanted_ns) | is_near)
