"""Checks of poses and stamps against those before and after them.

Most bags have no checksums, so a flipped bit reads as a valid value. A flipped bit in a frame's
name, a quaternion or a length is found by the reader. One that moves a single pose or stamp is
found here, if it moves it farther than the noise of the stream.
"""

from collections.abc import Callable

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry.trajectory import FARTHEST_M, far_position

# An isolated pose lies this many times farther from both neighbours than these from each other (and
# than the usual step).
_FACTOR = 10.0
_SMALLEST_JUMP_M, _SMALLEST_JUMP_RAD, _SMALLEST_JUMP_S = 0.2, 0.1, 0.5


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
        self.n_stamps = 0
        self._first_stamp = ""
        self._poses: list[tuple[IntArray, IntArray, FloatArray]] = []

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
        delays_s = np.asarray(bag_ns - stamps_ns, dtype=float)[:, None] * 1e-9
        jumps_s = _isolated(delays_s, _distance, _SMALLEST_JUMP_S)
        if jumps_s.any():
            row = int(np.flatnonzero(jumps_s)[0])
            first = _jump(first_number + row, stamps_ns[row], jumps_s[row], "s")
            self._first_stamp = self._first_stamp or first
            self.n_stamps += int((jumps_s > 0).sum())
        return jumps_s == 0

    def add(self, message_numbers: IntArray, stamps_ns: IntArray, poses: FloatArray) -> None:
        """Check poses in the order of the recording.

        Parameters
        ----------
        message_numbers : (N,) int array
        stamps_ns : (N,) int64 array
        poses : (N, 7) array
            x y z qx qy qz qw.

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
        self._poses.append((message_numbers, stamps_ns, poses))

    def warnings(self, name: str) -> list[str]:
        """List what was found, one line each; after the last pose."""
        found, n_poses = [], sum(len(poses) for _, _, poses in self._poses)
        if n_poses:
            numbers, stamps_ns, poses = map(np.concatenate, zip(*self._poses, strict=True))
            with np.errstate(over="ignore", invalid="ignore"):
                jumps_m = _isolated(poses[:, :3], _distance, _SMALLEST_JUMP_M)
                jumps_rad = _isolated(poses[:, 3:], _angle, _SMALLEST_JUMP_RAD)
            rows = np.flatnonzero((jumps_m > 0) | (jumps_rad > 0))
            for row in rows[:1]:
                jump, unit = (jumps_m[row], "m") if jumps_m[row] else (jumps_rad[row], "rad")
                first = _jump(int(numbers[row]), int(stamps_ns[row]), jump, unit)
                found.append(
                    f"{name}: {len(rows)} of {n_poses} poses jump away and back (first {first}), "
                    "as in a damaged bag or when tracking fails; check the stream, and use a "
                    "method that rejects outliers"
                )
        if self.n_stamps:
            found.append(
                f"{name}: {self.n_stamps} of {n_poses + self.n_stamps} stamps jump away and back "
                f"against the bag's own time (first {self._first_stamp}); their poses were left "
                "out, the bag may be damaged"
            )
        return found


def _jump(message_number: int, stamp_ns: int, jump: float, unit: str) -> str:
    """A jump, for a person."""
    seconds, nanoseconds = divmod(int(stamp_ns), 10**9)
    return f"message {message_number}, stamp {seconds}.{nanoseconds:09d}, by {jump:.3g} {unit}"


def _isolated(
    values: FloatArray, distance: Callable[[FloatArray, FloatArray], FloatArray], smallest: float
) -> FloatArray:
    """(N,) distance of each value from its neighbours; 0 if that is nothing unusual."""
    off, usual = np.zeros(len(values)), np.zeros(len(values))
    if len(values) < 3:
        return off
    steps = distance(values[:-1], values[1:])
    off[1:-1] = np.minimum(steps[:-1], steps[1:])
    usual[1:-1] = distance(values[:-2], values[2:])
    off[[0, -1]], usual[[0, -1]] = steps[[0, -1]], steps[[1, -2]]
    is_isolated = (off > smallest) & (off > _FACTOR * (usual + np.median(steps)))
    return np.where(is_isolated, off, 0.0)


def _distance(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(second - first, axis=1), dtype=float)


def _angle(first: FloatArray, second: FloatArray) -> FloatArray:
    products: FloatArray = (first * second).sum(axis=1)
    angles: FloatArray = 2.0 * np.arccos(np.clip(np.abs(products), 0.0, 1.0))
    return angles
