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
from hand_eye_calib.gls.increments import N_SYSTEMATIC, PARAMETERS, SYSTEMATIC, Streams
from hand_eye_calib.gls.noise_model import N_FAST, PARTS, ROTATION
from hand_eye_calib.gls.solution import AdaptiveSolution, parts_of
from hand_eye_calib.gls.stages import STAGES, Fit, Problem, is_settled, start
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
        Systematic errors in the model.
    quick : bool
        Stop at white noise, drift and outliers: neither errors that last nor heavy tails.
    is_clock_free : bool
        The clock offset was estimated from these poses: it is not known beforehand.
    without : collection of str
        Names of :data:`~hand_eye_calib.gls.stages.STAGES` to leave out.
    tuning : Tuning

    Returns
    -------
    AdaptiveSolution
    """
    problem = Problem(
        streams=Streams((stamps_ns - stamps_ns[0]) * 1e-9, Ts_pw_p, Ts_cw_c),
        columns=[column for name in systematic for column in PARAMETERS[name]],
        is_clock_free=is_clock_free,
        without=frozenset(without) | (_SLOW if quick else frozenset()),
        tuning=tuning,
    )
    return _solved(problem)


def _solved(problem: Problem) -> AdaptiveSolution:
    first = _passed(problem, start(problem), STAGES[:_FIRST])
    kept = _strided(problem, first)
    if len(kept) < len(problem.streams):
        fewer = replace(problem, streams=problem.streams[kept], _last=[])
        return _at_all_poses(_solved(fewer), kept, first.outliers.spikes)
    fit = _passed(problem, first, STAGES[_FIRST:])
    if not is_settled(problem, fit):
        problem = replace(problem, without=problem.without | {"lasting"})
        fit = _passed(problem, first, STAGES[_FIRST:])
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
    jumps, spikes = np.zeros(len(spikes) - 1, dtype=bool), spikes.copy()
    weights = np.ones(len(spikes))
    jumps[kept[1:][fewer.jumps] - 1] = True
    spikes[kept[fewer.spikes]] = True
    weights[kept] = fewer.weights
    return replace(fewer, jumps=jumps, spikes=spikes, weights=weights, is_drowned=True)


def _solution(problem: Problem, fit: Fit) -> AdaptiveSolution:
    """The solution one step from where the search stands."""
    streams, posterior, columns = problem.streams, problem.posterior(fit), problem.columns
    normal = posterior.normal
    # Rows of an increment that tell: three where only rotations are measured, without a place.
    places = np.concatenate([streams.Ts_pw_p[:, :3, 3], streams.Ts_cw_c[:, :3, 3]], axis=1)
    n_rows = 6 if np.ptp(places, axis=0).any() else 3
    n_evidence = int((~fit.outliers.jumps).sum()) - int(fit.outliers.spikes.sum())
    misfit = float(normal.cost) / max(n_rows * n_evidence - 6 - len(columns), 1)
    # Steps smaller than predicted do not make what was learned over long baselines more certain.
    covariance = max(misfit, 1.0) * normal.covariance
    sigmas = np.zeros(N_SYSTEMATIC)
    sigmas[columns] = np.sqrt(np.diag(covariance)[6:])
    unseen = np.zeros(6)
    for process, level in zip(fit.model.slow, fit.levels[N_FAST::2], strict=True):
        if process.kind == "body":
            unseen[PARTS[process.part]] += problem.tuning.unseen_share * np.exp(level)
    steps = np.diff(streams.Ts_pw_p[:, :3, 3], axis=0)
    final = fit.moved(normal.step, columns)
    is_there = fit.sigmas > problem.tuning.none
    return AdaptiveSolution(
        T_parent_child=final.T,
        cov_parent_child_in_child=covariance[:6, :6] + np.diag(unseen),
        unseen=normal.unseen[:6],
        model=fit.model,
        levels=fit.levels,
        weights=fit.weights,
        **parts_of(np.where(is_there, final.parameters, 0.0), np.where(is_there, sigmas, 0.0)),
        jumps=fit.outliers.jumps,
        spikes=fit.outliers.spikes,
        heavy_tails=fit.has_heavy_tails and "tails" not in problem.without,
        misfit=misfit,
        metres_per_pose=float(np.linalg.norm(steps, axis=1).sum()) / len(streams),
        part_products=posterior.part_products(),
        objective=0.5 * (posterior.log_determinant + float(normal.cost)),
        converged=is_settled(problem, fit),
    )
