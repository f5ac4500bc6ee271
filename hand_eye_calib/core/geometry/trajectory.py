"""Trajectories: stamped poses of one sensor in its own fixed frame."""

from dataclasses import dataclass, fields
from functools import cached_property
from numbers import Real
from os import PathLike
from typing import Any, ClassVar, Protocol, Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hand_eye_calib.core.base.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    floats,
)
from hand_eye_calib.core.base.errors import InputError, require_type
from hand_eye_calib.core.base.registry import MEASURES
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.interpolation import (
    corner_corrections,
    shares_of_motion,
)

# Largest deviation of the length of a quaternion from 1 that may be rounding (limit of tf2).
QUATERNION_NORM_TOLERANCE = 1e-2

# Largest coordinate of a position (m). It still accepts distances from the Earth's centre in
# millimetres, about 6.4e9.
FARTHEST_M = 1e10

# Smallest distance (m) of a place on the ground from the centre of the earth.
_MIN_EARTH_M = 6.3e6
# Largest distance (m) of an aircraft from the centre of the earth.
_MAX_EARTH_M = 6.45e6

# Largest element of R'R - I for a rotation matrix R. A matrix with six digits passes; a scaled
# matrix fails.
ROTATION_TOLERANCE = 1e-3

# The direction of motion is computed for steps along the path. The length of a step is the extent
# of all positions, divided by this number. At least a fifth of this number of steps is needed.
_STEPS_IN_EXTENT = 50

# A convention is wrong if the scatter of its direction of motion exceeds two limits, see
# :func:`scatter_of_direction`. First limit: this value.
STEADY_SCATTER = 0.05
# Second limit: this multiple of the scatter in another convention.
WRONG_SCATTER_RATIO = 4.0


def scatter_of_direction(poses: FloatArray) -> float:
    """Return the scatter of the direction of motion of poses (N, 4, 4) in the sensor's axes.

    The scatter is 1 minus the length of the mean direction. It is 0 if the direction never changes,
    as on vehicles. It is 1 if the sensor moves in all directions, or if there are too few steps.
    """
    positions = se3.translation_of(poses)
    rotations = se3.rotation_of(poses)
    # Select the first pose after each further step along the path.
    step_m = float(np.linalg.norm(np.ptp(positions, axis=0))) / _STEPS_IN_EXTENT
    travelled_m = np.r_[
        0.0, np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))
    ]
    n_steps_before = np.floor(travelled_m / (step_m or np.inf))
    rows = np.flatnonzero(np.diff(n_steps_before, prepend=-1.0))
    steps = np.diff(positions[rows], axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    # At rest, noise of the positions adds up to a path without a direction.
    is_step = lengths > step_m / 3
    if is_step.sum() < _STEPS_IN_EXTENT / 5:
        return 1.0
    directions = steps[is_step] / lengths[is_step, None]
    in_sensor = np.einsum(
        "nji,nj->ni", rotations[rows[:-1][is_step]], directions
    )
    return 1.0 - float(np.linalg.norm(in_sensor.mean(axis=0)))


#: Poses, positions or angles that differ by less than this (m, rad) are equal up to rounding.
SAME_POSE = 1e-6

# Smallest and largest stamp, ns.
_STAMPS_NS = np.iinfo(np.int64)


@dataclass(frozen=True, eq=False)
class WithArrays:
    """Base of dataclasses with arrays: two are equal if all their fields are equal.

    Declare subclasses with ``eq=False``.
    """

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, type(self)):
            return False
        return all(map(_equal, self.columns, other.columns))

    @property
    def columns(self) -> tuple[Any, ...]:
        """Values of the fields, in their order."""
        return tuple(getattr(self, column.name) for column in fields(self))


def _equal(value: Any, other: Any) -> bool:
    if isinstance(value, np.ndarray):
        return np.array_equal(value, other)
    return value == other


