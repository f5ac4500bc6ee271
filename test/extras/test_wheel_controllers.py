"""Parameters for ros2_controllers: their names, signs, and what a controller makes of them."""

import numpy as np
import pytest
import yaml

import hand_eye_calib as hec
from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.extras.vehicle import kinds
from hand_eye_calib.extras.vehicle.controllers import (
    controller_of,
    controller_text,
)
from hand_eye_calib.extras.vehicle.parameters import (
    VehicleParameter,
    VehicleParameters,
)
from hand_eye_calib.extras.vehicle.wheels import MODELS
from reproduction.machines import simulate_machine

# Parameters in the parameter files of ros2_controllers 4.42.1 (Jazzy) and 94e74de3 (master):
# diff_drive_controller_parameter.yaml, ackermann_steering_controller.yaml,
# tricycle_controller_parameter.yaml, mecanum_drive_controller.yaml. Lengths are in m.
NAMES = {
    "diff_drive_controller": {
        "wheel_separation",
        "wheel_radius",
        "wheel_separation_multiplier",
        "left_wheel_radius_multiplier",
        "right_wheel_radius_multiplier",
    },
    "ackermann_steering_controller": {
        "steering_track_width",
        "traction_track_width",
        "wheelbase",
        "traction_wheels_radius",
    },
    "tricycle_controller": {"wheelbase", "wheel_radius"},
    "mecanum_drive_controller": {
        "kinematics.wheels_radius",
        "kinematics.sum_of_robot_center_projection_on_X_Y_axis",
    },
}
CONTROLLER = {
    "wheels": "diff_drive_controller",
    "wheel_odometry": "diff_drive_controller",
    "steering": "ackermann_steering_controller",
    "tricycle": "tricycle_controller",
    "omni": "mecanum_drive_controller",
}


def wheels_of(measures, values, **nominal):
    parameters = map(
        VehicleParameter, MODELS[measures].names, values, [0.001] * 3
    )
    return VehicleParameters(tuple(parameters), 0.0, measures, **nominal)


@pytest.mark.parametrize(
    "nominal", [{}, {"nominal_radius_m": 0.1, "nominal_separation_m": 0.5}]
)
@pytest.mark.parametrize("measures", CONTROLLER)
def test_parameters_have_the_names_of_the_controller(measures, nominal):
    wheels = wheels_of(measures, [0.1, 0.1, 0.5], **nominal)
    text = controller_text(wheels, "USE")
    document = yaml.safe_load(text) or {}
    for name, node in document.items():
        assert name == CONTROLLER[measures]
        assert set(node["ros__parameters"]) <= NAMES[name]
    assert f"Parameters of {CONTROLLER[measures]}" in text


def driven(forward, turns):
    """Positions (N, 2) and headings (N,) after arcs, as the controllers integrate them."""
    headings = np.cumsum(turns)
    middle = headings - turns / 2
    places = np.cumsum(forward * np.exp(1j * middle))
    return np.column_stack([places.real, places.imag, headings])


def diff_drive(parameters, rates, seconds):
    left_m = (
        parameters["left_wheel_radius_multiplier"] * parameters["wheel_radius"]
    )
    right_m = (
        parameters["right_wheel_radius_multiplier"] * parameters["wheel_radius"]
    )
    track_m = (
        parameters["wheel_separation_multiplier"]
        * parameters["wheel_separation"]
    )
    left, right = rates.T * seconds * [[left_m], [right_m]]
    return driven((left + right) / 2, (right - left) / track_m)


def ackermann(parameters, rates, seconds):
    wheel_rates, angles = rates.T
    forward = wheel_rates * parameters["traction_wheels_radius"] * seconds
    turns = forward * np.tan(angles) / parameters["wheelbase"]
    return driven(forward, turns)


def tricycle(parameters, rates, seconds):
    wheel_rates, angles = rates.T
    rolled = wheel_rates * parameters["wheel_radius"] * seconds
    forward = rolled * np.cos(angles)
    turns = rolled * np.sin(angles) / parameters["wheelbase"]
    return driven(forward, turns)


