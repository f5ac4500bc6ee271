"""What is to be solved, where a search stands, and the stages of the search, in order.

Each stage takes a :class:`Problem` and a :class:`Fit`, and returns another fit; neither ever
changes. ``start`` makes the first one. Noise levels come before outliers, which need them; errors
that last are looked for once outliers are out; systematic errors are chosen under the noise found
so far.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import compress

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
    N_FAST,
    ROTATION,
    TRANSLATION,
    WALK_ROTATION,
    WALK_TRANSLATION,
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


@dataclass(frozen=True)
class Problem:
    """Poses of two sensors, and what is asked of them.

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
    # The fit whose posterior of all poses was asked for last, and that posterior. It is large.
    _last: list[tuple[Fit, Posterior]] = field(default_factory=list)

    def known(self, fit: Fit) -> FloatArray:
        """Products (p + 1, p + 1) that what is known of the parameters beforehand adds."""
        values, weights = fit.parameters[self.columns], fit.sigmas[self.columns] ** -2.0
        return known_products(range(6, 6 + len(values)), values, weights, 7 + len(values))

    def space(
        self, fit: Fit, kept: IntArray | None = None, model: NoiseModel | None = None
    ) -> StateSpace:
        """State space of all or some of the poses, with a model other than that of the fit."""
        poses, course, error, weights = fit.poses, fit.course, fit.error, fit.weights
        outliers = fit.outliers
        if kept is not None:
            poses, course = poses[kept], course[kept]
            error, weights = error[kept], weights[kept]
            outliers = outliers.across(kept)
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

    def posterior(self, fit: Fit) -> Posterior:
        """The posterior of all poses; that of the last fit is kept."""
        if not self._last or self._last[0][0] is not fit:
            self._last.clear()
            self._last.append((fit, Posterior(self.space(fit), fit.levels)))
        return self._last[0][1]

    def is_noisy(self, fit: Fit) -> bool:
        """Whether the rotation between poses is not large beside its noise."""
        turns = se3.rotation_angle(self.streams.motions_p[:, :3, :3])
        return bool(np.exp(0.5 * fit.levels[ROTATION]) > self.tuning.noisy * median(turns))


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Where a search stands.

    Attributes
    ----------
    poses : Streams
        Freed of the errors known so far, outlier poses bridged.
    error : (N, 6) array
        Those errors.
    course : Course
    T : (4, 4) array
        X.
    model, levels
        Noise model and its log levels.
    outliers : Outliers
    weights : (N,) array
        Of white errors; other than 1 where tails are heavy.
    sigmas : (8,) array
        What systematic errors are known to beforehand.
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
        """After a step of xi and of these parameters; X as it is if noise alone makes a step so
        long, along a direction that the motion hardly shows.
        """
        is_long = np.linalg.norm(step[:3]) >= TUNING.longest_step_m
        parameters = self.parameters.copy()
        parameters[columns] += step[6:]
        T = self.T if is_long else self.T @ se3.exp(step[:6])
        return replace(self, T=T, parameters=parameters)

    def freed(self, streams: Streams, states: FloatArray) -> Fit:
        """The fit with the given poses freed of the errors that latent states (N, d) make.

        White errors are split between the sensors by their covariances, which holds for errors of
        these covariances only. A lasting error of some centimetres beside white noise of a
        millimetre would be taken for large and opposite rotations, so other errors are split in
        halves; outlier poses, too.
        """
        spikes, T = self.outliers.spikes, self.T
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
    """Products (size, size) of what is known beforehand: that parameters at these places, which
    have these values, are zero, with these precisions.
    """
    known, at = np.zeros((size, size)), list(at)
    known[at, at] = weights
    known[at, -1] = known[-1, at] = weights * values
    known[-1, -1] = weights @ values**2
    return known


