"""One input of the session: counts its messages, judges their stamps, hands the poses over.

Stamps tell corrupt ones from gaps, late messages, bags that loop and clocks that were reset. A
message near one of those taken last is taken at once. Any other waits: six that follow each other
are a real change, a gap or a jump of the clock. Fewer, before the stream goes on where it was, have
corrupt stamps and are dropped.
"""

import itertools
import math
import statistics
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.base.config import STAMP_UNITS, CalibratorConfig
from hand_eye_calib.core.base.errors import HandEyeCalibError, NoPoseError
from hand_eye_calib.core.base.text import MUCH_NULL, listing, share
from hand_eye_calib.core.engine.calibrator import StreamStatistics
from hand_eye_calib.core.geometry.frames import check_not_null
from hand_eye_calib.formats.transforms import PoseFields
from hand_eye_calib.online.live.log import GOES_ON_S, NodeLog
from hand_eye_calib.online.live.session import LiveSession
from hand_eye_calib.online.live.state import REPORT_PERIOD_S, InputState, Level

# Share of lost messages from which on somebody should look.
_MUCH_LOST = 0.01
# Share of repeated stamps from which on the stamps are of no use, and fewest messages to judge.
_MUCH_REPEATED = 0.5
_FEWEST_TO_JUDGE = 20
# Reports, one a second, over which rates and shares are taken, and a bad message is reported.
_REPORTS = 10

# So many messages that follow each other are believed: more than corrupt ones come together.
WITNESSES = 6

# Near another message: within so much (ns), or so many periods. A real change farther back is a
# jump of the clock, and a new session. Messages that wait follow each other within the longest
# pause (ns).
NEAR_NS = 1_000_000_000
_PERIODS = 5
_LONGEST_PAUSE_NS = 60_000_000_000

# A stream is silent after so long (s). After one has jumped back, the others' messages of before
# are left out for as long.
SILENT_AFTER_S = 2.0

# A session is paused after so long (s), or so many periods of the stream, without a pose.
PAUSED_AFTER_S = 5.0
PAUSED_PERIODS = 5

Stamped = tuple[int, Any]

_STAMP_IS_0 = "its stamp is 0: have its publisher set header.stamp"


class Judgement(NamedTuple):
    """What a message has brought about: stamps and messages to be used now, of which some have
    waited; corrupt stamps of messages that are not to be used; whether those to be used are the
    first of a new session; the stamp of a message that repeats the one before, which waits.
    """

    taken: Sequence[Stamped] = ()
    dropped: Sequence[int] = ()
    jumped_back: bool = False
    repeated: Sequence[int] = ()


class StampGuard:
    """Watches the stamps of one stream; ``last_ns`` is the newest one taken in the session, None
    if there is none.
    """

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self._outdated_until_s = -math.inf
        self.last_ns: int | None = None
        # Those taken last: corrupt ones come WITNESSES - 1 together, and are never half of these.
        self._recent_ns: deque[int] = deque(maxlen=2 * WITNESSES - 1)
        self._held: list[Stamped] = []

    def check(self, stamp_ns: int, message: Any, now_s: float) -> Judgement:
        """Judge the next message; ``now_s`` is steady time."""
        if self._is_near(stamp_ns):
            if now_s < self._outdated_until_s:
                return Judgement()
            return Judgement(self._take([(stamp_ns, message)]), self._drop_held())
        dropped = []
        if self._held and stamp_ns == self._held[-1][0]:
            return Judgement(repeated=[stamp_ns])
        if self._held and not 0 < abs(stamp_ns - self._held[-1][0]) <= _LONGEST_PAUSE_NS:
            dropped = self._drop_held()
        self._held.append((stamp_ns, message))
        judgement = self._believe(now_s) if len(self._held) >= WITNESSES else Judgement()
        return judgement._replace(dropped=dropped)

    def restart(self, now_s: float | None = None) -> None:
        """Begin a new session; with ``now_s`` (steady time) as another stream has jumped back."""
        if now_s is None:
            self._begin()
        elif self.last_ns is not None:
            self._outdated_until_s = now_s + SILENT_AFTER_S
            self._outdated_until_s += 2 * WITNESSES * self.period_ns() * 1e-9

    def resume(self, last_ns: int | None) -> None:
        """Go on with a session whose newest stamp this is."""
        self.last_ns = last_ns
        if last_ns is not None:
            self._recent_ns.append(last_ns)

    def period_ns(self) -> float:
        """Median interval of the messages taken last."""
        intervals = [late - early for early, late in itertools.pairwise(sorted(self._recent_ns))]
        return statistics.median(intervals) if intervals else 0.0

    def _is_near(self, stamp_ns: int) -> bool:
        apart_ns = min((abs(stamp_ns - each) for each in self._recent_ns), default=math.inf)
        return apart_ns <= NEAR_NS or apart_ns <= _PERIODS * self.period_ns()

    def _take(self, messages: list[Stamped]) -> list[Stamped]:
        stamps_ns = [stamp_ns for stamp_ns, _ in messages]
        self._recent_ns.extend(stamps_ns)
        self.last_ns = max(stamps_ns if self.last_ns is None else [self.last_ns, *stamps_ns])
        return messages

    def _drop_held(self) -> list[int]:
        """Drop the messages that wait; returns their stamps."""
        dropped = [stamp_ns for stamp_ns, _ in self._held]
        self._held = []
        return dropped

    def _believe(self, now_s: float) -> Judgement:
        """Take the messages that wait."""
        members = self._held
        self._held = []
        before_ns = statistics.median_low(self._recent_ns or [members[0][0]])
        jumped = members[0][0] < before_ns - NEAR_NS
        follows = now_s < self._outdated_until_s
        self._outdated_until_s = -math.inf
        if jumped:
            self._begin()
        return Judgement(self._take(members), jumped_back=jumped and not follows)


