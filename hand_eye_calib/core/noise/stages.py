"""Stages of the adaptive search, in order.

A :class:`Problem` holds the data and never changes. A :class:`Fit` is a state of the search: X, the
noise model, outliers and systematic errors; a fit never changes either. A :class:`Workspace` keeps
the factorisation for the last fit. :func:`start` makes the first fit. Each stage takes a workspace
and a fit, and returns another fit. The order has reasons: outliers need noise levels,
time-correlated errors must not explain outliers, and systematic errors need the noise model.
docs/adaptive.md describes each stage.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import NamedTuple, TypeAlias

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.noise import reml
from hand_eye_calib.core.noise.increments import (
    N_SYSTEMATIC,
    RATE,
    SCALE,
    TIME,
    Course,
    Streams,
    course_of,
    linearise,
)
from hand_eye_calib.core.noise.noise_model import (
    CENTRES,
    LASTING,
    LOWEST_VARIANCE,
    N_FAST,
    ROTATION,
    VARIANCES,
    WALKS,
    WHITES,
    NoiseModel,
    increment_levels,
)
from hand_eye_calib.core.noise.normal import NormalEquations
from hand_eye_calib.core.noise.outliers import (
    Outliers,
    bridged,
    first_outliers,
    innovations,
    judged,
    tail_weights,
)
from hand_eye_calib.core.noise.state_space import WHITE, Posterior, StateSpace
from hand_eye_calib.core.noise.tuning import TUNING, Tuning
from hand_eye_calib.core.pairing.motion_pairs import motion_pairs
from hand_eye_calib.core.solvers.registry import Method

# Longest step of the translation of X (m). No lever arm is that long.
_LONGEST_STEP_M = 1000.0

# Steps of the search for time-correlated errors before processes without information are dropped.
_FIRST_STEPS = 4

# Longest step of X (m, rad) that is rounding.
_ROUNDING_STEP = 1e-9


@dataclass(frozen=True)
class Problem:
    """Data of a search: poses of two sensors, and which parameters to estimate.

    Attributes
    ----------
    streams : Streams
    columns : list of int
        Parameters of the systematic errors in the model, see
        :data:`~hand_eye_calib.core.noise.increments.PARAMETERS`.
    is_clock_free : bool
        Whether the time offset was estimated from the same poses.
    without : frozenset of str
        Names of the stages to leave out.
    tuning : Tuning
    """

    streams: Streams
    columns: list[int]
    is_clock_free: bool = False
    without: frozenset[str] = frozenset()
    tuning: Tuning = TUNING

    def prior(self, fit: Fit) -> FloatArray:
        """Products (p + 1, p + 1) of the prior of the parameters."""
        values = fit.parameters[self.columns]
        return prior_products(values, fit.sigmas[self.columns], 7 + len(values))

    def space(self, fit: Fit, kept: IntArray | None = None) -> StateSpace:
        """State space of all poses, or of some."""
        if kept is not None:
            fit = fit.at_poses(kept, self.tuning.longest_gap)
        linearisation = linearise(
            fit.poses, fit.course, fit.T, fit.parameters, self.columns, fit.error
        )
        return fit.model.state_space(
            fit.poses,
            linearisation,
            fit.course.twists,
            fit.T,
            np.where(fit.outliers.spikes, 0.0, fit.weights),
            fit.outliers.jumps,
            self.prior(fit),
        )

    def course(self, T_parent_child: FloatArray, levels: FloatArray) -> Course:
        """Course of the streams, smoothed as far as noise of these levels requires."""
        noise_m = float(np.exp(0.5 * increment_levels(levels)[0]))
        return course_of(self.streams, T_parent_child, self.tuning.caution * noise_m**2)

    def is_noisy(self, fit: Fit) -> bool:
        """Whether rotation noise exceeds a share of the rotation between poses."""
        turns = se3.rotation_angle(se3.rotation_of(self.streams.motions_p))
        return bool(np.exp(0.5 * fit.levels[ROTATION]) > self.tuning.noisy_share * median(turns))


class Workspace:
    """A problem, and the factorisation for the last fit.

    Attributes
    ----------
    problem : Problem
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        # Only the posterior of the last fit is stored, because a posterior of all poses is large.
        self._fit: Fit | None = None
        self._posterior: Posterior | None = None

    def posterior(self, fit: Fit) -> Posterior:
        """Return the posterior of all poses; solve only if the fit is not the last one."""
        if self._posterior is None or self._fit is not fit:
            # Release the memory of the last one first.
            self._posterior = None
            self._posterior = Posterior(self.problem.space(fit), fit.levels)
            self._fit = fit
        return self._posterior


