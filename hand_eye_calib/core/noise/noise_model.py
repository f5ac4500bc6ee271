"""Noise model of two trajectories.

The symbols are those of :mod:`hand_eye_calib.core.noise`. The model contains these independent
errors:

- white errors v of poses: translation, rotation, and a shift along the velocity, which is due to
  jitter of stamps;
- a random walk of the motions with the steps w: translation and rotation;
- first-order Gauss-Markov processes g of poses, with ``c = M g``. For translations fixed to the
  child's body, M is constant. For translations and rotations fixed to the parent's world,
  ``M = Ad(X^-1) blkdiag(R_p', R_p')`` with the orientation R_p of the parent;
- Gauss-Markov processes of increments: a drifting scale, or a drifting direction of travel.

Each error has one variance for all axes. White rotation errors and rotations of the walk also
displace the child, by its lever arm. Jitter displaces it along the velocity only. A level is the
logarithm of a variance or of a time constant. Derivation: docs/adaptive.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.noise.increments import (
    PATH_PARTS,
    SCALE,
    Linearisation,
    Streams,
)
from hand_eye_calib.core.noise.normal import transposed
from hand_eye_calib.core.noise.reml import Prior
from hand_eye_calib.core.noise.state_space import WHITE, StateSpace
from hand_eye_calib.core.noise.tuning import Tuning

# Centres of white rotation errors: the sensors themselves, or the origin of the child's or of the
# parent's world. A camera that observes a target has errors about the target, which is the origin
# of its world.
CENTRES = ("sensors", "child", "parent")

# Indices of the levels of fast errors (white errors and the walk), which are not time-correlated.
# Variances in order: white translation (m^2), white rotation (rad^2), jitter of stamps (s^2), and
# the walk of translation (m^2) and of rotation (rad^2) over a typical increment.
N_FAST = 5
TRANSLATION, ROTATION, JITTER, WALK_TRANSLATION, WALK_ROTATION = range(N_FAST)
WHITES = slice(TRANSLATION, ROTATION + 1)
WALKS = slice(WALK_TRANSLATION, WALK_ROTATION + 1)
# The levels of time-correlated errors are behind: for each process its variance, then its time
# constant (s).
VARIANCES = slice(N_FAST, None, 2)
TIME_CONSTANTS = slice(N_FAST + 1, None, 2)

# Rows of the translation and of the rotation in a vector of six.
PARTS = {"translation": slice(0, 3), "rotation": slice(3, 6)}
# Covariance bases with equal variance on all axes: of translations and of rotations.
TRANSLATIONS = np.diag([1.0, 1.0, 1.0, 0, 0, 0])
ROTATIONS = np.diag([0, 0, 0, 1.0, 1.0, 1.0])

# Lower bound of all variances (m^2, rad^2, s^2). A smaller variance is rounding.
MIN_VARIANCE = 1e-14
# Lower bound of the log variances of white noise and walk, relative to the log variance of an
# increment. One matrix contains the precisions of white noise and walk, so smaller variances are
# lost to rounding.
_MIN_LOG_SHARE = -12.0

# Longest time constant of a drifting direction of travel, in intervals between poses. A more
# constant direction is a bias or a rotated mount, which are parameters.
_MAX_INTERVALS_OF_DIRECTION = 10.0

# Bounds of the variance of the walk over an increment, divided by that over a typical increment.
# They keep gaps and nearly equal stamps from dominating.
_WALK_FACTOR_LIMITS = (0.1, 100.0)


class FastSigmas(NamedTuple):
    """Standard deviations per axis: white noise, jitter of stamps, walk per typical increment."""

    translation_m: float
    rotation_rad: float
    jitter_s: float
    walk_translation_m: float
    walk_rotation_rad: float


#: Kind and part of a time-correlated error. The kind "body" is fixed to the child's body and
#: "world" to the parent's world; their parts are "translation" and "rotation". The kind "path" is
#: an error of the child's path; its parts are "scale" and "direction".
Process: TypeAlias = tuple[str, str]

# All time-correlated errors that the search tries. A rotation fixed to the body is left out: it
# would be a wandering mount, and old data would not count for X. No recording became more accurate
# by it.
PROCESSES: tuple[Process, ...] = (
    ("body", "translation"),
    ("world", "translation"),
    ("world", "rotation"),
    ("path", "scale"),
    ("path", "direction"),
)


@dataclass(frozen=True)
class NoiseModel:
    """Errors that are in the model, and their state space.

    Attributes
    ----------
    processes : tuple of Process
        Time-correlated errors.
    centre : {"sensors", "child", "parent"}
        Centre of white rotation errors, see :data:`CENTRES`.
    interval_s, duration_s : float
        Typical interval between poses, and duration of the recording.
    tuning : Tuning
        Priors and starting values of the levels.
    """

    processes: tuple[Process, ...]
    centre: str
    interval_s: float
    duration_s: float
    tuning: Tuning

    def state_space(
        self,
        streams: Streams,
        linearisation: Linearisation,
        twists: FloatArray,
        T_parent_child: FloatArray,
        weights: FloatArray,
        cut: BoolArray,
        prior: FloatArray,
    ) -> StateSpace:
        """Return the state space for a linearisation.

        Parameters
        ----------
        streams : Streams
        linearisation : Linearisation
        twists : (N, 6) array
            Velocity of the child, see :class:`~hand_eye_calib.core.noise.increments.Course`.
        T_parent_child : (4, 4) array
            X.
        weights : (N,) array
        cut : (n,) bool array
        prior : (p + 1, p + 1) array
            ``weights``, ``cut`` and ``prior`` are those of
            :class:`~hand_eye_calib.core.noise.state_space.StateSpace`.
        """
        to_child = se3.adjoint(se3.inverse(T_parent_child))
        intervals_s = np.diff(streams.stamps_s)
        # The parent has half of the rotation noise R. Its half also displaces the child, through
        # the lever arm: 1/2 (R + Ad(X^-1) R Ad(X^-1)').
        rotations = 0.5 * (ROTATIONS + to_child @ ROTATIONS @ to_child.T)
        white_rotations = rotations[None]
        if self.centre != "sensors":
            white_rotations = self._rotations_about_origin(streams, to_child)
        jitter = twists[:, :, None] * twists[:, None]
        h1_processes, h0_processes = self._process_matrices(
            streams, linearisation, to_child
        )
        h0 = linearisation.adjoints
        if self.processes:
            h0 = np.concatenate([h0, *h0_processes], axis=2)
        no_process = np.zeros((len(intervals_s), 6, 0))
        return StateSpace(
            intervals_s=intervals_s,
            walk_factors=np.clip(
                intervals_s / self.interval_s, *_WALK_FACTOR_LIMITS
            ),
            columns=linearisation.columns,
            h1_processes=np.concatenate([no_process, *h1_processes], axis=2),
            h0=h0,
            white_bases=(TRANSLATIONS[None], white_rotations, jitter),
            walk_bases=(TRANSLATIONS, rotations),
            group_sizes=tuple(matrices.shape[2] for matrices in h1_processes),
            weights=weights,
            cut=cut,
            prior=prior,
        )

    def _process_matrices(
        self,
        streams: Streams,
        linearisation: Linearisation,
        to_child: FloatArray,
    ) -> tuple[list[FloatArray], list[FloatArray]]:
        """Return the matrices (N - 1, 6, .) of each process at the end and at the start of steps.

        ``to_child`` (6, 6) is the adjoint of the inverse of X.
        """
        at_end = []
        at_start = []
        for kind, part in self.processes:
            if kind == "path":
                by_path = linearisation.by_path[part]
                at_end.append(np.zeros_like(by_path))
                at_start.append(-by_path)
            else:
                M = _directions(kind, part, streams, to_child)
                at_end.append(M[1:])
                at_start.append(linearisation.adjoints @ M[:-1])
        return at_end, at_start

    def _rotations_about_origin(
        self, streams: Streams, to_child: FloatArray
    ) -> FloatArray:
        """Return the covariances (N, 6, 6) of c for rotation errors about the origin of a world.

        The standard deviation of the errors is 1 rad per axis. ``centre`` ("child" or "parent")
        selects the world.
        """
        poses = streams.Ts_cw_c if self.centre == "child" else streams.Ts_pw_p
        by_rotation = np.zeros((len(poses), 6, 3))
        by_rotation[:, :3] = se3.skew(se3.translation_of(se3.inverse(poses)))
        by_rotation[:, 3:] = np.eye(3)
        if self.centre == "parent":
            by_rotation = to_child @ by_rotation
        return by_rotation @ transposed(by_rotation)

    def shares(
        self, levels: FloatArray, streams: Streams, T_parent_child: FloatArray
    ) -> FloatArray:
        """Return the matrices (1 or N, 6, 6) from the white errors v to the parent's share of v.

        S_p and S_c are the white covariances of parent and child without jitter, in the child's
        frame. The expected white errors a of the parent and b of the child are

            Ad(X^-1) a = S_p (S_p + S_c)^-1 v,      b = -S_c (S_p + S_c)^-1 v

        Each sensor has half of the noise, with one exception: rotation noise about the origin of a
        world belongs to the sensor in this world.
        """
        to_child = se3.adjoint(se3.inverse(T_parent_child))
        translation, rotation = np.exp(levels[WHITES])
        S_c = 0.5 * translation * TRANSLATIONS[None]
        if self.centre == "sensors":
            S_c = S_c + 0.5 * rotation * ROTATIONS
        S_p = to_child @ S_c @ to_child.T
        if self.centre == "child":
            S_c = S_c + rotation * self._rotations_about_origin(
                streams, to_child
            )
        elif self.centre == "parent":
            S_p = S_p + rotation * self._rotations_about_origin(
                streams, to_child
            )
        return transposed(np.linalg.solve(S_p + S_c, S_p))

    def prior(self, levels: FloatArray) -> Prior:
        """Return the prior of the levels for a search that starts at ``levels`` (m,).

        Only the jitter and the time constants have a prior density. The lower bounds of white noise
        and walk depend on the start.
        """
        tuning = self.tuning
        smallest_of_parts = increment_levels(levels) + _MIN_LOG_SHARE
        shortest, longest = self._log_tau_bounds
        mean = levels.copy()
        precision = np.zeros(len(levels))
        lower = np.full(len(levels), np.log(MIN_VARIANCE))
        upper = np.full(len(levels), np.inf)
        lower[WHITES] = np.maximum(lower[WHITES], smallest_of_parts)
        lower[WALKS] = np.maximum(lower[WALKS], smallest_of_parts)
        mean[JITTER] = tuning.jitter
        # The prior standard deviation of the log variance is 4.5: the jitter may differ by a factor
        # of 10.
        precision[JITTER] = 0.05
        mean[TIME_CONSTANTS] = self._usual_log_tau
        precision[TIME_CONSTANTS] = tuning.tau_precision
        lower[TIME_CONSTANTS] = shortest
        longest_of_direction = shortest + np.log(_MAX_INTERVALS_OF_DIRECTION)
        is_direction = [part == "direction" for _, part in self.processes]
        upper[TIME_CONSTANTS] = np.where(
            is_direction, longest_of_direction, longest
        )
        return Prior(mean, precision, lower, upper)

    @property
    def _usual_log_tau(self) -> float:
        """Logarithm of the time constant (s) at the start of a search; also the mean of its prior.

        The search clips the start to the bounds of the time constants. For a short recording, the
        mean of the prior may be outside these bounds.
        """
        shortest_s = self.tuning.start_tau_intervals * self.interval_s
        longest_s = max(
            self.tuning.start_tau_share * self.duration_s, shortest_s
        )
        return 0.5 * float(np.log(shortest_s * longest_s))

    @property
    def _log_tau_bounds(self) -> tuple[float, float]:
        """Bounds of the logarithms of time constants (s).

        The lower bound is a typical interval between poses. The upper bound is a quarter of the
        recording: an error that lasts longer is hardly different from a constant error.
        """
        longest_s = max(0.25 * self.duration_s, self.interval_s)
        return float(np.log(self.interval_s)), float(np.log(longest_s))

    def with_processes(
        self, processes: tuple[Process, ...], levels: FloatArray
    ) -> tuple[NoiseModel, FloatArray]:
        """Add time-correlated errors to the model.

        Returns
        -------
        NoiseModel
        (m,) array
            Levels at the start of a search: the given levels, then the levels of the processes.
        """
        tuning = self.tuning
        of_poses = increment_levels(levels) + np.log(tuning.start_share)
        of_path = 2.0 * np.log(tuning.sizes[SCALE])
        log_variances = dict(zip(PARTS, of_poses, strict=True))
        log_variances |= dict.fromkeys(PATH_PARTS, of_path)
        log_tau = self._usual_log_tau
        starts = [[log_variances[part], log_tau] for _, part in processes]
        all_levels = np.concatenate([levels, np.ravel(starts)])
        return replace(self, processes=processes), all_levels

    def process_errors(
        self, states: FloatArray, streams: Streams, T_parent_child: FloatArray
    ) -> FloatArray:
        """Return the time-correlated part ``sum_k M_k g_k`` (N, 6) of the error c.

        Processes of the path are left out: they are errors of increments, not of poses.

        Parameters
        ----------
        states : (N, d) array
        streams : Streams
        T_parent_child : (4, 4) array
            X.
        """
        to_child = se3.adjoint(se3.inverse(T_parent_child))
        error = np.zeros((len(states), 6))
        start = WHITE
        for kind, part in self.processes:
            if kind != "path":
                M = _directions(kind, part, streams, to_child)
                error += se3.times(M, states[:, start : start + 3])
            start += 1 if part == "scale" else 3
        return error


def _directions(
    kind: str, part: str, streams: Streams, to_child: FloatArray
) -> FloatArray:
    """Return the matrices M (N, 6, 3) from a process of kind "body" or "world" to c."""
    if kind == "body":
        return np.broadcast_to(np.eye(6)[:, PARTS[part]], (len(streams), 6, 3))
    return to_child[:, PARTS[part]] @ transposed(
        se3.rotation_of(streams.Ts_pw_p)
    )


def fast_sigmas(levels: FloatArray) -> FastSigmas:
    """Return the standard deviations of white noise, jitter and walk from their log variances."""
    return FastSigmas(*np.exp(0.5 * levels)[:N_FAST].tolist())


def increment_levels(levels: FloatArray) -> FloatArray:
    """Return the log variances (2,) of an increment: translation (m^2), rotation (rad^2).

    The variance of an increment is the variance of the walk plus twice the white variance of a
    pose.
    """
    return np.logaddexp(levels[WALKS], levels[WHITES] + np.log(2.0))


def rough_levels(
    residuals: FloatArray, left_out: BoolArray, jitter: float
) -> FloatArray:
    """Return levels (5,) at the start of a search: half of the variance is white, half is walk.

    Parameters
    ----------
    residuals : (n, 6) array
    left_out : (n,) bool array
        Increments that are ignored.
    jitter : float
        Log variance (s^2) of the jitter of stamps.
    """
    squares = (residuals[~left_out] ** 2).reshape(-1, 2, 3)
    variances = np.zeros(2)
    if len(squares):
        variances = squares.mean(axis=(0, 2))
    of_increment = np.log(np.maximum(variances, 100 * MIN_VARIANCE))
    levels = np.full(N_FAST, jitter)
    # The white noise of an increment is that of its two poses.
    levels[WHITES] = of_increment + np.log(0.25)
    levels[WALKS] = of_increment + np.log(0.5)
    return levels
