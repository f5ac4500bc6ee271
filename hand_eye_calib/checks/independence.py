"""Whether two streams are of two sensors, or one was computed from the other.

Two sensors differ by their noise, whatever the extrinsic is. Poses that were computed from others
agree with them to the rounding of their numbers, on the transform that was used. Orientations alone
show it: they follow from the other stream's orientations if the poses do, or if they alone do.
"""

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.checks import findings as wording
from hand_eye_calib.checks.findings import Finding
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.pairing.motion_pairs import pairs_between
from hand_eye_calib.solvers.park import align_rotation_vectors
from hand_eye_calib.stats import quantile

# Orientations are copies if they agree to this angle, several times better than any two sensors of
# the recordings at hand, and so many times better than each stream is rough. Neither is enough:
# slow motion is smooth, and a slow stream of fast motion is rough without noise.
_AGREE_RAD, _BELOW_ROUGHNESS = float(np.radians(0.005)), 50.0

# This share of the poses must agree: the rest may be jumps.
_SHARE = 0.9

# Interpolation adds errors of its own, so that the instants nearest to a pose of both streams are
# compared: this share of them, at least and at most so many.
_NEAREST, _FEWEST, _MOST = 0.01, 40, 1000

# Rotation vectors near half a turn may point either way (rad).
_MAX_ROTATION = 2.8


def check_independent(parent: Trajectory, child: Trajectory, offset_s: float) -> list[Finding]:
    """Finding about streams of which one was computed from the other, or none.

    Parameters
    ----------
    parent, child : Trajectory
    offset_s : float
        Offset that was found; the stamps as they are count as well.
    """
    limit_rad = min(_AGREE_RAD, min(map(_roughness, (parent, child))) / _BELOW_ROUGHNESS)
    for moved in (child, child.shifted(offset_s)):
        # Programs interpolate at the stamps of the new stream, most of them along a straight line.
        for slow, fast in ((moved, parent), (parent, moved)):
            for straight in (True, False):
                residual_rad = _disagreement(slow, fast, straight)
                if residual_rad < limit_rad:
                    return [wording.finding("not_independent", residual_rad=residual_rad)]
    return []


def _roughness(trajectory: Trajectory) -> float:
    """Third difference of the orientations, rad."""
    rotations = trajectory.poses[:, :3, :3]
    steps = se3.rotation_log(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:])
    return _size(np.diff(steps, n=2, axis=0))


def _disagreement(slow: Trajectory, fast: Trajectory, straight: bool) -> float:
    """Angle (rad) that remains between the rotations of two streams, one of them interpolated at
    stamps of the other; infinite if they have too few in common.
    """
    inside = (slow.stamps_ns >= fast.stamps_ns[0]) & (slow.stamps_ns <= fast.stamps_ns[-1])
    indices = np.flatnonzero(inside)
    if len(indices) < 4:
        return np.inf
    after = np.clip(np.searchsorted(fast.stamps_ns, slow.stamps_ns[indices]), 1, len(fast) - 1)
    around = np.abs(fast.stamps_ns[[after - 1, after]] - slow.stamps_ns[indices]).min(axis=0)
    n_nearest = min(max(_FEWEST, round(_NEAREST * len(indices))), len(indices))
    indices = indices[around <= np.partition(around, n_nearest - 1)[n_nearest - 1]]
    indices = indices[:: -(-len(indices) // _MOST)]
    between = fast.at(slow.stamps_ns[indices], straight=straight)
    start = np.arange(len(indices) - 1)
    pairs = pairs_between(between, slow.poses[indices], start, start + 1)
    pairs = pairs[se3.rotation_angle(pairs.Ts_parenti_parentj[:, :3, :3]) < _MAX_ROTATION]
    if len(pairs) < 3:
        return np.inf
    X = se3.from_rotation_translation(align_rotation_vectors(pairs), np.zeros(3))
    return _size(pairs.rotation_residuals(X))


def _size(vectors: FloatArray) -> float:
    return quantile(np.linalg.norm(vectors, axis=1), _SHARE)
