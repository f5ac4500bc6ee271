"""One solve for the extrinsics of all sensors of a rig, under the noise of every sensor."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.adaptive.estimator import sample
from hand_eye_calib.adaptive.increments import motions
from hand_eye_calib.adaptive.outliers import Outliers, first_outliers, judged
from hand_eye_calib.adaptive.resampling import answers_without
from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.assessment.covariance import beyond_chance
from hand_eye_calib.errors import NotEnoughDataError
from hand_eye_calib.geometry import se3
from hand_eye_calib.rig import noise
from hand_eye_calib.rig.increments import NOTHING, Aligned, Increments, linearised
from hand_eye_calib.rig.likelihood import (
    N_LEVELS,
    UNKNOWN,
    Likelihood,
    Model,
    walk_between,
    walk_of,
    white_of,
)
from hand_eye_calib.rig.table import Table

# Noise levels need no more poses than this.
_MOST_POSES = 600

# A walk's variance over an increment, in units of a typical one.
_LEAST_RELATIVE, _MOST_RELATIVE = 0.1, 100.0

# Steps that vary by less than this share are alike: a walk by distance is not tried.
_EVEN = 0.2

# Rounds of looking for outliers, and of following X: until it moves by less than this share of its
# sigma.
_OUTLIER_ROUNDS, _MAX_ROUNDS, _SETTLED_SIGMAS = 3, 5, 0.1

# A pose is no evidence if more than this share of all would be wrong: then they are noisy.
_MOST_SPIKES = 0.2

# Blocks of the jackknife, and the fewest poses to solve with.
_BLOCKS, MIN_POSES = 10, 30


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations per axis of the errors of one sensor's trajectory.

    Attributes
    ----------
    rotation_white, translation_white : float
        Independent error of each pose, rad and m.
    rotation_drift, translation_drift : float
        What an error that stays grows by in a typical interval between poses, rad and m.
    n_jumps, n_spikes : int
        Increments across which the trajectory jumped for good, poses that are wrong by themselves.
    """

    rotation_white: float
    translation_white: float
    rotation_drift: float
    translation_drift: float
    n_jumps: int
    n_spikes: int


@dataclass(frozen=True)
class RigSolution:
    """Extrinsics of all sensors, their covariance and the noise that was found.

    Attributes
    ----------
    Xs : (S, 4, 4) array
        Poses of the sensors in the frame of the first one.
    covariance : (p, p) array
        Of xi_1 to xi_K, in ``Exp(xi_k) X_k``, then time offsets and scales.
    unseen : (p, U) array
        Directions that nothing is known about.
    parameters : (p - 6 K,) array
        What time offsets (s) and scales change by.
    answers_without : (B, p) array
        Steps without each block of the recording; none if it is too short.
    noise : tuple of SensorNoise
    walk_by : {"time", "distance"}
    misfit : float
        Weighted squared residual over its degrees of freedom.
    objective : float
        Negative log likelihood.
    converged : bool
    """

    Xs: FloatArray
    covariance: FloatArray
    unseen: FloatArray
    parameters: FloatArray
    answers_without: FloatArray
    noise: tuple[SensorNoise, ...]
    walk_by: str
    misfit: float
    objective: float
    converged: bool

    def T(self, first: int, second: int) -> FloatArray:
        """Pose (4, 4) of one sensor in the frame of another."""
        return se3.inverse(self.Xs[first]) @ self.Xs[second]

    def covariance_of(self, first: int, second: int) -> FloatArray:
        """Covariance (6, 6) of xi in ``T(first, second) @ Exp(xi)``.

        The model's, or that of the jackknife where that is larger beyond chance.
        """
        to_second = self._to(first, second)
        covariance = to_second @ self.covariance @ to_second.T
        if len(self.answers_without) < _BLOCKS:
            return covariance
        steps = self.answers_without @ to_second.T
        centred = steps - steps.mean(axis=0)
        spread = (_BLOCKS - 1) / _BLOCKS * centred.T @ centred
        return beyond_chance(covariance, spread)

    def unseen_of(self, first: int, second: int) -> FloatArray:
        """Directions (6, U) of the same xi that nothing is known about."""
        moved = self._to(first, second) @ self.unseen
        left, sizes, _ = np.linalg.svd(moved, full_matrices=False)
        return left[:, sizes > 1e-6]

    def _to(self, first: int, second: int) -> FloatArray:
        """Derivative (6, p) of the error of one sensor in the frame of another."""
        selection = np.zeros((6, len(self.covariance)))
        for sensor, sign in ((second, 1.0), (first, -1.0)):
            if sensor > 0:
                selection[:, 6 * sensor - 6 : 6 * sensor] += sign * np.eye(6)
        return se3.adjoint(se3.inverse(self.Xs[second])) @ selection


