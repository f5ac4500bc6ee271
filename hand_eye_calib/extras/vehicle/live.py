"""Convert live messages with wheel rates or velocities to poses: a step of a planar path each."""

import cmath
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

from hand_eye_calib.core.base.errors import ConfigError, InputError, NoPoseError
from hand_eye_calib.extras.vehicle.joints import STEERED, WheelJoints
from hand_eye_calib.extras.vehicle.wheel_files import unit_rates
from hand_eye_calib.formats.bags.messages import JOINTS_TYPE, MALFORMED, Cursor
from hand_eye_calib.formats.transforms import PoseFields

# Kinds of wheel data in messages with velocities.
_OF_TWISTS = ("wheel_odometry", "omni")


class LiveReading(ABC):
    """Reader of a live topic whose messages are steps of the unit vehicle's path (:mod:`.wheels`).

    The poses equal those of the same messages in a bag. The computation uses plain numbers, because
    it must take only some microseconds per message.

    Parameters
    ----------
    measures : str
        Kind of wheel data.
    sensor_frame : str, optional
        Frame of the vehicle, if the messages do not have its name.
    """

    def __init__(self, measures: str, sensor_frame: str | None = None) -> None:
        self.measures = measures
        self._sensor_frame = sensor_frame
        self._stamp_ns = 0
        self._values: Sequence[float] = ()
        # Position (m) as a complex number, and heading (rad) of the unit vehicle.
        self._position = 0j
        self._heading = 0.0

    @abstractmethod
    def _read(self, cursor: Cursor) -> Sequence[float]:
        """Return the wheel data after the header of a message.

        Raises
        ------
        NoPoseError
            If the message has no wheel data.
        InputError
            If the wheel data are unclear.
        """

    def _mean(
        self, earlier: Sequence[float], later: Sequence[float], _: float
    ) -> list[float]:
        """Return the mean wheel data between two messages that are some seconds apart."""
        return [
            (start + end) / 2.0
            for start, end in zip(earlier, later, strict=True)
        ]

    def __call__(self, data: bytes) -> PoseFields:
        """Return the pose after the next message (in CDR).

        Stamps must increase. If they jump back, the path continues from the last pose.

        Raises
        ------
        NoPoseError, InputError
            If the message has no usable wheel data.
        """
        try:
            cursor = Cursor(data, is_ros1=False)
            stamp_ns = cursor.stamp_ns()
            world_frame = cursor.name()
            values = self._read(cursor)
        except MALFORMED as error:
            raise InputError(
                f"not a message with velocities: {error}"
            ) from error
        if not all(map(math.isfinite, values)):
            raise NoPoseError("a value of the message is missing")
        duration_s = (stamp_ns - self._stamp_ns) * 1e-9
        earlier = self._values
        self._stamp_ns = stamp_ns
        self._values = values
        if earlier and duration_s > 0.0:
            self._drive(self._mean(earlier, values, duration_s), duration_s)
        half = self._heading / 2.0
        return PoseFields(
            stamp_ns,
            "" if self._sensor_frame else world_frame,
            self._sensor_frame,
            (self._position.real, self._position.imag, 0.0),
            (0.0, 0.0, math.sin(half), math.cos(half)),
        )

    def _drive(self, means: Sequence[float], duration_s: float) -> None:
        """Continue the path by one arc. ``means`` are the wheel data during the arc."""
        forward, left, turn = (
            float(rate) * duration_s
            for rate in unit_rates(self.measures, means)
        )
        if abs(turn) > math.pi:
            raise InputError(
                f"the wheels turn by more than half a turn of the vehicle within {duration_s:.3g} "
                "s; publish rad/s and rad"
            )
        # Ratio of the chord to the arc, as in :func:`.wheels.path_of`.
        shortening = math.sin(turn / 2.0) / (turn / 2.0) if turn else 1.0
        chord = complex(forward, left) * shortening
        self._position += chord * cmath.exp(1j * (self._heading + turn / 2.0))
        self._heading += turn


class LiveTwists(LiveReading):
    """Reader of forward speed, left speed (m/s) and yaw rate (rad/s), such as ``TwistStamped``."""

    def _read(self, cursor: Cursor) -> Sequence[float]:
        forward, left, _, _, _, turn = cursor.read("6d")
        return (
            (forward, left, turn)
            if self.measures == "omni"
            else (forward, turn)
        )


class LiveJoints(LiveReading):
    """Reader of the wheels in joint states."""

    def __init__(self, topic: str, measures: str) -> None:
        super().__init__(measures, "base_link")
        self._joints = WheelJoints(topic, measures)

    def _read(self, cursor: Cursor) -> Sequence[float]:
        names = [cursor.name() for _ in range(cursor.read("I")[0])]
        positions = _sequence(cursor)
        try:
            row = self._joints.row(names, positions, _sequence(cursor))
        except InputError as error:
            raise InputError(
                f"{error}. The node finds wheels by their names only: record a bag, and run "
                "hand_eye_calib calibrate BAG with this --parent-topic"
            ) from None
        if row is None:
            raise NoPoseError("the message has no wheels")
        return row

    def _mean(
        self,
        earlier: Sequence[float],
        later: Sequence[float],
        duration_s: float,
    ) -> list[float]:
        means = super()._mean(earlier, later, duration_s)
        if self._joints.are_positions:
            rates = [
                (end - start) / duration_s
                for start, end in zip(earlier, later, strict=True)
            ]
            means = [rates[0], means[1]] if self.measures in STEERED else rates
        return means


def _sequence(cursor: Cursor) -> Sequence[float]:
    """Read a sequence of numbers."""
    (length,) = cursor.read("I")
    # An empty sequence has no padding after its length.
    values: Sequence[float] = cursor.read(f"{length}d") if length else ()
    return values


def live_reading(message_type: str, topic: str, measures: str) -> LiveReading:
    """Return the reader of the messages of a live topic.

    Raises
    ------
    ConfigError
        If the messages have velocities, but the kind of wheel data is not set.
    """
    if message_type == JOINTS_TYPE:
        return LiveJoints(topic, measures)
    if measures not in _OF_TWISTS:
        raise ConfigError(
            f"{topic} has velocities, which the node reads as wheels only: set parent_measures to "
            "wheel_odometry or omni; for other velocities record a bag, and run hand_eye_calib "
            "calibrate BAG"
        )
    return LiveTwists(measures)
