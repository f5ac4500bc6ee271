"""Numbers as people read them."""

import pytest

from hand_eye_calib import text as words


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
