"""Frames and their parents: the one tree behind robot descriptions, ``/tf`` and ``/tf_static``; and
what these state of the pose of a sensor.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.errors import InputError, NoPoseError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import FARTHEST_M, QUATERNION_NORM_TOLERANCE, far_position

# A matrix whose rotation is further than this from one is none.
_ROTATION_WITHIN = 1e-2

# Edges that are listed in a message.
_MOST_LISTED = 50


def are_null(poses: FloatArray) -> BoolArray:
    """Mask (N,) of rows x y z qx qy qz qw (N, 7) by which a source states that it has no pose.

    A value is not finite, or the quaternion is zero: trackers publish both when they are lost.
    """
    is_finite = np.isfinite(poses).all(axis=1)
    has_quaternion = (poses[:, 3:] != 0.0).any(axis=1)
    return np.asarray(~(is_finite & has_quaternion), dtype=bool)


def check_not_null(*values: float) -> None:
    """Raise NoPoseError for x, y, z, qx, qy, qz, qw that :func:`are_null`."""
    if not all(map(math.isfinite, values)):
        raise NoPoseError("the pose has a value that is not finite")
    if not any(values[3:]):
        raise NoPoseError("the pose has a quaternion of length 0, expected 1")


def check_pose(*values: float) -> None:
    """Raise InputError for x, y, z, qx, qy, qz, qw that are too far away, or have a quaternion that
    is not of unit length; NoPoseError as :func:`check_not_null`.
    """
    check_not_null(*values)
    length = math.hypot(*values[3:])
    if abs(length - 1.0) > QUATERNION_NORM_TOLERANCE:
        raise InputError(f"the pose has a quaternion of length {length:.4g}, expected 1")
    if max(map(abs, values[:3])) > FARTHEST_M:
        raise InputError(far_position(*values[:3]))


def checked_pose(position: ArrayLike, quat_xyzw: ArrayLike) -> FloatArray:
    """Pose (4, 4) of a transform as it comes from outside. Raises as :func:`check_pose`."""
    t, quat_xyzw = np.asarray(position, dtype=float), np.asarray(quat_xyzw, dtype=float)
    check_pose(*t.tolist(), *quat_xyzw.tolist())
    return se3.from_quat_xyzw(t, quat_xyzw)


def pose_of(*values: Any) -> FloatArray:
    """Pose (4, 4) of what a file has: a matrix of 12 or 16 numbers; x, y, z, qx, qy, qz, qw; a
    message; or a translation and a rotation, as matrix, quaternion w, x, y, z, or roll, pitch and
    yaw in degrees.

    Raises
    ------
    InputError
        If it is none.
    """
    parts = [numbers_of(value) for value in values]
    sizes, flat, T = tuple(map(len, parts)), np.array(sum(parts, [])), np.eye(4)
    if not np.isfinite(flat).all():
        raise InputError("a number is not finite")
    if sizes in ((16,), (12,)):
        T[:3] = flat[:12].reshape(3, 4)
    elif sizes == (7,):
        T = checked_pose(flat[:3], flat[3:])
    elif sizes == (3, 4):
        T = checked_pose(flat[:3], np.roll(flat[3:], -1))
    elif sizes == (3, 9):
        T[:3, 3], T[:3, :3] = flat[:3], flat[3:].reshape(3, 3)
    elif sizes == (3, 3):
        rotation = se3.rotation_from_rpy(np.radians(flat[3:]))
        T = se3.from_rotation_translation(rotation, flat[:3])
    else:
        raise InputError(
            "expected a pose: 12 or 16 numbers of a matrix, 7 of x, y, z, qx, qy, qz, qw, or "
            "translation and rotation"
        )
    rotation = se3.nearest_rotation(T[:3, :3])
    if np.abs(rotation - T[:3, :3]).max() > _ROTATION_WITHIN:
        raise InputError("the rotation is not one")
    return se3.from_rotation_translation(rotation, T[:3, 3])


def numbers_of(value: Any) -> list[float]:
    """The numbers of nested lists, of a message, of OpenCV's matrix or of a text, in their order;
    empty if something else is among them.
    """
    if isinstance(value, Mapping):
        position = value.get("translation", value.get("position"))
        quaternion = value.get("rotation", value.get("orientation"))
        if isinstance(position, Mapping) and isinstance(quaternion, Mapping):
            value = [position.get(axis) for axis in "xyz"]
            value += [quaternion.get(axis) for axis in "xyzw"]
        else:
            value = value.get("data", ())
    if isinstance(value, str):
        value = value.split()
    try:
        return [float(x) for x in np.array(value, dtype=float).ravel()]
    except (TypeError, ValueError):
        return []


@dataclass(frozen=True)
class Extrinsic:
    """Pose of the child sensor in the parent sensor's frame, as stated by a source.

    Attributes
    ----------
    T_parent_child : (4, 4) array
    origin : str
        Where it comes from, for a person.
    covariance : (6, 6) array
        Of the error xi in ``T_parent_child @ exp(xi)``; zero if the source states none.
    is_calibration : bool
        Whether it was found from motion, with the same sensors.
    """

    T_parent_child: FloatArray
    origin: str
    covariance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    is_calibration: bool = False


@dataclass
class Edge:
    """A frame's parent, whether its pose in it is constant, and that (4, 4) if it is known."""

    parent: str
    is_static: bool = True
    pose: FloatArray | None = None


