"""Judge over many recordings whether stated standard deviations are as large as the errors."""

import numpy as np


def nees(error, covariance):
    """Return the normalised error squared: chi-square with a degree of freedom for each axis."""
    return error @ np.linalg.solve(covariance, error)


def assert_nees(values, low, high, average=np.mean):
    """Judge the average NEES of recordings by the range that is expected."""
    _assert_within(average(values), low, high, "NEES")


def assert_errors_over_sigmas(ratios, low, high):
    """Judge the root mean square of errors divided by their standard deviations."""
    _assert_within(np.sqrt(np.mean(np.square(ratios))), low, high, "errors over sigmas")


def _assert_within(average, low, high, quantity):
    size = "large" if average < low else "small"
    text = (
        f"sigmas are too {size}: {quantity} {average:.2f}, expected {low:g} to {high:g}"
    )
    assert low < average < high, text
