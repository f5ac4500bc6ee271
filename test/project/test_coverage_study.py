"""The coverage study: its yardstick is right, and a worsened row fails."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose
from published_data import data_folder
from result_making import calibration
from sigmas import assert_nees, nees

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.calibration import (
    DofObservability,
    DofVerdict,
    SolveStatus,
)
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.extras.simulation.drive import simulate_drive
from hand_eye_calib.extras.simulation.options import HILLY_DRIVE
from reproduction import clean_recordings, faults
from reproduction.coverage import __main__ as study
from reproduction.coverage import classes, motions, sensor_errors
from reproduction.coverage.bound import ideal_estimate
from reproduction.coverage.scores import misclosure, truth_cases
from reproduction.later_faults import LATER
from reproduction.recordings import CYCLE, Truth, real_rigs

# White, walk, scale and slow errors fixed to body and world: every term of the state space.
SMALL = classes.RecordingClass(
    motion=motions.hand_held,
    duration_s=12.0,
    rate_hz=10.0,
    parent=sensor_errors.SensorErrors(
        white=sensor_errors.sigmas(0.0005, 0.02),
        slow=(
            sensor_errors.GaussMarkov(
                2.0, sensor_errors.sigmas(0.002, 0.05), in_world=True
            ),
        ),
    ),
    child=sensor_errors.SensorErrors(
        white=sensor_errors.sigmas(0.0005, 0.02),
        walk=sensor_errors.sigmas(0.001, 0.02),
        slow=(
            sensor_errors.GaussMarkov(0.5, sensor_errors.sigmas(0.001, 0.05)),
        ),
        scale=(0.01, 5.0),
    ),
)


def shown(recording):
    """z of the bound's state space: increments' errors at the truth, summed up."""
    X = recording.T_parent_child
    A, B = (
        se3.inverse(stream.poses[:-1]) @ stream.poses[1:]
        for stream in (recording.parent, recording.child)
    )
    errors = se3.log(se3.inverse(B) @ se3.inverse(X) @ A @ X)
    true = recording.sides[1].Ts
    back = se3.adjoint(se3.inverse(se3.inverse(true[:-1]) @ true[1:]))
    z = np.zeros((len(true), 6))
    for i, error in enumerate(errors):
        z[i + 1] = back[i] @ z[i] + error
    return z


def test_ideal_weighted_estimator_scatters_by_the_bound():
    values = []
    for seed in range(40):
        recording = classes.simulate(SMALL, seed)
        xi = ideal_estimate(
            recording.sides,
            recording.sides[1].Ts,
            recording.dt,
            shown(recording),
        )
        values.append(nees(xi, recording.bound()))
    # The mean of chi-squared with 6 degrees of freedom over 40 draws: 6 +/- 0.55.
    assert_nees(values, 4.4, 7.6)


def test_information_of_heavy_tails():
    assert sensor_errors.mixture_information(0.0, 10.0) == pytest.approx(
        1.0, abs=1e-6
    )
    # Spikes far out are seen for what they are, and lost.
    assert sensor_errors.mixture_information(0.1, 100.0) == pytest.approx(
        0.9, abs=0.01
    )
    assert sensor_errors.Tail(
        "student", factor=1e6
    ).information() == pytest.approx(1.0, abs=1e-5)
    tail = sensor_errors.Tail("student", factor=3.0)
    rng = np.random.default_rng(0)
    draws = np.array(tail.draw(rng, 20_000, 0.1))
    x = draws.reshape(-1, 1) * rng.standard_normal((20_000, 6))
    scores = 9.0 * x[:, 0] / (3.0 + np.sum(x**2, axis=1))
    assert np.mean(scores**2) == pytest.approx(tail.information(), rel=0.05)


def test_recordings_of_a_class_repeat_and_differ():
    first, again, other = (
        classes.make("hand_white", seed) for seed in (1, 1, 2)
    )
    assert np.array_equal(first.child.poses, again.child.poses)
    assert not np.allclose(first.T_parent_child, other.T_parent_child)
    none = sensor_errors.SensorErrors(white=sensor_errors.sigmas(1e-9, 1e-9))
    exact = dataclasses.replace(SMALL, parent=none, child=none)
    recording = classes.simulate(exact, 0)
    X = recording.T_parent_child
    parent = recording.parent.poses
    child = recording.child.poses
    A, B = (se3.inverse(poses[0]) @ poses[-1] for poses in (parent, child))
    assert_allclose(A @ X, X @ B, atol=1e-6)


def test_cycle_of_true_answers_closes_and_its_covariance_counts_each_answer():
    rng = np.random.default_rng(0)
    T_ab, T_bc = se3.exp(rng.normal(0.0, 0.5, (2, 6)))
    T_ca = se3.inverse(T_ab @ T_bc)
    # The child's lengths times its scale are the parent's metres.
    scales = (0.5, 4.0, 0.5)
    T_bc[:3, 3] /= 0.5
    T_ca[:3, 3] /= 0.5 * 4.0
    covariances = [
        np.diag(variances) for variances in rng.uniform(1e-6, 1e-4, (3, 6))
    ]
    answers = [
        _calibration(T, covariance, scale)
        for T, covariance, scale in zip(
            (T_ab, T_bc, T_ca), covariances, scales, strict=True
        )
    ]
    xi, covariance = misclosure(answers)
    assert_allclose(xi, 0.0, atol=1e-12)
    off = se3.exp(np.array([0.0, 0.0, 0.01, 0.0, 0.0, 0.0]))
    xi, _ = misclosure(
        [*answers[:2], _calibration(T_ca @ off, covariances[2], 0.5)]
    )
    assert xi[2] == pytest.approx(0.02)
    values = []
    for _ in range(400):
        errors = [rng.multivariate_normal(np.zeros(6), c) for c in covariances]
        moved = [
            dataclasses.replace(
                answer, T_parent_child=answer.T_parent_child @ se3.exp(error)
            )
            for answer, error in zip(answers, errors, strict=True)
        ]
        xi, _ = misclosure(moved)
        values.append(nees(xi, covariance))
    assert_nees(values, 5.4, 6.6)


def _calibration(T_parent_child, covariance, scale):
    fields = {
        "T_parent_child": T_parent_child,
        "covariance_measured": covariance,
        "scale": scale,
    }
    return calibration(
        **fields, status=SolveStatus.OK, observability_measured=()
    )


def test_coverage_with_the_floor_is_told_apart():
    observability = tuple(
        DofObservability(axis, DofVerdict.OBSERVED, 0.001) for axis in AXES
    )
    result = _calibration(np.eye(4), 1e-6 * np.eye(6), 1.0)
    result = dataclasses.replace(
        result,
        observability_measured=observability,
        covariance_allowance=1e-4 * np.eye(6),
    )
    T_truth = np.eye(4)
    T_truth[0, 3] = 0.01
    cases = truth_cases(result, Truth.within(T_truth, 0.0, 0.0))
    assert (cases["covers"]["x"], cases["covers_floor"]["x"]) == (0.0, 1.0)
    assert cases["covers"]["y"] == cases["covers_floor"]["y"] == 1.0


def test_one_class_from_end_to_end(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(study, "CLASSES", ("hand_white", "flat_agv"))
    rows = study.measure(
        study.tasks_of("dnlo", range(2), [], None), ["dnlo"], 1
    )
    row_of = {row.name: row for row in rows}
    assert 0.3 < row_of["hand_white"].value("bound") < 3.0
    assert row_of["flat_agv"].value("refused") == 1.0
    assert set(row_of["all classes"].cases["bound"]) == {
        "hand_white/0",
        "hand_white/1",
    }
    # Rows differ in their arguments.
    assert [*study.in_parallel(max, [(1, 2), (3, 4, 5)], 2)] == [
        2,
        5,
    ]
    monkeypatch.delenv("HAND_EYE_CALIB_DATA", raising=False)
    monkeypatch.setattr(study, "measure", lambda *_: rows)
    files = [tmp_path / name for name in ("page.md", "rows.csv")]
    assert study.main(["--page", str(files[0]), "--rows", str(files[1])]) == 0
    assert (
        "| all classes | "
        in files[0].read_text()
        == capsys.readouterr().out[:-1]
    )
    assert (
        files[1]
        .read_text()
        .splitlines()[1]
        .startswith("simulated,hand_white,dnlo,")
    )


def test_absent_folders_are_named(tmp_path):
    rigs, absent = real_rigs(tmp_path)
    assert rigs == []
    assert "euroc_vio" in absent


def test_every_real_set_can_be_read():
    rigs, absent = real_rigs(data_folder())
    assert absent == []
    assert set(CYCLE) < {rig.name for rig in rigs}
    for rig in rigs:
        for recording in rig.recordings.values():
            assert min(len(recording.parent), len(recording.child)) > 100


def test_there_are_more_than_a_hundred_clean_recordings_of_more_than_ten_kinds():
    names = clean_recordings.names(None)
    assert len(names) == len(set(names)) > 100
    assert len({clean_recordings.kind_of(name) for name in names}) > 10
    cases = faults.clean_cases(None)
    assert [case.recording for case in cases] == names
    assert {case.method for case in cases} == {"auto"}


def test_the_page_names_what_is_wrong_in_confidence_and_wrong_findings():
    text = faults.report(
        [
            faults.Outcome(
                key="S5 0 hilly_1 auto", verdict="USE", findings=[], z=4.0
            ),
            faults.Outcome(
                key="S5 1 hilly_1 auto",
                verdict="USE WITH CARE",
                findings=[],
                z=9.0,
            ),
            faults.Outcome(
                key="none 0 hilly_1 auto", verdict="USE", findings=[], z=1.0
            ),
            faults.Outcome(
                key="clean 0 hilly 50 auto",
                verdict="USE",
                findings=["note:jumps"],
            ),
            faults.Outcome(
                key="clean 0 hand_mixture_30s 50 auto",
                verdict="USE WITH CARE",
                findings=["jumps", "scale"],
                rules=["warning_finding"],
            ),
        ],
        None,
    )
    assert "an error above 3.3 standard deviations: 1.\n- S5 0" in text
    assert "Wrong findings in 1 of 2 clean recordings" in text
    assert "| hand_mixture_30s | 1 | scale 1 |" in text


@pytest.mark.parametrize("fault", LATER, ids=lambda fault: fault.code)
def test_faults_that_were_built_last_change_the_streams(fault):
    drive = simulate_drive(0, dataclasses.replace(HILLY_DRIVE, poses=400))
    for severity in fault.severities:
        parent, child = fault.damage(
            drive.parent, drive.child, severity, np.random.default_rng(0)
        )
        assert min(len(parent), len(child)) > 250
        same = len(child) == len(drive.child) and np.array_equal(
            child.poses, drive.child.poses
        )
        same &= np.array_equal(child.stamps_ns, drive.child.stamps_ns)
        assert not same or not np.array_equal(parent.poses, drive.parent.poses)


def test_a_child_in_2d_ends_in_a_verdict(monkeypatch):
    monkeypatch.setattr(faults, "_MAX_PAIRS", 100)
    case = faults.Case(
        fault="S10b", severity=2, recording="hilly_1", method="auto"
    )
    assert faults.outcome(case, None).verdict == "DO NOT USE"
