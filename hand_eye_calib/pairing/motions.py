"""Motion pairs over a given time, at any pose rate."""

import numpy as np

from hand_eye_calib.arrays import IntArray
from hand_eye_calib.pairing.motion_pairs import MotionPairs, pairs_between
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.stats import median

_MAX_PAIRS = 800


def pairs_over(pose_pairs: PosePairs, lag_s: float, max_pairs: int = _MAX_PAIRS) -> MotionPairs:
    """Motion pairs between poses about ``lag_s`` seconds apart, evenly over the recording.

    Parameters
    ----------
    pose_pairs : PosePairs
    lag_s : float
        The interval of the poses if that is longer.
    max_pairs : int

    Returns
    -------
    MotionPairs
        Empty if no two poses lie that far apart.
    """
    stamps_ns = pose_pairs.stamps_ns
    if len(stamps_ns) > 1:
        lag_s = max(lag_s, median(np.diff(stamps_ns)) * 1e-9)
    i, j = _indices_over(stamps_ns, lag_s, max_pairs)
    return pairs_between(pose_pairs.Ts_pw_p, pose_pairs.Ts_cw_c, i, j)


def _indices_over(stamps_ns: IntArray, lag_s: float, max_pairs: int) -> tuple[IntArray, IntArray]:
    i = np.linspace(0, len(stamps_ns) - 1, min(len(stamps_ns), max_pairs)).astype(int)
    j = np.searchsorted(stamps_ns, stamps_ns[i] + round(lag_s * 1e9) - 1000)
    inside = j < len(stamps_ns)
    i, j = i[inside], j[inside]
    near = stamps_ns[j] - stamps_ns[i] <= (1.5 * lag_s + 0.1) * 1e9
    return i[near], j[near]
