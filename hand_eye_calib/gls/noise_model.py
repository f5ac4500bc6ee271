"""The noise of two trajectories: which errors there are, how strong, and how they enter.

Every pose of both sensors has a white error (translation, rotation, and along the velocity, for
stamps that jitter), the motions a random walk, and errors that last are first-order Gauss-Markov
processes, fixed to the child's body or to the parent's world. Each has one variance for translation
and one for rotation. A scale that drifts is one more.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls.increments import Linearisation, Streams
from hand_eye_calib.gls.reml import Prior
from hand_eye_calib.gls.state_space import WHITE, Group, StateSpace

# What white rotation noise turns a trajectory about: either sensor itself, or the origin of the
# child's or of the parent's world, as of a camera that sees a target.
CENTRES = ("sensors", "child", "parent")

# Log levels before those of lasting errors: white translation (m^2), white rotation (rad^2), jitter
# of stamps (s^2), walk of translation and of rotation.
TRANSLATION, ROTATION, JITTER, WALK_TRANSLATION, WALK_ROTATION = range(5)
N_FAST = 5

# Variances never fall below this (rad^2 or m^2): rounding, not noise. White noise and walk do not
# fall below these shares of the whole, either; the precisions of both stand in one matrix.
LOWEST_VARIANCE = 1e-14
_LEAST_WHITE, _LEAST_WALK = np.exp(-14.0), np.exp(-12.0)
_LOWEST_LEVEL, _HIGHEST_LEVEL = -32.0, 14.0

# Expected jitter of stamps (s^2), and how well it is known; time constants, too.
JITTER_VARIANCE, _JITTER_PRECISION, _TAU_PRECISION = np.exp(-14.0), 0.05, 0.3

# Time constants are between an interval and this share of the recording.
_LONGEST_SHARE = 0.25

# A walk's variance over an increment, in units of a typical one: bounded, so that neither a gap nor
# twin stamps dominate.
_RELATIVE = (0.1, 100.0)

# A search for errors that last begins at this share of the white and walking noise, and at a time
# constant between so many intervals and this share of the recording.
_FIRST_VARIANCE, _FIRST_TAU, _LAST_TAU = 0.1, 10.0, 0.06
_FIRST_SCALE = np.exp(-10.0)

# Where a search starts again, no white noise and no walk is smaller than this share of the whole.
_AUDIBLE_WHITE, _AUDIBLE_WALK = 0.1, 1e-3

# A process whose variance the data say less about than this is left out: it makes no difference.
_LEAST_INFORMATION = 0.3

_TRANSLATIONS = np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
_ROTATIONS = np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
PARTS = {"translation": slice(0, 3), "rotation": slice(3, 6)}


@dataclass(frozen=True)
class Slow:
    """A process of errors that last: ``kind`` body or world, ``part`` translation or rotation; or
    both scale.
    """

    kind: str
    part: str

    @property
    def size(self) -> int:
        """Number of states."""
        return 1 if self.kind == "scale" else 3


LASTING = (
    *(Slow(kind, part) for kind in ("body", "world") for part in PARTS),
    Slow("scale", "scale"),
)


@dataclass(frozen=True)
class Extent:
    """Typical interval (s) and duration (s) of a recording."""

    interval_s: float
    duration_s: float


@dataclass(frozen=True)
class NoiseModel:
    """Which errors there are.

    Attributes
    ----------
    slow : tuple of Slow
    centre : {"sensors", "child", "parent"}
    extent : Extent
    """

    slow: tuple[Slow, ...]
    centre: str
    extent: Extent

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
        """The state space of a linearisation.

        Parameters
        ----------
        streams : Streams
        linearisation : Linearisation
        twists : (N, 6) array
            The child's, see :class:`~hand_eye_calib.gls.increments.Course`.
        T_parent_child : (4, 4) array
        weights : (N,) array
        cut : (n,) bool array
        prior : (p + 1, p + 1) array
        """
        to_child, intervals_s = se3.adjoint(se3.inverse(T_parent_child)), np.diff(streams.stamps_s)
        ahead, behind = self._entries(streams, linearisation, to_child)
        walk = (_TRANSLATIONS, _both_rotations(to_child))
        white = (_TRANSLATIONS[None], self._white_rotation(streams, to_child))
        return StateSpace(
            intervals_s=intervals_s,
            relative=np.clip(intervals_s / self.extent.interval_s, *_RELATIVE),
            columns=linearisation.columns,
            ahead=ahead,
            behind=behind,
            white=white,
            walk=walk,
            twists=twists,
            groups=self._groups(),
            weights=weights,
            cut=cut,
            prior=prior,
        )

    def _groups(self) -> tuple[Group, ...]:
        ends = WHITE + np.cumsum([process.size for process in self.slow], dtype=int)
        return tuple(
            Group(slice(end - process.size, end), N_FAST + 2 * k, N_FAST + 2 * k + 1)
            for k, (process, end) in enumerate(zip(self.slow, ends.tolist(), strict=True))
        )

    def _entries(
        self, streams: Streams, linearisation: Linearisation, to_child: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        ahead = [np.zeros((len(streams) - 1, 6, 0))]
        behind = [linearisation.adjoints]
        for process in self.slow:
            if process.kind == "scale":
                ahead.append(np.zeros_like(linearisation.by_scale))
                behind.append(-linearisation.by_scale)
                continue
            directions = slow_directions(process, streams, to_child)
            ahead.append(directions[1:])
            behind.append(linearisation.adjoints @ directions[:-1])
        return np.concatenate(ahead, axis=2), np.concatenate(behind, axis=2)

    def _white_rotation(self, streams: Streams, to_child: FloatArray) -> FloatArray:
        if self.centre == "sensors":
            return _both_rotations(to_child)[None]
        poses = streams.Ts_cw_c if self.centre == "child" else streams.Ts_pw_p
        swing = np.zeros((len(poses), 6, 3))
        swing[:, :3], swing[:, 3:] = se3.skew(se3.inverse(poses)[:, :3, 3]), np.eye(3)
        if self.centre == "parent":
            swing = to_child @ swing
        return swing @ np.swapaxes(swing, 1, 2)

    def sensor_white(
        self, levels: FloatArray, streams: Streams, T_parent_child: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Covariances (1 or N, 6, 6) of the white errors of parent and child, in the child's frame:
        half of both sensors', or all of the rotation noise of the one that it turns about a world's
        origin.
        """
        to_child = se3.adjoint(se3.inverse(T_parent_child))
        translation, rotation = np.exp(levels[[TRANSLATION, ROTATION]])
        half = 0.5 * translation * _TRANSLATIONS
        of_child, of_parent = half[None], (to_child @ half @ to_child.T)[None]
        if self.centre == "sensors":
            turning = 0.5 * rotation * _ROTATIONS
            return of_parent + to_child @ turning @ to_child.T, of_child + turning
        turning = rotation * self._white_rotation(streams, to_child)
        if self.centre == "child":
            return of_parent, of_child + turning
        return of_parent + turning, of_child

    def prior(self, levels: FloatArray) -> Prior:
        """What is known beforehand, for a search from these levels."""
        extent = self.extent
        total = _whole(levels)
        mean, precision = levels.copy(), np.zeros(len(levels))
        lower, upper = np.full((2, len(levels)), _LOWEST_LEVEL)
        upper[:] = _HIGHEST_LEVEL
        lower[:N_FAST] = np.log(LOWEST_VARIANCE)
        lower[:2] = np.maximum(lower[:2], total + np.log(_LEAST_WHITE))
        lower[3:5] = np.maximum(lower[3:5], total + np.log(_LEAST_WALK))
        mean[JITTER], precision[JITTER] = np.log(JITTER_VARIANCE), _JITTER_PRECISION
        lower[JITTER] = _LOWEST_LEVEL
        for group in self._groups():
            precision[group.tau] = _TAU_PRECISION
            lower[group.tau] = np.log(extent.interval_s)
            upper[group.tau] = np.log(max(_LONGEST_SHARE * extent.duration_s, extent.interval_s))
        return Prior(mean, precision, lower, upper)

    def raised(self, levels: FloatArray) -> FloatArray:
        """Log levels with no white noise and no walk so small that a search cannot hear it."""
        levels, total = levels.copy(), _whole(levels)
        levels[:2] = np.maximum(levels[:2], total + np.log(_AUDIBLE_WHITE))
        levels[3:5] = np.maximum(levels[3:5], total + np.log(_AUDIBLE_WALK))
        return levels

    def step_noise(self, levels: FloatArray) -> float:
        """Standard deviation per axis (m) of white noise and walk of a typical step."""
        return float(np.exp(0.5 * _whole(levels)[0]))

    def with_lasting(
        self, processes: Sequence[Slow], levels: FloatArray
    ) -> tuple[NoiseModel, FloatArray]:
        """The model with processes that last, and log levels to start a search at."""
        shortest = _FIRST_TAU * self.extent.interval_s
        longest = max(_LAST_TAU * self.extent.duration_s, shortest)
        first = dict(zip(PARTS, _whole(levels) + np.log(_FIRST_VARIANCE), strict=True))
        first["scale"] = np.log(_FIRST_SCALE)
        starts = [[first[each.part], 0.5 * np.log(shortest * longest)] for each in processes]
        return dataclasses.replace(self, slow=tuple(processes)), np.r_[levels, np.ravel(starts)]

    def fixed_to_body(self, levels: FloatArray) -> FloatArray:
        """Variances (6,) of the lasting errors that are fixed to the body."""
        variances = np.zeros(6)
        for process, group in zip(self.slow, self._groups(), strict=True):
            if process.kind == "body":
                variances[PARTS[process.part]] += np.exp(levels[group.variance])
        return variances

    def reduced(self, levels: FloatArray, information: FloatArray) -> tuple[NoiseModel, FloatArray]:
        """The model and log levels without the slow processes that make no difference."""
        kept = np.diag(information)[N_FAST::2] > _LEAST_INFORMATION
        slow = tuple(process for process, is_kept in zip(self.slow, kept, strict=True) if is_kept)
        left = levels[np.r_[np.ones(N_FAST, dtype=bool), np.repeat(kept, 2)]]
        return dataclasses.replace(self, slow=slow), left

    def lasting(
        self, states: FloatArray, streams: Streams, T_parent_child: FloatArray
    ) -> FloatArray:
        """The lasting part (N, 6) of the error c that states (N, d) make, in the child's frame."""
        to_child = se3.adjoint(se3.inverse(T_parent_child))
        error = np.zeros((len(states), 6))
        for process, group in zip(self.slow, self._groups(), strict=True):
            if process.kind != "scale":
                directions = slow_directions(process, streams, to_child)
                error += (directions @ states[:, group.states, None])[:, :, 0]
        return error


def slow_directions(process: Slow, streams: Streams, to_child: FloatArray) -> FloatArray:
    """Matrices (N, 6, 3) from a process to the error c."""
    part = PARTS[process.part]
    if process.kind == "body":
        return np.broadcast_to(np.eye(6)[:, part], (len(streams), 6, 3))
    return to_child[:, part] @ np.swapaxes(streams.Ts_pw_p[:, :3, :3], 1, 2)


def _both_rotations(to_child: FloatArray) -> FloatArray:
    """Rotation noise, half of it the parent's, which moves the child by the lever arm."""
    return 0.5 * (_ROTATIONS + to_child @ _ROTATIONS @ to_child.T)


def _whole(levels: FloatArray) -> FloatArray:
    """Log variances (2,) of increments of translation and rotation: white noise plus walk."""
    return np.logaddexp(levels[[3, 4]], levels[:2] + np.log(2.0))
