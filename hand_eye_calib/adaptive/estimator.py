"""The adaptive estimator: X by generalised least squares under a noise model that is estimated along with it.

Instead of choosing which poses to compare, all evidence is weighed as the noise of these very trajectories asks for: white noise
favours long baselines, drift short ones, and a jump cuts the trajectory. docs/adaptive.md derives and tests it.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from hand_eye_calib.adaptive.block_tridiagonal import BLOCK
from hand_eye_calib.adaptive.increments import NUISANCES, Increments
from hand_eye_calib.adaptive.noise import (
    LOWEST_VARIANCE,
    NoiseLevels,
    covariance_factor,
    fit_rotation_variances,
    fit_translation_variances,
    generalised_least_squares,
    join_variances,
    solve_weighted,
    starting_variances,
)
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.solvers import dnlo

# Robust start: DNLO over this reference sees through jumps, and does not need the noise levels.
_START_REFERENCE = "B3"

# First look for jumps: increments this many robust sigmas out. Wide, for the noise levels are not known yet.
_FIRST_JUMP_SIGMAS = 5.0
_MEDIAN_OF_CHI_3 = 1.538

# Once the noise is known: false alarms expected in a whole trajectory.
_FALSE_ALARMS = 0.01

# A jump is given up when an increment of its size or more has this probability.
_PROBABLE = 0.01

# No more than this share of the increments can be jumps: where the noise levels would have it so, they are wrong.
_MOST_JUMPS = 0.5

# Noise levels need no more increments than this; longer drives lend evenly spread stretches of them.
_MOST_NOISE_INCREMENTS = 600
_STRETCH = 100

# Noise levels and X are improved in turn until X moves by less than this share of its sigma and no jump appears.
_MAX_ROUNDS, _SETTLED_SIGMAS = 4, 0.1

_MAX_STEPS = 20
_CONVERGED_SIGMAS, _CONVERGED_STEP = 1e-4, 1e-10


@dataclass(frozen=True)
class AdaptiveSolution:
    """Answer of the adaptive estimator.

    Attributes
    ----------
    T_parent_child : (4, 4) array
    cov_parent_child_in_child : (6, 6) array
        Covariance of xi = (rho, phi) in ``X exp(xi)`` under the model, nuisance parameters accounted for.
    unseen : (6, U) array
        Directions of xi that no increment says anything about.
    noise : NoiseLevels
    nuisance : {"none", "scale", "bias"}
        Which systematic error the data asks for.
    parameters : (k,) array
        Its parameters: the scale error, or the child's bias per metre along its axes.
    jumps : (n,) bool array
        Increments (from pose i to i + 1) across which a trajectory jumped.
    objective : float
        Negative log likelihood.
    converged : bool
    iterations : int
        Generalised least-squares steps.
    """

    T_parent_child: np.ndarray
    cov_parent_child_in_child: np.ndarray
    unseen: np.ndarray
    noise: NoiseLevels
    nuisance: str
    parameters: np.ndarray
    jumps: np.ndarray
    objective: float
    converged: bool
    iterations: int

    def describe(self, stamps_ns):
        """The noise in plain numbers and strings: levels per axis, the systematic error, and when trajectories jumped (ns)."""
        return {
            "rotation_white_rad": self.noise.rotation_white,
            "translation_white_m": self.noise.translation_white,
            "rotation_drift_rad_per_pose": self.noise.rotation_drift,
            "translation_drift_m_per_pose": self.noise.translation_drift,
            "systematic": self.nuisance,
            "systematic_parameters": self.parameters.tolist(),
            "jumps_before_stamp_ns": stamps_ns[1:][self.jumps].tolist(),
        }


def solve(stamps_ns, Ts_pw_p, Ts_cw_c, nuisances=("none", "scale", "bias")):
    """Estimate T_parent_child, the noise of the trajectories, and their covariance.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
        Poses of both sensors in their own worlds at these stamps.
    nuisances : sequence of str
        Systematic errors to choose from, by Schwarz's criterion (BIC).

    Returns
    -------
    AdaptiveSolution
    """
    increments = Increments(stamps_ns, Ts_pw_p, Ts_cw_c)
    T_start = dnlo.solve(motion_pairs(Ts_pw_p, Ts_cw_c, _START_REFERENCE)).T_parent_child
    fits = []
    start = _Start(T_start, _robust_jumps(increments.residuals(T_start)))
    for nuisance in nuisances:
        fits.append(_fit(increments, start, nuisance))
        start = _Start(fits[0].T_parent_child, fits[0].jumps, fits[0].noise.variances())
    # The jumps found under different models differ; the criterion needs the same evidence for all.
    jumps = np.logical_or.reduce([fit.jumps for fit in fits]) if len(fits) > 1 else fits[0].jumps
    scores = [_criterion(increments, fit, jumps) for fit in fits]
    return fits[int(np.argmin(scores))]


def solve_without(stamps_ns, Ts_pw_p, Ts_cw_c, solution, left_out):
    """Answers near a given one when some increments are left out, for resampling. The noise levels are kept.

    Parameters
    ----------
    stamps_ns, Ts_pw_p, Ts_cw_c
        As for :func:`solve`.
    solution : AdaptiveSolution
        Their solution.
    left_out : (B, n) bool array
        Increments to leave out, for each of B answers.

    Returns
    -------
    (B, 4, 4) array
    """
    increments = Increments(stamps_ns, Ts_pw_p, Ts_cw_c)
    linearisation = increments.linearise(solution.T_parent_child, solution.nuisance, solution.parameters)
    variances = solution.noise.variances()
    steps = [generalised_least_squares(linearisation, variances, solution.jumps | row).step[:6] for row in left_out]
    return solution.T_parent_child @ se3.exp(np.array(steps))


@dataclass(frozen=True)
class _Start:
    T_parent_child: np.ndarray
    jumps: np.ndarray
    variances: np.ndarray | None = None


def _fit(increments, start, nuisance):
    T, parameters, jumps, variances = start.T_parent_child, np.zeros(NUISANCES[nuisance]), start.jumps, start.variances
    sample = _noise_sample(len(increments))
    sampled = increments.rows(sample)
    iterations = 0
    while iterations < _MAX_ROUNDS:
        iterations += 1
        variances = _fit_noise(sampled.linearise(T, nuisance, parameters), jumps[sample], variances)
        linearisation = increments.linearise(T, nuisance, parameters)
        solve = generalised_least_squares(linearisation, variances, jumps)
        T, parameters = T @ se3.exp(solve.step[:6]), parameters + solve.step[6:]
        known_jumps = jumps
        residuals = increments.residuals(T, nuisance, parameters)
        jumps = _jumps(residuals, linearisation.components, variances, solve.factor, jumps)
        settled = np.abs(solve.step) < _SETTLED_SIGMAS * np.sqrt(np.diag(solve.covariance))
        if np.array_equal(jumps, known_jumps) and settled.all():
            break
    # The covariance is settled; what is left is to follow the residuals to the minimum.
    factor = covariance_factor(linearisation.components, variances, jumps)
    converged = False
    while not converged and iterations < _MAX_STEPS:
        iterations += 1
        arguments = (T, nuisance, parameters)
        solve = solve_weighted(increments.residuals(*arguments), increments.jacobian(*arguments), factor)
        T, parameters = T @ se3.exp(solve.step[:6]), parameters + solve.step[6:]
        tolerance = np.maximum(_CONVERGED_SIGMAS * np.sqrt(np.diag(solve.covariance)), _CONVERGED_STEP)
        converged = bool((np.abs(solve.step) < tolerance).all())
    return AdaptiveSolution(
        T,
        solve.covariance[:6, :6],
        solve.unseen[:6],
        NoiseLevels.from_variances(variances),
        nuisance,
        parameters,
        jumps,
        solve.loss(),
        converged,
        iterations,
    )


def _fit_noise(linearisation, jumps, variances):
    """Variances (4,) from some of the increments, starting from earlier ones if there are any."""
    if variances is None:
        rotation = starting_variances(linearisation.residuals[:, :3], jumps)
        translation = starting_variances(linearisation.residuals[:, 3:], jumps)
    else:
        rotation, translation = variances[::2], variances[1::2]
    rotation = fit_rotation_variances(linearisation, jumps, rotation)
    return join_variances(rotation, fit_translation_variances(linearisation, jumps, rotation, translation))


def _criterion(increments, fit, jumps):
    """Schwarz's criterion of a fit on the evidence outside the given jumps."""
    noise = fit.noise
    variances = np.maximum(
        np.square([noise.rotation_white, noise.translation_white, noise.rotation_drift, noise.translation_drift]),
        LOWEST_VARIANCE,
    )
    linearisation = increments.linearise(fit.T_parent_child, fit.nuisance, fit.parameters)
    loss = generalised_least_squares(linearisation, variances, jumps).loss()
    n_observations = 6 * int((~jumps).sum())
    return 2.0 * loss + NUISANCES[fit.nuisance] * np.log(max(n_observations, 2))


