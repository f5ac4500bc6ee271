"""The state of the node as one document: published as JSON, and the source of ``/diagnostics`` and
of what ``watch`` shows.

All values are in SI units. Mappings by axis have x, y, z, roll, pitch and yaw; None stands for what
is not known.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum, IntEnum

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.plain import plain
from hand_eye_calib.core.results.context import Comparison
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.online.live.progress import Progress

# The node says how it is so often (s). A disk, a solve under way and who listens may each hold up
# its end for so long (s).
REPORT_PERIOD_S = 1.0
GRACE_S = 0.4

# Who asks for a solve has an answer within so long (s), also where others use the processor.
ANSWER_WITHIN_S = 20.0

AxisValues = Mapping[str, float | None]


def by_axis(values: FloatArray) -> AxisValues:
    """Values (6,) by axis."""
    return dict(zip(AXES, plain(values), strict=True))


class Level(IntEnum):
    """As of diagnostic_msgs/DiagnosticStatus: WARN if a person should act, ERROR if something is
    broken.
    """

    OK = 0
    WARN = 1
    ERROR = 2


class Broadcast(Enum):
    """What is done about ``/tf_static``."""

    OFF = "off"
    WAITING = "not yet"
    ON = "broadcast"
    REFUSED = "refused"


class Standing(Enum):
    """Whether the session's result still holds.

    OUTDATED: every solve since has failed. REFUTED: the motion contradicts a prior, or the streams
    are faulty; such a result is not published.
    """

    NONE = "none"
    CURRENT = "current"
    OUTDATED = "outdated"
    REFUTED = "refuted"


@dataclass(frozen=True, kw_only=True)
class Part:
    """One part of the node: what it says, and whether a person should act."""

    level: Level
    text: str


@dataclass(frozen=True, kw_only=True)
class ResultState:
    """The session's result. ``pose`` has x, y, z (m), roll, pitch, yaw (rad) as they are printed,
    None if an axis is not determined.
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


@dataclass(frozen=True, kw_only=True)
class ExtrinsicState(Part):
    """The solver, what has been seen of the motion, and the result if there is one. The sensors
    moved for ``motion_s``; ``has_vehicle_axes`` if the parent sensor moves along its x and turns
    about its z, as on a vehicle (REP 103). ``problem`` is why the result is outdated or refuted.
    ``priors`` are the priors that are set, by axis; ``contradicted`` are the axes of those that the
    motion contradicts.
    """

    is_solving: bool
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
    """How far the session is from its goal; the text says what to do now. Standard deviations are
    along and about the axes of the parent sensor's frame. The session is paused while poses do not
    come in, before its goal. The comparison of the result with what is installed is only a sentence
    while it cannot be made.
    """

    is_paused: bool = False
    progress: Progress
    comparison: Comparison | None


@dataclass(frozen=True, kw_only=True)
class InputState(Part):
    """What an input has delivered. ``lost`` messages were published and never arrived, None if the
    middleware does not tell. ``publishers`` of its topic are there, None for transforms. The input
    is paused if it has delivered poses, but none for ``silent_s``.
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


@dataclass(frozen=True, kw_only=True)
class ChecksState(Part):
    """Findings of the stream checks; ``age_s`` is None before the first one."""

    age_s: float | None = None
    findings: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class JournalState(Part):
    """Whether a crash would lose the session."""

    directory: str


@dataclass(frozen=True, kw_only=True)
class MountState(Part):
    """A mount that is watched: the alarm's shift since a stamp, and the shift that ten minutes of
    motion would show, None if none would.
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
    """Where the result was saved, when (seconds since 1970), its headline and its verdict."""

    directory: str
    at_s: float
    text: str
    verdict: str = ""


@dataclass(frozen=True, kw_only=True)
class NodeState:
    """Everything that the node, by its fully qualified name, says of itself. A node that watches
    the mount has no result, progress, checks and journal, and only it has a mount. The inputs are
    by name: parent, child, child2 and so on. ``saved`` is the newest save of the session.
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

    @property
    def result(self) -> ResultState | None:
        """The session's result; None without one."""
        return self.extrinsic.result if self.extrinsic else None

    @property
    def standing(self) -> Standing:
        """Validity of the session's result."""
        return self.extrinsic.standing if self.extrinsic else Standing.NONE

    def parts(self) -> Iterator[tuple[str, Part]]:
        """The parts that there are, by the names that ``/diagnostics`` has for them."""
        before = {"extrinsic": self.extrinsic, "progress": self.progress, "mount": self.mount}
        after = {"stream checks": self.checks, "journal": self.journal}
        inputs = {f"{name} input": each for name, each in self.inputs.items()}
        for name, part in (before | inputs | after).items():
            if part is not None:
                yield name, part
