"""Between messages and numbers, without a node."""

from types import SimpleNamespace

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from numpy.testing import assert_allclose
from rclpy.serialization import serialize_message
from result_making import NAMES, dofs, good_calibration
from sensor_msgs.msg import Imu, NavSatFix
from visualization_msgs.msg import Marker

from hand_eye_calib.core.base import config
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.covariances import turned
from hand_eye_calib.core.results.context import Comparison
from hand_eye_calib.formats.bags.messages import MESSAGE_TYPES, ns_of
from hand_eye_calib.formats.bags.unpacking import MessageReader
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.ros import conversions
from hand_eye_calib.online.ros.markers import to_markers
from hand_eye_calib.online.ros.outputs import ResultTopics

T_PARENT_CHILD = se3.exp(np.array([0.4, -0.3, 0.2, 1.1, -0.7, 0.5]))


def calibration(covariance, **changes):
    named = {"child_frame": "camera", "stamp_ns": 1_700_000_000_123_456_789}
    changes |= named | {
        "T_parent_child": T_PARENT_CHILD,
        "covariance_measured": covariance,
    }
    return good_calibration(**changes)


def test_every_pose_type_of_the_options_can_be_read():
    auto, *names = config.POSE_TYPES
    assert auto == "auto"
    for name in names:  # of which bags have more
        assert name in MESSAGE_TYPES
        assert name.endswith(f"/{conversions.message_class(name).__name__}")


def test_control_characters_in_names_of_frames_are_escaped():
    read = MessageReader("nav_msgs/msg/Odometry", "poses")
    data = serialize_message(Odometry(child_frame_id="li\x1b[2J\ndar"))
    assert read(data).sensor_frame == "li\\x1b[2J\\ndar"


def test_control_characters_do_not_reach_the_log():
    written = []

    class Recorder:
        info = warning = error = written.append

    log = NodeLog(Recorder())
    for write in (log.info, log.warning, log.error):
        write("frame a\x1b[2J\nsecond line")
    assert written == ["frame a\\x1b[2J\nsecond line"] * 3


@pytest.mark.parametrize(
    ("kind", "measures"),
    [(Imu, "rates"), (Imu, "rotations"), (NavSatFix, "positions")],
)
def test_a_message_without_what_is_measured_is_refused(kind, measures):
    message = kind()
    if kind is Imu:
        message.orientation_covariance[0] = message.angular_velocity_covariance[
            0
        ] = -1.0
    else:
        message.status.status = -1
    read = MessageReader(f"sensor_msgs/msg/{kind.__name__}", measures)
    with pytest.raises(InputError, match=f"the message has no {measures}"):
        read(serialize_message(message))


def test_messages_carry_frames_stamp_and_transform():
    transform = conversions.to_transform(calibration(np.eye(6)))
    assert (transform.header.frame_id, transform.child_frame_id) == (
        "lidar",
        "camera",
    )
    assert ns_of(transform.header.stamp) == 1_700_000_000_123_456_789
    pose = conversions.to_pose_with_covariance(calibration(np.eye(6)))
    assert pose.header == transform.header
    total = calibration(np.eye(6), covariance_allowance=np.eye(6))
    total = conversions.to_pose_with_covariance(total).pose.covariance
    assert_allclose(np.reshape(total, (6, 6)), 2.0 * np.eye(6), atol=1e-12)
    for place, turn in (
        (transform.transform.translation, transform.transform.rotation),
        (pose.pose.pose.position, pose.pose.pose.orientation),
    ):
        read = se3.from_quat_xyzw(
            [place.x, place.y, place.z], [turn.x, turn.y, turn.z, turn.w]
        )
        assert_allclose(read, T_PARENT_CHILD, atol=1e-15)


