"""An input of the session: it counts messages, checks their stamps and passes poses on."""

import math
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import NamedTuple

from hand_eye_calib.core.base.config import STAMP_UNITS, CalibratorConfig
from hand_eye_calib.core.base.errors import HandEyeCalibError, NoPoseError
from hand_eye_calib.core.base.text import MUCH_NULL, duration, share
from hand_eye_calib.core.engine.calibrator import StreamStatistics
from hand_eye_calib.core.geometry.frames import check_not_null
from hand_eye_calib.formats.transforms import PoseFields
from hand_eye_calib.online.live.brief import (
    CHECK_SOURCE,
    START_SOURCE,
    START_SOURCE_AGAIN,
    publishers_in_words,
)
from hand_eye_calib.online.live.log import GOES_ON_S, NodeLog
from hand_eye_calib.online.live.session import LiveSession
from hand_eye_calib.online.live.stamp_guard import (
    NEAR_NS,
    NEAR_PERIODS,
    SILENT_AFTER_S,
    StampGuard,
)
from hand_eye_calib.online.live.state import (
    REPORT_PERIOD_S,
    InputCondition,
    InputState,
    Level,
)

# A smaller share of lost messages needs no action.
_MAX_LOST_SHARE = 0.01
# Above this share of repeated stamps, the publisher does not set its stamps.
_MAX_REPEATED_SHARE = 0.5
# Fewest messages from which a share of repeated stamps is computed.
_MIN_MESSAGES = 20
# If several publishers of a topic alternate at least this number of times, their poses are mixed in
# the session.
_MIN_TURNS = 10

# Number of reports, one per second, over which a rate or a share is computed. A bad message is
# reported for as many seconds.
_REPORTS = 10

# A gap between stamps is a step of the clock if it is longer than the time between the messages by
# this factor.
_STEP_RATIO = 2.0

# Time (s) without a pose after which a session is paused.
PAUSED_AFTER_S = 5.0

_STAMP_IS_0 = "its stamp is 0: set header.stamp in the publisher"


class _Counts(NamedTuple):
    """Numbers of messages until a steady time ``at_s``; ``null`` counts those without a pose."""

    at_s: float
    arrived: int
    lost: int
    null: int


