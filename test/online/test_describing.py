"""Lines about a result for the page of a session."""

import numpy as np
import pytest
from result_making import calibration, dofs

from hand_eye_calib.online.live.describing import measured_parts


@pytest.mark.parametrize(
    ("measured_m", "allowance_m", "expected"),
    [
        (
            0.0002,
            0.009,
            [
                "0.2 mm and 0.0057 deg are measured; the rest of +/- is an allowance for constant "
                "errors, which more motion does not reduce"
            ],
        ),
        (0.004, 0.004, []),
        (0.009, 0.0, []),
    ],
)
def test_the_measured_part_is_named_if_most_is_allowance(
    measured_m, allowance_m, expected
):
    sigmas = np.r_[np.full(3, measured_m), np.full(3, measured_m / 2)]
    result = calibration(
        covariance_measured=np.diag(sigmas**2),
        observability_measured=dofs(sigmas),
        covariance_allowance=np.diag(np.full(6, allowance_m**2)),
    )
    assert measured_parts(result) == expected
