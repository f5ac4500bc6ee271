"""The mount monitor in a live session: installed pose, log, digest and state for diagnostics."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from hand_eye_calib.core.assessment import change
from hand_eye_calib.core.assessment.comparison import SEEN_TARGETS
from hand_eye_calib.core.base.text import axes_in_words
from hand_eye_calib.core.engine.calibrator import BufferLimits
from hand_eye_calib.core.geometry.frames import Extrinsic
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.extras.mount.digest import write_digest
from hand_eye_calib.extras.mount.monitor import TUNING, MountMonitor
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.live.progress import AXIS_KEYS
from hand_eye_calib.online.live.session import LiveSession
from hand_eye_calib.online.live.state import Level, MountState, Outcome, by_axis

# Limits of a session that is monitored instead of calibrated: poses are paired soon, and few poses
# are stored.
LIMITS = BufferLimits(
    capacity=4_000,
    pairing_starts=32,
    batch=64,
    batch_every=16,
    late_ns=500_000_000,
)


class MountWatch:
    """Monitor of a live session. The node calls :meth:`look` about once a second.

    Parameters
    ----------
    session : LiveSession
    installed : callable
        Function ``installed(parent_frame, child_frame)`` that returns the installed pose; None
        while it is unknown.
    why_unknown : callable
        Function that returns the reason why the installed pose is unknown, as text.
    log : NodeLog
    """

    def __init__(
        self,
        session: LiveSession,
        installed: Callable[[str, str], Extrinsic | None],
        why_unknown: Callable[[], str],
        log: NodeLog,
    ) -> None:
        self._session = session
        self._log = log
        self._installed = installed
        self._why_unknown = why_unknown
        self._monitor: MountMonitor | None = None
        self._last_ns = -1
        self._frames = ("", "")

    def restart(self) -> None:
        """Accept earlier stamps after the stamps have jumped back. Noise and evidence are kept."""
        self._last_ns = -1
        if self._monitor is not None:
            self._monitor.restart()

    def look(self) -> None:
        """Add the new pose pairs to the monitor, and log an alarm."""
        calibrator = self._session.calibrator
        pairs = calibrator.take_pairs()
        pairs = pairs[pairs.stamps_ns > self._last_ns]
        # The frames are known after the first pair.
        if self._monitor is None and len(pairs):
            snapshot = calibrator.snapshot()
            installed = self._installed(
                snapshot.parent_frame, snapshot.child_frame
            )
            if installed is not None:
                self._frames = snapshot.parent_frame, snapshot.child_frame
                self._monitor = MountMonitor(
                    installed.T_parent_child, installed.covariance
                )
        if self._monitor is not None and len(pairs):
            self._last_ns = int(pairs.stamps_ns[-1])
            if alarm := self._monitor.add(pairs):
                self._log.error(str(alarm))

    def save(self, directory: Path) -> Outcome:
        """Write the digest. Return whether this succeeded, and a line of text for the user."""
        digest = self._monitor.digest(*self._frames) if self._monitor else None
        if digest is None:
            seconds = self._monitor.seconds if self._monitor else 0
            text = (
                f"no digest of the mount: {seconds} of the {TUNING.learning_s} s of motion that "
                "are needed to learn the noise"
            )
            self._log.warning(text)
            return False, text
        try:
            path = write_digest(directory, digest)
        except OSError as error:
            text = f"the digest of the mount is not saved: {error}"
            self._log.error(text)
            return False, text
        text = f"digest of the mount saved to {path}"
        self._log.info(text)
        return True, text

    def state(self) -> MountState:
        """Return the state for ``/diagnostics``: alarm, or detectable shifts on this robot."""
        monitor = self._monitor
        if monitor is None:
            return MountState(
                level=Level.WARN, text=self._why_unknown() or "no poses yet"
            )
        visible = monitor.visible(TUNING.session_s)
        alarm = monitor.alarm
        if alarm is not None:
            text = str(alarm)
        elif monitor.is_learning:
            text = f"learning the noise: {monitor.seconds} of {TUNING.learning_s} s of motion"
        else:
            text = "the mount has not moved"
            # Axes on which only large shifts would be detected.
            limits = SEEN_TARGETS * np.array(
                self._session.calibrator.config.targets
            )
            axes = [AXES[index] for index in np.flatnonzero(visible > limits)]
            if axes:
                text += f"; {axes_in_words(axes)} cannot be monitored with this motion"
        visible = np.where(visible < change.UNKNOWN_FROM, visible, np.nan)
        shift = {}
        shift_sigma = {}
        if alarm:
            for axis, row in alarm.shift.axes.items():
                shift[AXIS_KEYS[axis]] = row.difference
                shift_sigma[AXIS_KEYS[axis]] = row.sigma
        return MountState(
            level=Level.ERROR if alarm else Level.OK,
            text=text,
            is_learning=monitor.is_learning,
            seconds_of_motion=monitor.seconds,
            shift=shift,
            shift_sigma=shift_sigma,
            visible_10min=by_axis(visible),
            since_ns=alarm.since_ns if alarm else None,
            newest_ns=self._last_ns,
        )