@dataclass(frozen=True, kw_only=True)
class Fit:
    """State of a search.

    Attributes
    ----------
    poses : Streams
        Without the errors estimated so far, outlier poses bridged.
    error : (N, 6) array
        Errors c that were taken out of the poses.
    course : Course
    T : (4, 4) array
        X.
    model : NoiseModel
    levels : (m,) array
        Log levels of the model.
    outliers : Outliers
    weights : (N,) array
        Of white errors; other than 1 if tails are heavy.
    sigmas : (8,) array
        Prior standard deviations of systematic errors.
    has_heavy_tails : bool
    parameters : (8,) array
        Of systematic errors.
    """

    poses: Streams
    error: FloatArray
    course: Course
    T: FloatArray
    model: NoiseModel
    levels: FloatArray
    outliers: Outliers
    weights: FloatArray
    sigmas: FloatArray
    has_heavy_tails: bool = False
    parameters: FloatArray = field(default_factory=lambda: np.zeros(N_SYSTEMATIC))

    def at_poses(self, kept: IntArray, longest_gap: int) -> Fit:
        """Return the fit of a subset of poses, see :meth:`Outliers.across`."""
        return replace(
            self,
            poses=self.poses[kept],
            error=self.error[kept],
            course=self.course[kept],
            outliers=self.outliers.across(kept, longest_gap),
            weights=self.weights[kept],
        )

    def moved(self, step: FloatArray, columns: list[int]) -> Fit:
        """Return the fit after a step of xi and of the parameters of some columns.

        X stays if the step is longer than any lever arm: noise along a direction that the motion
        hardly excites.
        """
        parameters = self.parameters.copy()
        parameters[columns] += step[6:]
        if np.linalg.norm(step[:3]) >= _LONGEST_STEP_M:
            return replace(self, parameters=parameters)
        return replace(self, T=self.T @ se3.exp(step[:6]), parameters=parameters)

    def corrected(self, streams: Streams, states: FloatArray) -> Fit:
        """Return the fit with the errors of states (N, d) taken out of the given poses.

        White errors are split between the sensors by their covariances, which holds for errors of
        these covariances only. A lasting error of some centimetres, split by white noise of a
        millimetre, would become large and opposite rotations. So all other errors are split in
        halves, and the errors of outlier poses, too.
        """
        spikes = self.outliers.spikes
        T = self.T
        white_error = np.where(spikes[:, None], 0.0, states[:, :WHITE])
        error = states[:, :WHITE] + self.model.lasting(states, self.poses, T)
        other_error = error - white_error
        shares = self.model.shares(self.levels, self.poses, T)
        white_of_parent = se3.times(shares, white_error)
        of_parent = white_of_parent + 0.5 * other_error
        of_child = white_of_parent - white_error - 0.5 * other_error
        measured = bridged(streams, T, spikes)
        poses = Streams(
            streams.stamps_s,
            measured.Ts_pw_p @ se3.exp(-of_parent @ se3.adjoint(T).T),
            measured.Ts_cw_c @ se3.exp(-of_child),
        )
        return replace(self, poses=poses, error=error)


def prior_products(values: FloatArray, sigmas: FloatArray, size: int) -> FloatArray:
    """Products (size, size) of a prior: parameters are zero with some standard deviations.

    Parameters
    ----------
    values : (k,) array
        Present values of the last k parameters.
    sigmas : (k,) array
        Prior standard deviations.
    size : int
        Number of all parameters, plus 1 for the residuals.
    """
    products = np.zeros((size, size))
    indices = np.arange(size - 1 - len(values), size - 1)
    weights = sigmas**-2.0
    products[indices, indices] = weights
    products[indices, -1] = weights * values
    products[-1, indices] = weights * values
    products[-1, -1] = weights @ values**2
    return products


