"""What the joint solve of a rig looks at: increments of every sensor's error.

Everything is expressed in the frame of the first sensor. With its motion A between two instants,
the motion B_k of sensor k and its pose X_k in the frame of the first one,

    e_k = Log(A^-1 X_k B_k X_k^-1) = n_k - n_0 + (I - Ad(A^-1)) xi_k

for X_k replaced by ``Exp(-xi_k) X_k``. n_k are the increments of the error of sensor k: white
errors c at the poses, and a random walk w,

    n_k(i) = c_k(i + 1) - Ad(A_i^-1) c_k(i) + w_k(i)

so that the n_0 that all e_k share tells the noise of every single sensor from that of the others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.adaptive.increments import motions, turned
from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.rig.table import Table


@dataclass(frozen=True)
class Aligned:
    """Clock and lengths of the sensors behind the first one: what is estimated along with X.

    Attributes
    ----------
    with_time, with_scale : tuple of int
        Sensors whose time offset, whose scale was estimated.
    """

    with_time: tuple[int, ...] = ()
    with_scale: tuple[int, ...] = ()

    @property
    def n_parameters(self) -> int:
        """Number of parameters beside the extrinsics."""
        return len(self.with_time) + len(self.with_scale)


#: Neither clock nor lengths were estimated.
NOTHING = Aligned()


@dataclass(frozen=True)
class Increments:
    """Linearised increments of a rig with K + 1 sensors between N poses, n = N - 1.

    Attributes
    ----------
    columns : (n, 6 K, p + 1) array
        Derivatives of e_1 to e_K by xi_1 to xi_K, time offsets (s) and scales, and, last, e itself.
    adjoints : (n, 6, 6) array
        Ad(A^-1).
    """

    columns: FloatArray
    adjoints: FloatArray

    def __len__(self) -> int:
        return len(self.columns)


def linearised(
    table: Table, Xs: FloatArray, motion: FloatArray | None = None, aligned: Aligned = NOTHING
) -> Increments:
    """Residuals and derivatives.

    Parameters
    ----------
    table : Table
    Xs : (K + 1, 4, 4) array
        Poses of the sensors in the frame of the first one.
    motion : (n, 4, 4) array, optional
        Motions of the first sensor freed of errors, to take the derivatives at; as measured by
        default. Derivatives that share the noise of the residuals draw the answer.
    aligned : Aligned
    """
    intervals_s = np.diff(table.stamps_ns) * 1e-9
    measured = motions(table.poses[0])
    motion = measured if motion is None else motion
    adjoints = se3.adjoint(se3.inverse(motion))
    K, n = len(Xs) - 1, len(measured)
    columns = np.zeros((n, 6 * K, 6 * K + aligned.n_parameters + 1))
    back = se3.inverse(measured)
    for sensor in range(1, K + 1):
        rows = slice(6 * sensor - 6, 6 * sensor)
        X = Xs[sensor]
        moved = X @ motions(table.poses[sensor]) @ se3.inverse(X)
        columns[:, rows, rows] = adjoints - np.eye(6)
        columns[:, rows, -1] = se3.log(back @ moved)
    at = 6 * K
    for sensor in aligned.with_time:
        columns[:, 6 * sensor - 6 : 6 * sensor, at] = _by_time(motion, adjoints, intervals_s)
        at += 1
    for sensor in aligned.with_scale:
        columns[:, 6 * sensor - 6 : 6 * sensor, at] = _by_scale(motion, Xs[sensor])
        at += 1
    return Increments(columns, adjoints)


def _by_time(motion: FloatArray, adjoints: FloatArray, intervals_s: FloatArray) -> FloatArray:
    """Derivative (n, 6) by seconds that are added to the stamps of a sensor."""
    rates = se3.log(motion) / intervals_s[:, None]
    padded = np.concatenate([rates[:1], rates, rates[-1:]])
    twists = 0.5 * (padded[:-1] + padded[1:])
    return turned(adjoints, twists[:-1]) - twists[1:]


def _by_scale(motion: FloatArray, X: FloatArray) -> FloatArray:
    """Derivative (n, 6) by a factor of the lengths of the sensor at X, less one."""
    own = se3.inverse(X) @ motion @ X
    steps = np.zeros((len(own), 6))
    steps[:, :3] = -se3.inverse(own)[:, :3, 3]
    return steps @ se3.adjoint(X).T
