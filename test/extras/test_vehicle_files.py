"""Wheel data in files, bags and live messages, and the command line."""

import json

import numpy as np
import pytest
from bag_making import JAZZY
from rosbags import rosbag2
from vehicle_making import machine, pose_errors

import hand_eye_calib as hec
from hand_eye_calib.extras.vehicle.joints import middle_angle
from hand_eye_calib.extras.vehicle.live import live_reading
from hand_eye_calib.formats.bags.writer import write_streams
from hand_eye_calib.offline.cli.main import main

HEADERS = {
    "wheels": "t,left_rad_s,right_rad_s",
    "steering": "t, speed_m_s, steering_angle_deg",
    "tricycle": "t, drive_speed, steering_angle",
    "omni": "t,vx,vy,wz",
}


def write_files(folder, measures):
    drive = machine(measures)
    values = drive.values
    if measures == "steering":
        values = values * [1.0, np.degrees(1.0)]
    rows = np.column_stack([drive.stamps_ns * 1e-9, values])
    header = HEADERS[measures]
    np.savetxt(
        folder / "wheels.csv",
        rows,
        fmt="%.6f",
        delimiter=",",
        header=header,
        comments="",
    )
    hec.write_trajectory(folder / "lidar.tum", drive.sensor)
    return str(folder / "wheels.csv"), str(folder / "lidar.tum")


@pytest.mark.parametrize("measures", HEADERS)
def test_files_give_the_result_of_arrays(tmp_path, measures):
    wheels, lidar = write_files(tmp_path, measures)
    drive = machine(measures)
    with pytest.warns(UserWarning, match="by its columns"):
        of_files = hec.calibrate_vehicle(lidar, wheels)
    of_arrays = hec.calibrate_vehicle(drive.sensor, drive.wheels)
    assert of_files.parent_frame == "base_link"
    assert of_files.T_parent_child == pytest.approx(
        of_arrays.T_parent_child, abs=1e-4
    )