def _robust_jumps(residuals):
    jumps = np.zeros(len(residuals), dtype=bool)
    for columns in (slice(0, 3), slice(3, 6)):
        sizes = np.linalg.norm(residuals[:, columns], axis=1)
        jumps |= sizes > max(_FIRST_JUMP_SIGMAS * np.median(sizes) / _MEDIAN_OF_CHI_3, 10 * np.sqrt(LOWEST_VARIANCE))
    return jumps


def _jumps(residuals, components, variances, factor, known_jumps):
    """Increments that the noise does not explain.

    Judged by what is left of each once those before it are known. For a known jump that is next to nothing, its variance being
    huge; it stays one unless its whole size is quite probable after all.
    """
    innovations = factor.whiten(residuals.reshape(-1, 1)).reshape(-1, 6)
    surprising = (innovations**2).sum(axis=1) > chi2.isf(_FALSE_ALARMS / len(residuals), 6)
    bands = np.tensordot(variances, components[:, :BLOCK], axes=1).reshape(BLOCK, -1, BLOCK)
    blocks = np.empty((len(residuals), BLOCK, BLOCK))
    for column in range(BLOCK):
        blocks[:, column:, column] = blocks[:, column, column:] = bands[: BLOCK - column, :, column].T
    sizes = (residuals * np.linalg.solve(blocks, residuals[:, :, None])[:, :, 0]).sum(axis=1)
    jumps = surprising | (known_jumps & (sizes > chi2.isf(_PROBABLE, 6)))
    excess = int(jumps.sum()) - int(_MOST_JUMPS * len(jumps))
    if excess > 0:
        flagged = np.flatnonzero(jumps)
        jumps[flagged[np.argsort(sizes[flagged], kind="stable")[:excess]]] = False
    return jumps


def _noise_sample(n_increments):
    """Indices of the increments to judge the noise by: all, or evenly spread stretches."""
    if n_increments <= _MOST_NOISE_INCREMENTS:
        return np.arange(n_increments)
    n_stretches = _MOST_NOISE_INCREMENTS // _STRETCH
    starts = np.linspace(0, n_increments - _STRETCH, n_stretches).astype(int)
    return (starts[:, None] + np.arange(_STRETCH)).ravel()
