"""The lever arm of a sensor that measures only positions: a GNSS antenna, the prism of a total
station.

The sensor's orientation is that of the other one, as that is known from its own odometry, in the
world of the positions: a latent rotation of each pose that may be anything, but changes from pose
to pose as the odometry says, up to its drift. So this is the state space of the adaptive estimator
(:mod:`~hand_eye_calib.gls.state_space`) with a white rotation error without bounds; the
rotations are updated from what the positions say of them, until they stay. The sensor's frame has
the axes of the other one by convention: ``X = (I, l)``.

Errors that act like a lever arm are parameters beside it, known beforehand to what sensors have: a
scale and a direction of the odometry's path, a time offset and its rate. What the positions answer
to acceleration is in the covariance alone: on recorded drones even its sign depends on the
frequency. A drone tilts to accelerate, so that positions which answer by kappa (s^2), as smoothed
ones do, move the vertical lever arm by kappa g.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls import reml
from hand_eye_calib.gls.increments import (
    BIAS,
    N_SYSTEMATIC,
    SCALE,
    TIME,
    Course,
    Linearisation,
    Streams,
    course_of,
    linearise,
    summed,
    turned,
)
from hand_eye_calib.gls.noise_model import (
    LOWEST_VARIANCE,
    N_FAST,
    ROTATION,
    TRANSLATION,
    WALK_ROTATION,
    WALK_TRANSLATION,
    Extent,
    NoiseModel,
    Slow,
)
from hand_eye_calib.gls.normal import NormalEquations, selected
from hand_eye_calib.gls.outliers import LONGEST_GAP, Outliers, bridged, judged, surprises
from hand_eye_calib.gls.problem import known_products, sample
from hand_eye_calib.gls.solution import LeverArmSolution
from hand_eye_calib.gls.stages import rough_levels
from hand_eye_calib.gls.state_space import Posterior, StateSpace
from hand_eye_calib.gls.windows import aligned, first_lever_arm

# Parameters that poses do not have: a rate of the clock, and what the positions less the odometry
# are per m/s^2 of acceleration (s^2). Those in the model.
CLOCK, RESPONSE = N_SYSTEMATIC, N_SYSTEMATIC + 1
_SHARED = [SCALE, 1, 2, 3, TIME]
_COLUMNS = [*_SHARED, CLOCK, RESPONSE]
# Columns of the lever arm and of the parameters that it is solved with: all but the last.
_SOLVED = list(range(2 + len(_COLUMNS)))

# Log variance (rad^2) of orientations that may be anything, and bounds of their walk.
_ANY_ROTATION = float(np.log(100.0))
_LEAST_WALK, _MOST_WALK, _FIRST_WALK = np.log(1e-12), np.log(0.1), np.log(1e-6)
_LEAST_WHITE_SHARE, _LEAST_WALK_SHARE = -14.0, -12.0

# Rounds of updating the orientations; those after which noise levels are fitted, errors that last
# are looked for, and outliers; X moves by less than this share of its sigma in the last.
_ROUNDS, _FITS, _LASTING, _OUTLIERS, _QUALITY = 10, (1, 2, 4, 6), 2, (3, 5), (2, 4, 5)
_SETTLED = 0.1

# Standard deviations beforehand: of the lever arm (m), of the time offset (s) and its rate, of the
# scale of the odometry, known or not, of its direction (rad), and of what the positions answer to
# acceleration (s^2). Accelerations are those over this time (s).
_LONG_M, _TIME_SIGMA_S, _CLOCK_SIGMA = 10.0, 1.0, 1e-4
_SCALE_SIGMA, _ANY_SCALE = 0.01, 1.0
_DIRECTION_SIGMA, _RESPONSE_SIGMA = float(np.radians(0.15)), 0.002
_ACCELERATING_S, _NEAR = 0.2, 2.5

# An axis that is not known to this (m) need not settle: noise moves it on and on.
_UNKNOWN_M = 0.2

# An error that lasts is part of the model if the loss is so much lower with it.
_LEAST_GAIN = 4.0

# Noise levels need no more poses than this. A jump is a step of the walk with this many times the
# variance that it needs.
_MOST_POSES, _JUMP_FACTOR = 300, 10.0

# The quality of a solution is that of so many positions around; those whose squared errors exceed
# that of the best quarter of the recording by this factor are left out: they would hardly count,
# and their errors last.
_NEIGHBOURS, _USUAL, _WORSE = 11, 0.25, 16.0


def solve(
    stamps_ns: IntArray, Ts_pw_p: FloatArray, positions: FloatArray, with_scale: bool = False
) -> LeverArmSolution:
    """Estimate the lever arm of a sensor that measures positions.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    Ts_pw_p : (N, 4, 4) array
        Poses of the other sensor in its world.
    positions : (N, 3) array
        At the same stamps, in a world of their own.
    with_scale : bool
        Whether to estimate the scale between both worlds.
    """
    lever_arm, scale = first_lever_arm(Ts_pw_p, positions, with_scale)
    stamps_s = (stamps_ns - stamps_ns[0]) * 1e-9
    Ts = aligned(Ts_pw_p, scale * positions, lever_arm)
    state = _State.first(Streams(stamps_s, Ts_pw_p, Ts), lever_arm, with_scale)
    for number in range(_ROUNDS):
        state = state.fitted() if number in _FITS else state
        state = state.with_lasting_error() if number == _LASTING else state
        posterior = state.posterior()
        if number in _OUTLIERS:
            state = state.with_outliers(posterior)
        if number in _QUALITY:
            state = state.with_quality(posterior)
        normal = NormalEquations(selected(posterior.products, _SOLVED))
        step, sigmas = normal.step, np.sqrt(np.diag(normal.covariance)[:3])
        is_settled = (np.abs(step[:3]) < _SETTLED * sigmas) | (sigmas > _UNKNOWN_M)
        converged = number > max(_FITS) and bool(is_settled.all())
        if converged:
            break
        state = state.moved(posterior, step)
    return _solution(state, posterior, converged, scale)


@dataclass(frozen=True, kw_only=True)
class _State:
    """Where the search stands. The child's poses are its ``positions`` (N, 3), bridged where they
    are left out, with the orientations known so far. ``parameters`` are (10,), of which the scale
    is known to ``scale_sigma`` beforehand. ``boost`` (n,) are factors of the walk's variance, above
    1 at jumps; those around positions that are ``worse`` (N,) are far less precise than the best.
    """

    positions: FloatArray
    streams: Streams
    lever_arm: FloatArray
    scale_sigma: float
    parameters: FloatArray
    model: NoiseModel
    levels: FloatArray
    outliers: Outliers
    boost: FloatArray
    worse: BoolArray

    @classmethod
    def first(cls, streams: Streams, lever_arm: FloatArray, with_scale: bool) -> _State:
        """Where it begins."""
        stamps_s, n = streams.stamps_s, len(streams) - 1
        extent = Extent(float(np.median(np.diff(stamps_s))), float(stamps_s[-1]))
        state = cls(
            positions=streams.Ts_cw_c[:, :3, 3],
            streams=streams,
            lever_arm=lever_arm,
            scale_sigma=_ANY_SCALE if with_scale else _SCALE_SIGMA,
            parameters=np.zeros(RESPONSE + 1),
            model=NoiseModel((), "sensors", extent),
            levels=np.zeros(0),
            outliers=Outliers(np.zeros(n, dtype=bool), np.zeros(n + 1, dtype=bool)),
            boost=np.ones(n),
            worse=np.zeros(n + 1, dtype=bool),
        )
        residuals = state.linearised().residuals
        squares = (residuals[:, :3] ** 2).sum(axis=1)
        around = [squares[:1], 0.5 * (squares[1:] + squares[:-1]), squares[-1:]]
        worse = _worse(np.concatenate(around))
        levels = rough_levels(residuals, worse[1:] | worse[:-1])
        levels[ROTATION], levels[WALK_ROTATION] = _ANY_ROTATION, _FIRST_WALK
        streams = bridged(streams, state.X, worse)
        return replace(state, streams=streams, levels=levels, worse=worse)

    @property
    def X(self) -> FloatArray:
        """The lever arm as a transform (4, 4)."""
        return se3.from_rotation_translation(np.eye(3), self.lever_arm)

    @property
    def left_out(self) -> BoolArray:
        """(N,) which positions are no evidence."""
        return self.outliers.spikes | self.worse

    @property
    def course(self) -> Course:
        """Of the sensor with poses, at the lever arm: free of the noise of the positions, but in
        their world.
        """
        streams = self.streams
        course = course_of(replace(streams, Ts_cw_c=streams.Ts_pw_p @ self.X), self.X)
        back_p = np.swapaxes(streams.Ts_pw_p[:-1, :3, :3], 1, 2)
        worlds = streams.Ts_cw_c[:-1, :3, :3] @ back_p
        return replace(
            course,
            path=summed(turned(worlds, np.diff(course.path, axis=0))),
            along=summed(worlds @ np.diff(course.along, axis=0)),
        )

    def linearised(self) -> Linearisation:
        """Increments between poses, with the columns of the lever arm and of the parameters."""
        streams, course = self.streams, self.course
        away_s = streams.stamps_s - 0.5 * self.model.extent.duration_s
        drifting = away_s[:, None] * course.twists
        answering = _accelerations(streams, self.X)
        moved = streams.Ts_cw_c @ se3.exp(self.parameters[CLOCK] * drifting)
        poses = replace(streams, Ts_cw_c=moved)
        found = linearise(poses, course, self.X, self.parameters[:CLOCK], _SHARED)
        more = [_by_motion(found, each) for each in (drifting, answering)]
        found = found.with_columns(np.concatenate(more, axis=2))
        return replace(found, columns=np.delete(found.columns, [3, 4, 5], axis=2))

    def _known(self) -> FloatArray:
        """Products (p + 1, p + 1) that say how large lever arm and parameters may be."""
        sigmas = np.empty(RESPONSE + 1)
        sigmas[SCALE], sigmas[BIAS], sigmas[TIME] = (
            self.scale_sigma,
            _DIRECTION_SIGMA,
            _TIME_SIGMA_S,
        )
        sigmas[CLOCK], sigmas[RESPONSE] = _CLOCK_SIGMA, _RESPONSE_SIGMA
        values = np.r_[self.lever_arm, self.parameters[_COLUMNS]]
        weights = np.r_[np.full(3, _LONG_M), sigmas[_COLUMNS]] ** -2.0
        return known_products(range(len(values)), values, weights, len(values) + 1)

    def space(self, model: NoiseModel | None = None) -> StateSpace:
        """State space of all poses: without a rotation to estimate, with orientations that may be
        anything, and with a walk that is the odometry's.
        """
        space = (model or self.model).state_space(
            self.streams,
            self.linearised(),
            self.course.twists,
            self.X,
            np.where(self.left_out, 0.0, 1.0),
            np.zeros(len(self.boost), dtype=bool),
            self._known(),
        )
        to_child = se3.adjoint(se3.inverse(self.X))
        translation, rotation = np.diag([1.0, 1.0, 1.0, 0, 0, 0]), np.diag([0, 0, 0, 1.0, 1.0, 1.0])
        return replace(
            space,
            relative=space.relative * self.boost,
            white=(translation[None], rotation[None]),
            walk=(translation, to_child @ rotation @ to_child.T),
        )

    def sampled_space(self, model: NoiseModel | None = None) -> StateSpace:
        """State space of as many poses as noise levels need."""
        kept = sample(len(self.streams), _MOST_POSES)
        if kept is None:
            return self.space(model)
        jumps = self.outliers.across(kept, LONGEST_GAP).jumps
        return replace(
            self,
            streams=self.streams[kept],
            outliers=Outliers(jumps, self.outliers.spikes[kept]),
            boost=np.where(jumps, self.boost.max(), 1.0),
            worse=self.worse[kept],
        ).space(model)

    def posterior(self) -> Posterior:
        """Of all poses."""
        return Posterior(self.space(), self.levels)

    def fitted(self) -> _State:
        """With noise levels fitted."""
        space, prior = self.sampled_space(), _prior(self.model, self.levels)
        return replace(self, levels=reml.fit(space, self.levels, prior)[0].levels)

    def with_lasting_error(self) -> _State:
        """With an error of the positions that lasts, fixed to the body or to the world, if the data
        ask for it.
        """
        fits = []
        for kind in ("body", "world"):
            model, levels = self.model.with_lasting([Slow(kind, "translation")], self.levels)
            found, _ = reml.fit(self.sampled_space(model), levels, _prior(model, levels))
            fits.append((model, found))
        model, fit = min(fits, key=lambda each: each[1].loss)
        before = Posterior(self.sampled_space(), self.levels).loss
        if before - fit.loss < _LEAST_GAIN:
            return self
        return replace(self, model=model, levels=fit.levels)

    def with_outliers(self, posterior: Posterior) -> _State:
        """With jumps, which are large steps of the walk, and positions wrong by themselves."""
        of_walk, of_white = surprises(posterior, self.left_out)
        found = judged(self.outliers, of_walk, of_white, with_spikes=True)
        boost = np.where(found.jumps, np.maximum(_JUMP_FACTOR * of_walk, self.boost), 1.0)
        return replace(self, outliers=found, boost=boost)

    def with_quality(self, posterior: Posterior) -> _State:
        """With positions left out if those around are clearly worse than the rest."""
        states = posterior.states_after(posterior.normal.step)[:, :3]
        Ts_cw_c = self.streams.Ts_cw_c.copy()
        path = Ts_cw_c[:, :3, 3] + turned(Ts_cw_c[:, :3, :3], states)
        spread = posterior.selected_inverse[0][:, range(3), range(3)]
        drift = 3.0 * float(np.exp(self.levels[WALK_TRANSLATION]))
        worse = _worse(((self.positions - path) ** 2 + spread).sum(axis=1), drift)
        Ts_cw_c[:, :3, 3] = np.where(worse[:, None], path, self.positions)
        return replace(self, streams=replace(self.streams, Ts_cw_c=Ts_cw_c), worse=worse)

    def moved(self, posterior: Posterior, step: FloatArray) -> _State:
        """After a step, with the orientations that the positions ask for."""
        turns = posterior.states_after(np.r_[step, 0.0])[:, 3:6]
        Ts_cw_c = self.streams.Ts_cw_c.copy()
        Ts_cw_c[:, :3, :3] = Ts_cw_c[:, :3, :3] @ se3.rotation_exp(turns)
        parameters = self.parameters.copy()
        parameters[_COLUMNS[:-1]] += step[3:]
        return replace(
            self,
            streams=replace(self.streams, Ts_cw_c=Ts_cw_c),
            lever_arm=self.lever_arm + step[:3],
            parameters=parameters,
        )


def _worse(squares: FloatArray, least: float = LOWEST_VARIANCE) -> BoolArray:
    """Which positions (N,) are clearly worse than the best quarter, by the squared errors (N,) of
    those around, and than the least square: the odometry's drift from one position to the next.
    """
    window = np.ones(min(_NEIGHBOURS, len(squares)))
    around = np.convolve(squares, window, mode="same")
    counts = np.convolve(np.ones(len(squares)), window, mode="same")
    usual = max(float(np.quantile(around / counts, _USUAL)), least)
    return np.asarray(around > _WORSE * usual * counts)


def _by_motion(linearisation: Linearisation, moving: FloatArray) -> FloatArray:
    """Column (n, 6, 1) of an error that moves poses by ``exp(-moving)``, (N, 6)."""
    return (turned(linearisation.adjoints, moving[:-1]) - moving[1:])[:, :, None]


def _prior(model: NoiseModel, levels: FloatArray) -> reml.Prior:
    """What is known of log levels beforehand, for a search from these."""
    prior = model.prior(levels)
    lower, upper = prior.lower.copy(), prior.upper.copy()
    total = np.logaddexp(levels[WALK_TRANSLATION], levels[TRANSLATION] + np.log(2.0))
    least = np.log(LOWEST_VARIANCE)
    lower[TRANSLATION] = max(least, total + _LEAST_WHITE_SHARE)
    lower[WALK_TRANSLATION] = max(least, total + _LEAST_WALK_SHARE)
    lower[ROTATION] = upper[ROTATION] = _ANY_ROTATION
    lower[WALK_ROTATION], upper[WALK_ROTATION] = _LEAST_WALK, _MOST_WALK
    return replace(prior, lower=lower, upper=upper)


def _solution(
    state: _State, posterior: Posterior, converged: bool, first_scale: float
) -> LeverArmSolution:
    normal = NormalEquations(selected(posterior.products, _SOLVED))
    n_evidence = len(state.boost) - int(state.left_out.sum())
    misfit = normal.cost / max(3 * n_evidence - len(_SOLVED), 1)
    # With the answer to acceleration, and by what it would move the lever arm.
    whole = posterior.normal
    covariance, shift = max(misfit, 1.0) * whole.covariance, (whole.step[:-1] - normal.step)[:3]
    sigmas = np.zeros(RESPONSE + 1)
    sigmas[_COLUMNS] = np.sqrt(np.diag(covariance)[3:])
    # Errors that last for a share of the recording do so for all of it, too: X takes their mean.
    lasting = float(np.exp(state.levels[N_FAST])) if state.model.slow else 0.0
    parameters = state.parameters.copy()
    parameters[_COLUMNS] += np.r_[normal.step[3:], whole.step[-1]]
    return LeverArmSolution(
        lever_arm=state.lever_arm + normal.step[:3],
        covariance=covariance[:3, :3] + np.outer(shift, shift) + lasting * np.eye(3),
        response=(float(-parameters[RESPONSE]), float(sigmas[RESPONSE])),
        parameters=parameters,
        parameter_sigmas=sigmas,
        unit=first_scale,
        clock_rate=-float(parameters[CLOCK]),
        clock_rate_sigma=float(sigmas[CLOCK]),
        model=state.model,
        levels=state.levels,
        worse=state.worse,
        jumps=state.outliers.jumps,
        spikes=state.outliers.spikes,
        part_products=selected(posterior.part_products(), _SOLVED),
        misfit=misfit,
        objective=0.5 * (posterior.log_determinant + normal.cost),
        converged=converged,
    )


def _accelerations(streams: Streams, X: FloatArray) -> FloatArray:
    """Accelerations (N, 6) of the antenna by the odometry, m/s^2, in the body's axes, from steps on
    either side of each pose, whose own noise is not in them; zero beside gaps and at the ends.
    """
    path, stamps_s = (streams.Ts_pw_p @ X)[:, :3, 3], streams.stamps_s
    found = np.zeros((len(path), 6))
    interval_s = float(np.median(np.diff(stamps_s)))
    span = max(round(_ACCELERATING_S / interval_s), 1)
    at = np.arange(2 * span, len(path) - 2 * span)
    times_s, places = (
        np.stack([each[at + step * span] for step in (-2, -1, 1, 2)]) for each in (stamps_s, path)
    )
    before, after = (
        (places[k + 1] - places[k]) / (times_s[k + 1] - times_s[k])[:, None] for k in (0, 2)
    )
    apart_s = 0.5 * (times_s[3] + times_s[2] - times_s[1] - times_s[0])
    is_near = apart_s < _NEAR * 3 * span * interval_s
    back = np.swapaxes(streams.Ts_pw_p[at, :3, :3], 1, 2)
    of_body = turned(back, (after - before) / apart_s[:, None])
    found[at, :3] = np.where(is_near[:, None], of_body, 0.0)
    return found
