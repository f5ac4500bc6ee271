"""Residuals of increments between poses, and their derivatives.

The errors a of the parent and b of the child act on the right, in each sensor's own frame: the
measured poses are ``T_pw_p Exp(a)`` and ``T_cw_c Exp(b)``. Their common error in the child's frame
is ``c = Ad(X^-1) a - b``. A_i and B_i are the measured motions of parent and child from pose i to
pose i + 1, w_i is the error of the motions themselves, and X is the present estimate, so that
``X Exp(xi)`` is the true extrinsic. To first order,

    e_i = Log(B_i^-1 X^-1 A_i X)
    e_i + (I - Ad(B_i^-1)) xi = c_{i+1} - Ad(B_i^-1) c_i + w_i

The derivative of e_i with respect to xi is the factor of xi. The derivatives with respect to the
systematic errors follow: a scale, a bias per metre of path, a time offset, a bias of angular rates.

Derivatives are computed at poses from which the estimated errors were removed. Derivatives at noisy
poses would bias X if the noise is not much smaller than the motion from pose to pose (errors in
variables). The residuals are those of the measured poses, so these errors are added back.

For the same reason, the derivatives with respect to scale and bias use smoothed steps of the child.
A smoothed step contains only a small part of the noise of its own residual. Otherwise the scale
would be underestimated if steps are smaller than their noise.
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
from hand_eye_calib.core.noise.partwise import MAX_POSES
from hand_eye_calib.core.pairing.motion_pairs import motions

# Indices of the parameters of each systematic error:
# - scale: the child's lengths must be multiplied by 1 + scale;
# - bias: error per metre of the child's path, along the axes of the child (m/m);
# - time: delay of the child's stamps (s); positive if they are late;
# - rate: bias of the child's angular rates minus bias of the parent's, along the child's axes
#   (rad/s).
PARAMETERS = {"scale": [0], "bias": [1, 2, 3], "time": [4], "rate": [5, 6, 7]}
(SCALE,), BIAS, (TIME,), RATE = PARAMETERS.values()
N_SYSTEMATIC = sum(map(len, PARAMETERS.values()))

# Systematic errors in the model: for poses, for rotations, and for integrated angular rates.
SYSTEMATIC = ("scale", "bias", "time")
SYSTEMATIC_OF_ROTATIONS = ("time",)
SYSTEMATIC_OF_RATES = ("time", "rate")

# Parts of the child's step that may drift: its length (scale) and its direction.
PATH_PARTS = ("scale", "direction")

# Lower bound of the median square (m^2) of the differences between steps and their neighbours. A
# smaller value is rounding.
_ROUNDING_M2 = 1e-18


def parameter_columns(names: Iterable[str]) -> list[int]:
    """Return the indices of the parameters of the named systematic errors, see PARAMETERS."""
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
        Seconds since the first stamp.
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
        Poses of parent and child in their own worlds.
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

        Each component is the median over the four motions nearest to the pose. So a jump does not
        count as velocity.
        """
        rates = se3.log(self.motions_c) / np.diff(self.stamps_s)[:, None]
        padded = np.pad(rates, ((2, 2), (0, 0)), mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, 4, axis=0)
        # Median of four numbers. np.median would import numpy.ma, which takes 7 ms.
        return np.sort(windows, axis=2)[:, :, 1:3].mean(axis=2)


@dataclass(frozen=True, eq=False)
class Course(Columns):
    """Smoothed motion of the child, for derivatives with respect to systematic errors.

    The path and the products are sums over time: their difference between two poses belongs to the
    increment between these poses.

    Attributes
    ----------
    twists : (N, 6) array
        Velocity (m/s, rad/s) of the child in its own frame.
    path : (N, 3) array
        Smoothed position (m) of the child in its world, relative to the first pose.
    along : (N, 3, 3) array
        Sum, over all steps before the pose, of the length of the step (m) times the orientation of
        the child. A bias per metre times this sum is the error of the position.
    """

    twists: FloatArray
    path: FloatArray
    along: FloatArray


