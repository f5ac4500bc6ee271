"""Checks that two streams are independent measurements.

A stream may have been computed from the other stream through an assumed transform. The extrinsic
would then only be a copy of this transform.
:mod:`~hand_eye_calib.core.checks.fusion` checks streams that a filter fuses.

Model: the errors of two sensors are independent. The difference of the aligned streams then
contains the noise of both, and odometries drift against each other. If one stream was computed from
the other, the difference has less noise or no drift.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.stats import (
    masked_medians,
    median,
    quantile,
    robust_regression,
    robust_weights,
)
from hand_eye_calib.core.base.text import angle, length
from hand_eye_calib.core.checks.fault_regression import ROUNDS
from hand_eye_calib.core.checks.findings import Finding, Severity, finding
from hand_eye_calib.core.checks.stream_pair import (
    MAX_ROTATION_RAD,
    MIN_PAIRS,
    StreamPair,
)
from hand_eye_calib.core.checks.streams import USUAL, coarse
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import (
    MotionPairs,
    PosePairs,
    pairs_between,
)
from hand_eye_calib.core.solvers.all_pairs import align_rotation_vectors

# Orientations agree to rounding if their residual (rad) is below this angle: numbers with five
# digits.
_ROUNDING_RAD = 0.01 * np.radians(0.08)
# The residual must also be below this share of the angle of rotation between the poses.
_SMALL_SHARE = 0.005

# Interpolation adds errors. Therefore only the poses whose stamps are nearest to a stamp of the
# other stream are compared: a hundredth of all poses, but at least this number.
_MIN_NEAREST = 40
# Largest number of compared poses: if there are more, every k-th pose is used.
_MAX_NEAREST = 300

# The shared noise of both streams is measured in the upper half of their spectra. The noise counts
# as white if both quarters of this half differ by less than this factor.
_FLAT = 1.75
# The spectra of impulses are white like those of noise, so impulses are removed. An impulse is a
# sample at which the acceleration of both streams exceeds this multiple of the median.
_ABRUPT = 4.0
# Largest power of the noise of the orientations, as a share of the power of the rotation. A larger
# power may be motion that is too fast for the interval between poses.
_LITTLE_NOISE = 1e-3
# Largest ratio, for positions and for orientations, of the noise of the quieter stream to the noise
# of the difference of both streams. Sensors that shake together have ratios of 1.2 and 16.
_SHARED = np.array([3.0, 30.0])

# Duration of the windows in which positions are aligned, s.
_WINDOW_S = 3.0
# The drift is judged on paths above this length (m). Two odometries drift against each other, so
# the median distance of their aligned positions exceeds the share _LEAST_DRIFT of the path.
_LONG_PATH_M = 400.0
# Duration (s) of the steps over which the length of the path is summed.
_STEP_S = 1.0
# Smallest drift of two odometries, as a share of the path. Two sensors have 5e-5 to 6e-3; two
# outputs of one INS have 2e-8.
_LEAST_DRIFT = 2.5e-5
# The difference between two odometries grows with time, because their errors add up. The growth of
# the fastest of six axes is judged (three of positions, three of orientations). The size of the
# difference is this quantile: the sensors may rest during most of a recording.
_DIFFERENCE_SHARE = 0.9
# Shortest recording (s) whose growth is judged.
_GROWTH_S = 45.0
# Fewest poses of such a recording.
_GROWTH_POSES = 200
# Times (s) over which the growth is measured, up to a third of the recording.
_GROWN_S = (3.0, 8.0, 15.0, 30.0, 60.0)
# The difference is white noise if it grows from pose to pose by less than this factor. It grows by
# at least 1.4 for two sensors (an arm and a camera), and by at most 1.19 for copies with added
# white noise.
_WHITE_GROWTH = 1.25
# Streams do not drift if the distance of aligned positions is smaller than this factor times the
# same distance within windows of _WINDOW_S. Measured: at least 1.58 for two odometries, simulated
# and real, on paths above 200 m.
_STEADY = 1.25
# Shortest path (m) on which _STEADY is applied. Hand-held sensors in a motion capture room do not
# drift either; their paths are shorter (100 m).
_STEADY_PATH_M = 190.0
# Smallest and largest noise of the difference between a copy and its source, divided by the noise
# of the noisier stream. The noise of a copy contains the noise of its source, whereas the noise of
# two sensors adds up. Below the smallest value, the noisier stream consists of motion, or the copy
# has so little noise of its own that _SHARED detects the copy.
_NOISE_OF_COPY = (0.33, 1.1)
# The noise of one stream is regressed on the noise of the other. The factor is about 1 for a copy
# and its source, and 0 for two sensors. A stream is a copy if the factor exceeds this limit ...
_CONTAINED = 0.5
# ... if it also exceeds this number of standard deviations.
_CONTAINED_SIGMAS = 4.0
# Largest number of poses that are compared.
_MOST_POSES = 2000


def check_copies(
    given: StreamPair, aligned: StreamPair, are_exact: bool
) -> list[Finding]:
    """Detect a stream that was computed from the other stream.

    For any extrinsic, two sensors differ by their noise. A copy agrees with its source to the
    rounding of numbers. A copy with added noise shares more white noise with its source than two
    sensors do. Both tests also work with orientations alone.

    Parameters
    ----------
    given, aligned : StreamPair
        The same streams twice: with the recorded stamps, and with the child's stamps on the
        parent's clock. Other faults were already excluded.
    are_exact : bool
        Whether the user declared both streams as exact, as for motion capture. Agreement to
        rounding is then a warning instead of an error, and noise is not compared.
    """
    # A copy was interpolated from its source at the stamps of the copy. Either stream may be the
    # copy, so both are tried.
    pairs = [(streams.child, streams.parent) for streams in (given, aligned)]
    pairs += [(streams.parent, streams.child) for streams in (given, aligned)]
    residual_rad = min(
        _residual_at_nearest(computed, source) for computed, source in pairs
    )
    if residual_rad < _ROUNDING_RAD:
        severity = Severity.WARNING if are_exact else Severity.ERROR
        text = f"both streams agree to {angle(residual_rad)}, which two sensors hardly do"
        return [_doubt(text, severity, residual_rad=residual_rad)]
    if are_exact:
        return []
    excess = max(
        _shared_noise(_second_half(computed, source), source)
        for computed, source in pairs
    )
    if excess > 1.0:
        return [
            _doubt("the noise of both streams is unusually alike", more=excess)
        ]
    return []


def _doubt(
    text: str, severity: Severity | None = None, **evidence: float
) -> Finding:
    """Return the finding "not_independent" with the evidence in words, and its values."""
    return finding(
        "not_independent", "both", severity, None, evidence=text, **evidence
    )


def _within(computed: Trajectory, source: Trajectory) -> IntArray:
    """Return the indices of poses of ``computed`` between first and last stamp of ``source``."""
    first_ns, last_ns = source.stamps_ns[[0, -1]]
    stamps_ns = computed.stamps_ns
    is_within = (stamps_ns >= first_ns) & (stamps_ns <= last_ns)
    return np.flatnonzero(is_within)


def _second_half(computed: Trajectory, source: Trajectory) -> Trajectory:
    """Return the first _MAX_NEAREST poses of ``computed`` after the middle of the common time."""
    rows = _within(computed, source)
    second_half = rows[len(rows) // 2 :]
    return computed[second_half[:_MAX_NEAREST]]


def _residual_at_nearest(computed: Trajectory, source: Trajectory) -> float:
    """Return the residual angle (rad) between the rotations of both streams.

    Only the poses of ``computed`` whose stamps are nearest to a stamp of ``source`` are used.
    """
    rows = _within(computed, source)
    stamps_ns = computed.stamps_ns[rows]
    after = np.searchsorted(source.stamps_ns, stamps_ns)
    after = np.clip(after, 1, len(source) - 1)
    distances_ns = np.abs(source.stamps_ns[[after - 1, after]] - stamps_ns)
    nearest_ns = distances_ns.min(axis=0)
    n_near = max(_MIN_NEAREST, len(rows) // 100)
    limit_ns = np.sort(nearest_ns)[:n_near].max(initial=0)
    rows = rows[nearest_ns <= limit_ns]
    # Use every k-th of these poses, so that at most _MAX_NEAREST remain (division rounded up).
    every = max(-(-len(rows) // _MAX_NEAREST), 1)
    computed = computed[rows[::every]]
    of_source = source.at(computed.stamps_ns, straight=True)
    start = np.arange(len(computed) - 1)
    return _residual(pairs_between(of_source, computed.poses, start, start + 1))


def _residual(motions: MotionPairs) -> float:
    """Return the USUAL quantile of the residual angles (rad) after the best rotation of X.

    The result is infinite for too few motion pairs, or if it is not far smaller than the same
    quantile of the angles of rotation.
    """
    angles = se3.rotation_angle(se3.rotation_of(motions.Ts_parenti_parentj))
    is_clear = angles < MAX_ROTATION_RAD
    motions = motions[is_clear]
    angles = angles[is_clear]
    if len(motions) < MIN_PAIRS:
        return np.inf
    X = se3.from_rotation_translation(
        align_rotation_vectors(motions), np.zeros(3)
    )
    residual_rad = quantile(
        np.linalg.norm(motions.rotation_residuals(X), axis=1), USUAL
    )
    is_small = residual_rad < _SMALL_SHARE * quantile(angles, USUAL)
    return residual_rad if is_small else np.inf


def _shared_noise(computed: Trajectory, source: Trajectory) -> float:
    """Return the shared noise of both streams, divided by its limit for two sensors (_SHARED).

    The shared noise is the noise of the quieter stream, divided by the noise of the difference. It
    is large if one stream is a copy. The result is 0 if the noise may be motion, or if a pose is
    missing.
    """
    intervals_ns = np.diff(computed.stamps_ns)
    if len(computed) < _MIN_NEAREST or intervals_ns.max() > 1.5 * median(
        intervals_ns
    ):
        return 0.0
    of_computed = _second_differences(computed.poses)
    of_source = _second_differences(
        source.at(computed.stamps_ns, straight=True)
    )
    of_source = of_source @ se3.nearest_rotation(
        of_source[:, 1].T @ of_computed[:, 1]
    )
    difference = of_source - of_computed
    # Subtract the best lever arm from the translations of the difference.
    arms = se3.skew(of_computed[:, 1])
    lever_arm, *_ = np.linalg.lstsq(
        arms.reshape(-1, 3), difference[:, 0].ravel(), rcond=None
    )
    difference[:, 0] -= arms @ lever_arm
    is_calm = _is_calm(of_computed, of_source)
    # Axes of the spectra: quarter, stream, quantity (0 positions, 1 orientations).
    quarters = _upper_quarters(
        np.stack([of_computed, of_source, difference]) * is_calm[:, None, None]
    )
    noise = quarters[:, :2]
    noise_of_difference = quarters[:, 2]
    rotation = len(computed) * se3.rotation_of(computed.poses).var(axis=0).sum()
    if not noise[1, :, 1].max() < _LITTLE_NOISE * rotation:
        return 0.0
    smaller = noise.min(axis=1)
    common = (smaller / np.maximum(noise_of_difference, 1e-300)).min(axis=0)
    of_positions, of_orientations = (common**0.5 / _SHARED).tolist()
    is_white = (quarters.max(axis=0) < _FLAT * quarters.min(axis=0))[:2].all()
    if is_white:
        return max(of_positions, of_orientations)
    # The difference falls as steeply as motion does, and more steeply than errors that add up.
    is_steep = noise_of_difference[0, 1] > _FLAT**2 * noise_of_difference[1, 1]
    return max(of_orientations, 0.0) if is_steep else 0.0


def _second_differences(Ts: FloatArray) -> FloatArray:
    """Return second differences (N - 3, 2, 3) of the motions between neighbouring poses (N, 4, 4).

    Index 0 of the second axis is translation, index 1 is rotation.
    """
    steps = se3.log(se3.inverse(Ts[:-1]) @ Ts[1:])
    return np.diff(steps, 2, axis=0).reshape(-1, 2, 3)


def _is_calm(of_computed: FloatArray, of_source: FloatArray) -> BoolArray:
    """Return for each sample (N,) whether the streams have no common impulse.

    The arguments are second differences (N, 2, 3) of both streams.
    """
    sizes = np.linalg.norm([of_computed, of_source], axis=3)
    usual = _ABRUPT * np.median(sizes, axis=1, keepdims=True)
    return (sizes <= usual).any(axis=0).all(axis=1)


def _upper_quarters(second_differences: FloatArray) -> FloatArray:
    """Return the mean power (2, S, 2) of S streams in the third and fourth quarter of frequencies.

    ``second_differences`` is (S, N, 2, 3). The axes of the result are quarter, stream and quantity
    (positions, orientations). The power is that of the poses: the gain of the differences is
    divided out, see :func:`_upper_spectra`.
    """
    amplitudes = np.abs(np.fft.rfft(second_differences, axis=1))
    spectra = (amplitudes**2).sum(axis=3)
    half_frequencies = np.linspace(1e-3, np.pi / 2.0, spectra.shape[1])
    gain_of_difference = 2.0 * np.sin(half_frequencies)
    spectra /= gain_of_difference[:, None] ** 6
    quarters = np.array_split(spectra, 4, axis=1)
    return np.stack([quarter.mean(axis=1) for quarter in quarters[2:]])


def check_drift(pose_pairs: PosePairs, X: FloatArray) -> list[Finding]:
    """Detect streams that drift less against each other than two odometries do.

    Parameters
    ----------
    pose_pairs : PosePairs
        Pose pairs on one clock, in one unit of length.
    X : (4, 4) array
        The extrinsic.
    """
    path = coarse(Trajectory(pose_pairs.stamps_ns, pose_pairs.Ts_pw_p), _STEP_S)
    steps = np.diff(se3.translation_of(path.poses), axis=0)
    path_m = float(np.linalg.norm(steps, axis=1).sum())
    stride = 1 + len(pose_pairs) // _MOST_POSES
    aligned = _AlignedPositions.of(pose_pairs[::stride], X)
    apart_m = median(aligned.distances_m)
    is_close = path_m >= _LONG_PATH_M and apart_m <= _LEAST_DRIFT * path_m
    is_steady = path_m >= _STEADY_PATH_M and _is_steady(aligned)
    is_copy = _is_difference_white(aligned) and _is_noise_shared(pose_pairs, X)
    if not (is_close or is_steady or is_copy):
        return []
    text = f"the streams drift apart by only {length(apart_m)} over {length(path_m)}"
    return [_doubt(text, drift_m=apart_m, path_m=path_m)]


@dataclass(frozen=True, eq=False)
class _AlignedPositions:
    """Positions of both streams, aligned robustly by a rotation and a translation.

    Attributes
    ----------
    pose_pairs : PosePairs
        N pose pairs.
    Ts_pw_c : (N, 4, 4) array
        Poses of the child in the parent's world, from the parent's poses and X.
    points, others : (N, 3) arrays
        Positions of the child in the parent's world and in its own world, m.
    R : (3, 3) array
        Rotation from the child's world to the parent's world.
    distances_m : (N,) array
        Distances of the aligned positions, m.
    """

    pose_pairs: PosePairs
    Ts_pw_c: FloatArray
    points: FloatArray
    others: FloatArray
    R: FloatArray
    distances_m: FloatArray

    @classmethod
    def of(cls, pose_pairs: PosePairs, X: FloatArray) -> Self:
        """Align the positions of pose pairs for the extrinsic X (4, 4)."""
        Ts_pw_c = pose_pairs.Ts_pw_p @ X
        points = se3.translation_of(Ts_pw_c)
        others = se3.translation_of(pose_pairs.Ts_cw_c)
        are_used = np.ones(len(points), dtype=bool)
        R, distances_m = _alignment(points, others, are_used)
        return cls(pose_pairs, Ts_pw_c, points, others, R, distances_m)

    @cached_property
    def seconds(self) -> FloatArray:
        """Times (N,) since the first pose pair, s."""
        stamps_ns = self.pose_pairs.stamps_ns
        return (stamps_ns - stamps_ns[0]) * 1e-9

    @cached_property
    def from_mean(self) -> FloatArray:
        """Points (N, 3) relative to their mean, m."""
        return self.points - self.points.mean(axis=0)

    @cached_property
    def differences(self) -> FloatArray:
        """Differences (N, 3) of the aligned positions, in the parent's world, m."""
        others_from_mean = self.others - self.others.mean(axis=0)
        return others_from_mean @ self.R.T - self.from_mean

    def regressors(self, rotations: FloatArray) -> FloatArray:
        """Return the regressors (N, 3, 11) of errors of both worlds, X, scale and clock offset.

        ``rotations`` (N, 3, 3) rotate an error of the lever arm to the parent's world.
        """
        columns = [
            np.broadcast_to(np.eye(3), rotations.shape),
            se3.skew(self.from_mean),
            rotations,
            self.from_mean[:, :, None],
            np.gradient(self.points, self.seconds, axis=0)[:, :, None],
        ]
        return np.concatenate(columns, axis=2)


