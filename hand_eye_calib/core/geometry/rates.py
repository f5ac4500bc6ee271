"""Integration of angular rates to orientations.

The rate over an interval is the mean of the rates at both ends: ``R_j = R_i exp(dt (w_i + w_j) /
2)``. Coning terms are neglected (P. Savage, *Strapdown inertial navigation integration algorithm
design*, 1998).
"""

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.geometry import se3


class RateIntegrator:
    """Integrate the angular rates of one sensor, which arrive in blocks of any length."""

    def __init__(self) -> None:
        self._last: tuple[IntArray, FloatArray] | None = None
        self._rotation = np.eye(3)

    def rotations(self, stamps_ns: IntArray, rates: FloatArray) -> FloatArray:
        """Integrate further rates. Return orientations relative to that at the first rate.

        If the stamps go back in time, the sensor rotates back.

        Parameters
        ----------
        stamps_ns : (M,) int64 array
            Stamps of the next rates.
        rates : (M, 3) array
            Angular rates (rad/s) about the axes of the sensor.

        Returns
        -------
        (M, 3, 3) array
        """
        if not len(stamps_ns):
            return np.empty((0, 3, 3))
        last_ns, last_rate = self._last or (stamps_ns[:1], rates[:1])
        stamps_with_last_ns = np.concatenate([last_ns, stamps_ns])
        intervals_s = np.diff(stamps_with_last_ns) * 1e-9
        previous_rates = np.concatenate([last_rate, rates[:-1]])
        means = 0.5 * (rates + previous_rates)
        steps = se3.rotation_exp(means * intervals_s[:, None])
        rotations = self._rotation @ se3.chained(steps)[1:]
        self._last = stamps_ns[-1:].copy(), rates[-1:].copy()
        # Rounding errors add up over hours. Make the last orientation an exact rotation.
        self._rotation = se3.nearest_rotation(rotations[-1])
        return rotations
