"""``monitor: true``: has the child sensor moved against the installed extrinsic?

For days on end, in constant memory. Every second of motion adds its information about a shift from
the installed extrinsic (:mod:`hand_eye_calib.core.assessment.moved`). The likelihood ratio of a
shift is taken over the last three seconds of motion, the last four, ... up to twenty minutes, and
over all of them; the largest tells. It is measured by what the scores really scatter over time.

What was there before a shift, the installed extrinsic is off by: by its own uncertainty, and by the
common-mode error of both odometries (:mod:`hand_eye_calib.core.assessment.covariance`). It is
learned from all motion before. A scale that drifts, as that of visual odometry, looks like a lever
arm in curves: in each second the scale is a parameter. Standing still adds nothing. docs/session.md
has what the monitor can see.
"""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from typing import TypeAlias

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
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.live.session import LiveSession
from hand_eye_calib.online.live.state import Level, MountState, by_axis


@dataclass(frozen=True)
class Tuning:
    """Numbers of the search; times are seconds of motion unless it is said."""

    # Log likelihood ratio from which on the mount has moved.
    threshold: float = 10.0
    # Motions over a second are compared, and not those that took so many times as long; at most one
    # begins in each of these steps (ns).
    most_late: float = 1.5
    step_ns: int = 100_000_000
    # A second counts if the sensors move by this much within it (m, rad), and by so many times the
    # noise of the rotation.
    least_motion_m: float = 0.05
    least_rotation_rad: float = float(np.radians(1.5))
    least_of_noise: float = 3.0
    # The noise is learned from so many seconds before anything is judged; so many are kept.
    learning_s: int = 120
    memory_s: int = 1200
    # Shortest time over which a shift is looked for: longer than the motions, so that one jump of a
    # trajectory is no shift. And how many times there are up to those that are kept.
    shortest_s: int = 3
    lags: int = 16
    # Time over which the noise is followed, and over which older motion is forgotten.
    noise_memory_s: float = 900.0
    old_memory_s: float = 20_000.0
    # Factor on the variances that the installed extrinsic states; how much of the common-mode error
    # differs from hour to hour (one standard deviation, as a share).
    caution: float = 2.0
    wander: float = 0.25
    # Standard deviation of the child's scale in a second. A scale that drifts by 0.5 % is wrong for
    # a minute; as errors that are new in each second, that is sqrt(60) times as much.
    scale_sigma: float = 0.04
    # Windows (s) whose scores show the long-run variance, which is taken anew every so many
    # seconds. What is assumed of it beforehand counts as much as so many windows, and fewer say
    # nothing. A shift spoils some: none counts for more than so many times the typical one.
    windows_s: tuple[int, ...] = (10, 30, 90, 240)
    long_run_every_s: int = 10
    assumed: float = 10.0
    assumed_windows: int = 4
    most_of_typical: float = 20.0
    # Share of the information of the shifts that are looked for, without which a shift may be
    # anything.
    ridge: float = 1e-3
    # What can be seen is told for a session of so many seconds.
    session_s: float = 600.0


TUNING = Tuning()

_LAGS = np.geomspace(TUNING.shortest_s, TUNING.memory_s, TUNING.lags).round().astype(int)
_SECOND_NS = 1_000_000_000

# What a knock may be: a translation, a rotation, both. A knock that only turns the sensor shows
# sooner against the second.
_KNOCKS = np.array(
    [moved.shift_covariance(radians=1e-6), moved.shift_covariance(1e-6), moved.shift_covariance()]
)

# A second, its motions (K), their residuals (K, 6) at the installed extrinsic and the negative
# derivatives (K, 6, 7) of these by a shift and by the logarithm of the child's scale.
_Second: TypeAlias = tuple[int, MotionPairs, FloatArray, FloatArray]

# Of the session that is watched, poses are paired soon, and few are kept.
LIMITS = BufferLimits(
    capacity=4_000, pairing_starts=32, batch=64, batch_every=16, late_ns=500_000_000
)