class PoseInput:
    """Pass the poses of a sensor on to the session.

    Parameters
    ----------
    name : str
        "parent", "child", or a name of :func:`~hand_eye_calib.core.base.config.other_names`.
    topic : str
        Origin of the poses, for messages.
    session : LiveSession
    log : NodeLog
    on_jump_back : callable
        Function that is called with this input after its stamps have jumped back. It begins a new
        session.

    Attributes
    ----------
    is_enabled : bool
        Whether poses are accepted.
    problem : str
        Reason for missing poses; empty if unknown.
    publishers : tuple of str or None
        Name of the node of each publisher of the topic; None for transforms.
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
        self.publishers: tuple[str, ...] | None = None
        self._session = session
        self._log = log
        self._on_jump_back = on_jump_back
        # Measured quantity according to the options: "auto", or an entry of registry.MEASURES.
        self._wanted = "auto"
        self._guard = StampGuard()
        self._refused = Counter[str]()
        self._arrived = 0
        self._lost = 0
        self._reports = deque(
            [_Counts(time.monotonic(), 0, 0, 0)], maxlen=_REPORTS + 1
        )
        self._next_number: int | None = None
        self._has_fallen = False
        # Time (steady, s) of the last message.
        self._arrived_s: float | None = None
        # Time (steady, s) and fault of the last message that was refused.
        self._bad_at_s = -math.inf
        self._bad = ""
        self.restart()

    @property
    def has_poses(self) -> bool:
        """Whether the session has a pose of this input."""
        return self._guard.last_ns is not None

    def configure(self, config: CalibratorConfig) -> None:
        """Apply the options."""
        self._wanted = getattr(config, f"{self.name}_measures", "auto")

    def restart(self, because_of: "PoseInput | None" = None) -> None:
        """Begin a new session.

        Parameters
        ----------
        because_of : PoseInput, optional
            Input whose stamps have jumped back; None if a person requested the new session.
        """
        self._sensor_frame = ""
        self._world_frame = ""
        self._longest_gap_ns = 0
        # Sequence number of the last message while the topic had several publishers.
        self._mixed_number: int | None = None
        # Number of times that a sequence number was below the previous one.
        self._n_turns = 0
        # Names of the publishers whose poses are mixed in the session.
        self._mixed: tuple[str, ...] = ()
        # Time (steady, s) of the last pose.
        self._taken_s: float | None = None
        self._is_new = because_of is None
        if because_of is None:
            self._guard.restart()
        elif because_of is not self:
            self._guard.restart(time.monotonic())

    def resume(self) -> None:
        """Continue the session on disk."""
        self._guard.resume(
            self._session.engines.statistics(self.name).last_stamp_ns
        )

    # -------------------------------------------------------------- messages

    def count(self, sequence_number: int | None) -> None:
        """Count the messages that were lost before a message.

        Parameters
        ----------
        sequence_number : int or None
            Sequence number that the publisher gave to the message. None if lost messages cannot be
            counted: the topic has several publishers, or the middleware has no numbers.
        """
        expected = self._next_number
        self._next_number = (
            None if sequence_number is None else sequence_number + 1
        )
        if expected is not None and sequence_number is not None:
            # Smaller numbers have two causes. The publisher was restarted, or there is a second
            # publisher that is not discovered yet. In the second case, the next increase is a
            # message of the first publisher.
            has_fallen = sequence_number < expected
            if not (has_fallen or self._has_fallen):
                self._lost += sequence_number - expected
            self._has_fallen = has_fallen

    def count_mixed(self, sequence_number: int) -> None:
        """Count how often the publishers of a topic alternate.

        A restarted publisher also counts, but only once.
        """
        last = self._mixed_number
        self._mixed_number = sequence_number
        self._n_turns += last is not None and sequence_number < last
        if self._n_turns >= _MIN_TURNS and len(self.publishers or ()) > 1:
            self._mixed = tuple(sorted(self.publishers or ()))

    def accept(self, stamp_ns: int, read: Callable[[], PoseFields]) -> None:
        """Process a message. ``read`` is called after its stamp was accepted."""
        now_s = time.monotonic()
        self._arrived += 1
        self._arrived_s = now_s
        if not self.is_enabled:
            return
        last_ns = self._guard.last_ns
        judgement = self._guard.check(stamp_ns, read, now_s)
        if judgement.jumped_back:
            jump_s = ((last_ns or 0) - judgement.taken[0][0]) * 1e-9
            self._log.warning(
                f"{self.topic} jumped back by {jump_s:.3f} s (a bag that loops? a clock that was "
                "reset?): new session, earlier poses discarded"
            )
            self._on_jump_back(self)
        elif judgement.taken and last_ns is not None:
            self._take_gap(judgement.taken[0][0] - last_ns, now_s)
        for dropped_ns in judgement.dropped:
            self._refuse_stamp(
                dropped_ns, "its stamp does not fit those before and after it"
            )
        for repeated_ns in judgement.repeated:
            self._refuse_stamp(repeated_ns, repeated_stamps(repeated_ns))
        for message in judgement.taken:
            self._take(*message)
        if judgement.taken and self._is_new:
            self._is_new = False
            first_s = judgement.taken[0][0] * 1e-9
            self._log.info(f"first pose on {self.topic}, stamp {first_s:.3f} s")

    def _take_gap(self, gap_ns: int, now_s: float) -> None:
        """Store the gap (ns) before an accepted stamp. Report it if the clock has stepped."""
        self._longest_gap_ns = max(self._longest_gap_ns, gap_ns)
        gap_s = gap_ns * 1e-9
        silent_s = self.silent_s(now_s)
        if (
            silent_s is not None
            and gap_ns > NEAR_NS
            and gap_s > _STEP_RATIO * silent_s
        ):
            self._log.warning(
                f"{self.topic}: the stamps jump ahead by {gap_s:.3f} s within {silent_s:.3f} s "
                "(a clock that was set? a gap in a bag that is played fast?)"
            )

    def refuse(self, message: str, reason: str, text: str) -> None:
        """Count and log a message that cannot be used.

        Parameters
        ----------
        message : str
            Name of the message in the log, see :func:`with_stamp`.
        reason : str
            Category under which the message is counted.
        text : str
            Fault and remedy.
        """
        self._refused[reason] += 1
        self._bad = text
        self._bad_at_s = time.monotonic()
        self._log.warning(f"{self.topic}: a message is refused: {text}")
        self._log.debug(f"{self.topic}: message {message} refused: {text}")

    def leave_out(self, message: str, reason: NoPoseError) -> None:
        """Count a message that has no pose on purpose, such as that of a tracker without track."""
        self._refused["no pose"] += 1
        self._log.debug(
            f"{self.topic}: message {message} is left out: {reason}"
        )

    def _refuse_stamp(self, stamp_ns: int, text: str) -> None:
        """Refuse a message because of its stamp."""
        self.refuse(
            with_stamp(stamp_ns),
            "corrupt stamp",
            text if stamp_ns else _STAMP_IS_0,
        )

    def _take(self, stamp_ns: int, read: Callable[[], PoseFields]) -> None:
        """Read a message, and add its pose to the session or count it as refused."""
        try:
            pose = read()
            self._check_frames(pose)
            row = self.name, stamp_ns, pose.position, pose.quat_xyzw
            if not self._session.engines.add_pose(*row):
                message = with_stamp(stamp_ns)
                self._log.debug(
                    f"{self.topic}: message {message} is repeated or too late"
                )
                return
            self._taken_s = self._arrived_s
            if self._session.journal is not None:
                self._session.journal.poses.append(row)
        except NoPoseError as error:
            self.leave_out(with_stamp(stamp_ns), error)
        except HandEyeCalibError as error:
            self.refuse(with_stamp(stamp_ns), "unusable", str(error))

    def _check_frames(self, pose: PoseFields) -> None:
        """Pass changed names of frames on to the engines.

        A message type without a sensor frame has None. The name is then from a parameter, or the
        default.

        Raises
        ------
        HandEyeCalibError
            If the engines refuse a name, for example because another sensor has it.
        """
        sensor = pose.sensor_frame
        has_new_sensor = sensor is not None and sensor != self._sensor_frame
        has_new_world = pose.world_frame != self._world_frame
        # Ignore the frames of a message without a pose.
        if has_new_sensor or has_new_world:
            check_not_null(*pose.position, *pose.quat_xyzw)
        if sensor is not None and has_new_sensor:
            self._session.engines.set_frame(self.name, sensor)
            self._sensor_frame = sensor
        if has_new_world:
            self._session.engines.set_world(self.name, pose.world_frame)
            self._world_frame = pose.world_frame

    # ----------------------------------------------------------------- state

    def is_silent(self, steady_s: float) -> bool:
        """Return whether messages have arrived, but no longer arrive."""
        return (
            self._arrived_s is not None
            and steady_s - self._arrived_s > SILENT_AFTER_S
        )

    def silent_s(self, steady_s: float) -> float | None:
        """Return the time (s) without a pose; None before the first pose of the session."""
        return None if self._taken_s is None else steady_s - self._taken_s

    def is_paused(self, steady_s: float) -> bool:
        """Return whether poses have arrived in this session, but no longer arrive."""
        silent_s = self.silent_s(steady_s)
        if silent_s is None or not self.is_enabled:
            return False
        return silent_s > max(
            PAUSED_AFTER_S, NEAR_PERIODS * self._guard.period_ns() * 1e-9
        )

    def state(self, steady_s: float, may_rest: bool) -> InputState:
        """Return the diagnostics. Call this method at least once a second.

        Parameters
        ----------
        steady_s : float
            Steady time (s).
        may_rest : bool
            Whether silence is normal: a result exists, and the other input is silent, too.
        """
        now = _Counts(
            steady_s, self._arrived, self._lost, self._refused["no pose"]
        )
        oldest = self._reports[0]
        if steady_s - self._reports[-1].at_s > REPORT_PERIOD_S / 2:
            self._reports.append(now)
        seconds = steady_s - oldest.at_s
        arrived = now.arrived - oldest.arrived
        lost = now.lost - oldest.lost
        rate_hz = arrived / seconds if seconds > 0 else 0.0
        lost_share = lost / max(arrived + lost, 1)
        null_share = (now.null - oldest.null) / max(arrived, 1)
        level, text, step, needs_reset = self._condition(
            steady_s, rate_hz, lost_share, may_rest
        )
        accepted = self._session.engines.statistics(self.name)
        if level is Level.OK and self._longest_gap_ns > NEAR_NS:
            text = (
                f"{text}, longest gap {duration(self._longest_gap_ns * 1e-9)}"
            )
        advice = self._advice(null_share, accepted)
        if level is Level.OK and advice:
            self._log.warning(f"{self.topic}: {advice}")
            level = Level.WARN
            text = f"{text}; {advice}"
        n_publishers = None
        if self.publishers is not None:
            n_publishers = len(self.publishers)
        return InputState(
            level=level,
            text=text,
            topic=self.topic,
            rate_hz=rate_hz,
            messages=self._arrived,
            poses_taken=accepted.received,
            refused={
                "repeated stamp": accepted.refused_duplicate,
                "too late": accepted.refused_late,
                **dict(sorted(self._refused.items())),
            },
            lost=None if self._next_number is None else self._lost,
            longest_gap_s=self._longest_gap_ns * 1e-9,
            publishers=n_publishers,
            is_paused=self.is_paused(steady_s),
            silent_s=self.silent_s(steady_s),
            step=step,
            needs_reset=needs_reset,
        )

    def _advice(self, null_share: float, accepted: StreamStatistics) -> str:
        """Return advice if many messages have no pose or repeat a stamp; empty otherwise."""
        if null_share > MUCH_NULL:
            return (
                f"{share(null_share)} of the messages have no pose: check whether the source loses "
                "track"
            )
        n_repeated = accepted.refused_duplicate
        n_messages = n_repeated + accepted.received
        if (
            n_messages < _MIN_MESSAGES
            or n_repeated <= _MAX_REPEATED_SHARE * n_messages
        ):
            return ""
        return repeated_stamps(accepted.last_stamp_ns or 0)

    def _condition(
        self, steady_s: float, rate_hz: float, lost_share: float, may_rest: bool
    ) -> InputCondition:
        """Return the gravest condition of the input with its text."""
        if self._arrived_s is None:
            text = f"no message on {self.topic} yet"
            text = f"{text}: {self.problem}" if self.problem else text
            step = CHECK_SOURCE if self.publishers else START_SOURCE
            return InputCondition(Level.WARN, text, step)
        if steady_s - self._bad_at_s < _REPORTS:
            return InputCondition(Level.ERROR, f"{self.topic}: {self._bad}")
        if text := self._why_paused(steady_s, self._arrived_s):
            if may_rest:
                return InputCondition(Level.OK, text)
            self._log.info(text, GOES_ON_S)
            step = START_SOURCE_AGAIN if self.is_silent(steady_s) else ""
            return InputCondition(Level.WARN, text, step)
        if self.publishers is not None and len(self.publishers) > 1:
            several = publishers_in_words(self.publishers)
            text = f"{self.topic} has {several}. Stop all but one, then reset"
            self._log.warning(text)
            return InputCondition(Level.WARN, text, needs_reset=True)
        if self._mixed:
            several = publishers_in_words(self._mixed)
            text = f"{self.topic} had {several}. Their poses are mixed: reset"
            return InputCondition(Level.WARN, text, needs_reset=True)
        if lost_share < _MAX_LOST_SHARE:
            return InputCondition(Level.OK, f"{rate_hz:.1f} Hz")
        text = f"{share(lost_share)} of the messages are lost"
        advice = "Free processor time, or publish at a lower rate"
        self._log.warning(f"{self.topic}: {text}. {advice}")
        return InputCondition(Level.WARN, f"{text}. {advice}")

    def _why_paused(self, steady_s: float, arrived_s: float) -> str:
        """Return the reason why poses no longer arrive; empty if they arrive or it is unknown."""
        if self._taken_s is not None and not self.is_paused(steady_s):
            return ""
        silent_s = steady_s - arrived_s
        if silent_s > PAUSED_AFTER_S:
            text = f"{self.topic} has been silent for {silent_s:.0f} s"
            return (
                text
                if self.publishers != ()
                else f"{text}: it has no publisher any more"
            )
        if self._taken_s is None:
            return ""
        without_s = steady_s - self._taken_s
        return (
            f"{self.topic} has messages, but no new pose for {without_s:.0f} s. Check the source: "
            "the stamps repeat or are too late, or the poses are null"
        )


def repeated_stamps(stamp_ns: int) -> str:
    """Return fault and remedy of a stream whose stamps repeat; ``stamp_ns`` is one of them."""
    kind = (
        "repeat" if stamp_ns % STAMP_UNITS["s"] else "have whole seconds only"
    )
    return f"the stamps {kind}: set header.stamp in the publisher for every message"


def with_stamp(stamp_ns: int) -> str:
    """Return the name of a message in the log."""
    return f"with stamp {stamp_ns * 1e-9:.9f} s"
