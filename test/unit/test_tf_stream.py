"""Live transforms become the poses that a replay finds in a bag of the same transforms."""

import numpy as np
import pytest
from motions import wandering_poses

from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.transforms import PoseFields, TfSource, TransformTree
from hand_eye_calib.live.tf_stream import TfStream

MOUNT = se3.exp(np.array([1.2, 0.1, 0.8, 0.2, -0.1, 1.5]))
MS = 1_000_000


def stamped(parent, child, stamp_ns, T_parent_child):
    position = tuple(T_parent_child[:3, 3].tolist())
    quat_xyzw = tuple(se3.to_quat_xyzw(T_parent_child).tolist())
    return PoseFields(stamp_ns, parent, child, position, quat_xyzw)


def moving(parent, child, period_ms, n_poses, start_ms=0):
    poses = wandering_poses(n_poses)
    return [
        (stamped(parent, child, (start_ms + k * period_ms) * MS, T), False)
        for k, T in enumerate(poses)
    ]


def in_order(*edges):
    return sorted((each for edge in edges for each in edge), key=lambda each: each[0].stamp_ns)


def live(events, source, max_gap_s=0.5):
    stream = TfStream(TfSource.parse(source), max_gap_s)
    return stream, [pose for event in events for pose in stream.add(*event)]


def replayed(events, source, max_gap_s=0.5):
    tree, source = TransformTree(), TfSource.parse(source)
    for event in events:
        tree.note(*event)
    for transform, is_static in events:
        tree.keep(transform, is_static, transform.stamp_ns)
    return tree.trajectory(source, max_gap_s)


STATIC = [(stamped("base", "lidar", 0, MOUNT), True)]
CHAINS = {
    "one_edge": (moving("odom", "lidar", 10, 80), "odom:lidar"),
    "a_mount": (STATIC + moving("odom", "base", 10, 80), "odom:lidar"),
    "downwards": (STATIC + moving("base", "odom", 10, 80), "odom:lidar"),
    "two_moving_edges": (
        STATIC + in_order(moving("map", "odom", 100, 30, 3), moving("odom", "base", 10, 300)),
        "map:lidar",
    ),
}


@pytest.mark.parametrize("name", CHAINS)
def test_live_poses_are_those_of_a_replay(name):
    events, source = CHAINS[name]
    _, poses = live(events, source)
    expected, _, _ = replayed(events, source)
    stamps_ns = [pose.stamp_ns for pose in poses]
    # Of two moving edges, the tree is complete with the second pose, and the last one still waits.
    taken = slice(1, len(expected) - 1) if name == "two_moving_edges" else slice(None)
    assert stamps_ns[: len(expected.stamps_ns[taken])] == expected.stamps_ns[taken].tolist()
    expected = expected.poses[np.isin(expected.stamps_ns, stamps_ns)]
    assert [pose.position for pose in poses] == [tuple(T[:3, 3].tolist()) for T in expected]
    assert [pose.quat_xyzw for pose in poses] == [
        tuple(quat) for quat in se3.to_quat_xyzw(expected).tolist()
    ]


def test_nothing_is_interpolated_across_a_gap():
    odometry = moving("odom", "base", 10, 300)
    events = in_order(moving("map", "odom", 100, 30), odometry[:100] + odometry[205:])
    _, poses = live(events, "map:base")
    assert replayed(events, "map:base")[2] > 5
    assert not [pose for pose in poses if 1000 * MS < pose.stamp_ns < 2050 * MS]


def test_a_loop_of_a_bag_goes_on_with_new_stamps():
    events = in_order(moving("map", "odom", 100, 30), moving("odom", "base", 10, 300))
    _, once = live(events, "map:base")
    _, twice = live(events * 2, "map:base")
    assert twice[: len(once)] == once
    assert len(twice) >= 2 * len(once) - 1


def test_what_is_missing_is_said_with_what_is_there():
    stream, poses = live(STATIC, "odom:lidar")
    assert poses == []
    assert stream.describe_missing() == (
        "no frame 'odom' in /tf and /tf_static; it has base:lidar (static)"
    )


@pytest.mark.parametrize(
    ("event", "text"),
    [
        ((stamped("other", "lidar", 0, MOUNT), True), "frame 'lidar' has two parents"),
        (
            (stamped("odom", "base", 0, MOUNT)._replace(quat_xyzw=(0.0, 0.0, 0.0, 0.0)), False),
            "transform odom:base: .* quaternion",
        ),
        (
            (stamped("odom", "base", 0, MOUNT)._replace(position=(0.0, 1e300, 0.0)), False),
            "transform odom:base: ",
        ),
        (
            (stamped("odom", "base", 0, MOUNT)._replace(position=(0.0, np.nan, 0.0)), False),
            "transform odom:base: .* a value that is not finite",
        ),
    ],
)
def test_a_transform_that_is_none_is_refused_and_the_others_go_on(event, text):
    stream, before = live(STATIC + moving("odom", "base", 10, 10), "odom:lidar")
    with pytest.raises(InputError, match=text):
        list(stream.add(*event))
    (after,) = stream.add(*moving("odom", "base", 10, 11)[-1])
    assert len(before) == 10
    assert after.stamp_ns == 100 * MS
