"""Progress of a session towards its goal, as a part of its result."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from hand_eye_calib.core.base.text import ABOUT
from hand_eye_calib.core.results.records import AXES

# Names of the six axes on topics. The Euler angles of a printed pose are roll, pitch and yaw.
AXIS_KEYS = {
    axis: f"about_{ABOUT[axis]}" if axis in ABOUT else axis for axis in AXES
}


@dataclass(frozen=True, kw_only=True)
class AxisProgress:
    """Progress of one axis towards its target.

    Attributes
    ----------
    sigma : float
        Standard deviation with the allowance (m or rad).
    target : float
        Target of the standard deviation (m or rad).
    seconds_left : float
        Time (s) until the target is reached if the motion continues like this. Infinite if the
        motion does not observe the axis.
    """

    sigma: float
    target: float
    seconds_left: float


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Progress of a session towards its goal.

    Attributes
    ----------
    sentence : str
        Next action of the person who moves the robot.
    done : bool
        Whether the goal is reached.
    seconds_left : float
        Time (s) until the goal is reached if the motion continues like this, in coarse steps.
        Infinite if unknown.
    precision : str
        Precision of the best result, in words; empty before the goal is reached.
    is_faulty : bool
        Whether the streams have faults that make a calibration impossible.
    limiting_axis : str
        Name, from ``AXIS_KEYS``, of the axis that is farthest from its target. Empty without a
        result, or if every axis is within its target.
    will_not_get_there : bool
        Whether more of the present motion cannot bring the limiting axis to its target.
    target_is_too_small : bool
        Whether the allowance for constant errors alone exceeds the target of the limiting axis.
    by_hand : tuple of str
        Axes x, y, z that a person may measure by hand, because the present motion hides them.
    axes : mapping of str to AxisProgress
        Progress of each axis; the keys are the values of ``AXIS_KEYS``.
    """

    sentence: str
    done: bool = False
    seconds_left: float = math.inf
    precision: str = ""
    is_faulty: bool = False
    limiting_axis: str = ""
    will_not_get_there: bool = False
    target_is_too_small: bool = False
    by_hand: tuple[str, ...] = ()
    axes: Mapping[str, AxisProgress] = field(default_factory=dict)


def details(goal: Progress, result: object) -> list[str]:
    """Return the lines about the session that the terminal prints with a result."""
    if goal.done:
        return [f"the session reached its goal: {goal.precision}"]
    return [f"the session: {goal.sentence}"]
