"""Poses composed of transforms as they arrive."""

import numpy as np
import pytest
from motions import wandering_poses
from numpy.testing import assert_allclose

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.transforms import PoseFields, TfSource, TfStream

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
    return sorted(
        (pose for edge in edges for pose in edge),
        key=lambda pose: pose[0].stamp_ns,
    )


def live(events, source, max_gap_s=0.5):
    stream = TfStream(TfSource.parse(source), max_gap_s)
    return stream, [pose for event in events for pose in stream.add(*event)]


STATIC = [(stamped("base", "lidar", 0, MOUNT), True)]
STEPS = wandering_poses(80)


@pytest.mark.parametrize(
    ("events", "expected"),
    [
        (moving("odom", "lidar", 10, 80), STEPS),
        (STATIC + moving("odom", "base", 10, 80), STEPS @ MOUNT),
        (STATIC + moving("base", "odom", 10, 80), se3.inverse(STEPS) @ MOUNT),
    ],
)
def test_a_moving_edge_and_a_mount(events, expected):
    _, poses = live(events, "odom:lidar")
    assert [pose.stamp_ns for pose in poses] == [10 * MS * k for k in range(80)]
    Ts = se3.from_quat_xyzw(
        [pose.position for pose in poses], [pose.quat_xyzw for pose in poses]
    )
    assert_allclose(Ts, expected, atol=1e-12)


def test_two_moving_edges_at_the_stamps_of_the_slower():
    slow = moving("map", "odom", 100, 30, 3)
    fast = moving("odom", "base", 10, 300)
    _, poses = live(STATIC + in_order(slow, fast), "map:lidar")
    # The tree is complete with the first slow one, and the last one still waits.
    stamps_ns = np.array([pose.stamp_ns for pose in poses])
    assert (
        stamps_ns.tolist() == [(100 * k + 3) * MS for k in range(1, 29)]
        or len(poses) == 29
    )
    odometry = Trajectory(10 * MS * np.arange(300), wandering_poses(300))
    k = (stamps_ns // MS - 3) // 100
    expected = (
        wandering_poses(30)[k] @ odometry.at(stamps_ns, straight=True) @ MOUNT
    )
    assert_allclose(
        [pose.position for pose in poses], expected[:, :3, 3], atol=1e-12
    )


def test_nothing_is_interpolated_across_a_gap():
    odometry = moving("odom", "base", 10, 300)
    events = in_order(
        moving("map", "odom", 100, 30), odometry[:100] + odometry[205:]
    )
    _, poses = live(events, "map:base")
    assert len(poses) > 10
    assert not [pose for pose in poses if 1000 * MS < pose.stamp_ns < 2050 * MS]


def test_a_loop_of_a_bag_goes_on_with_new_stamps():
    events = in_order(
        moving("map", "odom", 100, 30), moving("odom", "base", 10, 300)
    )
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
        (
            (stamped("other", "lidar", 0, MOUNT), True),
            "frame 'lidar' has two parents",
        ),
        (
            (
                stamped("odom", "base", 0, MOUNT)._replace(
                    quat_xyzw=(0.0, 0.0, 0.0, 0.0)
                ),
                False,
            ),
            "transform odom:base: .* quaternion",
        ),
        (
            (
                stamped("odom", "base", 0, MOUNT)._replace(
                    position=(0.0, 1e300, 0.0)
                ),
                False,
            ),
            "transform odom:base: ",
        ),
        (
            (
                stamped("odom", "base", 0, MOUNT)._replace(
                    position=(0.0, np.nan, 0.0)
                ),
                False,
            ),
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