def test_markers_draw_sensors_uncertainty_and_what_is_installed():
    sigmas_m = np.array([0.01, 0.02, 0.03])
    in_parent = np.diag([*sigmas_m**2, 1e-4, 1e-4, 1e-4])
    in_child = turned(se3.inverse(T_PARENT_CHILD)[:3, :3], in_parent)
    installed = dict(
        zip(NAMES, (0.4, -0.3, 0.2, 0.0, 0.0, np.pi / 2), strict=True)
    )
    comparison = Comparison(sentence="same", values=installed)
    message = to_markers(calibration(in_child, comparison=comparison))
    clear, *markers = message.markers
    assert clear.action == Marker.DELETEALL
    assert {marker.header.frame_id for marker in markers} == {"lidar"}
    by_name = {marker.ns: marker for marker in markers}
    assert list(by_name) == [
        "parent",
        "child",
        "uncertainty",
        "text",
        "installed",
    ]
    assert_allclose(pose_of(by_name["parent"]), np.eye(4), atol=1e-15)
    assert_allclose(pose_of(by_name["child"]), T_PARENT_CHILD, atol=1e-12)
    x_axis = pose_of(by_name["installed"])[:3, 0]
    assert_allclose(x_axis, [0.0, 1.0, 0.0], atol=1e-12)
    ellipsoid = by_name["uncertainty"]
    size = ellipsoid.scale
    assert_allclose([size.x, size.y, size.z], 6.0 * sigmas_m, rtol=1e-9)
    T_parent_ellipsoid = pose_of(ellipsoid)
    assert_allclose(np.abs(T_parent_ellipsoid[:3, :3]), np.eye(3), atol=1e-9)
    assert "camera in lidar" in by_name["text"].text


def test_without_a_result_markers_are_deleted():
    (marker,) = to_markers(None).markers
    assert marker.action == Marker.DELETEALL


def test_the_ellipsoid_of_an_unobservable_axis_stays_in_the_scene():
    (ellipsoid,) = (
        marker
        for marker in to_markers(calibration(9.0 * np.eye(6))).markers
        if marker.ns == "uncertainty"
    )
    assert (ellipsoid.scale.x, ellipsoid.scale.y, ellipsoid.scale.z) == (
        2.0,
        2.0,
        2.0,
    )


def pose_of(marker):
    """The pose (4, 4) of a marker in the parent sensor's frame."""
    place = marker.pose.position
    turn = marker.pose.orientation
    quat_xyzw = [turn.x, turn.y, turn.z, turn.w]
    return se3.from_quat_xyzw([place.x, place.y, place.z], quat_xyzw)


def test_a_result_that_is_too_uncertain_withdraws_the_one_before():
    """A late subscriber gets what the page says, not an older pose."""
    made = []
    gone = []

    def create(kind, name, qos):
        sent = []
        made.append(SimpleNamespace(name=name, sent=sent, publish=sent.append))
        return made[-1]

    topics = ResultTopics(
        SimpleNamespace(create_publisher=create, destroy_publisher=gone.append)
    )
    sure, unsure = (
        calibration(np.eye(6), observability_measured=dofs([0.01] * 6, hidden))
        for hidden in ((), NAMES)
    )
    for sent_result in (unsure, sure, unsure, unsure):  # the last is not new
        topics.publish(sent_result)
    markers, *made = made
    # A subscriber that is there deletes what it has drawn.
    assert (markers.name, len(markers.sent)) == ("~/markers", 3)
    assert [(topic.name, len(topic.sent)) for topic in made] == [
        ("~/extrinsic", 1),
        ("~/extrinsic_with_covariance", 2),
        ("~/extrinsic", 0),
        ("~/extrinsic_with_covariance", 1),
    ]
    assert gone == made[:2]


def test_covariance_is_about_the_fixed_axes_of_the_parent():
    rng = np.random.default_rng(7)
    factor = 2e-3 * np.tril(rng.normal(size=(6, 6)) + 2 * np.eye(6))
    cov_in_child = factor @ factor.T
    samples = 400_000
    errors = rng.normal(size=(samples, 6)) @ factor.T
    moved = T_PARENT_CHILD @ se3.exp(errors)
    # What a receiver of the message measures: where the origin went, and the rotation about fixed
    # axes that took it there.
    shift = moved[:, :3, 3] - T_PARENT_CHILD[:3, 3]
    turn = se3.rotation_log(moved[:, :3, :3] @ T_PARENT_CHILD[:3, :3].T)
    measured = np.cov(np.hstack([shift, turn]).T)
    converted = turned(T_PARENT_CHILD[:3, :3], cov_in_child)
    scale = np.sqrt(np.outer(np.diag(measured), np.diag(measured)))
    # Standard error of a sampled correlation is below 1 / sqrt(samples); five of them, and the
    # second-order terms of exp.
    assert converted / scale == pytest.approx(
        measured / scale, abs=5 / np.sqrt(samples) + 5e-3
    )
    # The test can tell: the unconverted covariance is far off.
    assert np.abs((cov_in_child - measured) / scale).max() > 0.3