@dataclass(frozen=True)
class _State:
    """Where the search stands; ``motion`` is that of the first sensor freed of its errors."""

    table: Table
    aligned: Aligned
    Xs: FloatArray
    parameters: FloatArray
    motion: FloatArray
    levels: FloatArray
    outliers: tuple[Outliers, ...]
    walk_by: str = "time"

    def increments(self) -> Increments:
        """At X and the motion as they are, what the parameters change put into the residuals."""
        found = linearised(self.table, self.Xs, self.motion, self.aligned)
        n = len(self.parameters)
        if n:
            found.columns[:, :, -1] += found.columns[:, :, -1 - n : -1] @ self.parameters
        return found

    def model(self) -> Model:
        """Of all poses."""
        increments, white = self.increments(), white_of(self.Xs)
        walk = walk_of(white, self._relative(self.walk_by))
        return _model(increments, white, walk, self.outliers)

    def sampled_model(self, walk_by: str) -> Model:
        """Of so many poses as noise levels need."""
        kept = sample(len(self.table), _MOST_POSES)
        if kept is None:
            return dataclasses.replace(self, walk_by=walk_by).model()
        sampled = dataclasses.replace(
            self, table=self.table.at(kept), motion=_across(self.motion, kept)
        )
        white = white_of(self.Xs)
        walk = walk_between(white, self._relative(walk_by), self.table.poses[0], kept)
        outliers = tuple(each.across(kept) for each in self.outliers)
        return _model(sampled.increments(), white, walk, outliers)

    def _relative(self, walk_by: str) -> FloatArray:
        """Variance (n,) of a walk over each increment, in units of a typical one."""
        steps = np.diff(self.table.stamps_ns) * 1e-9
        if walk_by == "distance":
            steps = np.linalg.norm(self.motion[:, :3, 3], axis=1)
        typical = max(float(np.median(steps)), 1e-9)
        return np.clip(steps / typical, _LEAST_RELATIVE, _MOST_RELATIVE)

    def moved(self, step: FloatArray) -> _State:
        """After a step of xi_1 to xi_K and of the parameters."""
        K = len(self.Xs) - 1
        Xs = self.Xs.copy()
        Xs[1:] = se3.exp(step[: 6 * K].reshape(K, 6)) @ Xs[1:]
        return dataclasses.replace(self, Xs=Xs, parameters=self.parameters + step[6 * K :])


def _model(
    increments: Increments, white: FloatArray, walk: FloatArray, outliers: tuple[Outliers, ...]
) -> Model:
    jumps = np.array([each.jumps for each in outliers])
    return Model(increments, white, walk, jumps, np.array([each.spikes for each in outliers]))


