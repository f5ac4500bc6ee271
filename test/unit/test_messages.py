"""What is unpacked from bytes is what the library that made them says is in them."""

import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hand_eye_calib.errors import printable
from hand_eye_calib.io.bags.messages import (
    MALFORMED,
    MESSAGE_TYPES,
    POSE_TYPES,
    MalformedMessage,
    unpack_path,
    unpack_poses,
    unpack_transforms,
)
from hand_eye_calib.io.transforms import PoseFields

JAZZY, NOETIC = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC)
NOETIC.register(
    get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
)
ENCODINGS = ("cdr little-endian", "cdr big-endian", "ros1")

names = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9)
stamps_ns = st.integers(0, 2**31 * 10**9 - 1)
numbers = st.lists(st.floats(width=64), min_size=7, max_size=7)
poses = st.tuples(stamps_ns, names, names, numbers)


def header(types, stamp_ns, frame, extra):
    return types["std_msgs/msg/Header"](
        stamp=types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9)),
        frame_id=frame,
        **extra,
    )


def message_of(typestore, message_type, stamp_ns, world, sensor, values, seq=7):
    types, extra = typestore.types, {"seq": seq} if typestore is NOETIC else {}
    head, point = (
        header(types, stamp_ns, world, extra),
        types["geometry_msgs/msg/Point"](*values[:3]),
    )
    quaternion, zero = (
        types["geometry_msgs/msg/Quaternion"](*values[3:]),
        types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0),
    )
    pose, covariance = types["geometry_msgs/msg/Pose"](point, quaternion), np.ones(36)
    with_covariance = types["geometry_msgs/msg/PoseWithCovariance"](pose, covariance)
    if message_type == "nav_msgs/msg/Odometry":
        twist = types["geometry_msgs/msg/TwistWithCovariance"](
            types["geometry_msgs/msg/Twist"](zero, zero), covariance
        )
        return types[message_type](head, sensor, with_covariance, twist)
    if message_type == "geometry_msgs/msg/TransformStamped":
        transform = types["geometry_msgs/msg/Transform"](
            types["geometry_msgs/msg/Vector3"](*values[:3]), quaternion
        )
        return types[message_type](head, sensor, transform)
    return types[message_type](head, with_covariance if "Covariance" in message_type else pose)


def serialized(encoding, make):
    """Bytes of ``make(typestore)``, which returns a message and its type, and whether they are of
    ROS 1.
    """
    typestore = NOETIC if encoding == "ros1" else JAZZY
    message, message_type = make(typestore)
    if encoding == "ros1":
        return bytes(NOETIC.serialize_ros1(message, message_type)), True
    return bytes(
        JAZZY.serialize_cdr(message, message_type, little_endian=encoding == "cdr little-endian")
    ), False


def encoded(encoding, message_type, pose, seq=7):
    return serialized(
        encoding, lambda typestore: (message_of(typestore, message_type, *pose, seq), message_type)
    )


def assert_fields(fields, pose, message_type):
    stamp_ns, world, sensor, values = pose
    has_frame = MESSAGE_TYPES[message_type].has_child_frame
    frames = printable(world), printable(sensor) if has_frame else None
    assert fields[:3] == (stamp_ns, *frames)
    np.testing.assert_array_equal([*fields.position, *fields.quat_xyzw], values)


@pytest.mark.parametrize("message_type", POSE_TYPES)
@pytest.mark.parametrize("encoding", ENCODINGS)
@given(pose=poses)
def test_a_pose(encoding, message_type, pose):
    """The length of the frames' names shifts what follows: alignment is where readers go wrong."""
    data, is_ros1 = encoded(encoding, message_type, pose)
    stamps_ns, worlds, sensors, (values,) = unpack_poses([data], message_type, is_ros1)
    fields = PoseFields(int(stamps_ns[0]), worlds[0], sensors[0], values[:3], values[3:])
    assert_fields(fields, pose, message_type)


