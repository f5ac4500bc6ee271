"""Common-mode floor: the covariance of errors that are equal in every part of a recording.

Examples are wrong intrinsics of a camera, or a stretched lidar map. Such errors change neither the
residuals nor the difference between both halves of a recording, so the floor cannot be computed
from the recording. It was measured on real recordings with a known extrinsic.

The floor is C_floor in :mod:`hand_eye_calib.core.assessment.covariance`, and the allowance in the
documentation (``docs/uncertainty.md``).
"""

import numpy as np

from hand_eye_calib.core.assessment.covariance import derivatives
from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.noise.normal import multiplied
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs

# Standard deviation (m) along each axis: the origin of an odometry's frame is not exactly in the
# sensor. Measured on real recordings with a known extrinsic.
FLOOR_TRANSLATION = 0.005
# Standard deviation (rad) about each axis. Measured on the same recordings.
FLOOR_ROTATION = float(np.radians(0.15))
# Prior standard deviation of the scale of a path that is not part of the model.
FLOOR_SCALE = 0.01
# Standard deviation along each axis, divided by the speed (s). It is the rotation error of an
# odometry, 0.25 %, times the distance of the scene, about two seconds of travel. Measured on ten
# rigs: the origin is off by 6 to 14 cm on roads, which is 5 to 15 ms of travel, and by 1 cm in
# rooms.
FLOOR_TRAVEL_S = 0.005

# Duration (s) of the mean in a speed. It averages the noise of neighbouring poses.
_SPEED_OVER_S = 1.0

# Directions with less information than this share of the largest are unknown: such information is
# noise.
_MIN_INFORMATION = 1e-6


def common_mode_floor(speed_m_s: float = 0.0) -> FloatArray:
    """Return the common-mode floor if the scale is part of the model.

    Parameters
    ----------
    speed_m_s : float
        Usual speed of the recording.

    Returns
    -------
    (6, 6) array
        Covariance of xi = (rho, phi), in the child sensor's frame.
    """
    translation = FLOOR_TRANSLATION**2 + (FLOOR_TRAVEL_S * speed_m_s) ** 2
    rotation = FLOOR_ROTATION**2
    return np.diag(np.repeat([translation, rotation], 3))


def usual_speed(stamps_ns: IntArray, positions: FloatArray) -> float:
    """Return the speed (m/s) that is exceeded on half of the path.

    Stops and jumps do not change this speed.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    positions : (N, 3) array
    """
    step_s = median(np.diff(stamps_ns)) * 1e-9 if len(stamps_ns) > 1 else 1.0
    stride = max(1, round(_SPEED_OVER_S / step_s))
    durations_s = np.diff(stamps_ns[::stride]) * 1e-9
    lengths_m = np.linalg.norm(np.diff(positions[::stride], axis=0), axis=1)
    if not lengths_m.any():
        return 0.0
    speeds = lengths_m / durations_s
    order = np.argsort(speeds)
    driven_m = np.cumsum(lengths_m[order])
    middle = np.searchsorted(driven_m, driven_m[-1] / 2)
    return float(speeds[order[middle]])


def open_scale_floor(by_scale: FloatArray, scale_variance: float) -> FloatArray:
    """Return the part of the floor (6, 6) for a scale that the model does not contain.

    Parameters
    ----------
    by_scale : (6,) array
        Derivative of the answer with respect to the log scale of the child's path.
    scale_variance : float
        Variance of this scale from the data alone.
    """
    # The inverse variances of the prior and of the data add up.
    open_variance = (
        FLOOR_SCALE**2 * scale_variance / (FLOOR_SCALE**2 + scale_variance)
    )
    return open_variance * np.outer(by_scale, by_scale)


def floor_of_pairs(
    pairs: MotionPairs,
    weights: FloatArray,
    T_parent_child: FloatArray,
    speed_m_s: float,
) -> FloatArray:
    """Return the floor (6, 6) of an answer that minimises the squared residuals of motion pairs.

    A scale s of the child's path changes the residual ``(R_A - I) t + t_A - s R t_B`` by ``-R t_B
    ds``. Overlapping pairs repeat the same data, so the variance is multiplied by the mean overlap.

    Parameters
    ----------
    pairs : MotionPairs
        K motion pairs.
    weights : (K,) array
    T_parent_child : (4, 4) array
    speed_m_s : float
        Usual speed of the recording.
    """
    rotation = se3.rotation_of(T_parent_child)
    by_xi, of_rotation = derivatives(pairs, rotation)
    by_log_scale = se3.translation_of(pairs.Ts_childi_childj) @ rotation.T
    residual_t = pairs.translation_residuals(T_parent_child)
    columns = np.concatenate(
        [by_xi, by_log_scale[:, :, None], residual_t[:, :, None]], axis=2
    )
    weight_of_pair = weights[:, None, None]
    products = multiplied(weight_of_pair * columns, columns)
    information = products[:6, :6].copy()
    information[3:, 3:] += 2 * multiplied(
        weight_of_pair * of_rotation, of_rotation
    )
    coupling = products[:6, 6]
    covariance = np.linalg.pinv(
        information, rcond=_MIN_INFORMATION, hermitian=True
    )
    by_scale = covariance @ coupling
    scale_information = max(float(products[6, 6] - coupling @ by_scale), 1e-30)
    overlap = float(np.mean(pairs.j - pairs.i)) if len(pairs) else 1.0
    n_surplus = max(3.0 * float(weights.sum()) - 7.0, 1.0)
    variance = overlap * products[7, 7] / n_surplus
    scale_variance = float(variance / scale_information)
    return common_mode_floor(speed_m_s) + open_scale_floor(
        by_scale, scale_variance
    )
