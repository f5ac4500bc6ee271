"""Angular rates to orientations."""

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.geometry import se3


class RateIntegrator:
    """Integrates the angular rates of one sensor as they come in, in parts of any length."""

    def __init__(self) -> None:
        self._last: tuple[IntArray, FloatArray] | None = None
        self._rotation = np.eye(3)

    def rotations(self, stamps_ns: IntArray, rates: FloatArray) -> FloatArray:
        """Orientations (M, 3, 3) of the sensor in its own first axes at the stamps (M,) of the next
        rates (M, 3), rad/s, about its axes. Between two stamps the mean of both counts; a step back
        in time is a rotation back.
        """
        if not len(stamps_ns):
            return np.empty((0, 3, 3))
        last_ns, last_rate = self._last or (stamps_ns[:1], rates[:1])
        intervals_s = np.diff(np.concatenate([last_ns, stamps_ns])) * 1e-9
        means = 0.5 * (rates + np.concatenate([last_rate, rates[:-1]]))
        steps = se3.rotation_exp(means * intervals_s[:, None])
        rotations = self._rotation @ se3.chained(steps)[1:]
        self._last = stamps_ns[-1:].copy(), rates[-1:].copy()
        self._rotation = se3.nearest_rotation(rotations[-1])  # rounding adds up over hours
        return rotations
