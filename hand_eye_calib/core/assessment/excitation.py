"""Motion of the parent sensor during a session, and hints about motion that is missing."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from hand_eye_calib.core.assessment.covariance import (
    hidden_axes,
    lever_arm_products,
)
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import median, quantile
from hand_eye_calib.core.base.text import axes_in_words, listing
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.core.results.calibration import Calibration, DofVerdict
from hand_eye_calib.core.results.records import AXES, ROTATIONS, TRANSLATIONS

# Largest number of poses that are used, evenly spaced over the session. They resolve every curve,
# and the computation takes some milliseconds.
_MAX_POSES = 500

# The rotation about an axis is represented by this quantile, which excludes outliers.
_QUANTILE = 0.95

# A smaller rotation (rad) does not reveal a lever arm.
MIN_ROTATION = float(np.radians(5.0))

# A sensor moves if its mean speed over a second (m/s) exceeds this limit.
_MOVES_M_S = 0.05
# A sensor also moves if its mean angular rate over a second (rad/s) exceeds this limit.
_MOVES_RAD_S = float(np.radians(1.0))
# Time (ns) between the two poses from which a speed is computed.
_STEP_NS = 1_000_000_000

# Wheels or tracks move a sensor if the mean squared cosine between its steps and one of its axes is
# at least this. A motion is along x if its cosine with x is at least this. Measured: 0.95 to 1 for
# road vehicles; 0.4 to 0.85 for handheld devices, drones and robot arms.
_ALONG_ONE_AXIS = 0.9
# A step below this share of the median length is noise, without a direction.
_LONG_STEP = 0.3
# Manoeuvres that turn a vehicle about its x, y and z.
_MANOEUVRES = (
    "drive one wheel over a kerb",
    "drive over a ramp or a bump",
    "drive curves to both sides",
)

# Advice about the height of a vehicle that has turned about its vertical axis only.
_ON_A_FLAT_FLOOR = "drive over a ramp or a kerb, or measure it by hand"
# Addition for recordings. A live session has no clouds.
_WITH_LIDARS = ", or, if both sensors are lidars, record their clouds and run calibrate on the bag"


@dataclass(frozen=True)
class Excitation:
    """Motion of the parent sensor, in its own axes.

    Attributes
    ----------
    n_poses : int
        Number of synchronised pose pairs of the session.
    rotation : (3,) array
        Rotation about x, y and z between two poses, rad: the 95th percentile over the session. The
        distance between the poses is the one with the largest rotation.
    lever_arms : (3, 3) array
        :func:`~hand_eye_calib.core.assessment.covariance.lever_arm_products` of the rotations
        between two poses. The distance between the poses is the one with the largest displacement.
    distance : float
        Length of the path of the sensor, m.
    motion_s : float
        Time (s) during which the sensor moved.
    drives : bool
        Whether the sensor moves along one of its own axes, like a sensor on a vehicle. True before
        the first motion.
    forward : (3,) array
        Unit vector of the main direction of motion; 0 if the sensor has not moved.
    """

    n_poses: int
    rotation: FloatArray
    lever_arms: FloatArray
    distance: float
    motion_s: float = 0.0
    drives: bool = True
    forward: FloatArray = field(default_factory=lambda: np.zeros(3))

    @property
    def has_vehicle_axes(self) -> bool:
        """Whether the sensor moves along x and turns about z, as in REP 103."""
        turns_about_z = self.rotation[2] >= max(
            self.rotation.max(), MIN_ROTATION
        )
        moves_along_x = abs(self.forward[0]) > _ALONG_ONE_AXIS
        return bool(self.drives and turns_about_z and moves_along_x)

    def hidden_axes(self) -> tuple[str, ...]:
        """Return the axes x, y, z whose translation even noise-free motion does not reveal."""
        if self.rotation.max() < MIN_ROTATION:
            return TRANSLATIONS
        return hidden_axes(self.lever_arms)


def excitation(pose_pairs: PosePairs) -> Excitation:
    """Return the motion of the parent sensor in synchronised poses."""
    n_poses = len(pose_pairs)
    rotation = np.zeros(3)
    lever_arms = np.zeros((3, 3))
    if n_poses < 2:
        return Excitation(n_poses, rotation, lever_arms, 0.0)
    rows = np.linspace(0, n_poses - 1, min(n_poses, _MAX_POSES)).astype(int)
    poses = pose_pairs.Ts_pw_p[rows]
    orientations = se3.rotation_of(poses)
    lag = 1
    while lag < len(poses):
        motions = se3.relative_rotations(
            orientations[:-lag], orientations[lag:]
        )
        angles = np.abs(se3.rotation_log(motions))
        typical_angles = [quantile(angle, _QUANTILE) for angle in angles.T]
        rotation = np.maximum(rotation, typical_angles)
        products = lever_arm_products(motions - np.eye(3))
        if np.trace(products) > np.trace(lever_arms):
            lever_arms = products
        lag *= 2
    directions = [
        _main_direction(poses, lag) for lag in (1, 2, 4) if lag < len(poses)
    ]
    share, forward = max(directions, key=lambda direction: direction[0])
    steps = np.diff(se3.translation_of(poses), axis=0)
    return Excitation(
        n_poses=n_poses,
        rotation=rotation,
        lever_arms=lever_arms,
        distance=float(np.linalg.norm(steps, axis=1).sum()),
        motion_s=seconds_of_motion(pose_pairs),
        drives=share >= _ALONG_ONE_AXIS,
        forward=forward,
    )


def _main_direction(poses: FloatArray, lag: int) -> tuple[float, FloatArray]:
    """Return the mean squared cosine between motion and main direction, and this direction.

    Parameters
    ----------
    poses : (N, 4, 4) array
    lag : int
        Number of poses in a step.

    Returns
    -------
    share : float
        Mean squared cosine: 1/3 for motion in all directions of the sensor, 1 for motion along one
        axis.
    axis : (3,) array
        Unit vector in the sensor's frame; 0 without motion.
    """
    steps = poses[lag:, :3, 3] - poses[:-lag, :3, 3]
    lengths = np.linalg.norm(steps, axis=1)
    is_long = (lengths > _LONG_STEP * median(lengths)) & (lengths > 0)
    if not is_long.any():
        return 1.0, np.zeros(3)
    in_sensor = np.einsum("nji,nj->ni", poses[:-lag, :3, :3], steps)
    directions = in_sensor[is_long] / lengths[is_long, None]
    shares, axes = np.linalg.eigh(directions.T @ directions / len(directions))
    return float(shares[-1]), axes[:, -1]


def seconds_of_motion(pose_pairs: PosePairs) -> float:
    """Return the time (s) during which the parent sensor moved, from poses one second apart."""
    stamps_ns = pose_pairs.stamps_ns
    seconds = (stamps_ns - stamps_ns[0]) // _STEP_NS
    _, first_rows = np.unique(seconds, return_index=True)
    if len(first_rows) < 2:
        return 0.0
    durations_s = np.diff(stamps_ns[first_rows]) * 1e-9
    poses = pose_pairs.Ts_pw_p[first_rows]
    steps = np.diff(se3.translation_of(poses), axis=0)
    speeds = np.linalg.norm(steps, axis=1) / durations_s
    orientations = se3.rotation_of(poses)
    rotations = se3.relative_rotations(orientations[:-1], orientations[1:])
    rates = se3.rotation_angle(rotations) / durations_s
    is_moving = (speeds > _MOVES_M_S) | (rates > _MOVES_RAD_S)
    return float(durations_s[is_moving].sum())


def what_is_missing(
    seen: Excitation, calibration: Calibration | None = None
) -> str:
    """Describe what the motion so far does not determine, and which motion determines it.

    Parameters
    ----------
    seen : Excitation
        Motion of the parent sensor. The axes x, y, z are those of this sensor.
    calibration : Calibration, optional
        Result from the same poses. If present, its verdicts decide instead of the motion.

    Returns
    -------
    str
        Empty if nothing is missing.
    """
    axes = calibration.hidden if calibration else [*seen.hidden_axes()]
    problem = "cannot be determined from the motion so far"
    if calibration and not axes:
        verdicts = calibration.observability
        axes = [dof.name for dof in verdicts if dof.verdict is DofVerdict.WEAK]
        problem = "needs more motion" if len(axes) == 1 else "need more motion"
    if not axes:
        return ""
    motion = helpful_motion(axes, seen)
    if calibration and motion == _ON_A_FLAT_FLOOR:
        motion += _WITH_LIDARS
    return f"{axes_in_words(axes)} {problem}: {motion}"


def helpful_motion(axes: Sequence[str], seen: Excitation) -> str:
    """Describe the motion that reveals most about the given axes.

    A rotation about an axis reveals offsets along the other two axes, and angles about them. It
    reveals nothing along or about its own axis.

    Parameters
    ----------
    axes : sequence of str
        Some of x, y, z, roll, pitch and yaw, of the parent sensor.
    seen : Excitation
        The motion so far.
    """
    motions = [_motion_for(axis, seen) for axis in axes]
    rotations = {motion for motion in motions if isinstance(motion, int)}
    others = [motion for motion in motions if isinstance(motion, str)]
    hints = [*dict.fromkeys(others)]
    if rotations:
        hints.append(_rotations_in_words(sorted(rotations), seen))
    return "; ".join(hints)


def axes_by_hand(axes: Sequence[str], seen: Excitation) -> tuple[str, ...]:
    """Return the axes for which :func:`helpful_motion` proposes a measurement by hand.

    All rotation so far is about such an axis, which hides the offset along it.

    Parameters
    ----------
    axes : sequence of str
        Some of x, y, z, roll, pitch and yaw, of the parent sensor.
    seen : Excitation
        The motion so far.
    """
    if not _turns_about_one_axis(seen):
        return ()
    main = AXES[int(np.argmax(seen.rotation))]
    return tuple(axis for axis in axes if axis == main)


def _turns_about_one_axis(seen: Excitation) -> bool:
    """Return whether the motion has rotation about exactly one axis."""
    return int((seen.rotation < MIN_ROTATION).sum()) == 2


def _rotations_in_words(rotations: Sequence[int], seen: Excitation) -> str:
    """Return how to turn about axes, given by index."""
    if seen.has_vehicle_axes:
        return listing([_MANOEUVRES[index] for index in rotations])
    names = ["xyz"[index] for index in rotations]
    return f"rotate the sensors more about {listing(names)}"


def _motion_for(name: str, seen: Excitation) -> int | str:
    """Return the motion that reveals most about the axis ``name``.

    A rotation about an axis is returned as the index of this axis, other motions as text.
    """
    rotation = seen.rotation
    if rotation.max() < MIN_ROTATION:
        if seen.drives:
            return "move in curves, to both sides"
        return "rotate the sensors, about all axes"
    axis = AXES.index(name) % 3
    others = [other for other in range(3) if other != axis]
    is_main = axis == int(np.argmax(rotation))
    turns_about_one_axis = _turns_about_one_axis(seen)
    if turns_about_one_axis and is_main:
        return _motion_for_only_axis(name, others, seen)
    if turns_about_one_axis and seen.drives:
        return "drive tighter curves to both sides"
    return min(others, key=lambda other: float(rotation[other]))


def _motion_for_only_axis(
    name: str, others: Sequence[int], seen: Excitation
) -> str:
    """Describe the motion that reveals most about the axis of all rotation so far.

    ``others`` are the indices of the other two axes.
    """
    if name in ROTATIONS:
        return "move farther, straight on and in curves"
    if seen.drives:
        return _ON_A_FLAT_FLOOR
    axes = " and ".join("xyz"[other] for other in others)
    return f"tilt the sensors about {axes}, or measure it by hand"
