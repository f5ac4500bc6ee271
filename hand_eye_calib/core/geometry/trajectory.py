"""Trajectories: stamped poses of one sensor in a fixed frame of its own."""

from dataclasses import dataclass, fields
from functools import cached_property
from os import PathLike
from typing import Any, ClassVar, Protocol, Self, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.registry import MEASURES
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.geometry import se3

# A quaternion further from unit length than this is wrong and not just rounded (tf2 has the same
# bound).
QUATERNION_NORM_TOLERANCE = 1e-2

# A position (m) is never so large, not even from the Earth's centre in millimetres.
FARTHEST_M = 1e10

# Tolerance for rotation matrices: a file with six digits passes, a scaled matrix does not.
ROTATION_TOLERANCE = 1e-3

# Intervals on either side of one that tell motion from noise, and poses before and after a stamp
# that interpolation looks at.
_NEARBY = 4
REACH = _NEARBY + 2

# Directions of steps that are this share of the extent of the positions are compared, of a fifth of
# that number at least.
_STEPS_IN_EXTENT = 50

# In a wrong convention the direction scatters at least so much, and so many times as much as in the
# right one.
STEADY = 0.05
CLEARLY = 4.0

# Of white noise: covariance of neighbouring changes over their variance, and variance of the mean
# of two of them over theirs.
_CORRELATION = -2.0 / 3.0
_LEFT_IN_THE_MEAN = 1.0 / 6.0


