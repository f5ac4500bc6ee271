"""What single poses cannot tell: a pose or a stamp that does not go with those before and after it.

Most bags have no checksums, so a flipped bit reads as a number like any other. One in a frame's
name, a quaternion or a length is noticed where it is read; one that moves a single pose or stamp is
noticed here, if it moves it farther than noise. What stays within the noise cannot be told from it.
"""

import numpy as np

from hand_eye_calib.errors import InputError

# An isolated pose is one that lies this many times farther from both neighbours than these from
# each other (and than the usual step).
_FACTOR = 10.0
_SMALLEST_JUMP_M, _SMALLEST_JUMP_RAD, _SMALLEST_JUMP_S = 0.2, 0.1, 0.5
_BLOCK = 4096

# Nothing that moves on its own is farther from its world's origin; coordinates from the earth's
# centre are of 6.4e6 m.
_FARTHEST_M = 1e8


class PoseWatch:
    """Looks at the poses of one stream as they pass by.

    Attributes
    ----------
    n_poses, n_jumps, n_stamps : int
        Poses looked at, poses that jump away and back, and poses left out because their stamps do
        so against the bag's own time.
    first_jump, first_stamp : str
        The first of each, for a person.
    """

    def __init__(self):
        self.n_poses = self.n_jumps = self.n_stamps = 0
        self.first_jump = self.first_stamp = ""
        self._blocks = []
        self._is_first = True

    def believable(self, first_number, stamps_ns, bag_ns):
        """Whose stamps to believe among messages in the order in which they were recorded.

        A stamp that alone jumps away from the bag's own time and back is none: with it, a recording
        of minutes would last for years.

        Parameters
        ----------
        first_number : int
            Number of the first message.
        stamps_ns, bag_ns : (N,) int64 arrays

        Returns
        -------
        (N,) array of bool
        """
        if len(stamps_ns) < 3:
            return np.ones(len(stamps_ns), dtype=bool)
        delays_s = (bag_ns - stamps_ns)[:, None] * 1e-9
        jumps_s = _isolated(delays_s, _distance, _SMALLEST_JUMP_S, is_first=True, is_last=True)
        if jumps_s.any():
            self.first_stamp = self.first_stamp or _first(
                jumps_s, "s", first_number + np.arange(len(stamps_ns)), stamps_ns
            )
            self.n_stamps += int((jumps_s > 0).sum())
        return jumps_s == 0

    def add(self, numbers, stamps_ns, poses):
        """Look at poses in the order in which they were recorded.

        Parameters
        ----------
        numbers : (N,) int array
            Of the messages.
        stamps_ns : (N,) int64 array
        poses : (N, 7) array
            x y z qx qy qz qw.

        Raises
        ------
        InputError
            At the first position that is out of this world.
        """
        is_far = np.abs(poses[:, :3]).max(axis=1, initial=0.0) > _FARTHEST_M
        if is_far.any():
            index = int(np.argmax(is_far))
            x, y, z = poses[index, :3]
            raise InputError(
                f"message {numbers[index]}, stamp {_seconds(stamps_ns[index])}: position ({x:.4g}, {y:.4g}, {z:.4g}) is more than "
                f"{_FARTHEST_M:g} m from the origin; the bag is damaged, record it again"
            )
        self.n_poses += len(stamps_ns)
        self._blocks.append((numbers, stamps_ns, poses))
        if sum(len(block[0]) for block in self._blocks) > _BLOCK:
            self._check()

    def warnings(self, name):
        """What has been found, one line each; after the last pose."""
        self._check(is_last=True)
        found = []
        if self.n_jumps:
            found.append(
                f"{name}: {self.n_jumps} of {self.n_poses} poses jump away and back (first {self.first_jump}), as in a damaged bag or when "
                "tracking fails; check the stream, and use a method that rejects outliers"
            )
        if self.n_stamps:
            found.append(
                f"{name}: {self.n_stamps} of {self.n_poses + self.n_stamps} stamps jump away and back against the bag's own time (first "
                f"{self.first_stamp}); their poses were left out, the bag may be damaged"
            )
        return found

    def _check(self, is_last=False):
        if not self._blocks:
            return
        columns = [np.concatenate(column) for column in zip(*self._blocks, strict=True)]
        self._blocks = [tuple(column[-2:] for column in columns)]
        if len(columns[0]) < 3:
            return
        is_first, self._is_first = self._is_first, False
        numbers, stamps_ns, values = columns
        with np.errstate(over="ignore", invalid="ignore"):
            jumps_m = _isolated(values[:, :3], _distance, _SMALLEST_JUMP_M, is_first, is_last)
            jumps_rad = _isolated(values[:, 3:], _angle, _SMALLEST_JUMP_RAD, is_first, is_last)
        is_jump = (jumps_m > 0) | (jumps_rad > 0)
        if is_jump.any():
            jumps, unit = (jumps_m, "m") if jumps_m[np.argmax(is_jump)] else (jumps_rad, "rad")
            self.first_jump = self.first_jump or _first(jumps, unit, numbers, stamps_ns)
            self.n_jumps += int(is_jump.sum())


def _first(jumps, unit, numbers, stamps_ns):
    """The first of the jumps, for a person."""
    index = int(np.flatnonzero(jumps)[0])
    return f"message {numbers[index]}, stamp {_seconds(stamps_ns[index])}, by {jumps[index]:.3g} {unit}"


def _seconds(stamp_ns):
    seconds, nanoseconds = divmod(int(stamp_ns), 10**9)
    return f"{seconds}.{nanoseconds:09d}"


def _isolated(values, distance, smallest, is_first, is_last):
    """(N,) how far each lies off its neighbours; 0 where that is nothing unusual.

    The first and last value, neighbours of those in other blocks, are judged only where the stream
    begins or ends with them.
    """
    steps = distance(values[:-1], values[1:])
    off, usual = np.zeros(len(values)), np.zeros(len(values))
    off[1:-1] = np.minimum(steps[:-1], steps[1:])
    usual[1:-1] = distance(values[:-2], values[2:])
    if is_first:
        off[0], usual[0] = steps[0], steps[1]
    if is_last:
        off[-1], usual[-1] = steps[-1], steps[-2]
    return np.where((off > smallest) & (off > _FACTOR * (usual + np.median(steps))), off, 0.0)


def _distance(first, second):
    return np.linalg.norm(second - first, axis=1)


def _angle(first, second):
    return 2.0 * np.arccos(np.clip(np.abs((first * second).sum(axis=1)), 0.0, 1.0))
