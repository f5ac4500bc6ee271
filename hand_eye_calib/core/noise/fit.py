"""Data and state of the search for X, noise model, outliers and systematic errors.

:class:`Problem` contains the data. :class:`Fit` is one state of the search. Both are immutable.
:class:`Workspace` stores the factorisation of the last fit. The stages of the search are in
:mod:`~hand_eye_calib.core.noise.stages`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.noise.increments import (
    N_SYSTEMATIC,
    Course,
    Linearisation,
    Streams,
    course_of,
    linearise,
)
from hand_eye_calib.core.noise.noise_model import (
    ROTATION,
    NoiseModel,
    increment_levels,
)
from hand_eye_calib.core.noise.normal import prior_products
from hand_eye_calib.core.noise.outliers import (
    Outliers,
    bridge_outliers,
)
from hand_eye_calib.core.noise.partwise import MAX_POSES, PartwisePosterior
from hand_eye_calib.core.noise.state_space import WHITE, Posterior, StateSpace
from hand_eye_calib.core.noise.tuning import TUNING, Tuning

# A step of the translation of X that is longer than this (m) is not applied: no lever arm is so
# long.
_MAX_STEP_M = 1000.0


@dataclass(frozen=True)
class Problem:
    """Data of a search: poses of two sensors, and which parameters to estimate.

    Attributes
    ----------
    streams : Streams
    columns : list of int
        Indices of the systematic errors in the model, see
        :data:`~hand_eye_calib.core.noise.increments.PARAMETERS`.
    is_clock_free : bool
        Whether the time offset was estimated from the same poses. The offset is then always a
        parameter, so that the covariance of X contains its uncertainty.
    without : frozenset of str
        Names of the skipped stages. With "centre", rotation errors turn about the sensors.
    tuning : Tuning
    """

    streams: Streams
    columns: list[int]
    is_clock_free: bool = False
    without: frozenset[str] = frozenset()
    tuning: Tuning = TUNING

    def prior(self, fit: Fit) -> FloatArray:
        """Prior of the parameters, as products (p + 1, p + 1)."""
        values = fit.parameters[self.columns]
        return prior_products(values, fit.sigmas[self.columns], 7 + len(values))

    def linearised(self, fit: Fit) -> Linearisation:
        """Return the residuals and their derivatives at a fit."""
        return linearise(
            fit.poses,
            fit.course,
            fit.T,
            fit.parameters,
            self.columns,
            fit.error,
        )

    def space(self, fit: Fit, kept: IntArray | None = None) -> StateSpace:
        """Return the state space at a fit, for all poses or for the subset ``kept`` (indices)."""
        if kept is not None:
            fit = fit.at_poses(kept, self.tuning.burst[-1])
        return self.space_of(fit, self.linearised(fit))

    def space_of(self, fit: Fit, linearisation: Linearisation) -> StateSpace:
        """Return the state space of all poses at a fit whose linearisation is known."""
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
        """Return the motion of the child, smoothed according to the noise levels (m,)."""
        noise_m = float(np.exp(0.5 * increment_levels(levels)[0]))
        return course_of(
            self.streams, T_parent_child, self.tuning.caution * noise_m**2
        )

    def is_noisy(self, fit: Fit) -> bool:
        """Return whether the rotation noise exceeds a share of the usual rotation between poses."""
        turns = se3.rotation_angle(se3.rotation_of(self.streams.motions_p))
        return bool(
            np.exp(0.5 * fit.levels[ROTATION])
            > self.tuning.noisy_share * median(turns)
        )


class Workspace:
    """Problem with a cache: the posterior and the linearisation of the last fit.

    Attributes
    ----------
    problem : Problem
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        # Only one posterior is stored: for a long recording it is large.
        self._fit: Fit | None = None
        self._posterior: Posterior | PartwisePosterior | None = None
        self._linearisation: Linearisation | None = None

    def posterior(self, fit: Fit) -> Posterior | PartwisePosterior:
        """Return the posterior of all poses at a fit; a second call for it costs nothing."""
        if self._posterior is None or self._fit is not fit:
            # Release the stored posterior before the next one is computed: two would fill the
            # memory.
            self._posterior = None
            if self._fit is None or not fit.is_linearised_as(self._fit):
                self._linearisation = None
            self._posterior = self._new_posterior(fit)
            self._fit = fit
        return self._posterior

    def _new_posterior(self, fit: Fit) -> Posterior | PartwisePosterior:
        problem = self.problem
        n_poses = len(problem.streams)
        if n_poses <= MAX_POSES:
            if self._linearisation is None:
                self._linearisation = problem.linearised(fit)
            return Posterior(
                problem.space_of(fit, self._linearisation), fit.levels
            )

        def space_of(poses: IntArray) -> StateSpace:
            return problem.space(fit, poses)

        return PartwisePosterior(
            space_of, n_poses, problem.prior(fit), fit.levels
        )


