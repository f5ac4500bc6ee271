"""Stages of the search for X, noise model, outliers and systematic errors, in their order.

Data and state of the search are in :mod:`~hand_eye_calib.core.noise.fit`. :func:`start` returns the
first fit; each stage is a function that takes a workspace and a fit and returns the next fit:

1. :func:`noise`: all levels of the model, which contains only white noise and a walk at first, and
  a step of X;
2. :func:`outliers`: jumps and outlier poses, which need noise levels;
3. :func:`tails`: weights of white errors that have heavy tails;
4. :func:`time_correlated`: Gauss-Markov processes, which must not explain outliers;
5. :func:`systematic`: scale, bias and time offset, which need the whole noise model;
6. :func:`polish`: X and all parameters, until X settles.

docs/adaptive.md describes each stage.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import compress
from typing import NamedTuple, TypeAlias

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.noise import reml
from hand_eye_calib.core.noise.fit import Fit, Problem, Workspace
from hand_eye_calib.core.noise.increments import (
    N_SYSTEMATIC,
    RATE,
    SCALE,
    TIME,
    Streams,
    course_of,
    first_residuals,
)
from hand_eye_calib.core.noise.noise_model import (
    CENTRES,
    MIN_VARIANCE,
    N_FAST,
    PROCESSES,
    VARIANCES,
    WALKS,
    WHITES,
    NoiseModel,
    increment_levels,
    rough_levels,
)
from hand_eye_calib.core.noise.normal import NormalEquations
from hand_eye_calib.core.noise.outliers import (
    Outliers,
    bridge_outliers,
    detect_outliers,
    first_outliers,
    leave_one_out_chi_squares,
    tail_weights,
)
from hand_eye_calib.core.noise.partwise import PartwisePosterior
from hand_eye_calib.core.noise.state_space import Posterior
from hand_eye_calib.core.noise.tuning import Tuning
from hand_eye_calib.core.pairing.motion_pairs import motion_pairs
from hand_eye_calib.core.solvers.registry import Method

# Newton steps in the search for time-correlated errors, before processes without information are
# dropped for the first time.
_FIRST_STEPS = 4


def sample(n_poses: int, tuning: Tuning) -> IntArray | None:
    """Return the indices of the poses to which noise levels are fitted, or None for all poses.

    The poses form bursts, which are spread evenly over the recording.
    """
    if n_poses <= tuning.most_poses:
        return None
    burst = np.array(tuning.burst)
    n_bursts = tuning.most_poses // len(burst)
    # A burst is at most twice as long as the distance between the starts of two neighbouring
    # bursts, which is about n_poses / n_bursts.
    longest_offset = 2 * len(burst) * n_poses // tuning.most_poses
    offsets = burst[burst < longest_offset]
    starts = np.linspace(0, n_poses - 1 - offsets[-1], n_bursts).astype(int)
    return np.unique(starts[:, None] + offsets)


def start(problem: Problem) -> Fit:
    """Return the first fit: X from DNLO, first jumps and outliers, rough noise levels."""
    streams = problem.streams
    tuning = problem.tuning
    pairs = motion_pairs(
        streams.Ts_pw_p, streams.Ts_cw_c, tuning.start_reference
    )
    T = Method("dnlo").solve(pairs).T_parent_child
    course = course_of(streams, T)
    residuals = first_residuals(streams, course, T)
    outliers = first_outliers(streams, course, T, residuals, tuning)
    interval_s = median(np.diff(streams.stamps_s))
    duration_s = float(np.ptp(streams.stamps_s))
    centre = "sensors"
    if "centre" not in problem.without:
        centre = _centre_of_rotations(
            streams, T, residuals, tuning.centre_ratio
        )
    left_out = outliers.jumps | outliers.spikes[1:] | outliers.spikes[:-1]
    return Fit(
        poses=bridge_outliers(streams, T, outliers.spikes),
        error=np.zeros((len(streams), 6)),
        course=course,
        T=T,
        model=NoiseModel((), centre, interval_s, duration_s, tuning),
        levels=rough_levels(residuals, left_out, tuning.jitter),
        outliers=outliers,
        weights=np.ones(len(streams)),
        sigmas=np.array(tuning.first_sizes),
    )


def _centre_of_rotations(
    streams: Streams, T: FloatArray, residuals: FloatArray, max_ratio: float
) -> str:
    """Return the centre (CENTRES) about which white rotation errors turn.

    The centre is the origin of a world if the translations of residuals (n, 6) at this origin are
    smaller than ``max_ratio`` times those at the sensors.
    """
    translations = residuals[:, :3]
    rotations = residuals[:, 3:]
    poses_of_child = {
        "child": streams.Ts_cw_c[1:],
        "parent": streams.Ts_pw_p[1:] @ T,
    }
    sizes = {"sensors": median(np.linalg.norm(translations, axis=1))}
    for world, poses in poses_of_child.items():
        to_origin = se3.translation_of(se3.inverse(poses))
        at_origin = translations + np.cross(rotations, to_origin)
        sizes[world] = median(np.linalg.norm(at_origin, axis=1))
    smallest = min(CENTRES, key=lambda centre: sizes[centre])
    if sizes[smallest] < max_ratio * sizes["sensors"]:
        return smallest
    return "sensors"


def noise(workspace: Workspace, fit: Fit) -> Fit:
    """Fit all levels of the model on a sample of the poses, then take a step of X on this sample.

    The restricted likelihood marginalises X and all systematic errors, so that a systematic error
    does not count as noise. The step changes X alone: which systematic errors are present is
    decided later, by :func:`systematic`.
    """
    problem = workspace.problem
    tuning = problem.tuning
    space = problem.space(fit, sample(len(problem.streams), tuning))
    prior = fit.model.prior(fit.levels)
    fitted, _ = reml.fit(space, fit.levels, prior, tuning.settled_loss)
    xi_and_residual = [*range(6), -1]
    products_of_xi = fitted.products[np.ix_(xi_and_residual, xi_and_residual)]
    moved = fit.moved(NormalEquations(products_of_xi).step, [])
    course = problem.course(moved.T, fitted.levels)
    return replace(moved, levels=fitted.levels, course=course)


def outliers(workspace: Workspace, fit: Fit) -> Fit:
    """Detect jumps and outlier poses, and fit the noise without them."""
    problem = workspace.problem
    tuning = problem.tuning
    detected = _detect_in_rounds(workspace, fit, tuning.max_rounds)
    if detected.outliers.differs_from(fit.outliers):
        detected = _detect_in_rounds(workspace, noise(workspace, detected), 1)
    spikes = detected.outliers.spikes
    if np.mean(spikes) > tuning.max_outlier_share:
        # So many outliers are not single poses, but long noisy stretches. Weights for heavy tails
        # replace the outliers, unless the stage `tails` is skipped.
        detected = replace(
            detected,
            outliers=Outliers(detected.outliers.jumps, np.zeros_like(spikes)),
            poses=problem.streams,
            error=np.zeros_like(fit.error),
            has_heavy_tails=True,
        )
    return detected


def _detect_in_rounds(
    workspace: Workspace, fit: Fit, rounds: int, with_spikes: bool = True
) -> Fit:
    """Detect jumps and outlier poses until none of them changes, at most ``rounds`` times.

    With spikes, the fit also stores whether the remaining errors have heavy tails. Without spikes,
    only jumps are detected: in this case outlier poses have small weights.
    """
    problem = workspace.problem
    tuning = problem.tuning
    for _ in range(rounds):
        if problem.is_noisy(fit):
            fit = fit.corrected(
                problem.streams, _expected_states(workspace, fit)
            )
        of_walk, of_white = leave_one_out_chi_squares(
            workspace.posterior(fit), fit.outliers.spikes
        )
        detected = detect_outliers(
            fit.outliers, of_walk, of_white, tuning, with_spikes
        )
        if not detected.differs_from(fit.outliers):
            break
        fit = replace(
            fit,
            outliers=detected,
            poses=bridge_outliers(problem.streams, fit.T, detected.spikes),
            error=np.zeros_like(fit.error),
        )
    if with_spikes:
        of_sound = of_white[~fit.outliers.spikes]
        is_heavy = (
            np.mean(of_sound**2)
            > tuning.heavy_kurtosis * np.mean(of_sound) ** 2
        )
        fit = replace(fit, has_heavy_tails=bool(is_heavy))
    return fit


def _expected_states(workspace: Workspace, fit: Fit) -> FloatArray:
    """Return the expected states (N, d) after the next step of the parameters.

    This is a separate function, so that the caller keeps no reference to the posterior: two
    posteriors of a long recording would fill the memory.
    """
    posterior = workspace.posterior(fit)
    return posterior.states_after(posterior.normal.step)


def tails(workspace: Workspace, fit: Fit) -> Fit:
    """Weight the white errors by Student's t distribution if they have heavy tails."""
    if not fit.has_heavy_tails:
        return fit
    for _ in range(2):
        # The weights need three rounds. The levels stay constant.
        for _ in range(3):
            fit = replace(fit, weights=tail_weights(workspace.posterior(fit)))
        fit = noise(workspace, fit)
    return _detect_in_rounds(workspace, fit, 2, with_spikes=False)


