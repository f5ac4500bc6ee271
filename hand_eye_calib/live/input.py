"""One input of the session: counts its messages, judges their stamps, hands the poses over."""

import time
from collections import Counter, deque
from collections.abc import Callable

import numpy as np

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import ConfigError, HandEyeCalibError
from hand_eye_calib.io.bags.messages import measured_as
from hand_eye_calib.io.transforms import PoseFields
from hand_eye_calib.live.log import NodeLog
from hand_eye_calib.live.session import LiveSession
from hand_eye_calib.live.stamp_guard import SILENT_AFTER_S, Judgement, StampGuard
from hand_eye_calib.live.state import InputState, Level

# Share of lost messages from which on somebody should look.
_MUCH_LOST = 0.01
# Reports, one a second, over which rates and shares are taken, and a bad message is reported.
_REPORTS = 10


class PoseInput:
    """Hands the poses of one sensor to the session, wherever they come from.

    Parameters
    ----------
    name : str
        "parent", "child", or one of :func:`~hand_eye_calib.config.other_names`.
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
    """

    def __init__(
        self,
        name: str,
        topic: str,
        session: LiveSession,
        log: NodeLog,
        on_jump_back: Callable[["PoseInput"], None],
    ) -> None:
        self.name, self.topic = name, topic
        self.is_enabled, self.problem, self._sensor_frame = True, "", ""
        self._guard, self._refused = StampGuard(), Counter[str]()
        self._session, self._log, self._on_jump_back = session, log, on_jump_back
        self._wanted, self._is_watching = "auto", False
        self._arrived, self._lost = 0, 0
        self._next_number: int | None = None
        self._arrived_s: float | None = None
        self._bad, self._bad_at_s = "", -np.inf
        self._counts = deque([(time.monotonic(), 0, 0)], maxlen=_REPORTS + 1)
        self._last_stamp_ns: int | None = None
        self._longest_gap_ns, self._is_new = 0, True

    @property
    def has_poses(self) -> bool:
        """Whether there was a pose in this session."""
        return self._guard.last_ns is not None

    def configure(self, config: CalibratorConfig, is_watching: bool) -> None:
        """Follow the options; ``is_watching`` if the mount is watched."""
        self._wanted = getattr(config, f"{self.name}_measures", "auto")
        self._is_watching = is_watching

    def restart(self, because_of: "PoseInput | None") -> None:
        """Begin a new session: asked for, or because the stamps of an input have jumped back."""
        self._sensor_frame = ""
        self._last_stamp_ns, self._longest_gap_ns = None, 0
        self._is_new = because_of is None
        if because_of is None:
            self._guard.restart()
        elif because_of is not self:
            self._guard.restart(time.monotonic())

    def resume(self) -> None:
        """Go on where a session on disk has ended."""
        self._guard.resume(self._session.statistics(self.name).last_stamp_ns)

    def measures_as(self, type_name: str) -> str:
        """What messages of a type (empty for transforms) are read as here.

        Raises
        ------
        ConfigError
            If they cannot be used.
        """
        measures = measured_as(type_name, self._wanted, self.topic)
        if self._is_watching and measures != "poses":
            raise ConfigError(f"monitor needs poses; {self.topic} has {measures}")
        return measures

    # -------------------------------------------------------------- messages

    def count(self, sequence_number: int | None) -> None:
        """Count the lost messages before one with this number of its publisher; None if nothing is
        known of them: there are several publishers, or the middleware gives no numbers.
        """
        expected, number = self._next_number, sequence_number
        self._next_number = None if number is None else number + 1
        if expected is not None and number is not None:  # less: the publisher was started again
            self._lost += max(number - expected, 0)

    def accept(self, stamp_ns: int, read: Callable[[], PoseFields]) -> None:
        """Take a message; it is read when its stamp is believed."""
        self._arrived, self._arrived_s = self._arrived + 1, time.monotonic()
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
        self._bad, self._bad_at_s = text, time.monotonic()
        self._log.warning(f"{self.topic}: a message is refused: {text}")
        self._log.debug(f"{self.topic}: message {which} refused: {text}")

    def _use(self, judgement: Judgement) -> None:
        for stamp_ns in judgement.dropped:
            text = "its stamp does not fit those before and after it"
            self.refuse(with_stamp(stamp_ns), "corrupt stamp", text)
        for stamp_ns, read in judgement.taken:
            try:
                pose = read()
                # An empty name is the one before, too: parameters or a default name it.
                if pose.sensor_frame not in (None, self._sensor_frame):
                    self._session.set_frame(self.name, pose.sensor_frame)
                    self._sensor_frame = pose.sensor_frame
                if not self._session.add_pose(self.name, stamp_ns, pose.position, pose.quat_xyzw):
                    which = with_stamp(stamp_ns)
                    self._log.debug(f"{self.topic}: message {which} is repeated or too late")
            except HandEyeCalibError as error:
                self.refuse(with_stamp(stamp_ns), "unusable", str(error))
        if judgement.taken and self._is_new:
            self._is_new, first_s = False, judgement.taken[0][0] * 1e-9
            self._log.info(f"first pose on {self.topic}, stamp {first_s:.3f} s")

    # ----------------------------------------------------------------- state

    def is_silent(self, steady_s: float) -> bool:
        """Whether messages have come, but not lately."""
        return self._arrived_s is not None and steady_s - self._arrived_s > SILENT_AFTER_S

    def state(self, steady_s: float, may_rest: bool) -> InputState:
        """What has come in; to be called once a second. ``may_rest`` if silence is nothing to look
        at: there is a result, and the other input is silent too.
        """
        self._counts.append((steady_s, self._arrived, self._lost))
        seconds, arrived, lost = np.subtract(self._counts[-1], self._counts[0]).tolist()
        rate_hz = arrived / seconds if seconds > 0 else 0.0
        level, text = self._judge(steady_s, rate_hz, lost / max(arrived + lost, 1), may_rest)
        taken = self._session.statistics(self.name)
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
        )

    def _judge(
        self, steady_s: float, rate_hz: float, lost_share: float, may_rest: bool
    ) -> tuple[Level, str]:
        if self._arrived_s is None:
            text = f"no message on {self.topic} yet"
            return Level.WARN, ": ".join(filter(None, [text, self.problem]))
        if steady_s - self._bad_at_s < _REPORTS:
            return Level.ERROR, f"{self.topic}: {self._bad}"
        if self.is_silent(steady_s):
            text = f"{self.topic} has been silent for {steady_s - self._arrived_s:.0f} s"
            return (Level.OK if may_rest else Level.WARN), text
        if lost_share < _MUCH_LOST:
            return Level.OK, f"{rate_hz:.1f} Hz"
        advice = "give the node more processor time, or publish at a lower rate"
        return Level.WARN, f"{rate_hz:.1f} Hz; {lost_share:.1%} of the messages are lost: {advice}"


def with_stamp(stamp_ns: int) -> str:
    """Which message, in words."""
    return f"with stamp {stamp_ns * 1e-9:.9f} s"
