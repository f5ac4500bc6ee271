"""Commands for one job: ``arm``, ``rig``, ``batch`` and ``export``."""

import json
import shutil

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hand_eye_calib as hec
from hand_eye_calib.core.base.config import EXPORT_FORMATS, ROBOT_FORMATS
from hand_eye_calib.formats.files import local_path


def as_json(run, *arguments):
    _, out, err = run(*arguments, "--json")
    assert out, err
    return json.loads(out)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    result = hec.calibrate(
        "sample:lidar.tum", "sample:camera.tum", checks=False
    )
    return result.save(tmp_path_factory.mktemp("saved"))


def test_arm_is_calibrate_for_samples(run):
    alone = as_json(run, "arm", "sample:arm.yaml")
    assert (
        alone["T_parent_child"]
        == as_json(run, "calibrate", "sample:arm.yaml")["T_parent_child"]
    )


def test_arm_takes_two_files_as_stops(run, tmp_path):
    files = []
    for name, step in (("lidar.tum", 20), ("camera.tum", 40)):
        lines = (
            local_path(f"sample:{name}").read_text().splitlines(keepends=True)
        )
        poses = [line for line in lines if not line.startswith("#")]
        files.append(tmp_path / name)
        files[-1].write_text("".join(poses[::step]))
    alone = as_json(run, "arm", *files, "--pair-by", "row")
    both = as_json(
        run, "calibrate", *files, "--order", "none", "--pair-by", "row"
    )
    assert (alone["reference"], both["reference"]) == ("stops", "stops")
    # Only `arm` counts errors of the tilt of a flat target, so the results differ a little.
    rotation_of = [
        np.array(document["T_parent_child"]["matrix"])[:3, :3]
        for document in (alone, both)
    ]
    assert_allclose(*rotation_of, atol=5e-3)
    assert (alone["setup"], alone["parent_frame"]) == ("hand", "hand")
    placed = as_json(run, "arm", *files, "--setup", "hand")
    assert placed["T_parent_child"] == alone["T_parent_child"]


def test_files_of_an_arm_that_fit_two_places_of_the_camera_need_an_option(
    run, tmp_path
):
    samples = hec.read_arm_samples("sample:arm.yaml")
    files = [tmp_path / "hand.tum", tmp_path / "target.tum"]
    for file, poses in zip(
        files, (samples.robot, samples.tracking), strict=True
    ):
        stamps_ns = 1_000_000_000 * np.arange(len(poses))
        hec.write_trajectory(file, hec.Trajectory(stamps_ns, np.asarray(poses)))
    document = as_json(run, "arm", *files)
    assert document["verdict"] == "DO_NOT_USE"
    assert "setup beside" in document["reasons"][0]["what_to_do"]
    on_hand = as_json(run, "arm", *files, "--child-invert", "poses")
    assert (on_hand["verdict"], on_hand["setup"]) == ("USE", "hand")
    beside = as_json(run, "arm", *files, "--setup", "beside")
    assert (beside["verdict"], beside["setup"]) == ("USE", "beside")


def test_rig_is_calibrate_for_three_files(run, tmp_path):
    rear = tmp_path / "rear.tum"
    shutil.copy(local_path("sample:camera.tum"), rear)
    code, out, _ = run("rig", "sample:lidar.tum", "sample:camera.tum", rear)
    assert ": 3 sensors\n" in out
    assert run("calibrate", "sample:lidar.tum", "sample:camera.tum", rear)[
        :2
    ] == (
        code,
        out,
    )


def test_batch_is_calibrate_batch(run, tmp_path):
    folder = tmp_path / "fleet"
    folder.mkdir()
    shutil.copy(local_path("sample:drive.mcap"), folder / "monday.mcap")
    topics = (
        "--parent-topic",
        "/lidar/odometry",
        "--child-topic",
        "/camera/odometry",
    )
    rest = (*topics, "--no-report", "--jobs", "1")
    code, out, _ = run("batch", folder, *rest)
    assert code == 0
    assert out.startswith("fleet: USE")
    assert run("calibrate", "--batch", folder, *rest)[:2] == (code, out)


@pytest.mark.parametrize("name", [*EXPORT_FORMATS, *ROBOT_FORMATS])
def test_export_is_info_as_format(run, saved, name):
    file = run("export", saved, name)
    assert file == run("info", saved, "--as", name)
    assert file[0] == 0


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("urdf", "extrinsic.urdf.xacro"),
        ("launch", "static_transform.launch.py"),
    ],
)
def test_files_of_a_robot_are_exported_as_they_are_saved(
    run, saved, name, file
):
    assert run("export", saved, name)[1] == (saved.parent / file).read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["arm"],
            "arm needs the samples of an arm, or the stops of its hand and camera",
        ),
        (["rig", "a.tum", "b.tum"], "rig needs 3 sensors or more, got 2"),
        (
            ["rig", "bag", "--topics", "/a", "/b"],
            "rig needs 3 sensors or more, got 2",
        ),
        (["batch"], "batch needs bags, folders or patterns of bags"),
        (
            ["export", "result", "kalbr"],
            "argument FORMAT: invalid choice: 'kalbr'",
        ),
    ],
)
def test_paths_that_are_not_those_of_the_job_are_refused(
    run, arguments, message
):
    code, out, err = run(*arguments)
    assert (code, out) == (2, "")
    assert message in err
