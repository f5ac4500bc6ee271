"""Quantiles and different values are those of NumPy, and the numbers those of SciPy."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import chi, chi2, norm

from hand_eye_calib.core.base import stats
from hand_eye_calib.core.base import text as words
from hand_eye_calib.core.base.stats import median, quantile


@pytest.mark.parametrize("size", [1, 2, 3, 10, 11])
def test_they_are_those_of_numpy(size):
    random = np.random.default_rng(size)
    values = random.normal(size=(size, 1))

    assert median(values) == np.median(values)
    assert np.isnan(median([]))
    for share in (0.0, 0.3, 0.9, 1.0):
        expected = np.quantile(values, share)
        assert quantile(values, share) == pytest.approx(expected, rel=1e-14)


def test_the_numbers_are_those_of_scipy():
    largest_of_six = norm.isf(0.005 / 2 / 6)
    assert norm.isf(0.25) == pytest.approx(stats.MEDIAN_NORMAL, abs=1e-4)
    assert chi.median(3) == pytest.approx(stats.MEDIAN_LENGTH, abs=1e-3)
    assert largest_of_six == pytest.approx(stats.LARGEST_OF_SIX, abs=1e-6)
    assert norm.isf(0.1) == pytest.approx(stats.NINE_TIMES_OUT_OF_TEN, abs=1e-6)
    for tail, table in stats.CHI2.items():
        for dof, threshold in table.items():
            assert chi2.isf(tail, dof) == pytest.approx(threshold, abs=1e-2)


@pytest.mark.parametrize(
    ("kind", "loss"),
    [
        ("huber", lambda length: length**2 / 2 if length < 1 else length - 0.5),
        ("cauchy", lambda length: np.log1p(length**2) / 2),
        ("geman_mcclure", lambda length: length**2 / (1 + length**2) / 2),
        ("student", lambda length: 5 * np.log1p(length**2 / 4)),
    ],
)
def test_a_weight_is_the_slope_of_its_loss_over_the_residual(kind, loss):
    lengths = np.array([0.1, 0.5, 0.9, 1.1, 3.0, 20.0])
    step = 1e-6
    slopes = [
        (loss(length + step) - loss(length - step)) / (2 * step)
        for length in lengths
    ]
    assert stats.robust_weights(kind, lengths**2) == pytest.approx(
        slopes / lengths, rel=1e-6
    )


@pytest.mark.parametrize(
    ("kind", "within"), [("huber", 1e-3), ("cauchy", 1e-3)]
)
def test_a_fifth_of_wrong_rows_hardly_changes_a_robust_regression(kind, within):
    random = np.random.default_rng(1)
    rows = random.normal(size=(200, 3, 2))
    true_slopes = np.array([2.0, -0.5])
    noise = 1e-3 * random.normal(size=(200, 3))
    targets = rows @ true_slopes + noise
    targets[:40] += 5.0

    plain, *_ = np.linalg.lstsq(
        rows.reshape(-1, 2), targets.ravel(), rcond=None
    )
    slopes, lengths = stats.robust_regression(kind, rows, targets, 20, median)

    largest_error = np.abs(plain - true_slopes).max()
    assert largest_error > 0.05, "least squares is not disturbed"
    assert slopes == pytest.approx(true_slopes, abs=within)
    residuals = rows @ slopes - targets
    assert_allclose(lengths, np.linalg.norm(residuals, axis=1))


def test_a_robust_regression_without_evidence_for_a_value_leaves_it_zero():
    rows = np.array([[[1.0, 0.0]], [[2.0, 0.0]]])
    targets = np.array([[3.0], [6.0]])
    slopes, lengths = stats.robust_regression(
        "cauchy", rows, targets, 3, median
    )
    assert slopes == pytest.approx([3.0, 0.0])
    assert lengths == pytest.approx([0.0, 0.0], abs=1e-12)


def test_student_weights_of_many_degrees_of_freedom_are_those_of_normal_errors():
    squared = np.array([0.0, 6.0, 60.0])
    nearly_normal = stats.student_weights(squared, 1e9)
    heavy_tailed = stats.student_weights(squared, 12.0)
    assert nearly_normal == pytest.approx([1.0, 1.0, 1.0], rel=1e-6)
    assert heavy_tailed == pytest.approx([1.5, 1.0, 0.25])


@pytest.mark.parametrize("tail", [1e-30, 1e-9, 1e-3, 0.05, 0.5, 0.99])
def test_the_quantile_of_chi_square_is_that_of_scipy(tail):
    assert stats.chi_square_quantile(tail) == pytest.approx(
        chi2.isf(tail, 6), rel=1e-12
    )


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (0.40123, 0.0012, "0.4012 +/- 0.0012"),
        (-90.1412, 0.0284, "-90.141 +/- 0.028"),
        (12.3456, 3.7, "12.35 +/- 3.70"),
        (-0.00001, 0.01, "0.000 +/- 0.010"),
        (1.5, 0.0, "1.500000 +/- 0.000000"),
        (1.5, None, "unknown"),
        (1.5, float("inf"), "unknown"),
        (1.5, float("nan"), "unknown"),
    ],
)
def test_a_number_is_shown_to_two_digits_of_its_sigma(value, sigma, text):
    assert words.with_sigma(value, sigma) == text


def test_lists_counts_and_lengths():
    assert words.listing(["x"]) == "x"
    assert words.listing(["x", "y", "z"]) == "x, y and z"
    assert words.counted(1, "gap") == "1 gap"
    assert words.counted(1500, "gap") == "1,500 gaps"
    assert words.length(0.0123) == "1.2 cm"
    assert words.length(1234.5) == "1,234 m"
    assert words.amount("yaw", 0.0174533) == "1 deg"
