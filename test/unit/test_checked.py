"""What a stream check is certain of is used, and said."""

from dataclasses import replace
from itertools import accumulate

import numpy as np
import pytest
from motions import as_trajectory, child_of, disturbed, wandering_poses

import hand_eye_calib as hec
from hand_eye_calib.calibration import Verdict
from hand_eye_calib.checks.aligned import ByModel
from hand_eye_calib.checks.check import check_streams
from hand_eye_calib.engine.checked import at_clear_offset, checked, mend
from hand_eye_calib.engine.offline import offline_config, whole_snapshot
from hand_eye_calib.geometry import se3


@pytest.fixture(scope="module")
def streams():
    poses = wandering_poses(1200)
    parent = as_trajectory(poses)
    child = as_trajectory(disturbed(child_of(poses), 1, 0.002, 0.001))
    return parent, child, hec.calibrate(parent, child, reference="B5").T_parent_child


def test_a_clock_offset_that_is_certain_is_used_and_said(streams):
    parent, child, expected = streams
    result = hec.calibrate(parent, child.shifted(-0.3), reference="B5")
    assert result.time_offset_s == pytest.approx(0.3, abs=0.01)
    assert result.time_offset_sigma_s > 0
    np.testing.assert_allclose(result.T_parent_child, expected, atol=0.02)
    (said,) = (text for text in result.warnings if "solved with time_offset estimate" in text)
    assert "the child's clock is 0.3" in said


def test_a_unit_that_is_certain_is_used_and_said(streams):
    parent, child, expected = streams
    result = hec.calibrate(parent, child.scaled(1000.0), reference="B5")
    assert result.scale == 0.001
    np.testing.assert_allclose(result.T_parent_child, expected, atol=0.01)
    assert any("solved with scale 0.001" in text for text in result.warnings)
    assert result.findings == ()


def test_what_was_given_is_kept_and_spoils_the_verdict(streams):
    parent, child, _ = streams
    result = hec.calibrate(parent, child.scaled(1000.0), reference="B5", scale="none")
    assert result.scale == 1.0
    assert result.verdict is Verdict.DO_NOT_USE
    assert result.reasons[0].options == (("scale", 0.001),)


def test_good_streams_are_left_alone(streams):
    parent, child, _ = streams
    snapshot = whole_snapshot(offline_config(parent, child, {"reference": "B5"}), parent, child)
    plain = snapshot.estimate()
    result, same = checked(plain, snapshot, ())
    assert same is snapshot
    assert (result.warnings, result.findings) == (plain.warnings, ())


def test_a_scale_with_which_the_noise_model_does_not_fit_is_not_used():
    poses = wandering_poses(100)
    child = child_of(poses)
    # A drift of 5 % of the path along one axis of the child, hence partly along the path.
    steps = se3.inverse(child[:-1]) @ child[1:]
    steps[:, 0, 3] += 0.05 * np.linalg.norm(steps[:, :3, 3], axis=1)
    drifting = np.stack(list(accumulate(steps, np.matmul, initial=child[0])))
    result = hec.calibrate(as_trajectory(poses), as_trajectory(drifting))
    assert {"scale"} == {finding["code"] for finding in result.findings}
    assert (result.method, result.scale) == ("adaptive", 1.0)
    assert result.noise["systematic"] == "bias"


@pytest.fixture(scope="module")
def late():
    """Snapshot of streams whose clocks are apart."""
    poses = wandering_poses(300)
    parent = as_trajectory(poses)
    child = as_trajectory(disturbed(child_of(poses), 1, 0.002, 0.001)).shifted(-0.05)
    return whole_snapshot(offline_config(parent, child, {}), parent, child)


class TestClearOffset:
    def test_it_is_estimated_before_the_first_solve(self, late, monkeypatch):
        ahead = at_clear_offset(late, ())
        assert ahead.config.time_offset == "estimate"
        in_turn = mend(late.estimate(), late, ())
        result = ahead.estimate()
        found = mend(result, ahead, ())
        assert found.snapshot.config == in_turn.snapshot.config
        assert found.told == in_turn.told
        expected = in_turn.calibration
        np.testing.assert_array_equal(found.calibration.T_parent_child, expected.T_parent_child)
        np.testing.assert_array_equal(found.calibration.covariance, expected.covariance)
        assert found.calibration.findings == expected.findings
        assert expected.time_offset_s == pytest.approx(0.05, abs=0.003)
        # If something speaks against it, the streams are solved as they are, too.
        monkeypatch.setattr("hand_eye_calib.engine.checked._is_sound", lambda found: False)
        assert (
            mend(result, ahead, ()).check.findings == mend(late.estimate(), late, ()).check.findings
        )

    @pytest.mark.parametrize(
        "options", [{"time_offset": 0.0}, {"method": "dnlo"}, {"reference": "B5"}]
    )
    def test_it_stays_as_it_is_if_the_model_would_not_find_it(self, late, options):
        config = late.config.from_options(late.config.to_options() | options)
        other = replace(late, config=config)
        assert at_clear_offset(other, options) is other

    def test_none_is_left_alone(self, late):
        level = replace(late, buffered_child=late.child.shifted(0.05))
        assert at_clear_offset(level, ()) is level

    def test_none_is_clear_if_motions_over_other_times_tell_another(self, late, monkeypatch):
        spread = replace(at_clear_offset(late, ()).time_offset, spread_s=0.04)
        monkeypatch.setattr(
            "hand_eye_calib.engine.checked.refine_time_offset", lambda *given, **more: spread
        )
        assert at_clear_offset(late, ()) is late


def test_the_check_takes_the_correlation_and_a_model_s_offset_as_they_are(late, monkeypatch):
    known, child = 0.049, late.child
    found = check_streams(late.parent, child, known)
    same = check_streams(late.parent, child, known, correlation=late.correlation)
    assert same.findings == found.findings
    assert same.correlation.offset_s == pytest.approx(found.correlation.offset_s, abs=1e-9)
    apart = se3.from_rotation_translation(np.eye(3), np.array([0.3, 0.0, 0.0]))
    model = ByModel(T_parent_child=apart, offset_sigma_s=0.0005, is_steady=False)
    # An offset that a model has missed is found by the model of the check.
    (missed,) = check_streams(late.parent, child, 0.0, model=model).findings
    assert missed.code == "time_offset"
    assert dict(missed.options)["time_offset"] == pytest.approx(0.05, abs=0.002)
    # Unless the first one leaves no doubt: then there is no second one.
    monkeypatch.setattr("hand_eye_calib.checks.aligned.estimator", None)
    steady = replace(model, is_steady=True)
    sure = check_streams(late.parent, child, known, model=steady)
    assert [each.code for each in sure.findings] == [each.code for each in found.findings]
    same = replace(steady, T_parent_child=np.eye(4))
    given = replace(steady, offset_sigma_s=0.0)
    assert not any(each.leaves_no_doubt for each in (same, given, model))
