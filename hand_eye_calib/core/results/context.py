"""What only some calibrations have: other recordings, the goal of the session, what is installed, a
bias of rates.

All are plain values under names, as in :mod:`hand_eye_calib.core.results.records`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class RateBias:
    """Bias of angular rates, in the axes of the sensor that has it (``of``), rad/s."""

    of: str
    rad_per_s: tuple[float, ...]
    sigma: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """One of several recordings, as it stands by itself and beside the others.

    Attributes
    ----------
    name, headline : str
    left_out : str
        Why it is no part of the result; empty if it is.
    deviations, sigmas : mapping of str to float
        By axis, m or rad: from the common result, and their standard deviations with the usual
        scatter of recordings; NaN (None in files) if it does not know the axis.
    time_offset_s, scale, stamp_ns
        As of its own result.
    """

    name: str
    headline: str
    left_out: str = ""
    deviations: Mapping[str, float] = field(default_factory=dict)
    sigmas: Mapping[str, float] = field(default_factory=dict)
    time_offset_s: float = 0.0
    scale: float = 1.0
    stamp_ns: int = 0


@dataclass(frozen=True, kw_only=True)
class Together:
    """What several recordings of one rig say together.

    Attributes
    ----------
    kind : str
        single, agree, scatter (more than recordings of one rig do), one off, moved (between two of
        them), or differ (two do, and nobody knows which is wrong).
    sentence : str
    scatter : mapping of str to float
        By axis, m or rad: what differs from recording to recording, beyond what each states.
    recordings : tuple of Recorded
        In the order of time.
    """

    kind: str
    sentence: str
    scatter: Mapping[str, float]
    recordings: tuple[Recorded, ...]


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


@dataclass(frozen=True)
class AxisDifference:
    """Difference on one axis (m, rad), its standard deviation (infinite if unknown), the change
    that would have been seen nine times out of ten, and the verdict: same, moved or cannot tell.
    """

    difference: float
    sigma: float
    visible: float
    verdict: str


@dataclass(frozen=True, kw_only=True)
class Difference:
    """How an extrinsic differs from another, axis by axis: ``second`` minus ``first``."""

    first: str
    second: str
    verdict: str
    sentence: str
    axes: Mapping[str, AxisDifference]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Comparison of a result with what is installed: where that comes from, its ``values`` by axis
    (m, rad), and the differences.
    """

    sentence: str
    verdict: str = ""
    installed: str = ""
    values: Mapping[str, float] = field(default_factory=dict)
    moved: tuple[str, ...] = ()
    differences: tuple[Difference, ...] = ()
