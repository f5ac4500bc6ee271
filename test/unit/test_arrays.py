"""Quantiles and different values without ``numpy.ma``, which would have to be imported."""

import numpy as np
import pytest

from hand_eye_calib.arrays import distinct, median, quantile


@pytest.mark.parametrize("size", [1, 2, 3, 10, 11])
def test_they_are_those_of_numpy(size):
    values = np.random.default_rng(size).normal(size=(size, 1))
    assert median(values) == np.median(values)
    for share in (0.0, 0.3, 0.9, 1.0):
        assert quantile(values, share) == pytest.approx(np.quantile(values, share), rel=1e-14)


def test_the_median_of_nothing_is_not_a_number():
    assert np.isnan(median([]))


@pytest.mark.parametrize("values", [[3, 1, 3, 2, 1], [[0.5, 0.25], [0.5, -1.0]], [7]])
def test_each_different_value_is_there_once(values):
    assert distinct(np.array(values)).tolist() == np.unique(values).tolist()
