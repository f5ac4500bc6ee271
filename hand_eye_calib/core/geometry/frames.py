"""Checks of poses from files and users, and the tree of frames of a robot.

The edges of a tree of frames come from a robot description, ``/tf`` or ``/tf_static``.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
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
    Trajectory,
    far_position,
)

# Largest difference between an element of a rotation matrix and the nearest rotation.
_ROTATION_WITHIN = 1e-2

# Last row of every transform.
_LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])
# Largest difference between an element of the last row of a transform and 0 0 0 1.
LAST_ROW_WITHIN = 1e-6

# Words in the name of a fixed frame, such as a map or the origin of an odometry.
_WORLDS = {
    "map",
    "odom",
    "odometry",
    "world",
    "earth",
    "ecef",
    "enu",
    "ned",
    "utm",
    "global",
}
_WORLDS |= {"origin", "init", "mocap", "vicon", "optitrack", "inertial"}
# Words in the name of a frame that a camera observes.
_TARGETS = {
    "aruco",
    "marker",
    "tag",
    "apriltag",
    "charuco",
    "target",
    "board",
    "chessboard",
}
_TARGETS |= {"checkerboard", "pattern", "fiducial", "aprilgrid"}

# Largest number of edges of a tree in a message.
_MAX_LISTED = 50


def are_null(poses: FloatArray) -> BoolArray:
    """Return a mask (N,) of the null poses among rows x y z qx qy qz qw (N, 7).

    A null pose has a value that is not finite, or a quaternion of zeros. Trackers publish null
    poses when they are lost.
    """
    is_null = (poses[:, 3:] == 0.0).all(axis=1)
    # If the sum is finite, all values are finite. The sum is faster than a check of every row.
    with np.errstate(invalid="ignore", over="ignore"):
        total = poses.sum()
    if not np.isfinite(total):
        is_null |= ~np.isfinite(poses).all(axis=1)
    return np.asarray(is_null, dtype=bool)


def check_not_null(*values: float) -> None:
    """Raise NoPoseError if x, y, z, qx, qy, qz, qw are a null pose, see :func:`are_null`."""
    if not all(map(math.isfinite, values)):
        raise NoPoseError("the pose has a value that is not finite")
    if not any(values[3:]):
        raise NoPoseError("the pose has a quaternion of length 0, expected 1")


def check_pose(*values: float) -> None:
    """Check x, y, z, qx, qy, qz, qw of a pose.

    Raises
    ------
    NoPoseError
        If the source has no pose at this instant, see :func:`are_null`.
    InputError
        If the quaternion is not of unit length, or the position is too far away.
    """
    check_not_null(*values)
    length = math.hypot(*values[3:])
    if abs(length - 1.0) > QUATERNION_NORM_TOLERANCE:
        raise InputError(
            f"the pose has a quaternion of length {length:.4g}, expected 1"
        )
    if max(map(abs, values[:3])) > FARTHEST_M:
        raise InputError(far_position(*values[:3]))


def checked_pose(position: ArrayLike, quat_xyzw: ArrayLike) -> FloatArray:
    """Return the pose (4, 4) of a position and a quaternion; raises as :func:`check_pose`."""
    t = np.asarray(position, dtype=float)
    quat_xyzw = np.asarray(quat_xyzw, dtype=float)
    check_pose(*t.tolist(), *quat_xyzw.tolist())
    return se3.from_quat_xyzw(t, quat_xyzw)


def pose_of(*values: Any) -> FloatArray:
    """Return the pose (4, 4) for the values of a file, in any of the usual forms.

    Parameters
    ----------
    *values
        A matrix of 12 or 16 numbers; or x, y, z, qx, qy, qz, qw; or a message; or a translation
        and a rotation. The rotation is a matrix, a quaternion w, x, y, z, or roll, pitch and yaw in
        degrees. Each value may have any form that :func:`numbers_of` accepts.

    Raises
    ------
    InputError
        If the values have another form, or are not a rigid transform.
    """
    parts = [numbers_of(value) for value in values]
    sizes = tuple(map(len, parts))
    flat = np.concatenate([[], *parts])
    T = np.eye(4)
    if not np.isfinite(flat).all():
        raise InputError("a number is not finite")
    if sizes in ((16,), (12,)):
        T.flat[: len(flat)] = flat
    elif sizes == (7,):
        T = checked_pose(flat[:3], flat[3:])
    elif sizes == (3, 4):
        # From w, x, y, z to x, y, z, w.
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
    (T,) = _rigid(T[None])
    return T


def pose_stack(values: Any, label: str) -> FloatArray:
    """Return checked poses (N, 4, 4) for arrays in any of the usual forms.

    Parameters
    ----------
    values : array-like
        Matrices (N, 4, 4) or (N, 3, 4), rows (N, 7) of x, y, z, qx, qy, qz, qw, or a pair (R, t):
        rotations (N, 3, 3) or rotation vectors (N, 3), rad, and translations (N, 3), m.
    label : str
        Name of the poses in messages.

    Raises
    ------
    InputError
        If a pose is invalid; the message names its row, counted from 1.
    """
    if isinstance(values, str | PathLike):
        raise InputError(
            f"{label}: expected poses, not a path; read_arm_samples and read_trajectory read files"
        )
    if isinstance(values, Trajectory):
        values = values.poses
    pair = _pair_of_stacks(values)
    Ts = _joined(*pair, label) if pair else _single_stack(values, label)
    is_finite = np.isfinite(Ts).all(axis=(1, 2))
    if not is_finite.all():
        raise InputError(
            f"{label}, row {np.argmin(is_finite) + 1}: a number is not finite"
        )
    return _rigid(Ts, label)


def _rigid(Ts: FloatArray, label: str = "") -> FloatArray:
    """Return transforms (N, 4, 4) with each 3x3 part replaced by the nearest rotation.

    Raises
    ------
    InputError
        For the first matrix whose 3x3 part is not a rotation, or whose last row is not 0 0 0 1. If
        there is a ``label``, the message contains it and the row.
    """
    rotations = se3.nearest_rotation(se3.rotation_of(Ts))
    differences = np.abs(rotations - se3.rotation_of(Ts))
    is_wrong = (differences > _ROTATION_WITHIN).any(axis=(1, 2))
    if is_wrong.any():
        row = int(np.argmax(is_wrong))
        raise InputError(
            _place(label, row) + "the 3x3 part is not a rotation matrix"
        )
    is_wrong = (np.abs(Ts[:, 3] - _LAST_ROW) > LAST_ROW_WITHIN).any(axis=1)
    if is_wrong.any():
        row = int(np.argmax(is_wrong))
        raise InputError(_place(label, row) + wrong_last_row(Ts[row]))
    return se3.from_rotation_translation(rotations, se3.translation_of(Ts))


def _place(label: str, row: int) -> str:
    """Return the beginning of a message about a row; empty without a label."""
    return f"{label}, row {row + 1}: " if label else ""


def _numbers(values: Any) -> FloatArray | None:
    """Return values as an array; None if they are not numbers, or are rows of unequal lengths."""
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        return None


def _pair_of_stacks(values: Any) -> tuple[FloatArray, FloatArray] | None:
    """Return rotations and translations if the values are a pair of them, otherwise None."""
    if not isinstance(values, tuple | list) or len(values) != 2:
        return None
    rotations, translations = map(_numbers, values)
    if rotations is None or translations is None:
        return None
    vector_shapes = ((3,), (3, 1), (1, 3))
    are_rotations = rotations.shape[1:] in ((3, 3), *vector_shapes)
    are_translations = translations.shape[1:] in vector_shapes
    return (
        (rotations, translations)
        if are_rotations and are_translations
        else None
    )


def _joined(
    rotations: FloatArray, translations: FloatArray, label: str
) -> FloatArray:
    """Return poses (N, 4, 4) of rotations or rotation vectors, and translations."""
    if len(rotations) != len(translations):
        raise InputError(
            f"{label}: {len(rotations)} rotations, {len(translations)} translations; each pose "
            "needs both"
        )
    if rotations.shape[1:] != (3, 3):
        rotations = se3.rotation_exp(rotations.reshape(-1, 3))
    return se3.from_rotation_translation(rotations, translations.reshape(-1, 3))


def _single_stack(values: Any, label: str) -> FloatArray:
    """Return poses (N, 4, 4) of matrices or rows."""
    array = _numbers(values)
    if array is not None and array.ndim == 2 and array.shape[1] == 7:
        stack = []
        for number, row in enumerate(array.tolist(), 1):
            with located(f"{label}, row {number}"):
                stack.append(checked_pose(row[:3], row[3:]))
        return np.reshape(stack, (-1, 4, 4))
    if array is not None and array.shape[1:] == (3, 4):
        return se3.from_rotation_translation(array[:, :, :3], array[:, :, 3])
    if array is None or array.shape[1:] != (4, 4):
        shape = (
            "rows of different shapes"
            if array is None
            else f"an array {array.shape}"
        )
        raise InputError(
            f"{label}: expected poses as (N, 4, 4), (N, 7) of x, y, z, qx, qy, qz, qw, or a pair "
            f"of rotations (N, 3, 3) and translations (N, 3); found {shape}"
        )
    return array


def wrong_last_row(T: FloatArray) -> str:
    """Return a message about a matrix (4, 4) whose last row is not 0 0 0 1."""
    numbers = " ".join(f"{value:.4g}" for value in T[3])
    is_transposed = np.allclose(T[:, 3], _LAST_ROW, atol=LAST_ROW_WITHIN)
    cause = (
        ": the matrix is transposed, write it row by row"
        if is_transposed
        else ""
    )
    return f"the last row of the matrix is {numbers}, expected 0 0 0 1{cause}"


def numbers_of(value: Any) -> list[float]:
    """Return the numbers in nested lists, in a message, in a matrix of OpenCV or in a text.

    The numbers keep their order. The list is empty for other kinds of values.
    """
    if isinstance(value, Mapping):
        position = value.get("translation", value.get("position"))
        quaternion = value.get("rotation", value.get("orientation"))
        if isinstance(position, Mapping) and isinstance(quaternion, Mapping):
            # A message of ROS.
            value = [position.get(axis) for axis in "xyz"]
            value += [quaternion.get(axis) for axis in "xyzw"]
        else:
            # A matrix of OpenCV.
            value = value.get("data", ())
    if isinstance(value, str):
        value = value.split()
    try:
        numbers: list[float] = np.array(value, dtype=float).ravel().tolist()
    except (TypeError, ValueError):
        return []
    return numbers


def words_of(name: str) -> set[str]:
    """Return the words in the name of a frame or topic, in lower case."""
    # Capital letters after small ones begin a word, as in baseLink.
    separated = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)
    return set(re.findall("[a-z]+", separated.lower()))


@dataclass(frozen=True)
class StreamFrames:
    """Names of the frames of a stream of poses; empty if unknown.

    Attributes
    ----------
    sensor : str
        Name of the sensor's frame in the messages.
    world : str
        Name of the fixed frame in the messages.
    option : str
        Name of the sensor's frame that the user set.
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
        """Name of the sensor's frame if the poses of the stream are inverted.

        If the transforms camera -> marker are of a fixed marker, both frames exchange their roles,
        and the sensor is the camera. For inverse poses odom -> base_link, the sensor remains
        base_link, because odom is the name of a world.
        """
        is_named_otherwise = self.option not in ("", self.sensor)
        if not self.world or is_named_otherwise:
            return self.name
        has_name_of_world = bool(words_of(self.world) & _WORLDS)
        is_target = bool(words_of(self.sensor) & _TARGETS)
        return self.name if has_name_of_world and not is_target else self.world


