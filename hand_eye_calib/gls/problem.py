"""What is to be solved, where a search stands, and what is kept between its steps.

A stage of the search (:mod:`~hand_eye_calib.gls.stages`) takes a :class:`Problem` and a
:class:`Fit`, and returns another fit. Neither ever changes.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls.increments import (
    N_SYSTEMATIC,
    Course,
    Linearisation,
    Streams,
    freed,
    linearise,
)
from hand_eye_calib.gls.noise_model import ROTATION, NoiseModel
from hand_eye_calib.gls.outliers import LONGEST_GAP, Outliers, bridged
from hand_eye_calib.gls.state_space import WHITE, Posterior, StateSpace
from hand_eye_calib.gls.tuning import TUNING, Tuning
from hand_eye_calib.stats import distinct


@dataclass(frozen=True)
class Problem:
    """Poses of two sensors, and what is asked of them.

    Attributes
    ----------
    streams : Streams
    systematic : tuple of str
        Systematic errors to choose from, the plainest first; the choice if there is only one.
    is_clock_free : bool
        Whether a time offset is in the model if the motion tells it from X.
    without : frozenset of str
        Names of the stages to leave out.
    tuning : Tuning
    workspace : Workspace
    """

    streams: Streams
    systematic: tuple[str, ...]
    is_clock_free: bool = False
    without: frozenset[str] = frozenset()
    tuning: Tuning = TUNING
    workspace: Workspace = field(default_factory=lambda: Workspace())

    def space(
        self,
        fit: Fit,
        kept: IntArray | None = None,
        model: NoiseModel | None = None,
        columns: list[int] | None = None,
    ) -> StateSpace:
        """State space of all or some of the poses, with a model and systematic errors other than
        those of the fit.
        """
        poses, course, error, weights = fit.poses, fit.course, fit.error, fit.weights
        outliers = fit.outliers
        if kept is not None:
            poses, course, error, weights = poses[kept], course[kept], error[kept], weights[kept]
            outliers = outliers.across(kept, LONGEST_GAP)
        return (model or fit.model).state_space(
            poses,
            fit.linearised(poses, course, error, fit.columns if columns is None else columns),
            course.twists,
            fit.T,
            np.where(outliers.spikes, 0.0, weights),
            outliers.jumps,
        )

    def posterior(self, fit: Fit, columns: list[int] | None = None) -> Posterior:
        """Of all poses; with systematic errors other than those of the fit."""
        return self.workspace.posterior(self, fit, fit.columns if columns is None else columns)

    def is_noisy(self, fit: Fit) -> bool:
        """Whether the rotation between poses is not large beside its noise."""
        noise = np.exp(0.5 * fit.levels[ROTATION])
        return bool(noise > self.tuning.noisy * self.streams.typical_turn)


class Workspace:
    """The posterior of all poses that was asked for last. It is large, so that there is one."""

    def __init__(self) -> None:
        self._fit: Fit | None = None
        self._posterior: Posterior | None = None
        self._columns: list[int] = []

    def posterior(self, problem: Problem, fit: Fit, columns: list[int]) -> Posterior:
        """Of a fit with these systematic errors. What does not depend on them is kept."""
        if self._posterior is None or fit is not self._fit:
            self._fit = self._posterior = None
            self._posterior = Posterior(problem.space(fit, columns=columns), fit.levels)
            self._fit, self._columns = fit, columns
        if columns != self._columns:
            found = fit.linearised(fit.poses, fit.course, fit.error, columns)
            self._posterior = self._posterior.with_columns(found.columns)
            self._columns = columns
        return self._posterior

    def settled(self, fit: Fit, converged: bool) -> Fit:
        """A fit that is known to have converged, or not: its posterior stays the same."""
        found = replace(fit, converged=converged)
        if self._fit is fit:
            self._fit = found
        return found


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
    has_heavy_tails : bool
    systematic : str
    columns : list of int
        Parameters of systematic errors in the model.
    parameters : (8,) array
        Their values.
    other_sigmas : (8,) array
        Standard deviations of parameters that are not in the model.
    cov_beyond : (6, 6) array
        Of X, by what is not in the model: errors that last too long to be found, and systematic
        errors that may be there.
    n_evaluations : int
        Of the likelihood.
    converged : bool
    """

    poses: Streams
    error: FloatArray
    course: Course
    T: FloatArray
    model: NoiseModel
    levels: FloatArray
    outliers: Outliers
    weights: FloatArray
    has_heavy_tails: bool = False
    systematic: str = "none"
    columns: list[int] = field(default_factory=list)
    parameters: FloatArray = field(default_factory=lambda: np.zeros(N_SYSTEMATIC))
    other_sigmas: FloatArray = field(default_factory=lambda: np.zeros(N_SYSTEMATIC))
    cov_beyond: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    n_evaluations: int = 0
    converged: bool = False

    def linearised(
        self, poses: Streams, course: Course, error: FloatArray, columns: list[int]
    ) -> Linearisation:
        """Increments between poses, the errors that these were freed of put back."""
        known = error if error.any() else None
        return linearise(poses, course, self.T, self.parameters, columns, known)

    def moved(self, step: FloatArray) -> Fit:
        """After a step of xi and of the parameters in the model."""
        parameters = self.parameters.copy()
        parameters[self.columns[: len(step) - 6]] += step[6:]
        return replace(self, T=after(self.T, step[:6]), parameters=parameters)

    def bridged(self, streams: Streams, outliers: Outliers) -> Fit:
        """With other outliers, at poses as given."""
        poses = bridged(streams, self.T, outliers.spikes)
        return replace(self, outliers=outliers, poses=poses, error=np.zeros_like(self.error))

    def freed(self, streams: Streams, states: FloatArray) -> Fit:
        """With the given poses freed of the errors that latent states (N, d) make."""
        spikes = self.outliers.spikes
        white_error = np.where(spikes[:, None], 0.0, states[:, :WHITE])
        error = states[:, :WHITE] + self.model.lasting(states, self.poses, self.T)
        white = self.model.sensor_white(self.levels, self.poses, self.T)
        given = bridged(streams, self.T, spikes)
        poses = freed(given, white_error, error - white_error, self.T, white)
        return replace(self, poses=poses, error=error)


def after(T: FloatArray, step: FloatArray) -> FloatArray:
    """X after a step (6,); as it is if noise alone makes a step so long, along a direction that the
    motion hardly shows.
    """
    return T @ se3.exp(step) if np.linalg.norm(step[:3]) < TUNING.longest_step_m else T


def sample(n_poses: int, most: int) -> IntArray | None:
    """Poses to fit noise levels with: evenly spread bursts, ever farther apart within each; None
    for all of them.
    """
    if n_poses <= most:
        return None
    burst = np.array(TUNING.burst)
    offsets = burst[2 * len(burst) * n_poses // most > burst]
    starts = np.linspace(0, n_poses - 1 - offsets[-1], most // len(burst)).astype(int)
    return distinct((starts[:, None] + offsets).ravel())