def solve(table: Table, Xs: FloatArray, aligned: Aligned = NOTHING) -> RigSolution:
    """Estimate the poses of all sensors, their noise and the covariance of it all.

    Parameters
    ----------
    table : Table
        Of S sensors, S at least 2.
    Xs : (S, 4, 4) array
        First answers: poses of the sensors in the frame of the first one.
    aligned : Aligned
        Time offsets and scales that the table has from estimates, and whose errors count.

    Raises
    ------
    NotEnoughDataError
        If there are fewer than 30 poses.
    """
    if len(table) < MIN_POSES:
        raise NotEnoughDataError(
            f"only {len(table)} instants at which all {table.n_sensors} sensors have a pose; "
            f"{MIN_POSES} are needed: record longer, or check that the recordings overlap"
        )
    state = _fitted(_start(table, Xs, aligned), ("time", "distance"))
    for _ in range(_OUTLIER_ROUNDS):
        found = _outliers_found(state)
        if all(a.same_as(b) for a, b in zip(found.outliers, state.outliers, strict=True)):
            break
        state = _fitted(found, (state.walk_by,))
    return _polished(state)


def _start(table: Table, Xs: FloatArray, aligned: Aligned) -> _State:
    """First levels, and outliers of single sensors from those of all pairs with the first one."""
    increments = linearised(table, Xs)
    residuals = increments.columns[:, :, -1]
    outliers = _of_sensors(residuals)
    jumps = np.array([each.jumps | each.spikes[1:] | each.spikes[:-1] for each in outliers])
    return _State(
        table=table,
        aligned=aligned,
        Xs=Xs,
        parameters=np.zeros(aligned.n_parameters),
        motion=motions(table.poses[0]),
        levels=noise.first_levels(residuals, jumps),
        outliers=outliers,
    )


def _of_sensors(residuals: FloatArray) -> tuple[Outliers, ...]:
    """What stands out of residuals (n, 6 K): with the first sensor if it does in more than half of
    the pairs, otherwise with the other one.
    """
    n, K = len(residuals), residuals.shape[1] // 6
    found = [first_outliers(residuals[:, 6 * k : 6 * k + 6]) for k in range(K)]
    jumps, spikes = (
        np.array([getattr(each, name) for each in found]) for name in ("jumps", "spikes")
    )
    if K == 1:
        none = Outliers(np.zeros(n, dtype=bool), np.zeros(n + 1, dtype=bool))
        return none, found[0]
    of_first = Outliers(2 * jumps.sum(axis=0) > K, 2 * spikes.sum(axis=0) > K)
    others = [
        Outliers(jumped & ~of_first.jumps, spiked & ~of_first.spikes)
        for jumped, spiked in zip(jumps, spikes, strict=True)
    ]
    return of_first, *others


def _across(motion: FloatArray, kept: np.ndarray) -> FloatArray:
    """Motions between some poses from those (n, 4, 4) between all."""
    poses = np.empty((len(motion) + 1, 4, 4))
    poses[0] = np.eye(4)
    for index, step in enumerate(motion):
        poses[index + 1] = poses[index] @ step
    return motions(poses[kept])


def _fitted(state: _State, walks: tuple[str, ...]) -> _State:
    """Noise levels, and one step of X."""
    metres = np.linalg.norm(state.motion[:, :3, 3], axis=1)
    if np.std(metres) <= _EVEN * np.mean(metres):
        walks = (state.walk_by,)
    fits = [
        (walk_by, noise.fitted(state.sampled_model(walk_by), state.levels)) for walk_by in walks
    ]
    walk_by, fit = min(fits, key=lambda each: each[1].loss)
    fitted = dataclasses.replace(state, levels=fit.levels, walk_by=walk_by)
    return _freed(fitted, Likelihood(fitted.model(), fitted.levels))


def _freed(state: _State, likelihood: Likelihood) -> _State:
    """After a step of X, the motion of the first sensor freed of its expected errors."""
    errors = likelihood.motion_errors()
    motion = motions(state.table.poses[0]) @ se3.exp(-errors)
    return dataclasses.replace(state, motion=motion).moved(likelihood.normal.step)