@pytest.mark.parametrize("encoding", ENCODINGS)
@given(
    drawn=st.lists(
        st.tuples(
            stamps_ns, st.sampled_from(["a", "bc", "de"]), st.sampled_from(["s", "t"]), numbers
        ),
        min_size=1,
        max_size=8,
    )
)
def test_many_poses_at_once_whether_their_frames_are_alike_or_not(encoding, drawn):
    for message_type in ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"):
        messages = [encoded(encoding, message_type, pose, seq)[0] for seq, pose in enumerate(drawn)]
        found = unpack_poses(messages, message_type, encoding == "ros1")
        for index, pose in enumerate(drawn):
            values_found = found.poses[index].tolist()
            fields = [column[index] for column in found[:3]]
            assert_fields(
                PoseFields(*fields, values_found[:3], values_found[3:]), pose, message_type
            )


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_of_many_poses_the_damaged_one_is_named(encoding):
    pose = (5_000_000_007, "odom", "lidar", [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0])
    good, is_ros1 = encoded(encoding, "nav_msgs/msg/Odometry", pose)
    stamp = bytearray(good)
    stamp[8:12] = b"\xff\xff\xff\xff"  # four seconds of nanoseconds
    frame = bytearray(good)
    frame[12:16] = b"\xff\xff\xff\xff"  # a frame's name of four gigabytes
    for damaged in (bytes(stamp), bytes(frame), good[:40], b""):
        for index in range(3):
            messages = [good, good, good]
            messages[index] = damaged
            with pytest.raises(MalformedMessage) as caught:
                unpack_poses(messages, "nav_msgs/msg/Odometry", is_ros1)
            assert caught.value.index == index


@pytest.mark.parametrize("encoding", ENCODINGS)
@given(
    world=names,
    frames=st.sampled_from([["a"], ["a", "bcd"]]),
    drawn=st.lists(st.tuples(stamps_ns, numbers), max_size=6),
)
def test_a_path(encoding, world, frames, drawn):
    def make(typestore):
        types, extra = typestore.types, {"seq": 3} if typestore is NOETIC else {}
        steps = [
            message_of(
                typestore,
                "geometry_msgs/msg/PoseStamped",
                stamp_ns,
                frames[index % len(frames)],
                "",
                values,
            )
            for index, (stamp_ns, values) in enumerate(drawn)
        ]
        return types["nav_msgs/msg/Path"](
            header(types, 12, world, extra), steps
        ), "nav_msgs/msg/Path"

    found_world, found_stamps_ns, found_numbers = unpack_path(*serialized(encoding, make))
    assert found_world == printable(world)
    assert found_stamps_ns.tolist() == [stamp_ns for stamp_ns, _ in drawn]
    np.testing.assert_array_equal(
        found_numbers, np.array([values for _, values in drawn]).reshape(-1, 7)
    )


@pytest.mark.parametrize("encoding", ENCODINGS)
@given(drawn=st.lists(poses, max_size=4))
def test_transforms_lose_the_leading_slash_of_old_frames(encoding, drawn):
    def make(typestore):
        transforms = [
            message_of(
                typestore,
                "geometry_msgs/msg/TransformStamped",
                stamp_ns,
                f"/{world}",
                sensor,
                values,
            )
            for stamp_ns, world, sensor, values in drawn
        ]
        return typestore.types["tf2_msgs/msg/TFMessage"](transforms), "tf2_msgs/msg/TFMessage"

    for fields, (stamp_ns, world, sensor, values) in zip(
        unpack_transforms(*serialized(encoding, make)), drawn, strict=True
    ):
        assert_fields(
            fields,
            (stamp_ns, world.lstrip("/"), sensor.lstrip("/"), values),
            "geometry_msgs/msg/TransformStamped",
        )


@pytest.mark.parametrize("unpack", [unpack_path, unpack_transforms])
@given(data=st.binary(max_size=200), is_ros1=st.booleans())
def test_bytes_that_are_no_message_are_malformed_and_nothing_else(unpack, data, is_ros1):
    for start in (b"", b"\x00\x01\x00\x00"):
        with contextlib.suppress(*MALFORMED):
            unpack(start + data, is_ros1)


def test_an_encoding_that_is_not_plain_cdr_is_named():
    with pytest.raises(ValueError, match="expected plain CDR, found encoding 0x0007"):
        unpack_poses([b"\x00\x07\x00\x00" + bytes(100)], "geometry_msgs/msg/PoseStamped", False)
