"""Write the parameters of wheels for the controllers of ros2_controllers.

Names and equations of the parameters are those of ros2_controllers 4.42.1 (Jazzy) and of its master
branch of August 2026 (94e74de3):

- diff_drive_controller: forward = (R_l l + R_r r) / 2, turn = (R_r r - R_l l) / B, for rates l and
  r of the wheels, with R_l = left_wheel_radius_multiplier * wheel_radius, R_r likewise, and
  B = wheel_separation_multiplier * wheel_separation;
- ackermann_steering_controller: forward = traction_wheels_radius * rate,
  turn = forward tan(angle) / wheelbase; positive angles steer to the left;
- tricycle_controller: forward = wheel_radius * rate * cos(angle),
  turn = wheel_radius * rate * sin(angle) / wheelbase;
- mecanum_drive_controller: forward = R S / 4, turn = R D / (4 L), for a sum S and a difference D of
  the rates, with R = kinematics.wheels_radius and
  L = kinematics.sum_of_robot_center_projection_on_X_Y_axis.
"""

from collections.abc import Callable
from typing import NamedTuple

import yaml

from hand_eye_calib.core.base.text import fixed
from hand_eye_calib.core.base.version import version_of
from hand_eye_calib.extras.vehicle.parameters import VehicleParameters

# Number of decimals in a parameter.
_DECIMALS = 6


class Controller(NamedTuple):
    """Parameters of a controller: those with a value, and remarks about the others."""

    name: str
    values: dict[str, float]
    remarks: list[str]


def _of_two_wheels(wheels: VehicleParameters) -> Controller:
    """Return the parameters for the rates of two driven wheels."""
    left, right, separation = (
        parameter.value for parameter in wheels.parameters
    )
    values = {}
    remarks = []
    if wheels.is_factor:
        nominal_radius = 1.0
        remarks.append(
            "wheel_radius: keep the value with which the speeds in m/s were computed"
        )
    else:
        nominal_radius = wheels.nominal_radius_m or wheels.radius
        values["wheel_radius"] = nominal_radius
    nominal_separation = wheels.nominal_separation_m or separation
    values |= {
        "wheel_separation": nominal_separation,
        "wheel_separation_multiplier": separation / nominal_separation,
        "left_wheel_radius_multiplier": left / nominal_radius,
        "right_wheel_radius_multiplier": right / nominal_radius,
    }
    return Controller("diff_drive_controller", values, remarks)


def _of_odometry(wheels: VehicleParameters) -> Controller:
    """Return the parameters for the odometry of two wheels.

    A curvature c is a difference of both radii: c = 2 (R_r - R_l) / ((R_r + R_l) B).
    """
    radius, separation, curvature = (
        parameter.value for parameter in wheels.parameters
    )
    half = 0.5 * curvature * radius * separation * wheels.nominal_separation_m
    remarks = [
        "Multiply the values with which the odometry was recorded by these factors"
    ]
    if not wheels.nominal_separation_m:
        remarks.append(
            "The radii of the wheels differ: at equal speeds of both wheels, the path has a "
            f"curvature of {fixed(curvature, _DECIMALS)} 1/m; for a multiplier of each wheel, "
            "calibrate again with --nominal-separation"
        )
    values = {
        "wheel_separation_multiplier": separation,
        "left_wheel_radius_multiplier": radius - half,
        "right_wheel_radius_multiplier": radius + half,
    }
    return Controller("diff_drive_controller", values, remarks)


def _of_steering(wheels: VehicleParameters) -> Controller:
    """Return the parameters for the speed of the fixed axle and a steering angle."""
    return _steered(
        "ackermann_steering_controller", "traction_wheels_radius", wheels
    )


def _of_tricycle(wheels: VehicleParameters) -> Controller:
    """Return the parameters for the speed and the angle of the steered wheel."""
    return _steered("tricycle_controller", "wheel_radius", wheels)


def _steered(
    name: str, radius_name: str, wheels: VehicleParameters
) -> Controller:
    """Return the parameters of a controller with a steering angle."""
    radius, wheelbase, offset = (
        parameter.value for parameter in wheels.parameters
    )
    values = {"wheelbase": wheelbase}
    remarks = [
        f"The measured steering angle is {fixed(offset, _DECIMALS)} rad too large. The controller "
        "has no parameter for this: subtract it in the driver"
    ]
    if wheels.is_factor:
        remarks.append(
            f"{radius_name}: multiply yours by {fixed(radius, _DECIMALS)}"
        )
    else:
        values[radius_name] = radius
    return Controller(name, values, remarks)


def _of_omni(wheels: VehicleParameters) -> Controller:
    """Return the parameters of an omnidirectional vehicle, relative to those of its odometry."""
    forward, left, turn = (parameter.value for parameter in wheels.parameters)
    length = "kinematics.sum_of_robot_center_projection_on_X_Y_axis"
    values = {}
    remarks = [
        f"{length}: multiply yours by {fixed(forward / turn, _DECIMALS)}"
    ]
    if wheels.nominal_radius_m:
        values["kinematics.wheels_radius"] = forward * wheels.nominal_radius_m
    else:
        remarks.append(
            f"kinematics.wheels_radius: multiply yours by {fixed(forward, _DECIMALS)}"
        )
    remarks.append(
        f"Sideways the wheels roll {fixed(left / forward, _DECIMALS)} times as far; the controller "
        "has no parameter for this"
    )
    return Controller("mecanum_drive_controller", values, remarks)


_CONTROLLERS: dict[str, Callable[[VehicleParameters], Controller]] = {
    "wheels": _of_two_wheels,
    "wheel_odometry": _of_odometry,
    "steering": _of_steering,
    "tricycle": _of_tricycle,
    "omni": _of_omni,
}


def controller_of(wheels: VehicleParameters) -> Controller | None:
    """Return the parameters for the controller of these wheels; None for an unknown kind."""
    make = _CONTROLLERS.get(wheels.measures)
    return make(wheels) if make else None


def controller_text(wheels: VehicleParameters, headline: str) -> str:
    """Return a parameter file of ROS 2; empty for an unknown kind of wheels.

    The name of the node is the type of the controller.
    """
    controller = controller_of(wheels)
    if controller is None:
        return ""
    lines = [
        f"Parameters of {controller.name} (ros2_controllers), by hand_eye_calib {version_of()}.",
        f"{headline}.",
        *controller.remarks,
    ]
    comments = "".join(f"# {line}\n" for line in lines)
    parameters = {
        name: round(value, _DECIMALS)
        for name, value in controller.values.items()
    }
    document = {controller.name: {"ros__parameters": parameters}}
    return comments + (
        yaml.safe_dump(document, sort_keys=False) if parameters else ""
    )
