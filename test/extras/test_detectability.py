"""Smallest errors that a recording contradicts: linear injections against those into streams."""

import pickle
from dataclasses import replace
from html import unescape

import numpy as np
import pytest
from findings import codes_of
from numpy.testing import assert_allclose

import hand_eye_calib as hec
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.parts import facts_of
from hand_eye_calib.core.results.records import AXES, DofVerdict
from hand_eye_calib.extras.detectability import injection
from hand_eye_calib.extras.detectability.injection import evidence_of
from hand_eye_calib.extras.detectability.record import (
    Detectability,
    DetectabilityPart,
    find_undetectable,
)
from hand_eye_calib.offline.cli.main import main

ALL_COLUMNS = list(range(8))


@pytest.fixture(scope="module")
def drive():
    return hec.simulate(5, poses=1200)


@pytest.fixture(scope="module")
def result(drive):
    return hec.calibrate(drive.parent, drive.child)


@pytest.fixture(scope="module")
def pose_pairs(result):
    return result.recording.pose_pairs


def with_child(pose_pairs, change):
    child = Trajectory(pose_pairs.stamps_ns, pose_pairs.Ts_cw_c)
    changed = change(child).at(pose_pairs.stamps_ns, extrapolate=True)
    return replace(pose_pairs, Ts_cw_c=changed)


@pytest.mark.parametrize("axis", range(6))
def test_an_error_of_the_result_is_linear_in_the_evidence(
    result, pose_pairs, axis
):
    xi = np.zeros(6)
    xi[axis] = 0.02
    wrong = result.T_parent_child @ se3.exp(xi)
    before = evidence_of(pose_pairs, result.T_parent_child).solve(range(6))
    after = evidence_of(pose_pairs, wrong).solve(range(6))
    assert_allclose(after - before, -xi, atol=0.002)


def test_an_error_of_the_clock_is_linear_in_the_evidence(result, pose_pairs):
    late = with_child(pose_pairs, lambda child: child.shifted(0.01))
    evidence = evidence_of(pose_pairs, result.T_parent_child)
    evidence_of_late = evidence_of(late, result.T_parent_child)

    before = evidence.solve(ALL_COLUMNS)
    after = evidence_of_late.solve(ALL_COLUMNS)

    change_s = abs(after[6] - before[6])
    assert change_s == pytest.approx(0.01, rel=0.15)


def test_an_error_of_the_scale_is_linear_in_the_evidence(result, pose_pairs):
    longer = with_child(pose_pairs, lambda child: child.scaled(1.01))
    evidence = evidence_of(pose_pairs, result.T_parent_child)
    evidence_of_longer = evidence_of(longer, result.T_parent_child)

    before = evidence.solve(ALL_COLUMNS)
    after = evidence_of_longer.solve(ALL_COLUMNS)

    change = abs(after[7] - before[7])
    assert change == pytest.approx(0.01, rel=0.15)


@pytest.mark.parametrize(
    ("axis", "factor"), [("x", 1.3), ("yaw", -1.3), ("z", 0.3), ("roll", 0.3)]
)
def test_calibrate_reports_a_shift_from_the_smallest_size_on(
    drive, result, axis, factor
):
    in_parent = np.zeros(6)
    in_parent[AXES.index(axis)] = factor * result.detectability.shifts[axis]
    to_child = np.kron(np.eye(2), result.T_parent_child[:3, :3].T)
    shift = se3.exp(to_child @ in_parent)
    poses = drive.child.poses.copy()
    middle = len(poses) // 2
    poses[middle:] = poses[middle:] @ shift

    moved = hec.calibrate(drive.parent, replace(drive.child, poses=poses))

    codes = codes_of(moved.findings)
    assert ("mount_moved" in codes) == (abs(factor) > 1.0)


def test_a_shift_that_the_stream_check_does_not_report_is_not_stated(
    result, pose_pairs, monkeypatch
):
    monkeypatch.setattr(injection, "slow_suspects", lambda *_: [])
    sizes = injection.detectability(result, pose_pairs)
    # The allowance contains the open delay of a stream since.
    assert sizes.errors == pytest.approx(result.detectability.errors, rel=0.05)
    assert {*sizes.shifts.values()} == {np.inf}


def test_shifts_are_injected_when_read_or_sent(result, pose_pairs, monkeypatch):
    sizes = injection.detectability(result, pose_pairs)
    monkeypatch.setattr(injection, "slow_suspects", lambda *_: [])
    sent = pickle.loads(pickle.dumps(sizes.shifts))
    assert sent == dict.fromkeys(AXES, np.inf)


def test_no_size_is_below_what_sigma_makes_detectable(result, pose_pairs):
    """A method with a large sigma cannot have errors that a better method would contradict."""
    wide = replace(
        result, covariance_measured=400.0 * result.covariance_measured
    )
    sizes = injection.detectability(wide, pose_pairs).errors
    least = 3.0 * np.hypot(2.0 * wide.sigmas_measured, wide.allowance)
    assert (np.array([*sizes.values()]) >= least).all()


def test_the_true_error_is_smaller(drive, result):
    deviation = se3.deviation(result.T_parent_child, drive.T_parent_child)
    detectable = list(result.detectability.errors.values())
    assert (np.abs(deviation) < detectable).all()


def test_documents_contain_it(result):
    document = result.to_dict()
    assert document["detectability"]["errors"] == result.detectability.errors
    assert (
        hec.Calibration.from_dict(document).detectability
        == result.detectability
    )


