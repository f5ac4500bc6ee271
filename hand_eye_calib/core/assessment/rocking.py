"""Detect drives on which only the springs of the vehicle reveal the vertical lever arm.

On a flat road a body on springs rolls and pitches by some tenths of a degree, with its
acceleration. Errors of clock, scale, scan distortion and navigation filters follow acceleration,
too. They look like a lever arm along the vertical, and no part of the recording reveals the
difference. On one car, two pairs of sensors had a vertical that was wrong by 1.2 to 1.6 m at a
stated sigma of 0.16 m.

The test regresses the change of tilt about the level axes on the change of acceleration along them,
over baselines of half a second: ``tilt = K acceleration + noise``. A large coefficient of
determination means springs (T. D. Gillespie, *Fundamentals of vehicle dynamics*, 1992).
"""

import numpy as np

from hand_eye_calib.core.assessment.covariance import lever_arm_products
from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import rotation_log
from hand_eye_calib.core.pairing.motion_pairs import PosePairs

# Largest tilt (rad, root mean square over the baseline with the most) of a vehicle on a flat road.
# Measured: 0.50 to 0.74 deg on ten recordings of one car, 0.86 to 2.3 deg on nine drives through
# hilly towns.
_FLAT_RAD = float(np.radians(0.8))

# Least coefficient of determination of the tilt by acceleration if springs cause it. Measured: 0.15
# to 0.34 on that car, at most 0.02 on simulated vehicles without springs.
_EXPLAINED = 0.12

# A vehicle turns about one axis: the others have at most this share of the rotation.
_SHARE_OF_TILT = 0.04

# Baseline (s) of the acceleration and of the tilt that follows it: springs settle faster.
_SPRING_S = 0.5

# Step (s) between the poses that are used.
_STEP_S = 0.1
# Largest number of poses that are used.
_MOST_POSES = 10_000
# Fewest poses that are used.
_LEAST_POSES = 60
# Number of baselines of the tilt.
_BASELINES = 6


def rocking_axis(pose_pairs: PosePairs) -> FloatArray | None:
    """Return the axis along which only rocking on springs reveals a lever arm.

    Returns
    -------
    (3,) array or None
        Unit vector in the parent sensor's frame; None if other motion tilts the sensors, or there
        are too few poses.
    """
    stamps_ns = pose_pairs.stamps_ns
    step_s = median(np.diff(stamps_ns)) * 1e-9
    stride = max(round(_STEP_S / step_s), len(stamps_ns) // _MOST_POSES, 1)
    kept = slice(None, None, stride)
    stamps_ns = stamps_ns[kept]
    if len(stamps_ns) < _LEAST_POSES:
        return None
    Ts_pw_p = pose_pairs.Ts_pw_p[kept]
    Ts_cw_c = pose_pairs.Ts_cw_c[kept]
    parent_axis = _turning_axis(se3.rotation_of(Ts_pw_p))
    if parent_axis is None:
        return None
    # Noise increases a tilt and hides its cause: the less noisy stream decides.
    tilt_rad = min(_largest_tilt(se3.rotation_of(Ts_pw_p)), _largest_tilt(se3.rotation_of(Ts_cw_c)))
    if tilt_rad > _FLAT_RAD:
        return None
    share = _explained(stamps_ns, Ts_pw_p, parent_axis)
    child_axis = _turning_axis(se3.rotation_of(Ts_cw_c))
    if child_axis is not None:
        share = max(share, _explained(stamps_ns, Ts_cw_c, child_axis))
    return parent_axis if share > _EXPLAINED else None


def _products(rotations: FloatArray, baseline: int) -> FloatArray:
    """Lever arm products (3, 3) of rotations (N, 3, 3) between poses ``baseline`` poses apart."""
    motions = np.swapaxes(rotations[:-baseline], 1, 2) @ rotations[baseline:]
    return lever_arm_products(motions - np.eye(3))


def _turning_axis(rotations: FloatArray) -> FloatArray | None:
    """Axis (3,) in the sensor frame if nearly all rotation is about that axis; None otherwise."""
    powers, directions = np.linalg.eigh(_products(rotations, len(rotations) // 10))
    is_single = powers[0] < _SHARE_OF_TILT**2 * powers[2]
    return directions[:, 0] if is_single else None


def _largest_tilt(rotations: FloatArray) -> float:
    """Root mean square of the tilt (rad) over the baseline where it is largest."""
    baselines = np.geomspace(1, len(rotations) // 10, _BASELINES).astype(int)
    powers = [np.linalg.eigvalsh(_products(rotations, n))[0] for n in baselines.tolist()]
    return float(np.sqrt(max(*powers, 0.0)))


def _explained(stamps_ns: IntArray, Ts: FloatArray, axis: FloatArray) -> float:
    """Coefficient of determination of the change of tilt by the change of acceleration."""
    step_s = median(np.diff(stamps_ns)) * 1e-9
    span = max(round(_SPRING_S / step_s), 1)
    rotations = se3.rotation_of(Ts)
    positions = se3.translation_of(Ts)
    bends = positions[2 * span :] - 2.0 * positions[span:-span] + positions[: -2 * span]
    accelerations = np.einsum("nji,nj->ni", rotations[span:-span], bends / (span * step_s) ** 2)
    motions = np.swapaxes(rotations[span : -2 * span], 1, 2) @ rotations[2 * span : -span]
    # The two axes across the turning axis are level.
    level = np.linalg.svd(axis[None])[2][1:].T
    tilts = rotation_log(motions) @ level
    pushes = (accelerations[span:] - accelerations[:-span]) @ level
    slopes = np.linalg.lstsq(pushes, tilts, rcond=None)[0]
    residuals = tilts - pushes @ slopes
    return 1.0 - float((residuals**2).sum() / max((tilts**2).sum(), 1e-30))
