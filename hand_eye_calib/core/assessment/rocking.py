"""Detect drives on which only rocking on the vehicle's springs reveals the vertical lever arm.

On a flat road, a body on springs rolls and pitches by some tenths of a degree, in proportion to its
acceleration. Errors of clock, scale, scan distortion and navigation filters are also in proportion
to the acceleration, and so look like a vertical lever arm. On one car, the vertical lever arm
between two pairs of sensors was wrong by 1.2 to 1.6 m with a sigma of 0.16 m.

The test regresses the change of tilt about the level axes on the change of acceleration along them,
over half a second: ``tilt = K acceleration + noise``. A large coefficient of determination means
springs (T. D. Gillespie, *Fundamentals of vehicle dynamics*, 1992).
"""

import numpy as np

from hand_eye_calib.core.assessment.covariance import lever_arm_products
from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import PosePairs

# A road is flat if the tilt (rad) of the vehicle is smaller than this. The tilt is the root mean
# square of its change, at the baseline with the largest value. Measured: 0.50 to 0.74 deg in ten
# recordings of one car on flat roads, 0.86 to 2.3 deg on nine drives through hilly towns.
_FLAT_RAD = float(np.radians(0.8))

# Springs cause the tilt if the coefficient of determination by acceleration exceeds this. Measured:
# 0.15 to 0.34 on the same car, at most 0.02 on simulated vehicles without springs.
_EXPLAINED = 0.12

# A vehicle turns about one axis if its tilt is below this share of the rotation about this axis.
_SHARE_OF_TILT = 0.04

# Time (s) over which changes of velocity and of tilt are computed. Springs settle faster.
_SPRING_S = 0.5

# Interval (s) between the poses that are used.
_STEP_S = 0.1
# Largest number of poses that are used.
_MOST_POSES = 10_000
# Fewest poses that are used.
_LEAST_POSES = 60
# Number of baselines at which the tilt is computed. They range from one pose to a tenth of the
# recording.
_BASELINES = 6


def rocking_axis(pose_pairs: PosePairs) -> FloatArray | None:
    """Return the axis along which only rocking on springs reveals the lever arm, or None.

    Returns
    -------
    (3,) array or None
        Unit vector in the parent sensor's frame. None if other motion tilts the sensors, and for
        too few poses.
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
    # Noise increases the tilt, and decreases the share that acceleration explains. Therefore the
    # less noisy stream decides.
    if _is_tilted(Ts_pw_p) and _is_tilted(Ts_cw_c):
        return None
    share = _explained(stamps_ns, Ts_pw_p, parent_axis)
    child_axis = _turning_axis(se3.rotation_of(Ts_cw_c))
    if child_axis is not None:
        share = max(share, _explained(stamps_ns, Ts_cw_c, child_axis))
    return parent_axis if share > _EXPLAINED else None


def _products(rotations: FloatArray, baseline: int) -> FloatArray:
    """Return the lever arm products (3, 3) of the motions between poses.

    The eigenvector of the smallest eigenvalue is the axis with most rotation.

    Parameters
    ----------
    rotations : (N, 3, 3) array
    baseline : int
        Number of poses between the start and the end of a motion.
    """
    motions = se3.relative_rotations(
        rotations[:-baseline], rotations[baseline:]
    )
    return lever_arm_products(motions - np.eye(3))


def _turning_axis(rotations: FloatArray) -> FloatArray | None:
    """Return the axis (3,) of nearly all rotation in the sensor's frame, or None."""
    products = _products(rotations, len(rotations) // 10)
    powers, directions = np.linalg.eigh(products)
    is_single = powers[0] < _SHARE_OF_TILT**2 * powers[2]
    return directions[:, 0] if is_single else None


def _is_tilted(Ts: FloatArray) -> bool:
    """Return whether the tilt of poses (N, 4, 4) exceeds that on a flat road at a baseline."""
    rotations = se3.rotation_of(Ts)
    longest = len(rotations) // 10
    baselines = np.geomspace(1, longest, _BASELINES).astype(int)
    # The tilt is usually largest at the longest baseline.
    for baseline in baselines[::-1].tolist():
        squared_tilts = np.linalg.eigvalsh(_products(rotations, baseline))
        if squared_tilts[0] > _FLAT_RAD**2:
            return True
    return False


def _explained(stamps_ns: IntArray, Ts: FloatArray, axis: FloatArray) -> float:
    """Return the coefficient of determination of tilt by acceleration, from 0 to 1.

    Both are changes over half a second.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    Ts : (N, 4, 4) array
        Poses of a sensor.
    axis : (3,) array
        The turning axis of the sensor.
    """
    step_s = median(np.diff(stamps_ns)) * 1e-9
    span = max(round(_SPRING_S / step_s), 1)
    rotations = se3.rotation_of(Ts)
    positions = se3.translation_of(Ts)
    second_differences = (
        positions[2 * span :]
        - 2.0 * positions[span:-span]
        + positions[: -2 * span]
    )
    in_world = second_differences / (span * step_s) ** 2
    accelerations = np.einsum("nji,nj->ni", rotations[span:-span], in_world)
    # The two axes perpendicular to the turning axis are level.
    _, _, axes = np.linalg.svd(axis[None])
    level = axes[1:].T
    start = rotations[span : -2 * span]
    end = rotations[2 * span : -span]
    tilts = se3.rotations_between(start, end) @ level
    pushes = (accelerations[span:] - accelerations[:-span]) @ level
    slopes, *_ = np.linalg.lstsq(pushes, tilts, rcond=None)
    residuals = tilts - pushes @ slopes
    total = max((tilts**2).sum(), 1e-30)
    return 1.0 - float((residuals**2).sum() / total)
