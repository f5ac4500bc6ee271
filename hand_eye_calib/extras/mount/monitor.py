"""Option ``monitor: true``: detect a shift of the child sensor from the installed extrinsic.

The monitor runs for days in constant memory. Each second k of motion yields the information H_k and
the score S_k on a shift (:mod:`hand_eye_calib.core.assessment.moved`). With the long-run variance f
of the scores and the prior covariance L of a shift,

    H = sum H_k / f,   S = sum S_k / f      over the last 3 s, 4 s, ... 20 min, and over all seconds
    log ratio = 1/2 S' (H + L^-1)^-1 S - 1/2 log|I + L H|

An alarm is raised if the largest ratio exceeds a threshold: generalised likelihood ratio test (M.
Basseville, I. Nikiforov, *Detection of abrupt changes*, 1993).

Even without a shift, the pose has an offset from the installed extrinsic. Its prior covariance is
that of the extrinsic plus the common-mode error of both odometries
(:mod:`hand_eye_calib.core.assessment.covariance`). The offset is estimated from the motion before
the shift. A drifting scale, such as that of visual odometry, looks like a shift of the lever arm in
curves. Therefore each second has its own scale parameter. A sensor at rest adds no evidence.
docs/session.md lists the shifts that the monitor detects.
"""

from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from hand_eye_calib.core.assessment import change, moved
from hand_eye_calib.core.assessment.common_mode import floor_of_pairs
from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.blocks import (
    Blocks,
    information,
    inverse,
    score,
    shift_evidence,
)
from hand_eye_calib.core.base.config import STAMP_UNITS
from hand_eye_calib.core.base.stats import NINE_TIMES_OUT_OF_TEN, robust_weights
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.covariances import sigmas_in_parent
from hand_eye_calib.core.pairing.motion_pairs import (
    MotionPairs,
    PosePairs,
    pairs_between,
)
from hand_eye_calib.extras.mount.digest import Digest


@dataclass(frozen=True)
class Tuning:
    """Constants of the monitor. Times are seconds of motion, unless stated otherwise.

    docs/session.md lists the shifts that are detected with these numbers.
    """

    # Smallest logarithm of the likelihood ratio that raises an alarm.
    threshold: float = 10.0
    # Longest duration of a motion that should last one second (s).
    max_motion_s: float = 1.5
    # At most one motion begins in each interval of this length (ns).
    step_ns: int = 100_000_000
    # A second is used if the sensors move by at least this distance within it (m) ...
    min_motion_m: float = 0.05
    # ... or rotate by at least this angle (rad) ...
    min_rotation_rad: float = float(np.radians(1.5))
    # ... and by this multiple of the rotation noise.
    min_rotation_per_noise: float = 3.0
    # Duration of the motion from which the noise is estimated before the first test.
    learning_s: int = 120
    # Number of the newest seconds whose evidence is stored separately.
    memory_s: int = 1200
    # Shortest tested time since a shift (s). It is longer than a motion, so that a single jump of a
    # trajectory does not look like a shift.
    shortest_s: int = 3
    # Number of tested times since a shift, in geometric steps.
    lags: int = 16
    # Time constant (s) of the estimate of the noise.
    noise_memory_s: float = 900.0
    # Time constant (s) with which evidence older than the memory decays.
    old_memory_s: float = 20_000.0
    # Factor by which the covariance of the installed extrinsic is multiplied, as a safety margin.
    covariance_factor: float = 2.0
    # Standard deviation of the change of the common-mode error from hour to hour, as a share of
    # this error.
    wander: float = 0.25
    # Prior standard deviation of the scale error of the child in each second. A drift of 0.5 %
    # lasts for about a minute; errors that are independent in each second need sqrt(60) times as
    # much.
    scale_sigma: float = 0.04
    # Lengths (s) of the windows from whose scores the long-run variance is estimated.
    windows_s: tuple[int, ...] = (10, 30, 90, 240)
    # Interval between estimates of the long-run variance.
    long_run_every_s: int = 10
    # Prior value of the long-run variance.
    assumed: float = 10.0
    # Weight of the prior value, as a number of windows. The long-run variance is estimated from at
    # least this number of windows.
    assumed_windows: int = 4
    # Scores of windows are limited to this multiple of their median, because a shift within a
    # window increases its score.
    max_of_median: float = 20.0
    # Share of the prior information on a shift that is added to the information from the motion, so
    # that the sum is regular.
    ridge: float = 1e-3
    # Duration of the motion for which detectable shifts are reported.
    session_s: float = 600.0


