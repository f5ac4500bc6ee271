"""Several recordings of one rig: one result, in Python and on the command line."""

import dataclasses
import json

import numpy as np
import pytest
import real_data
from fleet_making import recordings_of
from motions import (
    T_PARENT_CHILD,
    as_trajectory,
    child_of,
    disturbed,
    wandering_poses,
)
from numpy.testing import assert_allclose
from result_making import SHIFTED_FROM as X
from result_making import SIGMAS, shift, written_finding
from result_making import shifted as result

import hand_eye_calib as hec
from hand_eye_calib.core.assessment.agreement import agreement_of
from hand_eye_calib.core.assessment.comparison import (
    compare,
    scatters_in_words,
    with_comparison,
)
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import Extrinsic
from hand_eye_calib.core.geometry.se3 import deviation
from hand_eye_calib.core.results.calibration import DofVerdict, SolveStatus
from hand_eye_calib.core.results.records import AXES, Severity
from hand_eye_calib.extras.fleet.together import together

pytestmark = pytest.mark.usefixtures("no_figures")


def named(*results):
    """Results by name, in the order of time."""
    return {
        f"drive {number}": dataclasses.replace(result, stamp_ns=number)
        for number, result in enumerate(results, start=1)
    }


def pair(seed, n_poses=150):
    poses = wandering_poses(n_poses, seed=seed)
    child = disturbed(child_of(poses), seed, 5e-4, 5e-4)
    return (
        as_trajectory(
            disturbed(poses, 100 + seed, 5e-4, 5e-4), sensor_frame="lidar"
        ),
        as_trajectory(child, sensor_frame="camera"),
    )


def test_more_recordings_know_more_and_the_interval_is_honest():
    errors_m = {1: [], 3: [], 6: []}
    is_inside = []
    for seed in range(15):
        recordings = [result(seed=20 * seed + i) for i in range(6)]
        for count in errors_m:
            joint = together(named(*recordings[:count]))
            error = deviation(joint.T_parent_child, X)
            errors_m[count].append(np.linalg.norm(error[:3]))
            is_inside.extend(np.abs(error) < 1.645 * joint.sigmas_measured)
        assert joint.together.kind == "agree"
    assert np.median(errors_m[6]) < 0.75 * np.median(errors_m[1])
    share = np.mean(is_inside)
    assert share > 0.85, (
        f"sigmas are too small: {share:.0%} of errors are in 90 % intervals"
    )


def test_an_axis_that_one_recording_hides_comes_from_another():
    flat = result(shift("z", -0.4), hidden="z", status=SolveStatus.UNOBSERVABLE)
    hidden = flat.covariance_measured + 9.0 * np.outer(
        *2 * [np.r_[X[2, :3], np.zeros(3)]]
    )
    flat = dataclasses.replace(flat, covariance_measured=hidden)
    joint = together(named(flat, flat, result()))
    assert joint.status is SolveStatus.OK
    assert deviation(joint.T_parent_child, X) == pytest.approx(
        np.zeros(6), abs=1e-3
    )
    assert joint.sigmas_measured[0] < joint.sigmas_measured[2] < 0.03
    both = together(named(flat, flat))
    assert both.unobservable() == ["z"]
    assert both.status is SolveStatus.UNOBSERVABLE


def test_what_all_have_from_one_measurement_by_hand_is_no_better_together():
    axes = tuple(
        dataclasses.replace(dof, verdict=DofVerdict.PRIOR, sigma=0.1)
        if dof.name == "z"
        else dof
        for dof in result().observability_measured
    )
    wide = result().covariance_measured + 0.01 * np.outer(
        *2 * [np.r_[X[2, :3], np.zeros(3)]]
    )
    same = dataclasses.replace(
        result(), observability_measured=axes, covariance_measured=wide
    )
    joint = together(named(same, same, same))
    assert joint.observability[2].verdict is DofVerdict.PRIOR
    assert joint.sigmas_measured[2] == pytest.approx(0.1, rel=0.05)


