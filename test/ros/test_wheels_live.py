"""The parent is the wheels of a vehicle, the child a sensor on it."""

import json

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped, TwistStamped
from nav_msgs.msg import Odometry
from ros_harness import RELIABLE_INPUTS, matrix, message
from sensor_msgs.msg import JointState
from std_msgs.msg import String

import hand_eye_calib as hec
from reproduction.machines import simulate_machine

# Number of rows of wheel data whose mean is one message: 10 Hz, the rate of the poses.
ROWS = 5
# Messages that are sent before the node must have received them; its queues are longer.
MESSAGES_A_PART = 500
LEFT_AND_RIGHT = ("wheel_left_joint", "wheel_right_joint")


def machine_of(model, duration_s):
    machine = simulate_machine(57, model, duration_s=duration_s)
    n_blocks = len(machine.values) // ROWS
    blocks = machine.values[: n_blocks * ROWS].reshape(n_blocks, ROWS, -1)
    stamps_ns = machine.stamps_ns[ROWS // 2 :: ROWS][:n_blocks]
    return machine._replace(stamps_ns=stamps_ns, values=blocks.mean(axis=1))


def stamped(kind, stamp_ns, frame=""):
    result = kind()
    result.header.stamp.sec, result.header.stamp.nanosec = divmod(
        stamp_ns, 10**9
    )
    result.header.frame_id = frame
    return result


def wheel_odometry(machine):
    """Integrate the wheels with nominal radii and track: what a driver publishes on /odom."""
    radius_m, track_m = 0.1, 0.5
    left, right = machine.values.T * radius_m
    nominal = np.column_stack([(left + right) / 2, (right - left) / track_m])
    odometry = hec.wheel_trajectory(
        machine.stamps_ns, nominal, "wheel_odometry"
    )
    return [message(Odometry, *row, "base_link") for row in rows(odometry)]


def joint_states(machine):
    messages = []
    for stamp_ns, values in zip(
        machine.stamps_ns.tolist(), machine.values.tolist(), strict=True
    ):
        state = stamped(JointState, stamp_ns)
        state.name = [*LEFT_AND_RIGHT, "head_joint"]
        state.position = [0.0, 0.0, 0.1]
        state.velocity = [*values, 0.0]
        messages.append(state)
    return messages


def car_states(machine):
    """A car with angles of two steered wheels, and angles instead of rates of its rear wheels."""
    speed, angle = machine.values.T
    angles = np.cumsum(speed) * 0.02 * ROWS
    half_width = 0.4  # of the front axle, as a share of the wheelbase
    both = [
        np.arctan(np.tan(angle) / (1 + side * half_width * np.tan(angle)))
        for side in (-1, 1)
    ]
    messages = []
    for stamp_ns, *row in zip(
        machine.stamps_ns.tolist(), angles, *both, strict=True
    ):
        state = stamped(JointState, stamp_ns)
        state.name = [
            "rear_left_wheel",
            "rear_right_wheel",
            "left_steering",
            "right_steering",
        ]
        state.position = [float(row[0]), *map(float, row)]
        messages.append(state)
    return messages


def twists(machine):
    messages = []
    for stamp_ns, values in zip(
        machine.stamps_ns.tolist(), machine.values.tolist(), strict=True
    ):
        twist = stamped(TwistStamped, stamp_ns, "base_link")
        twist.twist.linear.x, twist.twist.linear.y, twist.twist.angular.z = (
            values
        )
        messages.append(twist)
    return messages


def rows(stream):
    return zip(stream.stamps_ns.tolist(), stream.poses, strict=True)


def publish(peer, messages, machine):
    """Publish messages of wheels and the poses of the sensor in the order of their stamps.

    The next part is sent when the node has received the former: a burst of all would exceed the
    queues.
    """
    publishers = peer.publishers(type(messages[0]), Odometry)
    peer.wait_matched(*publishers)
    states = peer.listen(String, "progress")
    poses = [message(Odometry, *row, "lidar") for row in rows(machine.sensor)]
    queue = [("parent", item) for item in messages]
    queue += [("child", item) for item in poses]

    def stamp(row):
        return row[1].header.stamp.sec, row[1].header.stamp.nanosec

    queue.sort(key=stamp)
    publisher_of = dict(zip(("parent", "child"), publishers, strict=True))
    n_sent = {"parent": 0, "child": 0}

    def have_arrived():
        """Whether the node has received all that was sent."""
        inputs = json.loads(states[-1].data)["inputs"] if states else {}
        n_received = {name: row["messages"] for name, row in inputs.items()}
        return n_received == n_sent

    for start in range(0, len(queue), MESSAGES_A_PART):
        for name, item in queue[start : start + MESSAGES_A_PART]:
            publisher_of[name].publish(item)
            n_sent[name] += 1
        peer.spin_until(have_arrived, "all messages")


# Model of the machine, kind of wheel data, messages, and the parameter to look at.
CASES = {
    "odometry": (
        "wheels",
        "wheel_odometry",
        wheel_odometry,
        "wheel_radius_multiplier",
    ),
    "joint states": ("wheels", "auto", joint_states, "wheel_separation"),
    "joint states of a car": ("steering", "steering", car_states, "wheelbase"),
    "twists": ("omni", "omni", twists, "turn_multiplier"),
}


@pytest.mark.parametrize("case", CASES)
def test_wheels_as_parent(start_node, peer, tmp_path, case):
    model, measures, make_messages, parameter = CASES[case]
    machine = machine_of(model, 90.0)
    node = start_node(
        f"-p parent_measures:={measures}",
        f"-p output_directory:={tmp_path}/out",
        "-p solve_period:=1000.0",
        *RELIABLE_INPUTS,
    )
    transforms = peer.listen(TransformStamped, "extrinsic")
    publish(peer, make_messages(machine), machine)
    assert peer.trigger("solve").success
    peer.spin_until(lambda: transforms, "the extrinsic")
    errors_m = (matrix(transforms[-1]) - machine.T_base_sensor)[:2, 3]
    assert np.abs(errors_m).max() < 0.03  # x and y; z is out of reach
    assert peer.trigger("save").success
    saved = hec.load(tmp_path / "out")
    truth = {"wheel_separation": 2, "wheelbase": 1, "turn_multiplier": 2}
    if parameter in truth:
        expected = machine.parameters[truth[parameter]]
        assert saved.wheels[parameter].value == pytest.approx(
            expected, rel=0.01
        )
    assert "Traceback" not in node.log


def test_joints_without_wheels_are_answered_with_the_command_for_a_bag(
    start_node, peer
):
    machine = machine_of("wheels", 2.0)
    node = start_node("-p parent_measures:=wheels", *RELIABLE_INPUTS)
    messages = joint_states(machine)
    for state in messages:
        state.name = ["wheel_1", "wheel_2", "head_joint"]
    publish(peer, messages, machine)
    node.wait_for_log("the wheels are unclear", "hand_eye_calib calibrate BAG")
