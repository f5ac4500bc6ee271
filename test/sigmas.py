"""Judge over many recordings whether stated standard deviations are as large as the errors."""

import numpy as np


def nees(error, covariance):
    """Return the normalised error squared: chi-square with a degree of freedom for each axis."""
    weighted_error = np.linalg.solve(covariance, error)
    return error @ weighted_error


def assert_nees(values, low, high, average=np.mean):
    """Judge the average NEES of recordings by the range that is expected."""
    _assert_within(average(values), low, high, "NEES")


def assert_errors_over_sigmas(ratios, low, high):
    """Judge the root mean square of errors divided by their standard deviations."""
    mean_square = np.mean(np.square(ratios))
    ratio = np.sqrt(mean_square)
    _assert_within(ratio, low, high, "errors over sigmas")


def _assert_within(average, low, high, quantity):
    figures = f"{quantity} {average:.2f}, expected {low:g} to {high:g}"
    assert average > low, f"sigmas are too large: {figures}"
    assert average < high, f"sigmas are too small: {figures}"
