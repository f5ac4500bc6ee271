"""Positions and stamps that cannot be right."""

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry.trajectory import FARTHEST_M, far_position

# A delay against the bag's time is of a wrong stamp if it is this many times farther from both
# neighbours than these from each other (and than the usual step), and this far.
_FACTOR, _SMALLEST_JUMP_S = 10.0, 0.5


def check_positions(positions: FloatArray) -> None:
    """Refuse positions (N, 3) that are too far from the origin to be poses of a sensor.

    Raises
    ------
    InputError
        At the first; its attribute ``index`` has the row.
    """
    is_far = (np.abs(positions) > FARTHEST_M).any(axis=1)
    if is_far.any():
        index = int(np.argmax(is_far))
        error = InputError(far_position(*positions[index]))
        error.index = index  # type: ignore[attr-defined]
        raise error


def are_believable(stamps_ns: IntArray, bag_ns: IntArray) -> BoolArray:
    """Mask (N,) of the stamps (N,) that can be right, of messages in the order of the recording.

    A single stamp that jumps away from the bag's own time (N,) and back is wrong: with it, a
    recording of minutes would last for years.
    """
    if len(stamps_ns) < 3:
        return np.ones(len(stamps_ns), dtype=bool)
    delays_s = np.asarray(bag_ns - stamps_ns, dtype=float) * 1e-9
    # At both ends the two neighbours are on one side.
    delays_s = np.r_[delays_s[2], delays_s, delays_s[-3]]
    steps_s, across_s = np.abs(np.diff(delays_s)), np.abs(delays_s[2:] - delays_s[:-2])
    off_s = np.minimum(steps_s[:-1], steps_s[1:])
    usual_s = across_s + np.median(steps_s[1:-1])
    is_believable: BoolArray = (off_s <= _SMALLEST_JUMP_S) | (off_s <= _FACTOR * usual_s)
    return is_believable
