"""Detect drives on which only the springs of the vehicle reveal the vertical lever arm.

On a flat road a body on springs rolls and pitches by some tenths of a degree, with its
acceleration. Other errors follow acceleration, too: those of clock, scale, scan distortion and
navigation filters. They look like a lever arm along the vertical, and no part of the recording
shows the difference.
Of two pairs of sensors on one car, the vertical came out 1.2 to 1.6 m wrong at a stated 0.16 m.
"""

import numpy as np

from hand_eye_calib.core.assessment.covariance import lever_arm_products
from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.geometry.se3 import rotation_log
from hand_eye_calib.core.pairing.motion_pairs import PosePairs

# Largest tilt (rad, root mean square over the best baseline) of a vehicle on a flat road: 0.50 to
# 0.74 deg on ten recordings of one car, 0.86 to 2.3 deg on nine drives through hilly towns.
_FLAT_RAD = float(np.radians(0.8))

# Least share of the tilt, a coefficient of determination, that acceleration explains if springs
# make it: 0.15 to 0.34 on that car, at most 0.02 on simulated vehicles without springs.
_EXPLAINED = 0.12

# A vehicle turns about one axis: others have at most this share of the rotation.
_SHARE_OF_TILT = 0.04

# Baselines (s) of the acceleration and of the tilt that follows it: springs settle faster.
_SPRING_S = 0.5

# Step (s) and largest number of the poses that are looked at, number of the baselines of the tilt,
# and fewest poses in each.
_STEP_S = 0.1
_MOST_POSES = 10_000
_BASELINES = 6
_FEWEST = 60


def rocking_axis(pose_pairs: PosePairs) -> FloatArray | None:
    """Return the axis (3,) of the parent that only rocking on springs reveals a lever arm along.

    Returns
    -------
    (3,) array or None
        Unit vector in the parent sensor's frame; None if the motion tilts the sensors otherwise, or
        there are too few poses.
    """
    stamps_ns = pose_pairs.stamps_ns
    step_s = median(np.diff(stamps_ns)) * 1e-9
    stride = max(round(_STEP_S / step_s), len(stamps_ns) // _MOST_POSES, 1)
    kept = slice(None, None, stride)
    stamps_ns = stamps_ns[kept]
    if len(stamps_ns) < _FEWEST:
        return None
    streams = [pose_pairs.Ts_pw_p[kept], pose_pairs.Ts_cw_c[kept]]
    axes = [_turning_axis(Ts[:, :3, :3]) for Ts in streams]
    axis = axes[0]
    # Noise makes a tilt seem larger and its cause less clear: the better stream decides.
    if axis is None or min(_largest_tilt(Ts[:, :3, :3]) for Ts in streams) > _FLAT_RAD:
        return None
    shares = [
        _explained(stamps_ns, Ts, of_stream)
        for Ts, of_stream in zip(streams, axes, strict=True)
        if of_stream is not None
    ]
    return axis if max(shares) > _EXPLAINED else None


def _products(rotations: FloatArray, baseline: int) -> FloatArray:
    motions = np.swapaxes(rotations[:-baseline], 1, 2) @ rotations[baseline:]
    return lever_arm_products(motions - np.eye(3))


def _turning_axis(rotations: FloatArray) -> FloatArray | None:
    """Axis (3,) of a sensor that turns about hardly any other; None if there is none."""
    powers, directions = np.linalg.eigh(_products(rotations, len(rotations) // 10))
    is_single = powers[0] < _SHARE_OF_TILT**2 * powers[2]
    return directions[:, 0] if is_single else None


def _largest_tilt(rotations: FloatArray) -> float:
    """Root mean square of the tilt (rad) over the baseline where it is largest."""
    baselines = np.geomspace(1, len(rotations) // 10, _BASELINES).astype(int)
    powers = [np.linalg.eigvalsh(_products(rotations, n))[0] for n in baselines.tolist()]
    return float(np.sqrt(max(*powers, 0.0)))


def _explained(stamps_ns: IntArray, Ts: FloatArray, axis: FloatArray) -> float:
    """Share of the change of tilt that the change of acceleration explains, least squares."""
    step_s = median(np.diff(stamps_ns)) * 1e-9
    span = max(round(_SPRING_S / step_s), 1)
    rotations = Ts[:, :3, :3]
    positions = Ts[:, :3, 3]
    bends = positions[2 * span :] - 2.0 * positions[span:-span] + positions[: -2 * span]
    in_body = np.einsum("nji,nj->ni", rotations[span:-span], bends / (span * step_s) ** 2)
    pushed = in_body[span:] - in_body[:-span]
    turned = np.swapaxes(rotations[span : -2 * span], 1, 2) @ rotations[2 * span : -span]
    level = np.linalg.svd(axis[None])[2][1:].T
    tilts = rotation_log(turned) @ level
    pushes = pushed @ level
    slopes = np.linalg.lstsq(pushes, tilts, rcond=None)[0]
    left = tilts - pushes @ slopes
    return 1.0 - float((left**2).sum() / max((tilts**2).sum(), 1e-30))
