"""A sensor in the frame of its vehicle, on simulated machines."""

import json
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from bag_making import JAZZY
from rosbags import rosbag2

import hand_eye_calib as hec
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError, InputError, NotEnoughDataError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.vehicle import solving
from hand_eye_calib.extras.vehicle.joints import middle_angle
from hand_eye_calib.extras.vehicle.live import live_reading
from hand_eye_calib.formats.bags.writer import write_streams
from hand_eye_calib.offline.cli.main import main
from reproduction.machines import simulate_machine

# Half of what three minutes of figures of eight reach by far: x, y (m), rotations (rad).
POSE_TOLERANCES = [0.01, 0.01, np.radians(0.15), np.radians(0.15), np.radians(0.1)]
# Share of each parameter, rad of a steering offset.
PARAMETER_TOLERANCE = {
    "wheels": 0.004,
    "steering": 0.002,
    "tricycle": 0.002,
    "omni": 0.005,
}


@cache
def machine(measures="wheels", course="eights", duration_s=120.0, noise=1.0):
    return simulate_machine(11, measures, course, duration_s, noise)


def pose_errors(result, truth):
    """Errors of x, y (m) and of the rotations (rad) about the axes of the base."""
    turn = result.T_parent_child[:3, :3] @ truth[:3, :3].T
    return np.append((result.T_parent_child - truth)[:2, 3], se3.rotation_log(turn))


@pytest.mark.parametrize("measures", PARAMETER_TOLERANCE)
def test_pose_wheels_and_clock_of_a_machine(measures):
    drive = machine(measures)
    result = hec.calibrate_vehicle(drive.sensor, drive.wheels)
    assert result.verdict.value != "DO NOT USE"
    assert result.out_of_reach == ("z",)
    assert (result.parent_frame, result.child_frame) == ("base_link", "lidar")
    errors = np.abs(pose_errors(result, drive.T_base_sensor))
    assert (errors < POSE_TOLERANCES).all()
    assert (errors < 3.3 * result.sigmas[[0, 1, 3, 4, 5]]).all()
    assert result.time_offset_s == pytest.approx(drive.clock_s, abs=0.008)
    values = np.array([parameter.value for parameter in result.wheels.parameters])
    sizes = np.array(
        [1.0 if value == drive.parameters[2] else value for value in drive.parameters]
    )
    assert (
        np.abs((values - drive.parameters) / sizes).max()
        < PARAMETER_TOLERANCE[measures]
    )


def test_without_noise_the_answer_is_exact():
    drive = machine("omni", noise=0.0)
    result = hec.calibrate_vehicle(drive.sensor, drive.wheels, child_kind="exact")
    assert np.abs(pose_errors(result, drive.T_base_sensor)).max() < 1e-3


def test_without_wheels_y_is_out_of_reach():
    drive = machine()
    result = hec.calibrate_vehicle(drive.sensor)
    assert result.out_of_reach == ("y", "z")
    assert result.wheels is None
    assert np.abs(pose_errors(result, drive.T_base_sensor))[[0, 4]].max() < 0.01


def test_a_prior_fills_what_is_out_of_reach():
    drive = machine()
    result = hec.calibrate_vehicle(drive.sensor, drive.wheels, prior={"z": (0.8, 0.01)})
    assert result.out_of_reach == ()
    assert result.translation[2] == pytest.approx(0.8, abs=0.02)


@pytest.mark.parametrize("course", ["straight", "circle", "bend"])
@pytest.mark.parametrize("model", ["wheels", "omni", "tricycle", ""])
def test_a_drive_of_one_curve_is_refused(course, model):
    drive = machine(model or "wheels", course)
    result = hec.calibrate_vehicle(drive.sensor, drive.wheels if model else None)
    assert result.verdict.value == "DO NOT USE"
    assert "x" in result.headline or "yaw" in result.headline
    assert [found.code for found in result.findings] == ["one_motion"]
    assert result.wheels is None
    assert np.isinf(result.sigmas[[0, 1, 5]]).all()


def test_curves_to_one_side_make_roll_uncertain():
    drive = machine(course="left")
    result = hec.calibrate_vehicle(drive.sensor, drive.wheels, child_kind="exact")
    errors = np.abs(pose_errors(result, drive.T_base_sensor))
    assert errors[2] > np.radians(0.1)  # the body leans outwards
    assert (errors < 3.3 * result.sigmas[[0, 1, 3, 4, 5]]).all()


