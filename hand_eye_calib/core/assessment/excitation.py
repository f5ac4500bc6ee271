"""Motion of the parent sensor so far, and hints on the motion that is missing."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from hand_eye_calib.core.assessment.covariance import hidden_axes, lever_arm_products
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import median, quantile
from hand_eye_calib.core.base.text import axes_in_words, listing
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.core.results.calibration import Calibration, DofVerdict
from hand_eye_calib.core.results.records import ROTATIONS, TRANSLATIONS

# Largest number of poses, evenly over the session: enough for curves, and some milliseconds.
_MAX_POSES = 500

# Quantile of all motions that is the rotation about an axis: one outlier is not a rotation.
_QUANTILE = 0.95

# Smallest rotation (rad) that reveals anything of a lever arm.
MIN_ROTATION = float(np.radians(5.0))

# Speed over a second (m/s) above which a sensor moves.
_MOVES_M_S = 0.05
# Angular rate over a second (rad/s) above which a sensor moves.
_MOVES_RAD_S = float(np.radians(1.0))
_STEP_NS = 1_000_000_000

# Least share of the squared directions along one axis of the sensor if wheels or tracks move it;
# also the least cosine to x of a motion along x. Measured: road vehicles 0.95 to 1; handheld
# devices, drones and robot arms 0.4 to 0.85.
_ALONG_ONE_AXIS = 0.9
# Directions of steps below this share of the median are noise.
_LONG_STEP = 0.3
# Manoeuvres that turn a vehicle about its x, y and z.
_MANOEUVRES = ("one wheel over a kerb", "over a ramp or a bump", "curves to both sides")


@dataclass(frozen=True)
class Excitation:
    """Motion of the parent sensor, in its own axes.

    Attributes
    ----------
    n_poses : int
        Synchronised pose pairs of the session.
    rotation : (3,) array
        Rotation about x, y and z, rad: the 95th percentile over the session, of the time span with
        the most rotation.
    lever_arms : (3, 3) array
        :func:`~hand_eye_calib.core.assessment.covariance.lever_arm_products` of the rotations over
        the time span with the largest displacement of lever arms.
    distance : float
        Length of the path, m.
    motion_s : float
        Seconds during which the sensor moved. A robot at rest reveals nothing.
    drives : bool
        Whether the sensor moves along one axis of its own, as on a vehicle; also if it has not
        moved yet.
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
        turns_about_z = self.rotation[2] >= max(self.rotation.max(), MIN_ROTATION)
        moves_along_x = abs(self.forward[0]) > _ALONG_ONE_AXIS
        return bool(self.drives and turns_about_z and moves_along_x)

    def hidden_axes(self) -> tuple[str, ...]:
        """Return the axes x, y, z along which the motion hides the translation, without noise."""
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
    lag = 1
    while lag < len(poses):
        rotations = np.swapaxes(poses[:-lag, :3, :3], 1, 2) @ poses[lag:, :3, :3]
        angles = np.abs(se3.rotation_log(rotations))
        rotation = np.maximum(rotation, [quantile(angle, _QUANTILE) for angle in angles.T])
        products = lever_arm_products(rotations - np.eye(3))
        if np.trace(products) > np.trace(lever_arms):
            lever_arms = products
        lag *= 2
    directions = [_main_direction(poses, lag) for lag in (1, 2, 4) if lag < len(poses)]
    share, forward = max(directions, key=lambda direction: direction[0])
    return Excitation(
        n_poses=n_poses,
        rotation=rotation,
        lever_arms=lever_arms,
        distance=float(np.linalg.norm(np.diff(se3.translation_of(poses), axis=0), axis=1).sum()),
        motion_s=seconds_of_motion(pose_pairs),
        drives=share >= _ALONG_ONE_AXIS,
        forward=forward,
    )


def _main_direction(poses: FloatArray, lag: int) -> tuple[float, FloatArray]:
    """Share of the main direction in all motion of poses (N, 4, 4), and its axis in the sensor."""
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
    """Return the seconds during which the parent sensor moved, by poses a second apart."""
    stamps_ns = pose_pairs.stamps_ns
    rows = np.unique((stamps_ns - stamps_ns[0]) // _STEP_NS, return_index=True)[1]
    if len(rows) < 2:
        return 0.0
    durations_s = np.diff(stamps_ns[rows]) * 1e-9
    poses = pose_pairs.Ts_pw_p[rows]
    speeds = np.linalg.norm(np.diff(se3.translation_of(poses), axis=0), axis=1) / durations_s
    rotations = np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]
    rates = se3.rotation_angle(rotations) / durations_s
    is_moving = (speeds > _MOVES_M_S) | (rates > _MOVES_RAD_S)
    return float(durations_s[is_moving].sum())


def what_is_missing(seen: Excitation, calibration: Calibration | None = None) -> str:
    """Describe what the motion so far does not determine, and the motion that would.

    Parameters
    ----------
    seen : Excitation
        Motion of the parent sensor; x, y, z are its axes.
    calibration : Calibration, optional
        The result from the same poses. Its verdicts decide if given.

    Returns
    -------
    str
        Empty if nothing is missing.
    """
    axes = [*seen.hidden_axes()]
    problem = "cannot be determined from"
    if calibration:
        axes = calibration.hidden
        if not axes:
            verdicts = calibration.observability
            problem = "still uncertain after"
            axes = [dof.name for dof in verdicts if dof.verdict is DofVerdict.WEAK]
    if not axes:
        return ""
    return f"{axes_in_words(axes)} {problem} the motion so far: {helpful_motion(axes, seen)}"


def helpful_motion(axes: Sequence[str], seen: Excitation) -> str:
    """Describe the motion that reveals most about these axes.

    A rotation about one axis reveals offsets and angles across this axis, never along it.

    Parameters
    ----------
    axes : sequence of str
        Of x, y, z, roll, pitch and yaw, about the axes of the parent sensor.
    seen : Excitation
        The motion so far.
    """
    return listing([*dict.fromkeys(_motion_for(axis, seen) for axis in axes)])


def _motion_for(name: str, seen: Excitation) -> str:
    """Describe the motion that reveals most about one axis."""
    rotation = seen.rotation
    if rotation.max() < MIN_ROTATION:
        if seen.drives:
            return "move in curves, to both sides"
        return "rotate the sensors, about all axes"
    main = int(np.argmax(rotation))
    is_rotation = name in ROTATIONS
    axis = (ROTATIONS if is_rotation else TRANSLATIONS).index(name)
    across = [other for other in range(3) if other != axis]
    turns_about_one_axis = int((rotation < MIN_ROTATION).sum()) == 2
    if not turns_about_one_axis or not (seen.drives or axis == main):
        least = min(across, key=lambda other: rotation[other])
        hint = f"rotations about {'xyz'[least]} help most"
        return f"{hint} ({_MANOEUVRES[least]})" if seen.has_vehicle_axes else hint
    if axis != main:
        return "tighter curves to both sides help most"
    if is_rotation:
        return "move farther, straight on and in curves"
    if seen.drives:
        tilt = "over a ramp or a kerb"
    else:
        tilt = "about " + " and ".join("xyz"[other] for other in across)
    return f"tilt the sensors {tilt}, or measure it by hand"
