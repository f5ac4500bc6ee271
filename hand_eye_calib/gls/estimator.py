"""The adaptive estimator: X by generalised least squares under a noise model that is estimated
along with it.

Instead of choosing which poses to compare, all evidence is weighed as the noise of these very
trajectories asks for: white noise favours long baselines, drift short ones, errors that last
neither, and a jump cuts the trajectory. docs/adaptive.md derives and tests it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls import noise_model, reml
from hand_eye_calib.gls.increments import (
    N_SYSTEMATIC,
    SYSTEMATIC,
    TIME,
    Course,
    Linearisation,
    Streams,
    course_of,
    linearise,
    parameters_of,
)
from hand_eye_calib.gls.noise_model import (
    CENTRES,
    LONGEST_IN_THE_MEAN,
    SCALE_DRIFT,
    Extent,
    NoiseModel,
)
from hand_eye_calib.gls.outliers import (
    LONGEST_GAP,
    Outliers,
    bridged,
    first_outliers,
    judged,
    spikes_beyond_tails,
    student_weights,
    surprises,
    tails_are_heavy,
    with_jumps_across_spikes,
)
from hand_eye_calib.gls.part_delays import part_delay, with_delay_columns
from hand_eye_calib.gls.relinearise import corrected, restored
from hand_eye_calib.gls.resampling import N_BLOCKS, answers_without, part_products
from hand_eye_calib.gls.solution import AdaptiveSolution
from hand_eye_calib.gls.state_space import (
    WHITE,
    NormalEquations,
    Posterior,
    StateSpace,
    selected,
)
from hand_eye_calib.gls.systematic_choice import Candidates, columns_of
from hand_eye_calib.gls.world_drift import N_COLUMNS, with_world_columns, world_drift
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.solvers.registry import Method
from hand_eye_calib.stats import distinct, median

# Robust start: DNLO over this reference sees through jumps, and does not need the noise levels.
_START_REFERENCE = "B3"

# Rotation noise turns about the origin of a world if residuals seen from there are so much smaller
# than at the sensors.
_DECISIVE = 0.7

# Noise levels need no more poses than this, in bursts that are spread evenly: bursts show the fast
# errors, the time between them the slow ones. Slow errors take more time and need fewer poses.
_MOST_POSES, _MOST_POSES_LASTING = 300, 200
_BURST = np.array([0, 1, 2, 3, 5, 8, 13, 21, 34, 55])

# In the model while levels are fitted: scale, time, one bias. Two would differ by noise alone.
_WHILE_FITTING = [0, 1, 2, 3, 7]

# No lever arm is that long (m).
_LONGEST_STEP_M = 1000.0

# Rounds of looking for jumps; of weighing heavy tails.
_OUTLIER_ROUNDS, _TAIL_ROUNDS = 4, 3

# No more than this share of the poses are wrong by themselves.
_MOST_SPIKES = 0.2

# If more than this share are, and the tails are heavy without them, most of them belong to these.
_MOST_SPIKES_IN_TAILS = 0.1

# Refit the noise levels only if more than this share of poses changed status.
_NEGLIGIBLE = 0.005

# Strides where a target's camera is noisy, if so many poses remain.
_STRIDES, _FEWEST_STRIDES = (3, 10, 30), 50

# Rotation noise this large beside the rotation between poses is not small; rounds of fitting then.
_NOISY, _FREED_ROUNDS = 0.2, 2

# Errors that last are looked for if a first step promises to lower the loss by so much, and part of
# the model if it is so much lower in the end.
_LEAST_PROMISE, _LEAST_GAIN = 2.0, 4.0

# The covariance of white errors has 19 shape parameters: they are used if they lower the loss by so
# much.
_LEAST_GAIN_OF_SHAPE = 19.0

# Size of errors that last longer than those found, as a share of their variance, if there are any.
# A loss larger by so much leaves no chance.
_LONGER_SHARE, _NO_CHANCE = 0.5, 100.0

# What chi-square with the degrees of freedom of the jackknife, nine, exceeds per degree once in ten
# times.
_CHANCE = 1.63

# Half of the freed memory that is kept for the next arrays.
_KEPT_BYTES = 1 << 24

# X is followed until it moves by less than this share of its sigma, at least one round.
_MAX_ROUNDS = 6
_SETTLED_SIGMAS, _SETTLED_STEP = 0.1, 1e-9

# A translation whose variance is this many times that of the next one need not settle.
_MOST_UNEVEN = 9.0


def solve(
    stamps_ns: IntArray,
    Ts_pw_p: FloatArray,
    Ts_cw_c: FloatArray,
    systematic: Sequence[str] = SYSTEMATIC,
    quick: bool = False,
    is_clock_free: bool = False,
    with_delays: bool = False,
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
    with_delays : bool
        Estimate delays, and how a world moves, too.

    Returns
    -------
    AdaptiveSolution
    """
    _keep_freed_memory()
    stamps_s = (stamps_ns - stamps_ns[0]) * 1e-9
    streams = Streams(stamps_s, Ts_pw_p, Ts_cw_c)
    start = dataclasses.replace(
        _start(streams, _while_fitting(systematic)),
        is_clock_free=is_clock_free,
        with_delays=with_delays,
    )
    plain = _fitted(start)
    if _is_noisy(plain):
        plain = _fitted_at_freed_poses(start, plain)
    plain = _without_outliers(plain, quick)
    kept = _strided(plain)
    if len(kept) < len(streams):
        fewer = solve(
            stamps_ns[kept],
            Ts_pw_p[kept],
            Ts_cw_c[kept],
            systematic,
            quick,
            is_clock_free,
            with_delays,
        )
        return _at_all_poses(fewer, kept, plain.outliers.spikes)
    found = plain if quick else _with_lasting_errors(_with_shape_of_white(plain))
    found, plain = _with_systematic_errors(found, systematic), dataclasses.replace(plain)
    solution = _polished(found)
    if not solution.converged:
        solution = _polished(_with_systematic_errors(plain, systematic[:1]))
    return solution


