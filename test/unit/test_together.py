"""Several recordings of one rig: one result, in Python and on the command line."""

import dataclasses
import json

import numpy as np
import pytest
from motions import T_PARENT_CHILD, as_trajectory, child_of, disturbed, wandering_poses
from result_making import SHIFTED_FROM as X
from result_making import shift
from result_making import shifted as result

import hand_eye_calib as hec
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.errors import InputError
from hand_eye_calib.results.calibration import DofVerdict, SolveStatus
from hand_eye_calib.session.together import together


def named(*results):
    """Results by name, in the order of time."""
    return {
        f"drive {number}": dataclasses.replace(each, stamp_ns=number)
        for number, each in enumerate(results, start=1)
    }


def pair(seed, n_poses=150):
    poses = wandering_poses(n_poses, seed=seed)
    child = disturbed(child_of(poses), seed, 5e-4, 5e-4)
    return (
        as_trajectory(disturbed(poses, 100 + seed, 5e-4, 5e-4), sensor_frame="lidar"),
        as_trajectory(child, sensor_frame="camera"),
    )


def test_more_recordings_know_more_and_the_interval_is_honest():
    errors = {1: [], 3: [], 6: []}
    inside = []
    for seed in range(15):
        recorded = named(*(result(seed=20 * seed + i) for i in range(6)))
        for count, found in errors.items():
            joint = together(dict(list(recorded.items())[:count]))
            error = deviation(joint.T_parent_child, X)
            found.append(np.linalg.norm(error[:3]))
            inside.extend(np.abs(error) < 1.645 * joint.sigmas)
        assert joint.together.kind == "agree"
    assert np.median(errors[6]) < 0.75 * np.median(errors[1])
    assert np.mean(inside) > 0.85


def test_an_axis_that_one_recording_hides_comes_from_another():
    flat = result(shift("z", -0.4), hidden="z", status=SolveStatus.UNOBSERVABLE)
    hidden = flat.covariance + 9.0 * np.outer(*2 * [np.r_[X[2, :3], np.zeros(3)]])
    flat = dataclasses.replace(flat, covariance=hidden)
    joint = together(named(flat, flat, result()))
    assert joint.status is SolveStatus.OK
    assert deviation(joint.T_parent_child, X) == pytest.approx(np.zeros(6), abs=1e-3)
    assert joint.sigmas[0] < joint.sigmas[2] < 0.03
    both = together(named(flat, flat))
    assert both.unobservable() == ["z"]
    assert both.status is SolveStatus.UNOBSERVABLE


def test_what_all_have_from_one_measurement_by_hand_is_no_better_together():
    axes = tuple(
        dataclasses.replace(dof, verdict=DofVerdict.PRIOR, sigma=0.1) if dof.name == "z" else dof
        for dof in result().observability
    )
    wide = result().covariance + 0.01 * np.outer(*2 * [np.r_[X[2, :3], np.zeros(3)]])
    each = dataclasses.replace(result(), observability=axes, covariance=wide)
    joint = together(named(each, each, each))
    assert joint.observability[2].verdict is DofVerdict.PRIOR
    assert joint.sigmas[2] == pytest.approx(0.1, rel=0.05)


@pytest.mark.parametrize(
    ("shifts", "kind", "left_out", "verdict"),
    [
        ((0, 0, 1, 0), "one off", {"drive 3"}, hec.Verdict.USE_WITH_CARE),
        ((0, 0, 1, 1), "moved", {"drive 3", "drive 4"}, hec.Verdict.DO_NOT_USE),
        ((0, 1), "differ", set(), hec.Verdict.DO_NOT_USE),
        ((0, 0, 0, 0), "agree", set(), hec.Verdict.USE),
    ],
)
def test_what_does_not_belong_is_named_and_left_out(shifts, kind, left_out, verdict, tmp_path):
    moved = shift("yaw", np.radians(2.0)) + shift("x", 0.05)
    joint = together(named(*(result(each * moved, seed=i) for i, each in enumerate(shifts))))
    assert joint.together.kind == kind
    assert {each.name for each in joint.together.recordings if each.left_out} == left_out
    assert joint.verdict is verdict
    if kind in ("one off", "agree"):
        assert np.abs(deviation(joint.T_parent_child, X)[:3]).max() < 0.01
    hec.save(joint, tmp_path)
    again = hec.load(tmp_path)
    assert again.together.sentence == joint.together.sentence
    assert again.verdict is verdict
    json.dumps(joint.to_dict(), allow_nan=False)


def test_recordings_that_nobody_may_use_are_left_out():
    failed = result(status=SolveStatus.NOT_CONVERGED)
    joint = together(named(result(), failed))
    assert [bool(each.left_out) for each in joint.together.recordings] == [False, True]
    with pytest.raises(InputError, match="no recording can be used: drive 1: DO NOT USE"):
        together(named(failed))
    with pytest.raises(InputError, match="of one pair of frames"):
        together(named(result(), result(parent_frame="imu")))


def test_python_takes_pairs_of_trajectories():
    pairs = [pair(seed) for seed in range(2)]
    joint = hec.calibrate_together(pairs, ["monday", "tuesday"], method="park", checks=False)
    np.testing.assert_allclose(joint.T_parent_child, T_PARENT_CHILD, atol=3e-3)
    assert [each.name for each in joint.together.recordings] == ["monday", "tuesday"]
    assert (joint.parent_frame, joint.child_frame) == ("lidar", "camera")
    table = hec.calibrate_many([*pairs, (pairs[0][0][:5], pairs[0][1][:5])], checks=False)
    assert list(table.index) == ["1", "2", "3"]
    assert table.error.isna().tolist() == [True, True, False]
    assert table.x_m["1"] == pytest.approx(T_PARENT_CHILD[0, 3], abs=3e-3)
    with pytest.raises(InputError, match="monday: "):
        hec.calibrate_together([(pairs[0][0], 3)], ["monday"])
