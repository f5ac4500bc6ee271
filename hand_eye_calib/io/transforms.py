"""Trajectories out of the transform tree: from the edges on ``/tf`` and ``/tf_static`` to the pose
of one frame in another.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory


class TfSource(NamedTuple):
    """A pair of frames: the sensor's, whose poses are wanted, and the fixed one they are given in."""

    world_frame: str
    sensor_frame: str

    def __str__(self):
        return f"transform {self.world_frame}:{self.sensor_frame}"

    @classmethod
    def parse(cls, text):
        """From ``world:sensor``.

        Raises
        ------
        ConfigError
            Where that are not two different frames.
        """
        frames = [frame.strip().lstrip("/") for frame in text.split(":")]
        if len(frames) != 2 or not all(frames) or frames[0] == frames[1]:
            raise ConfigError(
                f"expected two frames as WORLD:SENSOR, such as odom:lidar; got {text!r}"
            )
        return cls(*frames)


@dataclass
class Edge:
    """What the bag says about one frame: its parent, and its poses in it."""

    parent: str
    is_static: bool = True
    log_ns: list = field(default_factory=list)
    stamps_ns: list = field(default_factory=list)
    numbers: list = field(default_factory=list)


class TransformTree:
    """The frames of a bag and how they hang together.

    Transforms are noted with :meth:`note` in a first pass over the messages, and their numbers kept
    with :meth:`keep` in a second one, when it is known which of them are needed.
    """

    def __init__(self):
        self.edges = {}

    def note(self, transform, is_static):
        """Take notice of an edge.

        Raises
        ------
        InputError
            Where the frame has another parent already.
        """
        edge = self.edges.setdefault(transform.sensor_frame, Edge(transform.world_frame))
        if edge.parent != transform.world_frame:
            raise InputError(
                f"frame {transform.sensor_frame!r} has two parents, {edge.parent!r} and {transform.world_frame!r}: the transforms do not form "
                "a tree; record only one of their publishers"
            )
        edge.is_static &= is_static

    def keep(self, transform, is_static, log_ns):
        """Keep the numbers of a transform that is needed. An edge that moves is not bothered by
        what is said to be static.
        """
        edge = self.edges[transform.sensor_frame]
        if edge.is_static or not is_static:
            edge.log_ns.append(log_ns)
            edge.stamps_ns.append(transform.stamp_ns)
            edge.numbers.append((*transform.position, *transform.quat_xyzw))

    def chain(self, source):
        """The frames whose edges lead from the world frame to the sensor's: those to go up from the
        world, those to come down by.

        Raises
        ------
        InputError
            Where a frame is not there, or nothing moves between the two.
        """
        for frame in source:
            if frame not in self.edges and frame not in {
                edge.parent for edge in self.edges.values()
            }:
                raise InputError(f"no frame {frame!r} in the bag's transforms; {self.listing()}")
        up, down = self._to_root(source.world_frame), self._to_root(source.sensor_frame)
        if self._root(source.world_frame) != self._root(source.sensor_frame):
            raise InputError(
                f"frames {source.world_frame!r} and {source.sensor_frame!r} are not connected; {self.listing()}"
            )
        shared = set(up) & set(down)
        up, down = (
            [frame for frame in up if frame not in shared],
            [frame for frame in down if frame not in shared],
        )
        if all(self.edges[frame].is_static for frame in up + down):
            raise InputError(
                f"{source} does not move: all of its transforms are static; {self.listing()}"
            )
        return up, down[::-1]

    def listing(self):
        """All edges in one line."""
        if not self.edges:
            return "it has none"
        edges = sorted(
            f"{edge.parent}:{frame}{' (static)' * edge.is_static}"
            for frame, edge in self.edges.items()
        )
        return f"it has {', '.join(edges)}"

    def _to_root(self, frame):
        frames = []
        while frame in self.edges:
            if frame in frames:
                raise InputError(f"the transforms form a loop through frame {frame!r}")
            frames.append(frame)
            frame = self.edges[frame].parent
        return frames

    def _root(self, frame):
        frames = self._to_root(frame)
        return self.edges[frames[-1]].parent if frames else frame

    def trajectory(self, source, max_gap_s):
        """Poses of the sensor's frame in the world frame, at the stamps of the chain's slowest
        moving edge.

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
            Where a transform is not a pose.
        """
        up, down = self.chain(source)
        static = {frame: self._static(frame) for frame in up + down if self.edges[frame].is_static}
        moving = {frame: self._moving(frame) for frame in up + down if frame not in static}
        slowest = max(moving, key=lambda frame: _interval(moving[frame][0]))
        (base, log_ns) = moving[slowest]
        stamps_ns = base.stamps_ns
        known = np.ones(len(stamps_ns), dtype=bool)
        for frame, (edge, _) in moving.items():
            if frame != slowest:
                known &= _is_known(edge.stamps_ns, stamps_ns, max_gap_s)
        stamps_ns = stamps_ns[known]

        def at(frame):
            if frame in static:
                return static[frame]
            if frame == slowest:
                return base.poses[known]
            edge = moving[frame][0]
            return (
                edge.at(stamps_ns)
                if len(edge) > 1
                else np.repeat(edge.poses, len(stamps_ns), axis=0)
            )

        Ts_world_sensor = np.broadcast_to(np.eye(4), (len(stamps_ns), 4, 4))
        for frame in up:
            Ts_world_sensor = Ts_world_sensor @ se3.inverse(at(frame))
        for frame in down:
            Ts_world_sensor = Ts_world_sensor @ at(frame)
        trajectory = Trajectory(stamps_ns, Ts_world_sensor, source.sensor_frame, source.world_frame)
        return trajectory, log_ns[known], int((~known).sum())

    def _static(self, frame):
        """(4, 4): the last that was said."""
        return self._checked(frame, [0], self.edges[frame].numbers[-1:]).poses[0]

    def _moving(self, frame):
        """Trajectory and bag times of an edge; transforms are often repeated, the first with a
        stamp counts.
        """
        edge = self.edges[frame]
        stamps_ns, first = np.unique(np.array(edge.stamps_ns, dtype=np.int64), return_index=True)
        return self._checked(frame, stamps_ns, np.array(edge.numbers)[first]), np.array(
            edge.log_ns, dtype=np.int64
        )[first]

    def _checked(self, frame, stamps_ns, numbers):
        numbers = np.array(numbers, dtype=float).reshape(-1, 7)
        try:
            return Trajectory.from_quat_xyzw(
                np.array(stamps_ns, dtype=np.int64), numbers[:, :3], numbers[:, 3:]
            )
        except InputError as error:
            raise InputError(f"transform {self.edges[frame].parent}:{frame}: {error}") from None


def _interval(trajectory):
    return float(np.median(np.diff(trajectory.stamps_ns))) if len(trajectory) > 1 else np.inf


def _is_known(available_ns, wanted_ns, max_gap_s):
    """Mask of the stamps at which an edge has a transform or lies between two that are not too far
    apart.
    """
    after = np.searchsorted(available_ns, wanted_ns)
    inside = after < len(available_ns)
    after = np.minimum(after, len(available_ns) - 1)
    before = np.maximum(after - 1, 0)
    gap_ns = available_ns[after] - available_ns[before]
    return inside & (
        (available_ns[after] == wanted_ns) | ((after > 0) & (gap_ns <= max_gap_s * 1e9))
    )
