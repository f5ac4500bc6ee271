"""The mount monitor in the node: ``monitor: true`` watches the mount instead of calibrating."""

import time
from datetime import UTC, datetime

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.covariance import AXES
from hand_eye_calib.engine.pose_buffer import BufferLimits
from hand_eye_calib.ros.live_session import LiveSession
from hand_eye_calib.ros.log import NodeLog
from hand_eye_calib.ros.robot import Robot
from hand_eye_calib.ros.status import ERROR, OK, WARN, Report
from hand_eye_calib.session.monitor import LEARNING_S, Alarm, MountMonitor
from hand_eye_calib.text import amount, listing

# Poses are paired soon, and few are kept.
LIMITS = BufferLimits(
    capacity=4_000, pairing_starts=32, batch=64, batch_every=16, late_ns=500_000_000
)

# An axis is watched if ten minutes of motion would show a change of so many targets.
_UNKNOWN = (1.0, 1.0, 1.0, 0.3, 0.3, 0.3)  # m, rad: as good as nothing
_TARGETS, _MINUTE_S, _LONG_S = 5.0, 60.0, 600.0


class MountWatch:
    """Feeds the monitor with the pose pairs of the session, once a second.

    Parameters
    ----------
    session : LiveSession
    robot : Robot
    log : NodeLog
    """

    def __init__(self, session: LiveSession, robot: Robot, log: NodeLog) -> None:
        self._session, self._robot, self._log = session, robot, log
        self._monitor: MountMonitor | None = None
        self._last_ns = -1
        self._had_alarm = False
        self.seconds = 0.0

    def restart(self) -> None:
        """The stamps have jumped back: nothing runs across; what was learned stays."""
        self._last_ns = -1
        if self._monitor is not None:
            self._monitor.restart()

    def look(self) -> None:
        """Judge what has come in; to be called about once a second."""
        began_s = time.perf_counter()
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
        self.seconds = time.perf_counter() - began_s

    def _started(self) -> MountMonitor | None:
        """The monitor; None while what is installed is not known."""
        if self._monitor is None:
            snapshot = self._session.calibrator.snapshot()
            frames = snapshot.parent_frame, snapshot.child_frame
            installed = self._robot.installed(*frames)
            if installed is not None:
                self._monitor = MountMonitor(installed.T_parent_child, installed.covariance)
        return self._monitor

    def report(self) -> Report:
        """Whether the mount has moved, and what can be seen of it on this robot."""
        monitor = self._monitor
        if monitor is None:
            return Report(WARN, self._robot.problem or "no poses yet", {"alarms": 0})
        targets = np.array(self._session.calibrator.config.targets)
        visible = monitor.visible(_LONG_S)
        values: dict[str, object] = {
            "seconds of motion": monitor.seconds,
            "alarms": monitor.alarms,
            "long-run variance": f"{monitor.long_run:.1f}",
            "last step took (s)": f"{self.seconds:.4f}",
        }
        values |= _per_axis("visible_1min", monitor.visible(_MINUTE_S))
        values |= _per_axis("visible_10min", visible)
        if monitor.alarm is not None:
            values |= _alarm_values(monitor.alarm)
            return Report(ERROR, in_words(monitor.alarm), values)
        if monitor.is_learning:
            seen = f"{monitor.seconds} of {LEARNING_S} s of motion"
            return Report(OK, f"learning the noise: {seen}", values)
        return Report(OK, _quiet(visible, visible <= _TARGETS * targets), values)


def in_words(alarm: Alarm) -> str:
    """Which axes have moved, by how much, since when."""
    ratios = np.abs(alarm.shift) / alarm.sigmas
    clear = [index for index in np.argsort(-ratios) if ratios[index] > 3.0]
    axes = sorted(int(index) for index in clear) or [int(np.argmax(ratios))]
    told = [
        f"{AXES[index]} by {amount(AXES[index], float(alarm.shift[index]))} +/- "
        f"{amount(AXES[index], float(alarm.sigmas[index]))}"
        for index in axes
    ]
    since = datetime.fromtimestamp(alarm.since_ns * 1e-9, UTC).isoformat(timespec="seconds")
    return f"the mount has moved: {listing(told)}, since about {since}"


def _quiet(visible: FloatArray, watched: np.ndarray) -> str:
    told = []
    for names in (AXES[:3], AXES[3:]):
        known = [axis for axis in names if watched[AXES.index(axis)]]
        if known:
            worst = max(known, key=lambda axis: float(visible[AXES.index(axis)]))
            told.append(f"{amount(worst, float(visible[AXES.index(worst)]))} in {listing(known)}")
    unwatched = [axis for axis, is_watched in zip(AXES, watched, strict=True) if not is_watched]
    text = "the mount has not moved"
    if told:
        text += f": ten minutes of motion would show {listing(told)}"
    return f"{text}; {listing(unwatched)} cannot be watched here" if unwatched else text


def _per_axis(name: str, values: FloatArray) -> dict[str, object]:
    return {
        f"{name}.{axis}": f"{value:.6g}" if value < unknown else "unknown"
        for axis, value, unknown in zip(AXES, values, _UNKNOWN, strict=True)
    }


def _alarm_values(alarm: Alarm) -> dict[str, object]:
    return {
        "since_ns": alarm.since_ns,
        "raised_ns": alarm.raised_ns,
        "log likelihood ratio": f"{alarm.log_ratio:.1f}",
        **_per_axis("shift", alarm.shift),
        **_per_axis("shift_sigma", alarm.sigmas),
    }