TUNING = Tuning()

# Tested times since a shift (s).
_LAGS = (
    np.geomspace(TUNING.shortest_s, TUNING.memory_s, TUNING.lags)
    .round()
    .astype(int)
)
_SECOND_NS = STAMP_UNITS["s"]

# Prior covariances (3, 6, 6) of shifts: only a translation, only a rotation, or both. The second
# covariance detects a pure rotation sooner than the third.
KNOCKS = np.array(
    [
        moved.shift_covariance(radians=1e-6),
        moved.shift_covariance(1e-6),
        moved.shift_covariance(),
    ]
)


@dataclass(frozen=True)
class _Second:
    """K motions that begin within the same second. Each motion lasts about one second.

    Attributes
    ----------
    stamp_ns : int
        Start of the second, on the parent's clock.
    motions : MotionPairs
    residuals : (K, 6) array
        Residuals of A X = X B at the installed extrinsic X.
    jacobians : (K, 6, 7) array
        J in ``residuals = -J parameters + noise``. The parameters are the shift (6,) and the
        logarithm of the child's scale.
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
    seconds_before : int
        Duration of the motion before the shift (s); 0 if the mount was already displaced at the
        start.
    shift : Moved
        Shift along and about the axes of the parent sensor's frame.
    log_ratio : float
        Logarithm of the likelihood ratio of the shift against no shift.
    """

    since_ns: int
    raised_ns: int
    seconds_before: int
    shift: change.Moved
    log_ratio: float

    def __str__(self) -> str:
        """Return the axes that have moved, by how much, and since when (local time), as text."""
        since = datetime.fromtimestamp(self.since_ns * 1e-9).isoformat(
            " ", timespec="minutes"
        )
        return f"the mount has moved: {self.shift.what}, since about {since}"