def _keep_freed_memory() -> None:
    """Let the C library keep freed memory for what comes next: glibc gives memory back to the
    system, page by page, when more is free than twice the largest block that was freed so far. This
    one is never written to, and takes no memory itself.
    """
    np.empty(_KEPT_BYTES, dtype=np.uint8)


def _while_fitting(systematic: Sequence[str]) -> list[int]:
    """Parameters of systematic errors that are in the model while the noise levels are fitted."""
    if len(systematic) == 1:
        return parameters_of(systematic[0])
    chosen = {column for name in systematic for column in parameters_of(name)}
    return [column for column in _WHILE_FITTING if column in chosen]


def _strided(state: _State) -> IntArray:
    """Poses to keep: all, but of a camera that sees a target, whose errors repeat from pose to pose
    and drown the rotation between them, only every so many.
    """
    every = np.arange(len(state.streams))
    if state.model.centre == "sensors" or not _is_noisy(state):
        return every
    every = every[~state.outliers.spikes]
    stride = max((s for s in _STRIDES if len(every) >= s * _FEWEST_STRIDES), default=1)
    noise = np.exp(0.5 * state.levels[noise_model.ROTATION])
    rotations = state.streams.Ts_pw_p[every, :3, :3]
    for rival in _STRIDES:
        back = np.swapaxes(rotations[:-rival], 1, 2)
        if noise < _NOISY * median(se3.rotation_angle(back @ rotations[rival:])):
            stride = min(stride, rival)
            break
    return every[::stride]


def _at_all_poses(fewer: AdaptiveSolution, kept: IntArray, spikes: BoolArray) -> AdaptiveSolution:
    """The solution of some poses, jumps and spikes told of all."""
    jumps, spikes = np.zeros(len(spikes) - 1, dtype=bool), spikes.copy()
    jumps[kept[1:][fewer.jumps] - 1] = True
    spikes[kept[fewer.spikes]] = True
    weights = np.ones(len(spikes))
    weights[kept] = fewer.weights
    return dataclasses.replace(fewer, jumps=jumps, spikes=spikes, weights=weights, is_drowned=True)


