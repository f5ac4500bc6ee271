"""Increments of the error between two trajectories: residuals and their derivatives.

Errors act on the right, in each sensor's own frame: ``T_pw_p Exp(a)`` and ``T_cw_c Exp(b)``. The
common error in the child's frame is ``c = Ad(X^-1) a - b``. For the motions A, B between poses i
and i + 1, errors w of the motions themselves, and ``X Exp(-xi)`` in place of X,

    e_i = Log(B_i^-1 X^-1 A_i X) = c_{i+1} - Ad(B_i^-1) c_i + w_i + (I - Ad(B_i^-1)) xi

to first order. Systematic errors add columns of their own: a scale, a bias per metre of the path, a
time offset, a bias of rates.

Derivatives are taken at poses without the errors estimated so far; the residuals contain these
errors. Derivatives at noisy poses would be noisy themselves if noise is not much smaller than the
motion from pose to pose, and would bias X (errors in variables).

The columns use steps without each increment's own noise: the mean of the steps two before and two
after. Steps with the noise of the residuals would bias the scale: a child whose steps are smaller
than their noise would seem to shrink.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Columns
from hand_eye_calib.core.noise.normal import transposed
from hand_eye_calib.core.pairing.motion_pairs import motions

# Columns of the parameters of each systematic error:
# - scale: share by which the child's lengths are short;
# - bias: error per metre of the child's path, along the axes of the child (m/m);
# - time: by how much the child's stamps are late (s);
# - rate: bias of the child's rates minus bias of the parent's, along the child's axes (rad/s).
PARAMETERS = {"scale": [0], "bias": [1, 2, 3], "time": [4], "rate": [5, 6, 7]}
(SCALE,), BIAS, (TIME,), RATE = PARAMETERS.values()
N_SYSTEMATIC = sum(map(len, PARAMETERS.values()))

# Systematic errors of poses, of rotations, and of rotations that are integrated rates.
SYSTEMATIC = ("scale", "bias", "time")
SYSTEMATIC_OF_ROTATIONS = ("time",)
SYSTEMATIC_OF_RATES = ("time", "rate")

# Parts of a step that may drift: its length and its direction.
PATH_PARTS = ("scale", "direction")

# Smallest variance (m^2) of steps against their neighbours. Smaller ones are rounding.
_ROUNDING_M2 = 1e-18


def parameter_columns(names: Iterable[str]) -> list[int]:
    """Return the columns of the parameters of some systematic errors."""
    columns = []
    for name in names:
        columns += PARAMETERS[name]
    return columns


@dataclass(frozen=True, eq=False)
class Streams(Columns):
    """Poses of both sensors at common stamps.

    Attributes
    ----------
    stamps_s : (N,) array
        Since the first stamp.
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
    """

    stamps_s: FloatArray
    Ts_pw_p: FloatArray
    Ts_cw_c: FloatArray

    @cached_property
    def motions_p(self) -> FloatArray:
        """Motions A (N - 1, 4, 4) of the parent."""
        return motions(self.Ts_pw_p[:-1], self.Ts_pw_p[1:])

    @cached_property
    def motions_c(self) -> FloatArray:
        """Motions B (N - 1, 4, 4) of the child."""
        return motions(self.Ts_cw_c[:-1], self.Ts_cw_c[1:])

    @cached_property
    def twists(self) -> FloatArray:
        """Velocity (N, 6), m/s and rad/s, of the child in its own frame.

        It is the mean of the middle two of the four motions nearest to a pose, component by
        component. So a jump does not count as velocity.
        """
        rates = se3.log(self.motions_c) / np.diff(self.stamps_s)[:, None]
        padded = np.pad(rates, ((2, 2), (0, 0)), mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, 4, axis=0)
        first, second, third, fourth = np.moveaxis(windows, 2, 0)
        lower = np.maximum(np.minimum(first, second), np.minimum(third, fourth))
        upper = np.minimum(np.maximum(first, second), np.maximum(third, fourth))
        return 0.5 * (lower + upper)


@dataclass(frozen=True, eq=False)
class Course(Columns):
    """Motion of the child without each increment's own noise, summed over time.

    Attributes
    ----------
    twists : (N, 6) array
        Velocity (m/s, rad/s) of the child in its own frame.
    path : (N, 3) array
        Position (m) of the child in its world, from the first pose on.
    along : (N, 3, 3) array
        Sum of the metres travelled by the child times the axes of the child in its world.
    """

    twists: FloatArray
    path: FloatArray
    along: FloatArray


def course_of(streams: Streams, T_parent_child: FloatArray, noise_m2: float = np.inf) -> Course:
    """Smooth the motion of the child.

    The child's steps are the mean of both streams. The metres travelled come from the
    parent's stream, which has no bias per metre.

    Parameters
    ----------
    streams : Streams
    T_parent_child : (4, 4) array
    noise_m2 : float
        Variance per axis up to which differences between a step and its neighbours count as
        noise. The larger the differences, the less the steps are smoothed.
    """
    R = se3.rotation_of(T_parent_child)
    lever_arm = se3.translation_of(T_parent_child)
    by_child = se3.translation_of(streams.motions_c)
    chords = se3.rotation_of(streams.motions_p) @ lever_arm - lever_arm
    by_parent = (chords + se3.translation_of(streams.motions_p)) @ R
    intervals_s = np.diff(streams.stamps_s)
    steps = _smoothed(0.5 * (by_child + by_parent), intervals_s, noise_m2)
    metres = np.linalg.norm(_smoothed(by_parent, intervals_s, noise_m2), axis=1)
    axes_c = streams.Ts_cw_c[:-1, :3, :3]
    return Course(
        streams.twists,
        summed(se3.times(axes_c, steps)),
        summed(axes_c * metres[:, None, None]),
    )


def _smoothed(steps: FloatArray, intervals_s: FloatArray, noise_m2: float) -> FloatArray:
    """Smooth steps (n, 3) towards the mean velocity of the steps two before and two after.

    Differences from this mean are kept by the share of their variance that is not noise.
    """
    rates = steps / intervals_s[:, None]
    padded = np.concatenate([rates[:1], rates[:1], rates, rates[-1:], rates[-1:]])
    smooth = 0.5 * (padded[:-4] + padded[4:]) * intervals_s[:, None]
    variance = max(median((steps - smooth) ** 2), _ROUNDING_M2)
    share = max(1.0 - noise_m2 / variance, 0.0)
    return smooth + share * (steps - smooth)


def summed(steps: FloatArray) -> FloatArray:
    """Return the sums (N, ...) of the steps (N - 1, ...) up to each instant, from zero on."""
    return np.concatenate([np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)])


@dataclass(frozen=True)
class Linearisation:
    """Residuals and derivatives at one X.

    Attributes
    ----------
    columns : (n, 6, 6 + k + 1) array
        Derivatives of e with respect to xi in ``X Exp(xi)`` and to k parameters of systematic
        errors; last, e.
    adjoints : (n, 6, 6) array
        Ad(B^-1).
    by_path : dict of (n, 6, k) arrays
        Derivatives with respect to the scale, and to a rotation of the direction of travel against
        the child.
    """

    columns: FloatArray
    adjoints: FloatArray
    by_path: dict[str, FloatArray]

    @property
    def residuals(self) -> FloatArray:
        """Residuals e (n, 6)."""
        return self.columns[:, :, -1]


def linearise(
    streams: Streams,
    course: Course,
    T_parent_child: FloatArray,
    parameters: FloatArray,
    columns: list[int],
    error: FloatArray | None = None,
) -> Linearisation:
    """Compute residuals and derivatives.

    Parameters
    ----------
    streams : Streams
    course : Course
        At the same poses.
    T_parent_child : (4, 4) array
        X.
    parameters : (8,) array
        Of all systematic errors, see :data:`PARAMETERS`.
    columns : sequence of int
        Parameters whose derivatives are returned.
    error : (N, 6) array, optional
        Errors c that were taken out of the poses.
    """
    R_c_transposed = transposed(streams.Ts_cw_c[:-1, :3, :3])
    steps = se3.times(R_c_transposed, np.diff(course.path, axis=0))
    metres = R_c_transposed @ np.diff(course.along, axis=0)
    B, by_rate = _child_motions(streams, course, parameters)
    B[:, :3, 3] = (1.0 + parameters[SCALE]) * se3.translation_of(B) - metres @ parameters[BIAS]
    B_inverse = se3.inverse(B)
    R_B_transposed = se3.rotation_of(B_inverse)
    adjoints = se3.adjoint(B_inverse)
    by_steps = np.zeros((len(steps), 6, 4))
    by_steps[:, :3] = -R_B_transposed @ np.dstack([steps, se3.skew(steps)])
    A_X = (streams.motions_p.reshape(-1, 4) @ T_parent_child).reshape(B.shape)
    residuals = se3.log(B_inverse @ (se3.inverse(T_parent_child) @ A_X))
    if error is not None:
        residuals += error[1:] - se3.times(adjoints, error[:-1])
    systematic = np.zeros((len(steps), 6, N_SYSTEMATIC))
    systematic[:, :, SCALE] = by_steps[:, :, 0]
    systematic[:, :3, BIAS] = R_B_transposed @ metres
    systematic[:, :, TIME] = se3.times(adjoints, course.twists[:-1]) - course.twists[1:]
    systematic[:, 3:, RATE] = by_rate
    by_xi = np.eye(6) - adjoints
    all_columns = np.concatenate([by_xi, systematic[:, :, columns], residuals[:, :, None]], axis=2)
    by_path = {"scale": by_steps[:, :, :1], "direction": by_steps[:, :, 1:]}
    return Linearisation(all_columns, adjoints, by_path)


def _child_motions(
    streams: Streams, course: Course, parameters: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Compute motions of the child without its time offset and bias of rates.

    Returns
    -------
    (n, 4, 4) array
        Motions.
    (n, 3, 3) array
        Derivatives of their rotations with respect to the bias of rates.
    """
    Ts_cw_c = streams.Ts_cw_c
    if parameters[TIME]:
        Ts_cw_c = Ts_cw_c @ se3.exp(parameters[TIME] * course.twists)
    child_motions = motions(Ts_cw_c[:-1], Ts_cw_c[1:])
    rotations = se3.rotation_of(child_motions)
    by_rate = _derivatives_by_rate_bias(rotations, np.diff(streams.stamps_s))
    if parameters[RATE].any():
        child_motions[:, :3, :3] = rotations @ se3.rotation_exp(-by_rate @ parameters[RATE])
    return child_motions, by_rate