def course_of(
    streams: Streams, T_parent_child: FloatArray, noise_m2: float = np.inf
) -> Course:
    """Smooth the motion of the child.

    A smoothed step is the mean of the child's steps from both streams. Its length comes from the
    parent's stream, which has no bias per metre.

    Parameters
    ----------
    streams : Streams
    T_parent_child : (4, 4) array
        X.
    noise_m2 : float
        Noise variance of a step per axis. If the median square of the differences between steps and
        their neighbours is at most this variance, the differences are removed. They hardly change
        if it is far larger. ``inf`` removes them.
    """
    R = se3.rotation_of(T_parent_child)
    lever_arm = se3.translation_of(T_parent_child)
    steps_by_child = se3.translation_of(streams.motions_c)
    # Translation of A_i X relative to X, in the child's axes.
    rotated = se3.rotation_of(streams.motions_p) @ lever_arm - lever_arm
    steps_by_parent = (rotated + se3.translation_of(streams.motions_p)) @ R
    intervals_s = np.diff(streams.stamps_s)
    steps = _smooth_steps(
        0.5 * (steps_by_child + steps_by_parent), intervals_s, noise_m2
    )
    metres = np.linalg.norm(
        _smooth_steps(steps_by_parent, intervals_s, noise_m2), axis=1
    )
    rotations_c = streams.Ts_cw_c[:-1, :3, :3]
    return Course(
        streams.twists,
        cumulative_sum(se3.times(rotations_c, steps)),
        cumulative_sum(rotations_c * metres[:, None, None]),
    )


def _smooth_steps(
    steps: FloatArray, intervals_s: FloatArray, noise_m2: float
) -> FloatArray:
    """Move each step i (n, 3) towards the step with the mean velocity of steps i - 2, i + 2.

    Only a share of the difference between the step and this mean is kept. The share is
    ``1 - noise_m2 / m``, at least 0, with the median square m of all differences.
    """
    velocities = steps / intervals_s[:, None]
    padded = np.pad(velocities, ((2, 2), (0, 0)), mode="edge")
    smooth = 0.5 * (padded[:-4] + padded[4:]) * intervals_s[:, None]
    differences = steps - smooth
    median_square = max(median(differences**2), _ROUNDING_M2)
    share = max(1.0 - noise_m2 / median_square, 0.0)
    return smooth + share * differences


def cumulative_sum(steps: FloatArray) -> FloatArray:
    """Return the sums (N, ...) of the steps (N - 1, ...) before each instant, from zero."""
    return np.concatenate(
        [np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)]
    )