class Columns(WithArrays):
    """Base of dataclasses with arrays of equally many rows; the first field is an array."""

    def __len__(self) -> int:
        # Loops call this often. A tuple of all columns would be slower than the first field.
        first = next(iter(self.__dataclass_fields__))
        return len(getattr(self, first))

    def __getitem__(self, index: slice | NDArray[Any]) -> Self:
        """Return a selection of the rows, by a slice, a mask or an array of indices."""
        columns = []
        for column in self.columns:
            columns.append(
                column[index] if isinstance(column, np.ndarray) else column
            )
        return type(self)(*columns)

    @classmethod
    def concatenate(cls, *tables: Self) -> Self:
        """Return the rows of all tables, one table after the other."""
        columns = zip(*(table.columns for table in tables), strict=True)
        return cls(*map(np.concatenate, columns))


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
        Measured part of the poses. Positions have no valid orientations, and rotations no valid
        positions. Rates are stored as integrated rotations, with a bias.

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

    # Trajectory with the original stamps, if the stamps of this trajectory were shifted. Both
    # trajectories have the same `_steps`.
    _unshifted: ClassVar[Self | None] = None

    def __hash__(self) -> int:
        """Hash of the stamps, so that a function of a trajectory can be cached."""
        return hash(self.stamps_ns.tobytes())

    def __post_init__(self) -> None:
        stamps_ns = np.ascontiguousarray(self.stamps_ns)
        poses = np.ascontiguousarray(floats("poses", self.poses))
        if stamps_ns.ndim != 1 or not np.issubdtype(
            stamps_ns.dtype, np.integer
        ):
            is_float = np.issubdtype(stamps_ns.dtype, np.floating)
            hint = (
                ": multiply seconds by 1e9 and round them" if is_float else ""
            )
            raise InputError(
                "stamps_ns must be one-dimensional integers (nanoseconds); "
                f"found shape {stamps_ns.shape} of {stamps_ns.dtype}{hint}"
            )
        if poses.shape != (len(stamps_ns), 4, 4):
            hint = ""
            if poses.shape == (len(stamps_ns), 3):
                hint = (
                    ": for positions alone, use "
                    "Trajectory.from_positions(stamps_ns, positions)"
                )
            elif poses.shape == (len(stamps_ns), 7):
                hint = (
                    ": for rows of x y z qx qy qz qw, use "
                    "Trajectory.from_quat_xyzw(stamps_ns, rows[:, :3], rows[:, 3:])"
                )
            raise InputError(
                f"poses must have shape ({len(stamps_ns)}, 4, 4), one per stamp; "
                f"found {poses.shape}{hint}"
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
        """Make a trajectory of translations (N, 3), m, and quaternions (N, 4), scalar last.

        Raises
        ------
        InputError
            If a value is not finite or a quaternion is more than 1 % away from unit length.
        """
        translations = floats("translations", translations, 3)
        quats_xyzw = floats("quats_xyzw", quats_xyzw, 4)
        _check_finite(
            "pose", np.concatenate([translations, quats_xyzw], axis=1)
        )
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
        """Make a trajectory of positions (N, 3), m, of a sensor without orientation.

        Examples are the antenna of a GNSS receiver and the prism of a total station.
        """
        poses = se3.from_rotation_translation(
            np.eye(3), floats("positions", positions, 3)
        )
        return cls(stamps_ns, poses, sensor_frame, world_frame, "positions")

    @classmethod
    def from_rates(
        cls, stamps_ns: IntArray, rates: ArrayLike, sensor_frame: str = ""
    ) -> Self:
        """Make a trajectory of angular rates (N, 3), rad/s, of a gyroscope about its own axes.

        Raises
        ------
        InputError
            If a rate is not finite or the stamps do not increase.
        """
        rates = floats("rates", rates, 3)
        _check_finite("rate", rates)
        from hand_eye_calib.core.geometry.rates import RateIntegrator

        rotations = RateIntegrator().rotations(np.asarray(stamps_ns), rates)
        poses = se3.from_rotation_translation(rotations, np.zeros_like(rates))
        return cls(stamps_ns, poses, sensor_frame, "", "rates")

    def __repr__(self) -> str:
        text = f"{len(self)} {self.measures} over {self.duration_s:.3f} s"
        if self.sensor_frame:
            text += f", sensor_frame={self.sensor_frame!r}"
        if self.world_frame:
            text += f", world_frame={self.world_frame!r}"
        return f"Trajectory({text})"

    @property
    def has_positions(self) -> bool:
        """Whether the positions are measured."""
        return self.measures in ("poses", "positions")

    @property
    def has_rotations(self) -> bool:
        """Whether the orientations are measured."""
        return self.measures != "positions"

    @property
    def duration_s(self) -> float:
        """Seconds from the first to the last pose; 0 for fewer than two poses."""
        if len(self) < 2:
            return 0.0
        return float(self.stamps_ns[-1] - self.stamps_ns[0]) * 1e-9

    @property
    def interval_s(self) -> float:
        """Median time (s) between consecutive poses. There must be at least two poses."""
        return median(np.diff(self.stamps_ns)) * 1e-9

    def shifted(
        self, offset_s: float, rate: float = 0.0, about_ns: int = 0
    ) -> Self:
        """Return the same poses with shifted stamps.

        Parameters
        ----------
        offset_s : float
            Seconds that are added to every stamp.
        rate : float
            Number of seconds that are also added for each second after ``about_ns``.
        about_ns : int
            Stamp (ns) at which ``rate`` adds nothing.

        Raises
        ------
        InputError
            If a stamp would not fit 64 bits.
        """
        require_type("offset_s", offset_s, Real)
        if not len(self) or not (offset_s or rate):
            return self
        offset_ns = round(offset_s * 1e9)
        first_ns = int(self.stamps_ns[0]) + offset_ns
        last_ns = int(self.stamps_ns[-1]) + offset_ns
        if first_ns < _STAMPS_NS.min or last_ns > _STAMPS_NS.max:
            raise InputError(
                f"a time offset of {offset_s:.10g} s moves stamps beyond 64 bits of nanoseconds; "
                "check its unit and sign"
            )
        stamps_ns = self.stamps_ns + np.int64(offset_ns)
        if rate:
            stamps_ns += np.round(rate * (self.stamps_ns - about_ns)).astype(
                np.int64
            )
        unshifted = None if rate else self._unshifted or self
        return self._unchecked("stamps_ns", stamps_ns, unshifted)

    def scaled(self, scale: float) -> Self:
        """Return the same rotations with every translation multiplied by ``scale``."""
        require_type("scale", scale, Real)
        if scale == 1.0:
            return self
        poses = self.poses.copy()
        poses[:, :3, 3] *= scale
        # Positions in another unit may exceed the largest position, so they are not checked.
        return self._unchecked("poses", poses)

    def _unchecked(
        self, name: str, value: NDArray[Any], unshifted: Self | None = None
    ) -> Self:
        """Return a copy with another value of a field, without checks."""
        changed = object.__new__(type(self))
        values = {
            column.name: getattr(self, column.name) for column in fields(self)
        }
        values |= {name: value, "_unshifted": unshifted}
        for key in values:
            object.__setattr__(changed, key, values[key])
        return changed

    @cached_property
    def _steps(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Twists between poses, their changes, and the share of motion in these changes.

        Returns
        -------
        steps : (N - 1, 6) array
            Twists from each pose to the next.
        changes : (N, 6) array
            Changes of the twist at the poses (m/s^2, rad/s^2); zero at the first and last pose.
        shares : (N - 1, 6) array
            See :func:`~hand_eye_calib.core.geometry.interpolation.shares_of_motion`.
        """
        if self._unshifted is not None:
            return self._unshifted._steps
        spans_s = np.diff(self.stamps_ns)[:, None] * 1e-9
        mean_spans_s = 0.5 * (spans_s[1:] + spans_s[:-1])
        steps = se3.log(se3.inverse(self.poses[:-1]) @ self.poses[1:])
        changes = np.zeros((len(self), 6))
        changes[1:-1] = np.diff(steps / spans_s, axis=0) / mean_spans_s
        return steps, changes, shares_of_motion(changes)

    def at(
        self,
        stamps_ns: IntArray,
        extrapolate: bool = False,
        straight: bool = False,
    ) -> FloatArray:
        """Interpolate poses (M, 4, 4) at other stamps, see :mod:`.interpolation`.

        Poses at stamps of the trajectory itself are returned unchanged, bit by bit.

        Parameters
        ----------
        stamps_ns : (M,) int64 array
        extrapolate : bool
            Whether to extend the twist of the first and last segment beyond the ends, as the
            paper's KITTI experiments do.
        straight : bool
            Whether to follow the geodesic of SE(3) between neighbours, as in the paper.

        Raises
        ------
        InputError
            If there are fewer than two poses or, without ``extrapolate``, a stamp is outside the
            trajectory's time range.
        """
        stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
        is_outside = self._is_outside(stamps_ns)
        if is_outside.any() and not extrapolate:
            raise InputError(
                f"{int(is_outside.sum())} of {len(stamps_ns)} stamps lie outside the trajectory "
                f"({self.stamps_ns[0]} to {self.stamps_ns[-1]} ns); poses are not extrapolated"
            )
        after = np.clip(
            np.searchsorted(self.stamps_ns, stamps_ns), 1, len(self) - 1
        )
        before = after - 1
        span = (self.stamps_ns[after] - self.stamps_ns[before]).astype(float)
        fraction = (stamps_ns - self.stamps_ns[before]).astype(float) / span
        poses = self.poses[np.where(fraction == 1.0, after, before)]
        is_between = (fraction != 0.0) & (fraction != 1.0)
        if not is_between.any():
            return poses
        steps, changes, shares = self._steps
        twists = fraction[is_between, None] * steps[before[is_between]]
        poses[is_between] = poses[is_between] @ se3.exp(twists)
        is_bent = is_between & ~is_outside
        if is_bent.any() and not straight:
            corrections = corner_corrections(
                self.stamps_ns,
                changes,
                shares,
                start=before[is_bent],
                fraction=fraction[is_bent],
            )
            poses[is_bent] = poses[is_bent] @ se3.exp(corrections)
        return poses

    def _is_outside(self, stamps_ns: IntArray) -> BoolArray:
        """Whether stamps (M,) are before the first or after the last pose; refuse a single pose."""
        if len(self) < 2:
            raise InputError(
                f"interpolation needs at least two poses; found {len(self)}"
            )
        is_before = stamps_ns < self.stamps_ns[0]
        return is_before | (stamps_ns > self.stamps_ns[-1])


class Table(Protocol):
    """``pandas.DataFrame``, or another table with named columns."""

    columns: Any


#: A trajectory, or an input of :func:`hand_eye_calib.read_trajectory`: a path, rows or a table.
TrajectoryLike: TypeAlias = (
    Trajectory | str | PathLike[str] | np.ndarray | Table
)


def far_position(x: float, y: float, z: float) -> str:
    """Describe a position farther than FARTHEST_M from the origin."""
    position = f"({x:.4g}, {y:.4g}, {z:.4g})"
    return f"position {position} is more than {FARTHEST_M:g} m from the origin"


def _check_finite(noun: str, rows: FloatArray) -> None:
    """Raise InputError for the first of the rows (N, K) with a value that is not finite."""
    is_finite = np.isfinite(rows).all(axis=1)
    if not is_finite.all():
        raise InputError(
            f"{noun} {int(np.argmin(is_finite))} has a value that is not finite; "
            "remove it or repair its source"
        )


def check_poses(poses: FloatArray) -> None:
    """Raise InputError for the first of the poses (N, 4, 4) that is not a rigid transform."""
    _check_finite("pose", poses.reshape(-1, 16))
    is_far = (np.abs(se3.translation_of(poses)) > FARTHEST_M).any(axis=1)
    if is_far.any():
        index = int(np.argmax(is_far))
        raise InputError(
            f"pose {index}: {far_position(*poses[index, :3, 3])}; check its unit, or remove it"
        )
    rotation = se3.rotation_of(poses)
    deviations = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3))
    is_scaled = deviations.max(axis=(1, 2), initial=0.0) > ROTATION_TOLERANCE
    is_wrong = is_scaled | (np.linalg.det(rotation) < 0)
    if is_wrong.any():
        raise InputError(
            f"pose {int(np.argmax(is_wrong))} is not a rigid transform: its 3x3 part is not a "
            f"rotation matrix within {ROTATION_TOLERANCE} (scaled or left-handed axes?)"
        )
    _check_last_rows(poses)


def _check_last_rows(poses: FloatArray) -> None:
    """Raise InputError for the first of the poses (N, 4, 4) whose last row is not 0 0 0 1."""
    is_wrong = _differs_from_last_row(poses[:, 3])
    if is_wrong.any():
        index = int(np.argmax(is_wrong))
        hint = "is it a pose (4, 4)?"
        if not _differs_from_last_row(poses[:, :, 3]).any():
            hint = (
                "the poses seem to be transposed; pass poses.transpose(0, 2, 1)"
            )
        found = " ".join(f"{number:.4g}" for number in poses[index, 3])
        raise InputError(
            f"pose {index}: the last row must be 0 0 0 1; found {found}: {hint}"
        )


def _differs_from_last_row(rows: FloatArray) -> BoolArray:
    """Whether rows (N, 4) differ from the last row of a pose."""
    deviations = np.abs(rows - np.array([0.0, 0.0, 0.0, 1.0]))
    return np.asarray(deviations.max(axis=1, initial=0.0) > ROTATION_TOLERANCE)


def are_earth_centred(positions: FloatArray) -> bool:
    """Whether all positions (N, 3), m, are as far from the origin as places on the earth.

    Such positions are probably relative to the centre of the earth (ECEF).
    """
    distances_m = np.linalg.norm(positions, axis=1)
    return bool(
        ((distances_m > _MIN_EARTH_M) & (distances_m < _MAX_EARTH_M)).all()
    )


def repetitions(
    trajectory: Trajectory, least_s: float
) -> list[tuple[int, int]]:
    """Return the first and last stamp (ns) of each period in which a stream repeats one pose.

    Parameters
    ----------
    trajectory : Trajectory
    least_s : float
        Shortest period that is returned, in seconds.
    """
    differences = np.abs(np.diff(trajectory.poses, axis=0))
    is_same = differences.max(axis=(1, 2)) < SAME_POSE
    # A period begins where `is_same` becomes True, and ends where it becomes False.
    changes = np.diff(np.r_[False, is_same, False].astype(int))
    rows = np.flatnonzero(changes)
    from_ns, until_ns = trajectory.stamps_ns[rows].reshape(-1, 2).T
    is_long = until_ns - from_ns >= least_s * 1e9
    return [
        *zip(from_ns[is_long].tolist(), until_ns[is_long].tolist(), strict=True)
    ]
