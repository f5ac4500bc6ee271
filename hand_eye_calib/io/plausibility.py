"""Checks of the poses and stamps of a bag while it is read.

Most bags have no checksums, so a flipped bit reads as a valid value. In a frame's name, a
quaternion or a length the reader finds it, in a stamp or the size of a position it is found here; a
pose that is wrong by less is an outlier like any other.
"""

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


class PoseWatch:
    """Checks the poses of one stream while they are read.

    Attributes
    ----------
    n_stamps : int
        Poses left out because their stamps jump away and back against the bag's own time.
    """

    def __init__(self) -> None:
        self.n_stamps = self._n_poses = 0
        self._first = ""

    def believable(self, first_number: int, stamps_ns: IntArray, bag_ns: IntArray) -> BoolArray:
        """Mask of the stamps that can be right, of messages in the order of the recording.

        A single stamp that jumps away from the bag's own time and back is wrong: with it, a
        recording of minutes would last for years.

        Parameters
        ----------
        first_number : int
            Number of the first message.
        stamps_ns, bag_ns : (N,) int64 arrays

        Returns
        -------
        (N,) array of bool
        """
        delays_s = np.asarray(bag_ns - stamps_ns, dtype=float) * 1e-9
        off_s, usual_s = np.zeros(len(delays_s)), np.zeros(len(delays_s))
        if len(delays_s) > 2:
            steps_s = np.abs(np.diff(delays_s))
            off_s[1:-1] = np.minimum(steps_s[:-1], steps_s[1:])
            usual_s[1:-1] = np.abs(delays_s[2:] - delays_s[:-2]) + np.median(steps_s)
            off_s[[0, -1]] = steps_s[[0, -1]]
            usual_s[[0, -1]] = steps_s[[1, -2]] + np.median(steps_s)
        is_wrong: BoolArray = (off_s > _SMALLEST_JUMP_S) & (off_s > _FACTOR * usual_s)
        if is_wrong.any() and not self.n_stamps:
            row = int(np.argmax(is_wrong))
            seconds, nanoseconds = divmod(int(stamps_ns[row]), 10**9)
            self._first = (
                f"message {first_number + row}, stamp {seconds}.{nanoseconds:09d}, by "
                f"{off_s[row]:.3g} s"
            )
        self.n_stamps += int(is_wrong.sum())
        return ~is_wrong

    def add(self, message_numbers: IntArray, stamps_ns: IntArray, poses: FloatArray) -> None:
        """Check poses (N, 7), x y z qx qy qz qw, in the order of the recording, of messages (N,)
        with stamps (N,).

        Raises
        ------
        InputError
            At the first position that is too far from the origin.
        """
        try:
            check_positions(poses[:, :3])
        except InputError as error:
            row = getattr(error, "index", 0)
            raise InputError(
                f"message {message_numbers[row]}, stamp {stamps_ns[row]} ns: {error}; "
                "the bag is damaged, record it again"
            ) from None
        self._n_poses += len(poses)

    def warnings(self, name: str) -> list[str]:
        """List what was found, one line each; after the last pose."""
        if not self.n_stamps:
            return []
        return [
            f"{name}: {self.n_stamps} of {self._n_poses + self.n_stamps} stamps jump away and back "
            f"against the bag's own time (first {self._first}); their poses were left out, the bag "
            "may be damaged"
        ]
