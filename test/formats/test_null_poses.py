"""Messages that state that there is no pose, as of a tracker that is lost: left out and counted."""

import json

import numpy as np
import pytest
from bag_making import (
    JAZZY,
    ODOMETRY,
    PATH,
    POSE_STAMPED,
    STORAGES,
    TF,
    bag_path,
    header,
    path_message,
    pose_message,
    tf_message,
    write_messages,
)
from motions import T_PARENT_CHILD, child_of, wandering_poses
from numpy.testing import assert_allclose

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.formats.bags.sources import source_of
from hand_eye_calib.formats.bags.unpacking import MessageReader
from hand_eye_calib.formats.transforms import PoseFields
from hand_eye_calib.offline.cli.main import main
from hand_eye_calib.online.live.input import PoseInput
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.live.session import LiveSession
from hand_eye_calib.online.live.state import Level

N = 200
STAMPS_NS = 1_700_000_000_000_000_000 + 50_000_000 * np.arange(N)
POSES = wandering_poses(N)
PARENT = se3.to_rows(POSES)
CHILD = se3.to_rows(child_of(POSES))
NULLS = {
    "all zero": [0.0] * 7,
    "zero quaternion": [1.0, 2.0, 3.0, 0.0, 0.0, -0.0, 0.0],
    "all NaN": [np.nan] * 7,
    "a NaN": [1.0, np.nan, 3.0, 0.0, 0.0, 0.0, 1.0],
    "infinite": [np.inf, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
}
FEW = (0, 1, 50, 51, 52, 199)  # 3 %, also the first and the last
MANY = tuple(range(20, 60))  # 20 %


def spoiled(rows, null, indices):
    rows = rows.copy()
    rows[list(indices)] = null
    return rows


def bag_of(path, storage, kind, rows):
    """A bag with the parent as odometry on /a, and the child, whose rows are given, on /b or TF."""
    recorded = []
    for stamp_ns, parent, child in zip(
        STAMPS_NS.tolist(), PARENT, rows, strict=True
    ):
        make = pose_message(ODOMETRY, stamp_ns, parent, "map", "lidar")
        recorded.append((stamp_ns, "/a", ODOMETRY, make))
        if kind == TF:
            recorded.append((stamp_ns, "/tf", TF, tf_of(stamp_ns, child)))
        else:
            make = pose_message(kind, stamp_ns, child, "odom", "camera")
            recorded.append((stamp_ns, "/b", kind, make))
    return write_messages(path, recorded, storage)


def tf_of(stamp_ns, row):
    """A transform odom -> camera of x y z qx qy qz qw."""
    make_edge = tf_message([(stamp_ns, "odom", "camera", np.eye(4))])

    def make(typestore):
        message = make_edge(typestore)
        transform = message.transforms[0].transform
        for component, value in zip("xyz", row[:3], strict=True):
            setattr(transform.translation, component, float(value))
        for component, value in zip("xyzw", row[3:], strict=True):
            setattr(transform.rotation, component, float(value))
        return message

    return make


def read(path, child):
    with PoseBag(path) as bag:
        table = bag.poses("/a", source_of(child))
        rows = table[table.streams == "child"]
        return rows.stamps_ns, rows.poses, bag.warnings


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("kind", [ODOMETRY, POSE_STAMPED, TF])
@pytest.mark.parametrize("null", NULLS.values(), ids=[*NULLS])
def test_null_poses_of_a_bag_are_left_out_and_counted(
    tmp_path, storage, kind, null
):
    rows = spoiled(CHILD, null, FEW)
    path = bag_of(bag_path(tmp_path, storage), storage, kind, rows)
    source = "odom:camera" if kind == TF else "/b"
    name = "/tf" if kind == TF else "/b"
    stamps_ns, poses, warnings = read(path, source)
    kept = np.delete(np.arange(N), FEW)
    assert stamps_ns.tolist() == STAMPS_NS[kept].tolist()
    assert_allclose(poses[:, :3], CHILD[kept, :3], atol=1e-12)
    assert warnings == [
        f"{name}: 6 of 200 poses (3.0%) were left out: their quaternion is 0, or a value is not "
        "finite or absent"
    ]


def test_many_null_poses_ask_for_another_recording(tmp_path):
    path = bag_of(
        tmp_path / "bag",
        "mcap",
        ODOMETRY,
        spoiled(CHILD, NULLS["all zero"], MANY),
    )
    _, _, (warning,) = read(path, "/b")
    assert warning.startswith("/b: 40 of 200 poses (20%) were left out: ")
    assert warning.endswith(
        "check whether the source loses track, and record again"
    )


def test_the_result_with_null_poses_is_the_truth_and_says_their_number(
    tmp_path, capsys
):
    path = bag_of(
        tmp_path / "bag",
        "sqlite3",
        POSE_STAMPED,
        spoiled(CHILD, NULLS["a NaN"], FEW),
    )
    options = [
        "--parent-topic",
        "/a",
        "--child-topic",
        "/b",
        "--reference",
        "B5",
        "--json",
    ]
    main(["calibrate", str(path), *options])
    document = json.loads(capsys.readouterr().out)
    assert [
        text for text in document["warnings"] if "6 of 200 poses (3.0%)" in text
    ]
    assert_allclose(
        document["T_parent_child"]["matrix"], T_PARENT_CHILD, atol=1e-6
    )


def test_a_quaternion_that_is_neither_unit_nor_zero_is_still_refused(
    tmp_path, capsys
):
    path = bag_of(
        tmp_path / "bag",
        "mcap",
        ODOMETRY,
        spoiled(CHILD, [0, 0, 0, 0, 0, 0, 0.5], FEW),
    )
    assert (
        main(
            [
                "calibrate",
                str(path),
                "--parent-topic",
                "/a",
                "--child-topic",
                "/b",
            ]
        )
        == 1
    )
    assert "quaternion of length 0.5, expected 1" in capsys.readouterr().err


def test_null_poses_of_a_path_are_left_out(tmp_path):
    def make(typestore):
        message = path_message(STAMPS_NS, POSES)(typestore)
        for index in FEW:
            orientation = message.poses[index].pose.orientation
            orientation.x = orientation.y = orientation.z = orientation.w = 0.0
        return message

    path = write_messages(
        tmp_path / "bag", [(int(STAMPS_NS[-1]), "/path", PATH, make)]
    )
    with PoseBag(path) as bag:
        trajectory, _ = bag.trajectory("/path")
        warnings = bag.warnings
    assert trajectory.stamps_ns.tolist() == np.delete(STAMPS_NS, FEW).tolist()
    assert [text.partition(" were")[0] for text in warnings] == [
        "/path: 6 of 200 poses (3.0%)"
    ]


def test_null_poses_of_fields_are_left_out(tmp_path):
    path = bag_of(
        tmp_path / "bag",
        "mcap",
        POSE_STAMPED,
        spoiled(CHILD, NULLS["all zero"], FEW),
    )
    place = ",".join(f"{axis}=pose.position.{axis}" for axis in "xyz")
    turn = ",".join(f"q{axis}=pose.orientation.{axis}" for axis in "xyzw")
    stamps_ns, _, warnings = read(path, f"/b?t=header.stamp,{place},{turn}")
    assert stamps_ns.tolist() == np.delete(STAMPS_NS, FEW).tolist()
    assert "6 of 200 poses (3.0%) were left out" in " ".join(warnings)


def test_orientations_alone_without_a_quaternion_are_left_out(tmp_path):
    path = bag_of(
        tmp_path / "bag",
        "mcap",
        ODOMETRY,
        spoiled(CHILD, NULLS["zero quaternion"], FEW),
    )
    with PoseBag(path) as bag:
        rotations, _ = bag.trajectory("/b", "rotations")
    with PoseBag(path) as bag:
        positions, _ = bag.trajectory("/b", "positions")
    assert len(rotations) == N - len(FEW)
    assert len(positions) == N


# ---- live


class Lines:
    """A logger that keeps what is written."""

    def __init__(self):
        self.written = []

    def __getattr__(self, level):
        return lambda text: self.written.append((level, text))


def live_input():
    lines = Lines()
    log = NodeLog(lines)
    session = LiveSession(log, CalibratorConfig())
    return (
        PoseInput("child", "/b", session, log, lambda _: None),
        session,
        lines,
    )


@pytest.mark.parametrize("null", NULLS.values(), ids=[*NULLS])
@pytest.mark.parametrize(
    ("indices", "level"), [(FEW, Level.OK), (MANY, Level.WARN)]
)
def test_null_poses_of_a_live_input_are_counted_and_are_no_error(
    null, indices, level
):
    pose_input, session, lines = live_input()
    for stamp_ns, row in zip(
        STAMPS_NS.tolist(), spoiled(CHILD, null, indices), strict=True
    ):
        frame = "camera" if row[3:].any() else ""
        fields = PoseFields(
            stamp_ns, "odom", frame, row[:3].tolist(), row[3:].tolist()
        )
        pose_input.accept(stamp_ns, lambda fields=fields: fields)
    state = pose_input.state(pose_input._arrived_s, may_rest=False)
    assert state.level is level
    assert state.refused["no pose"] == len(indices)
    assert state.poses_taken == N - len(indices)
    assert ("20% of the messages have no pose" in state.text) == (
        level is Level.WARN
    )
    assert session.calibrator.frame("child") == "camera"
    assert [text for kind, text in lines.written if "is refused" in text] == []


def test_a_null_message_is_read_live_as_in_a_bag():
    reader = MessageReader(ODOMETRY, "poses")
    message = pose_message(
        ODOMETRY, STAMPS_NS[0], NULLS["all zero"], "odom", "camera"
    )(JAZZY)
    fields = reader(bytes(JAZZY.serialize_cdr(message, ODOMETRY)))
    assert fields.quat_xyzw == (0.0, 0.0, 0.0, 0.0)
    assert header(JAZZY, STAMPS_NS[0], "odom").frame_id == fields.world_frame


def test_a_live_stream_with_whole_seconds_says_so():
    pose_input, _, _ = live_input()
    for stamp_ns, row in zip(STAMPS_NS.tolist(), CHILD, strict=True):
        whole_ns = stamp_ns // 10**9 * 10**9
        fields = PoseFields(
            whole_ns, "odom", "camera", row[:3].tolist(), row[3:].tolist()
        )
        pose_input.accept(whole_ns, lambda fields=fields: fields)
    state = pose_input.state(pose_input._arrived_s, may_rest=False)
    later = pose_input.state(pose_input._arrived_s + 11.0, may_rest=True)
    assert state.level is Level.ERROR
    assert (
        "/b: the stamps have whole seconds only: set header.stamp" in state.text
    )
    assert state.poses_taken == 10
    assert later.level is Level.WARN
    assert "the stamps have whole seconds only" in later.text
