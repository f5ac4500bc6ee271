"""Results against what is installed, and recordings against each other."""

import dataclasses
import json

import numpy as np
import pytest
import real_data
from result_making import SHIFTED_FROM as X
from result_making import shift
from result_making import shifted as result

import hand_eye_calib as hec
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry.extrinsic import Extrinsic
from hand_eye_calib.results.calibration import SolveStatus
from hand_eye_calib.results.status import AXES
from hand_eye_calib.session.together import compare, with_comparison


def values(difference):
    return np.array([each.difference for each in difference.axes.values()])


def axes(difference, verdict):
    return [axis for axis, each in difference.axes.items() if each.verdict == verdict]


def test_results_that_scatter_by_their_sigmas_are_the_same_and_the_power_is_told():
    found = compare([result(seed=1), result(seed=2), result(seed=3)])
    assert (found.verdict, found.moved) == ("same", ())
    one = found.differences[0]
    assert one.sentence == "same: a change of 5.4 cm or 0.8 deg would have been seen"
    np.testing.assert_allclose(
        values(one), deviation(result(seed=2).T_parent_child, result(seed=1).T_parent_child)
    )


def test_chance_makes_a_change_less_than_once_in_a_hundred():
    moved = [
        compare([result(seed=2 * i), result(seed=2 * i + 1)]).verdict == "moved" for i in range(150)
    ]
    assert sum(moved) <= 2


@pytest.mark.parametrize("axis", AXES)
def test_a_change_of_the_size_that_is_said_to_be_seen_is_seen(axis):
    seen = compare([result(), result()]).differences[0].axes[axis].visible
    found = [
        compare([result(seed=i), result(shift(axis, seen), seed=100 + i)]).differences[0]
        for i in range(20)
    ]
    named = [each.axes[axis].verdict == "moved" for each in found]
    assert np.mean(named) >= 0.9  # sigmas are taken larger than stated


def test_an_unknown_axis_is_neither_the_same_nor_moved():
    flat = result(shift("z", 0.5), hidden="z", status=SolveStatus.UNOBSERVABLE)
    found = compare([flat], Extrinsic(X, "drawing")).differences[0]
    assert found.verdict == "cannot tell"
    assert axes(found, "cannot tell") == ["z"]
    assert np.isinf(found.axes["z"].sigma)
    assert found.sentence.startswith("cannot tell about z; x, y, roll, pitch and yaw the same: ")


def test_what_no_recording_shows_counts_against_a_drawing_not_against_a_recording():
    floor = np.diag(np.r_[np.zeros(3), np.full(3, np.radians(0.2) ** 2)])
    first, second = result(floor=floor), result(shift("yaw", np.radians(0.6)), floor=floor)
    assert compare([second], Extrinsic(X, "drawing")).verdict == "same"
    assert compare([first, second]).verdict == "moved"
    known = Extrinsic(X, "earlier result", first.covariance, is_calibration=True)
    assert axes(compare([second], known).differences[0], "moved") == ["yaw"]


def test_what_a_flight_alone_is_off_by_is_no_move():
    """Its truth is 15 mm off in y: of other flights of the same rig it is not."""
    flight = real_data.euroc("vio_stereo", "v2_01")
    published = Extrinsic(real_data.EUROC_TRUTH, "published")
    found = compare([hec.calibrate(flight.parent, flight.child)], published).differences[0]
    assert found.axes["y"].difference == pytest.approx(0.015, abs=0.002)
    assert found.verdict == "same"


@pytest.mark.parametrize("sigma_z", [0.002, 0.05], ids=["in hand", "vehicle"])
@pytest.mark.parametrize("axis", range(3))
def test_a_mount_that_moved_by_3_cm_and_1_deg_is_found(sigma_z, axis):
    sigmas = np.r_[0.002, 0.002, sigma_z, np.full(3, np.radians(0.05))]
    moved = shift(AXES[axis], 0.03) + shift(AXES[axis + 3], np.radians(1.0))
    floor = np.diag(np.r_[np.full(3, 0.005**2), np.full(3, np.radians(0.15) ** 2)])
    for seed in range(5):
        first, second = (
            result(sigmas=sigmas, seed=seed, floor=floor),
            result(moved, sigmas=sigmas, seed=100 + seed, floor=floor),
        )
        assert AXES[axis + 3] in axes(compare([first, second]).differences[0], "moved")
        against = compare([second], Extrinsic(X, "drawing")).differences[0]
        assert AXES[axis + 3] in axes(against, "moved")


def test_an_axis_is_the_same_by_its_own_target():
    rough, drawing = result(), Extrinsic(X, "drawing")
    assert compare([rough], drawing).verdict == "same"
    strict = dataclasses.replace(rough, target_axes={"y": 0.001})
    assert axes(compare([strict], drawing).differences[0], "cannot tell") == ["y"]


@pytest.mark.parametrize(
    ("have_moved", "named", "sentence"),
    [
        ("010", ("drive 2",), "moved: drive 2 differs from the others: the rotation about y by "),
        ("0011", ("drive 3", "drive 4"), "moved: The mount has moved before drive 3: "),
        ("01", (), "moved: drive 1 and drive 2 differ; they do not show which of them has moved"),
    ],
)
def test_which_one_moved(have_moved, named, sentence):
    moved = shift("pitch", np.radians(0.6))
    found = compare(
        [result(int(each) * moved, seed=i) for i, each in enumerate(have_moved)],
        names=[f"drive {i + 1}" for i in range(len(have_moved))],
    )
    assert found.moved == named
    assert found.sentence.startswith(sentence)


def test_files_and_python_speak_of_the_same(tmp_path):
    changed = with_comparison(result(shift("x", 0.1), seed=1), Extrinsic(X, "drawing"))
    hec.save(changed, tmp_path)
    again = hec.load(tmp_path)
    assert again.comparison == changed.comparison
    assert again.comparison.verdict == "moved"
    assert again.comparison.installed == "drawing"
    assert hec.compare([again], Extrinsic(X, "drawing")).moved == ("result 1",)
    json.dumps(again.to_dict()["comparison"], allow_nan=False)


@pytest.mark.parametrize(
    ("results", "fields", "text"),
    [
        ([], {}, "two results or more"),
        ([result()], {}, "two results or more"),
        ([result(), result()], {"names": ["a", "a"]}, "2 different names"),
        ([result(), result(parent_frame="imu")], {}, "results of one pair of frames; found "),
    ],
)
def test_what_cannot_be_compared_is_refused(results, fields, text):
    with pytest.raises(InputError, match=text):
        compare(results, **fields)
