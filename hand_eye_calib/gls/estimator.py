"""The adaptive estimator: X by generalised least squares under a noise model that is estimated
along with it.

Instead of choosing which poses to compare, all evidence is weighed as the noise of these very
trajectories asks for: white noise favours long baselines, drift short ones, errors that last
neither, and a jump cuts the trajectory. docs/adaptive.md derives and tests it.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls.increments import SCALE, SYSTEMATIC, Streams
from hand_eye_calib.gls.noise_model import ROTATION
from hand_eye_calib.gls.normal import N_BLOCKS, answers_without
from hand_eye_calib.gls.parts import part_products
from hand_eye_calib.gls.problem import Fit, Problem
from hand_eye_calib.gls.solution import AdaptiveSolution
from hand_eye_calib.gls.stages import STAGES, start
from hand_eye_calib.gls.state_space import Posterior
from hand_eye_calib.gls.tuning import TUNING, Tuning
from hand_eye_calib.stats import median

# Stages that a quick solve leaves out; the first stages, whose fit a search may fall back on.
_SLOW, _FIRST = frozenset({"tails", "lasting"}), 3


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
        Systematic errors to choose from, the plainest first; the choice if there is only one.
    quick : bool
        Stop at white noise, drift and outliers: neither errors that last nor heavy tails.
    is_clock_free : bool
        The clock offset was estimated from these poses, so that X is as uncertain as that makes it:
        the model has a time offset, unless the motion hardly tells it from X.
    without : collection of str
        Names of :data:`~hand_eye_calib.gls.stages.STAGES` to leave out.
    tuning : Tuning

    Returns
    -------
    AdaptiveSolution
    """
    problem = Problem(
        streams=Streams((stamps_ns - stamps_ns[0]) * 1e-9, Ts_pw_p, Ts_cw_c),
        systematic=tuple(systematic),
        is_clock_free=is_clock_free,
        without=frozenset(without) | (_SLOW if quick else frozenset()),
        tuning=tuning,
    )
    first = _passed(problem, start(problem), STAGES[:_FIRST])
    kept = _strided(problem, first)
    if len(kept) < len(stamps_ns):
        fewer = solve(
            stamps_ns[kept],
            Ts_pw_p[kept],
            Ts_cw_c[kept],
            systematic,
            quick,
            is_clock_free,
            without,
            tuning,
        )
        return _at_all_poses(fewer, kept, first.outliers.spikes)
    fit = _passed(problem, first, STAGES[_FIRST:])
    if not fit.converged:
        plainest = replace(
            problem, systematic=problem.systematic[:1], without=problem.without | {"lasting"}
        )
        fit = _passed(plainest, first, STAGES[_FIRST:])
    return _solution(problem, fit)


def _passed(problem: Problem, fit: Fit, stages: Sequence) -> Fit:
    """The fit after some stages."""
    for stage in stages:
        if stage.__name__ not in problem.without:
            fit = stage(problem, fit)
    return fit


def _strided(problem: Problem, fit: Fit) -> IntArray:
    """Poses to keep: all, but of a camera that sees a target, whose errors repeat from pose to pose
    and drown the rotation between them, only every so many.
    """
    tuning, streams = problem.tuning, problem.streams
    every = np.arange(len(streams))
    if fit.model.centre == "sensors" or not problem.is_noisy(fit):
        return every
    every = every[~fit.outliers.spikes]
    most = max((s for s in tuning.strides if len(every) >= s * tuning.fewest_strides), default=1)
    noise = np.exp(0.5 * fit.levels[ROTATION])
    rotations = streams.Ts_pw_p[every, :3, :3]
    for stride in tuning.strides:
        turned = np.swapaxes(rotations[:-stride], 1, 2) @ rotations[stride:]
        if noise < tuning.noisy * median(se3.rotation_angle(turned)):
            return every[:: min(stride, most)]
    return every[::most]


def _at_all_poses(fewer: AdaptiveSolution, kept: IntArray, spikes: BoolArray) -> AdaptiveSolution:
    """The solution of some poses, jumps and spikes told of all."""
    jumps, spikes, weights = (
        np.zeros(len(spikes) - 1, dtype=bool),
        spikes.copy(),
        np.ones(len(spikes)),
    )
    jumps[kept[1:][fewer.jumps] - 1] = True
    spikes[kept[fewer.spikes]] = True
    weights[kept] = fewer.weights
    return replace(fewer, jumps=jumps, spikes=spikes, weights=weights, is_drowned=True)


def _solution(problem: Problem, fit: Fit) -> AdaptiveSolution:
    """The solution one step from where the search stands."""
    streams, posterior = problem.streams, problem.posterior(fit)
    normal = posterior.normal
    n_evidence = int((~fit.outliers.jumps).sum()) - int(fit.outliers.spikes.sum())
    misfit = normal.cost / max(streams.n_rows * n_evidence - 6 - len(fit.columns), 1)
    # Steps smaller than predicted do not make what was learned over long baselines more certain.
    covariance = max(misfit, 1.0) * normal.covariance
    covariance[:6, :6] += fit.cov_beyond
    parts = part_products(posterior)
    steps = np.diff(streams.Ts_pw_p[:, :3, 3], axis=0)
    final = fit.moved(normal.step)
    by_scale, scale_variance = _of_scale(posterior, fit)
    return AdaptiveSolution(
        T_parent_child=final.T,
        cov_parent_child_in_child=covariance[:6, :6],
        unseen=normal.unseen[:6],
        model=fit.model,
        levels=fit.levels,
        weights=fit.weights,
        systematic=fit.systematic,
        parameters=final.parameters,
        parameter_sigmas=_sigmas(problem.tuning, fit, covariance[6:, 6:], parts),
        jumps=fit.outliers.jumps,
        spikes=fit.outliers.spikes,
        heavy_tails=fit.has_heavy_tails and "tails" not in problem.without,
        misfit=misfit,
        metres_per_pose=float(np.linalg.norm(steps, axis=1).sum()) / len(streams),
        part_products=parts,
        by_scale=by_scale,
        scale_variance=max(misfit, 1.0) * scale_variance,
        objective=0.5 * (posterior.precision.log_determinant + normal.cost),
        converged=fit.converged,
        iterations=fit.n_evaluations,
    )


def _of_scale(posterior: Posterior, fit: Fit) -> tuple[FloatArray, float]:
    """Derivative (6,) of xi by a scale of the child's path that is not in the model, and what the
    data leave open of that scale, as a variance.
    """
    if SCALE in fit.columns:
        return np.zeros(6), 0.0
    columns = fit.linearised(fit.poses, fit.course, fit.error, [*fit.columns, SCALE]).columns
    products = posterior.with_columns(columns).products[:-1, :-1]
    by_scale = -posterior.normal.covariance @ products[:-1, -1]
    information = products[-1, -1] + products[-1, :-1] @ by_scale
    return by_scale[:6], 1.0 / max(float(information), np.finfo(float).tiny)


def _sigmas(tuning: Tuning, fit: Fit, covariance: FloatArray, parts: FloatArray) -> FloatArray:
    """Standard deviations (8,) of all parameters: of those in the model by their covariance or, if
    that is larger beyond chance, the jackknife over ten blocks; of the scale and the time offset
    otherwise by the models that have them.
    """
    sigmas, variances = fit.other_sigmas.copy(), np.diag(covariance)
    if len(parts) >= N_BLOCKS:
        spread = answers_without(parts)[:, 6:].var(axis=0) * (N_BLOCKS - 1)
        variances = np.maximum(variances, spread / tuning.chance_of_jackknife)
    sigmas[fit.columns] = np.sqrt(variances)
    return sigmas
