"""What is to be solved, where a search stands, and what is kept between its steps.

A stage of the search (:mod:`~hand_eye_calib.gls.stages`) takes a :class:`Problem` and a
:class:`Fit`, and returns another fit. Neither ever changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls.increments import N_SYSTEMATIC, Course, Streams, linearise, turned
from hand_eye_calib.gls.noise_model import ROTATION, NoiseModel
from hand_eye_calib.gls.outliers import Outliers, bridged
from hand_eye_calib.gls.state_space import WHITE, Posterior, StateSpace
from hand_eye_calib.gls.tuning import TUNING, Tuning
from hand_eye_calib.stats import median


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
            course = Course(course.twists[kept], course.path[kept], course.along[kept])
            poses, error, weights = poses[kept], error[kept], weights[kept]
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
        """Of all poses."""
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
        Freed of the errors known so far, spikes bridged.
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
        parameters, is_long = (
            self.parameters.copy(),
            np.linalg.norm(step[:3]) >= TUNING.longest_step_m,
        )
        parameters[columns] += step[6:]
        T = self.T if is_long else self.T @ se3.exp(step[:6])
        return replace(self, T=T, parameters=parameters)

    def freed(self, streams: Streams, states: FloatArray) -> Fit:
        """With the given poses freed of the errors that latent states (N, d) make.

        White errors are split between the sensors by their covariances, which holds for errors of
        these covariances only. A lasting error of some centimetres beside white noise of a
        millimetre would be taken for large and opposite rotations, so other errors are split in
        halves; spikes, too.
        """
        spikes, T = self.outliers.spikes, self.T
        white_error = np.where(spikes[:, None], 0.0, states[:, :WHITE])
        error = states[:, :WHITE] + self.model.lasting(states, self.poses, T)
        other_error = error - white_error
        of_white = turned(self.model.shares(self.levels, self.poses, T), white_error)
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
