"""How the parent sensor has moved, and in words what it does not show: hints for a person who is
still recording.
"""

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

# Most poses that are looked at, evenly over the session: enough to see curves, and few enough to
# cost a few milliseconds.
_MAX_POSES = 500

# The rotation about an axis is this quantile of all motions: one outlier is not a rotation.
_QUANTILE = 0.95

# Smallest rotation (rad) that reveals anything of a lever arm.
MIN_ROTATION = float(np.radians(5.0))

# A sensor moves if it does so faster than this over a second (m/s, rad/s).
_MOVES = 0.05, float(np.radians(1.0))
_STEP_NS = 1_000_000_000

# Wheels and tracks move a sensor along one axis of its own: at least this share of its squared
# directions; it is x from this cosine on. Directions of the shorter steps, below this share of the
# median, are noise. (Road vehicles: 0.95 to 1; handheld devices, drones and robot arms: 0.4 to
# 0.85.)
_ALONG_ONE_AXIS = 0.9
_LONG_STEP = 0.3
# What turns a vehicle about its x, y and z.
_MANOEUVRES = ("one wheel over a kerb", "over a ramp or a bump", "curves to both sides")


@dataclass(frozen=True)
class Excitation:
    """How the parent sensor has moved, in its own axes.

    Attributes
    ----------
    n_poses : int
        Synchronised pose pairs of the session.
    rotation : (3,) array
        Rotation about x, y and z, rad: the 95th percentile over the session, of the time span with
        the most rotation.
    lever_arms : (3, 3) array
        How far the rotations move lever arms, over the time span with the most of it: their
        :func:`~hand_eye_calib.core.assessment.covariance.lever_arm_products`.
    distance : float
        Length of the path, m.
    motion_s : float
        Seconds during which the sensor moved; a robot that stands still shows nothing.
    drives : bool
        The sensor moves as on a vehicle, along one axis of its own; also if it has not moved yet.
    forward : (3,) array
        Unit vector of the direction that it moves along most; 0 if it has not moved.
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
        """Whether x is along the motion and z is what it turns about, as REP 103 has it."""
        turns_about_z = self.rotation[2] >= max(self.rotation.max(), MIN_ROTATION)
        return bool(self.drives and turns_about_z and abs(self.forward[0]) > _ALONG_ONE_AXIS)

    def hidden_axes(self) -> tuple[str, ...]:
        """Axes x, y, z along which the motion cannot show the translation, whatever the noise."""
        if self.rotation.max() < MIN_ROTATION:
            return TRANSLATIONS
        return hidden_axes(self.lever_arms)


def excitation(pose_pairs: PosePairs) -> Excitation:
    """The Excitation in synchronised poses."""
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
        at_lag = lever_arm_products(rotations - np.eye(3))
        if np.trace(at_lag) > np.trace(lever_arms):
            lever_arms = at_lag
        lag *= 2
    distance = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
    found = [_main_direction(poses, lag) for lag in (1, 2, 4) if lag < len(poses)]
    share, forward = max(found, key=lambda each: each[0])
    motion_s = seconds_of_motion(pose_pairs)
    drives = share >= _ALONG_ONE_AXIS
    return Excitation(n_poses, rotation, lever_arms, distance, motion_s, drives, forward)


def _main_direction(poses: FloatArray, lag: int) -> tuple[float, FloatArray]:
    """The axis of their own that poses (N, 4, 4) move along, and its share of all motion."""
    steps = poses[lag:, :3, 3] - poses[:-lag, :3, 3]
    lengths = np.linalg.norm(steps, axis=1)
    long = (lengths > _LONG_STEP * median(lengths)) & (lengths > 0)
    if not long.any():
        return 1.0, np.zeros(3)
    own = np.einsum("nji,nj->ni", poses[:-lag, :3, :3], steps)[long] / lengths[long, None]
    shares, axes = np.linalg.eigh(own.T @ own / len(own))
    return float(shares[-1]), axes[:, -1]


def seconds_of_motion(pose_pairs: PosePairs) -> float:
    """Seconds during which the parent sensor moved, by poses that are a second apart or more."""
    stamps_ns = pose_pairs.stamps_ns
    rows = np.unique((stamps_ns - stamps_ns[0]) // _STEP_NS, return_index=True)[1]
    if len(rows) < 2:
        return 0.0
    seconds = np.diff(stamps_ns[rows]) * 1e-9
    poses = pose_pairs.Ts_pw_p[rows]
    speeds = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / seconds
    rotations = np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]
    moves = (speeds > _MOVES[0]) | (se3.rotation_angle(rotations) / seconds > _MOVES[1])
    return float(seconds[moves].sum())


def what_is_missing(seen: Excitation, calibration: Calibration | None = None) -> str:
    """What cannot be determined from the motion so far, and the motion that would show it.

    Parameters
    ----------
    seen : Excitation
        Of the parent sensor; x, y, z are its axes.
    calibration : Calibration, optional
        The result from those poses. If there is one, its verdicts decide.

    Returns
    -------
    str
        Empty if nothing is missing.
    """
    axes = [*seen.hidden_axes()]
    what = "cannot be determined from"
    if calibration:
        axes = calibration.hidden
        if not axes:
            known = calibration.observability
            what = "still uncertain after"
            axes = [dof.name for dof in known if dof.verdict is DofVerdict.WEAK]
    if not axes:
        return ""
    return f"{axes_in_words(axes)} {what} the motion so far: {helpful_motion(axes, seen)}"


def helpful_motion(axes: Sequence[str], seen: Excitation) -> str:
    """The motion that would show most about these axes, in words.

    A rotation about one axis shows offsets and angles across it, never those along it.

    Parameters
    ----------
    axes : sequence of str
        Of x, y, z, roll, pitch and yaw, about the axes of the parent sensor.
    seen : Excitation
        The motion so far.
    """
    return listing([*dict.fromkeys(_motion_for(axis, seen) for axis in axes)])


def _motion_for(axis: str, seen: Excitation) -> str:
    rotation = seen.rotation
    if rotation.max() < MIN_ROTATION:
        return (
            "move in curves, to both sides" if seen.drives else "rotate the sensors, about all axes"
        )
    main = int(np.argmax(rotation))
    along = (TRANSLATIONS if axis in TRANSLATIONS else ROTATIONS).index(axis)
    is_planar = int((rotation < MIN_ROTATION).sum()) == 2 and (seen.drives or along == main)
    if not is_planar:
        least = min((each for each in range(3) if each != along), key=lambda each: rotation[each])
        like = f" ({_MANOEUVRES[least]})" * seen.has_vehicle_axes
        return f"rotations about {'xyz'[least]} help most{like}"
    if along != main:
        return "tighter curves to both sides help most"
    if axis in ROTATIONS:
        return "move farther, straight on and in curves"
    others = " and ".join(name for index, name in enumerate("xyz") if index != main)
    tilt = "over a ramp or a kerb" if seen.drives else f"about {others}"
    return f"tilt the sensors {tilt}, or measure it by hand"