@pytest.mark.parametrize("model", [*PARAMETER_TOLERANCE, ""])
def test_spinning_on_the_spot_is_refused(model):
    drive = machine(model or "wheels", "spin")
    result = hec.calibrate_vehicle(drive.sensor, drive.wheels if model else None)
    assert result.verdict.value == "DO NOT USE"
    assert [found.code for found in result.findings] == ["one_motion"]


@pytest.mark.parametrize("course", ["eights", "wide"])
@pytest.mark.parametrize(
    ("model", "wrong"), [("steering", "tricycle"), ("tricycle", "steering")]
)
def test_a_speed_of_the_other_wheel_is_refused(model, wrong, course):
    drive = machine(model, course)
    result = hec.calibrate_vehicle(drive.sensor, drive.wheels, parent_measures=wrong)
    assert result.verdict.value == "DO NOT USE"
    assert [found.code for found in result.findings] == [f"speed_of_{model}"]


@pytest.mark.parametrize(
    "change", [lambda values: values[:, ::-1], lambda values: -values]
)
def test_wheels_that_turn_the_other_way_need_care(change):
    drive = machine()
    wheels = hec.wheel_trajectory(drive.stamps_ns, change(drive.values), "wheels")
    result = hec.calibrate_vehicle(drive.sensor, wheels)
    assert [found.code for found in result.findings] == ["upside_down"]
    assert result.verdict.value == "USE WITH CARE"
    confirmed = hec.calibrate_vehicle(
        drive.sensor, wheels, prior={"roll": np.radians([result.rpy_deg[0], 10.0])}
    )
    assert not confirmed.findings


def test_much_slip_needs_care():
    drive = simulate_machine(11, duration_s=120.0, slip=2.0)
    result = hec.calibrate_vehicle(drive.sensor, drive.wheels)
    assert result.verdict.value == "USE WITH CARE"
    assert any(
        "the wheels or the vehicle slip" in reason.sentence for reason in result.reasons
    )
    assert np.abs(pose_errors(result, drive.T_base_sensor))[:2].max() < 0.01


def test_an_articulated_machine_is_no_car():
    drive = machine("articulated")
    result = hec.calibrate_vehicle(drive.sensor, drive.wheels)
    assert "bends in its middle" in result.findings[0].cause
    assert [found.code for found in result.findings] == ["unrelated"]
    assert result.verdict.value != "USE"


def test_tracks_that_slip_in_curves_keep_the_pose():
    drive = machine("skid")
    result = hec.calibrate_vehicle(drive.sensor, drive.wheels)
    errors = np.abs(pose_errors(result, drive.T_base_sensor))
    assert (errors < POSE_TOLERANCES).all()
    assert result.wheels["wheel_separation"].value > 1.3 * drive.parameters[2]


def test_wheels_of_another_drive_are_doubted():
    # A clock offset makes two drives of figures of eight alike.
    drive = machine()
    reversed_values = drive.values[::-1]
    other = hec.wheel_trajectory(drive.stamps_ns, reversed_values, "wheels")
    result = hec.calibrate_vehicle(drive.sensor, other)
    assert [found.code for found in result.findings] == ["unrelated"]
    assert result.verdict.value != "USE"


def test_a_wheel_that_turns_backwards_is_refused():
    drive = machine()
    backwards = hec.wheel_trajectory(
        drive.stamps_ns, drive.values * [1.0, -1.0], "wheels"
    )
    result = hec.calibrate_vehicle(drive.sensor, backwards)
    assert [found.code for found in result.findings] == ["unrelated"]
    assert result.verdict.value == "DO NOT USE"


def test_a_mount_that_moved_is_a_warning():
    drive = machine()
    half = len(drive.sensor) // 2
    poses = drive.sensor.poses.copy()
    poses[half:] = poses[half:] @ se3.exp(np.array([0.1, 0.1, 0, 0, 0, 0.05]))
    result = hec.calibrate_vehicle(
        hec.Trajectory(drive.sensor.stamps_ns, poses), drive.wheels
    )
    assert result.verdict.value != "USE"


