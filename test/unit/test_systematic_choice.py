"""Which systematic errors the adaptive estimator assumes."""

from types import SimpleNamespace

import numpy as np
import pytest

from hand_eye_calib.adaptive import estimator
from hand_eye_calib.adaptive.systematic_choice import Candidates
from hand_eye_calib.assessment.covariance import assess_adaptive
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.synchronise import PosePairs
from reproduction.unlike import UnlikeSource


@pytest.mark.parametrize("number", [0, 2])
def test_a_drift_that_a_mount_askew_nearly_explains_is_found(number):
    # The standard deviations of X grow to 5.8 and 3.3 times those without a drift.
    drive = UnlikeSource(seed=0, runs=number + 1).cases("as the paper", None)[number]
    poses = PosePairs(drive.parent.stamps_ns, drive.parent.poses, drive.child.poses)
    solution = estimator.solve(poses.stamps_ns, poses.Ts_pw_p, poses.Ts_cw_c)
    assert solution.systematic == "bias"
    covariance = assess_adaptive(poses, solution).cov_parent_child_in_child
    xi = se3.log(se3.inverse(solution.T_parent_child) @ drive.T_parent_child)
    assert xi @ np.linalg.solve(covariance, xi) < 16.8  # chi-square (6), once in a hundred


@pytest.mark.parametrize(("lead", "variance"), [(0.0, 0.5), (2.0, 0.2689), (60.0, 0.0)])
def test_a_model_about_as_good_as_the_chosen_one_widens_the_covariance(lead, variance):
    askew = np.eye(6)[5]
    fits = {
        name: SimpleNamespace(cost=cost, step=step)
        for name, cost, step in (("none", 0.0, np.zeros(6)), ("bias", lead, askew))
    }
    candidates = Candidates([], None, fits, list(fits), dict.fromkeys(fits, 5.0))
    assert candidates.best == "none"
    expected = np.diag(variance * askew)
    np.testing.assert_allclose(candidates.spread_about("none"), expected, atol=1e-4)
