"""The common-mode floor: errors that are the same in every part of a recording.

A camera whose intrinsics are slightly wrong, or a lidar map that is stretched, gives an error that
no statistic of the recording shows: neither the residuals nor the halves know of it. It is stated
beside the covariance, as a floor, and the standard deviation of a result contains both.

The scale is what the data leave open of it; where the frame of a sensor is, and how it is turned,
is known to what odometries on real recordings with a known extrinsic agree to. An odometry whose
gain of rotation is slightly wrong moves its own centre by that share of the distance of what it
sees, which is far where a vehicle is fast: on roads, centres are 6 to 14 cm off, in rooms 1 cm.
"""

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.assessment.excitation import weighted_products
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import MotionPairs
from hand_eye_calib.stats import median

# Standard deviation along (m) and about (rad) each axis, and of the scale of a path.
FLOOR_TRANSLATION = 0.005
FLOOR_ROTATION = float(np.radians(0.15))
FLOOR_SCALE = 0.01
# What is seen is about two seconds of travel away, and rotations are right to 0.25 %: of ten real
# rigs, those on roads agree with 5 to 15 ms, and to the others it makes no difference.
FLOOR_TRAVEL_S = 0.005

# Speeds are those over this time (s), so that noise between neighbouring poses counts little.
_SPEED_OVER_S = 1.0

# Information below this share of the largest is noise: along such directions nothing is known
# anyway.
_MIN_INFORMATION = 1e-6


def common_mode_floor(speed_m_s: float = 0.0) -> FloatArray:
    """Covariance (6, 6) of xi = (rho, phi) that the floor stands for, in the child sensor's frame,
    with a scale that is part of the model; ``speed_m_s`` is the usual one of the recording.
    """
    translation = FLOOR_TRANSLATION**2 + (FLOOR_TRAVEL_S * speed_m_s) ** 2
    return np.diag(np.repeat([translation, FLOOR_ROTATION**2], 3))


def usual_speed(stamps_ns: IntArray, positions: FloatArray) -> float:
    """The speed (m/s) above which half of the path is driven: neither stops nor jumps count.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    positions : (N, 3) array
    """
    step_s = median(np.diff(stamps_ns)) * 1e-9 if len(stamps_ns) > 1 else 1.0
    stride = max(1, round(_SPEED_OVER_S / step_s))
    seconds = np.diff(stamps_ns[::stride]) * 1e-9
    metres = np.linalg.norm(np.diff(positions[::stride], axis=0), axis=1)
    if not metres.any():
        return 0.0
    speeds = metres / seconds
    order = np.argsort(speeds)
    driven = np.cumsum(metres[order])
    return float(speeds[order[np.searchsorted(driven, driven[-1] / 2)]])


def open_scale_floor(by_scale: FloatArray, scale_variance: float) -> FloatArray:
    """What a scale outside the model adds to the floor (6, 6).

    Parameters
    ----------
    by_scale : (6,) array
        Derivative of the answer by the logarithm of the scale of the child's path.
    scale_variance : float
        Of that scale, by the data alone.
    """
    open_variance = FLOOR_SCALE**2 * scale_variance / (FLOOR_SCALE**2 + scale_variance)
    return open_variance * np.outer(by_scale, by_scale)


def floor_of_pairs(
    pairs: MotionPairs, weights: FloatArray, T_parent_child: FloatArray, speed_m_s: float
) -> FloatArray:
    """The floor (6, 6) of an answer that minimises the weighted squared residuals of motion pairs,
    of a recording of this usual speed.

    With the child's translations times s the residual ``(R_A - I) t + t_A - s R t_B`` changes by
    ``-R t_B ds``. Pairs that overlap are as much evidence of the scale as those that do not.
    """
    rotation = T_parent_child[:3, :3]
    moved = pairs.Ts_parenti_parentj[:, :3, :3] - np.eye(3)
    translation_b = pairs.Ts_childi_childj[:, :3, 3]
    residuals = pairs.residuals(T_parent_child)[0][:, :, None]
    push = (translation_b @ rotation.T)[:, :, None]
    jacobian = [moved @ rotation, rotation @ se3.skew(translation_b), push, residuals]
    products = weighted_products(weights, np.concatenate(jacobian, axis=2))
    information, pushed = products[:6, :6].copy(), products[:6, 6]
    turned = pairs.Ts_childi_childj[:, :3, :3] - np.eye(3)
    information[3:, 3:] += 2 * weighted_products(weights, turned)
    by_scale = np.linalg.pinv(information, rcond=_MIN_INFORMATION, hermitian=True) @ pushed
    of_scale = max(float(products[6, 6] - pushed @ by_scale), 1e-30)
    overlap = float(np.mean(pairs.j - pairs.i)) if len(pairs) else 1.0
    variance = overlap * products[7, 7] / max(3.0 * float(weights.sum()) - 7.0, 1.0)
    return common_mode_floor(speed_m_s) + open_scale_floor(by_scale, float(variance / of_scale))
