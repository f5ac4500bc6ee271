"""Noise model of two trajectories.

The error c of a pair of poses, in the child's frame, is the sum of these independent parts:

- a white error: translation, rotation, and along the velocity, for stamps that jitter;
- a random walk of the motions: translation and rotation;
- first-order Gauss-Markov processes g: ``c = M g`` with M constant for translations fixed to the
  child's body, and ``M = Ad(X^-1) blkdiag(R_p', R_p')`` for translations and rotations fixed to the
  parent's world. A drifting scale or direction of travel enters the increments instead.

Each part has one variance for all axes. A level is the logarithm of a variance or of a time
constant. Derivation: docs/adaptive.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.noise.increments import PATH_PARTS, SCALE, Linearisation, Streams
from hand_eye_calib.core.noise.normal import transposed
from hand_eye_calib.core.noise.reml import Prior
from hand_eye_calib.core.noise.state_space import WHITE, StateSpace
from hand_eye_calib.core.noise.tuning import Tuning

# Centres of white rotation noise: the sensors themselves, or the origin of the child's or of the
# parent's world. Rotation errors of a camera that observes a target turn about the target.
CENTRES = ("sensors", "child", "parent")

# Levels of the fast errors: white translation (m^2), white rotation (rad^2), jitter of stamps
# (s^2), walk of translation and of rotation.
N_FAST = 5
TRANSLATION, ROTATION, JITTER, WALK_TRANSLATION, WALK_ROTATION = range(N_FAST)
WHITES = slice(TRANSLATION, ROTATION + 1)
WALKS = slice(WALK_TRANSLATION, WALK_ROTATION + 1)
# Levels of time-correlated errors follow: the variance, then the time constant (s) of each process.
VARIANCES = slice(N_FAST, None, 2)
TIME_CONSTANTS = slice(N_FAST + 1, None, 2)

PARTS = {"translation": slice(0, 3), "rotation": slice(3, 6)}
TRANSLATIONS = np.diag([1.0, 1.0, 1.0, 0, 0, 0])
ROTATIONS = np.diag([0, 0, 0, 1.0, 1.0, 1.0])

# Bounds of variances (m^2, rad^2, s^2) and of log variances. Rounding is below the lower one.
LOWEST_VARIANCE = 1e-14
_HIGHEST_LEVEL = 14.0

# Lower bound of the logarithms of the shares of white noise and of the walk in the variance of an
# increment. A smaller share is lost to rounding, because one matrix contains both precisions.
_LOWEST_SHARE = -12.0

# Longest time constant of a drifting direction of travel, in intervals. A direction that lasts
# longer is a bias or a rotated mount, which have parameters.
_LONGEST_OF_DIRECTION = 10.0

# Bounds of the variance of the walk over an increment, in units of a typical increment. Neither a
# gap nor two almost equal stamps may dominate.
_WALK_BOUNDS = (0.1, 100.0)


class FastSigmas(NamedTuple):
    """Standard deviations per axis of white noise, jitter of stamps and walk."""

    translation_m: float
    rotation_rad: float
    jitter_s: float
    walk_translation_m: float
    walk_rotation_rad: float


#: Kind and part of a process of time-correlated errors: ("body" or "world", "translation" or
#: "rotation"), or ("path", "scale" or "direction").
Slow: TypeAlias = tuple[str, str]

# There is no rotation fixed to the body, which is a mount that wanders: X would forget its
# evidence, and no recording gains by it.
LASTING: tuple[Slow, ...] = (
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
    slow : tuple of Slow
        Time-correlated errors.
    centre : {"sensors", "child", "parent"}
        Centre of white rotation noise, see :data:`CENTRES`.
    interval_s, duration_s : float
        Typical interval and duration of the recording.
    tuning : Tuning
        Numbers of the prior and of the levels that a search starts at.
    """

    slow: tuple[Slow, ...]
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
        """Return the state space of a linearisation.

        Parameters
        ----------
        streams : Streams
        linearisation : Linearisation
        twists : (N, 6) array
            Of the child, see :class:`~hand_eye_calib.core.noise.increments.Course`.
        T_parent_child : (4, 4) array
        weights : (N,) array
        cut : (n,) bool array
        prior : (p + 1, p + 1) array
            The last three as in :class:`~hand_eye_calib.core.noise.state_space.StateSpace`.
        """
        to_child = se3.adjoint(se3.inverse(T_parent_child))
        intervals_s = np.diff(streams.stamps_s)
        # Half of the rotation noise is the parent's, which moves the child by the lever arm.
        rotations = 0.5 * (ROTATIONS + to_child @ ROTATIONS @ to_child.T)
        white_rotations = rotations[None]
        if self.centre != "sensors":
            white_rotations = self._rotations_about_origin(streams, to_child)
        jitter = twists[:, :, None] * twists[:, None]
        ahead = [np.zeros((len(intervals_s), 6, 0))]
        behind = [linearisation.adjoints]
        for kind, part in self.slow:
            if kind == "path":
                by_path = linearisation.by_path[part]
                ahead.append(np.zeros_like(by_path))
                behind.append(-by_path)
            else:
                M = _directions(kind, part, streams, to_child)
                ahead.append(M[1:])
                behind.append(linearisation.adjoints @ M[:-1])
        return StateSpace(
            intervals_s=intervals_s,
            walk_factors=np.clip(intervals_s / self.interval_s, *_WALK_BOUNDS),
            columns=linearisation.columns,
            ahead=np.concatenate(ahead, axis=2),
            behind=np.concatenate(behind, axis=2) if self.slow else linearisation.adjoints,
            white_bases=(TRANSLATIONS[None], white_rotations, jitter),
            walk_bases=(TRANSLATIONS, rotations),
            group_sizes=tuple(matrices.shape[2] for matrices in ahead[1:]),
            weights=weights,
            cut=cut,
            prior=prior,
        )

    def _rotations_about_origin(self, streams: Streams, to_child: FloatArray) -> FloatArray:
        """Return the covariances (N, 6, 6) of c for rotations of 1 rad about a world's origin."""
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
        """Return the matrices (1 or N, 6, 6) from white errors c to the parent's share of c.

        White errors are split by ``Ad(X^-1) a = S' (S' + S)^-1 c`` and ``b = -S (S' + S)^-1 c``
        with the white covariances S' of the parent and S of the child, in the child's frame. A
        rotation of the parent also moves the child by the lever arm. Each sensor has half of the
        noise. Rotation noise about the origin of a world belongs to the sensor in this world.
        """
        to_child = se3.adjoint(se3.inverse(T_parent_child))
        translation, rotation = np.exp(levels[WHITES])
        S_child = 0.5 * translation * TRANSLATIONS[None]
        if self.centre == "sensors":
            S_child = S_child + 0.5 * rotation * ROTATIONS
        S_parent = to_child @ S_child @ to_child.T
        if self.centre == "child":
            S_child = S_child + rotation * self._rotations_about_origin(streams, to_child)
        elif self.centre == "parent":
            S_parent = S_parent + rotation * self._rotations_about_origin(streams, to_child)
        return transposed(np.linalg.solve(S_parent + S_child, S_parent))

    def prior(self, levels: FloatArray) -> Prior:
        """Return the prior of the levels (m,) for a search that starts at given levels (m,)."""
        tuning = self.tuning
        total = increment_levels(levels)
        shortest, longest = self._log_tau_bounds
        mean = levels.copy()
        precision = np.zeros(len(levels))
        lower = np.full(len(levels), np.log(LOWEST_VARIANCE))
        upper = np.full(len(levels), _HIGHEST_LEVEL)
        lower[WHITES] = np.maximum(lower[WHITES], total + _LOWEST_SHARE)
        lower[WALKS] = np.maximum(lower[WALKS], total + _LOWEST_SHARE)
        mean[JITTER] = tuning.jitter
        # The prior standard deviation of this level is 4.5: a factor of 10 of the jitter.
        precision[JITTER] = 0.05
        mean[TIME_CONSTANTS] = self._usual_log_tau
        precision[TIME_CONSTANTS] = tuning.tau_precision
        lower[TIME_CONSTANTS] = shortest
        longest_of_direction = shortest + np.log(_LONGEST_OF_DIRECTION)
        is_direction = [part == "direction" for _, part in self.slow]
        upper[TIME_CONSTANTS] = np.where(is_direction, longest_of_direction, longest)
        return Prior(mean, precision, lower, upper)

    @property
    def _usual_log_tau(self) -> float:
        """Logarithm of the time constant (s) that a search starts at, which is its prior mean."""
        shortest_s = self.tuning.start_tau_intervals * self.interval_s
        longest_s = max(self.tuning.start_tau_share * self.duration_s, shortest_s)
        return 0.5 * float(np.log(shortest_s * longest_s))

    @property
    def _log_tau_bounds(self) -> tuple[float, float]:
        """Bounds of the logarithms of time constants (s): an interval, and a share of the duration.

        An error that lasts for more than a quarter of the recording is constant.
        """
        longest_s = max(0.25 * self.duration_s, self.interval_s)
        return float(np.log(self.interval_s)), float(np.log(longest_s))

    def with_lasting(
        self, processes: tuple[Slow, ...], levels: FloatArray
    ) -> tuple[NoiseModel, FloatArray]:
        """Add time-correlated errors to the model.

        Returns
        -------
        NoiseModel
        (m,) array
            Levels to start a search at: the given levels, then those of the processes.
        """
        tuning = self.tuning
        variances = dict(
            zip(PARTS, increment_levels(levels) + np.log(tuning.start_share), strict=True)
        )
        variances |= dict.fromkeys(PATH_PARTS, 2.0 * np.log(tuning.sizes[SCALE]))
        log_tau = self._usual_log_tau
        starts = [[variances[part], log_tau] for _, part in processes]
        return replace(self, slow=processes), np.r_[levels, np.ravel(starts)]

    def lasting(
        self, states: FloatArray, streams: Streams, T_parent_child: FloatArray
    ) -> FloatArray:
        """Return the time-correlated part (N, 6) of the error c, in the child's frame.

        Parameters
        ----------
        states : (N, d) array
        streams : Streams
        T_parent_child : (4, 4) array
        """
        to_child = se3.adjoint(se3.inverse(T_parent_child))
        error = np.zeros((len(states), 6))
        start = WHITE
        for kind, part in self.slow:
            if kind != "path":
                M = _directions(kind, part, streams, to_child)
                error += se3.times(M, states[:, start : start + 3])
            start += 1 if part == "scale" else 3
        return error


def _directions(kind: str, part: str, streams: Streams, to_child: FloatArray) -> FloatArray:
    """Return the matrices M (N, 6, 3) from a process to the error c."""
    if kind == "body":
        return np.broadcast_to(np.eye(6)[:, PARTS[part]], (len(streams), 6, 3))
    return to_child[:, PARTS[part]] @ transposed(se3.rotation_of(streams.Ts_pw_p))


def fast_sigmas(levels: FloatArray) -> FastSigmas:
    """Return the standard deviations of white noise, jitter and walk from their log variances."""
    return FastSigmas(*np.exp(0.5 * levels)[:N_FAST].tolist())


def increment_levels(levels: FloatArray) -> FloatArray:
    """Log variances (2,) of increments of translation and rotation: white noise plus walk."""
    return np.logaddexp(levels[WALKS], levels[WHITES] + np.log(2.0))