@dataclass(frozen=True)
class _State:
    """Where the search stands.

    Attributes
    ----------
    streams, poses : Streams
        As given, and freed of the errors known so far, spikes bridged.
    error : (N, 6) array
        Those errors.
    columns : list of int
        Parameters of systematic errors in the model.
    parameters : (11,) array
        Their values.
    other_sigmas : (11,) array
        Standard deviations of parameters that are not in the model.
    cov_beyond : (6, 6) array
        Of X, by what is not in the model: errors that last too long to be found, and systematic
        errors that may be there.
    is_clock_free : bool
        Whether a time offset is in the model if the motion tells it from X.
    with_delays : bool
        Whether the solution has delays, and how a world moves.
    weights : (N,) array
        Of white errors; other than 1 where tails are heavy.
    """

    streams: Streams
    poses: Streams
    error: FloatArray
    course: Course
    T: FloatArray
    model: NoiseModel
    levels: FloatArray
    outliers: Outliers
    weights: FloatArray
    heavy: bool = False
    systematic: str = "none"
    columns: list[int] = dataclasses.field(default_factory=list)
    parameters: FloatArray = dataclasses.field(default_factory=lambda: np.zeros(N_SYSTEMATIC))
    other_sigmas: FloatArray = dataclasses.field(default_factory=lambda: np.zeros(N_SYSTEMATIC))
    cov_beyond: FloatArray = dataclasses.field(default_factory=lambda: np.zeros((6, 6)))
    n_evaluations: int = 0
    is_clock_free: bool = False
    with_delays: bool = False

    def space(self, kept: IntArray | None = None, model: NoiseModel | None = None) -> StateSpace:
        """State space of all or some of the poses."""
        poses, course, error, weights = self.poses, self.course, self.error, self.weights
        outliers = self.outliers
        if kept is not None:
            poses, course, error, weights = poses[kept], course[kept], error[kept], weights[kept]
            outliers = outliers.across(kept, LONGEST_GAP)
        return (model or self.model).state_space(
            poses,
            self._linearised(poses, course, error, self.columns),
            course.twists,
            self.T,
            np.where(outliers.spikes, 0.0, weights),
            outliers.jumps,
        )

    def _linearised(
        self, poses: Streams, course: Course, error: FloatArray, columns: list[int]
    ) -> Linearisation:
        linearisation = linearise(poses, course, self.T, self.parameters, columns)
        return restored(linearisation, error) if error.any() else linearisation

    @cached_property
    def posterior(self) -> Posterior:
        """Of all poses. It is large: a copy of the state does not have it."""
        return Posterior(self.space(), self.levels)

    def posterior_with(self, columns: list[int]) -> Posterior:
        """Of all poses with other systematic errors in the model."""
        if "posterior" not in vars(self):
            return dataclasses.replace(self, columns=columns).posterior
        linearisation = self._linearised(self.poses, self.course, self.error, columns)
        return self._taken_posterior().with_columns(linearisation.columns)

    def posterior_with_delays(self) -> Posterior:
        """Of all poses, with the columns of a clock offset, of delays of positions, and of a world
        that moves.
        """
        columns = [*dict.fromkeys((*self.columns, TIME))]
        linearisation = self._linearised(self.poses, self.course, self.error, columns)
        linearisation = with_delay_columns(linearisation, self.poses.twists, self.T)
        linearisation = with_world_columns(linearisation, self.poses)
        return self._taken_posterior().with_columns(linearisation.columns)

    def _taken_posterior(self) -> Posterior:
        """The posterior, which the state forgets: what others do not share of it is freed."""
        posterior = self.posterior
        del vars(self)["posterior"]
        return posterior

    def moved(self, step: FloatArray) -> _State:
        """After a step of xi and of the parameters in the model."""
        parameters = self.parameters.copy()
        parameters[self.columns[: len(step) - 6]] += step[6:]
        return dataclasses.replace(self, T=_after(self.T, step[:6]), parameters=parameters)


def _after(T: FloatArray, step: FloatArray) -> FloatArray:
    """X after a step (6,); as it is if noise alone makes a step so long, along a direction that the
    motion hardly shows.
    """
    return T @ se3.exp(step) if np.linalg.norm(step[:3]) < _LONGEST_STEP_M else T


