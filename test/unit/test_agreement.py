"""Results of one rig agree, scatter, or have one among them that does not belong there."""

import numpy as np
import pytest
from fleet_making import recordings_of

from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.geometry import se3
from hand_eye_calib.session.agreement import agreement_of


def results(seed, count, unknown_z=False, apart=(), factor=1.0):
    """Extrinsics and their covariances along the parent's axes, some rotated by 0.06 rad."""
    Ts, covariances = recordings_of(seed, count, unknown_z)
    to_parent = np.kron(np.eye(2), Ts[:, :3, :3])
    Ts, apart = Ts.copy(), list(apart)
    Ts[apart] = se3.exp(np.array([0, 0, 0, 0, 0, 0.06])) @ Ts[apart]
    return Ts, factor * to_parent @ covariances @ np.swapaxes(to_parent, 1, 2)


@pytest.mark.parametrize("unknown_z", [False, True])
@pytest.mark.parametrize("count", [2, 3, 8, 30])
def test_honest_results_agree_with_the_chance_that_is_stated(count, unknown_z):
    seeds = range(40 if count < 10 else 15)
    found = [agreement_of(*results(seed, count, unknown_z)) for seed in seeds]
    alarms = sum(one.kind != "agree" for one in found)
    assert alarms <= 4  # 0.8 expected, 5 or more once in 800
    p_values = np.array([one.p_value for one in found])
    assert 0.35 < p_values.mean() < 0.65
    assert all(one.dof == (5 if unknown_z else 6) * (count - 1) for one in found)


def test_the_common_extrinsic_is_better_than_each_and_says_how_good():
    X = se3.exp(np.array([0.4, -0.2, 0.7, 0.3, -1.2, 0.6]))
    distances = []
    for seed in range(100):
        found = agreement_of(*results(seed, 5))
        error = deviation(found.T_parent_child, X)
        distances.append(error @ np.linalg.solve(found.covariance, error))
    assert 5.0 < np.mean(distances) < 7.0  # 6 expected, 0.35 its standard error


@pytest.mark.parametrize("unknown_z", [False, True])
@pytest.mark.parametrize(
    ("apart", "kind"),
    [([4], "one off"), ([0], "one off"), ([7], "one off"), ([5, 6, 7], "moved")],
)
def test_which_one_is_off_and_since_when(apart, kind, unknown_z):
    for seed in range(10):
        found = agreement_of(*results(seed, 8, unknown_z, apart))
        assert (found.kind, list(found.apart)) == (kind, apart)
        assert found.deviations[apart, 5] == pytest.approx(0.06, abs=0.02)
        assert np.isnan(found.deviations[0, 2]) == unknown_z
        assert found.p_value < 1e-6
        assert "the rotation about z by " in found.sentence("abcdefgh")


def test_results_that_all_scatter_more_than_stated_accuse_none():
    found = [agreement_of(*results(seed, 12, factor=0.25)) for seed in range(20)]
    scattered = [one for one in found if one.kind == "scatter"]
    assert len(scattered) >= 19
    assert all(1.5 < one.excess < 2.5 for one in scattered)


def test_of_two_that_differ_none_is_accused():
    found = agreement_of(*results(3, 2, apart=[1]))
    assert (found.kind, found.apart) == ("differ", ())
    assert found.sentence("ab").startswith("a and b differ; a third recording shows which is off")


def test_a_single_result_and_one_that_knows_nothing():
    Ts, covariances = results(3, 2)
    found = agreement_of(Ts[:1], covariances[:1])
    assert (found.kind, found.dof, found.p_value) == ("single", 0, 1.0)
    np.testing.assert_allclose(found.T_parent_child, Ts[0])
    covariances[1] = np.diag([np.inf] * 6)
    found = agreement_of(Ts, covariances)
    assert (found.kind, found.dof) == ("agree", 0)
    np.testing.assert_allclose(found.T_parent_child, Ts[0], atol=1e-9)
    assert np.isnan(found.deviations[1]).all()
