"""A sensor in the frame of its vehicle, on simulated machines."""

from types import SimpleNamespace

import numpy as np
import pytest
from findings import codes_of
from vehicle_making import machine, pose_errors

import hand_eye_calib as hec
from hand_eye_calib.core.base.blocks import Blocks
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import (
    ConfigError,
    InputError,
    NotEnoughDataError,
)
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.vehicle import solving
from reproduction.machines import simulate_machine

# Half of what three minutes of figures of eight reach by far: x, y (m), rotations (rad).
POSE_TOLERANCES = [
    0.01,
    0.01,
    np.radians(0.15),
    np.radians(0.15),
    np.radians(0.1),
]
# Share of each parameter, rad of a steering offset.
PARAMETER_TOLERANCE = {
    "wheels": 0.004,
    "steering": 0.002,
    "tricycle": 0.002,
    "omni": 0.005,
}


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
    values = np.array(
        [parameter.value for parameter in result.wheels.parameters]
    )
    sizes = np.array(
        [
            1.0 if value == drive.parameters[2] else value
            for value in drive.parameters
        ]
    )
    assert (
        np.abs((values - drive.parameters) / sizes).max()
        < PARAMETER_TOLERANCE[measures]
    )


def test_without_noise_the_answer_is_exact():
    drive = machine("omni", noise=0.0)
    result = hec.calibrate_vehicle(
        drive.sensor, drive.wheels, child_kind="exact"
    )
    assert np.abs(pose_errors(result, drive.T_base_sensor)).max() < 1e-3


def test_without_wheels_y_is_out_of_reach():
    drive = machine()
    result = hec.calibrate_vehicle(drive.sensor)
    assert result.out_of_reach == ("y", "z")
    assert result.wheels is None
    assert np.abs(pose_errors(result, drive.T_base_sensor))[[0, 4]].max() < 0.01


def test_a_prior_fills_what_is_out_of_reach():
    drive = machine()
    result = hec.calibrate_vehicle(
        drive.sensor, drive.wheels, prior={"z": (0.8, 0.01)}
    )
    assert result.out_of_reach == ()
    assert result.translation[2] == pytest.approx(0.8, abs=0.02)


@pytest.mark.parametrize("course", ["straight", "circle", "bend"])
@pytest.mark.parametrize("model", ["wheels", "omni", "tricycle", ""])
def test_a_drive_of_one_curve_is_refused(course, model):
    drive = machine(model or "wheels", course)
    result = hec.calibrate_vehicle(
        drive.sensor, drive.wheels if model else None
    )
    assert result.verdict.value == "DO NOT USE"
    assert "x" in result.headline or "yaw" in result.headline
    assert [found.code for found in result.findings] == ["one_motion"]
    assert result.wheels is None
    assert np.isinf(result.sigmas[[0, 1, 5]]).all()


def test_curves_to_one_side_make_roll_uncertain():
    drive = machine(course="left")
    result = hec.calibrate_vehicle(
        drive.sensor, drive.wheels, child_kind="exact"
    )
    errors = np.abs(pose_errors(result, drive.T_base_sensor))
    assert errors[2] > np.radians(0.1)  # the body leans outwards
    assert (errors < 3.3 * result.sigmas[[0, 1, 3, 4, 5]]).all()


@pytest.mark.parametrize("model", [*PARAMETER_TOLERANCE, ""])
def test_spinning_on_the_spot_is_refused(model):
    drive = machine(model or "wheels", "spin")
    result = hec.calibrate_vehicle(
        drive.sensor, drive.wheels if model else None
    )
    assert result.verdict.value == "DO NOT USE"
    assert [found.code for found in result.findings] == ["one_motion"]


@pytest.mark.parametrize("course", ["eights", "wide"])
@pytest.mark.parametrize(
    ("model", "wrong"), [("steering", "tricycle"), ("tricycle", "steering")]
)
def test_a_speed_of_the_other_wheel_is_refused(model, wrong, course):
    drive = machine(model, course)
    result = hec.calibrate_vehicle(
        drive.sensor, drive.wheels, parent_measures=wrong
    )
    assert result.verdict.value == "DO NOT USE"
    assert [found.code for found in result.findings] == [f"speed_of_{model}"]


@pytest.mark.parametrize(
    "change", [lambda values: values[:, ::-1], lambda values: -values]
)
def test_wheels_that_turn_the_other_way_need_care(change):
    drive = machine()
    wheels = hec.wheel_trajectory(
        drive.stamps_ns, change(drive.values), "wheels"
    )
    result = hec.calibrate_vehicle(drive.sensor, wheels)
    assert [found.code for found in result.findings] == ["upside_down"]
    assert result.verdict.value == "USE WITH CARE"
    confirmed = hec.calibrate_vehicle(
        drive.sensor,
        wheels,
        prior={"roll": np.radians([result.rpy_deg[0], 10.0])},
    )
    assert not confirmed.findings


def test_much_slip_needs_care():
    drive = simulate_machine(11, duration_s=120.0, slip=2.0)
    result = hec.calibrate_vehicle(drive.sensor, drive.wheels)
    assert result.verdict.value == "USE WITH CARE"
    assert any(
        "the wheels or the vehicle slip" in reason.sentence
        for reason in result.reasons
    )
    assert np.abs(pose_errors(result, drive.T_base_sensor))[:2].max() < 0.01


def test_an_articulated_machine_is_no_car():
    drive = machine("articulated")
    result = hec.calibrate_vehicle(drive.sensor, drive.wheels)
    assert "bends in its middle" in result.findings[0].cause
    assert [found.code for found in result.findings] == ["unrelated"]
    assert result.verdict.value != "USE"


