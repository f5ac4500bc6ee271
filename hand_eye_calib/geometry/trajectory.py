"""A sensor's trajectory: poses of one sensor in its own fixed frame, with their stamps."""

import copy
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3

# Farther from unit length than this a quaternion is not a rounded rotation but a wrong one (tf2
# uses the same bound).
QUATERNION_NORM_TOLERANCE = 1e-2

# Poses given as matrices must be rotations to this tolerance; a file with six digits passes, a
# scaled matrix does not.
ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Trajectory:
    """Stamped poses of a sensor, in strictly increasing order of time.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
        Stamps in nanoseconds, strictly increasing.
    poses : (N, 4, 4) float64 array
        ``Ts_world_sensor``: poses of the sensor in its own world (odometry) frame, metres.
    sensor_frame : str
        Name of the moving frame; empty where it is not known.
    world_frame : str
        Name of the fixed frame; empty where it is not known.

    Raises
    ------
    InputError
        Where shapes, stamps or poses are unusable; the message names the first offending pose.
    """

    stamps_ns: np.ndarray
    poses: np.ndarray
    sensor_frame: str = ""
    world_frame: str = ""

    def __post_init__(self):
        stamps_ns = np.ascontiguousarray(self.stamps_ns)
        poses = np.ascontiguousarray(self.poses, dtype=float)
        if stamps_ns.ndim != 1 or not np.issubdtype(stamps_ns.dtype, np.integer):
            raise InputError(
                f"stamps_ns must be one-dimensional integers (nanoseconds); found shape {stamps_ns.shape} of {stamps_ns.dtype}"
            )
        if poses.shape != (len(stamps_ns), 4, 4):
            raise InputError(
                f"poses must have shape ({len(stamps_ns)}, 4, 4), one per stamp; found {poses.shape}"
            )
        stamps_ns = stamps_ns.astype(np.int64, copy=False)
        backwards = np.flatnonzero(np.diff(stamps_ns) <= 0)
        if backwards.size:
            index = int(backwards[0]) + 1
            raise InputError(
                f"stamps must increase: pose {index} has stamp {stamps_ns[index]} ns after {stamps_ns[index - 1]} ns; "
                "sort the poses and drop repeated stamps"
            )
        _check_poses(poses)
        object.__setattr__(self, "stamps_ns", stamps_ns)
        object.__setattr__(self, "poses", poses)

    @classmethod
    def from_quat_xyzw(cls, stamps_ns, translations, quats_xyzw, **frames):
        """Build from translations (N, 3) in metres and quaternions (N, 4), scalar last, of nearly
        unit length.

        Raises
        ------
        InputError
            Where a number is not finite or a quaternion is more than 1 % away from unit length.
        """
        translations = np.asarray(translations, dtype=float).reshape(-1, 3)
        quats_xyzw = np.asarray(quats_xyzw, dtype=float).reshape(-1, 4)
        finite = np.isfinite(translations).all(axis=1) & np.isfinite(quats_xyzw).all(axis=1)
        if not finite.all():
            raise InputError(
                f"pose {int(np.argmin(finite))} has a value that is not finite; remove it or repair its source"
            )
        norms = np.linalg.norm(quats_xyzw, axis=1)
        wrong = np.abs(norms - 1.0) > QUATERNION_NORM_TOLERANCE
        if wrong.any():
            index = int(np.argmax(wrong))
            raise InputError(
                f"pose {index} has a quaternion of length {norms[index]:.4g}, expected 1 within {QUATERNION_NORM_TOLERANCE}; "
                "check the column order (x y z qx qy qz qw)"
            )
        return cls(stamps_ns, se3.from_quat_xyzw(translations, quats_xyzw), **frames)

    def __len__(self):
        return len(self.stamps_ns)

    def __getitem__(self, index):
        """A part of the trajectory: any slice, mask or increasing index array."""
        if isinstance(index, (int, np.integer)):
            raise TypeError(
                "index a Trajectory with a slice, mask or index array; single poses are trajectory.poses[i]"
            )
        return Trajectory(
            self.stamps_ns[index], self.poses[index], self.sensor_frame, self.world_frame
        )

    @property
    def duration_s(self):
        """Seconds from first to last pose; 0 for fewer than two."""
        return float(self.stamps_ns[-1] - self.stamps_ns[0]) * 1e-9 if len(self) > 1 else 0.0

    @property
    def interval_s(self) -> float:
        """Median time between two poses in seconds, of at least two poses."""
        return float(np.median(np.diff(self.stamps_ns))) * 1e-9

    def shifted(self, offset_s):
        """The same poses with ``offset_s`` seconds added to every stamp."""
        shifted = copy.copy(self)  # poses and order have been checked
        object.__setattr__(shifted, "stamps_ns", self.stamps_ns + np.int64(round(offset_s * 1e9)))
        return shifted

    def scaled(self, scale):
        """The same rotations with every translation multiplied by ``scale``."""
        poses = self.poses.copy()
        poses[:, :3, 3] *= scale
        return Trajectory(self.stamps_ns, poses, self.sensor_frame, self.world_frame)

    def at(self, stamps_ns, extrapolate=False):
        """Poses at other stamps, along the geodesic of SE(3) between neighbouring poses.

        Parameters
        ----------
        stamps_ns : (M,) int64 array
        extrapolate : bool
            Extend the first and last segment's twist beyond the ends (as the paper's KITTI
            experiments do); otherwise a stamp outside the trajectory is an error.

        Returns
        -------
        (M, 4, 4) array
            A stamp that the trajectory has gives that very pose, bit by bit.

        Raises
        ------
        InputError
            With fewer than two poses, or outside the trajectory's time range without
            ``extrapolate``.
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
            poses[between] = se3.interpolate(
                self.poses[before[between]], self.poses[after[between]], fraction[between]
            )
        return poses


def _check_poses(poses):
    finite = np.isfinite(poses).all(axis=(1, 2))
    if not finite.all():
        raise InputError(
            f"pose {int(np.argmin(finite))} has a value that is not finite; remove it or repair its source"
        )
    rotation = poses[:, :3, :3]
    deviation = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max(
        axis=(1, 2), initial=0.0
    )
    wrong = (deviation > ROTATION_TOLERANCE) | (np.linalg.det(rotation) < 0)
    if wrong.any():
        raise InputError(
            f"pose {int(np.argmax(wrong))} is not a rigid transform: its 3x3 part is not a rotation matrix within "
            f"{ROTATION_TOLERANCE} (scaled or left-handed axes?)"
        )
