"""Rotations from angular rates: a gyroscope as a stream of orientations that drift."""

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.geometry import se3


def integrated(stamps_ns: IntArray, rates: FloatArray) -> FloatArray:
    """Orientations (N, 3, 3) of a body in its own first axes, from its angular rates.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
        In any order; a step back in time is a rotation back.
    rates : (N, 3) array
        rad/s, about the axes of the body. Between two stamps the mean of both counts.
    """
    intervals_s = np.diff(stamps_ns) * 1e-9
    steps = 0.5 * (rates[1:] + rates[:-1]) * intervals_s[:, None]
    return chained(se3.rotation_exp(steps))


def chained(steps: FloatArray) -> FloatArray:
    """Orientations (N + 1, 3, 3) after each of the rotations (N, 3, 3), from the identity on."""
    rotations = np.concatenate([np.eye(3)[None], steps])
    # Products of all up to each, in as many passes as their number has binary digits.
    span = 1
    while span < len(rotations):
        rotations[span:] = rotations[:-span] @ rotations[span:]
        span *= 2
    return rotations


class RateIntegrator:
    """Integrates the angular rates of one sensor as they come in, in parts of any length."""

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._last_rate = np.zeros(3)
        self._rotation = np.eye(3)

    def quats_xyzw(self, stamps_ns: IntArray, rates: FloatArray) -> FloatArray:
        """Orientations (M, 4), scalar last, at the stamps (M,) of the next rates (M, 3), rad/s."""
        first_ns = stamps_ns[0] if self._last_ns is None else self._last_ns
        before = rates[0] if self._last_ns is None else self._last_rate
        rotations = integrated(
            np.concatenate([[first_ns], stamps_ns]), np.concatenate([[before], rates])
        )
        rotations = self._rotation @ rotations[1:]
        self._last_ns, self._last_rate = int(stamps_ns[-1]), np.array(rates[-1], dtype=float)
        # Rounding adds up over hours.
        left, _, right = np.linalg.svd(rotations[-1])
        self._rotation = left @ right
        return se3.to_quat_xyzw(rotations)
