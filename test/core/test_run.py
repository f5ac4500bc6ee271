"""What a stream check is certain of is used, and said."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from findings import codes_of
from motions import (
    as_trajectory,
    child_of,
    disturbed,
    planar_poses,
    walked,
    wandering_poses,
)
from numpy.testing import assert_allclose
from real_data import zxl19
from scipy.ndimage import uniform_filter1d

import hand_eye_calib as hec
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.checks.check import CheckResult
from hand_eye_calib.core.checks.streams import check_lengths
from hand_eye_calib.core.engine.attempts import with_options
from hand_eye_calib.core.engine.run import examine, review, run
from hand_eye_calib.core.engine.snapshot import Snapshot, whole_snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import Verdict
from hand_eye_calib.core.results.records import Severity
from reproduction.coverage.classes import make


@pytest.fixture(scope="module")
def streams():
    poses = wandering_poses(500)
    child_poses = disturbed(child_of(poses), 1, 0.002, 0.001)
    parent = as_trajectory(poses)
    child = as_trajectory(child_poses)
    expected = hec.calibrate(parent, child, reference="B5")
    return parent, child, expected.T_parent_child


def test_a_clock_offset_that_is_certain_is_used_and_said(streams):
    parent, child, expected = streams
    result = hec.calibrate(parent, child.shifted(-0.3), reference="B5")
    assert result.time_offset_s == pytest.approx(0.3, abs=0.01)
    assert result.time_offset_sigma_s > 0
    assert_allclose(result.T_parent_child, expected, atol=0.02)
    (warning,) = (
        text
        for text in result.warnings
        if 'solved with time_offset="estimate"' in text
    )
    assert "the child's clock is 0.299993 +/- 0.0000" in warning


def test_a_check_states_the_clock_offset_and_the_scale_of_the_solution(streams):
    parent, child, _ = streams
    other = child.shifted(-0.3).scaled(0.4)
    snapshot = whole_snapshot(parent, other, {})

    issues = {issue.code: issue for issue in examine(snapshot)}
    result = hec.calibrate(parent, other)

    offset = issues["time_offset"].evidence
    scale = issues["scale"].evidence
    assert offset["size_s"] == result.time_offset_s
    assert offset["sigma_s"] == result.time_offset_sigma_s
    assert scale["scale"] == result.scale


@pytest.mark.parametrize("bag", [1, 2, 3])
def test_a_check_states_an_offset_that_the_noise_model_estimates_in_part(bag):
    recording = zxl19(bag, "LO")
    snapshot = whole_snapshot(recording.parent, recording.child, {})
    issues = {issue.code: issue for issue in examine(snapshot)}
    result = hec.calibrate(recording.parent, recording.child)
    offset = issues["time_offset"].evidence
    # Both solves end at their own tolerance.
    assert offset["offset_s"] == pytest.approx(result.time_offset_s, abs=1e-4)
    assert result.time_offset_s < -0.03


def test_an_axis_with_a_prior_is_not_called_unknown():
    parent = as_trajectory(planar_poses(500))
    child = as_trajectory(disturbed(child_of(parent.poses), 1, 0.002, 0.001))
    (without,) = hec.calibrate(parent, child).findings
    assert (
        "z cannot be determined from this motion, and will be unknown"
        in without.what
    )
    (with_prior,) = hec.calibrate(
        parent, child, prior={"z": (0.1, 0.02)}
    ).findings
    assert with_prior.code == "one_axis"
    assert with_prior.what.endswith(
        "motion: the prior alone determines the value"
    )
    assert not with_prior.options


def test_a_unit_that_is_certain_is_used_and_said(streams):
    parent, child, expected = streams
    in_millimetres = child.scaled(1000.0)

    result = hec.calibrate(parent, in_millimetres, reference="B5")

    assert result.scale == 0.001
    assert result.findings == ()
    assert_allclose(result.T_parent_child, expected, atol=0.01)
    assert "solved with scale=0.001" in "\n".join(result.warnings)


def test_a_parent_with_another_scale_has_no_finding(streams):
    parent, child, _ = streams
    result = hec.calibrate(parent.scaled(3.0), child)
    assert result.scale == pytest.approx(3.0, abs=0.01)
    assert result.findings == ()


def test_both_streams_in_millimetres_are_never_used(streams):
    parent, child, expected = streams
    parent_mm = parent.scaled(1000.0)
    child_mm = child.scaled(1000.0)

    result = hec.calibrate(parent_mm, child_mm, reference="B5")

    (finding,) = result.findings
    assert result.verdict is Verdict.DO_NOT_USE
    assert finding.code == "lengths"
    assert finding.stream == "both"
    assert "both streams' lengths seem to be in millimetres" in result.headline
    assert finding.evidence["speed_m_s"] > 1000
    options = {"reference": "B5", **finding.options}
    answered = hec.calibrate(parent_mm, child_mm, **options)
    assert_allclose(answered.T_parent_child, expected, atol=1e-9)


def written_otherwise(trajectory, convention):
    """As another program writes it: what the option of that name puts right."""
    inversion = convention.get("invert", "none")
    poses = se3.put_right(trajectory.poses, inversion)
    order = convention.get("quaternion")
    if order:
        positions = poses[:, :3, 3]
        quats_xyzw = se3.to_quat_xyzw(poses)
        quats = np.roll(quats_xyzw, order.index("x"), axis=1)
        poses = se3.from_quat_xyzw(positions, quats)
    return replace(trajectory, poses=poses)


REPAIRS = [
    {"invert": "poses"},
    {"invert": "orientations"},
    {"quaternion": "wxyz"},
]
REPAIRS += [{"quaternion": "wxyz", "invert": "poses"}, {"quaternion": "yzwx"}]


def as_options(options):
    """Options as a warning writes them."""
    assignments = [f'{name}="{value}"' for name, value in options.items()]
    return ", ".join(assignments)


@pytest.mark.parametrize("convention", REPAIRS, ids=str)
@pytest.mark.parametrize("stream", ["parent", "child"])
def test_a_stream_in_another_convention_is_repaired_and_that_is_said(
    streams, stream, convention
):
    parent, child, expected = streams
    trajectories = {"parent": parent, "child": child}
    trajectories[stream] = written_otherwise(trajectories[stream], convention)
    repairs = {f"{stream}_{name}": value for name, value in convention.items()}
    defaults = {name: getattr(CalibratorConfig, name) for name in repairs}

    result = hec.calibrate(**trajectories, reference="B5")

    assert_allclose(result.T_parent_child, expected, atol=1e-9)
    assert result.verdict is Verdict.USE
    (warning,) = (
        text for text in result.warnings if text.startswith("repaired: ")
    )
    solved = as_options(repairs)
    undo = as_options(defaults)
    sentence = f"Solved with {solved}: USE; without the repair: DO NOT USE (undo with {undo})"
    assert sentence in warning


@pytest.mark.parametrize("scale", [{}, {"scale": "estimate"}])
def test_inverse_poses_on_a_clock_an_hour_off_and_in_feet(streams, scale):
    parent, child, expected = streams
    inverse = written_otherwise(child, REPAIRS[0])
    other = inverse.shifted(3600.0).scaled(1 / 0.3048)

    result = hec.calibrate(parent, other, reference="B5", **scale)

    assert_allclose(result.T_parent_child, expected, atol=1e-3)
    assert result.verdict is Verdict.USE_WITH_CARE
    assert result.time_offset_s == pytest.approx(-3600.0, abs=1e-3)
    assert "without the repair: no result" in "\n".join(result.warnings)


def test_what_was_given_is_kept_spoils_the_verdict_and_the_advice_undoes_it(
    streams,
):
    parent, child, _expected = streams
    as_it_is = hec.calibrate(
        parent, written_otherwise(child, REPAIRS[0]), child_invert="none"
    )
    assert as_it_is.verdict is Verdict.DO_NOT_USE
    assert as_it_is.reasons[0].options == {"child_invert": "poses"}
    wrong = hec.calibrate(parent, child, child_invert="poses", reference="B5")
    assert (wrong.verdict, wrong.reasons[0].options) == (
        as_it_is.verdict,
        {"child_invert": "none"},
    )
    unit = hec.calibrate(
        parent, child.scaled(1000.0), reference="B5", scale="none"
    )
    assert (unit.scale, unit.verdict) == (1.0, as_it_is.verdict)
    assert unit.reasons[0].options == {"scale": 0.001}


def test_kept_pairs_are_put_right_like_poses(streams):
    parent, child, expected = streams
    inverse = written_otherwise(child, REPAIRS[0])
    snapshot = whole_snapshot(parent, inverse, {"reference": "B5"})
    kept = replace(
        snapshot,
        kept=snapshot.pose_pairs,
        paired_at="child",
        buffered_parent=parent[:0],
        buffered_child=inverse[:0],
    )

    repaired = with_options(kept, {"child_invert": "poses"})
    with_offset = with_options(
        kept, {"child_invert": "poses", "time_offset": 0.0}
    )

    assert_allclose(repaired.estimate().T_parent_child, expected, atol=1e-9)
    assert_allclose(with_offset.estimate().T_parent_child, expected, atol=1e-9)


def test_a_slow_arm_in_millimetres_is_noticed_and_a_drone_in_metres_is_not():
    arm = as_trajectory(wandering_poses(1200, step_m=0.006))
    drone = as_trajectory(wandering_poses(1200, step_m=1.0))
    arm_in_mm = arm.scaled(1000.0)

    assert check_lengths(arm, arm) == []
    assert check_lengths(drone, drone) == []
    findings = check_lengths(arm_in_mm, arm_in_mm)
    assert codes_of(findings) == ["lengths"]


def test_a_scale_that_was_given_is_left_by_the_noise_model_too(streams):
    parent, child, _ = streams
    longer = child.scaled(1.03)
    estimated = hec.calibrate(parent, longer)
    assert estimated.scale == pytest.approx(1 / 1.03, abs=0.002)
    for scale in (1.0, "none"):
        result = hec.calibrate(parent, longer, scale=scale)
        assert result.scale == 1.0
        assert result.scale_sigma == 0.0
        assert "scale" in codes_of(result.findings)


def test_a_clock_that_was_given_as_right_is_left_by_the_noise_model_too(late):
    # An offset of 0.01 s remains.
    shifted = replace(late, buffered_child=late.buffered_child.shifted(0.04))
    estimated = hec.calibrate(late.buffered_parent, shifted.buffered_child)
    assert estimated.time_offset_s == pytest.approx(0.01, abs=0.003)
    result = hec.calibrate(
        late.buffered_parent, shifted.buffered_child, time_offset=0.0
    )
    assert (result.time_offset_s, result.time_offset_sigma_s) == (0.0, 0.0)


def test_options_that_are_passed_are_given_even_if_they_are_the_defaults():
    assert CalibratorConfig().given == set()
    config = CalibratorConfig.from_options({"time_offset": 0.0, "prior.z": ""})
    assert config.given == {"time_offset", "prior_z"}
    assert (
        replace(config, scale="estimate", time_offset="estimate").given
        == config.given
    )
    assert pickle.loads(pickle.dumps(config)).given == config.given
    assert config.is_known("time_offset")
    assert not config.is_known("scale")


def test_good_streams_are_left_alone(streams):
    parent, child, _ = streams
    snapshot = whole_snapshot(parent, child, {"reference": "B5"})
    plain = snapshot.estimate()
    outcome = review(plain, snapshot)
    assert outcome.snapshot is snapshot
    assert (outcome.calibration.warnings, outcome.options) == (
        plain.warnings,
        {},
    )
    assert outcome.calibration.findings == ()


@pytest.mark.parametrize(
    ("offset_s", "factor", "is_inverse", "estimate"),
    [
        (0.3, 1.0, False, "0.30"),
        (0.0, 1.7, False, "0.588"),
        (0.0, 1.0, True, "USE"),
    ],
)
def test_a_session_keeps_messages_without_estimates_and_verdicts(
    streams, offset_s, factor, is_inverse, estimate
):
    parent, child, _ = streams
    child = child.shifted(offset_s).scaled(factor)
    if is_inverse:
        child = replace(child, poses=se3.inverse(child.poses))
    snapshot = whole_snapshot(parent, child, {"reference": "B5"})
    attempt = review(snapshot.estimate(), snapshot)
    (message,) = attempt.messages
    assert estimate in message.text
    assert message.text in attempt.calibration.warnings
    assert estimate not in message.lasting
    assert attempt.for_session().warnings[0] == message.lasting
    for name, value in attempt.options.items():
        assert f"{name} {value}" in message.lasting
    assert message.text not in attempt.for_session().warnings


@pytest.mark.parametrize(
    ("is_inverse", "offset_s", "factor", "n_expected"),
    [
        (False, 0.0, 1.0, 1),
        (False, 0.3, 1.0, 1),
        (False, 0.0, 1000.0, 2),
        (False, 0.3, 1.02, 1),
        (False, 0.3, 1000.0, 2),
        (True, 0.3, 1.0, 3),
    ],
)
def test_number_of_solves(
    streams, monkeypatch, is_inverse, offset_s, factor, n_expected
):
    """The look at the clocks solves only what may be the result."""
    parent, child, _ = streams
    if is_inverse:
        child = written_otherwise(child, REPAIRS[0])
    child = child.shifted(offset_s).scaled(factor)
    solved = []
    estimate = Snapshot.estimate

    def counted_estimate(snapshot, cross_check=None):
        solved.append(snapshot)
        return estimate(snapshot, cross_check)

    monkeypatch.setattr(Snapshot, "estimate", counted_estimate)
    hec.calibrate(parent, child)
    assert len(solved) == n_expected


@pytest.mark.parametrize("checks", [None, True, False])
def test_a_given_reference_solves_nothing_else_unless_cross_checks_are_asked_for(
    streams, checks, monkeypatch
):
    """Neither the noise model nor other references; without checks not even the stream checks."""
    parent, child, _ = streams
    solved = []
    monkeypatch.setattr(
        "hand_eye_calib.core.noise.estimator.solve",
        lambda *_, **__: solved.append("adaptive"),
    )
    monkeypatch.setattr(
        "hand_eye_calib.core.engine.attempts.check",
        lambda *_: solved.append("check") or CheckResult(()),
    )
    result = hec.calibrate(
        parent, child, method="dnlo", reference="B5", checks=checks
    )
    assert solved == ([] if checks is False else ["check"])
    assert (result.cross_check is not None) == (checks is True)


def test_a_scale_with_which_the_noise_model_does_not_fit_is_not_used():
    poses = wandering_poses(100)
    child = child_of(poses)
    # A drift of 5 % of the path along one axis of the child, hence partly along the path.
    steps = se3.inverse(child[:-1]) @ child[1:]
    lengths_m = np.linalg.norm(steps[:, :3, 3], axis=1)
    steps[:, 0, 3] += 0.05 * lengths_m
    drifting_child = walked(steps, child[0])

    result = hec.calibrate(as_trajectory(poses), as_trajectory(drifting_child))

    codes = codes_of(result.findings)
    assert set(codes) == {"scale", "not_independent"}
    assert result.method == "adaptive"
    assert result.scale == 1.0
    assert result.noise.systematic == "bias"


@pytest.fixture(scope="module")
def late():
    """Snapshot of streams whose clocks are apart."""
    poses = wandering_poses(300)
    child_poses = disturbed(child_of(poses), 1, 0.002, 0.001)
    parent = as_trajectory(poses)
    child = as_trajectory(child_poses).shifted(-0.05)
    return whole_snapshot(parent, child, {})


@pytest.mark.parametrize(
    "options", [{"time_offset": 0.0}, {"method": "dnlo", "time_offset": 0.05}]
)
def test_a_clock_that_the_user_set_stays(late, options):
    config = replace(late.config, given=options, **options)
    other = replace(late, config=config)
    attempt = run(other)
    assert attempt.snapshot is other


def test_a_large_offset_that_nobody_asked_for_is_used_with_care(late):
    child = late.buffered_child.shifted(5.0)
    config = replace(late.config, time_offset="estimate", given={"time_offset"})
    unasked = replace(late, buffered_child=child)
    asked = replace(late, buffered_child=child, config=config)

    result = run(unasked).calibration
    asked_result = run(asked).calibration

    assert result.time_offset_s == pytest.approx(-5.0, abs=0.1)
    assert result.verdict is not Verdict.USE
    assert set(codes_of(result.findings)) == {"time_offset"}
    assert asked_result.findings == ()


@pytest.mark.parametrize(
    ("kind", "span_s", "code"),
    [
        ("car_lever", 1.0, "position_clock"),
        ("car_ins_lidar", 0.7, "smoothed_positions"),
    ],
)
def test_a_model_that_fits_does_not_rule_out_smoothing_without_a_delay(
    kind, span_s, code
):
    drive = make(kind, 932)
    width = round(span_s / drive.dt)
    poses = drive.child.poses.copy()
    positions = poses[:, :3, 3]
    poses[:, :3, 3] = uniform_filter1d(positions, width, axis=0, mode="nearest")
    smoothed = Trajectory(drive.child.stamps_ns, poses)

    result = hec.calibrate(drive.parent, smoothed)

    assert result.noise.misfit < 2.0
    assert code in codes_of(result.findings)
    assert result.verdict is Verdict.DO_NOT_USE


@pytest.mark.parametrize(
    ("factor", "severity", "words"),
    [
        (1.0, None, ""),
        (1.006, None, ""),
        (1.02, Severity.NOTE, "longer"),
        (0.98, Severity.NOTE, "shorter"),
        (1.06, Severity.WARNING, "longer"),
        (0.9, Severity.WARNING, "shorter"),
    ],
)
def test_a_scale_that_the_noise_model_finds_unasked_is_stated(
    factor, severity, words
):
    poses = wandering_poses(500)
    parent = as_trajectory(disturbed(poses, 4, 0.002, 0.001))
    child = as_trajectory(disturbed(child_of(poses), 5, 0.002, 0.001)).scaled(
        factor
    )
    result = hec.calibrate(parent, child)
    findings = {finding.code: finding for finding in result.findings}
    if severity is None:
        assert "model_scale" not in findings
        assert "lengths" not in result.headline
        return
    assert findings["model_scale"].severity is severity
    assert findings["model_scale"].evidence["scale"] == pytest.approx(
        1.0 / factor, abs=0.002
    )
    assert f"% {words} than the parent's" in result.headline
    is_care = severity is Severity.WARNING
    assert result.verdict is (Verdict.USE_WITH_CARE if is_care else Verdict.USE)


@pytest.mark.parametrize("scale", ["auto", "estimate"])
def test_a_scale_that_was_asked_for_is_no_finding(scale):
    poses = wandering_poses(500)
    parent_poses = disturbed(poses, 4, 0.002, 0.001)
    child_poses = disturbed(child_of(poses), 5, 0.002, 0.001)
    parent = as_trajectory(parent_poses)
    child = as_trajectory(child_poses).scaled(1.06)

    result = hec.calibrate(parent, child, scale=scale)

    assert result.scale == pytest.approx(1.0 / 1.06, abs=0.002)
    assert "model_scale" not in codes_of(result.findings)