@pytest.mark.parametrize(
    ("shifts", "kind", "left_out", "verdict"),
    [
        ((0, 0, 1, 0), "one off", {"drive 3"}, hec.Verdict.USE_WITH_CARE),
        ((0, 0, 1, 1), "moved", {"drive 3", "drive 4"}, hec.Verdict.DO_NOT_USE),
        ((0, 1), "differ", set(), hec.Verdict.DO_NOT_USE),
        ((0, 0, 0, 0), "agree", set(), hec.Verdict.USE),
    ],
)
def test_what_does_not_belong_is_named_and_left_out(
    shifts, kind, left_out, verdict, tmp_path
):
    moved = shift("yaw", np.radians(2.0)) + shift("x", 0.05)
    joint = together(
        named(
            *(
                result(displacement * moved, seed=i)
                for i, displacement in enumerate(shifts)
            )
        )
    )
    assert joint.together.kind == kind
    assert {
        recording.name
        for recording in joint.together.recordings
        if recording.left_out
    } == left_out
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
    assert [
        bool(recording.left_out) for recording in joint.together.recordings
    ] == [
        False,
        True,
    ]
    with pytest.raises(
        InputError, match="no recording can be used: drive 1: DO NOT USE"
    ):
        together(named(failed))
    with pytest.raises(InputError, match="of one pair of frames"):
        together(named(result(), result(parent_frame="imu")))


def test_the_common_result_has_the_gravest_findings_and_all_warnings():
    small = written_finding("jumps", Severity.NOTE, "few jumps", stream="child")
    large = written_finding(
        "jumps", Severity.WARNING, "many jumps", stream="child"
    )
    other = written_finding("jumps", Severity.NOTE, "a jump", stream="parent")
    first = dataclasses.replace(
        result(0), findings=(large, other), warnings=("m", "repaired")
    )
    second = dataclasses.replace(result(1), findings=(small,), warnings=("m",))
    joint = together(named(first, second))
    assert joint.findings == (large, other)
    assert joint.warnings == ("m", "drive 1: repaired")


def test_python_takes_pairs_of_trajectories():
    pairs = [pair(seed) for seed in range(2)]
    joint = hec.calibrate_together(
        pairs, ["monday", "tuesday"], method="park", checks=False
    )
    assert_allclose(joint.T_parent_child, T_PARENT_CHILD, atol=3e-3)
    assert [recording.name for recording in joint.together.recordings] == [
        "monday",
        "tuesday",
    ]
    assert (joint.parent_frame, joint.child_frame) == ("lidar", "camera")
    named = {
        "a": pairs[0],
        "b": pairs[1],
        "c": (pairs[0][0][:5], pairs[0][1][:5]),
    }
    table = hec.calibrate_many(named, checks=False)
    assert table.error.isna().to_dict() == {"a": True, "b": True, "c": False}
    assert table.x_m["a"] == pytest.approx(T_PARENT_CHILD[0, 3], abs=3e-3)
    with pytest.raises(InputError, match="monday: "):
        hec.calibrate_together([(pairs[0][0], 3)], ["monday"])
    with pytest.raises(InputError, match="a pair of parent and child"):
        hec.calibrate_many(pairs[0])


# ---- results of one rig agree, scatter, or have one among them that does not belong there


def results_of(seed, count, unknown_z=False, apart=(), factor=1.0):
    """Extrinsics and their covariances along the parent's axes, some rotated by 0.06 rad."""
    Ts, covariances = recordings_of(seed, count, unknown_z)
    to_parent = np.kron(np.eye(2), Ts[:, :3, :3])
    Ts = Ts.copy()
    apart = list(apart)
    Ts[apart] = se3.exp(np.array([0, 0, 0, 0, 0, 0.06])) @ Ts[apart]
    return Ts, factor * to_parent @ covariances @ np.swapaxes(to_parent, 1, 2)


@pytest.mark.parametrize("unknown_z", [False, True])
@pytest.mark.parametrize("count", [2, 3, 8, 30])
def test_honest_results_agree_with_the_chance_that_is_stated(count, unknown_z):
    seeds = range(40 if count < 10 else 15)
    agreements = [
        agreement_of(*results_of(seed, count, unknown_z)) for seed in seeds
    ]
    alarms = [
        agreement.kind for agreement in agreements if agreement.kind != "agree"
    ]
    assert len(alarms) <= 4  # 0.8 expected, 5 or more once in 800
    p_value = np.mean([agreement.p_value for agreement in agreements])
    assert p_value > 0.35, (
        f"sigmas are too small: p is {p_value:.2f} on average, expected 0.5"
    )
    assert p_value < 0.65, (
        f"sigmas are too large: p is {p_value:.2f} on average, expected 0.5"
    )
    axes = 5 if unknown_z else 6
    assert {agreement.dof for agreement in agreements} == {axes * (count - 1)}


