"""What is unpacked from bytes is what the library that made them says is in them."""

import numpy as np
import pytest
from bag_making import JAZZY, NOETIC, ODOMETRY, POSE_STAMPED, TF, header
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from hand_eye_calib.core.base.errors import printable
from hand_eye_calib.formats.bags.messages import (
    MALFORMED,
    MESSAGE_TYPES,
    POSE_TYPES,
    Run,
)
from hand_eye_calib.formats.bags.pose_table import PoseTable
from hand_eye_calib.formats.bags.storage import MessageKind
from hand_eye_calib.formats.bags.unpacking import MessageReader, unpack_poses

ENCODINGS = ("cdr", "ros1")
TRANSFORM = "geometry_msgs/msg/TransformStamped"
TF_DEFINITION = b"geometry_msgs/TransformStamped[] transforms"

names = st.text(
    st.characters(codec="utf-8", exclude_characters="\0"), max_size=9
)
stamps_ns = st.integers(0, 2**31 * 10**9 - 1)
numbers = st.lists(st.floats(width=64), min_size=7, max_size=7)
poses = st.tuples(stamps_ns, names, names, numbers)


def message_of(typestore, message_type, stamp_ns, world, sensor, values):
    def make(name, *parts):
        return typestore.types[f"geometry_msgs/msg/{name}"](*parts)

    head = header(typestore, stamp_ns, world)
    zero = [0.0] * 3
    covariance = np.ones(36)
    quaternion = make("Quaternion", *values[3:])
    pose = make("Pose", make("Point", *values[:3]), quaternion)
    with_covariance = make("PoseWithCovariance", pose, covariance)
    twist = make("Twist", make("Vector3", *zero), make("Vector3", *zero))
    parts = {
        ODOMETRY: (
            sensor,
            with_covariance,
            make("TwistWithCovariance", twist, covariance),
        ),
        TRANSFORM: (
            sensor,
            make("Transform", make("Vector3", *values[:3]), quaternion),
        ),
        POSE_STAMPED: (pose,),
    }
    return typestore.types[message_type](
        head, *parts.get(message_type, (with_covariance,))
    )


def serialized(encoding, message_type, make):
    """Bytes of the message ``make(typestore)``, and whether they are of ROS 1."""
    if encoding == "ros1":
        return bytes(NOETIC.serialize_ros1(make(NOETIC), message_type)), True
    return bytes(JAZZY.serialize_cdr(make(JAZZY), message_type)), False


def encoded(encoding, message_type, pose):
    return serialized(
        encoding,
        message_type,
        lambda types: message_of(types, message_type, *pose),
    )


def assert_unpacked(columns, drawn, message_type):
    has_frame = MESSAGE_TYPES[message_type].has_child_frame
    assert columns.stamps_ns.tolist() == [
        stamp_ns for stamp_ns, _, _, _ in drawn
    ]
    worlds = [printable(world.lstrip("/")) for _, world, _, _ in drawn]
    assert columns.world_frames.tolist() == worlds
    sensors = [
        printable(sensor.lstrip("/")) if has_frame else None
        for _, _, sensor, _ in drawn
    ]
    assert columns.sensor_frames.tolist() == sensors
    assert_array_equal(columns.poses, [values for _, _, _, values in drawn])


# Of few frames, so that many messages are alike.
alike = st.tuples(
    stamps_ns,
    st.sampled_from(["a", "bc", "de"]),
    st.sampled_from("st"),
    numbers,
)


@pytest.mark.parametrize("message_type", POSE_TYPES)
@pytest.mark.parametrize("encoding", ENCODINGS)
@settings(max_examples=30)
@given(
    drawn=st.lists(alike, min_size=1, max_size=8)
    | st.lists(poses, min_size=1, max_size=2)
)
def test_poses_at_once_whether_their_frames_are_alike_or_not(
    encoding, message_type, drawn
):
    """The length of the frames' names shifts what follows: alignment is where readers go wrong."""
    messages = [encoded(encoding, message_type, pose)[0] for pose in drawn]
    if encoding == "ros1":  # its sequence numbers differ
        messages = [
            k.to_bytes(4, "little") + data[4:]
            for k, data in enumerate(messages)
        ]
    assert_unpacked(
        unpack_poses(messages, message_type, encoding == "ros1"),
        drawn,
        message_type,
    )
    if encoding == "cdr":  # one by one, as the node does
        read = MessageReader(message_type, "poses")
        stamps, worlds, sensors, *values = zip(
            *map(read, messages), strict=True
        )
        table = PoseTable.of(stamps, np.hstack(values), worlds, sensors)
        assert_unpacked(table, drawn, message_type)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_damaged_one_of_many_poses_is_refused(encoding):
    pose = (5_000_000_007, "odom", "lidar", [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0])
    good, is_ros1 = encoded(encoding, ODOMETRY, pose)
    stamp = bytearray(good)
    frame = bytearray(good)
    stamp[8:12] = b"\xff\xff\xff\xff"  # four seconds of nanoseconds
    frame[12:16] = b"\xff\xff\xff\xff"  # a frame's name of four gigabytes
    for damaged in (bytes(stamp), bytes(frame), good[:40], b""):
        for messages in ([damaged, good, good], [good, good, damaged]):
            with pytest.raises(MALFORMED):
                unpack_poses(messages, ODOMETRY, is_ros1)


@pytest.mark.parametrize("encoding", ENCODINGS)
@given(drawn=st.lists(poses, max_size=4))
def test_transforms_lose_the_leading_slash_of_old_frames(encoding, drawn):
    def make(types):
        edges = [
            message_of(types, TRANSFORM, stamp_ns, f"/{world}", sensor, values)
            for stamp_ns, world, sensor, values in drawn
        ]
        return types.types[TF](edges)

    kind = MessageKind("/tf", TF, encoding, ("MSG", TF_DEFINITION))
    data, _ = serialized(encoding, TF, make)
    transforms = Run(kind, [data], np.zeros(1)).transforms()
    for (_, fields), (stamp_ns, world, sensor, values) in zip(
        transforms, drawn, strict=True
    ):
        frames = printable(world).lstrip("/"), printable(sensor).lstrip("/")
        assert fields[:3] == (stamp_ns, *frames)
        assert_array_equal([*fields.position, *fields.quat_xyzw], values)
