"""How the parent sensor has moved, and in words what its motion does not show: hints for a person
who is still recording.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.covariance import (
    ROTATIONS,
    TRANSLATIONS,
    WEAK_ROTATION,
    WEAK_TRANSLATION,
)
from hand_eye_calib.assessment.lever_arm import LeverArms
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.results.calibration import Calibration, DofObservability, DofVerdict
from hand_eye_calib.stats import median, quantile
from hand_eye_calib.text import amount, angle, length, listing

# Most poses that are looked at, evenly over the session: enough to see curves, and few enough to
# cost a few milliseconds.
_MAX_POSES = 500

# The rotation about an axis is this quantile of all motions: one outlier is not a rotation.
_QUANTILE = 0.95

# Smallest rotation (rad) that reveals anything of a lever arm.
MIN_ROTATION = float(np.radians(5.0))

# A sensor moves if it does so faster than this over a second (m/s, rad/s).
_MIN_SPEED, _MIN_RATE = 0.05, float(np.radians(1.0))
_STEP_NS = 1_000_000_000

# Wheels and tracks move a sensor along one axis of its own: at least this share of its squared
# directions. Directions of the shorter steps, below this share of the median, are noise. (Road
# vehicles: 0.95 to 1; handheld devices, drones and robot arms: 0.4 to 0.85.)
_ALONG_ONE_AXIS, _LONG_STEP = 0.9, 0.3

_ROTATION_ABOUT = dict(zip(TRANSLATIONS, ROTATIONS, strict=True))


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
    lever_arms : LeverArms
        How far the rotations move lever arms, over the time span with the most of it.
    distance : float
        Length of the path, m.
    motion_s : float
        Seconds during which the sensor moved; a robot that stands still shows nothing.
    drives : bool
        The sensor moves as on a vehicle, along one axis of its own; also if it has not moved yet.
    """

    n_poses: int
    rotation: FloatArray
    lever_arms: LeverArms
    distance: float
    motion_s: float = 0.0
    drives: bool = True

    @property
    def gain(self) -> FloatArray:
        """(3,) array: root mean square displacement of lever arms of 1 m along x, y and z, in m:
        how well an offset shows. 0 to 2.
        """
        return np.sqrt(np.maximum(np.diag(self.lever_arms.information), 0.0))

    @property
    def worst(self) -> FloatArray:
        """(3,) array: unit vector of the lever arm that the rotations move least."""
        return self.lever_arms.directions[:, 0]

    @property
    def worst_gain(self) -> float:
        """Gain of that lever arm."""
        return float(np.sqrt(max(self.lever_arms.powers[0], 0.0)))

    def hidden_axes(self) -> tuple[str, ...]:
        """Axes x, y, z along which the motion cannot show the translation, whatever the noise."""
        if self.rotation.max() < MIN_ROTATION:
            return TRANSLATIONS
        return self.lever_arms.hidden_axes()


def excitation(pose_pairs: PosePairs) -> Excitation:
    """The Excitation in synchronised poses.

    Parameters
    ----------
    pose_pairs : PosePairs

    Returns
    -------
    Excitation
    """
    n_poses = len(pose_pairs)
    rotation, lever_arms = np.zeros(3), LeverArms.of(np.zeros((1, 3, 3)))
    if n_poses < 2:
        return Excitation(n_poses, rotation, lever_arms, 0.0)
    rows = np.linspace(0, n_poses - 1, min(n_poses, _MAX_POSES)).astype(int)
    poses = pose_pairs.Ts_pw_p[rows]
    lag = 1
    while lag < len(poses):
        rotations = np.swapaxes(poses[:-lag, :3, :3], 1, 2) @ poses[lag:, :3, :3]
        angles = np.abs(se3.rotation_log(rotations))
        rotation = np.maximum(rotation, [quantile(angle, _QUANTILE) for angle in angles.T])
        at_lag = LeverArms.of(rotations - np.eye(3))
        if np.trace(at_lag.information) > np.trace(lever_arms.information):
            lever_arms = at_lag
        lag *= 2
    distance = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
    return Excitation(
        n_poses, rotation, lever_arms, distance, seconds_of_motion(pose_pairs), _drives(poses)
    )


