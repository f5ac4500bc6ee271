"""Messages that carry a part of a pose: positions of GNSS receivers and prisms, orientations and
angular rates of IMUs; and messages of poses of which only a part counts.
"""

from collections.abc import Sequence

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry.rates import RateIntegrator
from hand_eye_calib.io.bags.messages import (
    FIX_TYPE,
    IMU_TYPE,
    MALFORMED,
    POINT_TYPE,
    POSE_TYPES,
    Buffer,
    MalformedMessage,
    PoseColumns,
    PoseFields,
    unpack_part,
    unpack_pose,
    unpack_poses,
)
from hand_eye_calib.io.trajectory_files.geodetic import LocalOrigin, wrong_latitude

#: What each type can be read as, the usual first.
PART_TYPES = {
    IMU_TYPE: ("rates", "rotations"),
    FIX_TYPE: ("positions",),
    POINT_TYPE: ("positions",),
}
_OF_POSES = ("poses", "positions", "rotations")

_POLE_DEG = 90.0 + 1e-9

_LEVEL = (0.0, 0.0, 0.0, 1.0)

# What a row that is not finite lacks.
_LACKS = {"positions": "fix", "rotations": "orientation", "rates": "angular rates"}


def measured_as(message_type: str, wanted: str, source: object) -> str:
    """What messages of a type are read as: what is wanted, or the usual for "auto".

    Raises
    ------
    ConfigError
        If they cannot be read as that.
    """
    possible = PART_TYPES.get(message_type, _OF_POSES)
    if wanted == "auto":
        return possible[0]
    if wanted not in possible:
        raise ConfigError(
            f"{source} has messages of type {message_type or 'tf2_msgs/msg/TFMessage'}, which "
            f"measure {' or '.join(possible)}; asked for are {wanted}"
        )
    return wanted


class PartReader:
    """Unpacks the messages of one topic, in their order, as rows of poses whose other part means
    nothing: level positions, rotations at the origin.

    Parameters
    ----------
    message_type, measures : str
        As of :func:`measured_as`.
    origin : LocalOrigin, optional
        Of latitudes and longitudes; the first one read by default.

    Attributes
    ----------
    n_left_out : int
        Messages without a fix or an orientation.
    """

    def __init__(self, message_type: str, measures: str, origin: LocalOrigin | None = None) -> None:
        self._type, self._measures = message_type, measures
        self._integrator, self._origin = RateIntegrator(), origin or LocalOrigin()
        self.n_left_out = 0

    def columns(self, messages: Sequence[Buffer], is_ros1: bool) -> PoseColumns:
        """The next messages; a row without a fix or an orientation is not finite.

        Raises
        ------
        MalformedMessage
            At the first that cannot be unpacked.
        InputError
            At the first latitude beyond 90 deg; its attribute ``index`` has the row.
        """
        if self._type in POSE_TYPES:
            columns = unpack_poses(messages, self._type, is_ros1)
            poses = columns.poses.copy()
            if self._measures == "positions":
                poses[:, 3:] = _LEVEL
            elif self._measures == "rotations":
                poses[:, :3] = 0.0
            return columns._replace(poses=poses)
        rows = []
        for index, data in enumerate(messages):
            try:
                rows.append(unpack_part(data, self._type, is_ros1))
            except MALFORMED as error:
                raise MalformedMessage(index, error) from error
        stamps_ns = np.array([row.stamp_ns for row in rows], dtype=np.int64)
        poses = np.zeros((len(rows), 7))
        poses[:, 3:] = _LEVEL
        values = np.array([row.values for row in rows], dtype=float)
        if self._type == IMU_TYPE:
            values = values[:, 4:] if self._measures == "rates" else values[:, :4]
        is_usable = np.isfinite(values).all(axis=1)
        self.n_left_out += int((~is_usable).sum())
        if is_usable.any():
            self._fill(poses, stamps_ns, values, is_usable)
        poses[~is_usable] = np.nan
        names = [row.frame for row in rows]
        is_fixed = self._type == POINT_TYPE
        return PoseColumns(
            stamps_ns,
            names if is_fixed else [""] * len(rows),
            [None] * len(rows) if is_fixed else names,
            poses,
        )

    def _fill(
        self, poses: FloatArray, stamps_ns: IntArray, values: FloatArray, rows: BoolArray
    ) -> None:
        """Write what was measured into some rows of poses (N, 7)."""
        if self._type == FIX_TYPE:
            _check_latitudes(values, rows)
            lat, lon = np.radians(values[rows, :2]).T
            poses[rows, :3] = self._origin.local(lat, lon, values[rows, 2])
        elif self._type == POINT_TYPE:
            poses[rows, :3] = values[rows]
        elif self._measures == "rates":
            poses[rows, 3:] = self._integrator.quats_xyzw(stamps_ns[rows], values[rows])
        else:
            poses[rows, 3:] = values[rows]


def _check_latitudes(values: FloatArray, rows: BoolArray) -> None:
    """Refuse latitudes (deg) beyond the poles, of some rows of latitude, longitude and height."""
    beyond = np.flatnonzero(rows & (np.abs(values[:, 0]) > _POLE_DEG))
    if len(beyond):
        error = InputError(wrong_latitude(*values[beyond[0], :2]))
        error.index = int(beyond[0])  # type: ignore[attr-defined]
        raise error


class MessageReader:
    """Unpacks the messages of one topic one by one, as they arrive; the parameters are those of
    :class:`PartReader`.
    """

    def __init__(self, message_type: str, measures: str, origin: LocalOrigin | None = None) -> None:
        self._type, self._measures = message_type, measures
        self._parts = PartReader(message_type, measures, origin)

    def __call__(self, data: Buffer) -> PoseFields:
        """The next message, in CDR.

        Raises
        ------
        InputError
            If it cannot be unpacked, or lacks what is measured.
        """
        try:
            if self._measures == "poses":
                return unpack_pose(data, self._type, is_ros1=False)
            columns = self._parts.columns([data], is_ros1=False)
        except InputError:
            raise
        except MALFORMED as error:
            raise InputError(f"not a message of type {self._type}: {error}") from error
        if not np.isfinite(columns.poses).all():
            raise InputError(f"the message has no {_LACKS[self._measures]}")
        position, quat_xyzw = columns.poses[0, :3].tolist(), columns.poses[0, 3:].tolist()
        frames = columns.world_frames[0], columns.sensor_frames[0]
        return PoseFields(int(columns.stamps_ns[0]), *frames, position, quat_xyzw)
