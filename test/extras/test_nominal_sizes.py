"""Nominal sizes of wheels from a URDF or from the parameters of a controller."""

import pytest

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.extras.vehicle.nominal import nominal_sizes
from hand_eye_calib.formats.results import load_result
from hand_eye_calib.offline.cli.main import main

SAMPLES = ("sample:robot_wheels.csv", "sample:robot_lidar.tum")


def wheel(side, y_m, radius_m, name="wheel_{side}_joint"):
    """Return link and joint of a wheel whose axis is turned into y, as in the TurtleBot 3."""
    joint = name.format(side=side)
    return f"""
      <link name="{joint}_link">
        <visual><geometry><mesh filename="tire.stl"/></geometry></visual>
        <collision><geometry>
          <cylinder length="0.018" radius="{radius_m}"/>
        </geometry></collision>
      </link>
      <joint name="{joint}" type="continuous">
        <parent link="base_link"/><child link="{joint}_link"/>
        <origin xyz="0.1 {y_m} 0.02" rpy="-1.57079632679 0 0"/>
        <axis xyz="0 0 1"/>
      </joint>"""


def robot(folder, *parts):
    path = folder / "robot.urdf"
    base = """
      <link name="base_footprint"/><link name="base_link"/>
      <joint name="base_joint" type="fixed">
        <parent link="base_footprint"/><child link="base_link"/>
        <origin xyz="0.3 0.2 0.01" rpy="0 0 1"/>
      </joint>"""
    path.write_text(f"<robot name='r'>{base}{''.join(parts)}</robot>")
    return path


def test_a_urdf_has_radius_and_separation(tmp_path):
    caster = wheel("left", 0.05, 0.01, "caster_wheel_{side}_joint")
    path = robot(
        tmp_path,
        wheel("left", 0.144, 0.033),
        wheel("right", -0.143, 0.033),
        caster,
    )
    assert nominal_sizes(path) == pytest.approx(
        {"nominal_radius": 0.033, "nominal_separation": 0.287}
    )


def test_wheels_of_different_radii_are_refused(tmp_path):
    path = robot(
        tmp_path,
        wheel("left", 0.2, 0.1, "front_{side}_wheel"),
        wheel("right", -0.2, 0.1, "front_{side}_wheel"),
        wheel("left", 0.2, 0.3, "rear_{side}_wheel"),
        wheel("right", -0.2, 0.3, "rear_{side}_wheel"),
    )
    with pytest.raises(
        InputError, match=r"a radius of 0\.1 and 0\.3 m; choose one with"
    ):
        nominal_sizes(path)


def test_a_robot_without_wheels_and_macros_are_refused(tmp_path):
    with pytest.raises(InputError, match="no size of wheels; expected cont"):
        nominal_sizes(robot(tmp_path))
    path = tmp_path / "robot.urdf.xacro"
    path.write_text("<robot><xacro:include filename='a'/></robot>")
    with pytest.raises(InputError, match="xacro macros"):
        nominal_sizes(path)


@pytest.mark.parametrize(
    ("controller", "sizes"),
    [
        (
            "{wheel_radius: 0.1, wheel_separation: 0.5, "
            "wheel_separation_multiplier: 1.02}",
            {"nominal_radius": 0.1, "nominal_separation": 0.5},
        ),
        (
            "{traction_wheels_radius: 0.25, traction_track_width: 1.2, "
            "wheelbase: 2.5}",
            {"nominal_radius": 0.25, "nominal_separation": 1.2},
        ),
        (
            "{kinematics: {wheels_radius: 0.076}}",
            {"nominal_radius": 0.076},
        ),
        ("{wheel_radius: 0, wheel_separation: 1}", {"nominal_separation": 1.0}),
    ],
)
def test_parameters_of_a_controller_have_sizes(tmp_path, controller, sizes):
    path = tmp_path / "controllers.yaml"
    path.write_text(
        "controller_manager: {ros__parameters: {update_rate: 50}}\n"
        f"/base/controller: {{ros__parameters: {controller}}}\n"
    )
    assert nominal_sizes(path) == sizes


def test_a_file_without_sizes_is_refused(tmp_path):
    path = tmp_path / "controllers.yaml"
    path.write_text("a: {ros__parameters: {rate: 1, wheel_radius: true}}\n")
    with pytest.raises(
        InputError, match="no size of wheels; expected wheel_radius"
    ):
        nominal_sizes(path)


def test_the_command_uses_the_sizes_of_a_file(tmp_path):
    path = tmp_path / "controllers.yaml"
    path.write_text("a: {wheel_radius: 0.2, wheel_separation: 0.51}\n")
    out = tmp_path / "result"
    main(["calibrate", *SAMPLES, "--nominal", str(path), "--out", str(out)])
    result = load_result(out)
    assert result.wheels.nominal_separation_m == 0.51
    assert "radius_not_nominal" in {found.code for found in result.findings}


def test_an_option_takes_precedence_over_the_file(tmp_path):
    path = tmp_path / "controllers.yaml"
    path.write_text("a: {wheel_radius: 0.2, wheel_separation: 0.51}\n")
    out = tmp_path / "result"
    options = ["--nominal-radius", "0.1", "--nominal", str(path)]
    main(["calibrate", *SAMPLES, *options, "--out", str(out)])
    wheels = load_result(out).wheels
    assert (wheels.nominal_radius_m, wheels.nominal_separation_m) == (0.1, 0.51)


def test_an_unreadable_file_is_one_line(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["calibrate", *SAMPLES, "--nominal", str(tmp_path / "no.yaml")])
    last_line = capsys.readouterr().err.splitlines()[-1]
    assert "--nominal" in last_line
    assert "no.yaml" in last_line
