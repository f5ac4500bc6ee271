"""The parent is the wheel odometry of a vehicle, the child a sensor on it."""

import numpy as np
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from ros_harness import RELIABLE_INPUTS, matrix, message

import hand_eye_calib as hec
from hand_eye_calib.core.geometry import se3
from reproduction.machines import simulate_machine


def wheel_odometry(drive):
    """Integrate the wheels with nominal radii and track: what a driver publishes on /odom."""
    radius_m, track_m = 0.1, 0.5
    left, right = drive.values.T * radius_m
    forward = (left + right) / 2
    yaw_rate = (right - left) / track_m
    nominal = np.column_stack([forward, yaw_rate])
    return hec.wheel_trajectory(drive.stamps_ns, nominal, "wheel_odometry")


def test_wheel_odometry_as_parent(start_node, peer):
    machine = simulate_machine(57, duration_s=90.0)
    wheels = wheel_odometry(machine)
    node = start_node(
        "-p parent_measures:=wheel_odometry", "-p solve_period:=1000.0", *RELIABLE_INPUTS
    )
    publishers = peer.publishers(Odometry, Odometry)
    peer.wait_matched(*publishers)
    transforms = peer.listen(TransformStamped, "extrinsic")
    messages = [
        (stamp_ns, publisher, pose, frame)
        for publisher, stream, frame in (
            (publishers[0], wheels, "base_link"),
            (publishers[1], machine.sensor, "lidar"),
        )
        for stamp_ns, pose in zip(stream.stamps_ns.tolist(), stream.poses, strict=True)
    ]
    for stamp_ns, publisher, pose, frame in sorted(messages, key=lambda row: row[0]):
        publisher.publish(message(Odometry, stamp_ns, pose, frame))
    answer = peer.trigger("solve")
    assert answer.success
    peer.spin_until(lambda: transforms, "the extrinsic")
    T_base_sensor = matrix(transforms[-1])
    error = se3.log(se3.inverse(machine.T_base_sensor) @ T_base_sensor)
    assert np.abs(error[:2]).max() < 0.03  # m, x and y; z is out of reach
    assert "Traceback" not in node.log