class MountMonitor:
    """Monitor of the pose of the child sensor in the parent sensor's frame.

    Parameters
    ----------
    T_parent_child : (4, 4) array
        The installed extrinsic.
    covariance : (6, 6) array
        Covariance of the error xi in ``T_parent_child @ exp(xi)``; zero if it is exact.

    Attributes
    ----------
    alarm : Alarm or None
        Detected shift.
    seconds : int
        Duration of the motion so far (s).
    is_learning : bool
        Whether the noise is still being estimated from the first motions. Nothing is tested yet.
    long_run : float
        Long-run variance f of the scores, relative to their variance without correlation in time.
    """

    def __init__(
        self, T_parent_child: FloatArray, covariance: FloatArray
    ) -> None:
        self._installed = np.asarray(T_parent_child, dtype=float)
        self._covariance = TUNING.covariance_factor * np.asarray(
            covariance, dtype=float
        )
        self._wander = np.zeros((6, 6))
        self._noise = np.zeros((6, 6))
        self._learning: list[_Second] = []
        self.is_learning = True
        self._tail = PosePairs.empty()
        # Stamps and evidence of the newest seconds of motion, and the sum of older evidence.
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
            The alarm that these poses raise; None if there is none, or if it was raised before.
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
        """Accept earlier stamps again. The noise and the evidence are kept."""
        self._tail = PosePairs.empty()
        self._last_s = -1

    # ---- motions

    def _by_second(self, pose_pairs: PosePairs) -> list[_Second]:
        """Return the motions that the new poses complete, grouped by the second of their start.

        Only complete seconds are returned. Poses of an incomplete second are stored.
        """
        if len(self._tail) and len(pose_pairs):
            gap_ns = int(pose_pairs.stamps_ns[0] - self._tail.stamps_ns[-1])
            if not 0 < gap_ns <= TUNING.max_motion_s * _SECOND_NS:
                self._tail = PosePairs.empty()
        poses = PosePairs.concatenate(self._tail, pose_pairs)
        steps = poses.stamps_ns // TUNING.step_ns
        _, first_of_step = np.unique(steps, return_index=True)
        poses = poses[first_of_step]
        stamps_ns = poses.stamps_ns
        seconds = poses.stamps_ns // _SECOND_NS
        # A motion lasts from pose i to the first pose j that is at least one second later.
        j = np.searchsorted(stamps_ns, stamps_ns + _SECOND_NS)
        # Further motions may start in the second of the last finished motion, so this second is
        # incomplete. All motions of earlier seconds are finished.
        has_end = j < len(stamps_ns)
        incomplete_s = int(seconds[has_end][-1]) if has_end.any() else -1
        self._tail = poses[seconds >= incomplete_s]
        i = np.flatnonzero(
            has_end & (seconds < incomplete_s) & (seconds > self._last_s)
        )
        durations_ns = stamps_ns[j[i]] - stamps_ns[i]
        i = i[durations_ns <= TUNING.max_motion_s * _SECOND_NS]
        self._last_s = max(self._last_s, incomplete_s - 1)
        pairs = pairs_between(poses.Ts_pw_p, poses.Ts_cw_c, i, j[i])
        second_of_pair = seconds[i]
        residuals, jacobians = moved.residuals_and_jacobians(
            pairs, self._installed
        )
        # Column for the logarithm of the child's scale, which changes only the translation.
        by_scale = -se3.inverse(pairs.Ts_childi_childj)[:, :3, 3:]
        jacobians = np.append(
            jacobians, np.pad(by_scale, ((0, 0), (0, 3), (0, 0))), axis=2
        )
        complete = []
        for second in np.unique(second_of_pair).tolist():
            rows = second_of_pair == second
            stamp_ns = second * _SECOND_NS
            complete.append(
                _Second(stamp_ns, pairs[rows], residuals[rows], jacobians[rows])
            )
        return complete

    def _learn(self, second: _Second) -> None:
        """Collect the first seconds. If there are enough, estimate the noise and start to test.

        The noise is the scatter of the residuals about the shift that fits these seconds best.
        """
        self._learning.append(second)
        if len(self._learning) < TUNING.learning_s:
            return
        seconds = self._learning
        self._learning = []
        pairs = MotionPairs.concatenate(*(item.motions for item in seconds))
        # Number the poses so that each motion is a separate step: the motions then count as
        # independent.
        index = np.arange(len(pairs))
        pairs = replace(pairs, i=index, j=index + 1)
        residuals = np.concatenate([item.residuals for item in seconds])
        jacobians = np.concatenate(
            [item.jacobians[:, :, :6] for item in seconds]
        )
        self.is_learning = False
        self._noise, _ = moved.noise_covariance(residuals)
        for _ in range(2):
            table, _ = _evidence(residuals, jacobians, self._noise)
            shift = moved.most_likely(table, TUNING.ridge)
            self._noise, _ = moved.noise_covariance(
                residuals + jacobians @ shift
            )
        distances_m = np.linalg.norm(
            se3.translation_of(pairs.Ts_parenti_parentj), axis=1
        )
        speed_m_s = float(np.median(distances_m))
        floor = floor_of_pairs(
            pairs, np.ones(len(pairs)), self._installed, speed_m_s
        )
        # Keep the covariance regular.
        floor += moved.shift_covariance(1e-3, 1e-4)
        self._covariance = self._covariance + floor
        self._wander = TUNING.wander**2 * floor
        for item in seconds:
            self._add_evidence(item)

    def _add_evidence(self, second: _Second) -> None:
        """Add the evidence of a second on a shift, and update the estimate of the noise.

        The scale of the child in this second is unknown, so it is eliminated from the evidence.
        """
        n_seconds = len(self._seconds.sums)
        if (
            self.seconds % TUNING.long_run_every_s == 0
            and n_seconds >= TUNING.learning_s
        ):
            self._centre = moved.most_likely(self._seconds.total, TUNING.ridge)
        shift = np.append(self._centre, 0.0)
        table, scatter = _evidence(
            second.residuals, second.jacobians, self._noise, shift
        )
        # Eliminate the scale (row and column 6), with its prior, from the evidence [H S] (7, 8) by
        # the Schur complement.
        scale_information = table[6, 6] + self.long_run / TUNING.scale_sigma**2
        by_scale = np.delete(table[6], 6)
        table = np.delete(table[:6], 6, axis=1) - np.outer(
            table[:6, 6] / scale_information, by_scale
        )
        # The oldest second leaves the memory. After an alarm, the old evidence must stay unchanged.
        if n_seconds == TUNING.memory_s and self.alarm is None:
            kept_share = 1.0 - 1.0 / TUNING.old_memory_s
            self._old = kept_share * self._old + self._seconds.sums[0]
        stamps_ns = np.append(self._stamps_ns, np.int64(second.stamp_ns))
        self._stamps_ns = stamps_ns[-TUNING.memory_s :]
        tables = np.concatenate([self._seconds.sums, table[None]])
        self._seconds = Blocks(tables[-TUNING.memory_s :])
        share = 1.0 / TUNING.noise_memory_s
        self._noise = (1.0 - share) * self._noise + share * scatter
        # Mean over the last 100 seconds.
        n_averaged = min(n_seconds + 1, 100)
        excess = len(second.residuals) - self._motions_per_s
        self._motions_per_s += excess / n_averaged

    # ---- test

    def _test(self) -> None:
        """Raise an alarm if the largest ratio exceeds the threshold.

        If an alarm already exists, its shift is updated when the ratio has increased.
        """
        if (
            self.seconds % TUNING.long_run_every_s == 0
            or self.seconds <= TUNING.learning_s
        ):
            self.long_run = _long_run_variance(self._seconds, self.long_run)
        if len(self._stamps_ns) < _LAGS[0]:
            return
        lags, tables = self._shifts()
        ratios = moved.log_ratio(tables, KNOCKS[:, None]).max(axis=0)
        best = int(np.argmax(ratios))
        threshold = self.alarm.log_ratio if self.alarm else TUNING.threshold
        if ratios[best] < threshold:
            return
        H = information(tables[best])
        S = score(tables[best])
        covariance = np.linalg.inv(
            H + np.linalg.inv(moved.shift_covariance(1.0, 1.0))
        )
        to_parent = se3.block_diagonal(se3.rotation_of(self._installed))
        values = to_parent @ covariance @ S
        shift = change.moved(
            values, to_parent @ covariance @ to_parent.T, np.zeros(6)
        )
        log_ratio = float(ratios[best])
        if self.alarm:
            self.alarm = replace(self.alarm, shift=shift, log_ratio=log_ratio)
            return
        is_since_the_start = best == len(lags) - 1
        self.alarm = Alarm(
            since_ns=int(self._stamps_ns[-lags[best]]),
            raised_ns=int(self._stamps_ns[-1]),
            seconds_before=0
            if is_since_the_start
            else self.seconds - int(lags[best]),
            shift=shift,
            log_ratio=log_ratio,
        )

    def _shifts(self) -> tuple[IntArray, FloatArray]:
        """Return the evidence on a shift at each tested time.

        The evidence is divided by the long-run variance, and reduced by the uncertainty of the
        offset before the shift.

        Returns
        -------
        lags : (l,) int array
            Seconds since the shift. The last value is the whole memory: it represents a shift
            before it.
        tables : (l, 6, 7) array
            Information H and score S, ``[H S]``, for each lag.
        """
        n_seconds = len(self._stamps_ns)
        lags = _LAGS[: np.searchsorted(_LAGS, n_seconds, side="right")]
        since = self._seconds.since(n_seconds - lags)
        since = (
            np.concatenate([since, [self._old + self._seconds.total]])
            / self.long_run
        )
        before = since[-1] - since
        covariances = inverse(inverse(self._covariance) + information(before))
        offsets = se3.times(covariances, score(before))
        tables = shift_evidence(since, offsets, covariances + self._wander)
        return np.append(lags, n_seconds), tables

    def digest(self, parent_frame: str, child_frame: str) -> Digest | None:
        """Return the digest of the session; None before the noise is estimated."""
        if self.is_learning:
            return None
        digest = Digest(
            parent_frame=parent_frame,
            child_frame=child_frame,
            start_ns=self._start_ns,
            end_ns=int(self._stamps_ns[-1]),
            seconds=self.seconds,
            installed=self._installed,
            covariance=self._covariance,
            wander=self._wander,
            evidence=(self._old + self._seconds.total) / self.long_run,
        )
        alarm = self.alarm
        if alarm is None:
            return digest
        n_since = self.seconds - alarm.seconds_before
        evidence_since = digest.evidence
        if alarm.seconds_before:
            # The memory contains at least the newest of these seconds.
            newest = self._seconds.sums[-n_since:]
            evidence_since = newest.sum(axis=0) / self.long_run
        return replace(
            digest,
            alarm=alarm.shift.what,
            since_ns=alarm.since_ns,
            seconds_since=n_since,
            evidence_since=evidence_since,
        )

    def visible(self, seconds: float) -> FloatArray:
        """Return the shifts (6,) that are detected in nine of ten cases.

        The shifts are along (m) and about (rad) each axis of the parent sensor. They are detected
        within ``seconds`` of motion like the motion so far. Before the noise is estimated, all are
        infinite.
        """
        if self.is_learning:
            return np.full(6, np.inf)
        H = information(self._seconds.total)
        before = (information(self._old) + H) / self.long_run
        cov_before = (
            np.linalg.inv(np.linalg.inv(self._covariance) + before)
            + self._wander
        )
        H = H / len(self._stamps_ns)
        # Subtract the spurious information on the translation that rotation noise produces:
        # sum_jk noise_jk G_j' precision G_k, with the generators G_j (3, 3) of rotations.
        generators = se3.skew(np.eye(3))
        precision = np.linalg.inv(self._noise)[:3, :3]
        spurious = np.einsum(
            "jk,jai,ab,kbl->il",
            self._noise[3:, 3:],
            generators,
            precision,
            generators,
        )
        H[:3, :3] -= self._motions_per_s * spurious
        H *= seconds / self.long_run
        # Covariance from H, with a very weak prior that limits axes without information.
        scale = np.sqrt(np.diag(moved.shift_covariance(100.0, np.pi)))
        values, vectors = np.linalg.eigh(scale[:, None] * H * scale)
        root = scale[:, None] * vectors / np.sqrt(1.0 + np.maximum(values, 0.0))
        covariance = root @ root.T + cov_before
        # A shift of z standard deviations has the log ratio (z^2 - log|I + L C^-1|) / 2: C is the
        # covariance, and L the prior covariance of a translation or a rotation.
        volumes = np.eye(6) + KNOCKS[:2] @ np.linalg.inv(covariance)
        log_volumes = np.linalg.slogdet(volumes)[1]
        detected_sigmas = (
            np.sqrt(2.0 * TUNING.threshold + log_volumes)
            + NINE_TIMES_OUT_OF_TEN
        )
        sigmas = sigmas_in_parent(se3.rotation_of(self._installed), covariance)
        return np.repeat(detected_sigmas, 3) * sigmas