@dataclass(frozen=True)
class Linearisation:
    """Residuals e and their derivatives at a given X.

    Attributes
    ----------
    columns : (n, 6, 6 + k + 1) array
        Derivatives of e with respect to xi in ``X Exp(xi)`` and to k parameters of systematic
        errors; the last column is e.
    adjoints : (n, 6, 6) array
        Ad(B_i^-1).
    by_path : dict of str to array
        Derivatives of e with respect to drifting errors of the path: "scale" (n, 6, 1) and
        "direction" (n, 6, 3). A direction error is a rotation vector (rad) in the child's frame;
        the step is rotated by its negative.
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
    """Compute residuals e and their derivatives.

    Parameters
    ----------
    streams : Streams
    course : Course
        Smoothed motion at the same poses.
    T_parent_child : (4, 4) array
        X.
    parameters : (8,) array
        Current values of all systematic errors, see :data:`PARAMETERS`.
    columns : list of int
        Indices of the systematic errors with derivatives in the result.
    error : (N, 6) array, optional
        Errors c that were removed from the poses; they are added to the residuals.
    """
    R_c_transposed = transposed(streams.Ts_cw_c[:-1, :3, :3])
    # Smoothed steps in the child's frame, and the derivatives with respect to a bias per metre.
    steps = se3.times(R_c_transposed, np.diff(course.path, axis=0))
    metres = R_c_transposed @ np.diff(course.along, axis=0)
    B = _child_motions(streams, course, parameters)
    scaled = (1.0 + parameters[SCALE]) * se3.translation_of(B)
    B[:, :3, 3] = scaled - metres @ parameters[BIAS]
    B_inverse = se3.inverse(B)
    R_B_transposed = se3.rotation_of(B_inverse)
    adjoints = se3.adjoint(B_inverse)
    A_X = (streams.motions_p.reshape(-1, 4) @ T_parent_child).reshape(B.shape)
    motions_by_parent = se3.inverse(T_parent_child) @ A_X
    residuals = se3.log(B_inverse @ motions_by_parent)
    if error is not None:
        residuals += error[1:] - se3.times(adjoints, error[:-1])
    scale_and_direction = np.dstack([steps, se3.skew(steps)])
    by_steps = np.zeros((len(steps), 6, 4))
    by_steps[:, :3] = -R_B_transposed @ scale_and_direction
    systematic = np.zeros((len(steps), 6, N_SYSTEMATIC))
    systematic[:, :, SCALE] = by_steps[:, :, 0]
    systematic[:, :3, BIAS] = R_B_transposed @ metres
    systematic[:, :, TIME] = (
        se3.times(adjoints, course.twists[:-1]) - course.twists[1:]
    )
    if not set(columns).isdisjoint(RATE):
        systematic[:, 3:, RATE] = _derivatives_by_rate_bias(
            transposed(R_B_transposed), np.diff(streams.stamps_s)
        )
    all_columns = np.empty((len(steps), 6, 7 + len(columns)))
    all_columns[:, :, :6] = np.eye(6) - adjoints
    all_columns[:, :, 6:-1] = systematic[:, :, columns]
    all_columns[:, :, -1] = residuals
    by_path = {"scale": by_steps[:, :, :1], "direction": by_steps[:, :, 1:]}
    return Linearisation(all_columns, adjoints, by_path)


def first_residuals(
    streams: Streams, course: Course, T_parent_child: FloatArray
) -> FloatArray:
    """Return the residuals e (n, 6) of :func:`linearise` without systematic errors."""
    residuals = []
    # Batches limit the memory.
    for start in range(0, len(streams) - 1, MAX_POSES):
        poses = slice(start, start + MAX_POSES + 1)
        parameters = np.zeros(N_SYSTEMATIC)
        part = linearise(
            streams[poses], course[poses], T_parent_child, parameters, []
        )
        residuals.append(part.residuals)
    return np.concatenate(residuals)


def _child_motions(
    streams: Streams, course: Course, parameters: FloatArray
) -> FloatArray:
    """Return motions (n, 4, 4) of the child, corrected for its time offset and bias of rates."""
    if parameters[TIME]:
        Ts_cw_c = streams.Ts_cw_c @ se3.exp(parameters[TIME] * course.twists)
        child_motions = motions(Ts_cw_c[:-1], Ts_cw_c[1:])
    else:
        child_motions = streams.motions_c.copy()
    if parameters[RATE].any():
        rotations = se3.rotation_of(child_motions)
        by_rate = _derivatives_by_rate_bias(
            rotations, np.diff(streams.stamps_s)
        )
        child_motions[:, :3, :3] = rotations @ se3.rotation_exp(
            -by_rate @ parameters[RATE]
        )
    return child_motions


def _derivatives_by_rate_bias(
    rotations: FloatArray, intervals_s: FloatArray
) -> FloatArray:
    """Return derivatives (n, 3, 3), in s, of rotations (n, 3, 3) with respect to a bias of rates.

    The axes of the body turn during an interval. To first order, a constant bias (rad/s) along them
    rotates the end of the interval by its duration times the mean of the axes at start and end, in
    the frame of the end.
    """
    mean_axes: FloatArray = 0.5 * (np.eye(3) + transposed(rotations))
    return intervals_s[:, None, None] * mean_axes


def without_rate_bias(
    stamps_ns: IntArray, Ts_cw_c: FloatArray, bias: FloatArray
) -> FloatArray:
    """Remove a bias (3,), rad/s, of angular rates from rotations integrated from the rates.

    Returns
    -------
    (N, 4, 4) array
        Poses with corrected rotations relative to the first pose, and zero translations.
    """
    child_motions = motions(Ts_cw_c[:-1], Ts_cw_c[1:])
    rotations = se3.rotation_of(child_motions)
    intervals_s = np.diff(stamps_ns) * 1e-9
    by_rate = _derivatives_by_rate_bias(rotations, intervals_s)
    corrections = se3.rotation_exp(-by_rate @ bias)
    integrated = se3.chained(rotations @ corrections)
    return se3.from_rotation_translation(
        integrated, np.zeros((len(integrated), 3))
    )