class FrameTree:
    """Frames with their parents.

    Parameters
    ----------
    origin : str
        Where the frames come from, for messages.

    Attributes
    ----------
    edges : dict of str to Edge
        Frame to the edge that leads up from it.
    """

    def __init__(self, origin: str = "the transforms") -> None:
        self.edges: dict[str, Edge] = {}
        self._origin = origin

    def add(
        self, parent: str, frame: str, pose: FloatArray | None = None, is_static: bool = True
    ) -> Edge:
        """Add an edge, or its newest pose. An edge that has ever moved is not static.

        Raises
        ------
        InputError
            If the frame has another parent already.
        """
        edge = self.edges.setdefault(frame, Edge(parent))
        if edge.parent != parent:
            raise InputError(
                f"frame {frame!r} has two parents, {edge.parent!r} and {parent!r}: "
                f"{self._origin} do not form a tree; record only one of their publishers"
            )
        edge.is_static &= is_static
        edge.pose = pose
        return edge

    def pose(
        self, frame: str, of: str, moving: Mapping[str, FloatArray] | None = None
    ) -> FloatArray:
        """Pose (..., 4, 4) of the frame ``of`` in ``frame``, with the poses (..., 4, 4) of those
        whose edges move.

        Raises
        ------
        InputError
            If one of both is not there, or they are not fixed to each other.
        """
        up, down = self.route(frame, of)
        T_frame_of = np.eye(4)
        for each in up + down:
            edge = self.edges[each]
            T = moving[each] if moving and each in moving else edge.pose
            if T is None or not (edge.is_static or moving):
                raise InputError(f"{frame} and {of} are not fixed to each other: {each} moves")
            T_frame_of = T_frame_of @ (se3.inverse(T) if each in up else T)
        return T_frame_of

    def route(self, frame: str, of: str) -> tuple[list[str], list[str]]:
        """Frames whose edges lead up from ``frame``, and those whose edges lead down to ``of``.

        Raises
        ------
        InputError
            If one of both is not there, or they are not connected.
        """
        up, down = self.above(frame), self.above(of)
        if up[-1] != down[-1]:
            raise InputError(f"frames {frame!r} and {of!r} are not connected; {self.listing()}")
        shared = {*up} & {*down}
        down = [each for each in down if each not in shared]
        return [each for each in up if each not in shared], down[::-1]

    def above(self, frame: str) -> list[str]:
        """The frame, its parent, and so on to the root.

        Raises
        ------
        InputError
            If it is not there, or the frames above it form a loop.
        """
        if frame not in self.edges and all(edge.parent != frame for edge in self.edges.values()):
            raise InputError(f"no frame {frame!r} in {self._origin}; {self.listing()}")
        found = {frame: None}
        while frame in self.edges:
            frame = self.edges[frame].parent
            if frame in found:
                raise InputError(f"{self._origin} form a loop through frame {frame!r}")
            found[frame] = None
        return [*found]

    def listing(self) -> str:
        """List the edges in one line."""
        edges = sorted(
            f"{edge.parent}:{frame}{' (static)' * edge.is_static}"
            for frame, edge in self.edges.items()
        )
        if len(edges) > _MOST_LISTED:
            edges[_MOST_LISTED:] = [f"and {len(edges) - _MOST_LISTED} more"]
        return f"it has {', '.join(edges) or 'none'}"