def _is_steady(aligned: _AlignedPositions) -> bool:
    """Return whether the streams differ over the whole recording hardly more than within seconds.

    Errors of X, scale and clock offset also cause differences. A robust regression removes them.
    """
    rows = aligned.regressors(se3.rotation_of(aligned.pose_pairs.Ts_pw_p))
    residuals = _residuals(rows, aligned.differences)
    corrected_points = aligned.points + aligned.differences - residuals
    windows_m = _apart_in_windows(
        aligned.pose_pairs.stamps_ns, corrected_points, aligned.others
    )
    distances_m = np.linalg.norm(residuals, axis=1)
    return median(distances_m) < _STEADY * windows_m


def _apart_in_windows(
    stamps_ns: IntArray, points: FloatArray, others: FloatArray
) -> float:
    """Align points (N, 3) in each window of time; return the median distance (m) in all windows."""
    # Enlarge the windows of a long recording if only few of its poses are used: a window needs
    # enough points.
    window_ns = max(
        round(_WINDOW_S * 1e9),
        round(2 * MIN_PAIRS * median(np.diff(stamps_ns))),
    )
    windows = (stamps_ns - stamps_ns[0]) // window_ns
    _, firsts, counts = np.unique(
        windows, return_index=True, return_counts=True
    )
    is_long = counts >= MIN_PAIRS
    if not is_long.any():
        return 0.0
    counts = counts[is_long]
    # Align all windows at once. Shorter windows are filled up with points that have no weight.
    in_window = np.arange(counts.max())
    rows = np.minimum(firsts[is_long, None] + in_window, len(points) - 1)
    is_inside = in_window < counts[:, None]
    _, distances_m = _alignment(points[rows], others[rows], is_inside)
    return median(masked_medians(distances_m, is_inside))


