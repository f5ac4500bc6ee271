"""Option ``monitor: true``: detect a shift of the child sensor from the installed extrinsic.

The monitor runs for days in constant memory. Each second k of motion adds its evidence on a shift
d, the information H_k and the score S_k (:mod:`hand_eye_calib.core.assessment.moved`):

    H = sum H_k / f,   S = sum S_k / f      over the last 3 s, 4 s, ... 20 min, and over everything
    log ratio = 1/2 S' (H + L^-1)^-1 S - 1/2 log|I + L H|

with the long-run variance f, by the real scatter of the scores over time. An alarm is raised if the
largest ratio exceeds a threshold: the generalised likelihood ratio test of M. Basseville, I.
Nikiforov, *Detection of abrupt changes*, 1993.

The offset from the installed extrinsic before a shift comes from the uncertainty of the extrinsic
and from the common-mode error of both odometries
(:mod:`hand_eye_calib.core.assessment.covariance`). The motion before the shift estimates it. A
drifting scale, for example of visual odometry, looks like a lever arm in curves: each second has
its own scale parameter. A sensor at rest adds nothing. docs/session.md lists the shifts that the
monitor detects.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np

from hand_eye_calib.core.assessment import change, moved
from hand_eye_calib.core.assessment.comparison import SEEN_TARGETS
from hand_eye_calib.core.assessment.covariance import floor_of_pairs
from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.blocks import Blocks, information, inverse, score, shift_evidence
from hand_eye_calib.core.base.stats import NINE_TIMES_OUT_OF_TEN, robust_weights
from hand_eye_calib.core.base.text import axes_in_words
from hand_eye_calib.core.engine.calibrator import BufferLimits
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import Extrinsic
from hand_eye_calib.core.geometry.se3 import sigmas_in_parent
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs, PosePairs, pairs_between
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.extras.mount.digest import Digest, write_digest
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.live.progress import AXIS_KEYS
from hand_eye_calib.online.live.session import LiveSession
from hand_eye_calib.online.live.state import Level, MountState, Outcome, by_axis


@dataclass(frozen=True)
class Tuning:
    """Numbers of the monitor; times are seconds of motion unless stated otherwise.

    docs/session.md lists the shifts that are detected with them.
    """

    # Log likelihood ratio from which on the mount has moved.
    threshold: float = 10.0
    # Longest motion that counts as one over a second, as a multiple of a second.
    most_late: float = 1.5
    # At most one motion begins in each step of this length (ns).
    step_ns: int = 100_000_000
    # A second counts if the sensors move by this distance within it (m) ...
    least_motion_m: float = 0.05
    # ... or rotate by this angle (rad) ...
    least_rotation_rad: float = float(np.radians(1.5))
    # ... and by this multiple of the rotation noise.
    least_of_noise: float = 3.0
    # Time from which the noise is learned before the first test.
    learning_s: int = 120
    # Newest seconds whose evidence is kept one by one.
    memory_s: int = 1200
    # Shortest time since a shift: longer than the motions, so that one jump of a trajectory is no
    # shift.
    shortest_s: int = 3
    # Number of tested times since a shift.
    lags: int = 16
    # Time constant of the estimate of the noise.
    noise_memory_s: float = 900.0
    # Time constant with which older evidence is forgotten.
    old_memory_s: float = 20_000.0
    # Factor of the variances of the installed extrinsic.
    caution: float = 2.0
    # Standard deviation of the common-mode error from hour to hour, as a share.
    wander: float = 0.25
    # Standard deviation of the child's scale in a second. A scale that drifts by 0.5 % is wrong for
    # a minute; as independent errors of seconds, this is sqrt(60) times as much.
    scale_sigma: float = 0.04
    # Lengths (s) of the windows whose scores give the long-run variance.
    windows_s: tuple[int, ...] = (10, 30, 90, 240)
    # Interval of its estimates.
    long_run_every_s: int = 10
    # Prior long-run variance.
    assumed: float = 10.0
    # Weight of the prior in windows; fewer windows are no evidence.
    assumed_windows: int = 4
    # Largest score of a window, as a multiple of the typical one: a shift spoils some windows.
    most_of_typical: float = 20.0
    # Information of the expected shifts that is added to that of the motion, as a share.
    ridge: float = 1e-3
    # Duration of the session for which visible shifts are reported.
    session_s: float = 600.0


TUNING = Tuning()

_LAGS = np.geomspace(TUNING.shortest_s, TUNING.memory_s, TUNING.lags).round().astype(int)
_SECOND_NS = 1_000_000_000

# Covariances of expected shifts: a translation, a rotation, or both. A shift that only rotates the
# sensor is detected sooner with the second.
KNOCKS = np.array(
    [moved.shift_covariance(radians=1e-6), moved.shift_covariance(1e-6), moved.shift_covariance()]
)

# Limits of a session that is only monitored: poses are paired soon, and few are kept.
LIMITS = BufferLimits(
    capacity=4_000, pairing_starts=32, batch=64, batch_every=16, late_ns=500_000_000
)


@dataclass(frozen=True)
class _Second:
    """Motions that begin within one second of motion.

    Attributes
    ----------
    stamp_ns : int
    motions : MotionPairs
        K motions over a second.
    residuals : (K, 6) array
        At the installed extrinsic.
    jacobians : (K, 6, 7) array
        Negative derivatives of the residuals with respect to a shift and to the logarithm of the
        child's scale.
    """

    stamp_ns: int
    motions: MotionPairs
    residuals: FloatArray
    jacobians: FloatArray


@dataclass(frozen=True, kw_only=True)
class Alarm:
    """A shift of the mount from the installed pose.

    Attributes
    ----------
    since_ns : int
        Approximate time of the shift, on the parent's clock.
    raised_ns : int
        Time of its detection, on the parent's clock.
    shift : Moved
    log_ratio : float
    """

    since_ns: int
    raised_ns: int
    shift: change.Moved
    log_ratio: float

    def __str__(self) -> str:
        """Describe the axes that have moved, by how much, and since when (local time)."""
        since = datetime.fromtimestamp(self.since_ns * 1e-9).isoformat(" ", timespec="minutes")
        return f"the mount has moved: {self.shift.what}, since about {since}"


class MountMonitor:
    """Monitors the pose of the child sensor in the parent sensor's frame.

    Parameters
    ----------
    T_parent_child : (4, 4) array
        The installed extrinsic.
    covariance : (6, 6) array
        Covariance of the error xi in ``T_parent_child @ exp(xi)``; zero if it is exact.

    Attributes
    ----------
    alarm : Alarm or None
        The detected shift.
    seconds : int
        Seconds of motion so far.
    is_learning : bool
        Whether the noise is still learned, and nothing is tested.
    long_run : float
        Long-run variance of the scores in units of their information.
    """

    def __init__(self, T_parent_child: FloatArray, covariance: FloatArray) -> None:
        self._installed = np.asarray(T_parent_child, dtype=float)
        self._covariance = TUNING.caution * np.asarray(covariance, dtype=float)
        self._wander = np.zeros((6, 6))
        self._noise = np.zeros((6, 6))
        self._learning: list[_Second] = []
        self.is_learning = True
        self._tail = PosePairs.empty()
        # Evidence of the newest seconds of motion, and the sum of older ones.
        self._stamps_ns: IntArray = np.zeros(0, dtype=np.int64)
        self._seconds = Blocks(np.zeros((0, 6, 7)))
        self._old = np.zeros((6, 7))
        self._centre = np.zeros(6)
        self._last_s = -1
        self._motions_per_s = 0.0
        self.alarm: Alarm | None = None
        self._start_ns = 0
        self.seconds = 0
        self.long_run = TUNING.assumed

    def add(self, pose_pairs: PosePairs) -> Alarm | None:
        """Add the next poses.

        Returns
        -------
        Alarm or None
            A new alarm, if these poses raise it.
        """
        had_alarm = self.alarm is not None
        raised = None
        for second in self._by_second(pose_pairs):
            if not _is_motion(second.motions, self._noise):
                continue
            self.seconds += 1
            self._start_ns = self._start_ns or second.stamp_ns
            if self.is_learning:
                self._learn(second)
            else:
                self._add_evidence(second)
            if not self.is_learning:
                self._test()
            if raised is None and not had_alarm:
                raised = self.alarm
        return raised

    def restart(self) -> None:
        """Start again with stamps of any time, without loss of what was learned."""
        self._tail = PosePairs.empty()
        self._last_s = -1

    # ------------------------------------------------------------- the motions

    def _by_second(self, pose_pairs: PosePairs) -> list[_Second]:
        """Return motions over a second that end in these poses, by the second of their begin."""
        if len(self._tail) and len(pose_pairs):
            late_ns = int(pose_pairs.stamps_ns[0] - self._tail.stamps_ns[-1])
            if not 0 < late_ns <= TUNING.most_late * _SECOND_NS:
                self._tail = PosePairs.empty()
        poses = PosePairs.concatenate(self._tail, pose_pairs)
        poses = poses[np.unique(poses.stamps_ns // TUNING.step_ns, return_index=True)[1]]
        stamps_ns = poses.stamps_ns
        seconds = poses.stamps_ns // _SECOND_NS
        j = np.searchsorted(stamps_ns, stamps_ns + _SECOND_NS)
        # A second is complete once a motion of the next second has its end.
        has_end = j < len(stamps_ns)
        incomplete_s = int(seconds[has_end][-1]) if has_end.any() else -1
        self._tail = poses[seconds >= incomplete_s]
        i = np.flatnonzero(has_end & (seconds < incomplete_s) & (seconds > self._last_s))
        i = i[stamps_ns[j[i]] - stamps_ns[i] <= TUNING.most_late * _SECOND_NS]
        self._last_s = max(self._last_s, incomplete_s - 1)
        pairs = pairs_between(poses.Ts_pw_p, poses.Ts_cw_c, i, j[i])
        second_of_pair = seconds[i]
        residuals, jacobians = moved.residuals_and_jacobians(pairs, self._installed)
        by_scale = -se3.inverse(pairs.Ts_childi_childj)[:, :3, 3:]
        jacobians = np.append(jacobians, np.pad(by_scale, ((0, 0), (0, 3), (0, 0))), axis=2)
        complete = []
        for second in np.unique(second_of_pair).tolist():
            rows = second_of_pair == second
            stamp_ns = second * _SECOND_NS
            complete.append(_Second(stamp_ns, pairs[rows], residuals[rows], jacobians[rows]))
        return complete

    def _learn(self, second: _Second) -> None:
        """Collect motions; once there are enough, learn the noise about their own answer."""
        self._learning.append(second)
        if len(self._learning) < TUNING.learning_s:
            return
        learned = self._learning
        self._learning = []
        pairs = MotionPairs.concatenate(*(second.motions for second in learned))
        # Motions count as independent, each over one step.
        index = np.arange(len(pairs))
        pairs = replace(pairs, i=index, j=index + 1)
        residuals = np.concatenate([second.residuals for second in learned])
        jacobians = np.concatenate([second.jacobians[:, :, :6] for second in learned])
        self.is_learning = False
        self._noise, _ = moved.noise_covariance(residuals)
        for _ in range(2):
            table, _ = _evidence(residuals, jacobians, self._noise)
            shift = moved.most_likely(table, TUNING.ridge)
            self._noise, _ = moved.noise_covariance(residuals + jacobians @ shift)
        distances_m = np.linalg.norm(se3.translation_of(pairs.Ts_parenti_parentj), axis=1)
        speed_m_s = float(np.median(distances_m))
        floor = floor_of_pairs(pairs, np.ones(len(pairs)), self._installed, speed_m_s)
        floor += moved.shift_covariance(1e-3, 1e-4)  # keeps the covariance regular
        self._covariance = self._covariance + floor
        self._wander = TUNING.wander**2 * floor
        for second in learned:
            self._add_evidence(second)

    def _add_evidence(self, second: _Second) -> None:
        """Add the evidence of a second, for an unknown scale in it, and update the noise."""
        n_seconds = len(self._seconds.sums)
        if self.seconds % TUNING.long_run_every_s == 0 and n_seconds >= TUNING.learning_s:
            self._centre = moved.most_likely(self._seconds.total, TUNING.ridge)
        shift = np.append(self._centre, 0.0)
        table, scatter = _evidence(second.residuals, second.jacobians, self._noise, shift)
        # Eliminate the scale, with its prior, from the evidence [H S] (7, 8).
        scale_information = table[6, 6] + self.long_run / TUNING.scale_sigma**2
        by_scale = np.delete(table[6], 6)
        table = np.delete(table[:6], 6, axis=1) - np.outer(
            table[:6, 6] / scale_information, by_scale
        )
        if n_seconds == TUNING.memory_s and self.alarm is None:
            self._old = (1.0 - 1.0 / TUNING.old_memory_s) * self._old + self._seconds.sums[0]
        stamps_ns = np.append(self._stamps_ns, np.int64(second.stamp_ns))
        self._stamps_ns = stamps_ns[-TUNING.memory_s :]
        tables = np.concatenate([self._seconds.sums, table[None]])
        self._seconds = Blocks(tables[-TUNING.memory_s :])
        share = 1.0 / TUNING.noise_memory_s
        self._noise = (1.0 - share) * self._noise + share * scatter
        n_averaged = min(n_seconds + 1, 100)
        self._motions_per_s += (len(second.residuals) - self._motions_per_s) / n_averaged

    # ------------------------------------------------------------- the test

    def _test(self) -> None:
        """Raise an alarm, or update an alarm that has become clearer."""
        if self.seconds % TUNING.long_run_every_s == 0 or self.seconds <= TUNING.learning_s:
            self.long_run = _long_run_variance(self._seconds, self.long_run)
        if len(self._stamps_ns) < _LAGS[0]:
            return
        lags, tables = self._shifts()
        ratios = moved.log_ratio(tables, KNOCKS[:, None]).max(axis=0)
        best = int(np.argmax(ratios))
        least_ratio = self.alarm.log_ratio if self.alarm else TUNING.threshold
        if ratios[best] < least_ratio:
            return
        H = information(tables[best])
        S = score(tables[best])
        covariance = np.linalg.inv(H + np.linalg.inv(moved.shift_covariance(1.0, 1.0)))
        to_parent = se3.block_diagonal(se3.rotation_of(self._installed))
        values = to_parent @ covariance @ S
        shift = change.moved(values, to_parent @ covariance @ to_parent.T, np.zeros(6))
        log_ratio = float(ratios[best])
        if self.alarm:
            self.alarm = replace(self.alarm, shift=shift, log_ratio=log_ratio)
            return
        self.alarm = Alarm(
            since_ns=int(self._stamps_ns[-lags[best]]),
            raised_ns=int(self._stamps_ns[-1]),
            shift=shift,
            log_ratio=log_ratio,
        )

    def _shifts(self) -> tuple[IntArray, FloatArray]:
        """Return the evidence of a shift at each tested time.

        It includes the long-run variance and the uncertainty of the offset before the shift.

        Returns
        -------
        lags : (l,) int array
            Seconds since the shift; the last lag is the whole memory.
        tables : (l, 6, 7) array
        """
        n_seconds = len(self._stamps_ns)
        lags = _LAGS[: np.searchsorted(_LAGS, n_seconds, side="right")]
        since = self._seconds.since(n_seconds - lags)
        since = np.concatenate([since, [self._old + self._seconds.total]]) / self.long_run
        before = since[-1] - since
        covariances = inverse(inverse(self._covariance) + information(before))
        offsets = se3.times(covariances, score(before))
        tables = shift_evidence(since, offsets, covariances + self._wander)
        return np.append(lags, n_seconds), tables

    def digest(self, parent_frame: str, child_frame: str) -> Digest | None:
        """Return the evidence of the session on the mount; None while the noise is learned."""
        if self.is_learning:
            return None
        return Digest(
            parent_frame=parent_frame,
            child_frame=child_frame,
            start_ns=self._start_ns,
            end_ns=int(self._stamps_ns[-1]),
            seconds=self.seconds,
            installed=self._installed,
            covariance=self._covariance,
            wander=self._wander,
            evidence=(self._old + self._seconds.total) / self.long_run,
            alarm=str(self.alarm) if self.alarm else "",
        )

    def visible(self, seconds: float) -> FloatArray:
        """Return the shifts (6,) that are detected in nine of ten cases.

        They are along (m) and about (rad) each axis of the parent sensor, after so many seconds of
        motion like the motion so far. They are infinite while learning.
        """
        if self.is_learning:
            return np.full(6, np.inf)
        H = information(self._seconds.total)
        before = (information(self._old) + H) / self.long_run
        cov_before = np.linalg.inv(np.linalg.inv(self._covariance) + before) + self._wander
        H = H / len(self._stamps_ns)
        # Subtract the spurious translation information that rotation noise produces: rotations that
        # never took place reveal nothing.
        turns = se3.skew(np.eye(3))
        precision = np.linalg.inv(self._noise)[:3, :3]
        spurious = np.einsum("jk,jai,ab,kbl->il", self._noise[3:, 3:], turns, precision, turns)
        H[:3, :3] -= self._motions_per_s * spurious
        H *= seconds / self.long_run
        scale = np.sqrt(np.diag(moved.shift_covariance(100.0, np.pi)))
        values, vectors = np.linalg.eigh(scale[:, None] * H * scale)
        root = scale[:, None] * vectors / np.sqrt(1.0 + np.maximum(values, 0.0))
        covariance = root @ root.T + cov_before
        # The ratio of a shift of z standard deviations along or about an axis is
        # (z^2 - log_volume) / 2.
        volumes = np.eye(6) + KNOCKS[:2] @ np.linalg.inv(covariance)
        log_volumes = np.linalg.slogdet(volumes)[1]
        detected_sigmas = np.sqrt(2.0 * TUNING.threshold + log_volumes) + NINE_TIMES_OUT_OF_TEN
        sigmas = sigmas_in_parent(se3.rotation_of(self._installed), covariance)
        return np.asarray(np.repeat(detected_sigmas, 3) * sigmas)


def _is_motion(motions: MotionPairs, noise: FloatArray) -> bool:
    """Whether the sensors move: at rest, noise would look like information."""
    parent = motions.Ts_parenti_parentj
    angle_rad = np.median(se3.rotation_angle(se3.rotation_of(parent)))
    distance_m = np.median(np.linalg.norm(se3.translation_of(parent), axis=1))
    noise_rad = float(np.sqrt(np.trace(noise[3:, 3:]) / 3))
    least_rad = max(TUNING.least_rotation_rad, TUNING.least_of_noise * noise_rad)
    return bool(angle_rad > least_rad or distance_m > TUNING.least_motion_m)


def _evidence(
    residuals: FloatArray,
    jacobians: FloatArray,
    noise: FloatArray,
    shift: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return the evidence (p, p + 1) of motions on p parameters, and their scatter (6, 6).

    The weights and the scatter are about the residuals after a shift (p,), zero by default.
    """
    centred = residuals if shift is None else residuals + jacobians @ shift
    squared = np.einsum("ki,ki->k", centred @ np.linalg.inv(noise), centred)
    weights = robust_weights("student", squared)
    table = moved.evidence(residuals, jacobians, noise, weights).sum(axis=0)
    return table, (weights[:, None] * centred).T @ centred / len(centred)


