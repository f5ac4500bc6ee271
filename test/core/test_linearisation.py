"""Derivatives of the residuals of the noise model."""

import numpy as np
from motions import T_PARENT_CHILD, child_of
from numpy.testing import assert_allclose

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.noise import increments

NO_SYSTEMATIC_ERROR = np.zeros(increments.N_SYSTEMATIC)


def linearised(
    streams, T_parent_child=T_PARENT_CHILD, parameters=NO_SYSTEMATIC_ERROR
):
    course = increments.course_of(streams, T_PARENT_CHILD)
    return increments.linearise(
        streams,
        course,
        T_parent_child,
        parameters,
        list(range(increments.N_SYSTEMATIC)),
    )


def inner_residuals(streams, T_parent_child, parameters):
    """Residuals without those of the first and last three increments."""
    rows = linearised(streams, T_parent_child, parameters).columns
    inner_rows = rows[3:-3]
    return inner_rows[:, :, -1]


SCALE_COLUMN = 6


def test_derivatives_are_the_numerical_ones():
    times_s = np.arange(60) * 0.1
    parent = smooth_poses(times_s)
    streams = increments.Streams(times_s, parent, child_of(parent))
    jacobian = linearised(streams).columns[3:-3, :, :-1]
    step = 1e-6
    for column in range(6 + increments.N_SYSTEMATIC):
        change = np.zeros(6 + increments.N_SYSTEMATIC)
        change[column] = step
        ahead = inner_residuals(
            streams, T_PARENT_CHILD @ se3.exp(change[:6]), change[6:]
        )
        behind = inner_residuals(
            streams, T_PARENT_CHILD @ se3.exp(-change[:6]), -change[6:]
        )
        numerical = (ahead - behind) / (2 * step)
        tolerance = 2e-8
        if column == SCALE_COLUMN:
            # The derivative uses the increments before and after, which are less noisy.
            tolerance = 0.15 * np.abs(numerical).max()
        assert_allclose(jacobian[:, :, column], numerical, atol=tolerance)


def smooth_poses(times_s):
    frequencies = [0.9, 1.1, 0.7, 0.8, 1.0, 1.2]
    amplitudes = [1.0, 1.0, 0.5, 0.3, 0.4, 0.8]
    phases = np.outer(times_s, frequencies) + np.arange(6)
    return se3.exp(np.sin(phases) * amplitudes)