def test_clocks_that_differ_by_seconds():
    drive = machine()
    result = hec.calibrate_vehicle(drive.sensor.shifted(-3.0), drive.wheels)
    assert result.time_offset_s == pytest.approx(3.0 + drive.clock_s, abs=0.008)
    assert np.abs(pose_errors(result, drive.T_base_sensor))[:2].max() < 0.01


def test_two_dimensional_poses_have_no_roll_and_pitch():
    drive = machine("omni", noise=0.0)
    level = drive.T_base_sensor.copy()
    level[:3, :3] = se3.rotation_from_rpy([0.0, 0.0, 0.4])
    Ts_world_base = drive.sensor.poses @ se3.inverse(drive.T_base_sensor)
    sensor = hec.Trajectory(drive.sensor.stamps_ns, Ts_world_base @ level)
    result = hec.calibrate_vehicle(sensor, drive.wheels)
    assert result.out_of_reach == ("z", "roll", "pitch")
    assert result.translation[:2] == pytest.approx(level[:2, 3], abs=0.001)


def test_odometry_of_two_wheels_gets_multipliers():
    drive = machine()
    left, right = drive.values.T
    nominal = np.column_stack([0.1 * (left + right) / 2.0, 0.1 * (right - left) / 0.5])
    odometry = hec.wheel_trajectory(drive.stamps_ns, nominal, "wheel_odometry")
    result = hec.calibrate_vehicle(drive.sensor, odometry)
    radius = (drive.parameters[0] + drive.parameters[1]) / 2.0
    wheels = result.wheels
    assert wheels["wheel_radius_multiplier"].value == pytest.approx(
        radius / 0.1, rel=0.004
    )
    track = drive.parameters[2] / 0.5
    assert wheels["wheel_separation_multiplier"].value == pytest.approx(
        track, rel=0.006
    )


@pytest.mark.parametrize(
    ("measures", "n_columns", "error", "match"),
    [
        ("wheels", 3, InputError, r"wheels needs values of shape \(3, 2\)"),
        ("omni", 2, InputError, r"omni needs values of shape \(3, 3\)"),
        ("tracks", 2, ConfigError, "measures must be one of wheels, steering"),
    ],
)
def test_wheel_data_of_another_shape_are_refused(measures, n_columns, error, match):
    with pytest.raises(error, match=match):
        hec.wheel_trajectory(
            np.arange(3) * 20_000_000, np.ones((3, n_columns)), measures
        )


def test_wheels_as_child_are_answered_with_the_other_order():
    drive = machine()
    with pytest.raises(
        ConfigError, match="exchange the streams, the one with wheels first"
    ):
        hec.calibrate(drive.sensor, drive.wheels)


def test_too_short_a_drive_raises():
    drive = machine()
    with pytest.raises(NotEnoughDataError, match="figures of eight"):
        hec.calibrate_vehicle(drive.sensor[:300], drive.wheels)


def test_speeds_in_another_unit_are_refused():
    with pytest.raises(InputError, match=r"in rad/s or m/s"):
        hec.wheel_trajectory(np.arange(3) * 20_000_000, [[0.0, 2000.0]] * 3, "wheels")


def test_wheels_need_increasing_stamps():
    with pytest.raises(InputError, match="increase"):
        hec.wheel_trajectory(np.zeros(3, dtype=np.int64), np.ones((3, 2)), "wheels")


# ------------------------------------------------------------------ options

# A value of each option that is not the default, or None if another test sets it.
OBEYED = {
    "min_pairs": 10_000,
    "max_pairs": 700,
    "keyframe_min_translation": 1.0,
    "keyframe_min_rotation": 0.1,
    "keyframe_min_interval": 0.2,
    "max_gap": 0.01,
    "time_offset": 0.015,
    "child_kind": "exact",
    "child_invert": "poses",
    "child_quaternion": "wxyz",
    "target_translation": 1e-4,
    "target_rotation": 1e-5,
    "target_axes": "x=1mm",
    "nominal_radius": 0.11,
    "nominal_separation": 0.55,
    "parent_frame": "axle",
    "child_frame": "laser",
    "prior": {"x": (0.1, 0.01)},
}
REFUSED = {
    "method": "dnl",
    "reference": "B3",
    "backend": "ipopt",
    "threshold": 1e-5,
    "min_inlier_fraction": 0.999,
    "scale": 1.1,
    "parent_scale": 2.0,
    "parent_kind": "exact",
    "child_measures": "rotations",
    "parent_invert": "poses",
    "parent_quaternion": "wxyz",
}