@dataclass(frozen=True, kw_only=True)
class Fit:
    """State of a search.

    Attributes
    ----------
    poses : Streams
        Poses for linearisation: the errors estimated so far were removed, and outlier poses were
        replaced by :func:`~hand_eye_calib.core.noise.outliers.bridge_outliers`.
    error : (N, 6) array
        Errors c that were removed from the poses. The walk and the errors of the path are not part
        of c and were not removed.
    course : Course
        Smoothed motion of the child.
    T : (4, 4) array
        X, which is T_parent_child.
    model : NoiseModel
    levels : (m,) array
        Levels of the model: log variances and log time constants.
    outliers : Outliers
    weights : (N,) array
        Weights of the white errors; 1 unless white errors have heavy tails. Outlier poses have
        weights here, too; only in the state space their weight is 0.
    sigmas : (8,) array
        Prior standard deviations of systematic errors.
    has_heavy_tails : bool
        Whether white errors have heavy tails.
    parameters : (8,) array
        Estimates of systematic errors, see
        :data:`~hand_eye_calib.core.noise.increments.PARAMETERS`.
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
    parameters: FloatArray = field(
        default_factory=lambda: np.zeros(N_SYSTEMATIC)
    )

    def is_linearised_as(self, other: Fit) -> bool:
        """Return whether this fit and another fit have the same residuals and derivatives.

        They have, if only levels or weights differ.
        """
        names = ("poses", "error", "course", "T", "parameters")
        return all(
            getattr(self, name) is getattr(other, name) for name in names
        )

    def at_poses(self, kept: IntArray, longest_gap: int) -> Fit:
        """Return the fit of a subset of the poses (indices), see :meth:`Outliers.across`."""
        return replace(
            self,
            poses=self.poses[kept],
            error=self.error[kept],
            course=self.course[kept],
            outliers=self.outliers.across(kept, longest_gap),
            weights=self.weights[kept],
        )

    def moved(self, step: FloatArray, columns: list[int]) -> Fit:
        """Return the fit after a step of the parameters beta.

        ``step`` (6 + k,) contains xi, then the changes of the k systematic errors in ``columns``. X
        stays unchanged if its step is longer than any lever arm: such a step is noise along a
        direction that the motion hardly excites.
        """
        parameters = self.parameters.copy()
        parameters[columns] += step[6:]
        if np.linalg.norm(step[:3]) >= _MAX_STEP_M:
            return replace(self, parameters=parameters)
        return replace(
            self, T=self.T @ se3.exp(step[:6]), parameters=parameters
        )

    def corrected(self, streams: Streams, states: FloatArray) -> Fit:
        """Return the fit with poses from which the smoothed errors c were removed.

        White errors are split between both sensors in proportion to their covariances. All other
        errors, and the errors of outlier poses, are split into halves, because the covariances of
        white noise do not apply to them. Split by these covariances, a position error of
        centimetres would be explained by large and opposite rotations of both sensors, because a
        rotation moves the end of the lever arm.

        Parameters
        ----------
        streams : Streams
            Measured poses.
        states : (N, d) array
            Expected states, see :mod:`~hand_eye_calib.core.noise.state_space`.
        """
        spikes = self.outliers.spikes
        T = self.T
        white_error = np.where(spikes[:, None], 0.0, states[:, :WHITE])
        error = states[:, :WHITE] + self.model.process_errors(
            states, self.poses, T
        )
        other_error = error - white_error
        shares = self.model.shares(self.levels, self.poses, T)
        # Ad(X^-1) a of the parent, and b of the child, with c = Ad(X^-1) a - b.
        white_of_parent = se3.times(shares, white_error)
        of_parent = white_of_parent + 0.5 * other_error
        of_child = white_of_parent - white_error - 0.5 * other_error
        measured = bridge_outliers(streams, T, spikes)
        # The adjoint converts the parent's error from the child's frame to the parent's frame.
        poses = Streams(
            streams.stamps_s,
            measured.Ts_pw_p @ se3.exp(-of_parent @ se3.adjoint(T).T),
            measured.Ts_cw_c @ se3.exp(-of_child),
        )
        return replace(self, poses=poses, error=error)