# Equations of the controller, and its parameters by the drawing. The wheels of the machines are
# some 2 % and their track or wheelbase 3 % off; the steering angle has an offset of 1 deg.
DRAWINGS = {
    "wheels": (
        diff_drive,
        {
            "wheel_radius": 0.1,
            "wheel_separation": 0.5,
            "left_wheel_radius_multiplier": 1.0,
            "right_wheel_radius_multiplier": 1.0,
            "wheel_separation_multiplier": 1.0,
        },
    ),
    "steering": (ackermann, {"traction_wheels_radius": 0.3, "wheelbase": 1.2}),
    "tricycle": (tricycle, {"wheel_radius": 0.3, "wheelbase": 1.2}),
}


def exact_wheels(measures, parameters, speed, yaw_rate):
    """What wheels with these parameters measure without noise or slip, (N, 2)."""
    first, second, last = parameters
    if measures == "wheels":
        half_turn = yaw_rate * last / 2
        return np.column_stack(
            [(speed - half_turn) / first, (speed + half_turn) / second]
        )
    angle = np.arctan2(second * yaw_rate, speed)
    rolled = (
        np.hypot(speed, second * yaw_rate) if measures == "tricycle" else speed
    )
    # The speeds of these machines are in m/s: turn them to rates of wheels of 0.3 m.
    return np.column_stack([rolled / first / 0.3, angle + last])


@pytest.mark.parametrize("measures", DRAWINGS)
def test_a_controller_with_these_parameters_drives_the_true_path(
    tmp_path, measures
):
    simulated, drawing = DRAWINGS[measures]
    drive = simulate_machine(23, measures, duration_s=120.0)
    unit = 1.0 if measures == "wheels" else np.array([1.0 / 0.3, 1.0])
    wheels = hec.wheel_trajectory(
        drive.stamps_ns, drive.values * unit, measures
    )
    result = hec.calibrate_vehicle(drive.sensor, wheels)
    hec.save(result, tmp_path)
    (node,) = yaml.safe_load(
        (tmp_path / "controller_parameters.yaml").read_text()
    ).values()
    times_s = np.arange(0.0, 120.0, 0.02)
    speed = 0.8 + 0.2 * np.sin(times_s / 5.0)
    yaw_rate = 0.4 * np.sin(times_s / 3.0) + 0.05
    rates = exact_wheels(measures, drive.parameters, speed, yaw_rate)
    # The driver subtracts the offset of the steering angle.
    offset = (
        result.wheels["steering_offset"].value if measures != "wheels" else 0.0
    )
    truth = driven(speed * 0.02, yaw_rate * 0.02)
    by_drawing = simulated(drawing, rates, 0.02)
    calibrated = simulated(node["ros__parameters"], rates - [0.0, offset], 0.02)
    errors = [
        np.abs(path - truth).max(axis=0) for path in (by_drawing, calibrated)
    ]
    position_errors_m = [max(error[:2]) for error in errors]
    heading_errors = [error[2] for error in errors]
    assert position_errors_m[0] > 2.0  # on a path of a hundred metres
    assert position_errors_m[1] < 0.1 * position_errors_m[0]
    assert heading_errors[1] < 0.1 * heading_errors[0]


def test_a_bend_of_the_odometry_becomes_a_multiplier_of_each_wheel():
    # Left radius 2 % too small, right radius 2 % too large, and a track of 0.5 m.
    left, right, track = 0.098, 0.102, 0.5
    odometry = (0.1, 0.5)  # nominal radius and track, m
    curvature = 2.0 * (right - left) / ((right + left) * track)
    wheels = wheels_of(
        "wheel_odometry", [1.0, 1.0, curvature], nominal_separation_m=track
    )
    values = controller_of(wheels).values
    nominal = {"wheel_radius": odometry[0], "wheel_separation": odometry[1]}
    rates = np.array([[3.0, 5.0], [4.0, 4.0], [5.0, -5.0]])
    truth = {
        "left_wheel_radius_multiplier": left / odometry[0],
        "right_wheel_radius_multiplier": right / odometry[0],
        "wheel_separation_multiplier": 1.0,
    }
    expected = diff_drive(nominal | truth, rates, 0.1)
    assert diff_drive(nominal | values, rates, 0.1) == pytest.approx(
        expected, abs=1e-9
    )
    # Without the track, the file states what is missing.
    text = controller_text(
        wheels_of("wheel_odometry", [1.0, 1.0, curvature]), "USE"
    )
    assert "--nominal-separation" in text