def _is_difference_white(aligned: _AlignedPositions) -> bool:
    """Return whether the difference of both streams does not grow with time."""
    seconds = aligned.seconds
    if len(seconds) < _GROWTH_POSES or seconds[-1] < _GROWTH_S:
        return False
    interval_s = median(np.diff(seconds))
    times_s = [time_s for time_s in _GROWN_S if time_s <= seconds[-1] / 3.0]
    differences = _pose_differences(aligned)
    first = _size_of_changes(differences, 1)
    sizes = [
        _size_of_changes(differences, round(time_s / interval_s))
        for time_s in times_s
    ]
    return bool((np.array(sizes) < _WHITE_GROWTH * first).all())


def _is_noise_shared(pose_pairs: PosePairs, X: FloatArray) -> bool:
    """Return whether the noise of one stream contains the noise of the other.

    Noise is white in the upper half of the spectrum. Positions or orientations without white noise
    are not compared.
    """
    streams = np.stack(
        [
            _second_differences(Ts)
            for Ts in (pose_pairs.Ts_pw_p @ X, pose_pairs.Ts_cw_c)
        ]
    )
    streams = streams * _is_calm(*streams)[:, None, None]
    difference = streams[1] - streams[0]
    # Axes of the spectra: quarter, stream, quantity (0 positions, 1 orientations).
    quarters = _upper_quarters(np.concatenate([streams, [difference]]))
    of_noisier = quarters[:, :2].max(axis=1)
    shares = (quarters[:, 2].sum(axis=0) / of_noisier.sum(axis=0)) ** 0.5
    is_white = of_noisier.max(axis=0) < _FLAT * of_noisier.min(axis=0)
    smallest, largest = _NOISE_OF_COPY
    is_noise = is_white & (shares > smallest)
    if not is_noise.any() or (shares[is_noise] > largest).any():
        return False
    of_parent, of_child = quarters[:, :2].sum(axis=0)
    # The quieter stream is first: it may be the source of the noisier one.
    is_parent_noisier = (of_parent > of_child)[:, None]
    streams = np.where(is_parent_noisier, streams[::-1], streams)
    factors, sigmas = _factors_of_noise(streams)
    is_contained = (factors > _CONTAINED) & (
        factors > _CONTAINED_SIGMAS * sigmas
    )
    is_foreign = factors + _CONTAINED_SIGMAS * sigmas < _CONTAINED
    return bool(is_contained[is_noise].any() and not is_foreign[is_noise].any())