def time_correlated(workspace: Workspace, fit: Fit) -> Fit:
    """Add time-correlated errors to the model if they lower the loss enough.

    The search begins with all processes, and fits all levels again: those of the processes, of
    white noise and of the walk. Processes without information are dropped twice: after the first
    steps, so that the remaining steps are faster, and at the end. After the end, the remaining
    levels are not fitted again, and the decrease of the loss is that before the drop. In 58
    simulated drives, the drop at the end changed the loss by at most 0.8.
    """
    problem = workspace.problem
    tuning = problem.tuning
    kept = sample(len(problem.streams), tuning)
    # Allow large biases. Otherwise a process would explain a constant bias as its own.
    free = replace(fit, sigmas=np.array(tuning.sizes))
    loss_before = Posterior(problem.space(free, kept), fit.levels).loss
    # White noise and walk start with at least a share of the variance of an increment, so that the
    # loss depends on their levels.
    lowest = increment_levels(fit.levels) + np.log(tuning.start_share)
    levels = fit.levels.copy()
    levels[WHITES] = np.maximum(levels[WHITES], lowest)
    levels[WALKS] = np.maximum(levels[WALKS], lowest)
    model, levels = fit.model.with_processes(PROCESSES, levels)
    rival = replace(free, model=model, levels=levels)
    settled_loss = tuning.settled_loss * len(levels)
    for n_steps in (_FIRST_STEPS, reml.MAX_STEPS):
        space = problem.space(rival, kept)
        prior = rival.model.prior(rival.levels)
        fitted, information = reml.fit(
            space, rival.levels, prior, settled_loss, n_steps
        )
        matters = np.diag(information)[VARIANCES] > tuning.min_information
        if n_steps == _FIRST_STEPS:
            # A process whose level has risen may gain information in the remaining steps.
            matters |= (fitted.levels > rival.levels)[VARIANCES]
        rival = _with_processes(rival, fitted.levels, matters)
    if loss_before - fitted.loss < tuning.least_gain:
        return fit
    return replace(fit, model=rival.model, levels=rival.levels)


