"""Progress of a session towards its goal, as a part of its result."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from hand_eye_calib.core.base.text import ABOUT
from hand_eye_calib.core.results.records import AXES

# Names of the six axes on topics. The Euler angles of a printed pose are roll, pitch and yaw.
AXIS_KEYS = {axis: f"about_{ABOUT[axis]}" if axis in ABOUT else axis for axis in AXES}


@dataclass(frozen=True, kw_only=True)
class AxisProgress:
    """Progress of one axis towards its target.

    Attributes
    ----------
    sigma : float
        Standard deviation with the allowance (m or rad).
    target : float
        Standard deviation that is wanted (m or rad).
    seconds_left : float
        Time of similar motion until the target is reached (s); infinite if the motion does not
        observe the axis.
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
        Next step of the person who moves the robot.
    done : bool
        Whether the goal is reached.
    seconds_left : float
        Time of similar motion until the goal is reached (s), in coarse steps; infinite if unknown.
    precision : str
        Precision of the best result, in words; empty before the goal is reached.
    is_faulty : bool
        Whether the streams have faults that make a calibration impossible.
    limiting_axis : str
        Of ``AXIS_KEYS``: the axis that is farthest from its target; empty if every axis is within
        its target, or without a result.
    will_not_get_there : bool
        Whether more of the present motion is useless for the limiting axis.
    target_is_too_small : bool
        Whether the allowance for constant errors alone exceeds the target of the limiting axis.
    axes : mapping of str to AxisProgress
        By ``AXIS_KEYS``.
    """

    sentence: str
    done: bool = False
    seconds_left: float = math.inf
    precision: str = ""
    is_faulty: bool = False
    limiting_axis: str = ""
    will_not_get_there: bool = False
    target_is_too_small: bool = False
    axes: Mapping[str, AxisProgress] = field(default_factory=dict)


def details(goal: Progress, result: object) -> list[str]:
    """Return a line about the session of a result, for a person."""
    return [f"the session: {goal.sentence}"]
