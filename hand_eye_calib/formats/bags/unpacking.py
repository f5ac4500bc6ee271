"""Unpack messages from their bytes into tables of poses or of other quantities of a topic."""

import struct
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.errors import InputError, NoPoseError
from hand_eye_calib.core.base.registry import MEASURES
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import are_null
from hand_eye_calib.core.geometry.rates import RateIntegrator
from hand_eye_calib.formats.bags.messages import (
    COLUMNS,
    MALFORMED,
    MESSAGE_TYPES,
    NS_PER_S,
    POSE_SIZE,
    POSE_TYPES,
    SENSOR_TYPES,
    STAMP_SIZE,
    START,
    Cursor,
    MessageType,
    unpack_fix,
    unpack_pose,
)
from hand_eye_calib.formats.bags.pose_table import PoseTable
from hand_eye_calib.formats.geodetic import LocalOrigin
from hand_eye_calib.formats.transforms import PoseFields


class _Unpacked(NamedTuple):
    """Fields of a message. ``end`` is the number of bytes until the end of the values."""

    stamp_ns: int
    world_frame: str
    sensor_frame: str | None
    values: Sequence[float]
    end: int


class _Frames(NamedTuple):
    """Frames of a pose in CDR.

    Attributes
    ----------
    data : bytes
        Bytes of the message between its stamp and its pose. They contain the frame names.
    end : int
        Number of bytes of the message before the pose.
    world_frame, sensor_frame : str
    """

    data: bytes
    end: int
    world_frame: str
    sensor_frame: str | None


def _unpack(row: MessageType, is_ros1: bool, data: bytes) -> _Unpacked:
    """Unpack one message. Raise an error of ``MALFORMED`` if it is not of the row's type."""
    cursor = Cursor(data, is_ros1)
    stamp_ns = cursor.stamp_ns()
    world_frame = cursor.name()
    sensor_frame = cursor.name() if row.has_child_frame else None
    values = row.unpack(cursor) if row.unpack else ()
    return _Unpacked(
        stamp_ns, world_frame, sensor_frame, values, cursor.position
    )


def unpack_poses(
    messages: Sequence[bytes], message_type: str, is_ros1: bool
) -> PoseTable:
    """Unpack messages of a type in MESSAGE_TYPES.

    Raises an error of ``MALFORMED`` if a message is not of this type. To save time, poses with
    equal frames are unpacked together.
    """
    row = MESSAGE_TYPES[message_type]
    if row.unpack is unpack_pose and len(messages) > 1:
        table = _unpack_alike(messages, row, is_ros1)
        if table is not None:
            return table
    unpacked = [_unpack(row, is_ros1, data) for data in messages]
    stamps_ns, worlds, sensors, values, _ = zip(*unpacked, strict=True)
    return PoseTable.of(stamps_ns, values, worlds, sensors)