@dataclass(frozen=True, kw_only=True)
class Alarm:
    """The mount has moved, from the installed pose, since about a stamp of the parent's clock; that
    was clear at another.
    """

    since_ns: int
    raised_ns: int
    shift: change.Moved
    log_ratio: float

    def __str__(self) -> str:
        """Which axes have moved, by how much, since when (local time)."""
        since = datetime.fromtimestamp(self.since_ns * 1e-9).isoformat(" ", timespec="minutes")
        return f"the mount has moved: {self.shift.what}, since about {since}"


class MountMonitor:
    """Watches the pose of the child sensor in the parent sensor's frame.

    Parameters
    ----------
    T_parent_child : (4, 4) array
        The installed extrinsic.
    covariance : (6, 6) array
        Of the error xi in ``T_parent_child @ exp(xi)``; zero if it is exact.

    Attributes
    ----------
    alarm : Alarm or None
        The shift that has been seen.
    seconds : int
        Seconds of motion seen so far; the noise is learned from the first, and nothing is judged
        while ``is_learning``.
    """

    def __init__(self, T_parent_child: FloatArray, covariance: FloatArray) -> None:
        self._installed = np.asarray(T_parent_child, dtype=float)
        self._covariance = TUNING.caution * np.asarray(covariance, dtype=float)
        self._wander = np.zeros((6, 6))
        self._noise = np.zeros((6, 6))
        self._learning: list[_Second] = []
        self.is_learning = True
        self._tail = PosePairs.empty()
        # Evidence of the newest seconds of motion, and the sum of those before them.
        self._stamps_ns: IntArray = np.zeros(0, dtype=np.int64)
        self._seconds = Blocks(np.zeros((0, 6, 7)))
        self._old = np.zeros((6, 7))
        self._centre = np.zeros(6)
        self._last_s = -1
        self._motions_per_s = 0.0
        self.alarm: Alarm | None = None
        self.seconds = 0
        self.long_run = TUNING.assumed

    def add(self, pose_pairs: PosePairs) -> Alarm | None:
        """Take the poses that follow those before.

        Returns
        -------
        Alarm or None
            A new one, if it was raised by these poses.
        """
        before = self.alarm
        raised = None
        for second in self._by_second(pose_pairs):
            stamp_ns, motions, *terms = second
            if not _is_motion(motions, self._noise):
                continue
            self.seconds += 1
            if self.is_learning:
                self._learn(second)
            else:
                self._take(stamp_ns, *terms)
            if not self.is_learning:
                self._judge()
            raised = raised or (None if before else self.alarm)
        return raised

    def restart(self) -> None:
        """Begin anew with stamps of any time; what was learned stays."""
        self._tail = PosePairs.empty()
        self._last_s = -1

    # ------------------------------------------------------------- the motions

    def _by_second(self, pose_pairs: PosePairs) -> list[_Second]:
        """Motions over a second that end in these poses, by the second in which they begin."""
        if len(self._tail) and len(pose_pairs):
            late_ns = int(pose_pairs.stamps_ns[0] - self._tail.stamps_ns[-1])
            if not 0 < late_ns <= TUNING.most_late * _SECOND_NS:
                self._tail = PosePairs.empty()
        poses = PosePairs.concatenate(self._tail, pose_pairs)
        poses = poses[np.unique(poses.stamps_ns // TUNING.step_ns, return_index=True)[1]]
        stamps_ns = poses.stamps_ns
        seconds = poses.stamps_ns // _SECOND_NS
        j = np.searchsorted(stamps_ns, stamps_ns + _SECOND_NS)
        # A second is complete once a motion of the next one has its end.
        has_end = j < len(stamps_ns)
        under_way = int(seconds[has_end][-1]) if has_end.any() else -1
        self._tail = poses[seconds >= under_way]
        i = np.flatnonzero(has_end & (seconds < under_way) & (seconds > self._last_s))
        i = i[stamps_ns[j[i]] - stamps_ns[i] <= TUNING.most_late * _SECOND_NS]
        self._last_s = max(self._last_s, under_way - 1)
        pairs = pairs_between(poses.Ts_pw_p, poses.Ts_cw_c, i, j[i])
        of_pairs = seconds[i]
        residuals, jacobians = moved.residuals_and_jacobians(pairs, self._installed)  # all at once
        by_scale = -se3.inverse(pairs.Ts_childi_childj)[:, :3, 3:]
        jacobians = np.append(jacobians, np.pad(by_scale, ((0, 0), (0, 3), (0, 0))), axis=2)
        parts = [(each * _SECOND_NS, of_pairs == each) for each in np.unique(of_pairs).tolist()]
        return [(ns, pairs[part], residuals[part], jacobians[part]) for ns, part in parts]

    def _learn(self, second: _Second) -> None:
        """Collect motions; once there are enough, learn the noise about their own answer."""
        self._learning.append(second)
        if len(self._learning) < TUNING.learning_s:
            return
        learned = self._learning
        self._learning = []
        parent = np.concatenate([each.Ts_parenti_parentj for _, each, *_ in learned])
        child = np.concatenate([each.Ts_childi_childj for _, each, *_ in learned])
        index = np.arange(len(parent))
        pairs = MotionPairs(parent, child, index, index + 1)
        residuals = np.concatenate([each for *_, each, _ in learned])
        jacobians = np.concatenate([each[:, :, :6] for *_, each in learned])
        self.is_learning = False
        self._noise, _ = moved.noise_covariance(residuals)
        for _ in range(2):
            table, _ = _information(residuals, jacobians, self._noise)
            shift = moved.most_likely(table, TUNING.ridge)
            self._noise, _ = moved.noise_covariance(residuals + jacobians @ shift)
        speed_m_s = float(np.median(np.linalg.norm(parent[:, :3, 3], axis=1)))
        floor = floor_of_pairs(pairs, np.ones(len(parent)), self._installed, speed_m_s)
        floor += moved.shift_covariance(1e-3, 1e-4)  # never singular
        self._covariance = self._covariance + floor
        self._wander = TUNING.wander**2 * floor
        for second_ns, _, *terms in learned:
            self._take(second_ns, *terms)

    def _take(self, stamp_ns: int, residuals: FloatArray, jacobians: FloatArray) -> None:
        """Add the information of a second whatever the scale in it, and follow the noise."""
        n_seconds = len(self._seconds.sums)
        if self.seconds % TUNING.long_run_every_s == 0 and n_seconds >= TUNING.learning_s:
            self._centre = moved.most_likely(self._seconds.total, TUNING.ridge)
        shift = np.append(self._centre, 0.0)
        table, scatter = _information(residuals, jacobians, self._noise, shift)
        of_scale = table[6, [0, 1, 2, 3, 4, 5, 7]]
        share = table[:6, 6] / (table[6, 6] + self.long_run / TUNING.scale_sigma**2)
        table = np.delete(table[:6], 6, axis=1) - np.outer(share, of_scale)
        if n_seconds == TUNING.memory_s and self.alarm is None:
            self._old = (1.0 - 1.0 / TUNING.old_memory_s) * self._old + self._seconds.sums[0]
        self._stamps_ns = np.append(self._stamps_ns, np.int64(stamp_ns))[-TUNING.memory_s :]
        tables = np.concatenate([self._seconds.sums, table[None]])
        self._seconds = Blocks(tables[-TUNING.memory_s :])
        share = 1.0 / TUNING.noise_memory_s
        self._noise = (1.0 - share) * self._noise + share * scatter
        n_seconds = min(n_seconds + 1, 100)
        self._motions_per_s += (len(residuals) - self._motions_per_s) / n_seconds

    # ------------------------------------------------------------- the judgement

    def _judge(self) -> None:
        """Raise an alarm, or follow one that has become clearer."""
        if self.seconds % TUNING.long_run_every_s == 0 or self.seconds <= TUNING.learning_s:
            self.long_run = _long_run_variance(self._seconds, self.long_run)
        if len(self._stamps_ns) < _LAGS[0]:
            return
        lags, tables = self._shifts()
        ratios = moved.log_ratio(tables, _KNOCKS[:, None]).max(axis=0)
        best = int(np.argmax(ratios))
        if ratios[best] < (self.alarm.log_ratio if self.alarm else TUNING.threshold):
            return
        H = information(tables[best])
        S = score(tables[best])
        covariance = np.linalg.inv(H + np.linalg.inv(moved.shift_covariance(1.0, 1.0)))
        to_parent = np.kron(np.eye(2), self._installed[:3, :3])
        since_ns = int(self._stamps_ns[-lags[best]])
        raised_ns = int(self._stamps_ns[-1])
        self.alarm = Alarm(
            since_ns=self.alarm.since_ns if self.alarm else since_ns,
            raised_ns=self.alarm.raised_ns if self.alarm else raised_ns,
            shift=change.moved(
                to_parent @ covariance @ S, to_parent @ covariance @ to_parent.T, np.zeros(6)
            ),
            log_ratio=float(ratios[best]),
        )

    def _shifts(self) -> tuple[IntArray, FloatArray]:
        """Lags (l,), and the evidence (l, 6, 7) of a shift over each, with the long-run variance
        and the uncertainty of what was before counted in; the last lag is all there is.
        """
        n_seconds = len(self._stamps_ns)
        lags = _LAGS[: np.searchsorted(_LAGS, n_seconds, side="right")]
        since = self._seconds.since(n_seconds - lags)
        since = np.concatenate([since, [self._old + self._seconds.total]]) / self.long_run
        before = since[-1] - since
        covariances = inverse(inverse(self._covariance) + information(before))
        known = se3.times(covariances, score(before))
        tables = shift_evidence(since, known, covariances + self._wander)
        return np.append(lags, n_seconds), tables

    def visible(self, seconds: float) -> FloatArray:
        """Shifts (6,) along (m) and about (rad) each axis of the parent sensor that so many seconds
        of motion like that so far would show nine times out of ten; infinite while learning.
        """
        if self.is_learning:
            return np.full(6, np.inf)
        H = information(self._seconds.total)
        known = (information(self._old) + H) / self.long_run
        before = np.linalg.inv(np.linalg.inv(self._covariance) + known) + self._wander
        H = H / len(self._stamps_ns)
        # Of that, what the rotation noise of a motion seems to tell of a translation: rotations
        # that never took place reveal nothing.
        turns = se3.skew(np.eye(3))
        of_noise = np.linalg.inv(self._noise)[:3, :3]
        seeming = np.einsum("jk,jai,ab,kbl->il", self._noise[3:, 3:], turns, of_noise, turns)
        H[:3, :3] -= self._motions_per_s * seeming
        H *= seconds / self.long_run
        scale = np.sqrt(np.diag(moved.shift_covariance(100.0, np.pi)))
        values, vectors = np.linalg.eigh(scale[:, None] * H * scale)
        root = scale[:, None] * vectors / np.sqrt(1.0 + np.maximum(values, 0.0))
        covariance = root @ root.T + before
        # A shift along or about an axis of z standard deviations has the ratio z^2 / 2 less this.
        precision = np.linalg.inv(covariance)
        _, log_volumes = np.linalg.slogdet(np.eye(6) + _KNOCKS[:2] @ precision)
        seen_sigmas = np.sqrt(2.0 * TUNING.threshold + log_volumes) + NINE_TIMES_OUT_OF_TEN
        sigmas = sigmas_in_parent(self._installed[:3, :3], covariance)
        return np.asarray(np.repeat(seen_sigmas, 3) * sigmas)


def _is_motion(motions: MotionPairs, noise: FloatArray) -> bool:
    """Whether the sensors move: where they stand, noise would look like information."""
    parent = motions.Ts_parenti_parentj
    rotation = np.median(se3.rotation_angle(parent[:, :3, :3]))
    distance = np.median(np.linalg.norm(parent[:, :3, 3], axis=1))
    of_noise = np.sqrt(np.trace(noise[3:, 3:]) / 3)
    least = max(TUNING.least_rotation_rad, TUNING.least_of_noise * float(of_noise))
    return bool(rotation > least or distance > TUNING.least_motion_m)


def _information(
    residuals: FloatArray,
    jacobians: FloatArray,
    noise: FloatArray,
    shift: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Evidence (p, p + 1) of motions on p parameters, and their weighted scatter (6, 6) about given
    ones.
    """
    centred = residuals if shift is None else residuals + jacobians @ shift
    squared = np.einsum("ki,ki->k", centred @ np.linalg.inv(noise), centred)
    weights = robust_weights("student", squared)
    table = moved.evidence(residuals, jacobians, noise, weights).sum(axis=0)
    return table, (weights[:, None] * centred).T @ centred / len(centred)


def _long_run_variance(seconds: Blocks, known: float) -> float:
    """Long-run variance of the scores in units of the information, from those of seconds: the
    largest over windows of several lengths, each about the answer of all; what is known while there
    are too few.
    """
    answer = moved.most_likely(seconds.total, TUNING.ridge)
    found = []
    for length in TUNING.windows_s:
        n_windows = len(seconds.sums) // length
        if n_windows < TUNING.assumed_windows:
            break
        windows = Blocks(seconds.sums[-n_windows * length :]).merged(n_windows)
        squared = moved.squares_about(windows.sums, answer, TUNING.ridge)
        seen = np.minimum(squared, TUNING.most_of_typical * np.median(squared)).sum() / 6
        found.append(
            (seen + TUNING.assumed_windows * TUNING.assumed) / (n_windows + TUNING.assumed_windows)
        )
    return max(found, default=known)


class MountWatch:
    """Feeds the monitor with the pose pairs of the session, once a second. ``installed`` gives the
    pose of the child's frame in the parent's; None while it is not known, for which ``why_unknown``
    gives the reason.
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

    def restart(self) -> None:
        """The stamps have jumped back: nothing runs across; what was learned stays."""
        self._last_ns = -1
        if self._monitor is not None:
            self._monitor.restart()

    def look(self) -> None:
        """Judge what has come in; to be called about once a second."""
        calibrator = self._session.calibrator
        pairs = calibrator.take_pairs()
        pairs = pairs[pairs.stamps_ns > self._last_ns]
        if self._monitor is None and len(pairs):  # before the first, the frames are not known
            snapshot = calibrator.snapshot()
            installed = self._installed(snapshot.parent_frame, snapshot.child_frame)
            if installed is not None:
                self._monitor = MountMonitor(installed.T_parent_child, installed.covariance)
        if self._monitor is not None and len(pairs):
            self._last_ns = int(pairs.stamps_ns[-1])
            if alarm := self._monitor.add(pairs):
                self._log.error(str(alarm))

    def state(self) -> MountState:
        """Whether the mount has moved, and what can be seen of it on this robot."""
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
            hidden = visible > SEEN_TARGETS * np.array(self._session.calibrator.config.targets)
            unwatched = axes_in_words([AXES[index] for index in np.flatnonzero(hidden)])
            text = "the mount has not moved"
            text += f"; {unwatched} cannot be watched here" if unwatched else ""
        told = np.where(visible < change.UNKNOWN_FROM, visible, np.nan)
        shift = alarm.shift.axes if alarm else {}
        return MountState(
            level=Level.ERROR if alarm else Level.OK,
            text=text,
            is_learning=monitor.is_learning,
            seconds_of_motion=monitor.seconds,
            shift={axis: each.difference for axis, each in shift.items()},
            shift_sigma={axis: each.sigma for axis, each in shift.items()},
            visible_10min=by_axis(told),
            since_ns=alarm.since_ns if alarm else None,
            newest_ns=self._last_ns,
        )