def _drives(poses: FloatArray) -> bool:
    """Whether poses (N, 4, 4) move along one axis of their own."""
    shares = [_share_of_main_direction(poses, lag) for lag in (1, 2, 4) if lag < len(poses)]
    return max(shares, default=1.0) >= _ALONG_ONE_AXIS


def _share_of_main_direction(poses: FloatArray, lag: int) -> float:
    steps = poses[lag:, :3, 3] - poses[:-lag, :3, 3]
    lengths = np.linalg.norm(steps, axis=1)
    long = (lengths > _LONG_STEP * median(lengths)) & (lengths > 0)
    if not long.any():
        return 1.0
    own = np.einsum("nji,nj->ni", poses[:-lag, :3, :3], steps)[long] / lengths[long, None]
    return float(np.linalg.eigvalsh(own.T @ own / len(own))[-1])


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
    moves = (speeds > _MIN_SPEED) | (se3.rotation_angle(rotations) / seconds > _MIN_RATE)
    return float(seconds[moves].sum())


def what_is_missing(seen: Excitation, calibration: Calibration | None = None) -> str:
    """What the motion so far does not show, and what to do about it, in one sentence.

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
    hidden = seen.hidden_axes()
    if calibration:
        reach = set(calibration.out_of_reach)
        hidden = tuple(axis for axis in calibration.unobservable() if axis not in reach)
    if not hidden:
        return _weak(calibration, seen) if calibration else ""
    angles = dict(zip("xyz", seen.rotation.tolist(), strict=True))
    most = max(angles.values())
    if most < MIN_ROTATION:
        turn = "drive curves in both directions" if seen.drives else "rotate about all axes"
        return (
            f"hardly any rotation so far (at most {_degrees(most)}): {listing(hidden)} not "
            f"observable, {turn}"
        )
    fine = [axis for axis, angle in angles.items() if angle >= MIN_ROTATION]
    small = [axis for axis in angles if axis not in fine]
    text = (
        f"rotation about {listing(fine)} is fine ({listing([_degrees(angles[a]) for a in fine])})"
    )
    if small:
        below = _degrees(max(angles[axis] for axis in small), round_up=True)
        text += f"; {listing([_ROTATION_ABOUT[axis] for axis in small])} under {below}"
    vertical = TRANSLATIONS[int(np.argmax(seen.rotation))] if seen.drives else ""
    names = listing([_described(name, vertical) for name in hidden])
    return f"{text}: {names} not observable, {_advice(hidden, small, seen.drives)}"


def _described(name: str, vertical: str) -> str:
    if name == vertical:
        return f"vertical offset ({name})"
    return f"offset {name}" if name in TRANSLATIONS else name


_ROTATE_ABOUT_OTHERS = "rotate by 20 deg and more about the other two axes"


def _advice(hidden: Sequence[str], small: Sequence[str], drives: bool) -> str:
    if not any(name in TRANSLATIONS for name in hidden):
        return "rotate about other axes as well"
    if len(small) >= 2:
        them = "it" if len(hidden) == 1 else "them"
        tilt = "drive over a ramp or a kerb" if drives else _ROTATE_ABOUT_OTHERS
        return f"{tilt}, or measure {them} by hand"
    return "rotate further about the other axes"


def _weak(calibration: Calibration, seen: Excitation) -> str:
    weak = [dof for dof in calibration.observability if dof.verdict is DofVerdict.WEAK]
    if not weak:
        return ""
    limits = f"{length(WEAK_TRANSLATION)} or {angle(WEAK_ROTATION)}"
    return (
        f"{listing([_with_sigma(dof) for dof in weak])} still more uncertain than {limits}: "
        f"continue, with {'more curves' if seen.drives else 'larger rotations about all axes'}"
    )


def _with_sigma(dof: DofObservability) -> str:
    return f"{dof.name} (+/- {amount(dof.name, dof.sigma)})"


def _degrees(angle: float, round_up: bool = False) -> str:
    degrees = float(np.degrees(angle))
    if round_up:
        return f"{max(np.ceil(degrees), 1.0):.0f} deg"
    return f"{degrees:.0f} deg" if degrees >= 10 else f"{degrees:.1f} deg"