def sample(n_poses: int, tuning: Tuning) -> IntArray | None:
    """Return poses to fit noise levels with: evenly spread bursts. None means all poses."""
    if n_poses <= tuning.most_poses:
        return None
    burst = np.array(tuning.burst)
    n_bursts = tuning.most_poses // len(burst)
    # A burst is at most twice as long as the time between the starts of two bursts.
    offsets = burst[2 * len(burst) * n_poses // tuning.most_poses > burst]
    starts = np.linspace(0, n_poses - 1 - offsets[-1], n_bursts).astype(int)
    return np.unique(starts[:, None] + offsets)


def start(problem: Problem) -> Fit:
    """Estimate X robustly, then jumps, noise levels and the centre of rotation noise."""
    streams = problem.streams
    tuning = problem.tuning
    pairs = motion_pairs(streams.Ts_pw_p, streams.Ts_cw_c, tuning.start_reference)
    T = Method("dnlo").solve(pairs).T_parent_child
    course = course_of(streams, T)
    residuals = linearise(streams, course, T, np.zeros(N_SYSTEMATIC), []).residuals
    outliers = first_outliers(streams, course, T, residuals, tuning)
    interval_s = median(np.diff(streams.stamps_s))
    duration_s = float(np.ptp(streams.stamps_s))
    centre = _centre(streams, T, residuals, tuning.centre_ratio)
    left_out = outliers.jumps | outliers.spikes[1:] | outliers.spikes[:-1]
    return Fit(
        poses=bridged(streams, T, outliers.spikes),
        error=np.zeros((len(streams), 6)),
        course=course,
        T=T,
        model=NoiseModel((), centre, interval_s, duration_s, tuning),
        levels=rough_levels(residuals, left_out, tuning.jitter),
        outliers=outliers,
        weights=np.ones(len(streams)),
        sigmas=np.array(tuning.first_sizes),
    )


def _centre(streams: Streams, T: FloatArray, residuals: FloatArray, decisive: float) -> str:
    """Centre of white rotation noise, see :data:`~hand_eye_calib.core.noise.noise_model.CENTRES`.

    It is the origin of a world if residuals at that origin are clearly smaller.
    """
    worlds = {"child": streams.Ts_cw_c[1:], "parent": streams.Ts_pw_p[1:] @ T}
    sizes = {"sensors": median(np.linalg.norm(residuals[:, :3], axis=1))}
    for centre, poses in worlds.items():
        to_origin = se3.translation_of(se3.inverse(poses))
        at_origin = residuals[:, :3] + np.cross(residuals[:, 3:], to_origin)
        sizes[centre] = median(np.linalg.norm(at_origin, axis=1))
    best = min(CENTRES, key=lambda centre: sizes[centre])
    return best if sizes[best] < decisive * sizes["sensors"] else "sensors"


def rough_levels(residuals: FloatArray, left_out: BoolArray, jitter: float) -> FloatArray:
    """Return log levels (5,) to start at: half of each mean square is white noise, half is walk.

    Parameters
    ----------
    residuals : (n, 6) array
    left_out : (n,) bool array
        Increments that are no evidence.
    jitter : float
        Log variance (s^2) of the jitter of stamps.
    """
    squares = (residuals[~left_out] ** 2).reshape(-1, 2, 3)
    variances = np.zeros(2)
    if len(squares):
        variances = squares.mean(axis=(0, 2))
    total = np.log(np.maximum(variances, 100 * LOWEST_VARIANCE))
    levels = np.full(N_FAST, jitter)
    # An increment has the white noise of two poses.
    levels[WHITES] = total + np.log(0.25)
    levels[WALKS] = total + np.log(0.5)
    return levels


def noise(workspace: Workspace, fit: Fit) -> Fit:
    """Fit the levels of white noise and walk, then take one step of X."""
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
    searched = _with_outliers(workspace, fit, tuning.max_rounds)
    if searched.outliers.differs_by(fit.outliers) > tuning.negligible_share:
        searched = _with_outliers(workspace, noise(workspace, searched), 1)
    spikes = searched.outliers.spikes
    if np.mean(spikes) > tuning.max_outlier_share:
        # Whole stretches are noisy, and no single pose is wrong. All poses get less weight instead.
        searched = replace(
            searched,
            outliers=Outliers(searched.outliers.jumps, np.zeros_like(spikes)),
            poses=problem.streams,
            has_heavy_tails=True,
        )
    return searched


def _with_outliers(workspace: Workspace, fit: Fit, rounds: int, with_spikes: bool = True) -> Fit:
    """Detect jumps and outlier poses alternately until few change.

    Without spikes, detect only jumps: heavy tails have weights instead.
    """
    problem = workspace.problem
    tuning = problem.tuning
    for _ in range(rounds):
        if problem.is_noisy(fit):
            fit = fit.corrected(problem.streams, _states_of(workspace, fit))
        of_walk, of_white = innovations(workspace.posterior(fit), fit.outliers.spikes)
        detected = judged(fit.outliers, of_walk, of_white, tuning, with_spikes)
        change = detected.differs_by(fit.outliers)
        if change:
            poses = bridged(problem.streams, fit.T, detected.spikes)
            fit = replace(fit, outliers=detected, poses=poses, error=np.zeros_like(fit.error))
        if change <= tuning.negligible_share:
            break
    if with_spikes:
        normal = of_white[~fit.outliers.spikes]
        is_heavy = np.mean(normal**2) > tuning.heavy_kurtosis * np.mean(normal) ** 2
        fit = replace(fit, has_heavy_tails=bool(is_heavy))
    return fit


def _states_of(workspace: Workspace, fit: Fit) -> FloatArray:
    """Return the expected states (N, d) after the next step of a fit.

    No caller needs a reference to the posterior then: two posteriors of a long recording would fill
    the memory.
    """
    posterior = workspace.posterior(fit)
    return posterior.states_after(posterior.normal.step)


def tails(workspace: Workspace, fit: Fit) -> Fit:
    """Weight white errors with heavy tails."""
    if not fit.has_heavy_tails:
        return fit
    for _ in range(2):
        posterior = workspace.posterior(fit)
        # Three rounds of weights at one model; the last weights are those of the next fit.
        for _ in range(2):
            weights = np.where(fit.outliers.spikes, 0.0, tail_weights(posterior))
            posterior = Posterior(replace(posterior.space, weights=weights), posterior.levels)
        fit = noise(workspace, replace(fit, weights=tail_weights(posterior)))
    return _with_outliers(workspace, fit, 2, with_spikes=False)


def lasting(workspace: Workspace, fit: Fit) -> Fit:
    """Add time-correlated errors to the model if the data ask for them.

    The search begins with all processes. Processes without information are dropped after some
    steps, which makes the other steps faster, and again at the end.
    """
    problem = workspace.problem
    tuning = problem.tuning
    kept = sample(len(problem.streams), tuning)
    # Large biases are possible here. Otherwise a bias would become drift and never be found.
    free = replace(fit, sigmas=np.array(tuning.sizes))
    loss_before = Posterior(problem.space(free, kept), fit.levels).loss
    # Neither white noise nor walk is too small to matter during the search.
    lowest = increment_levels(fit.levels) + np.log(tuning.start_share)
    levels = fit.levels.copy()
    levels[WHITES] = np.maximum(levels[WHITES], lowest)
    levels[WALKS] = np.maximum(levels[WALKS], lowest)
    model, levels = fit.model.with_lasting(LASTING, levels)
    rival = replace(free, model=model, levels=levels)
    settled_loss = tuning.settled_loss * len(levels)
    for n_steps in (_FIRST_STEPS, reml.MAX_STEPS):
        space = problem.space(rival, kept)
        prior = rival.model.prior(rival.levels)
        fitted, information = reml.fit(space, rival.levels, prior, settled_loss, n_steps)
        matters = np.diag(information)[VARIANCES] > tuning.min_information
        if n_steps == _FIRST_STEPS:
            # The level of a process without information may rise in the other steps.
            matters |= (fitted.levels > rival.levels)[VARIANCES]
        rival = _with_processes(rival, fitted.levels, matters)
    if loss_before - fitted.loss < tuning.least_gain:
        return fit
    return replace(fit, model=rival.model, levels=rival.levels)


def _with_processes(fit: Fit, levels: FloatArray, is_kept: BoolArray) -> Fit:
    """Return the fit at levels (m,) with only some of its K time-correlated errors.

    Parameters
    ----------
    fit : Fit
    levels : (m,) array
    is_kept : (K,) bool array
    """
    model = replace(fit.model, slow=tuple(compress(fit.model.slow, is_kept)))
    is_kept_level = np.r_[np.ones(N_FAST, dtype=bool), np.repeat(is_kept, 2)]
    return replace(fit, model=model, levels=levels[is_kept_level])


class _Hypothesis(NamedTuple):
    """Systematic errors that may be present: the fit, its solution and its loss."""

    fit: Fit
    normal: NormalEquations
    loss: float


def systematic(workspace: Workspace, fit: Fit) -> Fit:
    """Choose the likeliest systematic errors, then take a step of X and of their parameters.

    The child's path has a scale, or a bias along one of its axes, or neither. The step is taken at
    poses without their errors.
    """
    problem = workspace.problem
    tuning = problem.tuning
    posterior = workspace.posterior(fit)
    plain = _likeliest(problem, fit, posterior, [])
    plain_information = np.linalg.pinv(plain.normal.covariance[:6, :6], hermitian=True)
    best = plain
    largest_gain = 0.0
    for column in problem.columns:
        if column >= TIME:
            continue
        rival = _likeliest(problem, fit, posterior, [column])
        gain = plain.loss - rival.loss
        if column != SCALE:
            gain *= tuning.bias_gain_share
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
    problem: Problem, fit: Fit, posterior: Posterior, path_columns: list[int]
) -> _Hypothesis:
    """Return the likelier hypothesis: errors of the path with or without a time offset.

    The loss is minus twice the log evidence. The noise levels may be those of other systematic
    errors, so a common factor of all variances is integrated out: its prior counts as much as all
    residuals, and makes the evidence one of Student's t distribution.
    """
    tuning = problem.tuning
    choices_of_time = [[], [TIME]] if TIME in problem.columns else [[]]
    if problem.is_clock_free:
        # A time offset without a prior is present for sure.
        choices_of_time = choices_of_time[-1:]
    products = posterior.products - problem.prior(fit)
    log_odds = np.log(tuning.odds)
    n_rows = 6.0 * len(problem.streams)
    hypotheses = []
    for time_columns in choices_of_time:
        present = path_columns + time_columns
        is_present = [k in present or k in RATE for k in range(N_SYSTEMATIC)]
        rival = replace(fit, sigmas=np.where(is_present, tuning.sizes, tuning.absent_sigma))
        normal = NormalEquations(products + problem.prior(rival))
        loss = 2.0 * n_rows * np.log1p(max(float(normal.cost), 0.0) / n_rows)
        loss += float(normal.log_determinant + 2.0 * np.log(rival.sigmas).sum())
        loss -= 2.0 * log_odds * len(present)
        hypotheses.append(_Hypothesis(rival, normal, loss))
    return min(hypotheses, key=lambda hypothesis: hypothesis.loss)


