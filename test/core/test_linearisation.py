"""Derivatives of the residuals of the noise model."""

import numpy as np
import pytest
from motions import T_PARENT_CHILD, child_of
from numpy.testing import assert_allclose, assert_array_equal

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.noise import increments
from hand_eye_calib.core.noise.outliers import bridge_outliers

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


@pytest.mark.parametrize(
    "outlier_poses", [[0], [0, 1, 2], [30], [30, 31], [59], [0, 1, 30, 58, 59]]
)
def test_each_outlier_pose_is_replaced_by_what_the_parent_implies(
    outlier_poses,
):
    times_s = np.arange(60) * 0.1
    parent = smooth_poses(times_s)
    child = child_of(parent)
    spikes = np.isin(np.arange(60), outlier_poses)
    wrong = child.copy()
    wrong[spikes] = wrong[spikes] @ se3.exp([5.0, -3.0, 2.0, 0.2, 0.1, 0.4])

    streams = increments.Streams(times_s, parent, wrong)
    bridged = bridge_outliers(streams, T_PARENT_CHILD, spikes)

    assert_allclose(bridged.Ts_cw_c, child, atol=1e-9)
    assert_array_equal(bridged.Ts_cw_c[~spikes], child[~spikes])
    assert_array_equal(streams.Ts_cw_c, wrong)


def test_without_a_sound_pose_all_follow_the_first():
    times_s = np.arange(10) * 0.1
    parent = smooth_poses(times_s)
    streams = increments.Streams(times_s, parent, child_of(parent))
    bridged = bridge_outliers(streams, T_PARENT_CHILD, np.ones(10, dtype=bool))
    assert_allclose(bridged.Ts_cw_c, streams.Ts_cw_c, atol=1e-9)


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
