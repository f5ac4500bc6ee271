"""What the adaptive estimator looks at: increments of the error between two trajectories.

Errors act on the right, in each sensor's own frame: ``T_pw_p Exp(a)`` and ``T_cw_c Exp(b)``. In the
child's frame, with ``c = Ad(X^-1) a - b``,

    e_i = Log(B_i^-1 X^-1 A_i X) = c_{i+1} - Ad(B_i^-1) c_i + w_i + (I - Ad(B_i^-1)) xi

for motions A, B between poses i and i + 1, errors w of the motions themselves, and ``X Exp(-xi)``
in place of X. Systematic errors add their own columns: a scale, a bias per metre of either path, a
time offset.

The columns rest on steps free of each increment's own noise: the mean of the steps two before and
two after. Steps that share the noise of the residuals would be drawn towards it, and a child whose
steps are lost in noise would seem to shrink.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import chained
from hand_eye_calib.gls.chunks import chunks
from hand_eye_calib.stats import median

# Systematic errors and their parameters: by how much the child's lengths are short, bias per metre
# of the child's or of the parent's path along the axes of that sensor (m/m), by how much the
# child's stamps are late (s), the bias of the child's rates minus that of the parent's, along the
# axes of the child (rad/s).
_PARAMETERS: dict[str, list[int]] = {
    "none": [],
    "scale": [0],
    "bias": [1, 2, 3],
    "parent bias": [4, 5, 6],
    "time": [7],
    "rate": [8, 9, 10],
}
SYSTEMATIC = (
    "none",
    "scale",
    "bias",
    "parent bias",
    "time",
    "scale+time",
    "bias+time",
    "parent bias+time",
)
# Of streams without positions, and of those whose rotations are integrated rates.
SYSTEMATIC_OF_ROTATIONS, SYSTEMATIC_OF_RATES = ("time",), ("rate+time",)
N_SYSTEMATIC = 11

# Steps count as noise until they differ from their neighbours by so many times its variance.
_CAUTION, _LEAST_VARIANCE = 10.0, 1e-24

# Steps that vary by less than this share are alike.
_EVEN = 0.2

SCALE, TIME, RATE = 0, 7, slice(8, 11)
_CHILD_BIASES, _PARENT_BIASES, _RATES = {1, 2, 3}, {4, 5, 6}, {8, 9, 10}
DRIFT = sorted(_CHILD_BIASES | _PARENT_BIASES)


def parameters_of(systematic: str) -> list[int]:
    """Which of the parameters of all systematic errors a model has."""
    return [index for name in systematic.split("+") for index in _PARAMETERS[name]]


@dataclass(frozen=True)
class Steps:
    """Steps (n, 3) in m of a sensor, and what those around make of them.

    Attributes
    ----------
    raw : (n, 3) array
    smooth : (n, 3) array
        With the mean velocity of the steps two before and two after.
    variance : float
        Of what they differ by, as a rule.
    """

    raw: FloatArray
    smooth: FloatArray
    variance: float

    @classmethod
    def of(cls, raw: FloatArray, intervals_s: FloatArray) -> Steps:
        """From steps over these intervals."""
        rates = raw / intervals_s[:, None]
        around = np.concatenate([rates[:1], rates[:1], rates, rates[-1:], rates[-1:]])
        smooth = 0.5 * (around[:-4] + around[4:]) * intervals_s[:, None]
        return cls(raw, smooth, median((raw - smooth) ** 2))

    def cleaned(self, noise_m: float) -> FloatArray:
        """Smooth steps (n, 3), as far as what they differ by may be noise."""
        believed = max(1.0 - _CAUTION * noise_m**2 / max(self.variance, _LEAST_VARIANCE), 0.0)
        return self.smooth + believed * (self.raw - self.smooth)


@dataclass(frozen=True)
class Streams:
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

    def __len__(self) -> int:
        return len(self.stamps_s)

    @cached_property
    def typical_turn(self) -> float:
        """Median angle (rad) that the parent turns by from pose to pose."""
        return median(se3.rotation_angle(self.motions_p[:, :3, :3]))

    @cached_property
    def n_rows(self) -> int:
        """Values that an increment tells: 6, or 3 if neither sensor ever leaves its place, because
        only rotations are measured.
        """
        positions = np.concatenate([self.Ts_pw_p[:, :3, 3], self.Ts_cw_c[:, :3, 3]], axis=1)
        return 6 if np.ptp(positions, axis=0).any() else 3

    @cached_property
    def motions_p(self) -> FloatArray:
        """Motions (N - 1, 4, 4) of the parent."""
        return motions(self.Ts_pw_p)

    @cached_property
    def steps(self) -> tuple[Steps, Steps]:
        """Of parent and child."""
        by_child, intervals_s = motions(self.Ts_cw_c), np.diff(self.stamps_s)
        of_parent = Steps.of(self.motions_p[:, :3, 3], intervals_s)
        return of_parent, Steps.of(by_child[:, :3, 3].copy(), intervals_s)

    @cached_property
    def twists(self) -> FloatArray:
        """Velocity (N, 6), m/s and rad/s, of the child in its own frame."""
        return _twists(motions(self.Ts_cw_c), np.diff(self.stamps_s))

    def __getitem__(self, index: IntArray | slice) -> Streams:
        return Streams(self.stamps_s[index], self.Ts_pw_p[index], self.Ts_cw_c[index])


@dataclass(frozen=True)
class Course:
    """How the sensors move, by steps free of each increment's own noise; sums over time.

    Attributes
    ----------
    twists : (N, 6) array
        Velocity (m/s, rad/s) of the child in its own frame.
    path : (N, 3) array
        Of the child, in its world, m.
    along_c, along_p : (N, 3, 3) arrays
        Metres travelled by child and parent times the axes in which they were travelled.
    """

    twists: FloatArray
    path: FloatArray
    along_c: FloatArray
    along_p: FloatArray

    @property
    def is_uneven(self) -> bool:
        """Whether the child is not about as fast at all times."""
        metres = np.linalg.norm(np.diff(self.path, axis=0), axis=1)
        return bool(np.std(metres) > _EVEN * np.mean(metres))

    def __getitem__(self, index: IntArray | slice) -> Course:
        return Course(
            self.twists[index], self.path[index], self.along_c[index], self.along_p[index]
        )


def course_of(streams: Streams, T_parent_child: FloatArray, noise_m: float = np.inf) -> Course:
    """Course of both sensors; the child's steps are the mean of what both streams say.

    Parameters
    ----------
    streams : Streams
    T_parent_child : (4, 4) array
    noise_m : float
        Standard deviation per axis of the noise of a step. The smaller it is beside what steps
        differ from their neighbours by, the more they are believed themselves.
    """
    of_parent, of_child = streams.steps
    rotation, lever_arm = T_parent_child[:3, :3], T_parent_child[:3, 3]
    chords = streams.motions_p[:, :3, :3] @ lever_arm - lever_arm
    as_child = (chords + of_parent.raw) @ rotation
    step = Steps.of(0.5 * (of_child.raw + as_child), np.diff(streams.stamps_s)).cleaned(noise_m)
    metres_c = np.linalg.norm(of_child.cleaned(noise_m), axis=1)
    metres_p = np.linalg.norm(of_parent.cleaned(noise_m), axis=1)
    axes_c, axes_p = streams.Ts_cw_c[:-1, :3, :3], streams.Ts_pw_p[:-1, :3, :3]
    return Course(
        streams.twists,
        summed(turned(axes_c, step)),
        summed(axes_c * metres_c[:, None, None]),
        summed(axes_p * metres_p[:, None, None]),
    )


def motions(Ts_world_sensor: FloatArray) -> FloatArray:
    """Motions (N - 1, 4, 4) from each pose to the next."""
    before, moved = Ts_world_sensor[:-1], Ts_world_sensor[1:].copy()
    moved[:, :3, 3] -= before[:, :3, 3]
    moved[:, :3] = np.swapaxes(before[:, :3, :3], 1, 2) @ moved[:, :3]
    return moved


def between(Ts: FloatArray, T_parent_child: FloatArray) -> FloatArray:
    """Motions (n, 4, 4) of the parent as the child makes them, ``X^-1 A X``."""
    moved = (Ts.reshape(-1, 4) @ T_parent_child).reshape(Ts.shape)
    return se3.inverse(T_parent_child) @ moved


def turned(rotations: FloatArray, vectors: FloatArray) -> FloatArray:
    """Matrices (n, k, 3) times vectors (n, 3)."""
    return (rotations @ vectors[:, :, None])[:, :, 0]


def summed(steps: FloatArray) -> FloatArray:
    """Sums (N, ...) of the steps (N - 1, ...) up to each instant, from zero on."""
    return np.concatenate([np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)])


def _twists(by_child: FloatArray, intervals_s: FloatArray) -> FloatArray:
    """Velocities (N, 6): of the four motions around a pose the mean of the middle two, component
    by component. Jumps are no velocity.
    """
    rates = se3.log(by_child) / intervals_s[:, None]
    padded = np.pad(rates, ((2, 2), (0, 0)), mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(padded, 4, axis=0)
    first, second, third, fourth = np.moveaxis(around, 2, 0)
    lower = np.maximum(np.minimum(first, second), np.minimum(third, fourth))
    upper = np.minimum(np.maximum(first, second), np.maximum(third, fourth))
    return 0.5 * (lower + upper)


@dataclass(frozen=True)
class Linearisation:
    """Residuals and derivatives at one X.

    Attributes
    ----------
    columns : (n, 6, 6 + k + 1) array
        Derivatives by xi in ``X Exp(xi)`` and by k parameters of systematic errors; last, e.
    adjoints : (n, 6, 6) array
        Ad(B^-1).
    by_scale : (n, 6, 1) array
        Derivative by the scale.
    metres : (n,) array
        Path of the child.
    """

    columns: FloatArray
    adjoints: FloatArray
    by_scale: FloatArray
    metres: FloatArray

    @property
    def jacobian(self) -> FloatArray:
        """(n, 6, 6 + k) array: the derivatives."""
        return self.columns[:, :, :-1]

    @property
    def residuals(self) -> FloatArray:
        """(n, 6) array: e."""
        return self.columns[:, :, -1]

    def __getitem__(self, part: slice) -> Linearisation:
        return Linearisation(
            self.columns[part], self.adjoints[part], self.by_scale[part], self.metres[part]
        )

    def with_columns(self, columns: FloatArray) -> Linearisation:
        """With more derivatives (n, 6, l)."""
        parts = [self.jacobian, columns, self.columns[:, :, -1:]]
        return dataclasses.replace(self, columns=np.concatenate(parts, axis=2))


def linearise(
    streams: Streams,
    course: Course,
    T_parent_child: FloatArray,
    parameters: FloatArray,
    columns: Sequence[int] = range(N_SYSTEMATIC),
) -> Linearisation:
    """Residuals and derivatives.

    Parameters
    ----------
    streams : Streams
    course : Course
        At the same poses.
    T_parent_child : (4, 4) array
    parameters : (11,) array
        Of all systematic errors, see the module.
    columns : sequence of int
        Those whose derivatives are asked for.
    """
    n = len(streams) - 1
    found = Linearisation(
        columns=np.zeros((n, 6, 6 + len(columns) + 1)),
        adjoints=np.empty((n, 6, 6)),
        by_scale=np.zeros((n, 6, 1)),
        metres=np.empty(n),
    )
    for part in chunks(n):
        poses = slice(part.start, part.stop + 1)
        _linearise(streams[poses], course[poses], T_parent_child, parameters, columns, found[part])
    return found


def _linearise(
    streams: Streams,
    course: Course,
    T_parent_child: FloatArray,
    parameters: FloatArray,
    columns: Sequence[int],
    found: Linearisation,
) -> None:
    """Fill in the arrays of a part of the increments, whose columns and ``by_scale`` are zero."""
    used, asked = {*columns, *np.flatnonzero(parameters).tolist()}, {*columns}

    def of(kind: set[int]) -> tuple[list[int], list[int]]:
        """Columns of the parameters of a kind that are asked for, and their axes."""
        chosen = sorted(kind & asked)
        return [6 + columns.index(index) for index in chosen], [i - min(kind) for i in chosen]

    back_c = np.swapaxes(streams.Ts_cw_c[:-1, :3, :3], 1, 2)
    back_p = np.swapaxes(streams.Ts_pw_p[:-1, :3, :3], 1, 2)
    step = turned(back_c, np.diff(course.path, axis=0))

    Ts_cw_c = streams.Ts_cw_c
    if parameters[TIME]:
        Ts_cw_c = Ts_cw_c @ se3.exp(parameters[TIME] * course.twists)
    by_child, by_parent = motions(Ts_cw_c), motions(streams.Ts_pw_p)
    if used & _RATES:
        by_rate = _by_rate_bias(by_child[:, :3, :3], np.diff(streams.stamps_s))
        by_child[:, :3, :3] = by_child[:, :3, :3] @ se3.rotation_exp(-by_rate @ parameters[RATE])
    by_child[:, :3, 3] *= 1.0 + parameters[SCALE]
    if used & _CHILD_BIASES:
        metres_c = back_c @ np.diff(course.along_c, axis=0)
        by_child[:, :3, 3] -= metres_c @ parameters[1:4]
    if used & _PARENT_BIASES:
        metres_p = back_p @ np.diff(course.along_p, axis=0)
        by_parent[:, :3, 3] -= metres_p @ parameters[4:7]
    back = se3.inverse(by_child)
    adjoints = se3.adjoint(back)

    by = found.columns
    np.subtract(np.eye(6), adjoints, out=by[:, :, :6])
    found.by_scale[:, :3, 0] = -turned(back[:, :3, :3], step)
    if SCALE in asked:
        by[:, :, 6 + columns.index(SCALE)] = found.by_scale[:, :, 0]
    if asked & _CHILD_BIASES:
        at, along = of(_CHILD_BIASES)
        by[:, :3, at] = (back[:, :3, :3] @ metres_c)[:, :, along]
    if asked & _PARENT_BIASES:
        at, along = of(_PARENT_BIASES)
        axes = T_parent_child[:3, :3].T @ np.swapaxes(by_parent[:, :3, :3], 1, 2)
        by[:, :3, at] = (-axes @ metres_p)[:, :, along]
    if TIME in asked:
        late = turned(adjoints, course.twists[:-1]) - course.twists[1:]
        by[:, :, 6 + columns.index(TIME)] = late
    if asked & _RATES:
        at, along = of(_RATES)
        by[:, 3:, at] = by_rate[:, :, along]
    by[:, :, -1] = se3.log(back @ between(by_parent, T_parent_child))
    found.adjoints[:], found.metres[:] = adjoints, np.linalg.norm(step, axis=1)


def _by_rate_bias(rotations: FloatArray, intervals_s: FloatArray) -> FloatArray:
    """What a bias of the rates (rad/s) adds to the rotations (n, 3, 3) over each interval: (n, 3,
    3), the mean of the body's axes at both ends as seen at the end.
    """
    mean_axes: FloatArray = 0.5 * (np.eye(3) + np.swapaxes(rotations, 1, 2))
    return intervals_s[:, None, None] * mean_axes


def without_rate_bias(stamps_ns: IntArray, Ts_cw_c: FloatArray, bias: FloatArray) -> FloatArray:
    """Poses (N, 4, 4) at the origin, freed of a bias (3,), rad/s, of the rates they come from."""
    rotations = motions(Ts_cw_c)[:, :3, :3]
    by_rate = _by_rate_bias(rotations, np.diff(stamps_ns) * 1e-9)
    freed = chained(rotations @ se3.rotation_exp(-by_rate @ bias))
    return se3.from_rotation_translation(freed, np.zeros((len(freed), 3)))