def scatter_of_direction(poses: FloatArray) -> float:
    """How much the direction of a sensor's motion scatters in its own axes: 0 if it is always the
    same, as on vehicles, 1 if it goes everywhere, or if there are too few steps.
    """
    positions = poses[:, :3, 3]
    rotations = poses[:, :3, :3]
    step = float(np.linalg.norm(np.ptp(positions, axis=0))) / _STEPS_IN_EXTENT
    travelled = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))]
    rows = np.flatnonzero(np.diff(np.floor(travelled / (step or np.inf)), prepend=-1.0))
    steps = np.diff(positions[rows], axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    # Of a sensor that stands still, the noise of the positions adds up to a path.
    is_step = lengths > step / 3
    if is_step.sum() < _STEPS_IN_EXTENT / 5:
        return 1.0
    directions = steps[is_step] / lengths[is_step, None]
    in_sensor = np.einsum("nji,nj->ni", rotations[rows[:-1][is_step]], directions)
    return 1.0 - float(np.linalg.norm(in_sensor.mean(axis=0)))


# Poses (m and entries of rotations) this close are the same, to rounding.
_SAME_POSE = 1e-6

# Range of stamps (ns).
_FIRST_NS = int(np.iinfo(np.int64).min)
_LAST_NS = int(np.iinfo(np.int64).max)


@dataclass(frozen=True, eq=False)
class WithArrays:
    """Base of dataclasses with ``eq=False``: equal if all fields are, arrays as a whole."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self)) and all(map(_equal, self.columns, other.columns))

    @property
    def columns(self) -> tuple[Any, ...]:
        """The values of the fields, in their order."""
        return tuple(getattr(self, each.name) for each in fields(self))


def _equal(one: Any, other: Any) -> bool:
    return np.array_equal(one, other) if isinstance(one, np.ndarray) else one == other


class Columns(WithArrays):
    """Base of dataclasses whose arrays, of which the first field is one, have as many rows each."""

    def __len__(self) -> int:
        return len(self.columns[0])

    def __getitem__(self, index: slice | NDArray[Any]) -> Self:
        """Some of the rows: a slice, mask or index array."""
        parts = (x[index] if isinstance(x, np.ndarray) else x for x in self.columns)
        return type(self)(*parts)

    @classmethod
    def concatenate(cls, *parts: Self) -> Self:
        """The rows of all parts in the given order."""
        return cls(*map(np.concatenate, zip(*(each.columns for each in parts), strict=True)))


@dataclass(frozen=True, eq=False)
class Trajectory(Columns):
    """Stamped poses of a sensor, in strictly increasing order of time.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
        Stamps in nanoseconds, strictly increasing.
    poses : (N, 4, 4) float64 array
        ``Ts_world_sensor``: poses of the sensor in its own world (odometry) frame, metres.
    sensor_frame : str
        Name of the moving frame; empty if unknown.
    world_frame : str
        Name of the fixed frame; empty if unknown.
    measures : {"poses", "positions", "rotations", "rates"}
        What the sensor measures of its poses. The orientations of positions and the positions of
        rotations mean nothing; rates are rotations that were integrated, with a bias.

    Raises
    ------
    InputError
        If shapes, stamps or poses are unusable; the message names the first such pose.

    Examples
    --------
    >>> stamps_ns = np.array([0, 100_000_000])
    >>> hec.Trajectory(stamps_ns, np.repeat(np.eye(4)[None], 2, axis=0), "lidar")
    Trajectory(2 poses over 0.100 s, sensor_frame='lidar')
    """

    stamps_ns: IntArray
    poses: FloatArray
    sensor_frame: str = ""
    world_frame: str = ""
    measures: str = "poses"

    # One that has the same bends: this one is it at another time.
    _alike: ClassVar[Self | None] = None

    def __post_init__(self) -> None:
        stamps_ns = np.ascontiguousarray(self.stamps_ns)
        poses = np.ascontiguousarray(self.poses, dtype=float)
        if stamps_ns.ndim != 1 or not np.issubdtype(stamps_ns.dtype, np.integer):
            raise InputError(
                "stamps_ns must be one-dimensional integers (nanoseconds); "
                f"found shape {stamps_ns.shape} of {stamps_ns.dtype}"
            )
        if poses.shape != (len(stamps_ns), 4, 4):
            raise InputError(
                f"poses must have shape ({len(stamps_ns)}, 4, 4), one per stamp; "
                f"found {poses.shape}"
            )
        if self.measures not in MEASURES:
            raise InputError(
                f"measures must be one of {', '.join(MEASURES)}; got {self.measures!r}"
            )
        stamps_ns = stamps_ns.astype(np.int64, copy=False)
        backwards = np.flatnonzero(np.diff(stamps_ns) <= 0)
        if backwards.size:
            index = int(backwards[0]) + 1
            raise InputError(
                f"stamps must increase: pose {index} has stamp {stamps_ns[index]} ns "
                f"after {stamps_ns[index - 1]} ns; sort the poses and drop repeated stamps"
            )
        check_poses(poses)
        object.__setattr__(self, "stamps_ns", stamps_ns)
        object.__setattr__(self, "poses", poses)

    @classmethod
    def from_quat_xyzw(
        cls,
        stamps_ns: IntArray,
        translations: ArrayLike,
        quats_xyzw: ArrayLike,
        sensor_frame: str = "",
        world_frame: str = "",
    ) -> Self:
        """Build from translations (N, 3), m, and quaternions (N, 4), scalar last.

        Raises
        ------
        InputError
            If a value is not finite or a quaternion is more than 1 % away from unit length.
        """
        translations = np.asarray(translations, dtype=float).reshape(-1, 3)
        quats_xyzw = np.asarray(quats_xyzw, dtype=float).reshape(-1, 4)
        _check_finite("pose", np.concatenate([translations, quats_xyzw], axis=1))
        norms = np.linalg.norm(quats_xyzw, axis=1)
        wrong = np.abs(norms - 1.0) > QUATERNION_NORM_TOLERANCE
        if wrong.any():
            index = int(np.argmax(wrong))
            raise InputError(
                f"pose {index} has a quaternion of length {norms[index]:.4g}, "
                f"expected 1 within {QUATERNION_NORM_TOLERANCE}; "
                "check the column order (x y z qx qy qz qw)"
            )
        poses = se3.from_quat_xyzw(translations, quats_xyzw)
        return cls(stamps_ns, poses, sensor_frame, world_frame)

    @classmethod
    def from_positions(
        cls,
        stamps_ns: IntArray,
        positions: ArrayLike,
        sensor_frame: str = "",
        world_frame: str = "",
    ) -> Self:
        """Build from positions (N, 3), m, of a sensor that has no orientation: the antenna of a
        GNSS receiver, the prism of a total station.
        """
        poses = se3.from_rotation_translation(np.eye(3), np.reshape(positions, (-1, 3)))
        return cls(stamps_ns, poses, sensor_frame, world_frame, "positions")

    @classmethod
    def from_rates(cls, stamps_ns: IntArray, rates: ArrayLike, sensor_frame: str = "") -> Self:
        """Build from angular rates (N, 3), rad/s, about the sensor's own axes, as a gyroscope
        measures them.

        Raises
        ------
        InputError
            If a rate is not finite or the stamps do not increase.
        """
        rates = np.asarray(rates, dtype=float).reshape(-1, 3)
        _check_finite("rate", rates)
        from hand_eye_calib.core.geometry.rates import RateIntegrator

        rotations = RateIntegrator().rotations(np.asarray(stamps_ns), rates)
        poses = se3.from_rotation_translation(rotations, np.zeros_like(rates))
        return cls(stamps_ns, poses, sensor_frame, "", "rates")

    def __repr__(self) -> str:
        text = f"{len(self)} {self.measures} over {self.duration_s:.3f} s"
        for name in ("sensor_frame", "world_frame"):
            text += f", {name}={getattr(self, name)!r}" if getattr(self, name) else ""
        return f"Trajectory({text})"

    @property
    def has_positions(self) -> bool:
        """Whether its positions mean something."""
        return self.measures in ("poses", "positions")

    @property
    def has_rotations(self) -> bool:
        """Whether its orientations mean something."""
        return self.measures != "positions"

    @property
    def duration_s(self) -> float:
        """Seconds from first to last pose; 0 for fewer than two."""
        return float(self.stamps_ns[-1] - self.stamps_ns[0]) * 1e-9 if len(self) > 1 else 0.0

    @property
    def interval_s(self) -> float:
        """Median time between two poses in seconds, of at least two poses."""
        return median(np.diff(self.stamps_ns)) * 1e-9

    def shifted(self, offset_s: float, rate: float = 0.0, about_ns: int = 0) -> Self:
        """The same poses with ``offset_s`` seconds added to every stamp, and ``rate`` seconds more
        for each second after a stamp.

        Raises
        ------
        InputError
            If a stamp would not fit 64 bits.
        """
        if not len(self) or not (offset_s or rate):
            return self
        offset_ns = round(offset_s * 1e9)
        ends_ns = [int(stamp_ns) + offset_ns for stamp_ns in self.stamps_ns[[0, -1]]]
        if min(ends_ns) < _FIRST_NS or max(ends_ns) > _LAST_NS:
            raise InputError(
                f"a time offset of {offset_s:.10g} s moves stamps beyond 64 bits of nanoseconds; "
                "check its unit and sign"
            )
        stamps_ns = self.stamps_ns + np.int64(offset_ns)
        if rate:
            stamps_ns += np.round(rate * (self.stamps_ns - about_ns)).astype(np.int64)
        return self._unchecked("stamps_ns", stamps_ns, None if rate else self._alike or self)

    def scaled(self, scale: float) -> Self:
        """The same rotations with every translation multiplied by ``scale``."""
        if scale == 1.0:
            return self
        poses = self.poses.copy()
        poses[:, :3, 3] *= scale
        return self._unchecked("poses", poses)  # in another unit, they may be farther away

    def _unchecked(self, name: str, value: NDArray[Any], alike: Self | None = None) -> Self:
        changed = object.__new__(type(self))
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        for key, each in (values | {name: value, "_alike": alike}).items():
            object.__setattr__(changed, key, each)
        return changed

    @cached_property
    def _steps(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Twists (N - 1, 6) from each pose to the next; their change (N, 6) per second, squared, at
        each of the poses, zero at the ends; and the share (N - 1, 6) of motion in those at both
        ends of each interval, translation and rotation each on its own, as the weight that makes
        their mean most precise.
        """
        if self._alike is not None:
            return self._alike._steps
        spans_s = np.diff(self.stamps_ns)[:, None] * 1e-9
        steps = se3.log(se3.inverse(self.poses[:-1]) @ self.poses[1:])
        changes = np.zeros((len(self), 6))
        changes[1:-1] = np.diff(steps / spans_s, axis=0) / (0.5 * (spans_s[1:] + spans_s[:-1]))
        shares = np.empty((len(changes) - 1, 6))
        for part in (slice(0, 3), slice(3, 6)):
            of_part = changes[:, part]
            power = (of_part**2).sum(axis=1)
            both = (of_part[1:] * of_part[:-1]).sum(axis=1), 0.5 * (power[1:] + power[:-1])
            padded = (np.pad(values, _NEARBY) for values in both)
            nearby = (sliding_window_view(values, 2 * _NEARBY + 1) for values in padded)
            products, powers = (values.sum(axis=1) for values in nearby)
            alike = products / np.maximum(powers, 1e-300)
            motion = np.clip((alike - _CORRELATION) / (1.0 - _CORRELATION), 0.0, 1.0)
            shares[:, part] = (motion / (motion + (1.0 - motion) * _LEFT_IN_THE_MEAN))[:, None]
        return steps, changes, shares

    def at(
        self, stamps_ns: IntArray, extrapolate: bool = False, straight: bool = False
    ) -> FloatArray:
        """Interpolate poses (M, 4, 4) at other stamps (M,), see :func:`corners`. A stamp of the
        trajectory gives its very pose, bit by bit.

        Parameters
        ----------
        stamps_ns : (M,) int64 array
        extrapolate : bool
            Extend the twist of the first and last segment beyond the ends, as the paper's KITTI
            experiments do.
        straight : bool
            Along the geodesic of SE(3) between neighbours, as in the paper.

        Raises
        ------
        InputError
            If there are fewer than two poses or, without ``extrapolate``, a stamp is outside the
            trajectory's time range.
        """
        stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
        if len(self) < 2:
            raise InputError(f"interpolation needs at least two poses; found {len(self)}")
        outside = (stamps_ns < self.stamps_ns[0]) | (stamps_ns > self.stamps_ns[-1])
        if outside.any() and not extrapolate:
            raise InputError(
                f"{int(outside.sum())} of {len(stamps_ns)} stamps lie outside the trajectory "
                f"({self.stamps_ns[0]} to {self.stamps_ns[-1]} ns); poses are not extrapolated"
            )
        after = np.clip(np.searchsorted(self.stamps_ns, stamps_ns), 1, len(self) - 1)
        before = after - 1
        span = (self.stamps_ns[after] - self.stamps_ns[before]).astype(float)
        fraction = (stamps_ns - self.stamps_ns[before]).astype(float) / span
        poses = self.poses[np.where(fraction == 1.0, after, before)]
        between = (fraction != 0.0) & (fraction != 1.0)
        if between.any():
            steps, changes, motion = self._steps
            shares = fraction[between, None]
            bent = between & ~outside
            poses[between] = poses[between] @ se3.exp(shares * steps[before[between]])
            if bent.any() and not straight:
                bends = self.stamps_ns, changes, motion, before[bent], fraction[bent]
                poses[bent] = poses[bent] @ se3.exp(corners(*bends))
        return poses


class Table(Protocol):
    """``pandas.DataFrame``, or another table with named columns."""

    columns: Any


#: A trajectory, or what :func:`hand_eye_calib.read_trajectory` makes one of: a path, rows, a table.
TrajectoryLike: TypeAlias = Trajectory | str | PathLike[str] | np.ndarray | Table


def far_position(x: float, y: float, z: float) -> str:
    """What is wrong with a position farther than FARTHEST_M from the origin."""
    return f"position ({x:.4g}, {y:.4g}, {z:.4g}) is more than {FARTHEST_M:g} m from the origin"


def _check_finite(what: str, rows: FloatArray) -> None:
    """Raise InputError at the first row (N, K) with a value that is not finite."""
    finite = np.isfinite(rows).all(axis=1)
    if not finite.all():
        raise InputError(
            f"{what} {int(np.argmin(finite))} has a value that is not finite; "
            "remove it or repair its source"
        )


def check_poses(poses: FloatArray) -> None:
    """Raise InputError at the first pose (N, 4, 4) that is no rigid transform."""
    _check_finite("pose", poses.reshape(-1, 16))
    is_far = (np.abs(poses[:, :3, 3]) > FARTHEST_M).any(axis=1)
    if is_far.any():
        index = int(np.argmax(is_far))
        raise InputError(
            f"pose {index}: {far_position(*poses[index, :3, 3])}; check its unit, or remove it"
        )
    rotation = poses[:, :3, :3]
    apart = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3))
    deviation = apart.max(axis=(1, 2), initial=0.0)
    wrong = (deviation > ROTATION_TOLERANCE) | (np.linalg.det(rotation) < 0)
    if wrong.any():
        raise InputError(
            f"pose {int(np.argmax(wrong))} is not a rigid transform: its 3x3 part is not a "
            f"rotation matrix within {ROTATION_TOLERANCE} (scaled or left-handed axes?)"
        )