def _is_motion(motions: MotionPairs, noise: FloatArray) -> bool:
    """Return whether the sensors move. At rest, noise would look like information."""
    parent = motions.Ts_parenti_parentj
    angle_rad = np.median(se3.rotation_angle(se3.rotation_of(parent)))
    distance_m = np.median(np.linalg.norm(se3.translation_of(parent), axis=1))
    noise_rad = float(np.sqrt(np.trace(noise[3:, 3:]) / 3))
    min_rad = max(
        TUNING.min_rotation_rad, TUNING.min_rotation_per_noise * noise_rad
    )
    return bool(angle_rad > min_rad or distance_m > TUNING.min_motion_m)


def _evidence(
    residuals: FloatArray,
    jacobians: FloatArray,
    noise: FloatArray,
    shift: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return the evidence (p, p + 1) of motions on p parameters, and the scatter (6, 6).

    Motions with large residuals get smaller weights. Weights and scatter are computed from the
    residuals after the parameters ``shift`` (p,), which are zero by default.
    """
    centred = residuals if shift is None else residuals + jacobians @ shift
    squared = np.einsum("ki,ki->k", centred @ np.linalg.inv(noise), centred)
    weights = robust_weights("student", squared)
    table = moved.evidence(residuals, jacobians, noise, weights).sum(axis=0)
    scatter = (weights[:, None] * centred).T @ centred / len(centred)
    return table, scatter


def _long_run_variance(seconds: Blocks, previous: float) -> float:
    """Return the long-run variance of the scores, relative to the variance without correlation.

    For windows of several lengths, the mean of the squared scores about the best shift is computed.
    The largest mean is used. If all lengths have too few windows, ``previous`` is returned.
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
        limited = np.minimum(squares, TUNING.max_of_median * np.median(squares))
        variances.append(
            (limited.sum() / 6 + prior) / (n_windows + TUNING.assumed_windows)
        )
    return max(variances, default=previous)