def test_command_line(tmp_path, capsys):
    wheels, lidar = write_files(tmp_path, "wheels")
    out = tmp_path / "out"
    assert main(["calibrate", wheels, lidar, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "lidar in base_link" in printed
    assert "wheel_separation: " in printed
    urdf = (out / "extrinsic.urdf.xacro").read_text()
    assert '<parent link="base_link"/>' in urdf
    assert "MEASURE_Z_BY_HAND" in urdf
    result = hec.load(out)
    assert result.wheels["wheel_separation"].value == pytest.approx(
        0.5, rel=0.1
    )
    assert result.inverse().wheels == result.wheels
    report = (out / "report.html").read_text()
    assert "Pose of" in report
    # The path of wheels of unknown size cannot be compared with that of the lidar.
    assert "Both trajectories, aligned" not in report


def test_command_line_without_wheels(tmp_path, capsys):
    _, lidar = write_files(tmp_path, "wheels")
    assert main(["calibrate", lidar, "--on-vehicle", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["parent_frame"] == "base_link"
    assert document["measured"] == "vehicle_alone"
    # The parent is made of the child, so that there is no second clock.
    assert document["time_offset_s"] == pytest.approx(0.0, abs=1e-12)
    assert document["time_offset_sigma_s"] == 0.0
    assert main(["calibrate", lidar, lidar, "--on-vehicle"]) == 2
    bag = tmp_path / "drive.bag"
    bag.write_bytes(b"#ROSBAG V2.0")
    capsys.readouterr()
    assert main(["calibrate", str(bag), "--on-vehicle"]) == 2
    assert "is a bag: --on-vehicle takes" in capsys.readouterr().err


def test_odometry_of_a_bag(tmp_path):
    drive = machine()
    left, right = drive.values.T
    nominal = np.column_stack(
        [0.1 * (left + right) / 2.0, 0.1 * (right - left) / 0.5]
    )
    odometry = hec.wheel_trajectory(drive.stamps_ns, nominal, "wheel_odometry")
    base = hec.Trajectory(
        odometry.stamps_ns, odometry.poses, "base_footprint", "odom"
    )
    lidar = hec.Trajectory(
        drive.sensor.stamps_ns, drive.sensor.poses, "lidar", "map"
    )
    bag = tmp_path / "bag"
    with rosbag2.Writer(
        bag, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP
    ) as writer:
        type_ = "nav_msgs/msg/Odometry"
        write_streams(
            writer, {"/odom": (base, type_), "/lidar": (lidar, type_)}, "mcap"
        )
    arguments = ["--parent-topic", "/odom", "--child-topic", "/lidar"]
    arguments += [
        "--parent-measures",
        "wheel_odometry",
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(["calibrate", str(bag), *arguments]) == 0
    result = hec.load(tmp_path / "out")
    assert result.parent_frame == "base_footprint"
    assert np.abs(pose_errors(result, drive.T_base_sensor))[:2].max() < 0.01


def write_wheel_bag(path, type_, topic, messages, drive):
    """Write messages at the stamps of the wheels, and the odometry of the lidar."""
    lidar = hec.Trajectory(
        drive.sensor.stamps_ns, drive.sensor.poses, "lidar", "map"
    )
    with rosbag2.Writer(
        path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP
    ) as writer:
        write_streams(
            writer, {"/lidar": (lidar, "nav_msgs/msg/Odometry")}, "mcap"
        )
        connection = writer.add_connection(topic, type_, typestore=JAZZY)
        for stamp_ns, message in zip(
            drive.stamps_ns.tolist(), messages, strict=True
        ):
            writer.write(
                connection, stamp_ns, JAZZY.serialize_cdr(message, type_)
            )


def header(stamp_ns):
    stamp = JAZZY.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    return JAZZY.types["std_msgs/msg/Header"](stamp, "")


def joint_states(drive, names, has_velocity):
    kind = JAZZY.types["sensor_msgs/msg/JointState"]
    n_each = len(names) // 2
    rates = np.repeat(drive.values, n_each, axis=1)
    # Drivers integrate the rates.
    positions = np.cumsum(rates, axis=0) * 0.02
    nothing = np.zeros(0)
    for stamp_ns, rate, position in zip(
        drive.stamps_ns.tolist(), rates, positions, strict=True
    ):
        velocity = rate if has_velocity else nothing
        yield kind(header(stamp_ns), [*names], position, velocity, nothing)


@pytest.mark.parametrize(
    ("names", "fields", "has_velocity"),
    [
        (["wheel_left_joint", "wheel_right_joint"], "", True),
        (["wheel_left_joint", "wheel_right_joint"], "", False),
        (
            [
                "front_left_wheel",
                "rear_left_wheel",
                "front_right_wheel",
                "rear_right_wheel",
            ],
            "",
            True,
        ),
        (["joint_1", "joint_2"], "?joint_1,joint_2", True),
    ],
)
def test_joint_states_of_a_bag(tmp_path, capsys, names, fields, has_velocity):
    drive = machine()
    bag = tmp_path / "bag"
    messages = joint_states(drive, names, has_velocity)
    write_wheel_bag(
        bag, "sensor_msgs/msg/JointState", "/joint_states", messages, drive
    )
    arguments = [
        "--parent-topic",
        f"/joint_states{fields}",
        "--child-topic",
        "/lidar",
    ]
    assert (
        main(
            ["calibrate", str(bag), *arguments, "--out", str(tmp_path / "out")]
        )
        == 0
    )
    assert names[0] in capsys.readouterr().err
    result = hec.load(tmp_path / "out")
    assert np.abs(pose_errors(result, drive.T_base_sensor))[:2].max() < 0.01
    radius = result.wheels["left_wheel_radius"].value
    assert radius == pytest.approx(drive.parameters[0], rel=0.004)


def test_joint_states_without_wheels_are_refused(tmp_path, capsys):
    drive = machine()
    bag = tmp_path / "bag"
    messages = joint_states(drive, ["joint_1", "joint_2"], True)
    write_wheel_bag(
        bag, "sensor_msgs/msg/JointState", "/joint_states", messages, drive
    )
    assert main(["calibrate", str(bag), "--parent-topic", "/joint_states"]) == 1
    assert (
        "name the joints: /joint_states?LEFT,RIGHT" in capsys.readouterr().err
    )


def car_states(drive, wheel_names, steering_names):
    """Joint states of a car: equal rear wheels, and the wheels of an Ackermann axle."""
    kind = JAZZY.types["sensor_msgs/msg/JointState"]
    names = [*wheel_names, *steering_names]
    n_steered = len(steering_names)
    sides = [0.0] if n_steered == 1 else [-0.4, 0.4]
    for stamp_ns, (speed, angle) in zip(
        drive.stamps_ns.tolist(), drive.values, strict=True
    ):
        tangent = np.tan(angle)
        angles = [
            float(np.arctan(tangent / (1.0 + side * tangent))) for side in sides
        ]
        positions = np.array([0.0] * len(wheel_names) + angles)
        velocities = np.array([speed] * len(wheel_names) + [0.0] * n_steered)
        yield kind(header(stamp_ns), names, positions, velocities, np.zeros(0))


@pytest.mark.parametrize(
    ("measures", "wheels", "steering", "fields"),
    [
        (
            "steering",
            ["rear_left_wheel", "rear_right_wheel"],
            ["left_steer", "right_steer"],
            "",
        ),
        ("steering", ["a", "b"], ["c", "d"], "?a+b,c+d"),
        ("tricycle", ["front_drive_wheel"], ["front_steering_joint"], ""),
    ],
)
def test_joint_states_of_a_steered_vehicle(
    tmp_path, measures, wheels, steering, fields
):
    drive = machine(measures)
    bag = tmp_path / "bag"
    messages = car_states(drive, wheels, steering)
    write_wheel_bag(
        bag, "sensor_msgs/msg/JointState", "/joint_states", messages, drive
    )
    arguments = [
        "--parent-topic",
        f"/joint_states{fields}",
        "--child-topic",
        "/lidar",
    ]
    arguments += ["--parent-measures", measures, "--out", str(tmp_path / "out")]
    assert main(["calibrate", str(bag), *arguments]) == 0
    result = hec.load(tmp_path / "out")
    assert np.abs(pose_errors(result, drive.T_base_sensor))[:2].max() < 0.01
    assert result.wheels["wheelbase"].value == pytest.approx(
        drive.parameters[1], rel=0.004
    )


def test_joint_states_of_a_steered_vehicle_need_the_kind(tmp_path, capsys):
    drive = machine("steering")
    bag = tmp_path / "bag"
    messages = car_states(
        drive, ["rear_left_wheel", "rear_right_wheel"], ["steer"]
    )
    write_wheel_bag(
        bag, "sensor_msgs/msg/JointState", "/joint_states", messages, drive
    )
    arguments = ["--parent-topic", "/joint_states", "--child-topic", "/lidar"]
    assert main(["calibrate", str(bag), *arguments]) == 1
    assert (
        "has steering joints, steer: set --parent-measures to"
        in capsys.readouterr().err
    )


def test_angles_of_a_steered_axle():
    for angle in (-0.6, -0.1, -0.001, 0.0, 0.02, 0.3, 0.8):
        tangent = np.tan(angle)
        wheels = [
            np.arctan(tangent / (1.0 + side * tangent)) for side in (-0.3, 0.3)
        ]
        assert middle_angle(wheels) == pytest.approx(angle, rel=1e-3)
    # Noise of both wheels has opposite signs where the wheels are straight.
    assert middle_angle([0.002, -0.0019]) == pytest.approx(0.00005)


def test_velocities_without_stamps_are_refused(tmp_path, capsys):
    drive = machine("omni")
    vector = JAZZY.types["geometry_msgs/msg/Vector3"]
    twist = JAZZY.types["geometry_msgs/msg/Twist"]
    speed = twist(vector(1.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
    bag = tmp_path / "bag"
    messages = [speed] * len(drive.stamps_ns)
    write_wheel_bag(bag, "geometry_msgs/msg/Twist", "/cmd_vel", messages, drive)
    arguments = ["--parent-topic", "/cmd_vel", "--child-topic", "/lidar"]
    assert (
        main(["calibrate", str(bag), *arguments, "--parent-measures", "omni"])
        == 1
    )
    assert (
        "it has no stamps, and is usually a command" in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("header", "units"),
    [
        ("t,left_rpm,right_rpm", [np.pi / 30] * 2),
        ("t,left_deg_s,right_deg_s", [np.pi / 180] * 2),
        ("t,speed_km_h,steering_angle_deg", [1 / 3.6, np.pi / 180]),
        ("t,left_rad_s,right_rad_s", [1.0, 1.0]),
    ],
)
def test_units_in_the_names_of_columns(tmp_path, header, units):
    stamps_ns = np.arange(3) * 20_000_000
    values = np.array([[1.0, 2.0], [3.0, 4.0], [2.0, 1.0]])
    path = tmp_path / "wheels.csv"
    rows = np.column_stack([stamps_ns * 1e-9, values])
    np.savetxt(
        path, rows, fmt="%.6f", delimiter=",", header=header, comments=""
    )
    with pytest.warns(UserWarning, match="by its columns"):
        read = hec.read_trajectory(path)
    expected = hec.wheel_trajectory(stamps_ns, values * units, read.measures)
    assert read.poses == pytest.approx(expected.poses)


def test_the_order_of_columns_and_decimal_commas_are_read(tmp_path):
    columns = {"t": [0.0, 0.02], "left": [1.5, 2.5], "right": [1.0, 3.0]}
    stamps_ns = np.arange(2) * 20_000_000
    values = np.column_stack([columns["left"], columns["right"]])
    path = tmp_path / "wheels.csv"
    lines = ["t;right_rad_s;left_rad_s"]
    for stamp, left, right in zip(*columns.values(), strict=True):
        lines.append(f"{stamp};{right};{left}".replace(".", ","))
    path.write_text("\n".join(lines), encoding="utf-8")
    with pytest.warns(UserWarning, match="by its columns"):
        read = hec.read_trajectory(path)
    expected = hec.wheel_trajectory(stamps_ns, values, "wheels")
    assert read.poses == pytest.approx(expected.poses)


def twists(drive):
    """Velocities of an omnidirectional machine."""
    vector = JAZZY.types["geometry_msgs/msg/Vector3"]
    twist = JAZZY.types["geometry_msgs/msg/Twist"]
    kind = JAZZY.types["geometry_msgs/msg/TwistStamped"]
    for stamp_ns, (forward, left, turn) in zip(
        drive.stamps_ns.tolist(), drive.values.tolist(), strict=True
    ):
        rates = twist(vector(forward, left, 0.0), vector(0.0, 0.0, turn))
        yield kind(header(stamp_ns), rates)


@pytest.mark.parametrize("model", ["steering", "omni"])
def test_live_messages_have_the_poses_of_a_bag(tmp_path, model):
    drive = machine(model)
    type_ = "geometry_msgs/msg/TwistStamped"
    messages = [*twists(drive)] if model == "omni" else []
    if not messages:
        type_ = "sensor_msgs/msg/JointState"
        messages = [
            *car_states(drive, ["rear_wheel"], ["left_steer", "right_steer"])
        ]
    write_wheel_bag(tmp_path / "bag", type_, "/wheels", messages, drive)
    in_bag = hec.read_trajectory(
        tmp_path / "bag", topic="/wheels", measures=model
    )
    read = live_reading(type_, "/wheels", model)
    live = [
        read(bytes(JAZZY.serialize_cdr(message, type_))) for message in messages
    ]
    assert [pose.stamp_ns for pose in live] == in_bag.stamps_ns.tolist()
    positions = np.array([pose.position for pose in live])
    assert positions == pytest.approx(in_bag.poses[:, :3, 3], abs=1e-8)


def test_twists_of_a_bag(tmp_path):
    drive = machine("omni")
    messages = [*twists(drive)]
    bag = tmp_path / "bag"
    write_wheel_bag(
        bag, "geometry_msgs/msg/TwistStamped", "/twist", messages, drive
    )
    arguments = [
        "--parent-topic",
        "/twist",
        "--child-topic",
        "/lidar",
        "--parent-measures",
        "omni",
    ]
    assert (
        main(
            ["calibrate", str(bag), *arguments, "--out", str(tmp_path / "out")]
        )
        == 0
    )
    result = hec.load(tmp_path / "out")
    assert np.abs(pose_errors(result, drive.T_base_sensor))[:2].max() < 0.01