def _long_run_variance(seconds: Blocks, previous: float) -> float:
    """Return the long-run variance of the scores in units of their information.

    It is the largest over windows of several lengths, about the answer of all seconds; the previous
    value while there are too few windows.
    """
    shift = moved.most_likely(seconds.total, TUNING.ridge)
    prior = TUNING.assumed_windows * TUNING.assumed
    variances = []
    for length in TUNING.windows_s:
        n_windows = len(seconds.sums) // length
        if n_windows < TUNING.assumed_windows:
            break
        windows = Blocks(seconds.sums[-n_windows * length :]).merged(n_windows)
        squares = moved.squares_about(windows.sums, shift, TUNING.ridge)
        limited = np.minimum(squares, TUNING.most_of_typical * np.median(squares))
        variances.append((limited.sum() / 6 + prior) / (n_windows + TUNING.assumed_windows))
    return max(variances, default=previous)


class MountWatch:
    """Monitor of a live session: takes its pose pairs about once a second.

    Parameters
    ----------
    session : LiveSession
    installed : callable
        Returns the pose of the child's frame in the parent's frame by the names of both; None while
        it is unknown.
    why_unknown : callable
        Returns the reason why it is unknown.
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
        """Start again after the stamps have jumped back, without loss of what was learned."""
        self._last_ns = -1
        if self._monitor is not None:
            self._monitor.restart()

    def look(self) -> None:
        """Add the new pose pairs to the monitor, and log an alarm."""
        calibrator = self._session.calibrator
        pairs = calibrator.take_pairs()
        pairs = pairs[pairs.stamps_ns > self._last_ns]
        if self._monitor is None and len(pairs):  # the frames are known from the first pair on
            snapshot = calibrator.snapshot()
            installed = self._installed(snapshot.parent_frame, snapshot.child_frame)
            if installed is not None:
                self._frames = snapshot.parent_frame, snapshot.child_frame
                self._monitor = MountMonitor(installed.T_parent_child, installed.covariance)
        if self._monitor is not None and len(pairs):
            self._last_ns = int(pairs.stamps_ns[-1])
            if alarm := self._monitor.add(pairs):
                self._log.error(str(alarm))

    def save(self, directory: Path) -> Outcome:
        """Write the digest of the session; return whether it is written, and a line about it."""
        digest = self._monitor.digest(*self._frames) if self._monitor else None
        if digest is None:
            return False, "no digest of the mount yet: the noise is being learned"
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
        """Return whether the mount has moved, and the shifts that are visible on this robot."""
        monitor = self._monitor
        if monitor is None:
            return MountState(level=Level.WARN, text=self._why_unknown() or "no poses yet")
        visible = monitor.visible(TUNING.session_s)
        alarm = monitor.alarm
        if alarm is not None:
            text = str(alarm)
        elif monitor.is_learning:
            text = f"learning the noise: {monitor.seconds} of {TUNING.learning_s} s of motion"
        else:
            text = "the mount has not moved"
            is_hidden = visible > SEEN_TARGETS * np.array(self._session.calibrator.config.targets)
            if is_hidden.any():
                hidden = axes_in_words([AXES[index] for index in np.flatnonzero(is_hidden)])
                text += f"; {hidden} cannot be monitored with this motion"
        visible = np.where(visible < change.UNKNOWN_FROM, visible, np.nan)
        shift = alarm.shift.axes if alarm else {}
        return MountState(
            level=Level.ERROR if alarm else Level.OK,
            text=text,
            is_learning=monitor.is_learning,
            seconds_of_motion=monitor.seconds,
            shift={AXIS_KEYS[axis]: row.difference for axis, row in shift.items()},
            shift_sigma={AXIS_KEYS[axis]: row.sigma for axis, row in shift.items()},
            visible_10min=by_axis(visible),
            since_ns=alarm.since_ns if alarm else None,
            newest_ns=self._last_ns,
        )