def _derivatives_by_rate_bias(rotations: FloatArray, intervals_s: FloatArray) -> FloatArray:
    """Derivatives (n, 3, 3) of rotations (n, 3, 3) over each interval.

    The derivatives are with respect to a bias of rates (rad/s): the interval times
    the mean of the body's axes at both ends, in the frame of the end.
    """
    mean_axes: FloatArray = 0.5 * (np.eye(3) + transposed(rotations))
    return intervals_s[:, None, None] * mean_axes


def without_rate_bias(stamps_ns: IntArray, Ts_cw_c: FloatArray, bias: FloatArray) -> FloatArray:
    """Integrate rotations anew without a bias (3,), rad/s, of their rates.

    Returns
    -------
    (N, 4, 4) array
        Poses at the origin, from the identity on.
    """
    child_motions = motions(Ts_cw_c[:-1], Ts_cw_c[1:])
    rotations = se3.rotation_of(child_motions)
    intervals_s = np.diff(stamps_ns) * 1e-9
    by_rate = _derivatives_by_rate_bias(rotations, intervals_s)
    corrections = se3.rotation_exp(-by_rate @ bias)
    integrated = se3.chained(rotations @ corrections)
    return se3.from_rotation_translation(integrated, np.zeros((len(integrated), 3)))
