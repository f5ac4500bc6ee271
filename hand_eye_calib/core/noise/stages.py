"""Stages of the adaptive search, in order.

A :class:`Problem` holds the data and never changes. A :class:`Fit` is a state of the search: X, the
noise model, outliers and systematic errors; it never changes either. A :class:`Workspace` keeps the
factorisation for the last fit. :func:`start` makes the first fit; each stage takes a workspace and
a fit, and returns another fit. Noise levels come before outliers, which need them; time-correlated
errors are searched for without outliers; systematic errors are chosen under the noise model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
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
    TRANSLATION,
    VARIANCES,
    WALK_ROTATION,
    WALK_TRANSLATION,
    WALKS,
    WHITES,
    NoiseModel,
    whole,
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

# No lever arm is that long (m).
_LONGEST_STEP_M = 1000.0

# Steps of X below this (m, rad) are rounding.
_SETTLED_STEP = 1e-9


@dataclass(frozen=True)
class Problem:
    """Data of a search: poses of two sensors, and which parameters to estimate.

    Attributes
    ----------
    streams : Streams
    columns : list of int
        Parameters of the systematic errors in the model.
    is_clock_free : bool
        Whether the time offset is not known beforehand.
    without : frozenset of str
        Names of the stages to leave out.
    tuning : Tuning
    """

    streams: Streams
    columns: list[int]
    is_clock_free: bool = False
    without: frozenset[str] = frozenset()
    tuning: Tuning = TUNING

    def known(self, fit: Fit) -> FloatArray:
        """Products (p + 1, p + 1) of the prior of the parameters."""
        values = fit.parameters[self.columns]
        weights = fit.sigmas[self.columns] ** -2.0
        return known_products(range(6, 6 + len(values)), values, weights, 7 + len(values))

    def space(
        self, fit: Fit, kept: IntArray | None = None, model: NoiseModel | None = None
    ) -> StateSpace:
        """State space of all or some of the poses, with a model other than that of the fit."""
        poses = fit.poses
        course = fit.course
        error = fit.error
        weights = fit.weights
        outliers = fit.outliers
        if kept is not None:
            poses = poses[kept]
            course = course[kept]
            error = error[kept]
            weights = weights[kept]
            outliers = outliers.across(kept, self.tuning.longest_gap)
        known = error if error.any() else None
        return (model or fit.model).state_space(
            poses,
            linearise(poses, course, fit.T, fit.parameters, self.columns, known),
            course.twists,
            fit.T,
            np.where(outliers.spikes, 0.0, weights),
            outliers.jumps,
            self.known(fit),
        )

    def course(self, T_parent_child: FloatArray, levels: FloatArray) -> Course:
        """Course of the given poses, steps smoothed as far as noise of these levels asks for."""
        noise_m = float(np.exp(0.5 * whole(levels)[0]))
        return course_of(self.streams, T_parent_child, self.tuning.caution * noise_m**2)

    def is_noisy(self, fit: Fit) -> bool:
        """Whether the rotation between poses is not large beside its noise."""
        turns = se3.rotation_angle(self.streams.motions_p[:, :3, :3])
        return bool(np.exp(0.5 * fit.levels[ROTATION]) > self.tuning.noisy * median(turns))


class Workspace:
    """What is computed for a problem and kept: the factorisation for the last fit.

    Attributes
    ----------
    problem : Problem
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        # One alone: a posterior of all poses is large.
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
        The errors taken out of the poses.
    course : Course
    T : (4, 4) array
        X.
    model, levels
        Noise model and its log levels.
    outliers : Outliers
    weights : (N,) array
        Of white errors; other than 1 where tails are heavy.
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

    def moved(self, step: FloatArray, columns: list[int]) -> Fit:
        """Return the fit after a step of xi and of the parameters of some columns.

        X stays if the step is longer than any lever arm: noise along a direction that the motion
        hardly shows.
        """
        is_long = np.linalg.norm(step[:3]) >= _LONGEST_STEP_M
        parameters = self.parameters.copy()
        parameters[columns] += step[6:]
        T = self.T if is_long else self.T @ se3.exp(step[:6])
        return replace(self, T=T, parameters=parameters)

    def freed(self, streams: Streams, states: FloatArray) -> Fit:
        """Return the fit with the errors of latent states (N, d) taken out of the given poses.

        White errors are split between the sensors by their covariances, which holds for errors of
        these covariances only. A lasting error of some centimetres beside white noise of a
        millimetre would be taken for large and opposite rotations, so other errors are split in
        halves; outlier poses, too.
        """
        spikes = self.outliers.spikes
        T = self.T
        white_error = np.where(spikes[:, None], 0.0, states[:, :WHITE])
        error = states[:, :WHITE] + self.model.lasting(states, self.poses, T)
        other_error = error - white_error
        of_white = se3.times(self.model.shares(self.levels, self.poses, T), white_error)
        by_parent = of_white + 0.5 * other_error
        by_child = of_white - white_error - 0.5 * other_error
        given = bridged(streams, T, spikes)
        poses = Streams(
            streams.stamps_s,
            given.Ts_pw_p @ se3.exp(-by_parent @ se3.adjoint(T).T),
            given.Ts_cw_c @ se3.exp(-by_child),
        )
        return replace(self, poses=poses, error=error)


