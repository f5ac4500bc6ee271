"""Bag of both paths and the transform for viewers, written by ``calibrate --viewer``."""

import numpy as np
import pytest

import hand_eye_calib as hec
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.formats.installed import frames_of_bag
from hand_eye_calib.offline.cli.main import main

SAMPLE = ("sample:lidar.tum", "sample:camera.tum")


def write_viewer_bag(folder, *options):
    """The bag that the command writes for the sample, and the saved result."""
    bag = folder / "viewer"
    out = folder / "out"
    command = ["calibrate", *SAMPLE, "--viewer", str(bag), "--out", str(out)]
    assert main([*command, *options]) == 0
    return bag, hec.load(out)


def distances_from_child(bag, path_topic):
    """Distances (m) of a path of the child from its frame on /tf and /tf_static."""
    parent = hec.read_trajectory(bag, topic="world:lidar")
    path = hec.read_trajectory(bag, topic=path_topic)
    T_lidar_camera = frames_of_bag(bag).pose("lidar", "camera")
    expected = parent.at(path.stamps_ns, extrapolate=True) @ T_lidar_camera
    return np.linalg.norm(
        se3.translation_of(path.poses) - se3.translation_of(expected), axis=1
    )


def test_the_paths_agree_after_the_calibration_only(tmp_path):
    bag, result = write_viewer_bag(tmp_path)
    with PoseBag(bag) as opened:
        topics = {topic.name: topic.count for topic in opened.topics.values()}
    assert topics == {
        "/paths/child_after": 1,
        "/paths/child_before": 1,
        "/paths/parent": 1,
        "/tf": 600,
        "/tf_static": 1,
    }
    after = distances_from_child(bag, "/paths/child_after")
    before = distances_from_child(bag, "/paths/child_before")
    # The drift of both odometries in one minute is some decimetres.
    assert np.median(after) < 0.5
    assert np.median(before) > 10 * np.median(after)
    T_bag = frames_of_bag(bag).pose("lidar", "camera")
    assert T_bag == pytest.approx(result.T_parent_child, abs=1e-9)


def test_the_path_before_uses_the_installed_transform(tmp_path):
    truth = "-0.3747 0.0924 0.2028 -1.3489 -0.0072 -1.0812"
    bag, result = write_viewer_bag(tmp_path, "--installed", truth)
    assert result.comparison.verdict
    before = distances_from_child(bag, "/paths/child_before")
    assert np.median(before) < 0.5


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (
            [*SAMPLE, "--viewer", "{there}"],
            "exists, and no file is overwritten",
        ),
        ([*SAMPLE, "--viewer", ""], "the name is empty"),
        (
            [*SAMPLE, "sample:truth.tum", "--viewer", "new"],
            "--viewer applies to one recording of two sensors",
        ),
        (
            [*SAMPLE, "--child-measures", "rotations", "--viewer", "new"],
            "it needs a result from positions and orientations of both sensors",
        ),
    ],
)
def test_what_has_no_paths_is_refused(
    tmp_path, monkeypatch, capsys, command, message
):
    monkeypatch.chdir(tmp_path)
    there = tmp_path / "there"
    there.mkdir()
    arguments = [part.format(there=there) for part in command]
    try:
        code = main(["calibrate", *arguments])
    except SystemExit as end:
        code = end.code
    assert code in (1, 2)
    error = capsys.readouterr().err
    assert message in error
    assert not (tmp_path / "new").exists()
    assert not [*there.iterdir()]