def sample(n_poses: int, most: int) -> IntArray | None:
    """Poses to fit noise levels with: evenly spread bursts, ever farther apart within each; None
    for all of them.
    """
    if n_poses <= most:
        return None
    burst = np.array(TUNING.burst)
    offsets = burst[2 * len(burst) * n_poses // most > burst]
    starts = np.linspace(0, n_poses - 1 - offsets[-1], most // len(burst)).astype(int)
    return np.unique(starts[:, None] + offsets)


def start(problem: Problem) -> Fit:
    """Robust first answer, and what it says about jumps, noise and the centre of its rotation."""
    streams, tuning = problem.streams, problem.tuning
    pairs = motion_pairs(streams.Ts_pw_p, streams.Ts_cw_c, tuning.start_reference)
    T = Method("dnlo").solve(pairs).T_parent_child
    course = course_of(streams, T)
    residuals = linearise(streams, course, T, np.zeros(N_SYSTEMATIC), ()).columns[:, :, -1]
    outliers = first_outliers(streams, course, T, residuals)
    interval_s, duration_s = median(np.diff(streams.stamps_s)), float(np.ptp(streams.stamps_s))
    centre = _centre(streams, T, residuals, tuning.decisive_centre)
    beside = outliers.jumps | outliers.spikes[1:] | outliers.spikes[:-1]
    return Fit(
        poses=bridged(streams, T, outliers.spikes),
        error=np.zeros((len(streams), 6)),
        course=course,
        T=T,
        model=NoiseModel((), centre, interval_s, duration_s),
        levels=rough_levels(residuals, beside),
        outliers=outliers,
        weights=np.ones(len(streams)),
        sigmas=np.array(tuning.first_sizes),
    )


def _centre(streams: Streams, T: FloatArray, residuals: FloatArray, decisive: float) -> str:
    """What white rotation noise turns the trajectories about, see ``noise_model.CENTRES``."""
    worlds = {"child": streams.Ts_cw_c[1:], "parent": streams.Ts_pw_p[1:] @ T}
    sizes = {"sensors": median(np.linalg.norm(residuals[:, :3], axis=1))}
    for centre, poses in worlds.items():
        to_origin = se3.inverse(poses)[:, :3, 3]
        there = residuals[:, :3] + np.cross(residuals[:, 3:], to_origin)
        sizes[centre] = median(np.linalg.norm(there, axis=1))
    best = min(CENTRES, key=lambda centre: sizes[centre])
    return best if sizes[best] < decisive * sizes["sensors"] else "sensors"


def rough_levels(residuals: FloatArray, left_out: np.ndarray) -> FloatArray:
    """Log levels (5,) to start at, from scatter and correlation.

    Differences of white noise have variance 2 s^2 and a covariance of -s^2 with their neighbours;
    the walk adds variance alone.
    """
    kept = ~left_out
    together = kept[1:] & kept[:-1]
    levels, least = np.full(N_FAST, TUNING.jitter), TUNING.lowest_variance
    at = (TRANSLATION, WALK_TRANSLATION), (ROTATION, WALK_ROTATION)
    for (of_white, of_walk), of_part in zip(at, np.split(residuals, 2, axis=1), strict=True):
        total = np.mean(of_part[kept] ** 2) if kept.any() else least
        total = max(float(total), 100 * least)
        products = of_part[1:][together] * of_part[:-1][together]
        neighbours = np.mean(products) if together.any() else -total / 2
        white = float(np.clip(-neighbours, *np.multiply(TUNING.first_white, total)))
        levels[of_white] = np.log(white)
        levels[of_walk] = np.log(max(total - 2 * white, TUNING.first_walk * total))
    return levels


def noise(problem: Problem, fit: Fit) -> Fit:
    """Noise levels of white noise and walk, and one step of X."""
    kept = sample(len(problem.streams), problem.tuning.most_poses)
    found, _ = reml.fit(problem.space(fit, kept), fit.levels, fit.model.prior(fit.levels))
    of_xi = [*range(6), -1]
    moved = fit.moved(NormalEquations(found.products[np.ix_(of_xi, of_xi)]).step, [])
    noise_m = float(np.exp(0.5 * whole(found.levels)[0]))
    course = course_of(problem.streams, moved.T, noise_m)
    return replace(moved, levels=found.levels, course=course)


def outliers(problem: Problem, fit: Fit) -> Fit:
    """Jumps and outlier poses, and the noise without them."""
    tuning = problem.tuning
    found = _outliers_found(problem, fit, tuning.outlier_rounds)
    if found.outliers.differs_by(fit.outliers) > tuning.negligible:
        found = _outliers_found(problem, noise(problem, found), 1)
    if np.mean(found.outliers.spikes) > tuning.most_spikes:
        # Whole stretches are noisy, no single pose is wrong: all get less weight, none is left out.
        none = Outliers(found.outliers.jumps, np.zeros_like(found.outliers.spikes))
        found = replace(found, outliers=none, poses=problem.streams, has_heavy_tails=True)
    return found


def _outliers_found(problem: Problem, fit: Fit, rounds: int, with_spikes: bool = True) -> Fit:
    """Jumps and outlier poses in turn, until few change; jumps alone where tails have weights."""
    for _ in range(rounds):
        if problem.is_noisy(fit):
            posterior = problem.posterior(fit)
            fit = fit.freed(problem.streams, posterior.states_after(posterior.normal.step))
        of_walk, of_white = innovations(problem.posterior(fit), fit.outliers.spikes)
        found = judged(fit.outliers, of_walk, of_white, with_spikes)
        if change := found.differs_by(fit.outliers):
            poses = bridged(problem.streams, fit.T, found.spikes)
            fit = replace(fit, outliers=found, poses=poses, error=np.zeros_like(fit.error))
        if change <= TUNING.negligible:
            break
    if with_spikes:
        normal = of_white[~fit.outliers.spikes]
        is_heavy = np.mean(normal**2) > TUNING.heavy_kurtosis * np.mean(normal) ** 2
        fit = replace(fit, has_heavy_tails=bool(is_heavy))
    return fit


def tails(problem: Problem, fit: Fit) -> Fit:
    """Weights of white errors whose level varies, if their tails are heavy."""
    if not fit.has_heavy_tails:
        return fit
    for _ in range(2):
        posterior = problem.posterior(fit)
        for _ in range(problem.tuning.tail_rounds - 1):
            weights = np.where(fit.outliers.spikes, 0.0, tail_weights(posterior))
            posterior = Posterior(replace(posterior.space, weights=weights), posterior.levels)
        fit = noise(problem, replace(fit, weights=tail_weights(posterior)))
    return _outliers_found(problem, fit, 2, with_spikes=False)


def lasting(problem: Problem, fit: Fit) -> Fit:
    """Time-correlated errors, if the data ask for them."""
    tuning = problem.tuning
    kept = sample(len(problem.streams), tuning.most_poses)
    # No white noise and no walk is so small that the search cannot hear it.
    levels, total = fit.levels.copy(), whole(fit.levels)
    levels[:2] = np.maximum(levels[:2], total + np.log(tuning.audible))
    levels[3:5] = np.maximum(levels[3:5], total + np.log(tuning.audible_walk))
    model, levels = fit.model.with_lasting(LASTING, levels)
    # Biases are free here: those that are there would be taken for drift and never be found.
    free = replace(fit, sigmas=np.array(tuning.sizes))
    prior, faint = model.prior(levels), levels - tuning.faded

    def smaller(levels: FloatArray, information: FloatArray) -> reml.Rest:
        """Without the processes that make no difference, of those below the faint levels."""
        nonlocal model, prior, faint
        matters = np.diag(information)[N_FAST::2] > tuning.least_information
        matters |= (levels >= faint)[N_FAST::2]
        if matters.all():
            return None
        left = np.r_[np.ones(N_FAST, dtype=bool), np.repeat(matters, 2)]
        model = replace(model, slow=tuple(compress(model.slow, matters)))
        faint, prior = faint[left], reml.Prior(*np.array(prior)[:, left])
        return problem.space(free, kept, model), levels[left], prior

    settled = TUNING.settled_loss * len(levels)
    space = problem.space(free, kept, model)
    found, information = reml.fit(space, levels, prior, settled, smaller)
    before = Posterior(problem.space(free, kept), fit.levels)
    if before.loss - found.loss < tuning.least_gain:
        return fit
    faint = np.full(len(found.levels), np.inf)
    rest = smaller(found.levels, information)
    return replace(fit, model=model, levels=rest[1] if rest else found.levels)


def systematic(problem: Problem, fit: Fit) -> Fit:
    """The likeliest systematic errors; and a step of X and of these, at poses freed of errors.

    The child's path has a scale, or a bias along one of its axes, or neither.
    """
    posterior, tuning, columns = problem.posterior(fit), problem.tuning, problem.columns
    without, log_odds = posterior.products - problem.known(fit), np.log(tuning.odds)
    times = [[], [TIME]] if TIME in columns else [[]]
    # A time offset that is not known beforehand is there.
    times = times[-1:] if problem.is_clock_free else times
    # The levels may be those of other systematic errors: they are known as by so much evidence.
    rows = 6.0 * len(problem.streams)

    def likeliest(of_path: list[int]) -> tuple[float, Fit, NormalEquations]:
        """The loss with these errors of the path, with a time offset or without."""
        found = []
        for there in (of_path + time for time in times):
            is_there = [k in there or k in RATE for k in range(N_SYSTEMATIC)]
            rival = replace(fit, sigmas=np.where(is_there, tuning.sizes, tuning.none))
            normal = NormalEquations(without + problem.known(rival))
            loss = 2.0 * rows * np.log1p(float(normal.cost) / rows)
            loss += float(normal.log_determinant + 2.0 * np.log(rival.sigmas).sum())
            found.append((loss - 2.0 * log_odds * len(there), rival, normal))
        return min(found, key=lambda each: each[0])

    best = plain = likeliest([])
    known, most = np.linalg.pinv(plain[2].covariance[:6, :6], hermitian=True), 0.0
    for column in (column for column in columns if column < TIME):
        rival = likeliest([column])
        gain = (plain[0] - rival[0]) * (1.0 if column == SCALE else tuning.like_scale)
        growth = np.linalg.eigvals(known @ rival[2].covariance[:6, :6]).real.max()
        if growth < tuning.most_growth**2 and gain > most:
            best, most = rival, gain
    _, chosen, normal = best
    moved = chosen.moved(normal.step, columns)
    noise_m = float(np.exp(0.5 * whole(fit.levels)[0]))
    moved = replace(moved, course=course_of(problem.streams, moved.T, noise_m))
    return moved.freed(problem.streams, posterior.states_after(normal.step))


def polish(problem: Problem, fit: Fit) -> Fit:
    """X followed to the end, derivatives taken from poses freed of their errors."""
    for _ in range(problem.tuning.max_rounds - 1):
        posterior = problem.posterior(fit)
        if is_settled(problem, fit):
            break
        if fit.has_heavy_tails and "tails" not in problem.without:
            fit = replace(fit, weights=tail_weights(posterior))
        step = posterior.normal.step
        moved = fit.moved(step, problem.columns)
        fit = moved.freed(problem.streams, posterior.states_after(step))
    return fit


def is_settled(problem: Problem, fit: Fit) -> bool:
    """Whether the next step is small beside its sigmas, but for translations that the motion does
    not reveal.
    """
    tuning, normal = problem.tuning, problem.posterior(fit).normal
    variances, axes = np.linalg.eigh(normal.covariance[:3, :3])
    steps = np.r_[axes.T @ normal.step[:3], normal.step[3:]]
    sigmas = np.sqrt(np.maximum(np.r_[variances, np.diag(normal.covariance)[3:]], 0.0))
    limits = np.maximum(tuning.settled_sigmas * sigmas, tuning.settled_step)
    limits[:3][sigmas[:3] > tuning.unknown_m] = np.inf
    return bool((np.abs(steps) < limits).all())


STAGES = (noise, outliers, tails, lasting, systematic, polish)