def _start(streams: Streams, columns: list[int]) -> _State:
    """Robust first answer, and what it says about jumps, noise and the centre of its rotation."""
    pairs = motion_pairs(streams.Ts_pw_p, streams.Ts_cw_c, _START_REFERENCE)
    T = Method("dnlo").solve(pairs).T_parent_child
    course = course_of(streams, T)
    linearisation = linearise(streams, course, T, np.zeros(N_SYSTEMATIC), ())
    interval_s = median(np.diff(streams.stamps_s))
    metres = max(median(linearisation.metres), 1e-9)
    extent = Extent(interval_s, metres, float(streams.stamps_s[-1]))
    outliers = first_outliers(linearisation.residuals)
    poses = bridged(streams, T, outliers.spikes)
    if outliers.spikes.any():
        bridging = linearise(poses, course, T, np.zeros(N_SYSTEMATIC), ()).residuals
        outliers = with_jumps_across_spikes(outliers, linearisation.residuals, bridging)
    model = NoiseModel((SCALE_DRIFT,), "time", _centre(streams, T, linearisation.residuals), extent)
    beside = outliers.jumps | outliers.spikes[1:] | outliers.spikes[:-1]
    levels = model.first_levels(*rough_levels(linearisation.residuals, beside))
    return _State(
        streams=streams,
        poses=poses,
        error=np.zeros((len(streams), 6)),
        course=course,
        T=T,
        model=model,
        levels=levels,
        outliers=outliers,
        weights=np.ones(len(streams)),
        columns=columns,
    )


def _centre(streams: Streams, T: FloatArray, residuals: FloatArray) -> str:
    """What white rotation noise turns the trajectories about, see ``noise_model.CENTRES``."""
    worlds = {"child": streams.Ts_cw_c[1:], "parent": streams.Ts_pw_p[1:] @ T}
    sizes = {"sensors": median(np.linalg.norm(residuals[:, :3], axis=1))}
    for centre, poses in worlds.items():
        to_origin = se3.inverse(poses)[:, :3, 3]
        there = residuals[:, :3] + np.cross(residuals[:, 3:], to_origin)
        sizes[centre] = median(np.linalg.norm(there, axis=1))
    best = min(CENTRES, key=lambda centre: sizes[centre])
    return best if sizes[best] < _DECISIVE * sizes["sensors"] else "sensors"


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


