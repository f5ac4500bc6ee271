"""Frames and their parents: the one tree behind robot descriptions, ``/tf`` and ``/tf_static``; and
what these state of the pose of a sensor.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.errors import InputError, NoPoseError, located
from hand_eye_calib.core.base.text import frame_name
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import (
    FARTHEST_M,
    QUATERNION_NORM_TOLERANCE,
    far_position,
)

# A matrix whose rotation is further than this from one is none.
_ROTATION_WITHIN = 1e-2

# The last row of a matrix is 0 0 0 1 within this.
LAST_ROW_WITHIN = 1e-6

# Words in the name of a frame that say that it stands still: a map, the start of an odometry.
_WORLDS = {"map", "odom", "odometry", "world", "earth", "ecef", "enu", "ned", "utm", "global"}
_WORLDS |= {"origin", "init", "mocap", "vicon", "optitrack", "inertial"}
# Words that say that it is something that a camera observes.
_TARGETS = {"aruco", "marker", "tag", "apriltag", "charuco", "target", "board", "chessboard"}
_TARGETS |= {"checkerboard", "pattern", "fiducial", "aprilgrid"}

# Edges that are listed in a message.
_MOST_LISTED = 50


def are_null(poses: FloatArray) -> BoolArray:
    """Mask (N,) of rows x y z qx qy qz qw (N, 7) by which a source states that it has no pose.

    A value is not finite, or the quaternion is zero: trackers publish both when they are lost.
    """
    qx, qy, qz, qw = poses[:, 3:].T
    is_null = (qx == 0.0) & (qy == 0.0) & (qz == 0.0) & (qw == 0.0)
    with np.errstate(invalid="ignore", over="ignore"):
        total = poses.sum()
    if not np.isfinite(total):  # faster than to look at every row
        is_null |= ~np.isfinite(poses).all(axis=1)
    return np.asarray(is_null, dtype=bool)


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
    t = np.asarray(position, dtype=float)
    quat_xyzw = np.asarray(quat_xyzw, dtype=float)
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
    sizes = tuple(map(len, parts))
    flat = np.array([number for part in parts for number in part])
    T = np.eye(4)
    if not np.isfinite(flat).all():
        raise InputError("a number is not finite")
    if sizes in ((16,), (12,)):
        T.flat[: len(flat)] = flat
    elif sizes == (7,):
        T = checked_pose(flat[:3], flat[3:])
    elif sizes == (3, 4):
        T = checked_pose(flat[:3], np.roll(flat[3:], -1))
    elif sizes == (3, 9):
        T[:3, 3] = flat[:3]
        T[:3, :3] = flat[3:].reshape(3, 3)
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
    if np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max() > LAST_ROW_WITHIN:
        raise InputError(wrong_last_row(T))
    return se3.from_rotation_translation(rotation, T[:3, 3])


def pose_stack(values: Any, what: str) -> FloatArray:
    """Poses (N, 4, 4) of many at once, checked.

    Parameters
    ----------
    values : array-like
        Matrices (N, 4, 4) or (N, 3, 4), rows (N, 7) of x, y, z, qx, qy, qz, qw, or a pair (R, t):
        rotations (N, 3, 3) or rotation vectors (N, 3), rad, and translations (N, 3), m.
    what : str
        Name of the poses in messages.

    Raises
    ------
    InputError
        If a pose is none; the message names its row, counted from 1.
    """
    pair = _pair_of_stacks(values)
    Ts = _joined(*pair, what) if pair else _one_stack(values, what)
    rows = np.flatnonzero(~np.isfinite(Ts).all(axis=(1, 2)))
    if len(rows):
        raise InputError(f"{what}, row {rows[0] + 1}: a number is not finite")
    _require_last_row(Ts, what)
    rotations = se3.nearest_rotation(Ts[:, :3, :3])
    off = np.abs(rotations - Ts[:, :3, :3]).max(axis=(1, 2), initial=0.0)
    rows = np.flatnonzero(off > _ROTATION_WITHIN)
    if len(rows):
        raise InputError(f"{what}, row {rows[0] + 1}: the rotation is not one")
    return se3.from_rotation_translation(rotations, Ts[:, :3, 3])


def _numbers(values: Any) -> FloatArray | None:
    """Values as an array; None if they are no numbers, or rows of different lengths."""
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        return None


def _pair_of_stacks(values: Any) -> tuple[FloatArray, FloatArray] | None:
    """Rotations and translations, if the values are such a pair."""
    if not isinstance(values, tuple | list) or len(values) != 2:
        return None
    first, second = (_numbers(value) for value in values)
    if first is None or second is None or first.ndim < 2 or second.ndim < 2:
        return None
    if first.shape[1:] not in ((3, 3), (3,), (3, 1)) or second.shape[1:] not in ((3,), (3, 1)):
        return None
    return first, second


def _joined(rotations: FloatArray, translations: FloatArray, what: str) -> FloatArray:
    """Poses (N, 4, 4) of rotations or rotation vectors, and translations."""
    if len(rotations) != len(translations):
        raise InputError(
            f"{what}: {len(rotations)} rotations, {len(translations)} translations; each pose "
            "needs both"
        )
    if rotations.shape[1:] != (3, 3):
        rotations = se3.rotation_exp(rotations.reshape(-1, 3))
    return se3.from_rotation_translation(rotations, translations.reshape(-1, 3))


def _one_stack(values: Any, what: str) -> FloatArray:
    """Poses (N, 4, 4) of matrices or rows."""
    array = _numbers(values)
    if array is not None and array.ndim == 2 and array.shape[1] == 7:
        rows = enumerate(array.tolist(), 1)
        stack = []
        for number, row in rows:
            with located(f"{what}, row {number}"):
                stack.append(checked_pose(row[:3], row[3:]))
        return np.reshape(stack, (-1, 4, 4))
    if array is not None and array.shape[1:] == (3, 4):
        return se3.from_rotation_translation(array[:, :, :3], array[:, :, 3])
    if array is None or array.shape[1:] != (4, 4):
        shape = "rows of different shapes" if array is None else f"an array {array.shape}"
        raise InputError(
            f"{what}: expected poses as (N, 4, 4), (N, 7) of x, y, z, qx, qy, qz, qw, or a pair of "
            f"rotations (N, 3, 3) and translations (N, 3); found {shape}"
        )
    return array


def _require_last_row(Ts: FloatArray, what: str) -> None:
    """Check that the last row of matrices (N, 4, 4) is 0 0 0 1."""
    last = np.array([0.0, 0.0, 0.0, 1.0])
    wrong = np.abs(Ts[:, 3] - last).max(axis=1, initial=0.0) > LAST_ROW_WITHIN
    if not wrong.any():
        return
    row = int(np.argmax(wrong))
    raise InputError(f"{what}, row {row + 1}: {wrong_last_row(Ts[row])}")


def wrong_last_row(T: FloatArray) -> str:
    """Return what is wrong with a matrix (4, 4) whose last row is not 0 0 0 1."""
    numbers = " ".join(f"{value:.4g}" for value in T[3])
    is_transposed = np.allclose(T[:, 3], [0.0, 0.0, 0.0, 1.0], atol=LAST_ROW_WITHIN)
    cause = ": the matrix is transposed, write it row by row" if is_transposed else ""
    return f"the last row of the matrix is {numbers}, expected 0 0 0 1{cause}"


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


def words_of(name: str) -> set[str]:
    """Return the words in the name of a frame or topic, in lower case."""
    return {*re.findall("[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower())}


@dataclass(frozen=True)
class StreamFrames:
    """Names of the frames of a stream of poses; empty if they are not known.

    Attributes
    ----------
    sensor, world : str
        Of the sensor, and of the fixed frame in which its poses are, as the messages give them.
    option : str
        Of the sensor, as the user gave it.
    """

    sensor: str = ""
    world: str = ""
    option: str = ""

    @property
    def name(self) -> str:
        """Name of the sensor's frame."""
        return self.option or self.sensor

    @property
    def inverse_name(self) -> str:
        """Name of the sensor's frame if the poses have to be inverted.

        Transforms camera -> marker of a fixed marker are inverse poses of the camera: the frames
        change their roles. A publisher that writes inverse poses below the frames odom -> base_link
        means base_link: a frame that is called a world is no sensor.
        """
        is_named_otherwise = self.option not in ("", self.sensor)
        if not self.world or is_named_otherwise:
            return self.name
        is_world = bool(words_of(self.world) & _WORLDS)
        is_target = bool(words_of(self.sensor) & _TARGETS)
        return self.name if is_world and not is_target else self.world


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
        parent = frame_name(parent)
        frame = frame_name(frame)
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
        up = self.above(frame_name(frame))
        down = self.above(frame_name(of))
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
