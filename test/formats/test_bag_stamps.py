"""Stamps of a bag's messages that are 0 or have whole seconds only, and the times of receipt."""

import json

import numpy as np
import pytest
from bag_making import (
    ODOMETRY,
    PATH,
    POSE_STAMPED,
    STORAGES,
    TF,
    bag_path,
    path_message,
    pose_message,
    tf_message,
    write_messages,
)
from motions import T_PARENT_CHILD, child_of, wandering_poses
from numpy.testing import assert_allclose

from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.formats.bags.sources import source_of
from hand_eye_calib.offline.cli.main import main

N = 300
STAMPS_NS = 1_700_000_000_000_000_000 + 50_000_000 * np.arange(N)
POSES = wandering_poses(N)
CHILD = child_of(POSES)
TOPICS = ["--parent-topic", "/a", "--child-topic", "/b", "--reference", "B5"]


def zeros(stamps_ns):
    return np.zeros_like(stamps_ns)


def whole_seconds(stamps_ns):
    return stamps_ns // 10**9 * 10**9


def bag_of(path, storage, kind, header_of):
    """A bag recorded at STAMPS_NS, whose child has other header stamps."""
    recorded = []
    for bag_ns, header_ns, parent, child in zip(
        STAMPS_NS.tolist(),
        header_of(STAMPS_NS).tolist(),
        POSES,
        CHILD,
        strict=True,
    ):
        make = pose_message(
            ODOMETRY, bag_ns, se3.to_rows(parent), "map", "lidar"
        )
        recorded.append((bag_ns, "/a", ODOMETRY, make))
        if kind == TF:
            make = tf_message([(header_ns, "odom", "camera", child)])
            recorded.append((bag_ns, "/tf", TF, make))
        else:
            make = pose_message(
                kind, header_ns, se3.to_rows(child), "odom", "camera"
            )
            recorded.append((bag_ns, "/b", kind, make))
    return write_messages(path, recorded, storage)


def read(path, child, **options):
    with PoseBag(path) as bag:
        table = bag.poses("/a", source_of(child), **options)
        return table[table.streams == "child"], bag.warnings


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("kind", [ODOMETRY, POSE_STAMPED, TF])
def test_header_stamps_of_0_are_named_and_the_recorders_times_are_taken_if_asked(
    tmp_path, storage, kind
):
    path = bag_of(bag_path(tmp_path, storage), storage, kind, zeros)
    source = "odom:camera" if kind == TF else "/b"
    with pytest.raises(
        InputError,
        match=r"300 of 300 header stamps are 0. .*`child_stamps` rec",
    ):
        read(path, source)
    rows, warnings = read(path, source, stamps={"child": "receive"})
    assert rows.stamps_ns.tolist() == STAMPS_NS.tolist()
    assert_allclose(rows.poses[:, :3], CHILD[:, :3, 3], atol=1e-12)
    assert "at which the recorder received the messages" in " ".join(warnings)


@pytest.mark.parametrize("storage", STORAGES)
def test_whole_seconds_are_named(tmp_path, storage):
    path = bag_of(bag_path(tmp_path, storage), storage, ODOMETRY, whole_seconds)
    message = r"/b: the header stamps have whole seconds only: 300 poses have 15 stamps"
    with pytest.raises(InputError, match=message):
        read(path, "/b")
    rows, _ = read(path, "/b", stamps={"child": "receive"})
    assert rows.stamps_ns.tolist() == STAMPS_NS.tolist()


def test_a_simulation_may_begin_at_0_and_a_slow_stream_may_have_whole_seconds(
    tmp_path,
):
    recorded = []
    for second, pose in enumerate(POSES[:40]):
        stamp_ns = second * 10**9
        make = pose_message(ODOMETRY, stamp_ns, se3.to_rows(pose))
        recorded.append((stamp_ns + 1, "/a", ODOMETRY, make))
    path = write_messages(tmp_path / "bag", recorded)
    with PoseBag(path) as bag:
        trajectory, _ = bag.trajectory("/a")
        assert bag.warnings == []
    assert trajectory.stamps_ns.tolist() == [
        second * 10**9 for second in range(40)
    ]


def test_a_few_stamps_of_0_are_left_out_and_counted(tmp_path):
    def some_zero(stamps_ns):
        zero_poses = [3, 4, 5, 90]
        with_zeros = stamps_ns.copy()
        with_zeros[zero_poses] = 0
        return with_zeros

    path = bag_of(tmp_path / "bag", "mcap", ODOMETRY, some_zero)
    rows, warnings = read(path, "/b")
    assert (
        rows.stamps_ns.tolist() == np.delete(STAMPS_NS, (3, 4, 5, 90)).tolist()
    )
    assert warnings == ["/b: 4 poses were left out: their header stamps are 0"]


@pytest.mark.parametrize("option", ["--stamps", "--child-stamps"])
def test_the_command_takes_the_recorders_times_if_asked(
    tmp_path, capsys, option
):
    path = bag_of(tmp_path / "bag", "sqlite3", ODOMETRY, zeros)
    assert main(["calibrate", str(path), *TOPICS]) == 1
    error = capsys.readouterr().err
    assert "/b: 300 of 300 header stamps are 0" in error
    assert "--child-stamps receive" in error
    assert main(["check", str(path), *TOPICS[:4]]) == 1
    assert "--child-stamps receive" in capsys.readouterr().err
    main(["calibrate", str(path), *TOPICS, option, "receive", "--json"])
    document = json.loads(capsys.readouterr().out)
    assert_allclose(
        document["T_parent_child"]["matrix"], T_PARENT_CHILD, atol=1e-6
    )
    assert main(["check", str(path), *TOPICS[:4], option, "receive"]) in (0, 1)
    assert "header stamps" not in capsys.readouterr().err


def test_a_path_has_no_times_of_receipt(tmp_path):
    make = path_message(STAMPS_NS, POSES)
    path = write_messages(
        tmp_path / "bag", [(int(STAMPS_NS[-1]), "/path", PATH, make)]
    )
    with (
        PoseBag(path) as bag,
        pytest.raises(ConfigError, match=r"received as a whole"),
    ):
        bag.trajectory("/path", stamps="receive")


def test_times_of_receipt_are_of_bags_alone(capsys):
    sample = ["sample:lidar.tum", "sample:camera.tum"]
    assert main(["calibrate", *sample, "--stamps", "receive"]) == 2
    assert "--stamps applies to bags only" in capsys.readouterr().err