def sample(n_poses: int, most: int) -> IntArray | None:
    """Poses to fit noise levels with: evenly spread bursts, ever farther apart within each; None
    for all of them.
    """
    if n_poses <= most:
        return None
    offsets = _BURST[2 * len(_BURST) * n_poses // most > _BURST]
    starts = np.linspace(0, n_poses - 1 - offsets[-1], most // len(_BURST)).astype(int)
    return distinct((starts[:, None] + offsets).ravel())


def _fitted(state: _State, walks: tuple[str, ...] = ("time", "distance")) -> _State:
    """Noise levels of white noise, walk and drifting scale, and one step of X."""
    kept = sample(len(state.streams), _MOST_POSES)
    fits = []
    levels = state.levels
    if walks != (state.model.walk_by,) and not state.course.is_uneven:
        walks = (state.model.walk_by,)
    for walk_by in walks:
        model = dataclasses.replace(state.model, walk_by=walk_by)
        fits.append((model, reml.fit(state.space(kept, model), levels, model.prior(levels))))
        levels = model.raised(fits[0][1].levels)
    model, fit = min(fits, key=lambda each: each[1].loss)
    step = NormalEquations(selected(fit.posterior.products, list(range(6)))).step
    T = _after(state.T, step)
    n_evaluations = state.n_evaluations + sum(fit.n_evaluations for _, fit in fits)
    return dataclasses.replace(
        state,
        model=model,
        levels=fit.levels,
        T=T,
        course=course_of(state.streams, T, model.step_noise(fit.levels)),
        n_evaluations=n_evaluations,
    )


def _fitted_at_freed_poses(start: _State, fitted: _State) -> _State:
    """The fit again, with derivatives from poses freed of their errors, from the robust answer on:
    noise has drawn that of the first fit.
    """
    fitted = dataclasses.replace(fitted, T=start.T)
    for _ in range(_FREED_ROUNDS):
        fitted = _fitted(_at_freed_poses(fitted), (fitted.model.walk_by,))
    return fitted


def _without_outliers(state: _State, quick: bool) -> _State:
    """Jumps and spikes found, the noise fitted again, tails weighed if they are heavy."""
    walk = (state.model.walk_by,)
    found, of_white = _outliers_found(state, _OUTLIER_ROUNDS)
    if found.outliers.differs_by(state.outliers) > _NEGLIGIBLE:
        found = _fitted(found, walk)
        found, of_white = _outliers_found(found, 1)
    share = np.mean(found.outliers.spikes)
    if share > _MOST_SPIKES:
        # Whole stretches are noisy, not single poses wrong: they count less, and none is left out.
        outliers = Outliers(found.outliers.jumps, np.zeros_like(found.outliers.spikes))
        found = dataclasses.replace(found, outliers=outliers, poses=found.streams)
    elif quick or not tails_are_heavy(found.outliers, of_white):
        return found
    elif share > _MOST_SPIKES_IN_TAILS:
        found = _without_mild_spikes(found)
    for _ in range(2):
        found = _fitted(_weighed_tails(found), walk)
    return _outliers_found(found, 2)[0]


def _without_mild_spikes(state: _State) -> _State:
    """Reinstates outlier poses that a Student-t tail explains; they are down-weighted instead."""
    left_out = state.outliers.spikes
    errors = np.zeros_like(state.error)
    errors[left_out] = se3.log(
        se3.inverse(state.poses.Ts_cw_c[left_out]) @ state.streams.Ts_cw_c[left_out]
    )
    gross = spikes_beyond_tails(state.posterior, left_out, errors)
    outliers = Outliers(state.outliers.jumps, gross)
    poses = bridged(state.streams, state.T, gross)
    error = np.zeros_like(state.error)
    return dataclasses.replace(state, outliers=outliers, poses=poses, error=error)


def _weighed_tails(state: _State) -> _State:
    """With weights of white errors of Student's t distribution."""
    posterior = state.posterior
    for _ in range(_TAIL_ROUNDS - 1):
        weights = np.where(state.outliers.spikes, 0.0, student_weights(posterior))
        posterior = posterior.with_weights(weights)
    return dataclasses.replace(state, weights=student_weights(posterior), heavy=True)


def _outliers_found(state: _State, rounds: int) -> tuple[_State, FloatArray]:
    """Jumps and spikes in turn, until they stay; and the last chi-squares (N,) of white errors."""
    state = dataclasses.replace(state)
    for _ in range(rounds):
        if _is_noisy(state):
            state = _at_freed_poses(state)
        of_walk, of_white = surprises(state.posterior, state.outliers.spikes)
        outliers = judged(state.outliers, of_walk, of_white, with_spikes=not state.heavy)
        if outliers.same_as(state.outliers):
            break
        poses = bridged(state.streams, state.T, outliers.spikes)
        error = np.zeros_like(state.error)
        state = dataclasses.replace(state, outliers=outliers, poses=poses, error=error)
    return state, of_white


def _is_noisy(state: _State) -> bool:
    """Whether the rotation between poses is not large beside its noise."""
    noise = np.exp(0.5 * state.levels[noise_model.ROTATION])
    return bool(noise > _NOISY * state.streams.typical_turn)


def _with_shape_of_white(state: _State) -> _State:
    """With the white errors' own covariance if the data ask for it: a camera may be ten times as
    precise across its optical axis as along it.
    """
    streams, of_sensors = state.streams, state.model.centre == "sensors"
    if not of_sensors or streams.n_rows < WHITE or _is_noisy(state):
        return state
    model, levels = state.model.shaped(reml.white_moments(state.posterior), state.levels)
    kept = sample(len(state.streams), _MOST_POSES)
    before = Posterior(state.space(kept), state.levels)
    space = state.space(kept, model)
    if before.loss - Posterior(space, levels).loss < _LEAST_GAIN_OF_SHAPE:
        return state
    fit = reml.fit(space, levels, model.prior(levels))
    n_evaluations = state.n_evaluations + fit.n_evaluations + 2
    return dataclasses.replace(state, model=model, levels=fit.levels, n_evaluations=n_evaluations)


def _with_lasting_errors(plain: _State) -> _State:
    """The same with errors that last, if the data ask for them."""
    kept = sample(len(plain.streams), _MOST_POSES_LASTING)
    scores = []
    for tau_s in plain.model.taus_s():
        model, faint = plain.model.with_faint_lasting(plain.levels, tau_s)
        scores.append((tau_s, *reml.derivatives(Posterior(plain.space(kept, model), faint))))
    slow, start, promised = plain.model.promising(scores, plain.levels)
    if promised < _LEAST_PROMISE:
        return plain
    model = plain.model.richer((*slow, *plain.model.slow))
    fit = reml.fit(plain.space(kept, model), model.raised(start), model.prior(model.raised(start)))
    before = Posterior(plain.space(kept), plain.levels)
    n_evaluations = plain.n_evaluations + fit.n_evaluations + len(scores) + 1
    if before.loss - fit.loss < _LEAST_GAIN:
        return dataclasses.replace(plain, n_evaluations=n_evaluations)
    model, levels = model.reduced(fit)
    found = dataclasses.replace(plain, model=model, levels=levels, n_evaluations=n_evaluations)
    return dataclasses.replace(found, cov_beyond=np.diag(_mean_variances(found, kept)))


def _mean_variances(found: _State, kept: IntArray | None) -> FloatArray:
    """Variances (6,) of the mean of errors fixed to the body that last too long to be found.

    Errors that last often do so on all scales (flicker). A recording hardly shows those about as
    long as itself, and X takes their mean. So beside each process that was found, there is the
    longest that is modelled with half the variance, as flicker has, or none, both weighted by
    likelihood.
    """
    variances = np.zeros(6)
    none = Posterior(found.space(kept), found.levels).loss
    for process, size in found.model.fixed_to_body(found.levels):
        model, levels = found.model.with_longer(process, found.levels, _LONGER_SHARE * size)
        loss = Posterior(found.space(kept, model), levels).loss
        probability = 1.0 / (1.0 + np.exp(min(loss - none, _NO_CHANCE)))
        variance = probability * _LONGER_SHARE * size
        variances[noise_model.states_of(process.part)] = LONGEST_IN_THE_MEAN * variance
    return variances


def _with_systematic_errors(state: _State, systematic: Sequence[str]) -> _State:
    """The model of systematic errors that the data ask for, one step from where the search stands,
    at poses freed of their errors. All models are judged under the same noise. If the clock is
    free, those with a time offset come first, unless it differs from part to part.
    """
    tried = sorted({column for name in systematic for column in parameters_of(name)})
    posterior = state.posterior_with(tried)
    candidates = Candidates.of(tried, posterior, systematic)
    if state.is_clock_free or candidates.best != systematic[0]:
        candidates = candidates.judged_by_parts(prefers_time=state.is_clock_free)

    models = candidates.models

    def at_its_own(name: str) -> _State:
        own = dataclasses.replace(state, systematic=name, columns=models[name].parameters)
        return own.moved(models[name].fit.step)

    best = candidates.best
    if "bias" in best:
        # A scale is not of first order if it is large, and then a bias along the direction of
        # travel seems to be nearer: both are judged at their own parameters.
        scales = [name for name in candidates.credible if "scale" in name]
        best = min(
            (best, *sorted(scales, key=lambda name: models[name].criterion)[:1]),
            key=lambda name: at_its_own(name).posterior.normal.cost + models[name].penalty,
        )
    chosen = dataclasses.replace(
        at_its_own(best),
        other_sigmas=candidates.sigmas(("scale", "time")),
        cov_beyond=state.cov_beyond + candidates.spread_about(best),
    )
    states = posterior.states_after(models[best].fit.step, columns_of(chosen.columns, tried))
    return _freed(chosen, states)


def _polished(state: _State) -> AdaptiveSolution:
    """X followed to the end, derivatives taken from poses freed of their errors."""
    n_rounds = 1
    while isinstance(found := _polished_once(state, n_rounds == _MAX_ROUNDS), _State):
        state, n_rounds = found, n_rounds + 1
    return found


def _polished_once(state: _State, is_last: bool) -> AdaptiveSolution | _State:
    """The solution if the step is small or this round the last one, otherwise the next state."""
    converged = _is_settled(state.posterior.normal)
    return _solution(state, converged) if converged or is_last else _relinearised(state)


def _is_settled(normal: NormalEquations) -> bool:
    """Whether the step is small beside its sigmas, but for a translation that the rotations hardly
    reveal: noise moves it on and on.
    """
    variances, axes = np.linalg.eigh(normal.covariance[:3, :3])
    known = axes if variances[2] < _MOST_UNEVEN * variances[1] else axes[:, :2]
    steps = np.concatenate([known.T @ normal.step[:3], normal.step[3:]])
    of_axes = np.diag(known.T @ normal.covariance[:3, :3] @ known)
    sigmas = np.sqrt(np.maximum(np.r_[of_axes, np.diag(normal.covariance)[3:]], 0.0))
    return bool((np.abs(steps) < np.maximum(_SETTLED_SIGMAS * sigmas, _SETTLED_STEP)).all())


def _relinearised(state: _State) -> _State:
    """After a step, at poses freed of the errors that the posterior knows, tails weighed again."""
    posterior = state.posterior
    weights = student_weights(posterior) if state.heavy else state.weights
    state = dataclasses.replace(state, weights=weights, n_evaluations=state.n_evaluations + 1)
    return _freed(state.moved(posterior.normal.step), posterior.states_after(posterior.normal.step))


def _at_freed_poses(state: _State) -> _State:
    """With poses freed of the errors that are known at all poses, X as it is."""
    posterior = state.posterior
    return _freed(state, posterior.states_after(posterior.normal.step))


def _freed(state: _State, states: FloatArray) -> _State:
    """With poses freed of the errors that latent states (N, d) make."""
    model, T, spikes = state.model, state.T, state.outliers.spikes
    white_error = np.where(spikes[:, None], 0.0, states[:, :WHITE])
    error = states[:, :WHITE] + model.lasting(states, state.poses, T)
    white = model.sensor_white(state.levels, state.poses, T)
    given = bridged(state.streams, T, spikes)
    poses = corrected(given, white_error, error - white_error, T, white)
    return dataclasses.replace(state, poses=poses, error=error)


def _solution(state: _State, converged: bool) -> AdaptiveSolution:
    """The solution one step from where the search stands."""
    normal, streams = state.posterior.normal, state.streams
    n_columns = len(state.columns)
    n_evidence = int((~state.outliers.jumps).sum()) - int(state.outliers.spikes.sum())
    misfit = normal.cost / max(streams.n_rows * n_evidence - 6 - n_columns, 1)
    # Steps smaller than predicted do not make what was learned over long baselines more certain.
    covariance = max(misfit, 1.0) * normal.covariance
    covariance[:6, :6] += state.cov_beyond
    steps = np.diff(streams.Ts_pw_p[:, :3, 3], axis=0)
    posterior = state.posterior_with_delays() if state.with_delays else state.posterior
    all_parts = part_products(posterior)
    parts = selected(all_parts, list(range(6 + n_columns)))
    state = state.moved(normal.step)
    solution = AdaptiveSolution(
        T_parent_child=state.T,
        cov_parent_child_in_child=covariance[:6, :6],
        unseen=normal.unseen[:6],
        model=state.model,
        levels=state.levels,
        weights=state.weights,
        systematic=state.systematic,
        parameters=state.parameters,
        parameter_sigmas=_sigmas(state, covariance[6:, 6:], parts),
        jumps=state.outliers.jumps,
        spikes=state.outliers.spikes,
        heavy_tails=state.heavy,
        misfit=misfit,
        metres_per_pose=float(np.linalg.norm(steps, axis=1).sum()) / len(streams),
        part_products=parts,
        objective=0.5 * (posterior.log_determinant + normal.cost),
        converged=converged,
        iterations=state.n_evaluations,
    )
    if not state.with_delays:
        return solution
    return _with_more(solution, state.columns, all_parts)


def _with_more(
    solution: AdaptiveSolution, columns: list[int], parts: FloatArray
) -> AdaptiveSolution:
    """With errors that are not in the model, as they would be with each alone in it: from the
    products of all columns, by parts.
    """
    products = parts.sum(axis=0)
    known = list(range(6 + len(columns)))
    *with_clock, child, parent = range(len(products) - 1 - N_COLUMNS)
    world = list(range(parent + 1, parent + 1 + N_COLUMNS))
    misfit = solution.misfit
    of_child, of_parent = (
        part_delay(products, parts, with_clock, column, misfit) for column in (child, parent)
    )
    has_clock = TIME in columns
    clock = None if has_clock else part_delay(products, parts, known, with_clock[-1], misfit)
    drift = world_drift(products, known, world, misfit)
    return dataclasses.replace(
        solution, delays=(of_child, of_parent), clock=clock, world_drift=drift
    )


def _sigmas(state: _State, covariance: FloatArray, parts: FloatArray) -> FloatArray:
    """Standard deviations (11,) of all parameters: of those in the model by their covariance or, if
    that is larger beyond chance, the jackknife over ten blocks; of the scale and the time offset
    otherwise by the models that have them.
    """
    sigmas = state.other_sigmas.copy()
    variances = np.diag(covariance)
    if len(parts) >= N_BLOCKS:
        spread = answers_without(parts, N_BLOCKS)[:, 6:].var(axis=0) * (N_BLOCKS - 1)
        variances = np.maximum(variances, spread / _CHANCE)
    sigmas[state.columns] = np.sqrt(variances)
    return sigmas
