"""Smallest errors that a recording contradicts: linear injections against those into streams."""

from dataclasses import replace

import numpy as np
import pytest

import hand_eye_calib as hec
from hand_eye_calib.core.assessment.moved import SIGNIFICANT, evidence_by_second, find_change
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.extras.detectability import injection
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


def evidence(pose_pairs, T_parent_child):
    def columns(pairs):
        return injection._columns_of_streams(pairs, pose_pairs)

    return evidence_by_second(pose_pairs, T_parent_child, columns)[1]


def with_child(pose_pairs, change):
    child = Trajectory(pose_pairs.stamps_ns, pose_pairs.Ts_cw_c)
    changed = change(child).at(pose_pairs.stamps_ns, extrapolate=True)
    return replace(pose_pairs, Ts_cw_c=changed)


@pytest.mark.parametrize("axis", range(6))
def test_an_error_of_the_result_is_linear_in_the_evidence(result, pose_pairs, axis):
    xi = np.zeros(6)
    xi[axis] = 0.02
    wrong = result.T_parent_child @ se3.exp(xi)
    before = evidence(pose_pairs, result.T_parent_child).solve(range(6))
    after = evidence(pose_pairs, wrong).solve(range(6))
    np.testing.assert_allclose(after - before, -xi, atol=0.002)


def test_an_error_of_the_clock_is_linear_in_the_evidence(result, pose_pairs):
    late = with_child(pose_pairs, lambda child: child.shifted(0.01))
    before = evidence(pose_pairs, result.T_parent_child).solve(ALL_COLUMNS)
    after = evidence(late, result.T_parent_child).solve(ALL_COLUMNS)
    assert abs(after - before)[6] == pytest.approx(0.01, rel=0.15)


def test_an_error_of_the_scale_is_linear_in_the_evidence(result, pose_pairs):
    longer = with_child(pose_pairs, lambda child: child.scaled(1.01))
    before = evidence(pose_pairs, result.T_parent_child).solve(ALL_COLUMNS)
    after = evidence(longer, result.T_parent_child).solve(ALL_COLUMNS)
    assert abs(after - before)[7] == pytest.approx(0.01, rel=0.15)


@pytest.mark.parametrize("axis", ["x", "y", "z", "roll", "pitch", "yaw"])
def test_the_stream_check_finds_a_shift_of_the_smallest_size(result, pose_pairs, axis):
    size = result.detectability.shifts[axis]
    in_parent = np.zeros(6)
    in_parent[["x", "y", "z", "roll", "pitch", "yaw"].index(axis)] = size
    xi = np.kron(np.eye(2), result.T_parent_child[:3, :3].T) @ in_parent
    middle = len(pose_pairs) // 2
    ratios = []
    for factor in (0.3, 1.3):
        Ts_cw_c = pose_pairs.Ts_cw_c.copy()
        Ts_cw_c[middle:] = Ts_cw_c[middle:] @ se3.exp(factor * xi)
        moved = replace(pose_pairs, Ts_cw_c=Ts_cw_c)
        ratios.append(find_change(moved, result.T_parent_child).log_ratio)
    assert ratios[0] < SIGNIFICANT < ratios[1]


def test_the_true_error_is_smaller(drive, result):
    errors = abs(se3.deviation(result.T_parent_child, drive.T_parent_child))
    assert (errors < [*result.detectability.errors.values()]).all()


def test_documents_contain_it(result):
    document = result.to_dict()
    assert document["detectability"]["errors"] == result.detectability.errors
    assert hec.Calibration.from_dict(document).detectability == result.detectability


def test_the_exchanged_result_has_none(result):
    assert result.inverse().detectability is None


def test_without_checks_there_is_none(drive):
    assert hec.calibrate(drive.parent, drive.child, checks=False).detectability is None


def test_a_recording_of_a_few_seconds_has_none(drive):
    few = drive.parent[:120], drive.child[:120]
    assert hec.calibrate(*few).detectability is None


def flat_drive():
    """Streams of two sensors that turn about z only."""
    seconds = np.arange(900) / 10.0
    turns = np.outer(np.sin(0.5 * seconds), [0.0, 0.0, 0.8])
    places = np.stack([seconds, 2.0 * np.sin(0.4 * seconds), np.zeros_like(seconds)], axis=1)
    Ts = se3.from_rotation_translation(se3.rotation_exp(turns), places)
    X = se3.exp(np.array([0.4, -0.3, 0.2, 0.0, 0.0, 0.5]))
    errors = np.random.default_rng(3).normal(size=(2, 900, 6)) * np.repeat([0.003, 0.0005], 3)
    stamps_ns = (seconds * 1e9).astype(np.int64)
    parent = Trajectory(stamps_ns, Ts @ se3.exp(errors[0]))
    return parent, Trajectory(stamps_ns, Ts @ X @ se3.exp(errors[1]))


def test_an_axis_that_cannot_be_determined_has_none():
    result = hec.calibrate(*flat_drive())
    assert result.hidden == ["z"]
    assert result.detectability.errors["z"] == np.inf
    assert result.detectability.errors["yaw"] < 0.05


def test_a_sigma_that_the_blocks_contradict_needs_care(result):
    assert [reason.rule for reason in result.reasons] == []
    wide = replace(
        result.detectability,
        errors={axis: 100.0 * size for axis, size in result.detectability.errors.items()},
    )
    (reason,) = result.with_part("detectability", wide).reasons
    assert reason.rule == "undetectable"
    assert reason.axes == ("x", "y", "z", "roll", "pitch", "yaw")
    assert reason.verdict is hec.Verdict.USE_WITH_CARE
    assert "along x" in reason.sentence
    assert "about z" in reason.sentence


def test_details_and_report_state_it(capsys, tmp_path):
    arguments = ["calibrate", "sample:lidar.tum", "sample:camera.tum", "-v", "--out", str(tmp_path)]
    assert main(arguments) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "Smallest detectable error: " in printed
    assert "deg about y" in printed
    assert "Smallest detectable error: " in (tmp_path / "report.html").read_text("utf-8")
