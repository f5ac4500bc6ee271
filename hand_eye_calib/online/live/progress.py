"""How far a session is from its goal, as a part of its result."""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class AxisProgress:
    """One axis against its target, m or rad, and the seconds of motion like that so far until it is
    known: infinite if it is unobservable.
    """

    sigma: float
    target: float
    seconds_left: float


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a session is from its goal.

    Attributes
    ----------
    sentence : str
        What to do now, for a person next to the robot.
    done : bool
    is_faulty : bool
        The streams cannot be calibrated with.
    limiting_axis : str
        The axis that is farthest from its target; empty if there is none, or no result.
    will_not_get_there : bool
        More of this motion is of no use for the limiting axis.
    axes : mapping of str to AxisProgress
    """

    sentence: str
    done: bool = False
    is_faulty: bool = False
    limiting_axis: str = ""
    will_not_get_there: bool = False
    axes: Mapping[str, AxisProgress] = field(default_factory=dict)


def details(goal: Progress, headline: str) -> list[str]:
    """Return a line about the session, for a person."""
    return [f"the session: {goal.sentence}"]