def test_speeds_in_metres_keep_the_radius_of_the_user():
    text = controller_text(wheels_of("wheels", [1.02, 0.98, 0.5]), "USE")
    (node,) = yaml.safe_load(text).values()
    assert "wheel_radius" not in node["ros__parameters"]
    assert "keep the value" in text
    named = wheels_of("wheels", [1.02, 0.98, 0.5], nominal_radius_m=1.0)
    assert controller_of(named).values["wheel_radius"] == 1.0


def test_a_useless_result_has_no_parameters(tmp_path):
    drive = simulate_machine(23, course="circle", duration_s=90.0)
    hec.save(hec.calibrate_vehicle(drive.sensor, drive.wheels), tmp_path)
    assert not (tmp_path / "controller_parameters.yaml").exists()


# ---- the size of the wheels

DRIVE = simulate_machine(29, duration_s=90.0)


def result_of(factor=1.0, **options):
    wheels = hec.wheel_trajectory(
        DRIVE.stamps_ns, DRIVE.values * factor, "wheels"
    )
    return hec.calibrate_vehicle(DRIVE.sensor, wheels, **options)


def test_the_radius_is_in_the_headline():
    result = result_of(nominal_radius=0.1)
    assert (
        f"wheel radius {np.mean(DRIVE.parameters[:2]):.3f}" in result.headline
    )
    assert not {"unusual_radius", "radius_not_nominal"} & {
        item.code for item in result.findings
    }


def test_revolutions_per_minute_are_doubted():
    result = result_of(30.0 / np.pi)
    assert [item.code for item in result.findings] == ["unusual_radius"]
    assert result.verdict.value == "USE WITH CARE"
    confirmed = result_of(30.0 / np.pi, nominal_radius=0.0105)
    assert not confirmed.findings


@pytest.mark.parametrize(
    ("radius", "separation", "is_doubted"),
    [
        (0.033, 0.287, False),
        (0.3 * np.pi / 30.0, 1.0, True),
        (0.1 * 2 * np.pi, 0.5, True),
    ],
    ids=["TurtleBot", "large wheel in rpm", "small wheel in revolutions"],
)
def test_a_radius_is_judged_beside_the_track(radius, separation, is_doubted):
    findings = kinds._check_size(
        wheels_of("wheels", [radius, radius, separation])
    )
    assert [item.code for item in findings] == ["unusual_radius"] * is_doubted


@pytest.mark.parametrize("measures", ["wheel_odometry", "omni"])
@pytest.mark.parametrize(
    ("multiplier", "is_doubted"), [(1.05, False), (0.8, True)]
)
def test_odometry_is_compared_with_the_nominal_radius(
    measures, multiplier, is_doubted
):
    wheels = wheels_of(measures, [multiplier, 1.0, 1.0], nominal_radius_m=0.1)
    findings = kinds._check_size(wheels)
    assert [item.code for item in findings] == [
        "radius_not_nominal"
    ] * is_doubted


@pytest.mark.parametrize(
    ("factor", "unit"), [(30.0 / np.pi, "rpm"), (0.5, "gear ratio")]
)
def test_a_radius_that_is_not_nominal_is_doubted(factor, unit):
    result = result_of(factor, nominal_radius=0.1)
    (doubt,) = result.findings
    assert doubt.code == "radius_not_nominal"
    assert unit in doubt.cause
    assert result.verdict.value == "USE WITH CARE"


def test_odometry_in_another_unit_is_doubted():
    left, right = 0.1 * DRIVE.values.T
    nominal = np.column_stack([(left + right) / 2.0, (right - left) / 0.5]) * [
        1e-3,
        1.0,
    ]
    odometry = hec.wheel_trajectory(DRIVE.stamps_ns, nominal, "wheel_odometry")
    result = hec.calibrate_vehicle(DRIVE.sensor, odometry)
    assert [item.code for item in result.findings] == ["unusual_multiplier"]


@pytest.mark.parametrize("option", ["nominal_radius", "nominal_separation"])
def test_sizes_of_wheels_need_wheel_data(option):
    with pytest.raises(ConfigError, match="needs parent_measures wheels"):
        hec.calibrate(
            DRIVE.sensor,
            hec.Trajectory(DRIVE.sensor.stamps_ns, DRIVE.sensor.poses, "b"),
            **{option: 0.1},
        )
