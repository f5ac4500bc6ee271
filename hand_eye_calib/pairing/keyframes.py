"""Selection of the synchronised poses that are kept."""

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.synchronise import PosePairs

# Number of poses checked at once in the search for the next keyframe.
_WINDOW = 64


def select_keyframes(
    pose_pairs: PosePairs,
    min_translation: float,
    min_rotation: float,
    min_interval_s: float,
    previous: PosePairs | None = None,
) -> IntArray:
    """Indices of the pose pairs to keep, in order.

    A pose pair is kept if ``min_interval_s`` has passed since the last one kept and the parent
    sensor has since moved ``min_translation`` or rotated by ``min_rotation``. A threshold of zero
    switches that criterion off.

    Parameters
    ----------
    pose_pairs : PosePairs
    min_translation, min_rotation, min_interval_s : float
        In m, rad and s.
    previous : PosePairs, optional
        The last one kept before these, of length 1 (0 for none).

    Returns
    -------
    (M,) int array
    """
    n_poses = len(pose_pairs)
    if n_poses == 0 or max(min_translation, min_rotation, min_interval_s) == 0.0:
        return np.arange(n_poses)
    stamps_ns, poses = pose_pairs.stamps_ns, pose_pairs.Ts_pw_p
    if previous is not None and len(previous):
        kept, last_stamp_ns, T_last = [], previous.stamps_ns[-1], previous.Ts_pw_p[-1]
    else:
        kept, last_stamp_ns, T_last = [0], stamps_ns[0], poses[0]
    next_index = len(kept)
    while next_index < n_poses:
        window = slice(next_index, next_index + _WINDOW)
        wanted = stamps_ns[window] - last_stamp_ns >= min_interval_s * 1e9
        if min_translation > 0.0 or min_rotation > 0.0:
            wanted &= _has_moved(T_last, poses[window], min_translation, min_rotation)
        hits = np.flatnonzero(wanted)
        if hits.size == 0:
            next_index += _WINDOW
            continue
        index = next_index + int(hits[0])
        kept.append(index)
        last_stamp_ns, T_last, next_index = stamps_ns[index], poses[index], index + 1
    return np.array(kept, dtype=int)


def _has_moved(
    T_last: FloatArray, poses: FloatArray, min_translation: float, min_rotation: float
) -> BoolArray:
    """Whether each pose (N, 4, 4) is at least one of both thresholds away from the last."""
    moved = np.zeros(len(poses), dtype=bool)
    if min_translation > 0.0:
        moved |= np.linalg.norm(poses[:, :3, 3] - T_last[:3, 3], axis=1) >= min_translation
    if min_rotation > 0.0:
        moved |= se3.rotation_angle(T_last[:3, :3].T @ poses[:, :3, :3]) >= min_rotation
    return moved
