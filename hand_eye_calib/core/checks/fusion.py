"""Check whether a filter corrects one stream by the other stream through an assumed mount.

Example: a filter adds the steps of a camera's odometry, and pulls its poses towards those of a
lidar. The pull uses an assumed extrinsic from a TF tree. Fast motions of the filtered stream then
contain the true mount, and slow motions the assumed mount.

Model: P is the pose of the parent, W the child's world, X the assumed mount, and ``X exp(D)`` the
true mount. A filter of time constant T pulls the difference E of the child's pose from
``W P X exp(E)`` towards zero. To first order in D, with ``Ad`` the adjoint of ``P X``,

    E_k = Ad_k^-1 N_k D,        N_k = r (N_(k-1) + Ad_k - Ad_(k-1)),        r = exp(-dt / T).

N is a high-pass filter of ``Ad``. A robust regression estimates the constant D of the mount,
for several values of T. D is zero without such a filter. The same regressors result if the filter
corrects the parent by the child, or both streams by a third stream.
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.blocks import Blocks, solve
from hand_eye_calib.core.base.stats import median, robust_weights
from hand_eye_calib.core.base.text import angle, length
from hand_eye_calib.core.checks.agreement import SHORT_S
from hand_eye_calib.core.checks.fault_regression import ROUNDS, noise_units
from hand_eye_calib.core.checks.findings import Finding, Severity, finding
from hand_eye_calib.core.checks.stream_pair import MIN_PAIRS
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import (
    MotionPairs,
    PosePairs,
    pairs_over,
)

# Time constants T (s) that are tried. A filter with a time constant between two of these values is
# detected with both values.
_TIME_CONSTANTS_S = (0.1, 0.3, 1.0, 3.0)
# Largest number of motions whose differences are fitted.
_MOST_MOTIONS = 3000
# Number of blocks of the jackknife that estimates the standard deviations.
_BLOCKS = 20
# Fewest motions in a block.
_MIN_MOTIONS_PER_BLOCK = 3

# D is significant if its rotation or its translation exceeds this number of standard deviations.
# Measured for two sensors: at most 8.4 (78 simulated and 33 real recordings).
_SIGMAS = 14.0
# D must also explain this share of the squared residuals.
_SHARE = 0.01
# Smallest rotation (rad) of D that is reported.
_LEAST_ROTATION_RAD = float(np.radians(0.3))
# Smallest translation (m) of D that is reported.
_LEAST_TRANSLATION_M = 0.01
# A rotation that explains more than this share of the squared residuals is an error: D then
# explains the differences better than any other fault could.
_CERTAIN_SHARE = 0.35


class _Fit(NamedTuple):
    """Error D of the mount that a filter with a time constant assumes.

    Attributes
    ----------
    time_constant_s : float
        Time constant of the filter, s.
    mount_change : (6,) array
        D, which leads from the assumed to the true mount: translation (m) and rotation vector
        (rad), in the child's axes.
    translation_sigmas, rotation_sigmas : float
        Sizes of the translation and of the rotation of D, in standard deviations.
    share : float
        Share of the squared residuals that D explains.
    """

    time_constant_s: float
    mount_change: FloatArray
    translation_sigmas: float
    rotation_sigmas: float
    share: float

    @property
    def translation_m(self) -> float:
        """Length of the translation of D, m."""
        return float(np.linalg.norm(self.mount_change[:3]))

    @property
    def rotation_rad(self) -> float:
        """Angle of the rotation of D, rad."""
        return float(np.linalg.norm(self.mount_change[3:]))

    @property
    def is_turned(self) -> bool:
        """Whether the rotation of D is significant."""
        is_large = self.rotation_rad > _LEAST_ROTATION_RAD
        return is_large and self.rotation_sigmas > _SIGMAS

    @property
    def is_significant(self) -> bool:
        """Whether the rotation or the translation of D is significant."""
        is_large = self.translation_m > _LEAST_TRANSLATION_M
        is_shifted = is_large and self.translation_sigmas > _SIGMAS
        return self.is_turned or is_shifted

    @property
    def is_certain(self) -> bool:
        """Whether the rotation of D explains the differences better than any other fault."""
        # Twice the limit of significance is certain, too. Measured: at most 9.0 standard deviations
        # for two sensors, at most 15.7 for 210 pairs with other faults, and at least 36 for 33
        # simulated pairs with a filter and a mount that is wrong by 3.5 deg.
        is_clear = self.share > _CERTAIN_SHARE
        is_clear = is_clear or self.rotation_sigmas > 2.0 * _SIGMAS
        return self.is_turned and is_clear


def check_correction(
    pose_pairs: PosePairs, T_parent_child: FloatArray
) -> Finding | None:
    """Detect a stream that was corrected by the other stream through a wrong mount.

    Parameters
    ----------
    pose_pairs : PosePairs
        Pose pairs on one clock, in one unit of length.
    T_parent_child : (4, 4) array
        Estimate of the extrinsic.

    Returns
    -------
    Finding or None
        An error if the filter explains most of the difference between the streams. Otherwise a
        warning, which is used only if no other fault was found.
    """
    best = _best_fit(pose_pairs, T_parent_child)
    if best is None or not best.is_significant:
        return None
    return finding(
        "not_independent",
        "both",
        Severity.ERROR if best.is_certain else None,
        evidence=f"motions shorter than {best.time_constant_s:g} s fit another mount than longer "
        f"motions: they differ by {length(best.translation_m)} and {angle(best.rotation_rad)}",
        shift_m=best.translation_m,
        turn_rad=best.rotation_rad,
        sigmas=max(best.translation_sigmas, best.rotation_sigmas),
        time_constant_s=best.time_constant_s,
    )


def _best_fit(pose_pairs: PosePairs, T_parent_child: FloatArray) -> _Fit | None:
    """Return the fit of the filter that explains most.

    The result is None for too few motions, or if no filter explains enough.
    """
    if len(pose_pairs) < MIN_PAIRS:
        return None
    differences = _Differences(pose_pairs, T_parent_child)
    if differences.n_motions < _BLOCKS * _MIN_MOTIONS_PER_BLOCK:
        return None
    regressions = (
        differences.regression(constant_s) for constant_s in _TIME_CONSTANTS_S
    )
    best = max(regressions, key=lambda regression: regression.share)
    return differences.fit(best) if best.share > _SHARE else None


class _Regression(NamedTuple):
    """Robust regression of the differences for a filter.

    Attributes
    ----------
    time_constant_s : float
        Time constant of the filter, s.
    weighted : (K, 6, p + 1) array
        Regressors and differences of K motions, times the robust weights of the motions.
    share : float
        Share of the squared residuals that D explains.
    """

    time_constant_s: float
    weighted: FloatArray
    share: float


class _Regressors:
    """Changes of the child's motions that errors of the child's poses cause.

    A regressor is the change (6,) of a pose in the child's axes: translation before rotation. It
    does not depend on the world of the poses.

    Parameters
    ----------
    poses : (N, 4, 4) array
        Poses of the child, measured or computed from the parent's.
    T_parent_child : (4, 4) array
    seconds : (N,) array
    pairs : MotionPairs
        First and last pose of each of K motions.
    """

    def __init__(
        self,
        poses: FloatArray,
        T_parent_child: FloatArray,
        seconds: FloatArray,
        pairs: MotionPairs,
    ) -> None:
        self._poses = poses.copy()
        # Poses near the origin avoid rounding errors of map coordinates.
        self._poses[:, :3, 3] -= poses[:, :3, 3].mean(axis=0)
        self._T_parent_child = T_parent_child
        self._seconds = seconds
        self._start = pairs.i
        self._end = pairs.j
        self._adjoints = se3.adjoint(self._poses)
        self._from_end = se3.adjoint(se3.inverse(self._poses[self._end]))
        self._to_end = self._from_end @ self._adjoints[self._start]

    def _between(self, perturbations: FloatArray) -> FloatArray:
        """Return the changes (K, 6, n) of motions by n perturbations (N, 6, n) of each pose."""
        at_start = self._to_end @ perturbations[self._start]
        return perturbations[self._end] - at_start

    def usual_errors(self) -> FloatArray:
        """Return the regressors (K, 6, 10) of errors with other causes than a filter.

        The errors are an error of the extrinsic (6), a clock offset, a scale, a delay of the
        child's positions after its orientations, and the same delay of the parent.
        """
        of_mount = np.eye(6) - self._to_end
        steps = se3.log(se3.inverse(self._poses[:-1]) @ self._poses[1:])
        rates = steps / np.diff(self._seconds)[:, None]
        inner = 0.5 * (rates[1:] + rates[:-1])
        of_clock = np.concatenate([rates[:1], inner, rates[-1:]])
        parents = self._poses @ se3.inverse(self._T_parent_child)
        parent_velocities = np.gradient(
            se3.translation_of(parents), self._seconds, axis=0
        )
        child_positions = se3.translation_of(self._poses)
        child_velocities = np.gradient(child_positions, self._seconds, axis=0)
        to_child = np.swapaxes(se3.rotation_of(self._poses), 1, 2)
        errors = [of_clock]
        # A scale error displaces a pose along its position, a delay along its velocity.
        for displacements in (
            child_positions,
            child_velocities,
            parent_velocities,
        ):
            translations = se3.times(to_child, displacements)
            no_rotations = np.zeros_like(translations)
            errors.append(np.concatenate([translations, no_rotations], axis=1))
        of_poses = self._between(np.stack(errors, axis=2))
        return np.concatenate([of_mount, of_poses], axis=2)

    def filtered(self, time_constant_s: float) -> FloatArray:
        """Return the regressors (K, 6, 6) of D, the error of the assumed mount, for one filter.

        The filter with the time constant (s) pulls one stream towards the other.
        """
        kept = np.exp(-median(np.diff(self._seconds)) / time_constant_s)
        # An adjoint contains its rotation twice, so the upper half is sufficient.
        upper = self._adjoints[:, :3]
        steps = np.diff(upper, axis=0, prepend=upper[:1])
        high_passed = kept * _decaying_sums(steps, kept)
        changes = np.zeros_like(self._from_end)
        changes[:, :3] = high_passed[self._end] - high_passed[self._start]
        changes[:, 3:, 3:] = changes[:, :3, :3]
        return self._from_end @ changes


def _decaying_sums(values: FloatArray, kept: float) -> FloatArray:
    """Return ``sums[n] = values[n] + kept * sums[n - 1]`` along the first axis (N, ...).

    Each round doubles the number of values in a sum. The import of ``scipy.signal`` would take
    longer than this computation.
    """
    sums = values.copy()
    lag = 1
    while lag < len(sums) and kept**lag > np.finfo(float).eps:
        sums[lag:] += kept**lag * sums[:-lag]
        lag *= 2
    return sums


class _Differences:
    """Differences between the motions of both streams, with their regressors and instruments.

    The regressors are computed from the parent's poses. Both regressors and differences contain the
    noise of these poses, and this common noise biases D. Therefore the same regressors, computed
    from the child's poses, are the instruments (W. Greene, *Econometric Analysis*, 2012, chapter
    8).

    Parameters
    ----------
    pose_pairs : PosePairs
    T_parent_child : (4, 4) array
    """

    def __init__(
        self, pose_pairs: PosePairs, T_parent_child: FloatArray
    ) -> None:
        poses = pose_pairs.Ts_pw_p @ T_parent_child
        seconds = (pose_pairs.stamps_ns - pose_pairs.stamps_ns[0]) * 1e-9
        pairs = pairs_over(
            replace(pose_pairs, Ts_pw_p=poses), SHORT_S, _MOST_MOTIONS
        )
        motions_back = se3.inverse(pairs.Ts_parenti_parentj)
        self._residuals = se3.log(motions_back @ pairs.Ts_childi_childj)
        self._units = noise_units(
            self._residuals[:, :3], self._residuals[:, 3:]
        )
        self._of_parent = _Regressors(poses, T_parent_child, seconds, pairs)
        self._usual_errors = self._of_parent.usual_errors()
        self._regressors_of_child = partial(
            _Regressors, pose_pairs.Ts_cw_c, T_parent_child, seconds, pairs
        )

    @property
    def n_motions(self) -> int:
        """Number of motions K."""
        return len(self._residuals)

    @property
    def _n_usual(self) -> int:
        """Number of regressors that do not belong to a filter."""
        return self._usual_errors.shape[2]

    def regression(self, time_constant_s: float) -> _Regression:
        """Regress the differences on the regressors for a filter of a time constant (s)."""
        rows = self._joined(
            self._usual_errors, self._of_parent.filtered(time_constant_s)
        )
        weights = self._robust_weights(rows)
        table = _table(rows, weights)
        weighted = rows * weights[:, None, None]
        # The columns of the usual errors are first, then the six columns of D.
        cost = _cost(table, range(self._n_usual + 6))
        cost_without_filter = _cost(table, range(self._n_usual))
        share = 1.0 - cost / max(cost_without_filter, 1e-300)
        return _Regression(time_constant_s, weighted, share)

    def fit(self, regression: _Regression) -> _Fit:
        """Estimate the mount change D and its standard deviations with the instruments."""
        time_constant_s = regression.time_constant_s
        of_child = self._regressors_of_child()
        instruments = self._joined(
            of_child.usual_errors(), of_child.filtered(time_constant_s)
        )
        n_base = self._n_usual
        columns = range(n_base + 6)
        blocks = Blocks.of_rows(regression.weighted, _BLOCKS, instruments)
        mount_change = blocks.solve(columns)[n_base:]
        covariance = blocks.jackknife(columns)[n_base:, n_base:]
        translation_sigmas = _in_sigmas(mount_change[:3], covariance[:3, :3])
        rotation_sigmas = _in_sigmas(mount_change[3:], covariance[3:, 3:])
        return _Fit(
            time_constant_s,
            mount_change,
            translation_sigmas,
            rotation_sigmas,
            regression.share,
        )

    def _joined(
        self, usual_errors: FloatArray, filtered: FloatArray
    ) -> FloatArray:
        """Return rows (K, 6, p + 1) of regressors and differences, in units of the noise."""
        residuals = self._residuals[:, :, None]
        joined = np.concatenate([usual_errors, filtered, residuals], axis=2)
        return joined / self._units[:, None]

    def _robust_weights(self, rows: FloatArray) -> FloatArray:
        """Return robust weights (K,) of motions with rows (K, 6, p + 1).

        Normal equations are ten times faster here than the least squares of ``robust_regression``.
        They suffice, because weights need few digits of the coefficients.
        """
        weights = np.ones(len(rows))
        for _ in range(ROUNDS):
            coefficients = solve(
                _table(rows, weights), range(rows.shape[2] - 1)
            )
            errors = rows @ np.append(-coefficients, 1.0)
            squared = (errors**2).sum(axis=1)
            weights = robust_weights(
                "cauchy", squared / (4.0 * median(squared) + 1e-300)
            )
        return weights


def _table(rows: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the products (p + 1, p + 1) of rows (K, 6, p + 1), summed with weights (K,)."""
    flat = rows.reshape(-1, rows.shape[2])
    return np.asarray(
        flat.T @ (flat * np.repeat(weights, rows.shape[1])[:, None])
    )


def _cost(table: FloatArray, columns: range) -> float:
    """Return the squared residuals of the last column of a table, fitted by other columns."""
    x = np.append(-solve(table, columns), 1.0)
    used = [*columns, -1]
    return float(x @ table[np.ix_(used, used)] @ x)


def _in_sigmas(vector: FloatArray, covariance: FloatArray) -> float:
    """Return the length of a vector (3,) in standard deviations, for its covariance (3, 3)."""
    # Directions without information have variance 0 here. The pseudo-inverse ignores them.
    information = np.linalg.pinv(covariance, hermitian=True)
    return float(np.sqrt(vector @ information @ vector))
