"""Bags that are cut off or have a flipped bit, at hundreds of places: a right answer, a warning, or
one line - never a traceback.

What cannot be noticed is a flipped bit that moves one pose by less than noise might (some
centimetres here), in a file without checksums; robust methods then give nearly the same answer, and
how nearly is tested. Bits of what is not read (covariances, twists, other topics) do no harm.
"""

import faulthandler
import json

import numpy as np
import pytest
from motions import T_PARENT_CHILD, as_trajectory, child_of, wandering_poses

from hand_eye_calib.cli.main import main
from hand_eye_calib.errors import InputError
from hand_eye_calib.io.bags import PoseBag, write_bag

PLACES = 100
ODOMETRY, POSE_STAMPED = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
POSES = wandering_poses(60)
STREAMS = {
    "/a": (as_trajectory(POSES, sensor_frame="lidar", world_frame="map"), ODOMETRY),
    "/b": (as_trajectory(child_of(POSES), sensor_frame="camera", world_frame="odom"), POSE_STAMPED),
}
COMMAND = [
    "--parent-topic",
    "/a",
    "--child-topic",
    "/b",
    "--child-frame",
    "camera",
    "--reference",
    "B5",
    "--json",
]
FILES = {"mcap": "bag.mcap", "sqlite3": "bag.db3", "rosbag1": ""}

# Largest error of an entry of T_parent_child that may go unnoticed.
UNNOTICED = 5e-3


@pytest.fixture(autouse=True)
def _nothing_hangs():
    """Whatever takes minutes is a hang: it ends the run with the place it hangs at."""
    faulthandler.dump_traceback_later(600, exit=True)
    yield
    faulthandler.cancel_dump_traceback_later()


@pytest.fixture(params=FILES)
def bag(request, tmp_path):
    """Bytes of a bag's file, and where to put damaged ones."""
    path = tmp_path / ("bag.bag" if request.param == "rosbag1" else "bag")
    write_bag(path, STREAMS, request.param)
    file = path / FILES[request.param] if path.is_dir() else path
    return file.read_bytes(), tmp_path / f"damaged{file.suffix}"


def read(path):
    """Poses and warnings, or the one line of an error."""
    try:
        with PoseBag(path) as bag:
            bag.select_topics("/a", "/b")
            poses = list(bag.poses("/a", "/b"))
            return poses, bag.warnings
    except InputError as error:
        return None, [str(error)]


def replay(path, capsys):
    """Exit code, JSON document or None, lines of errors on stderr."""
    code = main(["replay", str(path), *COMMAND])
    out, err = capsys.readouterr()
    return (
        code,
        json.loads(out) if out else None,
        [line for line in err.splitlines() if ": error: " in line],
    )


def places(size, seed):
    return np.random.default_rng(seed).integers(0, size, PLACES).tolist()


def test_cut_off_anywhere(bag, capsys):
    data, path = bag
    path.write_bytes(data)
    whole, warnings = read(path)
    assert (len(whole), warnings) == (120, [])
    outcomes = set()
    for number, size in enumerate(places(len(data), seed=1)):
        path.write_bytes(data[:size])
        poses, warnings = read(path)
        # A database may be opened and fail later, which is said too.
        assert len(warnings) in ((1, 2) if path.suffix == ".db3" else (1,)), size
        assert "\n" not in "".join(warnings)
        outcomes.add("refused" if poses is None else "recovered")
        if poses is not None:
            if path.suffix == ".db3":  # rows of other pages may be missing
                assert set(stamped(poses)) <= set(stamped(whole))
            else:
                assert poses == whole[: len(poses)]
        if number % 20 == 0:
            code, document, errors = replay(path, capsys)
            if document is None:
                assert (code, len(errors)) == (1, 1)
                continue
            assert any("lost" in warning for warning in document["warnings"])
            if document["verdict"] != "DO NOT USE":
                np.testing.assert_allclose(
                    document["T_parent_child"]["matrix"], T_PARENT_CHILD, atol=1e-6
                )
    assert outcomes == {"refused", "recovered"}


@pytest.mark.slow
def test_a_bit_flipped_anywhere(bag, capsys):
    data, path = bag
    path.write_bytes(data)
    whole, _ = read(path)
    code, document, _ = replay(path, capsys)
    np.testing.assert_allclose(document["T_parent_child"]["matrix"], T_PARENT_CHILD, atol=1e-9)
    harmed = 0
    bits = np.random.default_rng(3).integers(0, 8, PLACES).tolist()
    for place, bit in zip(places(len(data), seed=2), bits, strict=True):
        damaged = bytearray(data)
        damaged[place] ^= 1 << bit
        path.write_bytes(damaged)
        poses, _ = read(path)
        if poses is not None and without_bag_times(poses) == without_bag_times(whole):
            continue  # the engine gets what it got before
        harmed += 1
        code, document, errors = replay(path, capsys)
        if document is None:
            assert (code, len(errors)) == (1, 1), place
        elif not document["warnings"]:
            np.testing.assert_allclose(
                document["T_parent_child"]["matrix"],
                T_PARENT_CHILD,
                atol=UNNOTICED,
                err_msg=str(place),
            )
    assert harmed >= 10


def stamped(poses):
    return [(pose.stream, pose.stamp_ns, pose.position, pose.quat_xyzw) for pose in poses]


def without_bag_times(poses):
    return sorted(repr(pose._replace(bag_ns=0)) for pose in poses)