@dataclass(frozen=True)
class Extrinsic:
    """Pose of the child sensor in the parent sensor's frame, from a file or another source.

    Attributes
    ----------
    T_parent_child : (4, 4) array
    origin : str
        Description of the source.
    covariance : (6, 6) array
        Covariance of the error xi in ``T_parent_child @ exp(xi)``; zero if the source has none.
    is_calibration : bool
        Whether the pose was estimated from the motion of the same sensors.
    """

    T_parent_child: FloatArray
    origin: str
    covariance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    is_calibration: bool = False


@dataclass
class Edge:
    """Edge from a frame to its parent.

    Attributes
    ----------
    parent : str
        Name of the parent frame.
    is_static : bool
        Whether the frame is fixed to its parent.
    pose : (4, 4) array, optional
        ``T_parent_frame``; None if unknown.
    """

    parent: str
    is_static: bool = True
    pose: FloatArray | None = None


class FrameTree:
    """Tree of frames.

    Parameters
    ----------
    origin : str
        Source of the frames, for messages.

    Attributes
    ----------
    edges : dict of str to Edge
        Frame to the edge to its parent.
    """

    def __init__(self, origin: str = "the transforms") -> None:
        self.edges: dict[str, Edge] = {}
        self._origin = origin

    def add(
        self,
        parent: str,
        frame: str,
        pose: FloatArray | None = None,
        is_static: bool = True,
    ) -> Edge:
        """Add an edge, or replace its pose. An edge that has moved never becomes static again.

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
                f"{self._origin} do not form a tree; record the transforms of one publisher only"
            )
        if not is_static:
            edge.is_static = False
        edge.pose = pose
        return edge

    def pose(
        self,
        frame: str,
        of: str,
        moving: Mapping[str, FloatArray] | None = None,
    ) -> FloatArray:
        """Return the pose (..., 4, 4) of the frame ``of`` in ``frame``.

        Parameters
        ----------
        frame, of : str
        moving : mapping, optional
            For edges that move: name of the frame to its poses (..., 4, 4) in its parent. Other
            edges that move then keep their last pose.

        Raises
        ------
        InputError
            If a frame is missing, or an edge between both frames moves and ``moving`` is empty.
        """
        up, down = self.route(frame, of)
        T_frame_of = np.eye(4)
        moving = moving or {}
        for step in up + down:
            edge = self.edges[step]
            T_above_step = moving.get(step, edge.pose)
            if T_above_step is None or not (edge.is_static or moving):
                raise InputError(
                    f"{frame} and {of} are not fixed to each other: {step} moves"
                )
            if step in up:
                T_above_step = se3.inverse(T_above_step)
            T_frame_of = T_frame_of @ T_above_step
        return T_frame_of

    def route(self, frame: str, of: str) -> tuple[list[str], list[str]]:
        """Return the edges on the path from ``frame`` to ``of``.

        An edge is represented by its lower frame. The first list has the edges from ``frame`` up to
        the common frame. The second list has the edges from the common frame down to ``of``.

        Raises
        ------
        InputError
            If a frame is missing, or both frames are not connected.
        """
        up = self.above(frame_name(frame))
        down = self.above(frame_name(of))
        if up[-1] != down[-1]:
            raise InputError(
                f"frames {frame!r} and {of!r} are not connected; {self.listing()}"
            )
        while up and down and up[-1] == down[-1]:
            del up[-1], down[-1]
        return up, down[::-1]

    def above(self, frame: str) -> list[str]:
        """Return a frame, its parent, the parent of its parent, and so on to the root.

        Raises
        ------
        InputError
            If the frame is missing, or the frames above it form a loop.
        """
        if frame not in self.edges and all(
            edge.parent != frame for edge in self.edges.values()
        ):
            raise InputError(
                f"no frame {frame!r} in {self._origin}; {self.listing()}"
            )
        frames = [frame]
        while frame in self.edges:
            frame = self.edges[frame].parent
            if frame in frames:
                raise InputError(
                    f"{self._origin} form a loop through frame {frame!r}: "
                    "correct the parent of a frame in this loop"
                )
            frames.append(frame)
        return frames

    def listing(self) -> str:
        """Return a text of one line with all edges."""
        edges = []
        for frame, edge in self.edges.items():
            suffix = " (static)" if edge.is_static else ""
            edges.append(f"{edge.parent}:{frame}{suffix}")
        edges.sort()
        if len(edges) > _MAX_LISTED:
            edges[_MAX_LISTED:] = [f"and {len(edges) - _MAX_LISTED} more"]
        return f"it has {', '.join(edges) or 'no transforms'}"