def corners(
    stamps_ns: IntArray,
    changes: FloatArray,
    shares: FloatArray,
    start: IntArray,
    fraction: FloatArray,
) -> FloatArray:
    """Twists from a constant twist to the motion.

    A constant twist between two poses cuts the corners of a motion: a shake of angular frequency f,
    seen every h seconds, shrinks by (f h)^2 / 12. So the change of the twist at the poses before
    and after counts, too, as far as it is motion and not noise. Changes by white noise s have
    variance 6 s^2 and a covariance of -4 s^2 with the next one; those by a motion that is sampled
    well are alike. The share of motion follows from the poses nearby. What is left of white noise
    halfway between two poses is between 0.71 (a constant twist) and 0.80 of it.

    Of poses at stamps (N,) with these changes of their twists, of which these shares are motion,
    ``start`` (M,) are the indices of those before each wanted one, ``fraction`` (M,) is of the
    interval to the next. Returns xi (M, 6) in ``T_world_sensor exp(xi)``.
    """
    at_start = changes[start]
    at_end = changes[start + 1]
    bend = ((2.0 - fraction)[:, None] * at_start + (1.0 + fraction)[:, None] * at_end) / 3.0
    missing = 0.5 * fraction * (1.0 - fraction) * (np.diff(stamps_ns)[start] * 1e-9) ** 2
    return -missing[:, None] * shares[start] * bend


def repetitions(trajectory: Trajectory, least_s: float) -> list[tuple[int, int]]:
    """Return the times in which a stream repeats its pose: first and last stamp (ns) of each.

    Parameters
    ----------
    trajectory : Trajectory
    least_s : float
        Shortest such time, in seconds.
    """
    same = np.abs(np.diff(trajectory.poses, axis=0)).max(axis=(1, 2)) < _SAME_POSE
    edges = np.flatnonzero(np.diff(np.r_[False, same, False].astype(int)))
    times_ns = trajectory.stamps_ns[edges].reshape(-1, 2)
    is_long = times_ns[:, 1] - times_ns[:, 0] >= least_s * 1e9
    return [(from_ns, until_ns) for from_ns, until_ns in times_ns[is_long].tolist()]
