"""Adaptive estimator of X by generalised least squares.

The noise model is estimated together with X, so the likelihood decides the weight of every
increment. The user need not choose a distance between poses (reference): white noise would need
long distances, drift would need short distances. The model is in :mod:`hand_eye_calib.core.noise`,
the stages of the search are in :mod:`~hand_eye_calib.core.noise.stages`. This module runs the
stages and returns the solution, with a description of its noise. docs/adaptive.md has the
derivation and tests.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.noise.increments import (
    N_SYSTEMATIC,
    PARAMETERS,
    RATE,
    SCALE,
    SYSTEMATIC,
    TIME,
    Streams,
    parameter_columns,
)
from hand_eye_calib.core.noise.noise_model import (
    ROTATION,
    TIME_CONSTANTS,
    VARIANCES,
    WALK_ROTATION,
    NoiseModel,
    fast_sigmas,
)
from hand_eye_calib.core.noise.normal import transposed
from hand_eye_calib.core.noise.stages import (
    STAGES,
    Fit,
    Problem,
    Stage,
    Workspace,
    is_settled,
    start,
)
from hand_eye_calib.core.noise.tuning import TUNING, Tuning
from hand_eye_calib.core.results.records import CorrelatedError, Noise

# Stages that a quick solve skips.
_SLOW_STAGES = frozenset({"tails", "time_correlated"})

# Stages noise, outliers and tails. If X does not settle, the search continues from their fit
# without time-correlated errors.
_FIRST_STAGES = STAGES[:3]
_LAST_STAGES = STAGES[3:]

# A systematic error is printed if it exceeds this number of standard deviations.
MIN_REPORTED_SIGMAS = 3.0


class NoiseModelError(InputError):
    """No noise model fits the poses: a matrix is not positive definite up to rounding."""


@dataclass(frozen=True, kw_only=True)
class ModelSolution:
    """Common fields of the solutions for poses and for positions.

    Attributes
    ----------
    model : NoiseModel
    levels : (m,) array
        Levels of the model: log variances and log time constants.
    parameters, parameter_sigmas : (8 or more,) arrays
        Estimates of all systematic errors, see
        :data:`~hand_eye_calib.core.noise.increments.PARAMETERS`, and their standard deviations;
        zero for errors that are absent.
    scale, scale_sigma : float
        Factor that converts the child's lengths to the parent's, and its standard deviation.
    time_offset_s, time_offset_sigma_s : float
        Seconds to be added to the child's stamps, and their standard deviation.
    jumps : (n,) bool array
        Increments (from pose i to pose i + 1) at which a trajectory jumps and does not return.
    spikes : (n + 1,) bool array
        Outlier poses, which were not used.
    misfit : float
        Weighted squared residual over its degrees of freedom. The covariance contains this factor
        if it exceeds 1.
    part_products : (K, p + 1, p + 1) array
        Contributions of blocks of time to the normal equations, see
        :func:`~hand_eye_calib.core.noise.state_space.Posterior.part_products`.
    objective : float
        Negative log likelihood, without constants, at the estimated parameters and their prior. The
        restricted likelihood of the levels marginalises the parameters; this likelihood does not.
    converged : bool
        Whether X and all parameters have settled. If not, the method "auto" uses DNLO.
    """

    model: NoiseModel
    levels: FloatArray
    parameters: FloatArray
    parameter_sigmas: FloatArray
    scale: float
    scale_sigma: float
    time_offset_s: float
    time_offset_sigma_s: float
    jumps: BoolArray
    spikes: BoolArray
    misfit: float
    part_products: FloatArray
    objective: float
    converged: bool

    @property
    def left_out(self) -> BoolArray:
        """Mask (n,) of unused increments: jumps, and increments beside an outlier pose."""
        return self.jumps | self.spikes[1:] | self.spikes[:-1]


@dataclass(frozen=True, kw_only=True)
class AdaptiveSolution(ModelSolution):
    """Solution of the adaptive estimator.

    Attributes
    ----------
    T_parent_child : (4, 4) array
    cov_parent_child_in_child : (6, 6) array
        Covariance of xi = (rho, phi) in ``X exp(xi)``. It includes the uncertainty of systematic
        errors, and the misfit.
    unseen : (6, U) array
        Unit vectors of xi about which no increment has information.
    weights : (n + 1,) array
        Weights of the white errors of the poses; 1 unless the errors have heavy tails.
    metres_per_pose : float
        Length of the parent's path (m), divided by the number of poses.
    is_noise_dominated : bool
        Whether the noise of single poses exceeds a share of the rotation between poses
        (``Tuning.noisy_share``). Then only every k-th pose was used.
    """

    T_parent_child: FloatArray
    cov_parent_child_in_child: FloatArray
    unseen: FloatArray
    weights: FloatArray
    metres_per_pose: float
    is_noise_dominated: bool = False

    @property
    def systematic(self) -> str:
        """Names of the significant systematic errors, joined by ``+``, or ``none``."""
        is_significant = (
            np.abs(self.parameters)
            > MIN_REPORTED_SIGMAS * self.parameter_sigmas
        )
        names = [
            name
            for name, columns in PARAMETERS.items()
            if is_significant[columns].any()
        ]
        return "+".join(names) or "none"

    @property
    def rate_bias(self) -> FloatArray:
        """Difference of the biases of the angular rates: child minus parent.

        The array (2, 3) has the difference and its standard deviations as rows, in rad/s along the
        child's axes.
        """
        return np.stack([self.parameters[RATE], self.parameter_sigmas[RATE]])

    def rotation_variance(self, n_intervals: IntArray | int) -> FloatArray:
        """Return the error variance (rad^2) per axis of the rotation between two measured poses.

        The poses are ``n_intervals`` typical intervals of the model apart from each other.
        """
        white, walk = np.exp(self.levels[[ROTATION, WALK_ROTATION]])
        variance = 2 * white + n_intervals * walk
        for process in self.noise.lasting:
            if process.part == "rotation":
                ratio = n_intervals * self.model.interval_s / process.tau_s
                variance = variance - 2 * process.sigma**2 * np.expm1(-ratio)
        return np.asarray(variance)

    @cached_property
    def noise(self) -> Noise:
        """Noise as numbers: standard deviations per axis, and names of systematic errors."""
        sigmas = fast_sigmas(self.levels)
        process_sigmas = np.exp(0.5 * self.levels[VARIANCES])
        taus_s = np.exp(self.levels[TIME_CONSTANTS])
        lasting = []
        for (kind, part), sigma, tau_s in zip(
            self.model.processes,
            process_sigmas.tolist(),
            taus_s.tolist(),
            strict=True,
        ):
            lasting.append(
                CorrelatedError(kind=kind, part=part, sigma=sigma, tau_s=tau_s)
            )
        return Noise(
            in_words=(),
            rotation_white_rad=sigmas.rotation_rad,
            translation_white_m=sigmas.translation_m,
            rotation_drift_rad_per_pose=sigmas.walk_rotation_rad,
            translation_drift_m_per_pose=sigmas.walk_translation_m,
            lasting=tuple(lasting),
            systematic=self.systematic,
            misfit=self.misfit,
        )


def solve(
    stamps_ns: IntArray,
    Ts_pw_p: FloatArray,
    Ts_cw_c: FloatArray,
    systematic: Sequence[str] = SYSTEMATIC,
    quick: bool = False,
    is_clock_free: bool = False,
    without: Collection[str] = (),
    tuning: Tuning = TUNING,
) -> AdaptiveSolution:
    """Estimate T_parent_child, the noise of the trajectories, and their covariance.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
        Poses of both sensors in their own worlds at these stamps.
    systematic : sequence of str
        Systematic errors in the model, see
        :data:`~hand_eye_calib.core.noise.increments.PARAMETERS`.
    quick : bool
        Skip the stages for heavy tails and time-correlated errors.
    is_clock_free : bool
        Whether the clock offset was estimated from these poses. If so, it is always a parameter, so
        that the covariance of X contains its uncertainty.
    without : collection of str
        Names of :data:`~hand_eye_calib.core.noise.stages.STAGES` that are skipped. With "centre",
        the centre of rotation errors is not searched for: they turn about the sensors.
    tuning : Tuning
        Constants of the search.

    Returns
    -------
    AdaptiveSolution

    Raises
    ------
    NoiseModelError
        If no noise model fits the poses: a matrix is not positive definite up to rounding.
    """
    problem = Problem(
        streams=Streams((stamps_ns - stamps_ns[0]) * 1e-9, Ts_pw_p, Ts_cw_c),
        columns=parameter_columns(systematic),
        is_clock_free=is_clock_free,
        without=frozenset(without) | (_SLOW_STAGES if quick else frozenset()),
        tuning=tuning,
    )
    try:
        return _search(problem)
    except np.linalg.LinAlgError:
        raise NoiseModelError(
            "no noise model fits these poses: check units, jumps and stamps, or use method dnlo "
            f"with reference {tuning.start_reference}"
        ) from None


def _search(problem: Problem) -> AdaptiveSolution:
    """Run all stages, and return the solution.

    The rotation noise of a camera that observes a target may be as large as the rotation between
    two poses. The search is then repeated with every k-th pose. If X does not settle, the search
    continues from the fit of the first stages without time-correlated errors.
    """
    workspace = Workspace(problem)
    first = _run_stages(_FIRST_STAGES, workspace, start(problem))
    if first.model.centre != "sensors" and problem.is_noisy(first):
        kept = _strided_poses(problem, first)
        if len(kept) < len(problem.streams):
            fewer = replace(problem, streams=problem.streams[kept])
            return _expand_to_all_poses(
                _search(fewer), kept, first.outliers.spikes
            )
    fit = _run_stages(_LAST_STAGES, workspace, first)
    if not is_settled(workspace, fit):
        workspace = Workspace(
            replace(problem, without=problem.without | {"time_correlated"})
        )
        fit = _run_stages(_LAST_STAGES, workspace, first)
    return _solution(workspace, fit)


def _run_stages(stages: Sequence[Stage], workspace: Workspace, fit: Fit) -> Fit:
    """Return the fit after the given stages, without the stages that the problem skips."""
    for stage in stages:
        if stage.__name__ not in workspace.problem.without:
            fit = stage(workspace, fit)
    return fit


def _strided_poses(problem: Problem, fit: Fit) -> IntArray:
    """Return the indices of every k-th pose, among the poses that are no outliers.

    The stride k is the shortest one in ``tuning.strides`` for which the rotation over k poses
    clearly exceeds the rotation noise, but at most the longest stride that leaves enough poses.
    """
    tuning = problem.tuning
    sound_poses = np.flatnonzero(~fit.outliers.spikes)
    # About 50 poses must remain for a solution.
    possible_strides = [
        stride for stride in tuning.strides if len(sound_poses) >= stride * 50
    ]
    longest_stride = max(possible_strides, default=1)
    noise_rad = np.exp(0.5 * fit.levels[ROTATION])
    rotations = problem.streams.Ts_pw_p[sound_poses, :3, :3]
    for stride in tuning.strides:
        turns = transposed(rotations[:-stride]) @ rotations[stride:]
        if noise_rad < tuning.noisy_share * median(se3.rotation_angle(turns)):
            return sound_poses[:: min(stride, longest_stride)]
    return sound_poses[::longest_stride]


def _expand_to_all_poses(
    fewer: AdaptiveSolution, kept: IntArray, spikes: BoolArray
) -> AdaptiveSolution:
    """Expand the arrays of a solution from the subset ``kept`` (indices) to all poses.

    ``spikes`` (N,) are the outliers among all poses.
    """
    jumps = np.zeros(len(spikes) - 1, dtype=bool)
    spikes = spikes.copy()
    weights = np.ones(len(spikes))
    # A jump between two kept poses is stored at the last increment before the second pose.
    jumps[kept[1:][fewer.jumps] - 1] = True
    spikes[kept[fewer.spikes]] = True
    weights[kept] = fewer.weights
    return replace(
        fewer,
        jumps=jumps,
        spikes=spikes,
        weights=weights,
        is_noise_dominated=True,
    )


def _solution(workspace: Workspace, fit: Fit) -> AdaptiveSolution:
    """Return the solution: the last fit of the search, after one more step of all parameters."""
    problem = workspace.problem
    columns = problem.columns
    posterior = workspace.posterior(fit)
    normal = posterior.normal
    final = fit.moved(normal.step, columns)
    misfit = float(normal.cost) / _degrees_of_freedom(problem, fit)
    # A misfit below 1 does not reduce the covariance: the misfit depends on short distances between
    # poses, X on long distances.
    covariance = max(misfit, 1.0) * normal.covariance
    sigmas = np.zeros(N_SYSTEMATIC)
    sigmas[columns] = np.sqrt(np.diag(covariance)[6:])
    is_present = fit.sigmas > problem.tuning.absent_sigma
    parameters = np.where(is_present, final.parameters, 0.0)
    sigmas = np.where(is_present, sigmas, 0.0)
    # A translation error fixed to the body is not detected if it is constant for about as long as
    # the recording; X then contains its mean. Its variance is assumed to be a share of the variance
    # of the detected errors.
    undetected = np.zeros(6)
    for (kind, _), level in zip(
        fit.model.processes, fit.levels[VARIANCES], strict=True
    ):
        if kind == "body":
            undetected[:3] += problem.tuning.undetected_share * np.exp(level)
    steps = np.diff(se3.translation_of(problem.streams.Ts_pw_p), axis=0)
    return AdaptiveSolution(
        T_parent_child=final.T,
        cov_parent_child_in_child=covariance[:6, :6] + np.diag(undetected),
        unseen=normal.unseen[:6],
        model=fit.model,
        levels=fit.levels,
        weights=fit.weights,
        parameters=parameters,
        parameter_sigmas=sigmas,
        scale=1.0 + float(parameters[SCALE]),
        scale_sigma=float(sigmas[SCALE]),
        time_offset_s=-float(parameters[TIME]),
        time_offset_sigma_s=float(sigmas[TIME]),
        jumps=fit.outliers.jumps,
        spikes=fit.outliers.spikes,
        misfit=misfit,
        metres_per_pose=float(np.linalg.norm(steps, axis=1).sum())
        / len(problem.streams),
        part_products=posterior.part_products(),
        objective=0.5 * (posterior.log_determinant + float(normal.cost)),
        converged=is_settled(workspace, fit),
    )


def _degrees_of_freedom(problem: Problem, fit: Fit) -> int:
    """Return the number of used residuals minus the number of parameters; at least 1."""
    streams = problem.streams
    positions = np.concatenate(
        [
            se3.translation_of(streams.Ts_pw_p),
            se3.translation_of(streams.Ts_cw_c),
        ],
        axis=1,
    )
    # Rotations without positions have three residuals instead of six.
    n_rows = 6 if np.ptp(positions, axis=0).any() else 3
    n_used = int((~fit.outliers.jumps).sum()) - int(fit.outliers.spikes.sum())
    return max(n_rows * n_used - 6 - len(problem.columns), 1)