def polish(workspace: Workspace, fit: Fit) -> Fit:
    """Follow X until it settles, with derivatives at poses without their errors."""
    problem = workspace.problem
    for _ in range(problem.tuning.max_rounds - 1):
        if is_settled(workspace, fit):
            break
        fit = _polished(workspace, fit)
    return fit


def _polished(workspace: Workspace, fit: Fit) -> Fit:
    """Take one step of all parameters, and take the expected errors out of the poses."""
    problem = workspace.problem
    posterior = workspace.posterior(fit)
    if fit.has_heavy_tails and "tails" not in problem.without:
        fit = replace(fit, weights=tail_weights(posterior))
    step = posterior.normal.step
    moved = fit.moved(step, problem.columns)
    return moved.corrected(problem.streams, posterior.states_after(step))


def is_settled(workspace: Workspace, fit: Fit) -> bool:
    """Return whether the next step is a small share of its standard deviations.

    Translations that the motion does not excite need not settle.
    """
    tuning = workspace.problem.tuning
    normal = workspace.posterior(fit).normal
    principal_variances, axes = np.linalg.eigh(normal.covariance[:3, :3])
    steps = np.r_[axes.T @ normal.step[:3], normal.step[3:]]
    variances = np.r_[principal_variances, np.diag(normal.covariance)[3:]]
    sigmas = np.sqrt(np.maximum(variances, 0.0))
    limits = np.maximum(tuning.settled_sigmas * sigmas, _ROUNDING_STEP)
    limits[:3][sigmas[:3] > tuning.unknown_m] = np.inf
    return bool((np.abs(steps) < limits).all())


# A stage of the search.
Stage: TypeAlias = Callable[[Workspace, Fit], Fit]
STAGES: tuple[Stage, ...] = (noise, outliers, tails, lasting, systematic, polish)