class PoseInput:
    """Hands the poses of one sensor to the session, wherever they come from.

    Parameters
    ----------
    name : str
        "parent", "child", or one of :func:`~hand_eye_calib.core.base.config.other_names`.
    topic : str
        Where they come from, for messages.
    session : LiveSession
    log : NodeLog
    on_jump_back : callable
        Called with this input when its stamps have jumped back: a new session has to begin.

    Attributes
    ----------
    is_enabled : bool
        Whether poses are taken.
    problem : str
        Why there is none; empty if that is not known.
    publishers : tuple of str or None
        Names of the nodes that publish on the topic, one for each publisher; None for transforms.
    """

    def __init__(
        self,
        name: str,
        topic: str,
        session: LiveSession,
        log: NodeLog,
        on_jump_back: Callable[["PoseInput"], None],
    ) -> None:
        self.name = name
        self.topic = topic
        self.is_enabled = True
        self.problem = ""
        self._sensor_frame = ""
        self._world_frame = ""
        self._guard = StampGuard()
        self._refused = Counter[str]()
        self._session = session
        self._log = log
        self._on_jump_back = on_jump_back
        self._wanted = "auto"
        self._arrived = 0
        self._lost = 0
        self._null = 0
        self._next_number: int | None = None
        self._arrived_s: float | None = None
        self._taken_s: float | None = None
        self.publishers: tuple[str, ...] | None = None
        self._bad = ""
        self._bad_at_s = -np.inf
        self._counts = deque([(time.monotonic(), 0, 0, 0)], maxlen=_REPORTS + 1)
        self._last_stamp_ns: int | None = None
        self._longest_gap_ns = 0
        self._is_new = True

    @property
    def has_poses(self) -> bool:
        """Whether there was a pose in this session."""
        return self._guard.last_ns is not None

    def configure(self, config: CalibratorConfig) -> None:
        """Follow the options."""
        self._wanted = getattr(config, f"{self.name}_measures", "auto")

    def restart(self, because_of: "PoseInput | None") -> None:
        """Begin a new session: asked for, or because the stamps of an input have jumped back."""
        self._sensor_frame = ""
        self._world_frame = ""
        self._last_stamp_ns = None
        self._longest_gap_ns = 0
        self._taken_s = None
        self._is_new = because_of is None
        if because_of is None:
            self._guard.restart()
        elif because_of is not self:
            self._guard.restart(time.monotonic())

    def resume(self) -> None:
        """Go on where a session on disk has ended."""
        self._guard.resume(self._session.engines.statistics(self.name).last_stamp_ns)

    # -------------------------------------------------------------- messages

    def count(self, sequence_number: int | None) -> None:
        """Count the lost messages before one with this number of its publisher; None if nothing is
        known of them: there are several publishers, or the middleware gives no numbers.
        """
        expected = self._next_number
        number = sequence_number
        self._next_number = None if number is None else number + 1
        if expected is not None and number is not None:  # less: the publisher was started again
            self._lost += max(number - expected, 0)

    def accept(self, stamp_ns: int, read: Callable[[], PoseFields]) -> None:
        """Take a message; it is read when its stamp is believed."""
        self._arrived = self._arrived + 1
        self._arrived_s = time.monotonic()
        if not self.is_enabled:
            return
        if self._last_stamp_ns is not None:
            self._longest_gap_ns = max(self._longest_gap_ns, stamp_ns - self._last_stamp_ns)
        self._last_stamp_ns = stamp_ns
        last_ns = self._guard.last_ns
        judgement = self._guard.check(stamp_ns, read, self._arrived_s)
        if judgement.jumped_back:
            jump_s = ((last_ns or 0) - judgement.taken[0][0]) * 1e-9
            self._log.warning(
                f"{self.topic} jumped back by {jump_s:.3f} s (a bag that loops? a clock that was "
                "reset?): new session, earlier poses forgotten"
            )
            self._on_jump_back(self)
        self._use(judgement)

    def refuse(self, which: str, reason: str, text: str) -> None:
        """Count a message that cannot be used, and say why."""
        self._refused[reason] += 1
        self._bad = text
        self._bad_at_s = time.monotonic()
        self._log.warning(f"{self.topic}: a message is refused: {text}")
        self._log.debug(f"{self.topic}: message {which} refused: {text}")

    def leave_out(self, which: str, reason: NoPoseError) -> None:
        """Count a message that states that it has no pose, as of a tracker that is lost."""
        self._refused["no pose"] += 1
        self._null += 1
        self._log.debug(f"{self.topic}: message {which} is left out: {reason}")

    def _use(self, judgement: Judgement) -> None:
        for stamp_ns in judgement.dropped:
            text = "its stamp does not fit those before and after it"
            text = text if stamp_ns else _STAMP_IS_0
            self.refuse(with_stamp(stamp_ns), "corrupt stamp", text)
        for stamp_ns in judgement.repeated:
            text = repeated_stamps(stamp_ns) if stamp_ns else _STAMP_IS_0
            self.refuse(with_stamp(stamp_ns), "corrupt stamp", text)
        for stamp_ns, read in judgement.taken:
            try:
                pose = read()
                has_new_frame = pose.sensor_frame not in (None, self._sensor_frame)
                if has_new_frame or pose.world_frame != self._world_frame:
                    check_not_null(*pose.position, *pose.quat_xyzw)  # whose frames mean nothing
                # An empty name is the one before, too: parameters or a default name it.
                if has_new_frame:
                    self._session.engines.set_frame(self.name, pose.sensor_frame)
                    self._sensor_frame = pose.sensor_frame
                if pose.world_frame != self._world_frame:
                    self._session.engines.set_world(self.name, pose.world_frame)
                    self._world_frame = pose.world_frame
                fields = self.name, stamp_ns, pose.position, pose.quat_xyzw
                if not self._session.engines.add_pose(*fields):
                    which = with_stamp(stamp_ns)
                    self._log.debug(f"{self.topic}: message {which} is repeated or too late")
                    continue
                self._taken_s = self._arrived_s
                if self._session.journal is not None:
                    self._session.journal.poses.append(fields)
            except NoPoseError as error:
                self.leave_out(with_stamp(stamp_ns), error)
            except HandEyeCalibError as error:
                self.refuse(with_stamp(stamp_ns), "unusable", str(error))
        if judgement.taken and self._is_new:
            self._is_new = False
            first_s = judgement.taken[0][0] * 1e-9
            self._log.info(f"first pose on {self.topic}, stamp {first_s:.3f} s")

    # ----------------------------------------------------------------- state

    def is_silent(self, steady_s: float) -> bool:
        """Whether messages have come, but not lately."""
        return self._arrived_s is not None and steady_s - self._arrived_s > SILENT_AFTER_S

    def silent_s(self, steady_s: float) -> float | None:
        """Seconds without a pose; None before the first of the session."""
        return None if self._taken_s is None else steady_s - self._taken_s

    def is_paused(self, steady_s: float) -> bool:
        """Whether poses were taken, but none for long."""
        silent_s = self.silent_s(steady_s)
        if silent_s is None or not self.is_enabled:
            return False
        return silent_s > max(PAUSED_AFTER_S, PAUSED_PERIODS * self._guard.period_ns() * 1e-9)

    def state(self, steady_s: float, may_rest: bool) -> InputState:
        """What has come in; to be called once a second or oftener. ``may_rest`` if silence is
        nothing to look at: there is a result, and the other input is silent too.
        """
        now = steady_s, self._arrived, self._lost, self._null
        seconds, arrived, lost, null = np.subtract(now, self._counts[0]).tolist()
        if steady_s - self._counts[-1][0] > REPORT_PERIOD_S / 2:
            self._counts.append(now)
        rate_hz = arrived / seconds if seconds > 0 else 0.0
        lost_share = lost / max(arrived + lost, 1)
        null_share = null / max(arrived, 1)
        level, text = self._judge(steady_s, rate_hz, lost_share, may_rest)
        taken = self._session.engines.statistics(self.name)
        if level is Level.OK and (advice := self._advice(null_share, taken)):
            self._log.warning(f"{self.topic}: {advice}")
            level = Level.WARN
            text = f"{text}; {advice}"
        refused = {"repeated stamp": taken.refused_duplicate, "too late": taken.refused_late}
        return InputState(
            level=level,
            text=text,
            topic=self.topic,
            rate_hz=rate_hz,
            messages=self._arrived,
            poses_taken=taken.received,
            refused=refused | dict(sorted(self._refused.items())),
            lost=None if self._next_number is None else self._lost,
            longest_gap_s=self._longest_gap_ns * 1e-9,
            publishers=None if self.publishers is None else len(self.publishers),
            is_paused=self.is_paused(steady_s),
            silent_s=self.silent_s(steady_s),
        )

    def _advice(self, null_share: float, taken: StreamStatistics) -> str:
        """Return what to do about messages without a pose or a stamp of their own; or nothing."""
        if null_share > MUCH_NULL:
            return (
                f"{share(null_share)} of the messages have no pose (null, not finite or without a "
                "fix): see whether the source loses track"
            )
        n_taken = taken.received
        n_repeated = taken.refused_duplicate
        if n_repeated + n_taken < _FEWEST_TO_JUDGE:
            return ""
        if n_repeated <= _MUCH_REPEATED * (n_repeated + n_taken):
            return ""
        return repeated_stamps(taken.last_stamp_ns or 0)

    def _judge(
        self, steady_s: float, rate_hz: float, lost_share: float, may_rest: bool
    ) -> tuple[Level, str]:
        if self._arrived_s is None:
            text = f"no message on {self.topic} yet"
            return Level.WARN, ": ".join(filter(None, [text, self.problem]))
        if steady_s - self._bad_at_s < _REPORTS:
            return Level.ERROR, f"{self.topic}: {self._bad}"
        if text := self._why_paused(steady_s):
            if not may_rest:
                self._log.info(text, GOES_ON_S)
            return (Level.OK if may_rest else Level.WARN), text
        if self.publishers is not None and len(self.publishers) > 1:
            text = self._several()
            self._log.warning(text)
            return Level.WARN, text
        if lost_share < _MUCH_LOST:
            return Level.OK, f"{rate_hz:.1f} Hz"
        advice = "give the node more processor time, or publish at a lower rate"
        text = f"{lost_share:.1%} of the messages are lost: {advice}"
        self._log.warning(f"{self.topic}: {text}")
        return Level.WARN, f"{rate_hz:.1f} Hz; {text}"

    def _why_paused(self, steady_s: float) -> str:
        """Why no poses come in any more; empty if they do, or if that is not known yet."""
        if self._taken_s is not None and not self.is_paused(steady_s):
            return ""
        arrived_s = math.inf if self._arrived_s is None else steady_s - self._arrived_s
        if arrived_s > PAUSED_AFTER_S:
            text = f"{self.topic} has been silent for {arrived_s:.0f} s"
            return text if self.publishers != () else f"{text}: it has no publisher any more"
        if self._taken_s is None:
            return ""
        without_s = steady_s - self._taken_s
        return (
            f"{self.topic} has messages, but no new pose for {without_s:.0f} s: their stamps stand "
            "still or are too late, or their poses are null; see to its source"
        )

    def _several(self) -> str:
        """That several publishers share the topic."""
        names = listing(sorted(self.publishers or ()))
        return (
            f"{self.topic} has {len(self.publishers or ())} publishers, {names}: poses of several "
            "sources mix; stop all but one, or give each its own topic, and reset"
        )


def repeated_stamps(stamp_ns: int) -> str:
    """What is wrong with a stream whose stamps repeat, of which this is one; and what to do."""
    kind = "repeat" if stamp_ns % STAMP_UNITS["s"] else "have whole seconds only"
    return f"the stamps {kind}: have the publisher set header.stamp for every message"


def with_stamp(stamp_ns: int) -> str:
    """Which message, in words."""
    return f"with stamp {stamp_ns * 1e-9:.9f} s"
