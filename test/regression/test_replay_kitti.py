"""The command ``replay`` on KITTI: the published figures, out of any kind of bag."""

import json

import numpy as np
import pytest
from published_data import kitti_short, rotation_error_deg, translation_error_m

from hand_eye_calib.cli.main import main
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.bags import write_bag

STORAGES = {"mcap": "short", "sqlite3": "short_sqlite3", "rosbag1": "short.bag"}


@pytest.fixture(scope="module")
def case():
    return kitti_short()


@pytest.fixture(scope="module")
def documents(case, tmp_path_factory):
    """What ``replay --json`` prints for each kind of bag."""
    folder = tmp_path_factory.mktemp("kitti")
    streams = {
        "/lidar/odom": (named(case.parent, "velo_link"), "nav_msgs/msg/Odometry"),
        "/camera/odom": (named(case.child, "camera_gray_left"), "nav_msgs/msg/Odometry"),
    }
    found = {}
    for storage, name in STORAGES.items():
        write_bag(folder / name, streams, storage)
        topics = ["--parent-topic", "/lidar/odom", "--child-topic", "/camera/odom"]
        with pytest.MonkeyPatch.context() as patch:
            printed = []
            patch.setattr(
                "builtins.print", lambda *texts, printed=printed, **_: printed.extend(texts)
            )
            code = main(
                [
                    "replay",
                    str(folder / name),
                    *topics,
                    "--method",
                    "dnlo",
                    "--reference",
                    "B10",
                    "--json",
                ]
            )
        found[storage] = (code, json.loads("".join(printed)))
    return found


def named(trajectory, sensor_frame):
    return Trajectory(trajectory.stamps_ns, trajectory.poses, sensor_frame, f"{sensor_frame}_start")


def test_replay_gives_the_published_errors(case, documents):
    code, document = documents["mcap"]
    # The height is known to 1.1 m only, which is not known; the method's own answer has it.
    assert (code, document["status"]) == (3, "unobservable")
    verdicts = {dof["name"]: dof["verdict"] for dof in document["observability"]}
    assert verdicts["z"] == "unobservable"
    assert (document["method"], document["reference"], document["n_poses"]) == ("dnlo", "B10", 448)
    assert (document["parent_frame"], document["child_frame"]) == ("velo_link", "camera_gray_left")
    T_parent_child = np.array(document["T_method"]["matrix"])
    assert translation_error_m(T_parent_child, case.T_parent_child) == pytest.approx(0.20, abs=0.01)
    assert rotation_error_deg(T_parent_child, case.T_parent_child) == pytest.approx(0.23, abs=0.01)


@pytest.mark.parametrize("storage", ["sqlite3", "rosbag1"])
def test_all_storages_give_the_same_numbers_bit_by_bit(documents, storage):
    code, document = documents[storage]
    document = document | {
        "inputs": document["inputs"] | {"bag": documents["mcap"][1]["inputs"]["bag"]}
    }
    assert (code, document) == documents["mcap"]
