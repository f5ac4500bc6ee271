"""The stages of the search, in order: each takes a problem and a fit and returns a fit.

``start`` makes the first one. Noise levels come before outliers, which need them; errors that last
are looked for once outliers are out; systematic errors are chosen under the noise found so far.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls import noise_model, reml
from hand_eye_calib.gls.increments import N_SYSTEMATIC, Streams, course_of, linearise, parameters_of
from hand_eye_calib.gls.noise_model import CENTRES, SCALE_DRIFT, Extent, NoiseModel
from hand_eye_calib.gls.normal import NormalEquations, selected
from hand_eye_calib.gls.outliers import (
    Outliers,
    bridged,
    first_outliers,
    judged,
    surprises,
    tail_weights,
    tails_are_heavy,
    with_jumps_across_spikes,
)
from hand_eye_calib.gls.problem import Fit, Problem, after, sample
from hand_eye_calib.gls.state_space import Posterior
from hand_eye_calib.gls.systematic import systematic
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.solvers.registry import Method
from hand_eye_calib.stats import median

# In the model while levels are fitted: scale, one bias, time. Two would differ by noise alone.
_WHILE_FITTING = ("scale", "bias", "time")


def start(problem: Problem) -> Fit:
    """Robust first answer, and what it says about jumps, noise and the centre of its rotation."""
    streams, tuning = problem.streams, problem.tuning
    pairs = motion_pairs(streams.Ts_pw_p, streams.Ts_cw_c, tuning.start_reference)
    T = Method("dnlo").solve(pairs).T_parent_child
    course, none = course_of(streams, T), np.zeros(N_SYSTEMATIC)
    linearisation = linearise(streams, course, T, none, ())
    residuals, metres = linearisation.residuals, max(median(linearisation.metres), 1e-9)
    extent = Extent(median(np.diff(streams.stamps_s)), metres, float(streams.stamps_s[-1]))
    outliers = first_outliers(residuals)
    poses = bridged(streams, T, outliers.spikes)
    if outliers.spikes.any():
        bridging = linearise(poses, course, T, none, ()).residuals
        outliers = with_jumps_across_spikes(outliers, residuals, bridging)
    centre = _centre(streams, T, residuals, tuning.decisive_centre)
    model = NoiseModel((SCALE_DRIFT,), "time", centre, extent)
    beside = outliers.jumps | outliers.spikes[1:] | outliers.spikes[:-1]
    return Fit(
        poses=poses,
        error=np.zeros((len(streams), 6)),
        course=course,
        T=T,
        model=model,
        levels=model.first_levels(*rough_levels(residuals, beside)),
        outliers=outliers,
        weights=np.ones(len(streams)),
        columns=_while_fitting(problem.systematic),
    )


def _while_fitting(names: tuple[str, ...]) -> list[int]:
    """Parameters of systematic errors that are in the model while the noise levels are fitted."""
    if len(names) == 1:
        return parameters_of(names[0])
    chosen = {part for name in names for part in name.split("+")}
    return [column for part in _WHILE_FITTING if part in chosen for column in parameters_of(part)]


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


def rough_levels(residuals: FloatArray, left_out: np.ndarray) -> tuple[FloatArray, FloatArray]:
    """Log variances of white noise (2,) and of the walk (2,), from scatter and correlation.

    Differences of white noise have variance 2 s^2 and a covariance of -s^2 with their neighbours;
    the walk adds variance alone.
    """
    kept = ~left_out
    together = kept[1:] & kept[:-1]
    white, walk = np.empty((2, 2))
    for index, part in enumerate((slice(0, 3), slice(3, 6))):
        of_part = residuals[:, part]
        total = np.mean(of_part[kept] ** 2) if kept.any() else noise_model.LOWEST_VARIANCE
        total = max(float(total), 100 * noise_model.LOWEST_VARIANCE)
        products = of_part[1:][together] * of_part[:-1][together]
        neighbours = np.mean(products) if together.any() else -total / 2
        white[index] = np.clip(-neighbours, 0.05 * total, 0.5 * total)
        walk[index] = max(total - 2 * white[index], 0.02 * total)
    return np.log(white), np.log(walk)


def noise(problem: Problem, fit: Fit) -> Fit:
    """Noise levels of white noise, walk and drifting scale, and one step of X; first for a walk by
    time or by distance, whichever is more likely, if the sensors are not as fast at all times.
    """
    is_open = fit.n_evaluations == 0 and fit.course.is_uneven
    kept = sample(len(problem.streams), problem.tuning.most_poses)
    levels, fits = fit.levels, []
    for walk_by in ("time", "distance") if is_open else (fit.model.walk_by,):
        model = replace(fit.model, walk_by=walk_by)
        fits.append((model, reml.fit(problem.space(fit, kept, model), levels, model.prior(levels))))
        levels = model.raised(fits[0][1].levels)
    model, found = min(fits, key=lambda each: each[1].loss)
    step = NormalEquations(selected(found.posterior.products, list(range(6)))).step
    T = after(fit.T, step)
    return replace(
        fit,
        model=model,
        levels=found.levels,
        T=T,
        course=course_of(problem.streams, T, model.step_noise(found.levels)),
        n_evaluations=fit.n_evaluations + sum(each.n_evaluations for _, each in fits),
    )


def outliers(problem: Problem, fit: Fit) -> Fit:
    """Jumps and spikes, and the noise without them."""
    tuning = problem.tuning
    found = _outliers_found(problem, fit, tuning.outlier_rounds)
    changed = found.outliers.differs_by(fit.outliers) > tuning.negligible
    if changed:
        found = _outliers_found(problem, noise(problem, found), 1)
    if np.mean(found.outliers.spikes) > tuning.most_spikes:
        # Whole stretches are noisy, not single poses wrong: they count less, and none is left out.
        none = Outliers(found.outliers.jumps, np.zeros_like(found.outliers.spikes))
        found = replace(found, outliers=none, poses=problem.streams, has_heavy_tails=True)
    return found


def _outliers_found(problem: Problem, fit: Fit, rounds: int, with_spikes: bool = True) -> Fit:
    """Jumps and spikes in turn, until they stay; or jumps alone, where tails have weights."""
    for _ in range(rounds):
        if problem.is_noisy(fit):
            fit = _freed(problem, fit)
        of_walk, of_white = surprises(problem.posterior(fit), fit.outliers.spikes)
        found = judged(fit.outliers, of_walk, of_white, with_spikes)
        if found.same_as(fit.outliers):
            break
        fit = fit.bridged(problem.streams, found)
    if with_spikes:
        fit = replace(fit, has_heavy_tails=tails_are_heavy(fit.outliers, of_white))
    return fit


def tails(problem: Problem, fit: Fit) -> Fit:
    """Weights of white errors whose level varies, if their tails are heavy."""
    if not fit.has_heavy_tails:
        return fit
    for _ in range(2):
        posterior = problem.posterior(fit)
        for _ in range(problem.tuning.tail_rounds - 1):
            weights = np.where(fit.outliers.spikes, 0.0, tail_weights(posterior))
            posterior = posterior.with_weights(weights)
        fit = noise(problem, replace(fit, weights=tail_weights(posterior)))
    return _outliers_found(problem, fit, 2, with_spikes=False)


def lasting(problem: Problem, fit: Fit) -> Fit:
    """Errors that last, if the data ask for them."""
    tuning, model = problem.tuning, fit.model
    kept = sample(len(problem.streams), tuning.most_poses_lasting)
    scores = []
    for tau_s in model.taus_s():
        with_faint, faint = model.with_faint_lasting(fit.levels, tau_s)
        posterior = Posterior(problem.space(fit, kept, with_faint), faint)
        scores.append((tau_s, *reml.derivatives(posterior)))
    slow, levels, promised = model.promising(scores, fit.levels)
    if promised < tuning.least_promise:
        return fit
    richer = model.richer((*slow, *model.slow))
    levels = richer.raised(levels)
    found = reml.fit(problem.space(fit, kept, richer), levels, richer.prior(levels))
    before = Posterior(problem.space(fit, kept), fit.levels)
    fit = replace(fit, n_evaluations=fit.n_evaluations + found.n_evaluations + len(scores) + 1)
    if before.loss - found.loss < tuning.least_gain:
        return fit
    reduced, levels = richer.reduced(found)
    fit = replace(fit, model=reduced, levels=levels)
    return replace(fit, cov_beyond=np.diag(_mean_variances(problem, fit, kept)))


def _mean_variances(problem: Problem, fit: Fit, kept: IntArray | None) -> FloatArray:
    """Variances (6,) of the mean of errors fixed to the body that last too long to be found.

    Errors that last often do so on all scales (flicker). A recording hardly shows those about as
    long as itself, and X takes their mean. So beside each process that was found, there is the
    longest that is modelled with half the variance, as flicker has, or none, both weighted by
    likelihood.
    """
    tuning, variances = problem.tuning, np.zeros(6)
    none = Posterior(problem.space(fit, kept), fit.levels).loss
    for process, size in fit.model.fixed_to_body(fit.levels):
        longer = tuning.longer_share * size
        model, levels = fit.model.with_longer(process, fit.levels, longer)
        loss = Posterior(problem.space(fit, kept, model), levels).loss
        probability = 1.0 / (1.0 + np.exp(min(loss - none, tuning.no_chance)))
        part = noise_model.states_of(process.part)
        variances[part] = noise_model.LONGEST_IN_THE_MEAN * probability * longer
    return variances


def polish(problem: Problem, fit: Fit) -> Fit:
    """X followed to the end, derivatives taken from poses freed of their errors."""
    for _ in range(problem.tuning.max_rounds - 1):
        posterior = problem.posterior(fit)
        if _is_settled(posterior.normal, problem):
            break
        if fit.has_heavy_tails and "tails" not in problem.without:
            fit = replace(fit, weights=tail_weights(posterior))
        step = posterior.normal.step
        fit = replace(fit.moved(step), n_evaluations=fit.n_evaluations + 1)
        fit = fit.freed(problem.streams, posterior.states_after(step))
    return problem.workspace.settled(fit, _is_settled(problem.posterior(fit).normal, problem))


def _freed(problem: Problem, fit: Fit) -> Fit:
    """At poses freed of the errors that are known of all poses, X as it is."""
    posterior = problem.posterior(fit)
    return fit.freed(problem.streams, posterior.states_after(posterior.normal.step))


def _is_settled(normal: NormalEquations, problem: Problem) -> bool:
    """Whether the step is small beside its sigmas, but for a translation that the rotations hardly
    reveal: noise moves it on and on.
    """
    tuning = problem.tuning
    variances, axes = np.linalg.eigh(normal.covariance[:3, :3])
    known = axes if variances[2] < tuning.most_uneven * variances[1] else axes[:, :2]
    steps = np.concatenate([known.T @ normal.step[:3], normal.step[3:]])
    of_axes = np.diag(known.T @ normal.covariance[:3, :3] @ known)
    sigmas = np.sqrt(np.maximum(np.r_[of_axes, np.diag(normal.covariance)[3:]], 0.0))
    limits = np.maximum(tuning.settled_sigmas * sigmas, tuning.settled_step)
    return bool((np.abs(steps) < limits).all())


STAGES = (noise, outliers, tails, lasting, systematic, polish)