def test_the_exchanged_result_has_none(result):
    assert result.inverse().detectability is None


def test_without_checks_there_is_none(drive):
    result = hec.calibrate(drive.parent, drive.child, checks=False)
    assert result.detectability is None


def test_a_recording_of_a_few_seconds_has_none(drive):
    parent = drive.parent[:120]
    child = drive.child[:120]
    result = hec.calibrate(parent, child)
    assert result.detectability is None


def flat_drive():
    """Streams of two sensors that turn about z only."""
    seconds = np.arange(900) / 10.0
    zero = np.zeros(900)
    yaw = 0.8 * np.sin(0.5 * seconds)
    rotations = se3.rotation_exp(np.c_[zero, zero, yaw])
    y = 2.0 * np.sin(0.4 * seconds)
    positions = np.stack([seconds, y, zero], axis=1)
    Ts = se3.from_rotation_translation(rotations, positions)
    X = se3.exp(np.array([0.4, -0.3, 0.2, 0.0, 0.0, 0.5]))
    random = np.random.default_rng(3)
    sigmas = np.repeat([0.003, 0.0005], 3)
    parent_noise, child_noise = se3.exp(
        random.normal(size=(2, 900, 6)) * sigmas
    )
    stamps_ns = (seconds * 1e9).astype(np.int64)
    parent = Trajectory(stamps_ns, Ts @ parent_noise)
    child = Trajectory(stamps_ns, Ts @ X @ child_noise)
    return parent, child


def test_an_axis_that_cannot_be_determined_has_none():
    result = hec.calibrate(*flat_drive())
    assert result.hidden == ["z"]
    assert result.detectability.errors["z"] == np.inf
    assert result.detectability.errors["yaw"] < 0.05


def test_a_sigma_that_the_blocks_contradict_needs_care(result):
    assert [reason.rule for reason in result.reasons] == []
    wide = replace(
        result.detectability,
        errors={
            axis: 100.0 * size
            for axis, size in result.detectability.errors.items()
        },
    )
    (reason,) = result.with_part("detectability", wide).reasons
    assert reason.rule == "undetectable"
    assert reason.axes == ("x", "y", "z", "roll", "pitch", "yaw")
    assert reason.verdict is hec.Verdict.USE_WITH_CARE
    assert "along x" in reason.sentence
    assert "about z" in reason.sentence


def test_details_and_report_state_it(capsys, tmp_path):
    arguments = [
        "calibrate",
        "sample:lidar.tum",
        "sample:camera.tum",
        "-v",
        "--out",
        str(tmp_path),
    ]
    assert main(arguments) == 0
    printed = " ".join(capsys.readouterr().out.split())
    report = " ".join((tmp_path / "report.html").read_text("utf-8").split())
    for text in (printed, unescape(report)):
        for fact in facts_of(hec.load(tmp_path)):
            assert fact in text
        assert "deg about y" in text
        assert (
            "half of the recording contradicts such errors in nine of ten trials"
            in text
        )


def test_sizes_that_are_unlimited_are_not_in_the_sentences(result):
    unlimited = dict.fromkeys(AXES, np.inf)
    sizes = replace(result.detectability, errors=unlimited, shifts=unlimited)
    assert DetectabilityPart().facts(sizes, result) == []
    assert DetectabilityPart().facts(None, result) == []
    only_x = replace(
        sizes,
        errors=unlimited | {"x": 0.0123},
        time_offset_s=0.004,
        scale=np.inf,
    )
    (fact,) = DetectabilityPart().facts(only_x, result)
    assert "1.2 cm along x" in fact
    assert "clocks" not in fact


@pytest.mark.parametrize(
    ("errors", "sentence"),
    [
        (
            dict.fromkeys(AXES, np.inf),
            "reveals no error in x, y, z and the rot",
        ),
        (
            dict.fromkeys(AXES, 0.0) | {"x": 1.0, "yaw": np.inf},
            "only errors above 1 m along x and no error in the rotation about z;",
        ),
    ],
)
def test_an_axis_whose_errors_are_never_revealed_is_named(
    result, errors, sentence
):
    sizes = replace(result.detectability, errors=errors)
    (ground,) = find_undetectable(result.with_part("detectability", sizes))
    assert sentence in ground.sentence
    assert "above ;" not in ground.sentence


def test_a_prior_is_no_reason_for_care(result):
    """A prior determines more than the motion can contradict."""
    nothing_shows = replace(
        result.detectability, errors=dict.fromkeys(AXES, 1.0)
    )
    by_prior = [
        replace(dof, verdict=DofVerdict.PRIOR)
        for dof in result.observability_measured
    ]
    with_prior = replace(result, observability_measured=tuple(by_prior))
    doubted = result.with_part("detectability", nothing_shows)
    assert list(find_undetectable(doubted))
    accepted = with_prior.with_part("detectability", nothing_shows)
    assert not list(find_undetectable(accepted))


def test_the_short_sentence_has_the_largest_detectable_errors():
    lengths = {"x": 0.01, "y": 0.03, "z": np.inf}
    angles = {"roll": 0.002, "pitch": 0.00873, "yaw": 0.003}
    value = Detectability(lengths | angles, {}, 0.01, 0.01)
    assert DetectabilityPart().brief_facts(value, None) == [
        "Errors above 3 cm along x and y or 0.5 deg would have been noticed"
    ]
    assert DetectabilityPart().brief_facts(None, None) == []