def test_wheels_that_do_not_determine_the_clock_offset_are_refused():
    drive = simulate_machine(391507204, "articulated", "eights")

    result = hec.calibrate_vehicle(
        drive.sensor, drive.wheels, child_kind="exact"
    )

    assert result.verdict is hec.Verdict.DO_NOT_USE
    assert codes_of(result.findings) == ["unrelated"]


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
    early_sensor = drive.sensor.shifted(-3.0)

    result = hec.calibrate_vehicle(early_sensor, drive.wheels)

    offset_s = 3.0 + drive.clock_s
    assert result.time_offset_s == pytest.approx(offset_s, abs=0.008)
    errors = np.abs(pose_errors(result, drive.T_base_sensor))
    assert errors[:2].max() < 0.01


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
    nominal = np.column_stack(
        [0.1 * (left + right) / 2.0, 0.1 * (right - left) / 0.5]
    )
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
def test_wheel_data_of_another_shape_are_refused(
    measures, n_columns, error, match
):
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
    stamps_ns = np.arange(3) * 20_000_000
    in_mm_s = [[0.0, 2000.0]] * 3
    with pytest.raises(InputError, match=r"in rad/s or m/s"):
        hec.wheel_trajectory(stamps_ns, in_mm_s, "wheels")


def test_wheels_need_increasing_stamps():
    equal_stamps_ns = np.zeros(3, dtype=np.int64)
    speeds = np.ones((3, 2))
    with pytest.raises(InputError, match="increase"):
        hec.wheel_trajectory(equal_stamps_ns, speeds, "wheels")


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
            hec.calibrate_vehicle(
                drive.sensor, drive.wheels, **options
            ).to_dict()
        )
    except NotEnoughDataError as error:
        return str(error)


def test_every_option_is_in_a_table():
    options = set()
    for name in CalibratorConfig().to_options():
        if "prior." not in name:
            options.add(name.replace(".", "_"))
    in_tables = {*OBEYED, *REFUSED} - {"prior"}
    assert options == in_tables | {"parent_measures"}


@pytest.mark.parametrize("option", OBEYED)
def test_an_option_is_obeyed(option):
    with_option = document_with(**{option: OBEYED[option]})
    without = document_with()
    assert with_option != without


@pytest.mark.parametrize("option", REFUSED)
def test_an_option_is_refused(option):
    with pytest.raises(ConfigError):
        document_with(**{option: REFUSED[option]})


# ------------------------------------------------------------------ ramps


@pytest.mark.parametrize(
    ("period", "is_counted"),
    [(28.5, True), (4.0, False)],
    ids=["rhythm of the curves", "another rhythm"],
)
def test_ramps_in_the_rhythm_of_the_curves_widen_roll(period, is_counted):
    angles = 2 * np.pi * np.arange(360)
    motions = np.zeros((360, 6))
    motions[:, 5] = 0.3 * np.sin(angles / 28.0)
    residuals = np.zeros((360, 6))
    residuals[:, 4] = 0.01 * np.sin(angles / period)
    drive = SimpleNamespace(measured=lambda _: motions, components=range(6))
    fit = SimpleNamespace(residuals=residuals, T_base_sensor=np.eye(4))

    variance = solving._variance_of_ramps(drive, fit)

    # Without a phase in common, the regression of equal rhythms is 1/30 over the root of 2.
    expected = 0.0236 if is_counted else 0.0
    assert np.sqrt(variance) == pytest.approx(expected, abs=0.006)


@pytest.mark.parametrize("course", ["one turn", "curves"])
def test_the_jackknife_has_the_spread_of_noise_of_shared_poses(course):
    windows = np.arange(360)
    turns = np.sin(2 * np.pi * windows / 28.0)
    column = turns if course == "curves" else np.ones(360)
    # A body that leans outwards makes errors that change sign with the curve.
    leaning = 0.5 * turns**3 * np.sign(turns)
    estimates = []
    variances = []
    for seed in range(40):
        noise = np.diff(np.random.default_rng(seed).standard_normal(361))
        values = noise + leaning * (course == "curves")
        rows = np.stack([column, values], axis=-1)[:, None]
        table = Blocks.of_rows(rows, 360)
        estimates.append(table.solve([0])[0])
        variances.append(
            solving._tapered_jackknife(table, np.zeros((2, 2)))[0, 0]
        )
    sigma = np.sqrt(np.mean(variances))
    assert 0.9 < sigma / np.std(estimates) < 2.0


def test_an_unknown_y_is_no_lateral_acceleration():
    turns = 0.3 * np.sin(2 * np.pi * np.arange(360) / 28.0)
    motions = np.zeros((360, 6))
    motions[:, 0] = 0.4 - 0.5 * turns
    motions[:, 5] = turns
    drive = SimpleNamespace(
        measured=lambda _: motions, ends_s=np.array([[0.0], [1.0]]), model=None
    )
    assert solving._lateral_acceleration(drive, np.eye(4)) == pytest.approx(
        0, abs=1e-3
    )
    motions[:, 5] += 0.3
    motions[:, 0] = 0.4
    assert solving._lateral_acceleration(drive, np.eye(4)) > 0.1


def test_mecanum_wheels_turn_as_the_machine_moves():
    still = simulate_machine(4, "mecanum", duration_s=30.0, noise=0.0)
    parameters = np.array(still.parameters)
    forward, left, turn = parameters[:, None] * still.values.T
    fastest_left = np.abs(left).max()
    fastest_turn = np.abs(turn).max()
    assert forward == pytest.approx(0.8, abs=0.3)
    assert fastest_left == pytest.approx(0.4, abs=0.01)
    assert fastest_turn == pytest.approx(0.9 * 0.9, abs=0.2)