def _with_processes(fit: Fit, levels: FloatArray, is_kept: BoolArray) -> Fit:
    """Return the fit at given levels, with some of its K time-correlated errors.

    Parameters
    ----------
    fit : Fit
    levels : (m,) array
        Levels of all K processes and of all other errors.
    is_kept : (K,) bool array
    """
    processes = tuple(compress(fit.model.processes, is_kept))
    model = replace(fit.model, processes=processes)
    is_kept_level = np.ones(len(levels), dtype=bool)
    is_kept_level[N_FAST:] = np.repeat(is_kept, 2)
    return replace(fit, model=model, levels=levels[is_kept_level])


class _Hypothesis(NamedTuple):
    """Set of systematic errors that are assumed to be present.

    ``fit`` contains the prior standard deviations of the errors, and ``normal`` is its solution.
    ``loss`` is minus twice the log evidence.
    """

    fit: Fit
    normal: NormalEquations
    loss: float


def systematic(workspace: Workspace, fit: Fit) -> Fit:
    """Choose the likeliest systematic errors, then take a step of X and of these errors.

    The child's path has a scale, a bias along one of its axes, or none of them. Each of these sets
    is tried with and without a time offset. The smoothed errors c are removed from the poses.
    Systematic errors remain parameters.
    """
    problem = workspace.problem
    tuning = problem.tuning
    posterior = workspace.posterior(fit)
    plain = _likeliest(problem, fit, posterior, [])
    plain_information = np.linalg.pinv(
        plain.normal.covariance[:6, :6], hermitian=True
    )
    best = plain
    largest_gain = 0.0
    for column in problem.columns:
        if column >= TIME:
            continue
        rival = _likeliest(problem, fit, posterior, [column])
        gain = plain.loss - rival.loss
        if column != SCALE:
            gain *= tuning.bias_gain_share
        # Ratios of the variances of X with and without the error. The largest over all directions
        # counts.
        ratios = plain_information @ rival.normal.covariance[:6, :6]
        growth = np.linalg.eigvals(ratios).real.max()
        if growth < tuning.max_sigma_growth**2 and gain > largest_gain:
            best = rival
            largest_gain = gain
    step = best.normal.step
    moved = best.fit.moved(step, problem.columns)
    moved = replace(moved, course=problem.course(moved.T, fit.levels))
    return moved.corrected(problem.streams, posterior.states_after(step))


