"""Quantiles and different values are those of NumPy, and the numbers those of SciPy."""

import numpy as np
import pytest
from scipy.stats import chi, chi2, norm

from hand_eye_calib import stats
from hand_eye_calib.stats import median, quantile


@pytest.mark.parametrize("size", [1, 2, 3, 10, 11])
def test_they_are_those_of_numpy(size):
    values = np.random.default_rng(size).normal(size=(size, 1))
    assert median(values) == np.median(values)
    for share in (0.0, 0.3, 0.9, 1.0):
        assert quantile(values, share) == pytest.approx(np.quantile(values, share), rel=1e-14)


def test_the_median_of_nothing_is_not_a_number():
    assert np.isnan(median([]))


def test_the_numbers_are_those_of_scipy():
    assert pytest.approx(norm.isf(0.25), abs=1e-4) == stats.MEDIAN_NORMAL
    assert pytest.approx(chi.median(3), abs=1e-3) == stats.MEDIAN_LENGTH
    assert pytest.approx(norm.isf(0.005 / 2 / 6), abs=1e-6) == stats.LARGEST_OF_SIX
    assert pytest.approx(norm.isf(0.1), abs=1e-6) == stats.NINE_TIMES_OUT_OF_TEN
    for tail, table in stats.CHI2.items():
        assert {dof: pytest.approx(chi2.isf(tail, dof), abs=1e-2) for dof in table} == table


@pytest.mark.parametrize("tail", [1e-30, 1e-9, 1e-3, 0.05, 0.5, 0.99])
def test_the_quantile_of_chi_square_is_that_of_scipy(tail):
    assert stats.chi_square_quantile(tail) == pytest.approx(chi2.isf(tail, 6), rel=1e-12)
