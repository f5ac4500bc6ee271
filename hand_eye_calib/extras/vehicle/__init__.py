"""Calibration of a sensor in the frame of its vehicle, with the parameters of the wheels."""

from functools import partial
from typing import Any

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.registry import (
    BAG_READINGS,
    FILE_READERS,
    FINDING_WORDS,
    KINDS,
    KINDS_OF_OPTIONS,
    LIVE_READINGS,
    MEASURES,
    OUT_OF_REACH,
    PUBLIC_NAMES,
    RESULT_PARTS,
    ROUTES,
    Measure,
    Route,
)

# Types of live messages with velocities or wheels.
_LIVE_TYPES = (
    "geometry_msgs/msg/TwistStamped",
    "geometry_msgs/msg/TwistWithCovarianceStamped",
    "sensor_msgs/msg/JointState",
)


def register() -> None:
    """Register vehicles as a kind of data, their parameters, and readers of wheel data.

    A registered function imports its module only when it is called.
    """
    needs = "wheels need the poses of a sensor, such as lidar odometry"
    for word in (
        "wheels",
        "wheel_odometry",
        "steering",
        "tricycle",
        "omni",
        "driving",
    ):
        MEASURES[word] = Measure(
            "vehicle", needs, read_as="poses", is_parent=True
        )
    OUT_OF_REACH["vehicle"] = ("z",)
    OUT_OF_REACH["vehicle_2d"] = ("z", "roll", "pitch")
    OUT_OF_REACH["vehicle_alone"] = ("y", "z")
    OUT_OF_REACH["vehicle_alone_2d"] = ("y", "z", "roll", "pitch")
    KINDS["vehicle"] = _vehicle
    KINDS_OF_OPTIONS["nominal_radius"] = "vehicle"
    KINDS_OF_OPTIONS["nominal_separation"] = "vehicle"
    RESULT_PARTS["wheels"] = _parameters
    FINDING_WORDS["vehicle"] = _words
    FILE_READERS["wheels"] = _wheels
    BAG_READINGS["sensor_msgs/msg/JointState"] = _joint_states
    for message_type in _LIVE_TYPES:
        LIVE_READINGS[message_type] = partial(_live, message_type)
    PUBLIC_NAMES["calibrate_vehicle"] = (
        "hand_eye_calib.extras.vehicle.calibrate"
    )
    PUBLIC_NAMES["wheel_trajectory"] = (
        "hand_eye_calib.extras.vehicle.wheel_files"
    )
    ROUTES["vehicle"] = Route(_add_arguments, _is_alone, _calibrate)


def _vehicle() -> Any:
    """Return the kind of data "vehicle"."""
    from hand_eye_calib.extras.vehicle.kinds import VEHICLE

    return VEHICLE


def _parameters() -> Any:
    """Return the part of results with the parameters of the wheels."""
    from hand_eye_calib.extras.vehicle.part import WheelPart

    return WheelPart()


def _words() -> Any:
    """Return the sentences of the findings about vehicles."""
    from hand_eye_calib.extras.vehicle.words import WORDS

    return WORDS


def _wheels(*file: Any) -> Any:
    """Return the table of a csv file of wheel data, or None for other files."""
    from hand_eye_calib.extras.vehicle.wheel_files import table_of_wheels

    return table_of_wheels(*file)


def _joint_states(*source: Any) -> Any:
    """Return the reader of the wheels in joint states."""
    from hand_eye_calib.extras.vehicle.joint_states import JointStateReading

    return JointStateReading(*source)


def _live(*topic: Any) -> Any:
    """Return the reader of a live topic with velocities or wheels."""
    from hand_eye_calib.extras.vehicle.live import live_reading

    return live_reading(*topic)


def _add_arguments(parser: Any) -> None:
    """Add the options of vehicles to the command line."""
    from hand_eye_calib.extras.vehicle.arguments import NominalAction

    words = (
        "the only PATH is the trajectory file of a sensor on a vehicle without wheel data: "
        "estimate its x, roll, pitch and yaw on the rear axle"
    )
    parser.add_argument("--on-vehicle", action="store_true", help=words)
    nominal = (
        "URDF, or YAML file of a controller of ros2_controllers, with the nominal radius and "
        "separation of the wheels: sets --nominal-radius and --nominal-separation"
    )
    parser.add_argument(
        "--nominal",
        metavar="FILE",
        action=NominalAction,
        dest="options",
        help=nominal,
    )


def _is_alone(arguments: Any) -> bool:
    """Return whether the command is for a sensor without wheel data.

    Raises a ConfigError if such a command has several paths.
    """
    if arguments.on_vehicle and len(arguments.paths) != 1:
        raise ConfigError(
            "--on-vehicle takes the trajectory file of one sensor; with wheel data leave it out: "
            "calibrate WHEELS.csv SENSOR.tum"
        )
    return bool(arguments.on_vehicle)


def _calibrate(arguments: Any, _: Any) -> int:
    """Calibrate a sensor without wheel data, and return the exit code."""
    from hand_eye_calib.extras.vehicle.calibrate import calibrate_alone

    return calibrate_alone(arguments)
