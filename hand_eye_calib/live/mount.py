"""The mount monitor in a live session: ``monitor: true`` watches instead of calibrating."""

from collections.abc import Callable
from datetime import datetime

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.engine.pose_buffer import BufferLimits
from hand_eye_calib.geometry.extrinsic import Extrinsic
from hand_eye_calib.live.log import NodeLog
from hand_eye_calib.live.monitor import LEARNING_S, Alarm, MountMonitor
from hand_eye_calib.live.session import LiveSession
from hand_eye_calib.live.state import AxisValues, Level, MountState
from hand_eye_calib.results.status import AXES
from hand_eye_calib.text import amount, axes_in_words, listing

# Poses are paired soon, and few are kept.
LIMITS = BufferLimits(
    capacity=4_000, pairing_starts=32, batch=64, batch_every=16, late_ns=500_000_000
)

# A shift is told from this many standard deviations on.
_CLEARLY = 3.0

# An axis is watched if ten minutes of motion would show a change of so many targets.
_UNKNOWN = (1.0, 1.0, 1.0, 0.3, 0.3, 0.3)  # m, rad: as good as nothing
_TARGETS, _MINUTE_S, _LONG_S = 5.0, 60.0, 600.0


class MountWatch:
    """Feeds the monitor with the pose pairs of the session, once a second.

    Parameters
    ----------
    session : LiveSession
    installed : callable
        Gives the installed pose of the child's frame in the parent's; None while it is not known.
    why_unknown : callable
        Gives the reason for that.
    log : NodeLog
    """

    def __init__(
        self,
        session: LiveSession,
        installed: Callable[[str, str], Extrinsic | None],
        why_unknown: Callable[[], str],
        log: NodeLog,
    ) -> None:
        self._session, self._log = session, log
        self._installed, self._why_unknown = installed, why_unknown
        self._monitor: MountMonitor | None = None
        self._last_ns = -1
        self._had_alarm = False

    def restart(self) -> None:
        """The stamps have jumped back: nothing runs across; what was learned stays."""
        self._last_ns = -1
        if self._monitor is not None:
            self._monitor.restart()

    def look(self) -> None:
        """Judge what has come in; to be called about once a second."""
        pairs = self._session.calibrator.take_pairs()
        pairs = pairs[pairs.stamps_ns > self._last_ns]
        # Before the first poses, the frames are not known.
        monitor = self._started() if len(pairs) else None
        if monitor is None:
            return
        self._last_ns = int(pairs.stamps_ns[-1])
        alarm = monitor.add(pairs)
        if alarm is not None:
            self._log.error(in_words(alarm))
        elif self._had_alarm and monitor.alarm is None:
            self._log.info("the mount is where it was installed again")
        self._had_alarm = monitor.alarm is not None

    def _started(self) -> MountMonitor | None:
        """The monitor; None while what is installed is not known."""
        if self._monitor is None:
            snapshot = self._session.calibrator.snapshot()
            installed = self._installed(snapshot.parent_frame, snapshot.child_frame)
            if installed is not None:
                self._monitor = MountMonitor(installed.T_parent_child, installed.covariance)
        return self._monitor

    def state(self) -> MountState:
        """Whether the mount has moved, and what can be seen of it on this robot."""
        monitor = self._monitor
        if monitor is None:
            return MountState(level=Level.WARN, text=self._why_unknown() or "no poses yet")
        visible, alarm = monitor.visible(_LONG_S), monitor.alarm
        level = Level.OK if alarm is None else Level.ERROR
        if alarm is not None:
            text = in_words(alarm)
        elif monitor.is_learning:
            text = f"learning the noise: {monitor.seconds} of {LEARNING_S} s of motion"
        else:
            targets = np.array(self._session.calibrator.config.targets)
            text = _quiet(visible, visible <= _TARGETS * targets)
        return MountState(
            level=level,
            text=text,
            is_learning=monitor.is_learning,
            seconds_of_motion=monitor.seconds,
            alarms=monitor.alarms,
            long_run=monitor.long_run,
            shift=dict(zip(AXES, alarm.shift.tolist(), strict=True)) if alarm else {},
            shift_sigma=dict(zip(AXES, alarm.sigmas.tolist(), strict=True)) if alarm else {},
            visible_1min=_visible(monitor.visible(_MINUTE_S)),
            visible_10min=_visible(visible),
            since_ns=alarm.since_ns if alarm else None,
            newest_ns=self._last_ns,
        )


def in_words(alarm: Alarm) -> str:
    """Which axes have moved, by how much, since when (local time)."""
    ratios = np.abs(alarm.shift) / alarm.sigmas
    told = [
        f"{axes_in_words([axis])} by {amount(axis, shift)} +/- {amount(axis, sigma)}"
        for axis, shift, sigma, ratio in zip(
            AXES, alarm.shift.tolist(), alarm.sigmas.tolist(), ratios, strict=True
        )
        if ratio >= min(_CLEARLY, ratios.max())
    ]
    since = datetime.fromtimestamp(alarm.since_ns * 1e-9).isoformat(" ", timespec="seconds")
    return f"the mount has moved: {listing(told)}, since about {since}"


def _quiet(visible: FloatArray, is_watched: np.ndarray) -> str:
    text = "the mount has not moved"
    told = []
    for part in (range(3), range(3, 6)):
        if known := [index for index in part if is_watched[index]]:
            worst = amount(AXES[known[0]], float(visible[known].max()))
            told.append(f"{worst} in {axes_in_words([AXES[index] for index in known])}")
    if told:
        text += f": ten minutes of motion would show {listing(told)}"
    unwatched = [axis for axis, watched in zip(AXES, is_watched, strict=True) if not watched]
    return f"{text}; {axes_in_words(unwatched)} cannot be watched here" if unwatched else text


def _visible(values: FloatArray) -> AxisValues:
    columns = zip(AXES, values.tolist(), _UNKNOWN, strict=True)
    return {axis: value if value < unknown else None for axis, value, unknown in columns}
