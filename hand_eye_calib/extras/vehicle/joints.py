"""Find the wheels of a vehicle among the joints of a robot.

Joints have names such as ``rear_left_wheel_joint`` and ``front_left_steering_joint``. The user may
also name the joints of the left and of the right wheels, or those of the driven wheels and of the
steering, such as ``rear_left+rear_right,front_steering``.
"""

import math
import re
from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.text import listing

# Kinds of wheel data with a steering angle.
STEERED = ("steering", "tricycle")

# Above this steering angle (rad), the mean of the cotangents of both angles of an Ackermann axle is
# used. Below it, the mean of the angles is used: it has less noise, and differs by less than 0.1 %.
_SMALL_ANGLE = 0.05

# Patterns of left and right in the names of joints.
LEFT = "left|_l(_|$)|^l_"
RIGHT = "right|_r(_|$)|^r_"


class Joints(NamedTuple):
    """Names of the joints in the two columns of wheel data.

    ``first`` has the left wheels, or the driven wheels. ``second`` has the right wheels, or the
    steered wheels.
    """

    first: tuple[str, ...]
    second: tuple[str, ...]


class WheelJoints:
    """Wheels and steering angles in joint states.

    Parameters
    ----------
    topic : str
        Name of the topic for messages.
    measures : str
        Kind of wheel data: "wheels", "steering" or "tricycle".
    names : str
        Joints according to the user; empty to find them by their names.

    Raises
    ------
    InputError
        If the user has not named two groups of joints.
    """

    def __init__(self, topic: str, measures: str, names: str = "") -> None:
        self._topic = topic
        self._measures = measures
        # Angle (rad) of each joint in the last message, including whole turns.
        self._angles: dict[str, float] = {}
        self.are_positions = False
        self.joints: Joints | None = None
        if names:
            self.joints = self._named(names)

    def _named(self, names: str) -> Joints:
        """Return the joints that the user names."""
        groups = names.split(",")
        if (
            "+" not in names
            and self._measures == "wheels"
            and len(groups) % 2 == 0
        ):
            half = len(groups) // 2
            return Joints(tuple(groups[:half]), tuple(groups[half:]))
        if len(groups) != 2:
            raise InputError(f"{self._topic}: {self.expected}; got {names}")
        first, second = groups
        return Joints(tuple(first.split("+")), tuple(second.split("+")))

    @property
    def expected(self) -> str:
        """Names of the joints in the form in which the user writes them."""
        pair = "WHEEL,STEERING" if self._measures in STEERED else "LEFT,RIGHT"
        return f"name the joints: {self._topic}?{pair}"

    def row(
        self,
        names: Sequence[str],
        positions: Sequence[float],
        velocities: Sequence[float],
    ) -> tuple[float, float] | None:
        """Return the wheel data in a message; None if the message is about other joints.

        A value is a steering angle (rad), or the mean over its wheels: of their rates (rad/s), or
        of their angles (rad) if the message has no velocities (``are_positions``). It is NaN if a
        joint has no value.

        Raises
        ------
        InputError
            If the joints of the wheels are unclear.
        """
        self.joints = self.joints or self._found(names)
        if self.joints is None or not {
            *self.joints.first,
            *self.joints.second,
        } <= {*names}:
            # Other joints can use the same topic.
            return None
        self.are_positions = not len(velocities)
        angles = dict(zip(names, positions, strict=False))
        wheels = dict(zip(names, velocities, strict=False))
        if self.are_positions:
            wheels = self._unwrapped(angles)
        first = [wheels.get(name, math.nan) for name in self.joints.first]
        if self._measures in STEERED:
            second = [angles.get(name, math.nan) for name in self.joints.second]
            return fmean(first), middle_angle(second)
        second = [wheels.get(name, math.nan) for name in self.joints.second]
        return fmean(first), fmean(second)

    def _unwrapped(self, angles: Mapping[str, float]) -> dict[str, float]:
        """Return the angles (rad) of the joints, without jumps of whole turns.

        Some drivers count the angle of a wheel within one turn. A wheel is therefore assumed to
        turn by less than half a turn between two messages.
        """
        for name, angle in angles.items():
            earlier = self._angles.get(name, angle)
            if math.isfinite(angle - earlier):
                angle -= math.tau * round((angle - earlier) / math.tau)
                self._angles[name] = angle
        return self._angles

    def _found(self, names: Sequence[str]) -> Joints | None:
        """Return the joints of the wheels by their names; None if there are no wheels."""
        steered = tuple(name for name in names if "steer" in name.lower())
        wheels = [name for name in names if is_wheel(name)]
        if not wheels:
            return None
        if self._measures in STEERED:
            return self._steered(names, wheels, steered)
        if steered:
            raise InputError(
                f"{self._topic} has steering joints, {listing(steered)}: set parent_measures to "
                "steering if the speed is that of the fixed axle, or to tricycle if the steered "
                "wheel drives"
            )
        left = tuple(name for name in wheels if re.search(LEFT, name.lower()))
        right = tuple(name for name in wheels if re.search(RIGHT, name.lower()))
        if not left or len(left) != len(right):
            raise self._unclear(names)
        return Joints(left, right)

    def _steered(
        self,
        names: Sequence[str],
        wheels: Sequence[str],
        steered: tuple[str, ...],
    ) -> Joints:
        """Return the driven wheels, and the joints with the steering angle.

        The driven wheels are the wheels of the fixed axle, or the steered wheel of a tricycle.
        """
        if not steered:
            raise self._unclear(names)
        rear = [name for name in wheels if re.search("rear|back", name.lower())]
        front = [name for name in wheels if "front" in name.lower()]
        driven = front if self._measures == "tricycle" else rear
        if not driven:
            # If the names have no word for front or rear, all wheels are on one axle.
            if front or rear:
                raise self._unclear(names)
            driven = [*wheels]
        return Joints(tuple(driven), steered)

    def _unclear(self, names: Sequence[str]) -> InputError:
        """Return the error about joints whose wheels are unclear."""
        return InputError(
            f"{self._topic}: the wheels are unclear among the joints {listing(names)}; "
            f"{self.expected}"
        )

    def means(self, stamps_ns: IntArray, rows: FloatArray) -> FloatArray:
        """Return the wheel data (N - 1, 2) between N messages, see ``wheel_trajectory``.

        Parameters
        ----------
        stamps_ns : (N,) int64 array
        rows : (N, 2) array
            Wheel data in the messages, see :meth:`row`.
        """
        means = np.asarray((rows[1:] + rows[:-1]) / 2.0)
        if self.are_positions:
            # The second column is a steering angle, or the angle of a wheel in data of two wheels.
            n_wheels = 1 if self._measures in STEERED else 2
            durations_s = np.diff(stamps_ns)[:, None] * 1e-9
            means[:, :n_wheels] = (
                np.diff(rows[:, :n_wheels], axis=0) / durations_s
            )
        return means


def is_wheel(name: str) -> bool:
    """Return whether the name of a joint is that of a driving wheel without steering."""
    lower = name.lower()
    return "wheel" in lower and not ("steer" in lower or "caster" in lower)


def middle_angle(angles: Sequence[float]) -> float:
    """Return the angle in the middle of a steered axle, from the angles of its wheels (rad).

    The wheels of an Ackermann axle point to a common centre of rotation. Their cotangents are
    linear along the axle, so the cotangent in the middle is the mean.
    """
    if min(map(abs, angles)) < _SMALL_ANGLE:
        return fmean(angles)
    cotangent = fmean(1.0 / math.tan(angle) for angle in angles)
    return math.atan(1.0 / cotangent) if cotangent else fmean(angles)
