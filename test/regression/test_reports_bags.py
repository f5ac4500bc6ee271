"""Bags rebuilt from public bug reports, with known truth: each command gives what its row says.

They are looked for where :mod:`published_data` looks; without them the tests are skipped.
"""

import numpy as np
import pytest
from report_inputs import calibrated, reports_folder

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.offline.cli.main import main

# Position (m) and roll, pitch, yaw (deg) of the child in the parent.
TRUTH = ((0.42, -0.11, 0.25), (-88.0, 3.0, -92.0))
ON_THE_ARM = ((0.06, 0.01, 0.05), (3.0, -2.0, 40.0))

# The noise of these bags moves results by a tenth of this (m, deg).
WITHIN_M = 0.005
WITHIN_DEG = 0.1

MESSAGES = 1192


@pytest.fixture
def bag():
    """Path of a bag by its name."""
    folder = reports_folder("bags")
    return lambda name: str(folder / name)


def matrix_of(truth):
    position, rpy_deg = truth
    rotation = se3.rotation_from_rpy(np.radians(rpy_deg))
    return se3.from_rotation_translation(rotation, np.array(position))


def assert_near(document, truth, within_m=WITHIN_M, within_deg=WITHIN_DEG):
    T_parent_child = np.array(document["T_parent_child"]["matrix"])
    error = se3.log(se3.inverse(truth) @ T_parent_child)
    assert np.abs(error[:3]).max() < within_m
    assert np.degrees(np.abs(error[3:]).max()) < within_deg


def frames_of(document):
    return document["parent_frame"], document["child_frame"]


def test_a_clean_bag_is_used(bag, capsys):
    code, document, err = calibrated(capsys, bag("good"))
    assert (code, document["verdict"], document["warnings"]) == (0, "USE", [])
    assert frames_of(document) == ("lidar", "camera")
    assert_near(document, matrix_of(TRUTH))
    assert "left out" not in err


def test_names_the_other_way_round_give_the_inverse(bag, capsys):
    names = ["--parent-frame", "camera", "--child-frame", "lidar"]
    code, document, _ = calibrated(capsys, bag("good"), *names)
    assert code == 0
    assert frames_of(document) == ("camera", "lidar")
    assert_near(document, se3.inverse(matrix_of(TRUTH)))


def test_a_camera_on_an_arm_that_sees_a_marker_is_named_and_right(bag, capsys):
    sources = [
        "--parent-topic",
        "base_link:tool0",
        "--child-topic",
        "camera:aruco_marker",
    ]
    code, document, _ = calibrated(capsys, bag("tf_bag"), *sources)
    assert (code, document["verdict"]) == (0, "USE")
    assert frames_of(document) == ("tool0", "camera")
    assert_near(document, matrix_of(ON_THE_ARM))
    assert main(["calibrate", bag("tf_bag"), *sources]) == 0
    text = capsys.readouterr().out
    assert "--frame-id tool0 --child-frame-id camera" in text
    assert "aruco_marker in tool0" not in text


def test_a_killed_recording_has_all_its_messages(bag, capsys):
    code, document, _ = calibrated(capsys, bag("wal_db3"))
    assert (code, document["verdict"]) == (0, "USE")
    assert_near(document, matrix_of(TRUTH))
    counts = [
        document["inputs"][stream]["messages"] for stream in ("parent", "child")
    ]
    assert counts == [MESSAGES, MESSAGES]


@pytest.mark.parametrize(
    ("name", "n_null"), [("lost_null", 29), ("first_null", 5)]
)
def test_null_poses_are_left_out_and_counted(bag, capsys, name, n_null):
    code, document, _ = calibrated(capsys, bag(name))
    assert (code, document["verdict"]) == (0, "USE")
    assert_near(document, matrix_of(TRUTH))
    sentence = f"/camera/odometry: {n_null} of 1,192 poses"
    assert [text for text in document["warnings"] if text.startswith(sentence)]


def test_header_stamps_of_0_are_said_and_receive_times_taken_if_asked(
    bag, capsys
):
    path = bag("zero_stamp_child")
    code, document, err = calibrated(capsys, path)
    assert (code, document) == (1, None)
    assert "/camera/odometry: 1,192 of 1,192 header stamps are 0" in err
    assert "--child-stamps receive" in err
    code, document, _ = calibrated(capsys, path, "--child-stamps", "receive")
    assert code == 0
    assert_near(document, matrix_of(TRUTH))


def test_clocks_of_two_epochs_are_estimated(bag, capsys):
    path = bag("boot_time")
    code, document, _ = calibrated(capsys, path, "--time-offset", "estimate")
    assert (code, document["verdict"]) == (0, "USE")
    assert_near(document, matrix_of(TRUTH))
    with PoseBag(path) as opened:
        table = opened.poses("/lidar/odometry", "/camera/odometry")
    first_ns = [
        table.stamps_ns[table.streams == stream][0]
        for stream in ("parent", "child")
    ]
    apart_s = (int(first_ns[0]) - int(first_ns[1])) * 1e-9
    assert abs(document["time_offset_s"] - apart_s) < 60.0
    assert document["time_offset_s"] > 1.6e9