def document_with(**options):
    drive = machine()
    try:
        return str(
            hec.calibrate_vehicle(drive.sensor, drive.wheels, **options).to_dict()
        )
    except NotEnoughDataError as error:
        return str(error)


def test_every_option_is_in_a_table():
    options = {name for name in CalibratorConfig().to_options() if "prior." not in name}
    names = {name.replace(".", "_") for name in options}
    assert names == ({*OBEYED, *REFUSED} - {"prior"}) | {"parent_measures"}


@pytest.mark.parametrize("option", OBEYED)
def test_an_option_is_obeyed(option):
    assert document_with(**{option: OBEYED[option]}) != document_with()


@pytest.mark.parametrize("option", REFUSED)
def test_an_option_is_refused(option):
    with pytest.raises(ConfigError):
        document_with(**{option: REFUSED[option]})


# ------------------------------------------------------------------ files and the command line

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
    assert of_files.T_parent_child == pytest.approx(of_arrays.T_parent_child, abs=1e-4)


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
    assert result.wheels["wheel_separation"].value == pytest.approx(0.5, rel=0.1)
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


def test_odometry_of_a_bag(tmp_path):
    drive = machine()
    left, right = drive.values.T
    nominal = np.column_stack([0.1 * (left + right) / 2.0, 0.1 * (right - left) / 0.5])
    odometry = hec.wheel_trajectory(drive.stamps_ns, nominal, "wheel_odometry")
    base = hec.Trajectory(odometry.stamps_ns, odometry.poses, "base_footprint", "odom")
    lidar = hec.Trajectory(drive.sensor.stamps_ns, drive.sensor.poses, "lidar", "map")
    bag = tmp_path / "bag"
    with rosbag2.Writer(
        bag, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP
    ) as writer:
        type_ = "nav_msgs/msg/Odometry"
        write_streams(
            writer, {"/odom": (base, type_), "/lidar": (lidar, type_)}, "mcap"
        )
    arguments = ["--parent-topic", "/odom", "--child-topic", "/lidar"]
    arguments += ["--parent-measures", "wheel_odometry", "--out", str(tmp_path / "out")]
    assert main(["calibrate", str(bag), *arguments]) == 0
    result = hec.load(tmp_path / "out")
    assert result.parent_frame == "base_footprint"
    assert np.abs(pose_errors(result, drive.T_base_sensor))[:2].max() < 0.01