def _outliers_found(state: _State) -> _State:
    """Jumps and spikes of every sensor, by what everything else makes of its errors."""
    likelihood = Likelihood(state.model(), state.levels)
    model = likelihood.model
    of_walk, of_white = [], []
    for sensor in range(model.n_sensors):
        own, _ = likelihood.precision(sensor)
        force, jumps, spikes = likelihood.force(sensor), model.jumps[sensor], model.spikes[sensor]
        of_walk.append(_surprises(force, own, jumps))
        at_poses = likelihood.precision_at_poses(sensor)
        of_white.append(_surprises(model.at_poses(force), at_poses, spikes))
    walks = _of_one_sensor(np.array(of_walk), model.jumps)
    whites = _of_one_sensor(np.array(of_white), model.spikes)
    found = [
        judged(outliers, walk, white, with_spikes=True)
        for outliers, walk, white in zip(state.outliers, walks, whites, strict=True)
    ]
    outliers = [
        each if np.mean(each.spikes) <= _MOST_SPIKES else Outliers(each.jumps, each.spikes & False)
        for each in found
    ]
    return dataclasses.replace(state, outliers=tuple(outliers))


def _surprises(forces: FloatArray, covariances: FloatArray, left_out: BoolArray) -> FloatArray:
    """Chi-squares (n,) of what errors are against what everything else makes of them.

    With forces u and their covariances P that is ``u' P^-1 u`` (de Jong, Penzer, J. Amer. Statist.
    Assoc. 93, 1998). The expected error ``P^-1 u`` does not depend on its own variance, so that
    what stands for "unknown" can be taken out of P^-1.
    """
    sizes = np.einsum("nii->n", covariances)[:, None, None] / 6.0
    spread = np.linalg.inv(covariances + 1e-9 * sizes * np.eye(6))
    expected = spread @ forces[:, :, None]
    spread[left_out] -= UNKNOWN * np.eye(6)
    return (expected * np.linalg.solve(spread, expected))[:, :, 0].sum(axis=1)


def _of_one_sensor(surprises: FloatArray, known: BoolArray) -> FloatArray:
    """Surprises (S, n), zero where another sensor's is larger there or beside: one event is of one
    sensor. Those that are known stay.
    """
    padded = np.pad(surprises.max(axis=0), 1)
    largest = np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:])
    return np.where((surprises >= largest) | known, surprises, 0.0)


def _polished(state: _State) -> RigSolution:
    """X followed until it stays."""
    for _ in range(_MAX_ROUNDS):
        likelihood = Likelihood(state.model(), state.levels)
        normal = likelihood.normal
        sigmas = np.sqrt(np.maximum(np.diag(normal.covariance), 0.0))
        converged = bool((np.abs(normal.step) <= _SETTLED_SIGMAS * sigmas + 1e-9).all())
        if converged:
            break
        state = _freed(state, likelihood)
    return _solution(state.moved(normal.step), likelihood, converged)


def _solution(state: _State, likelihood: Likelihood, converged: bool) -> RigSolution:
    normal, levels = likelihood.normal, state.levels
    lost = sum(int(each.jumps.sum() + each.spikes.sum()) for each in state.outliers)
    n_residuals = likelihood.model.increments.columns[:, :, -1].size
    misfit = normal.cost / max(n_residuals - 6 * lost - len(normal.step), 1)
    parts = likelihood.part_products()
    without = answers_without(parts, _BLOCKS) if len(parts) >= _BLOCKS else np.zeros((0, 0))
    return RigSolution(
        Xs=state.Xs,
        covariance=max(misfit, 1.0) * normal.covariance,
        unseen=normal.unseen,
        parameters=state.parameters,
        answers_without=without,
        noise=tuple(
            _noise(levels[N_LEVELS * at : N_LEVELS * (at + 1)], outliers)
            for at, outliers in enumerate(state.outliers)
        ),
        walk_by=state.walk_by,
        misfit=misfit,
        objective=likelihood.loss,
        converged=converged,
    )


def _noise(levels: FloatArray, outliers: Outliers) -> SensorNoise:
    white_m, white_rad, walk_m, walk_rad = np.exp(0.5 * levels).tolist()
    jumps, spikes = int(outliers.jumps.sum()), int(outliers.spikes.sum())
    return SensorNoise(white_rad, white_m, walk_rad, walk_m, jumps, spikes)
