"""Increments of the error between two trajectories: residuals and their derivatives.

Errors act on the right, in each sensor's own frame: ``T_pw_p Exp(a)`` and ``T_cw_c Exp(b)``. In the
child's frame, with ``c = Ad(X^-1) a - b``,

    e_i = Log(B_i^-1 X^-1 A_i X) = c_{i+1} - Ad(B_i^-1) c_i + w_i + (I - Ad(B_i^-1)) xi

for motions A, B between poses i and i + 1, errors w of the motions themselves, and ``X Exp(-xi)``
in place of X. Systematic errors add their own columns: a scale, a bias per metre of the path, a
time offset.

Derivatives are taken at poses without the errors estimated so far; the residuals contain these
errors. Derivatives at noisy poses would be noise themselves if noise is not small beside the motion
from pose to pose, and would bias X (errors in variables).

The columns use steps without each increment's own noise: the mean of the steps two before and two
after. Steps with the noise of the residuals would bias the scale: a child whose steps are lost in
noise would seem to shrink.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Columns
from hand_eye_calib.core.pairing.motion_pairs import motions

# Systematic errors and their parameters: by how much the child's lengths are short, bias per metre
# of the child's path along its axes (m/m), by how much the child's stamps are late (s), the bias of
# the child's rates minus that of the parent's, along the axes of the child (rad/s).
PARAMETERS = {"scale": [0], "bias": [1, 2, 3], "time": [4], "rate": [5, 6, 7]}
(SCALE,), BIAS, (TIME,), RATE = PARAMETERS.values()
# Least variance (m^2) of steps against their neighbours: rounding.
_LEAST_VARIANCE = 1e-18
N_SYSTEMATIC = sum(map(len, PARAMETERS.values()))
SYSTEMATIC = ("scale", "bias", "time")
# What of a step may err anew: its length, and its direction.
PATH_PARTS = ("scale", "direction")
# Of streams without positions, and of those whose rotations are integrated rates.
SYSTEMATIC_OF_ROTATIONS = ("time",)
SYSTEMATIC_OF_RATES = ("time", "rate")


@dataclass(frozen=True, eq=False)
class Streams(Columns):
    """Poses of both sensors at common stamps.

    Attributes
    ----------
    stamps_s : (N,) array
        From the first on.
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
    """

    stamps_s: FloatArray
    Ts_pw_p: FloatArray
    Ts_cw_c: FloatArray

    @cached_property
    def motions_p(self) -> FloatArray:
        """Motions (N - 1, 4, 4) of the parent."""
        return motions(self.Ts_pw_p[:-1], self.Ts_pw_p[1:])

    @cached_property
    def motions_c(self) -> FloatArray:
        """Motions (N - 1, 4, 4) of the child."""
        return motions(self.Ts_cw_c[:-1], self.Ts_cw_c[1:])

    @cached_property
    def twists(self) -> FloatArray:
        """Velocity (N, 6), m/s and rad/s, of the child in its own frame.

        The mean of the middle two of the four motions around a pose, component by component: jumps
        are no velocity.
        """
        rates = se3.log(self.motions_c) / np.diff(self.stamps_s)[:, None]
        padded = np.pad(rates, ((2, 2), (0, 0)), mode="edge")
        around = np.lib.stride_tricks.sliding_window_view(padded, 4, axis=0)
        first, second, third, fourth = np.moveaxis(around, 2, 0)
        lower = np.maximum(np.minimum(first, second), np.minimum(third, fourth))
        upper = np.minimum(np.maximum(first, second), np.maximum(third, fourth))
        return 0.5 * (lower + upper)


@dataclass(frozen=True, eq=False)
class Course(Columns):
    """Motion of both sensors without each increment's own noise, summed over time.

    Attributes
    ----------
    twists : (N, 6) array
        Velocity (m/s, rad/s) of the child in its own frame.
    path : (N, 3) array
        Of the child, in its world, m.
    along : (N, 3, 3) array
        Metres travelled by the child times the axes in which they were travelled.
    """

    twists: FloatArray
    path: FloatArray
    along: FloatArray


def course_of(streams: Streams, T_parent_child: FloatArray, noise_m2: float = np.inf) -> Course:
    """Course of both sensors.

    The child's steps are the mean of both streams. A bias per metre grows with the metres that the
    parent travels, which have no bias.

    Parameters
    ----------
    streams : Streams
    T_parent_child : (4, 4) array
    noise_m2 : float
        Variance per axis up to which differences between a step and its neighbours count as
        noise. The smaller it is beside them, the less the steps are smoothed.
    """
    of_parent = streams.motions_p[:, :3, 3]
    of_child = streams.motions_c[:, :3, 3]
    rotation = T_parent_child[:3, :3]
    lever_arm = T_parent_child[:3, 3]
    chords = streams.motions_p[:, :3, :3] @ lever_arm - lever_arm
    by_parent = (chords + of_parent) @ rotation
    intervals_s = np.diff(streams.stamps_s)
    step = _cleaned(0.5 * (of_child + by_parent), intervals_s, noise_m2)
    true_step = _cleaned(by_parent, intervals_s, noise_m2)
    metres_c = np.linalg.norm(true_step, axis=1)
    axes_c = streams.Ts_cw_c[:-1, :3, :3]
    return Course(
        streams.twists,
        summed(se3.times(axes_c, step)),
        summed(axes_c * metres_c[:, None, None]),
    )


def _cleaned(steps: FloatArray, intervals_s: FloatArray, noise_m2: float) -> FloatArray:
    """Smooth steps (n, 3) towards the mean velocity of the steps two before and two after.

    Differences beyond the noise are kept.
    """
    rates = steps / intervals_s[:, None]
    around = np.concatenate([rates[:1], rates[:1], rates, rates[-1:], rates[-1:]])
    smooth = 0.5 * (around[:-4] + around[4:]) * intervals_s[:, None]
    variance = max(median((steps - smooth) ** 2), _LEAST_VARIANCE)
    believed = max(1.0 - noise_m2 / variance, 0.0)
    return smooth + believed * (steps - smooth)


def summed(steps: FloatArray) -> FloatArray:
    """Sums (N, ...) of the steps (N - 1, ...) up to each instant, from zero on."""
    return np.concatenate([np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)])


@dataclass(frozen=True)
class Linearisation:
    """Residuals and derivatives at one X.

    Attributes
    ----------
    columns : (n, 6, 6 + k + 1) array
        Derivatives by xi in ``X Exp(xi)`` and by k parameters of systematic errors; last, e.
    adjoints : (n, 6, 6) array
        Ad(B^-1).
    by_path : dict of (n, 6, k) arrays
        Derivatives by the scale, and by a rotation of the direction of travel against the child.
    """

    columns: FloatArray
    adjoints: FloatArray
    by_path: dict[str, FloatArray]


def linearise(
    streams: Streams,
    course: Course,
    T_parent_child: FloatArray,
    parameters: FloatArray,
    columns: Sequence[int] = range(N_SYSTEMATIC),
    error: FloatArray | None = None,
) -> Linearisation:
    """Residuals and derivatives.

    Parameters
    ----------
    streams : Streams
    course : Course
        At the same poses.
    T_parent_child : (4, 4) array
    parameters : (8,) array
        Of all systematic errors, see the module.
    columns : sequence of int
        Parameters whose derivatives are returned.
    error : (N, 6) array, optional
        Errors that were taken out of the poses.
    """
    back_c = np.swapaxes(streams.Ts_cw_c[:-1, :3, :3], 1, 2)
    step = se3.times(back_c, np.diff(course.path, axis=0))
    metres = back_c @ np.diff(course.along, axis=0)
    by_child, by_rate = _child_motions(streams, course, parameters, RATE[0] in columns)
    by_child[:, :3, 3] = (1.0 + parameters[SCALE]) * by_child[:, :3, 3] - metres @ parameters[BIAS]
    back = se3.inverse(by_child)
    adjoints = se3.adjoint(back)
    by_steps = np.zeros((len(step), 6, 4))
    by_bias = back[:, :3, :3] @ metres
    by_steps[:, :3] = -back[:, :3, :3] @ np.dstack([step, se3.skew(step)])
    by_path = dict(zip(PATH_PARTS, np.split(by_steps, [1], axis=2), strict=True))
    of_all = np.zeros((len(step), 6, 6 + len(columns) + 1))
    by_xi = of_all[:, :, :6]
    residuals = of_all[:, :, -1]
    np.subtract(np.eye(6), adjoints, out=by_xi)
    for k, column in enumerate(columns, start=6):
        if column == SCALE:
            of_all[:, :, k] = by_steps[:, :, 0]
        elif column == TIME:
            of_all[:, :, k] = se3.times(adjoints, course.twists[:-1]) - course.twists[1:]
        elif column in BIAS:
            of_all[:, :3, k] = by_bias[:, :, BIAS.index(column)]
        else:
            of_all[:, 3:, k] = by_rate[:, :, RATE.index(column)]
    moved = (streams.motions_p.reshape(-1, 4) @ T_parent_child).reshape(by_child.shape)
    residuals[:] = se3.log(back @ (se3.inverse(T_parent_child) @ moved))
    if error is not None:
        residuals += error[1:] - se3.times(adjoints, error[:-1])
    return Linearisation(of_all, adjoints, by_path)


def _child_motions(
    streams: Streams, course: Course, parameters: FloatArray, has_rates: bool
) -> tuple[FloatArray, FloatArray]:
    """Motions (n, 4, 4) of the child without its time offset and bias of rates, and derivatives.

    The derivatives (n, 3, 3) of their rotations by the bias are empty if there are no rates.
    """
    Ts_cw_c = streams.Ts_cw_c
    by_rate = np.empty(0)
    if parameters[TIME]:
        Ts_cw_c = Ts_cw_c @ se3.exp(parameters[TIME] * course.twists)
    child_motions = motions(Ts_cw_c[:-1], Ts_cw_c[1:])
    if has_rates:
        by_rate = _by_rate_bias(child_motions[:, :3, :3], np.diff(streams.stamps_s))
        corrections = se3.rotation_exp(-by_rate @ parameters[RATE])
        child_motions[:, :3, :3] = child_motions[:, :3, :3] @ corrections
    return child_motions, by_rate


def _by_rate_bias(rotations: FloatArray, intervals_s: FloatArray) -> FloatArray:
    """Derivatives (n, 3, 3) of rotations (n, 3, 3) over each interval by a bias of rates (rad/s).

    The mean of the body's axes at both ends, in the frame of the end.
    """
    mean_axes: FloatArray = 0.5 * (np.eye(3) + np.swapaxes(rotations, 1, 2))
    return intervals_s[:, None, None] * mean_axes


def without_rate_bias(stamps_ns: IntArray, Ts_cw_c: FloatArray, bias: FloatArray) -> FloatArray:
    """Poses (N, 4, 4) at the origin, freed of a bias (3,), rad/s, of the rates they come from."""
    rotations = motions(Ts_cw_c[:-1], Ts_cw_c[1:])[:, :3, :3]
    by_rate = _by_rate_bias(rotations, np.diff(stamps_ns) * 1e-9)
    freed = se3.chained(rotations @ se3.rotation_exp(-by_rate @ bias))
    return se3.from_rotation_translation(freed, np.zeros((len(freed), 3)))