def _unpack_alike(
    messages: Sequence[bytes], row: MessageType, is_ros1: bool
) -> PoseTable | None:
    """Unpack poses together, as columns of the bytes of all messages.

    The result is None if the messages differ in length or in frames, or if a stamp is invalid. They
    must then be unpacked singly.
    """
    size = len(messages[0])
    if any(len(data) != size for data in messages):
        return None
    first = _unpack(row, is_ros1, messages[0])
    rows = np.frombuffer(b"".join(messages), dtype=np.uint8).reshape(-1, size)
    encodings = rows[:, :2]
    # In CDR these bytes are the encoding, which must be equal. In ROS 1 they belong to the sequence
    # number.
    has_same_encoding = is_ros1 or (encodings == encodings[0]).all()
    frames = rows[:, START + STAMP_SIZE : first.end - POSE_SIZE]
    stamps = np.ascontiguousarray(rows[:, START : START + STAMP_SIZE])
    columns = stamps.view("<u4" if is_ros1 else "<i4").T
    seconds, nanoseconds = columns.astype(np.int64)
    are_stamps = (nanoseconds // NS_PER_S == 0).all()
    has_same_frames = (frames == frames[0]).all()
    if not (has_same_encoding and are_stamps and has_same_frames):
        return None
    pose_bytes = rows[:, first.end - POSE_SIZE : first.end]
    poses = np.ascontiguousarray(pose_bytes).view("<f8")
    stamps_ns = seconds * NS_PER_S + nanoseconds
    return PoseTable.of(stamps_ns, poses, first.world_frame, first.sensor_frame)


class MessageReader:
    """Read the messages of one topic as poses, in their order.

    Angular rates are integrated to orientations. If the messages have no orientation, the poses
    have the identity. If they have no position, the poses are at the origin.

    Parameters
    ----------
    message_type : str
    measures : str
        Quantity to read, see :func:`.messages.measured_as`.
    origin : LocalOrigin, optional
        Origin for the conversion of latitudes and longitudes to metres; by default, the first
        position.

    Attributes
    ----------
    n_left_out : int
        Number of messages without the quantity: null poses, no fix, or no orientation.
    """

    def __init__(
        self,
        message_type: str,
        measures: str,
        origin: LocalOrigin | None = None,
    ) -> None:
        self._row = MESSAGE_TYPES[message_type]
        self._measures = MEASURES[measures].read_as or measures
        self._are_poses = (
            message_type in POSE_TYPES and self._measures == "poses"
        )
        self._rates = RateIntegrator()
        # Frames of the previous pose. The initial value differs from the bytes of every message.
        self._frames = _Frames(
            data=b" ", end=0, world_frame="", sensor_frame=None
        )
        self._origin = origin or LocalOrigin()
        self.n_left_out = 0

    def columns(
        self, messages: Sequence[bytes], is_ros1: bool
    ) -> tuple[PoseTable, BoolArray]:
        """Unpack the next messages.

        Returns
        -------
        PoseTable
        (N,) bool array
            Whether each message contains the quantity. Poses of messages without the quantity are
            NaN, except for null poses, which are returned as they are.

        Raises
        ------
        struct.error, ValueError
            If a message is not of its type.
        InputError
            If a latitude or longitude is out of range.
        """
        columns = unpack_poses(messages, self._row.name, is_ros1)
        if self._are_poses:
            is_null = are_null(columns.poses)
            self.n_left_out += int(is_null.sum())
            return columns, ~is_null
        values = columns.poses[:, COLUMNS[self._measures]]
        is_usable = np.asarray(np.isfinite(values).all(axis=1), dtype=bool)
        if self._measures == "rotations":
            is_usable &= (values != 0.0).any(axis=1)
        self.n_left_out += int((~is_usable).sum())
        poses = np.tile([0.0] * 6 + [1.0], (len(values), 1))  # placeholders
        if is_usable.any():
            has_positions = self._measures == "positions"
            target = COLUMNS["positions" if has_positions else "rotations"]
            measured = self._measured(
                columns.stamps_ns[is_usable], values[is_usable]
            )
            poses[is_usable, target] = measured
        poses[~is_usable] = np.nan
        if self._row.name not in SENSOR_TYPES:
            return replace(columns, poses=poses), is_usable
        return PoseTable.of(
            columns.stamps_ns, poses, "", columns.world_frames
        ), is_usable

    def _measured(self, stamps_ns: IntArray, values: FloatArray) -> FloatArray:
        """Return positions (N, 3), m, or quaternions (N, 4) from the values of N messages.

        Rates are integrated. Latitude, longitude (deg) and height are converted to metres.
        """
        if self._measures == "rates":
            return se3.to_quat_xyzw(self._rates.rotations(stamps_ns, values))
        if self._row.unpack is not unpack_fix:
            return values
        out_of_range = values[(np.abs(values[:, :2]) > (90, 360)).any(axis=1)]
        if len(out_of_range):
            found = "latitude {:.7g} and longitude {:.7g}".format(
                *out_of_range[0]
            )
            raise InputError(
                f"found {found}; the limits are 90 deg and 360 deg. If latitude and longitude "
                "are swapped, repair their source"
            )
        lat, lon = np.radians(values[:, :2]).T
        return self._origin.local(lat, lon, values[:, 2])

    def _pose_fields(self, data: bytes) -> PoseFields:
        """Unpack a pose in CDR.

        To save time, frame names are decoded only if their bytes differ from the previous pose.
        """
        start = START + STAMP_SIZE
        if data[start : self._frames.end] != self._frames.data:
            unpacked = _unpack(self._row, False, data)
            end = unpacked.end - POSE_SIZE
            self._frames = _Frames(
                data[start:end],
                end,
                unpacked.world_frame,
                unpacked.sensor_frame,
            )
        frames = self._frames
        pose = struct.unpack_from("<7d", data, frames.end)
        stamp_ns = Cursor(data, False).stamp_ns()
        return PoseFields(
            stamp_ns,
            frames.world_frame,
            frames.sensor_frame,
            pose[:3],
            pose[3:],
        )

    def __call__(self, data: bytes) -> PoseFields:
        """Unpack the next message, in CDR.

        Raises
        ------
        NoPoseError
            If the message does not contain the quantity.
        InputError
            If the message cannot be unpacked.
        """
        try:
            if self._are_poses:
                return self._pose_fields(data)
            columns, is_usable = self.columns([data], is_ros1=False)
        except InputError:
            raise
        except MALFORMED as error:
            raise InputError(
                f"not a message of type {self._row.name}: {error}"
            ) from error
        if not is_usable.all():
            raise NoPoseError(f"the message has no {self._measures}")
        pose = columns.poses[0].tolist()
        world = columns.world_frames[0]
        sensor = columns.sensor_frames[0]
        return PoseFields(
            int(columns.stamps_ns[0]), world, sensor, pose[:3], pose[3:]
        )