def write_wheel_bag(path, type_, topic, messages, drive):
    """Write messages at the stamps of the wheels, and the odometry of the lidar."""
    lidar = hec.Trajectory(drive.sensor.stamps_ns, drive.sensor.poses, "lidar", "map")
    with rosbag2.Writer(
        path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP
    ) as writer:
        write_streams(writer, {"/lidar": (lidar, "nav_msgs/msg/Odometry")}, "mcap")
        connection = writer.add_connection(topic, type_, typestore=JAZZY)
        for stamp_ns, message in zip(drive.stamps_ns.tolist(), messages, strict=True):
            writer.write(connection, stamp_ns, JAZZY.serialize_cdr(message, type_))


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
    write_wheel_bag(bag, "sensor_msgs/msg/JointState", "/joint_states", messages, drive)
    arguments = ["--parent-topic", f"/joint_states{fields}", "--child-topic", "/lidar"]
    assert (
        main(["calibrate", str(bag), *arguments, "--out", str(tmp_path / "out")]) == 0
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
    write_wheel_bag(bag, "sensor_msgs/msg/JointState", "/joint_states", messages, drive)
    assert main(["calibrate", str(bag), "--parent-topic", "/joint_states"]) == 1
    assert "name the joints: /joint_states?LEFT,RIGHT" in capsys.readouterr().err


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
        angles = [float(np.arctan(tangent / (1.0 + side * tangent))) for side in sides]
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
    write_wheel_bag(bag, "sensor_msgs/msg/JointState", "/joint_states", messages, drive)
    arguments = ["--parent-topic", f"/joint_states{fields}", "--child-topic", "/lidar"]
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
    messages = car_states(drive, ["rear_left_wheel", "rear_right_wheel"], ["steer"])
    write_wheel_bag(bag, "sensor_msgs/msg/JointState", "/joint_states", messages, drive)
    arguments = ["--parent-topic", "/joint_states", "--child-topic", "/lidar"]
    assert main(["calibrate", str(bag), *arguments]) == 1
    assert (
        "has steering joints, steer: set --parent-measures to"
        in capsys.readouterr().err
    )


def test_angles_of_a_steered_axle():
    for angle in (-0.6, -0.1, -0.001, 0.0, 0.02, 0.3, 0.8):
        tangent = np.tan(angle)
        wheels = [np.arctan(tangent / (1.0 + side * tangent)) for side in (-0.3, 0.3)]
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
    assert main(["calibrate", str(bag), *arguments, "--parent-measures", "omni"]) == 1
    assert "it has no stamps, and is usually a command" in capsys.readouterr().err


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
    np.savetxt(path, rows, fmt="%.6f", delimiter=",", header=header, comments="")
    with pytest.warns(UserWarning, match="by its columns"):
        read = hec.read_trajectory(path)
    expected = hec.wheel_trajectory(stamps_ns, values * units, read.measures)
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
        messages = [*car_states(drive, ["rear_wheel"], ["left_steer", "right_steer"])]
    write_wheel_bag(tmp_path / "bag", type_, "/wheels", messages, drive)
    in_bag = hec.read_trajectory(tmp_path / "bag", topic="/wheels", measures=model)
    read = live_reading(type_, "/wheels", model)
    live = [read(bytes(JAZZY.serialize_cdr(message, type_))) for message in messages]
    assert [pose.stamp_ns for pose in live] == in_bag.stamps_ns.tolist()
    positions = np.array([pose.position for pose in live])
    assert positions == pytest.approx(in_bag.poses[:, :3, 3], abs=1e-8)


def test_twists_of_a_bag(tmp_path):
    drive = machine("omni")
    messages = [*twists(drive)]
    bag = tmp_path / "bag"
    write_wheel_bag(bag, "geometry_msgs/msg/TwistStamped", "/twist", messages, drive)
    arguments = [
        "--parent-topic",
        "/twist",
        "--child-topic",
        "/lidar",
        "--parent-measures",
        "omni",
    ]
    assert (
        main(["calibrate", str(bag), *arguments, "--out", str(tmp_path / "out")]) == 0
    )
    result = hec.load(tmp_path / "out")
    assert np.abs(pose_errors(result, drive.T_base_sensor))[:2].max() < 0.01


# ------------------------------------------------------------------ ramps


@pytest.mark.parametrize(
    ("period", "is_counted"),
    [(28.5, True), (4.0, False)],
    ids=["rhythm of the curves", "another rhythm"],
)
def test_ramps_in_the_rhythm_of_the_curves_widen_roll(period, is_counted):
    windows = np.arange(360)
    motions = np.zeros((360, 6))
    motions[:, 5] = 0.3 * np.sin(2 * np.pi * windows / 28.0)
    residuals = np.zeros((360, 6))
    residuals[:, 4] = 0.01 * np.sin(2 * np.pi * windows / period)
    drive = SimpleNamespace(measured=lambda _: motions, components=range(6))
    fit = SimpleNamespace(residuals=residuals, T_base_sensor=np.eye(4))
    sigma = np.sqrt(solving._variance_of_ramps(drive, fit))
    # Without a phase in common, the regression of equal rhythms is 1/30 over the root of 2.
    assert sigma == pytest.approx(is_counted * 0.0236, abs=0.006)


def test_mecanum_wheels_turn_as_the_machine_moves():
    still = simulate_machine(4, "mecanum", duration_s=30.0, noise=0.0)
    forward, left, turn = still.values.T * np.array(still.parameters)[:, None]
    assert forward == pytest.approx(0.8, abs=0.3)
    assert np.abs(left).max() == pytest.approx(0.4, abs=0.01)
    assert np.abs(turn).max() == pytest.approx(0.9 * 0.9, abs=0.2)
