"""State of the node as one document.

The node publishes the state as JSON. ``/diagnostics`` and ``watch`` use the same state. All values
are in SI units, and None means unknown. Mappings by axis have the keys x, y, z, about_x, about_y
and about_z. Mappings of a printed pose have roll, pitch and yaw instead of the last three.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import NamedTuple, TypeAlias

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.plain import plain
from hand_eye_calib.core.results.context import Comparison
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.online.live.progress import AXIS_KEYS, Progress

# Period (s) at which the node publishes its state.
REPORT_PERIOD_S = 1.0

# Longest time (s) for which the stopping node waits for a disk, a running solve or a slow
# subscriber.
GRACE_S = 0.4

# Time (s) within which a request for a solve is answered, even on a busy computer.
ANSWER_WITHIN_S = 20.0

AxisValues: TypeAlias = Mapping[str, float | None]


def as_printed(values: FloatArray) -> AxisValues:
    """Return x, y, z, roll, pitch, yaw (6,) by name. A value that is not finite becomes None."""
    return dict(zip(AXES, plain(values), strict=True))


def by_axis(values: FloatArray) -> AxisValues:
    """Return values (6,) along and about the axes; None for a value that is not finite."""
    return dict(zip(AXIS_KEYS.values(), plain(values), strict=True))


class Level(IntEnum):
    """Level of diagnostic_msgs/DiagnosticStatus.

    WARN: a person should act. ERROR: something is broken.
    """

    OK = 0
    WARN = 1
    ERROR = 2


class Broadcast(Enum):
    """Whether the result is broadcast on ``/tf_static``."""

    OFF = "off"
    WAITING = "not yet"
    ON = "broadcast"
    WITHDRAWN = "withdrawn"
    REFUSED = "refused"


# Level of a condition of the node, and a line of text about the condition.
Condition: TypeAlias = tuple[Level, str]

# Whether the result is broadcast; if not, the reason.
BroadcastState: TypeAlias = tuple[Broadcast, str]

# Success of a request and a line of text about it.
Outcome: TypeAlias = tuple[bool, str]


class Standing(Enum):
    """Validity of the session's result.

    OUTDATED: all solves after this result have failed. REFUTED: the motion contradicts a prior, or
    the streams are faulty; such a result is not published.
    """

    NONE = "none"
    CURRENT = "current"
    OUTDATED = "outdated"
    REFUTED = "refuted"


@dataclass(frozen=True, kw_only=True)
class Part:
    """Part of the node: its condition in words, and whether a person should act."""

    level: Level
    text: str


@dataclass(frozen=True, kw_only=True)
class ResultState:
    """The session's result.

    Attributes
    ----------
    pose, pose_sigma : mapping of str to float or None
        x, y, z (m), roll, pitch, yaw (rad) as printed, and standard deviations. None for an axis
        that is not determined.
    facts : tuple of str
        Short sentences about the evidence, such as the smallest error that would have been noticed.
    angles : str
        Sentence about angles whose certainty differs from that of the rotation; empty without any.
    caution, step : str
        The gravest reason for the verdict and the next step, in a few words; empty for ``USE``.
    age_s : float
        Time since the solve (s).
    """

    parent_frame: str
    child_frame: str
    verdict: str
    status: str
    reasons: tuple[str, ...]
    warnings: tuple[str, ...]
    pose: AxisValues
    pose_sigma: AxisValues
    n_poses: int
    time_offset_s: float
    scale: float
    age_s: float
    facts: tuple[str, ...] = ()
    angles: str = ""
    caution: str = ""
    step: str = ""


@dataclass(frozen=True, kw_only=True)
class ExtrinsicState(Part):
    """Solver, motion of the session, and result.

    Attributes
    ----------
    is_solving : bool
        Whether a solve is running.
    slow : str
        Sentence about slow solves with the reason; empty if solves are fast.
    n_poses : int
        Number of synchronised pose pairs.
    path_m : float
        Length of the path (m).
    motion_s : float
        Time for which the sensors have moved (s).
    has_vehicle_axes : bool
        Whether the parent sensor moves along its x axis and turns about its z axis, as on a vehicle
        (REP 103).
    rotation_deg : mapping of str to float
        Rotation of the parent sensor about x, y and z (deg).
    tf_static, tf_static_reason
        Whether the result is broadcast; if not, the reason.
    standing : Standing
        Validity of the result.
    problem : str
        Reason why the result is outdated or refuted; empty otherwise.
    priors : mapping of str to str
        Priors that are set, by axis, as typed by the user.
    contradicted : tuple of str
        Axes whose prior the motion contradicts.
    result : ResultState or None
    """

    is_solving: bool
    slow: str = ""
    n_poses: int
    path_m: float
    motion_s: float = 0.0
    has_vehicle_axes: bool = False
    rotation_deg: Mapping[str, float]
    tf_static: Broadcast
    tf_static_reason: str
    standing: Standing = Standing.CURRENT
    problem: str = ""
    priors: Mapping[str, str] = field(default_factory=dict)
    contradicted: tuple[str, ...] = ()
    result: ResultState | None


@dataclass(frozen=True, kw_only=True)
class ProgressState(Part):
    """Progress of the session towards its goal; the text is what a person should do next.

    Attributes
    ----------
    is_paused : bool
        Whether no poses arrive although the goal is not reached.
    progress : Progress
        Standard deviations are along and about the axes of the parent sensor's frame.
    comparison : Comparison or None
        Comparison of the result with the installed transform. If it is not possible yet, it has a
        sentence with the reason only. None if no comparison is requested.
    """

    is_paused: bool = False
    progress: Progress
    comparison: Comparison | None


class InputCondition(NamedTuple):
    """Fields of an :class:`InputState` that depend on the messages."""

    level: Level
    text: str
    step: str = ""
    needs_reset: bool = False


@dataclass(frozen=True, kw_only=True)
class InputState(Part):
    """The messages of one input.

    Attributes
    ----------
    messages, poses_taken : int
        Number of received messages, and of poses that the engine has accepted.
    refused : mapping of str to int
        Number of refused messages, by reason.
    lost : int or None
        Number of published messages that never arrived; None if the middleware does not number
        messages.
    longest_gap_s : float
        Longest interval between two stamps (s).
    publishers : int or None
        Number of publishers of the topic; None for transforms.
    is_paused : bool
        Whether poses have arrived in this session, but no longer arrive.
    silent_s : float or None
        Time since the last pose (s); None before the first pose of the session.
    step : str
        What a person should do, as a sentence; empty if the text contains it.
    needs_reset : bool
        Whether the session has poses of several publishers. Only a reset removes them.
    """

    topic: str
    rate_hz: float
    messages: int
    poses_taken: int
    refused: Mapping[str, int]
    lost: int | None
    longest_gap_s: float
    publishers: int | None = None
    is_paused: bool = False
    silent_s: float | None = None
    step: str = ""
    needs_reset: bool = False


@dataclass(frozen=True, kw_only=True)
class ChecksState(Part):
    """Findings of the stream checks.

    Attributes
    ----------
    age_s : float or None
        Age of the last check (s); None before the first check.
    findings : tuple of str
    gravest : str
        The gravest relevant finding, without cause and remedy; empty if there is none.
    step : str
        Next action of a person, as a sentence.
    needs_reset : bool
        Whether the session keeps the fault until it is reset.
    """

    age_s: float | None = None
    findings: tuple[str, ...] = ()
    gravest: str = ""
    step: str = ""
    needs_reset: bool = False


@dataclass(frozen=True, kw_only=True)
class JournalState(Part):
    """The journal on disk, from which a session continues after a crash.

    Attributes
    ----------
    directory : str
        Directory of the journal; empty without a journal.
    """

    directory: str


@dataclass(frozen=True, kw_only=True)
class MountState(Part):
    """Mount that is monitored for a shift of the child sensor.

    Attributes
    ----------
    is_learning : bool
        Whether the monitor still measures the noise of the streams, and cannot detect a shift.
    seconds_of_motion : int
        Time for which the sensors have moved (s).
    shift, shift_sigma : mapping of str to float or None
        Shift that the alarm reports, and its standard deviation, by axis (m, rad).
    visible_10min : mapping of str to float or None
        Smallest shift that ten minutes of motion would detect, by axis (m, rad); None if no shift
        would be detected.
    since_ns : int or None
        Stamp at which the shift began (ns).
    newest_ns : int or None
        Stamp of the newest motion (ns).
    """

    is_learning: bool = False
    seconds_of_motion: int = 0
    shift: AxisValues = field(default_factory=dict)
    shift_sigma: AxisValues = field(default_factory=dict)
    visible_10min: AxisValues = field(default_factory=dict)
    since_ns: int | None = None
    newest_ns: int | None = None


@dataclass(frozen=True, kw_only=True)
class SavedState:
    """A saved result.

    Attributes
    ----------
    directory : str
    at_s : float
        Time of the save, in seconds since 1970 (Unix time).
    text : str
        Headline of the result, with the reason if the result is outdated.
    verdict : str
    """

    directory: str
    at_s: float
    text: str
    verdict: str = ""


@dataclass(frozen=True, kw_only=True)
class NodeState:
    """The whole state of the node.

    A node that monitors the mount has ``mount``. Any other node has ``extrinsic``, ``progress``,
    ``checks`` and ``journal``.

    Attributes
    ----------
    node : str
        Fully qualified name of the node.
    inputs : mapping of str to InputState
        State of each input, by name: parent, child, child2 and so on.
    saved : SavedState or None
        Newest save of the session.
    has_ended : bool
        Whether the node ends, so that this is its last state.
    can_save : bool
        Whether the node has an output directory.
    headline : str
        First action of a person. ``watch`` and the log contain the same text.
    """

    node: str
    extrinsic: ExtrinsicState | None = None
    progress: ProgressState | None = None
    mount: MountState | None = None
    inputs: Mapping[str, InputState] = field(default_factory=dict)
    checks: ChecksState | None = None
    journal: JournalState | None = None
    saved: SavedState | None = None
    has_ended: bool = False
    can_save: bool = True
    headline: str = ""

    @property
    def result(self) -> ResultState | None:
        """The session's result, or None."""
        return self.extrinsic.result if self.extrinsic else None

    @property
    def standing(self) -> Standing:
        """Validity of the session's result."""
        return self.extrinsic.standing if self.extrinsic else Standing.NONE

    def parts(self) -> Iterator[tuple[str, Part]]:
        """Yield the parts that the node has, and their names on ``/diagnostics``."""
        parts = {
            "extrinsic": self.extrinsic,
            "progress": self.progress,
            "mount": self.mount,
            **{f"{name} input": state for name, state in self.inputs.items()},
            "stream checks": self.checks,
            "journal": self.journal,
        }
        for name, part in parts.items():
            if part is not None:
                yield name, part
