"""Velocities, angular rates and their derivatives from differences between samples.

A difference uses the samples one and two steps before and after a sample, but not the sample
itself. So the white noise of a sample is independent of the derivatives at this sample.
"""

from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.geometry import se3


class Stencil(NamedTuple):
    """Rows (N,) of the samples one and two steps before and after each of N samples.

    At both ends of the recording, the first or last row replaces the missing rows. ``spans_s``
    (N,) is the duration of the four steps.
    """

    before_2: IntArray
    before: IntArray
    after: IntArray
    after_2: IntArray
    spans_s: FloatArray

    @property
    def step_s(self) -> FloatArray:
        """Duration (N, 1) of a step."""
        steps_s = np.maximum(self.spans_s / 4.0, 1e-9)
        return steps_s[:, None]


def stencil(stamps_s: FloatArray, step: int) -> Stencil:
    """Return the rows one and two steps before and after each sample with stamps (N,).

    A step has ``step`` samples. Rows beyond an end of the recording are replaced by this end.
    """
    rows = np.arange(len(stamps_s))
    last = len(stamps_s) - 1
    before_2, before, after, after_2 = (
        np.clip(rows + k * step, 0, last) for k in (-2, -1, 1, 2)
    )
    spans_s = stamps_s[after_2] - stamps_s[before_2]
    return Stencil(before_2, before, after, after_2, spans_s)


def path_derivatives(
    path: FloatArray, around: Stencil, step_s: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """Return velocities and accelerations (N, 3) of a path (N, 3).

    ``step_s`` is the duration of a step: one value, or (N, 1).
    """
    before_2, before, after, after_2, _ = around
    velocities = (path[after] - path[before]) / (2.0 * step_s)
    bends = path[after_2] - path[after] - path[before] + path[before_2]
    accelerations = bends / (3.0 * step_s**2)
    return velocities, accelerations


def rotations_around(
    orientations: FloatArray, around: Stencil
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return rotation vectors (N, 3) around each of N orientations (N, 3, 3).

    The three vectors are the rotations over the two middle steps, over the first step and over the
    last step, in the axes at the start of each rotation.
    """
    before_2, before, after, after_2, _ = around
    return (
        se3.rotations_between(orientations[before], orientations[after]),
        se3.rotations_between(orientations[before_2], orientations[before]),
        se3.rotations_between(orientations[after], orientations[after_2]),
    )