def _likeliest(
    problem: Problem,
    fit: Fit,
    posterior: Posterior | PartwisePosterior,
    path_columns: list[int],
) -> _Hypothesis:
    """Return the likelier hypothesis: the given errors of the path, with or without a time offset.

    The noise levels were fitted with other systematic errors. Therefore the evidence integrates
    over a common factor of all variances, and is that of Student's t distribution. The prior of the
    factor counts as much as all residuals.

    Parameters
    ----------
    problem : Problem
    fit : Fit
    posterior : Posterior
        Posterior of the fit.
    path_columns : list of int
        Indices of the errors of the path that are assumed to be present.
    """
    tuning = problem.tuning
    choices_of_time = [[], [TIME]] if TIME in problem.columns else [[]]
    if problem.is_clock_free:
        # The clock offset was estimated, so its error is certainly present.
        choices_of_time = choices_of_time[-1:]
    products = posterior.products - problem.prior(fit)
    n_rows = 6.0 * len(problem.streams)
    hypotheses = []
    for time_columns in choices_of_time:
        present = path_columns + time_columns
        # The bias of the angular rates is always present.
        is_present = [k in present or k in RATE for k in range(N_SYSTEMATIC)]
        rival = replace(
            fit, sigmas=np.where(is_present, tuning.sizes, tuning.absent_sigma)
        )
        normal = NormalEquations(products + problem.prior(rival))
        loss = 2.0 * n_rows * np.log1p(max(float(normal.cost), 0.0) / n_rows)
        loss += float(normal.log_determinant + 2.0 * np.log(rival.sigmas).sum())
        loss += 2.0 * tuning.least_gain * len(present)
        hypotheses.append(_Hypothesis(rival, normal, loss))
    return min(hypotheses, key=lambda hypothesis: hypothesis.loss)


def polish(workspace: Workspace, fit: Fit) -> Fit:
    """Take steps of X and of systematic errors until all of them settle.

    The number of steps is at most ``max_rounds`` minus 1, because the solution takes one more step.
    """
    problem = workspace.problem
    for _ in range(problem.tuning.max_rounds - 1):
        if is_settled(workspace, fit):
            break
        fit = _take_step(workspace, fit)
    return fit


def _take_step(workspace: Workspace, fit: Fit) -> Fit:
    """Take one step of all parameters. Remove the expected errors from the poses.

    The step and the errors are those of the present weights. If the white errors have heavy tails,
    the returned fit has new weights, which count from the next step on.
    """
    problem = workspace.problem
    posterior = workspace.posterior(fit)
    if fit.has_heavy_tails and "tails" not in problem.without:
        fit = replace(fit, weights=tail_weights(posterior))
    step = posterior.normal.step
    moved = fit.moved(step, problem.columns)
    return moved.corrected(problem.streams, posterior.states_after(step))


def is_settled(workspace: Workspace, fit: Fit) -> bool:
    """Return whether the next step of each parameter is small relative to its standard deviation.

    A direction in which the translation of X has a large standard deviation need not settle: the
    motion does not excite it.
    """
    tuning = workspace.problem.tuning
    normal = workspace.posterior(fit).normal
    # Compare the translation along its principal axes.
    steps = normal.step.copy()
    variances = np.diag(normal.covariance).copy()
    variances[:3], axes = np.linalg.eigh(normal.covariance[:3, :3])
    steps[:3] = axes.T @ normal.step[:3]
    sigmas = np.sqrt(np.maximum(variances, 0.0))
    limits = np.maximum(tuning.settled_sigmas * sigmas, np.sqrt(MIN_VARIANCE))
    limits[:3][sigmas[:3] > tuning.unknown_m] = np.inf
    return bool((np.abs(steps) < limits).all())


# Function that runs a stage of the search.
Stage: TypeAlias = Callable[[Workspace, Fit], Fit]
STAGES: tuple[Stage, ...] = (
    noise,
    outliers,
    tails,
    time_correlated,
    systematic,
    polish,
)