def _factors_of_noise(streams: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Regress the noise of the second of two streams on the noise of the first.

    ``streams`` (2, N, 2, 3) are the results of :func:`_second_differences` for both streams.

    Returns
    -------
    (2,) array, (2,) array
        Factors of positions and of orientations, and their standard deviations.
    """
    source, copy = _upper_spectra(streams)
    power = (np.abs(source) ** 2).sum(axis=(0, 2))
    divisor = np.maximum(power, 1e-300)
    products = (source.conj() * copy).real
    factors = products.sum(axis=(0, 2)) / divisor
    residuals = copy - factors[:, None] * source
    mean_squares = (np.abs(residuals) ** 2).mean(axis=(0, 2))
    # The real part of a complex coefficient has half of its power.
    variances = 0.5 * mean_squares / divisor
    return factors, np.sqrt(variances)


def _upper_spectra(second_differences: FloatArray) -> NDArray[np.complex128]:
    """Return the upper half of the spectra (S, F, 2, 3) of S streams of poses.

    Parameters
    ----------
    second_differences : (S, N, 2, 3) array
        Second differences of the motions from pose to pose. They are third differences of the
        poses, which multiply the amplitude at the frequency w (rad per pose) by
        ``(2 sin(w / 2))^3``. The spectra are divided by this gain.
    """
    spectra = np.fft.rfft(second_differences, axis=1)
    n_frequencies = spectra.shape[1]
    half_frequencies = np.linspace(1e-3, np.pi / 2.0, n_frequencies)
    gain_of_difference = 2.0 * np.sin(half_frequencies)
    spectra /= gain_of_difference[:, None, None] ** 3
    return spectra[:, n_frequencies // 2 :]


def _size_of_changes(values: FloatArray, n_poses: int) -> FloatArray:
    """Return the _DIFFERENCE_SHARE quantiles (d,) of the changes of values (N, d) over n poses."""
    n_poses = max(n_poses, 1)
    changes = np.abs(values[n_poses:] - values[:-n_poses])
    row = int(_DIFFERENCE_SHARE * len(changes))
    usual = np.sort(changes, axis=0)[row]
    return np.maximum(usual, 1e-12)


def _pose_differences(aligned: _AlignedPositions) -> FloatArray:
    """Return the differences (N, 6) of child and parent poses: positions (m), orientations (rad).

    Errors of X, scale and clock offset also cause differences. A robust regression removes them.
    """
    rotations = se3.rotation_of(aligned.Ts_pw_c)
    # Without errors, the rotation from the parent's world to the child's world is constant.
    between = se3.rotation_of(aligned.pose_pairs.Ts_cw_c) @ np.swapaxes(
        rotations, 1, 2
    )
    world = se3.nearest_rotation(between.sum(axis=0))
    turns = se3.rotation_log(world.T @ between)
    steps = se3.rotation_log(rotations[1:] @ np.swapaxes(rotations[:-1], 1, 2))
    angles = np.cumsum(np.pad(steps, ((1, 0), (0, 0))), axis=0)
    rates = np.gradient(angles, aligned.seconds, axis=0)
    constant = np.broadcast_to(np.eye(3), rotations.shape)
    of_orientations = np.concatenate(
        [constant, rotations, rates[:, :, None]], axis=2
    )
    residuals = [
        _residuals(aligned.regressors(rotations), aligned.differences),
        _residuals(of_orientations, turns),
    ]
    return np.concatenate(residuals, axis=1)


def _residuals(rows: FloatArray, targets: FloatArray) -> FloatArray:
    """Return the residuals (N, 3) of targets after a robust regression on rows (N, 3, m)."""
    values, _ = robust_regression(
        "cauchy", rows, targets, ROUNDS, lambda lengths: 2.0 * median(lengths)
    )
    return targets - rows @ values


def _alignment(
    points: FloatArray, others: FloatArray, is_used: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Align points (..., N, 3) robustly by a rotation and a translation.

    Points outside the mask ``is_used`` (..., N) have no weight.

    Returns
    -------
    (..., 3, 3) array, (..., N) array
        Rotation from the others to the points, and distances of the aligned points, m.
    """
    weights = is_used.astype(float)
    for _ in range(ROUNDS):
        shares = (weights / weights.sum(axis=-1, keepdims=True))[..., None, :]
        from_mean = points - shares @ points
        others_from_mean = others - shares @ others
        weighted = weights[..., None] * from_mean
        R = se3.nearest_rotation(
            np.swapaxes(weighted, -1, -2) @ others_from_mean
        )
        aligned = others_from_mean @ np.swapaxes(R, -1, -2)
        distances_m = np.linalg.norm(from_mean - aligned, axis=-1)
        usual_m = 2.0 * masked_medians(distances_m, is_used)[..., None] + 1e-9
        squared = (distances_m / usual_m) ** 2
        weights = is_used * robust_weights("cauchy", squared)
    return R, distances_m