@pytest.mark.parametrize("unknown_z", [False, True])
@pytest.mark.parametrize(
    ("apart", "kind"),
    [
        ([4], "one off"),
        ([0], "one off"),
        ([7], "one off"),
        ([5, 6, 7], "moved"),
    ],
)
def test_which_one_is_off_and_since_when(apart, kind, unknown_z):
    for seed in range(10):
        agreement = agreement_of(*results_of(seed, 8, unknown_z, apart))
        assert (agreement.kind, list(agreement.apart)) == (kind, apart)
        assert agreement.deviations[apart, 5] == pytest.approx(0.06, abs=0.02)
        assert np.isnan(agreement.deviations[0, 2]) == unknown_z
        assert agreement.p_value < 1e-6
        assert "the rotation about z by " in agreement.sentence("abcdefgh")


def test_results_that_all_scatter_more_than_stated_accuse_none():
    agreements = [
        agreement_of(*results_of(seed, 12, factor=0.25)) for seed in range(20)
    ]
    excesses = [
        agreement.excess
        for agreement in agreements
        if agreement.kind == "scatter"
    ]
    assert len(excesses) >= 19
    assert min(excesses) > 1.5
    assert max(excesses) < 2.5
    # The errors are far above these sigmas: the mounts differ.
    assert agreement_of(*results_of(0, 12, factor=0.001)).kind == "differ"


@pytest.mark.parametrize(("factor", "are_close"), [(1.0, False), (9.0, True)])
def test_results_closer_than_their_sigmas_are_explained(factor, are_close):
    agreement = agreement_of(*results_of(1, 8, factor=factor))
    sentence = agreement.sentence("abcdefgh")
    assert ("closer than their standard deviations" in sentence) == are_close


def test_a_single_result_and_one_that_knows_nothing():
    Ts, covariances = results_of(3, 2)
    agreement = agreement_of(Ts[:1], covariances[:1])
    assert (agreement.kind, agreement.dof, agreement.p_value) == (
        "single",
        0,
        1.0,
    )
    assert_allclose(agreement.T_parent_child, Ts[0])
    covariances[1] = np.diag([np.inf] * 6)
    agreement = agreement_of(Ts, covariances)
    assert (agreement.kind, agreement.dof) == ("agree", 0)
    assert_allclose(agreement.T_parent_child, Ts[0], atol=1e-9)
    assert np.isnan(agreement.deviations[1]).all()


# ---- results against what is installed, and recordings against each other


def values(difference):
    rows = difference.axes.values()
    return np.array([row.difference for row in rows])


def axes(difference, verdict):
    rows = difference.axes.items()
    return [axis for axis, row in rows if row.verdict == verdict]


def test_results_that_scatter_by_their_sigmas_are_the_same_and_the_power_is_told():
    comparison = compare([result(seed=1), result(seed=2), result(seed=3)])
    assert (comparison.verdict, comparison.moved) == ("same", ())
    pair_difference = comparison.differences[0]
    assert (
        pair_difference.sentence
        == "same: a change of 5.4 cm or 0.8 deg would have been seen"
    )
    assert_allclose(
        values(pair_difference),
        deviation(result(seed=2).T_parent_child, result(seed=1).T_parent_child),
    )


def test_a_comparison_names_the_scatter_that_its_sigmas_contain():
    in_hand = result(seed=1)
    of_vehicle = result(seed=2, sigmas=SIGMAS * [1, 1, 9, 1, 1, 1])
    assert scatters_in_words([in_hand, in_hand]) == (
        "+/- contains the usual scatter between recordings, which is assumed to be 8 mm and 0.12 "
        "deg, as for a sensor that turns about all axes"
    )
    text = scatters_in_words([in_hand, of_vehicle])
    assert text.endswith(
        "; and 2 cm and 0.1 deg, as for a vehicle, because one of x, y, z is much less certain"
    )


def test_chance_makes_a_change_less_than_once_in_a_hundred():
    moved = [
        compare([result(seed=2 * i), result(seed=2 * i + 1)]).verdict == "moved"
        for i in range(150)
    ]
    assert sum(moved) <= 2


@pytest.mark.parametrize("axis", AXES)
def test_a_change_of_the_size_that_is_said_to_be_seen_is_seen(axis):
    seen = compare([result(), result()]).differences[0].axes[axis].visible
    differences = [
        compare(
            [result(seed=i), result(shift(axis, seen), seed=100 + i)]
        ).differences[0]
        for i in range(20)
    ]
    named = [
        difference.axes[axis].verdict == "moved" for difference in differences
    ]
    assert np.mean(named) >= 0.9  # sigmas are taken larger than stated