def known_products(
    at: Sequence[int], values: FloatArray, weights: FloatArray, size: int
) -> FloatArray:
    """Products (size, size) of a prior: parameters at some indices are zero.

    ``values`` are the present values of these parameters, ``weights`` the precisions of the prior.
    """
    products = np.zeros((size, size))
    indices = list(at)
    products[indices, indices] = weights
    products[indices, -1] = products[-1, indices] = weights * values
    products[-1, -1] = weights @ values**2
    return products


def sample(n_poses: int, tuning: Tuning) -> IntArray | None:
    """Poses to fit noise levels with: evenly spread bursts. None for all poses."""
    most = tuning.most_poses
    if n_poses <= most:
        return None
    burst = np.array(tuning.burst)
    offsets = burst[2 * len(burst) * n_poses // most > burst]
    starts = np.linspace(0, n_poses - 1 - offsets[-1], most // len(burst)).astype(int)
    return np.unique(starts[:, None] + offsets)


def start(problem: Problem) -> Fit:
    """Estimate X robustly, then jumps, noise levels and the centre of rotation noise."""
    streams = problem.streams
    tuning = problem.tuning
    pairs = motion_pairs(streams.Ts_pw_p, streams.Ts_cw_c, tuning.start_reference)
    T = Method("dnlo").solve(pairs).T_parent_child
    course = course_of(streams, T)
    residuals = linearise(streams, course, T, np.zeros(N_SYSTEMATIC), ()).columns[:, :, -1]
    outliers = first_outliers(streams, course, T, residuals, tuning)
    interval_s = median(np.diff(streams.stamps_s))
    duration_s = float(np.ptp(streams.stamps_s))
    centre = _centre(streams, T, residuals, tuning.decisive_centre)
    beside = outliers.jumps | outliers.spikes[1:] | outliers.spikes[:-1]
    return Fit(
        poses=bridged(streams, T, outliers.spikes),
        error=np.zeros((len(streams), 6)),
        course=course,
        T=T,
        model=NoiseModel((), centre, interval_s, duration_s, tuning),
        levels=rough_levels(residuals, beside, tuning),
        outliers=outliers,
        weights=np.ones(len(streams)),
        sigmas=np.array(tuning.first_sizes),
    )


def _centre(streams: Streams, T: FloatArray, residuals: FloatArray, decisive: float) -> str:
    """Centre of white rotation noise, see ``noise_model.CENTRES``."""
    worlds = {"child": streams.Ts_cw_c[1:], "parent": streams.Ts_pw_p[1:] @ T}
    sizes = {"sensors": median(np.linalg.norm(residuals[:, :3], axis=1))}
    for centre, poses in worlds.items():
        to_origin = se3.inverse(poses)[:, :3, 3]
        there = residuals[:, :3] + np.cross(residuals[:, 3:], to_origin)
        sizes[centre] = median(np.linalg.norm(there, axis=1))
    best = min(CENTRES, key=lambda centre: sizes[centre])
    return best if sizes[best] < decisive * sizes["sensors"] else "sensors"


def rough_levels(residuals: FloatArray, left_out: np.ndarray, tuning: Tuning) -> FloatArray:
    """Log levels (5,) to start at, from scatter and correlation.

    Differences of white noise have variance 2 s^2 and a covariance of -s^2 with their neighbours;
    the walk adds variance alone.
    """
    kept = ~left_out
    together = kept[1:] & kept[:-1]
    levels = np.full(N_FAST, tuning.jitter)
    least = LOWEST_VARIANCE
    at = (TRANSLATION, WALK_TRANSLATION), (ROTATION, WALK_ROTATION)
    for (of_white, of_walk), of_part in zip(at, np.split(residuals, 2, axis=1), strict=True):
        total = np.mean(of_part[kept] ** 2) if kept.any() else least
        total = max(float(total), 100 * least)
        products = of_part[1:][together] * of_part[:-1][together]
        neighbours = np.mean(products) if together.any() else -total / 2
        white = float(np.clip(-neighbours, *np.multiply(tuning.first_white, total)))
        levels[of_white] = np.log(white)
        levels[of_walk] = np.log(max(total - 2 * white, tuning.first_walk * total))
    return levels


def noise(workspace: Workspace, fit: Fit) -> Fit:
    """Fit the levels of white noise and walk, then take one step of X."""
    problem = workspace.problem
    kept = sample(len(problem.streams), problem.tuning)
    space = problem.space(fit, kept)
    prior = fit.model.prior(fit.levels)
    fitted, _ = reml.fit(space, fit.levels, prior, problem.tuning)
    xi_and_residual = [*range(6), -1]
    products_of_xi = fitted.products[np.ix_(xi_and_residual, xi_and_residual)]
    moved = fit.moved(NormalEquations(products_of_xi).step, [])
    course = problem.course(moved.T, fitted.levels)
    return replace(moved, levels=fitted.levels, course=course)


def outliers(workspace: Workspace, fit: Fit) -> Fit:
    """Detect jumps and outlier poses, and fit the noise without them."""
    problem = workspace.problem
    tuning = problem.tuning
    searched = _with_outliers(workspace, fit, tuning.outlier_rounds)
    if searched.outliers.differs_by(fit.outliers) > tuning.negligible:
        searched = _with_outliers(workspace, noise(workspace, searched), 1)
    if np.mean(searched.outliers.spikes) > tuning.most_spikes:
        # Whole stretches are noisy, no single pose is wrong: all get less weight, none is left out.
        no_spikes = np.zeros_like(searched.outliers.spikes)
        searched = replace(
            searched,
            outliers=Outliers(searched.outliers.jumps, no_spikes),
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
            posterior = workspace.posterior(fit)
            fit = fit.freed(problem.streams, posterior.states_after(posterior.normal.step))
        of_walk, of_white = innovations(workspace.posterior(fit), fit.outliers.spikes)
        detected = judged(fit.outliers, of_walk, of_white, tuning, with_spikes)
        change = detected.differs_by(fit.outliers)
        if change:
            poses = bridged(problem.streams, fit.T, detected.spikes)
            fit = replace(fit, outliers=detected, poses=poses, error=np.zeros_like(fit.error))
        if change <= tuning.negligible:
            break
    if with_spikes:
        normal = of_white[~fit.outliers.spikes]
        is_heavy = np.mean(normal**2) > tuning.heavy_kurtosis * np.mean(normal) ** 2
        fit = replace(fit, has_heavy_tails=bool(is_heavy))
    return fit


def tails(workspace: Workspace, fit: Fit) -> Fit:
    """Weight white errors with heavy tails, whose level may vary."""
    tuning = workspace.problem.tuning
    if not fit.has_heavy_tails:
        return fit
    for _ in range(2):
        posterior = workspace.posterior(fit)
        for _ in range(tuning.tail_rounds - 1):
            weights = np.where(fit.outliers.spikes, 0.0, tail_weights(posterior, tuning))
            posterior = Posterior(replace(posterior.space, weights=weights), posterior.levels)
        fit = noise(workspace, replace(fit, weights=tail_weights(posterior, tuning)))
    return _with_outliers(workspace, fit, 2, with_spikes=False)


def lasting(workspace: Workspace, fit: Fit) -> Fit:
    """Add time-correlated errors to the model if the data ask for them."""
    problem = workspace.problem
    tuning = problem.tuning
    kept = sample(len(problem.streams), tuning)
    # Neither white noise nor walk is too small to matter during the search.
    total = whole(fit.levels)
    levels = fit.levels.copy()
    levels[WHITES] = np.maximum(levels[WHITES], total + np.log(tuning.audible))
    levels[WALKS] = np.maximum(levels[WALKS], total + np.log(tuning.audible_walk))
    model, levels = fit.model.with_lasting(LASTING, levels)
    # Biases are free here: a bias would be taken for drift and never be found.
    free = replace(fit, sigmas=np.array(tuning.sizes))
    prior = model.prior(levels)
    faint_levels = levels - tuning.faded

    def without_faint(levels: FloatArray, information: FloatArray) -> reml.Rest:
        """Drop processes below their faint level that make no difference."""
        nonlocal model, prior, faint_levels
        matters = np.diag(information)[VARIANCES] > tuning.least_information
        matters |= (levels >= faint_levels)[VARIANCES]
        if matters.all():
            return None
        is_kept = np.r_[np.ones(N_FAST, dtype=bool), np.repeat(matters, 2)]
        model = replace(model, slow=tuple(compress(model.slow, matters)))
        faint_levels = faint_levels[is_kept]
        prior = reml.Prior(*np.array(prior)[:, is_kept])
        return problem.space(free, kept, model), levels[is_kept], prior

    settled_loss = tuning.settled_loss * len(levels)
    space = problem.space(free, kept, model)
    fitted, information = reml.fit(space, levels, prior, tuning, settled_loss, without_faint)
    before = Posterior(problem.space(free, kept), fit.levels)
    if before.loss - fitted.loss < tuning.least_gain:
        return fit
    faint_levels = np.full(len(fitted.levels), np.inf)
    rest = without_faint(fitted.levels, information)
    return replace(fit, model=model, levels=rest[1] if rest else fitted.levels)


class _Hypothesis(NamedTuple):
    """Systematic errors that may be there: the loss with them, and the step that they make."""

    loss: float
    fit: Fit
    normal: NormalEquations


def systematic(workspace: Workspace, fit: Fit) -> Fit:
    """Choose the likeliest systematic errors, then take a step of X and of these.

    The child's path has a scale, or a bias along one of its axes, or neither. The step is taken at
    poses freed of their errors.
    """
    problem = workspace.problem
    tuning = problem.tuning
    columns = problem.columns
    posterior = workspace.posterior(fit)
    products = posterior.products - problem.known(fit)
    log_odds = np.log(tuning.odds)
    choices_of_time = [[], [TIME]] if TIME in columns else [[]]
    if problem.is_clock_free:
        # A time offset that is not known beforehand is there.
        choices_of_time = choices_of_time[-1:]
    # The levels may be those of other systematic errors: they are known as by so much evidence.
    n_rows = 6.0 * len(problem.streams)

    def likeliest(path_columns: list[int]) -> _Hypothesis:
        """Return the likelier hypothesis: these errors of the path with or without an offset."""
        hypotheses = []
        for time_columns in choices_of_time:
            present = path_columns + time_columns
            is_present = [k in present or k in RATE for k in range(N_SYSTEMATIC)]
            rival = replace(fit, sigmas=np.where(is_present, tuning.sizes, tuning.none))
            normal = NormalEquations(products + problem.known(rival))
            loss = 2.0 * n_rows * np.log1p(max(float(normal.cost), 0.0) / n_rows)
            loss += float(normal.log_determinant + 2.0 * np.log(rival.sigmas).sum())
            loss -= 2.0 * log_odds * len(present)
            hypotheses.append(_Hypothesis(loss, rival, normal))
        return min(hypotheses, key=lambda hypothesis: hypothesis.loss)

    plain = likeliest([])
    plain_information = np.linalg.pinv(plain.normal.covariance[:6, :6], hermitian=True)
    best = plain
    largest_gain = 0.0
    for column in columns:
        if column >= TIME:
            continue
        rival = likeliest([column])
        gain = plain.loss - rival.loss
        if column != SCALE:
            gain *= tuning.like_scale
        ratios = plain_information @ rival.normal.covariance[:6, :6]
        growth = np.linalg.eigvals(ratios).real.max()
        if growth < tuning.most_growth**2 and gain > largest_gain:
            best = rival
            largest_gain = gain
    step = best.normal.step
    moved = best.fit.moved(step, columns)
    moved = replace(moved, course=problem.course(moved.T, fit.levels))
    return moved.freed(problem.streams, posterior.states_after(step))


def polish(workspace: Workspace, fit: Fit) -> Fit:
    """Follow X to the end, with derivatives at poses freed of their errors."""
    problem = workspace.problem
    for _ in range(problem.tuning.max_rounds - 1):
        posterior = workspace.posterior(fit)
        if is_settled(workspace, fit):
            break
        if fit.has_heavy_tails and "tails" not in problem.without:
            fit = replace(fit, weights=tail_weights(posterior, problem.tuning))
        step = posterior.normal.step
        moved = fit.moved(step, problem.columns)
        fit = moved.freed(problem.streams, posterior.states_after(step))
    return fit


def is_settled(workspace: Workspace, fit: Fit) -> bool:
    """Return whether the next step is small beside its standard deviations.

    Translations that the motion does not show need not settle.
    """
    tuning = workspace.problem.tuning
    normal = workspace.posterior(fit).normal
    variances, axes = np.linalg.eigh(normal.covariance[:3, :3])
    steps = np.r_[axes.T @ normal.step[:3], normal.step[3:]]
    sigmas = np.sqrt(np.maximum(np.r_[variances, np.diag(normal.covariance)[3:]], 0.0))
    limits = np.maximum(tuning.settled_sigmas * sigmas, _SETTLED_STEP)
    limits[:3][sigmas[:3] > tuning.unknown_m] = np.inf
    return bool((np.abs(steps) < limits).all())


STAGES = (noise, outliers, tails, lasting, systematic, polish)
