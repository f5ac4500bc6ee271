"""The lever arm of a sensor that measures only positions: a GNSS antenna, the prism of a total
station.

The sensor's orientation is that of the other one, as that is known from its own odometry, in the
world of the positions: a latent rotation of each pose that may be anything, but changes from pose
to pose as the odometry says, up to its drift. So this is the state space of the adaptive estimator
(:mod:`~hand_eye_calib.gls.state_space`) with a white rotation error without bounds; the
rotations are updated from what the positions say of them, until they stay. The sensor's frame has
the axes of the other one by convention: ``X = (I, l)``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls import reml
from hand_eye_calib.gls.increments import (
    N_SYSTEMATIC,
    SCALE,
    TIME,
    Course,
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
from hand_eye_calib.gls.outliers import LONGEST_GAP, Outliers, bridged, judged, surprises
from hand_eye_calib.gls.parts import part_products
from hand_eye_calib.gls.problem import sample
from hand_eye_calib.gls.solution import LeverArmSolution
from hand_eye_calib.gls.stages import rough_levels
from hand_eye_calib.gls.state_space import Posterior, StateSpace

# Log variance (rad^2) of orientations that may be anything, and bounds of their walk.
_ANY_ROTATION = float(np.log(100.0))
_LEAST_WALK, _MOST_WALK = np.log(1e-12), np.log(0.1)
_FIRST_WALK = np.log(1e-6)
_LEAST_WHITE_SHARE, _LEAST_WALK_SHARE = -14.0, -12.0

# Poses of the windows that are aligned by themselves: for the first lever arm, and for the first
# orientations. The first lever arm is drawn to zero by so much where the motion does not tell it.
_START_WINDOWS, _ALIGNED_WINDOW = (480, 60), 100
_START_STEPS, _SETTLED_START, _DRAWN = 50, 1e-6, 1e-6

# Rounds of updating the orientations; those after which noise levels are fitted, errors that last
# are looked for, and outliers; X moves by less than this share of its sigma in the last.
_ROUNDS = 10
_FITS, _LASTING, _OUTLIERS, _QUALITY = (1, 2, 4, 6), 2, (3, 5), (2, 4, 5)
_SETTLED = 0.1

# Standard deviation (m) of lever arms before anything is known.
_LONG_M = 10.0

# An axis that is not known to this (m) need not settle: noise moves it on and on.
_UNKNOWN_M = 0.2

# An error that lasts is part of the model if the loss is so much lower with it; it starts at this
# share of the rest, a logarithm.
_LEAST_GAIN, _FIRST_SHARE = 4.0, -1.0

# Noise levels need no more poses than this.
_MOST_POSES = 300

# A jump is a step of the walk with this many times the variance that it needs.
_JUMP_FACTOR = 10.0

# Parts of a recording that are compared by themselves, and fewest positions of one.
_PARTS = 10

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
    stamps_s = (stamps_ns - stamps_ns[0]) * 1e-9
    lever_arm, scale = _first_answer(Ts_pw_p, positions, with_scale)
    state = _State.first(stamps_s, Ts_pw_p, scale * positions, lever_arm, with_scale)
    for number in range(_ROUNDS):
        state = state.fitted() if number in _FITS else state
        state = state.with_lasting_error() if number == _LASTING else state
        posterior = state.posterior()
        if number in _OUTLIERS:
            state = state.with_outliers(posterior)
        if number in _QUALITY:
            state = state.with_quality(posterior)
        step = posterior.normal.step
        sigmas = np.sqrt(np.diag(posterior.normal.covariance)[:3])
        is_settled = (np.abs(step[:3]) < _SETTLED * sigmas) | (sigmas > _UNKNOWN_M)
        converged = number > max(_FITS) and bool(is_settled.all())
        if converged:
            break
        state = state.moved(posterior)
    return _solution(state, posterior, converged, scale)


def _first_answer(
    Ts_pw_p: FloatArray, positions: FloatArray, with_scale: bool
) -> tuple[FloatArray, float]:
    """The lever arm (3,) and the scale, if it is asked for, that fit windows best, each aligned by
    itself; bad ones count less.

    Short windows hardly know of the drift, but have local minima: long ones lead to the right one,
    and know the scale.
    """
    lever_arm, scale = np.zeros(3), 1.0
    of_all = Ts_pw_p[:, :3, :3], Ts_pw_p[:, :3, 3], positions
    for size in _START_WINDOWS:
        windows = [_windows(values, min(size, len(positions))) for values in of_all]
        lever_arm, scale = _fitting(windows, lever_arm, scale, with_scale)
        with_scale = False
    return lever_arm, scale


def _fitting(
    windows: list[FloatArray], lever_arm: FloatArray, scale: float, with_scale: bool
) -> tuple[FloatArray, float]:
    """Lever arm and scale that fit windows of orientations (n, k, 3, 3), path and positions (n, k,
    3) best, from first ones on.
    """
    axes, path, measured = windows
    information = np.einsum("nkij,nkil->njl", axes, axes) + _DRAWN * axes.shape[1] * np.eye(3)
    for _ in range(_START_STEPS):
        predicted = axes @ lever_arm + path
        aligned = measured @ _rotations(measured, predicted)
        if with_scale:
            shares = (aligned * predicted).sum(axis=(1, 2)) / (aligned**2).sum(axis=(1, 2))
            scale = float(np.median(shares))
        residuals = scale * aligned - path
        errors = np.sqrt(((residuals - axes @ lever_arm) ** 2).sum(axis=2).mean(axis=1))
        weights = 1.0 / (1.0 + (errors / (np.median(errors) + 1e-12)) ** 2)
        pulled = np.einsum("n,nkij,nki->j", weights, axes, residuals)
        before = lever_arm
        lever_arm = np.linalg.solve(np.einsum("n,njl->jl", weights, information), pulled)
        if np.abs(lever_arm - before).max() < _SETTLED_START:
            break
    return lever_arm, scale


def unexplained_share(
    Ts_pw_p: FloatArray, positions: FloatArray, solution: LeverArmSolution
) -> float:
    """Share of the path of positions (N, 3) that the poses (N, 4, 4) and the lever arm do not
    explain, in tenths of the recording, each aligned by itself; 1 if nothing moves.
    """
    predicted = Ts_pw_p[:, :3, :3] @ solution.lever_arm + Ts_pw_p[:, :3, 3]
    size = max(len(positions) // _PARTS, min(_PARTS, len(positions)))
    expected, measured = (_windows(path, size) for path in (predicted, solution.scale * positions))
    residuals = measured @ _rotations(measured, expected) - expected
    left, whole = ((path**2).sum(axis=(1, 2)) for path in (residuals, measured))
    return float(np.sqrt(np.median(left) / np.median(whole))) if np.median(whole) else 1.0


def _windows(values: FloatArray, size: int) -> FloatArray:
    """Values (N, ...) of windows of a size, (n, size, ...), each less its mean."""
    whole = len(values) // size * size
    windows = values[:whole].reshape(-1, size, *values.shape[1:])
    return windows - windows.mean(axis=1, keepdims=True)


def _rotations(measured: FloatArray, predicted: FloatArray) -> FloatArray:
    """Rotations (n, 3, 3) from predicted to measured positions (n, k, 3) of windows, centred."""
    return se3.nearest_rotation(np.einsum("nki,nkj->nij", measured, predicted))


def _aligned(Ts_pw_p: FloatArray, positions: FloatArray, lever_arm: FloatArray) -> FloatArray:
    """Poses (N, 4, 4) of the positions, with the other sensor's orientations turned into their
    world, window by window.
    """
    predicted = Ts_pw_p[:, :3, :3] @ lever_arm + Ts_pw_p[:, :3, 3]
    n_poses = len(positions)
    size = min(_ALIGNED_WINDOW, n_poses)
    rotations = np.empty((n_poses, 3, 3))
    for start in range(0, n_poses, size):
        first = max(min(start, n_poses - size), 0)  # the last window is as long as the others
        window = slice(first, first + size)
        turn = _rotations(_windows(positions[window], size), _windows(predicted[window], size))[0]
        rotations[start : start + size] = turn @ Ts_pw_p[start : start + size, :3, :3]
    return se3.from_rotation_translation(rotations, positions)


@dataclass(frozen=True, kw_only=True)
class _State:
    """Where the search stands.

    Attributes
    ----------
    positions : (N, 3) array
        As measured.
    streams : Streams
        The child's poses are its positions, bridged where they are left out, with the orientations
        known so far.
    columns : list of int
        Parameters of systematic errors in the model, of ``parameters`` (11,).
    boost : (n,) array
        Factors of the walk's variance: above 1 at jumps.
    """

    positions: FloatArray
    streams: Streams
    lever_arm: FloatArray
    columns: list[int]
    parameters: FloatArray
    model: NoiseModel
    levels: FloatArray
    outliers: Outliers
    boost: FloatArray
    worse: BoolArray

    @classmethod
    def first(
        cls,
        stamps_s: FloatArray,
        Ts_pw_p: FloatArray,
        positions: FloatArray,
        lever_arm: FloatArray,
        with_scale: bool,
    ) -> _State:
        """Where it begins."""
        streams = Streams(stamps_s, Ts_pw_p, _aligned(Ts_pw_p, positions, lever_arm))
        steps = np.linalg.norm(np.diff(Ts_pw_p[:, :3, 3], axis=0), axis=1)
        interval_s = float(np.median(np.diff(stamps_s)))
        extent = Extent(interval_s, max(float(np.median(steps)), 1e-9), float(stamps_s[-1]))
        n = len(steps)
        state = cls(
            positions=positions,
            streams=streams,
            lever_arm=lever_arm,
            columns=[SCALE, TIME] if with_scale else [TIME],
            parameters=np.zeros(N_SYSTEMATIC),
            model=NoiseModel((), "time", "sensors", extent),
            levels=np.zeros(0),
            outliers=Outliers(np.zeros(n, dtype=bool), np.zeros(n + 1, dtype=bool)),
            boost=np.ones(n),
            worse=np.zeros(n + 1, dtype=bool),
        )
        residuals = linearise(streams, state.course, state.X, state.parameters).residuals
        squares = (residuals[:, :3] ** 2).sum(axis=1)
        around = [squares[:1], 0.5 * (squares[1:] + squares[:-1]), squares[-1:]]
        worse = _worse(np.concatenate(around))
        white, walk = rough_levels(residuals, worse[1:] | worse[:-1])
        white[1], walk[1] = _ANY_ROTATION, _FIRST_WALK
        levels = state.model.first_levels(white, walk)[:N_FAST]
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

    def space(
        self, model: NoiseModel | None = None, columns: list[int] | None = None
    ) -> StateSpace:
        """State space of all poses."""
        model, X = model or self.model, self.X
        course = self.course
        columns = self.columns if columns is None else columns
        linearisation = linearise(self.streams, course, X, self.parameters, columns)
        # The drift is the odometry's, and grows with its path, not with that of the antenna.
        path = np.linalg.norm(np.diff(self.streams.Ts_pw_p[:, :3, 3], axis=0), axis=1)
        space = model.state_space(
            self.streams,
            replace(linearisation, metres=path),
            course.twists,
            X,
            np.where(self.left_out, 0.0, 1.0),
            np.zeros(len(self.boost), dtype=bool),
        )
        return _of_positions(space, X, self.boost)

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
        space = self.space()
        known = _known(self.lever_arm, space.columns.shape[2])
        return Posterior(replace(space, prior=known), self.levels)

    def fitted(self) -> _State:
        """With noise levels fitted, for a drift that grows with time or with the path, whichever is
        more likely.
        """
        models = (replace(self.model, walk_by=walk_by) for walk_by in ("time", "distance"))
        return self._likeliest([(model, self.levels) for model in models])[0]

    def _likeliest(self, starts: list[tuple[NoiseModel, FloatArray]]) -> tuple[_State, float]:
        """With the likeliest of some models, fitted from log levels on, and its loss."""
        fits = [
            (model, reml.fit(self.sampled_space(model), levels, _prior(model, levels)))
            for model, levels in starts
        ]
        model, fit = min(fits, key=lambda each: each[1].loss)
        return replace(self, model=model, levels=fit.levels), fit.loss

    def with_lasting_error(self) -> _State:
        """With an error of the positions that lasts, if the data ask for it."""
        levels, shortest_s = self.levels, 2 * self.model.extent.interval_s
        first = np.logaddexp(levels[TRANSLATION], levels[WALK_TRANSLATION]) + _FIRST_SHARE
        found, loss = self._likeliest(
            [
                (
                    self.model.richer((Slow(kind, "translation"),)),
                    np.r_[levels, first, np.log(max(tau_s, shortest_s))],
                )
                for kind in ("body", "world")
                for tau_s in self.model.taus_s()
            ]
        )
        before = Posterior(self.sampled_space(), levels).loss
        return found if before - loss >= _LEAST_GAIN else self

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
        spread = posterior.precision.selected_inverse[0][:, range(3), range(3)]
        drift = 3.0 * float(np.exp(self.levels[WALK_TRANSLATION]))
        worse = _worse(((self.positions - path) ** 2 + spread).sum(axis=1), drift)
        Ts_cw_c[:, :3, 3] = np.where(worse[:, None], path, self.positions)
        streams = replace(self.streams, Ts_cw_c=Ts_cw_c)
        return replace(self, streams=streams, worse=worse)

    def moved(self, posterior: Posterior) -> _State:
        """After a step, with the orientations that the positions ask for."""
        turns = posterior.states_after(posterior.normal.step)[:, 3:6]
        Ts_cw_c = self.streams.Ts_cw_c.copy()
        Ts_cw_c[:, :3, :3] = Ts_cw_c[:, :3, :3] @ se3.rotation_exp(turns)
        parameters = self.parameters.copy()
        parameters[self.columns] += posterior.normal.step[3:]
        return replace(
            self,
            streams=replace(self.streams, Ts_cw_c=Ts_cw_c),
            lever_arm=self.lever_arm + posterior.normal.step[:3],
            parameters=parameters,
        )


def _worse(squares: FloatArray, least: float = LOWEST_VARIANCE) -> BoolArray:
    """Which positions (N,) are clearly worse than the best quarter, by the squared errors (N,) of
    those around. Errors no larger than the least square, that of the odometry's drift from one
    position to the next, are never worse.
    """
    window = np.ones(min(_NEIGHBOURS, len(squares)))
    around = np.convolve(squares, window, mode="same")
    counts = np.convolve(np.ones(len(squares)), window, mode="same")
    usual = max(float(np.quantile(around / counts, _USUAL)), least)
    return np.asarray(around > _WORSE * usual * counts)


def _known(lever_arm: FloatArray, n_columns: int) -> FloatArray:
    """Products (p + 1, p + 1) that say that no lever arm is kilometres long."""
    added = np.zeros((n_columns, n_columns))
    added[:3, :3] = np.eye(3) / _LONG_M**2
    added[:3, -1] = added[-1, :3] = lever_arm / _LONG_M**2
    added[-1, -1] = lever_arm @ added[:3, -1]
    return added


def _of_positions(space: StateSpace, X: FloatArray, boost: FloatArray) -> StateSpace:
    """A state space without a rotation to estimate, with orientations that may be anything, and
    with a walk that is the odometry's.
    """
    to_child = se3.adjoint(se3.inverse(X))
    translation, rotation = np.diag([1.0, 1.0, 1.0, 0, 0, 0]), np.diag([0, 0, 0, 1.0, 1.0, 1.0])
    return replace(
        space,
        relative=space.relative * boost,
        columns=np.delete(space.columns, [3, 4, 5], axis=2),
        white=(translation[None], rotation[None]),
        walk=(translation, to_child @ rotation @ to_child.T),
    )


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
    normal = posterior.normal
    n_evidence = len(state.boost) - int(state.left_out.sum())
    misfit = normal.cost / max(3 * n_evidence - 3 - len(state.columns), 1)
    covariance = max(misfit, 1.0) * normal.covariance
    sigmas = np.zeros(N_SYSTEMATIC)
    sigmas[state.columns] = np.sqrt(np.diag(covariance)[3:])
    parts = part_products(posterior)
    return LeverArmSolution(
        lever_arm=state.lever_arm + normal.step[:3],
        covariance=covariance[:3, :3],
        **_by_common_errors(state),
        time_offset_s=-float(state.parameters[TIME]),
        time_offset_sigma_s=float(sigmas[TIME]),
        scale=first_scale * (1.0 + float(state.parameters[SCALE])),
        scale_sigma=first_scale * float(sigmas[SCALE]),
        model=state.model,
        levels=state.levels,
        worse=state.worse,
        jumps=state.outliers.jumps,
        spikes=state.outliers.spikes,
        part_products=parts + _known(state.lever_arm, parts.shape[1]) / len(parts),
        misfit=misfit,
        objective=0.5 * (posterior.precision.log_determinant + normal.cost),
        converged=converged,
    )


def _by_common_errors(state: _State) -> dict[str, FloatArray]:
    """Derivatives of the lever arm by errors of the odometry that are the same all the time."""
    motions, steps = state.streams.motions_p, state.streams.steps[0]
    metres = np.linalg.norm(steps.cleaned(np.inf), axis=1)
    sideways = np.zeros((len(metres), 6, 3))
    sideways[:, :3] = -np.swapaxes(motions[:, :3, :3], 1, 2) * metres[:, None, None]
    space = state.space(columns=[SCALE])
    columns = np.insert(space.columns, [4], sideways, axis=2)
    products = Posterior(replace(space, columns=columns), state.levels).products
    by: FloatArray = -np.linalg.pinv(products[:3, :3], hermitian=True) @ products[:3, 3:-1]
    return {"by_scale": by[:, 0], "by_direction": by[:, 1:]}