def test_an_unknown_axis_is_neither_the_same_nor_moved():
    flat = result(shift("z", 0.5), hidden="z", status=SolveStatus.UNOBSERVABLE)
    difference = compare([flat], Extrinsic(X, "drawing")).differences[0]
    assert difference.verdict == "cannot tell"
    assert axes(difference, "cannot tell") == ["z"]
    assert np.isinf(difference.axes["z"].sigma)
    assert difference.sentence.startswith(
        "cannot tell about z; x, y, roll, pitch and yaw the same: "
    )


def test_what_no_recording_shows_counts_against_a_drawing_not_against_a_recording():
    floor = np.diag(np.r_[np.zeros(3), np.full(3, np.radians(0.2) ** 2)])
    first = result(covariance_allowance=floor)
    second = result(shift("yaw", np.radians(0.6)), covariance_allowance=floor)
    assert compare([second], Extrinsic(X, "drawing")).verdict == "same"
    assert compare([first, second]).verdict == "moved"
    stated = Extrinsic(
        X, "earlier result", first.covariance_measured, is_calibration=True
    )
    assert axes(compare([second], stated).differences[0], "moved") == ["yaw"]


def test_what_a_flight_alone_is_off_by_is_no_move():
    """Its truth is 15 mm off in y: of other flights of the same rig it is not."""
    flight = real_data.euroc("vio_stereo", "v2_01")
    published = Extrinsic(real_data.EUROC_TRUTH, "published")
    difference = compare(
        [hec.calibrate(flight.parent, flight.child)], published
    ).differences[0]
    assert difference.axes["y"].difference == pytest.approx(0.015, abs=0.002)
    assert difference.verdict == "same"


@pytest.mark.parametrize("sigma_z", [0.002, 0.05], ids=["in hand", "vehicle"])
@pytest.mark.parametrize("axis", range(3))
def test_a_mount_that_moved_by_3_cm_and_1_deg_is_found(sigma_z, axis):
    rotation_axis = AXES[axis + 3]
    sigma_rad = np.radians(0.05)
    sigmas = np.array([0.002, 0.002, sigma_z, sigma_rad, sigma_rad, sigma_rad])
    floor_sigmas = np.repeat([0.005, np.radians(0.15)], 3)
    options = {
        "sigmas": sigmas,
        "covariance_allowance": np.diag(floor_sigmas**2),
    }
    moved = shift(AXES[axis], 0.03) + shift(rotation_axis, np.radians(1.0))
    drawing = Extrinsic(X, "drawing")
    for seed in range(5):
        first = result(seed=seed, **options)
        second = result(moved, seed=100 + seed, **options)

        from_first = compare([first, second]).differences[0]
        from_drawing = compare([second], drawing).differences[0]

        assert rotation_axis in axes(from_first, "moved")
        assert rotation_axis in axes(from_drawing, "moved")


def test_an_axis_is_the_same_by_its_own_target():
    rough = result()
    drawing = Extrinsic(X, "drawing")
    assert compare([rough], drawing).verdict == "same"
    strict = dataclasses.replace(rough, target_axes={"y": 0.001})
    assert axes(compare([strict], drawing).differences[0], "cannot tell") == [
        "y"
    ]


@pytest.mark.parametrize(
    ("have_moved", "named", "sentence"),
    [
        (
            "010",
            ("drive 2",),
            "moved: drive 2 differs from the others: the rotation about y by ",
        ),
        (
            "0011",
            ("drive 3", "drive 4"),
            "moved: The mount has moved before drive 3: ",
        ),
        (
            "01",
            (),
            "moved: drive 1 and drive 2 differ; they do not show which of them has moved",
        ),
    ],
)
def test_which_one_moved(have_moved, named, sentence):
    moved = shift("pitch", np.radians(0.6))
    comparison = compare(
        [
            result(int(has_moved) * moved, seed=i)
            for i, has_moved in enumerate(have_moved)
        ],
        names=[f"drive {i + 1}" for i in range(len(have_moved))],
    )
    assert comparison.moved == named
    assert comparison.sentence.startswith(sentence)


def test_files_and_python_speak_of_the_same(tmp_path):
    changed = with_comparison(
        result(shift("x", 0.1), seed=1), Extrinsic(X, "drawing")
    )
    hec.save(changed, tmp_path)
    again = hec.load(tmp_path)
    assert again.comparison == changed.comparison
    assert again.comparison.verdict == "moved"
    assert again.comparison.installed == "drawing"
    assert hec.compare([again], Extrinsic(X, "drawing")).moved == ("result 1",)
    json.dumps(again.to_dict()["comparison"], allow_nan=False)
    with pytest.raises(InputError, match="a appears twice"):
        compare([again, again], names=["a", "a"])
