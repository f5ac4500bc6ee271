"""Starts the node ``calibrator`` on two topics with poses.

ros2 launch hand_eye_calib calibrator.launch.py parent_topic:=/lidar/odom child_topic:=/camera/odom

Every parameter of the node is an argument of the same name; one that is not given is left to the
parameter file.
"""

import dataclasses
from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from hand_eye_calib.config import CalibratorConfig, NodeConfig, option_name

PARAMETERS = {
    option_name(field): field
    for config in (CalibratorConfig, NodeConfig)
    for field in dataclasses.fields(config)
}

# Beside this folder, in the repository as in an installed package.
CONFIG_FILE = Path(__file__).parents[1] / "config" / "calibrator.yaml"

# Name, default and description of the arguments that are not parameters of the node's own.
ARGUMENTS = {
    "parent_topic": ("parent_odom", "Topic with the poses of the parent sensor."),
    "child_topic": ("child_odom", "Topic with the poses of the child sensor."),
    "config_file": (str(CONFIG_FILE), "File with the node's parameters."),
    "name": ("calibrator", "Name of the node."),
    "namespace": ("", "Namespace of the node; relative topics are looked for in it."),
    "use_sim_time": ("", "true follows /clock, as with a bag played with --clock."),
    "log_level": ("", "Of this node: debug, info, warn, error or fatal."),
    "respawn": ("false", "true starts the node again if it dies; use it with journal:=resume."),
}


def value_type(field: dataclasses.Field) -> type | None:
    """Type of a parameter; None for one that takes a word or a number."""
    return None if field.metadata["words"] else type(field.default)


def describe(field: dataclasses.Field) -> str:
    """Help for a parameter's argument."""
    choices = field.metadata["choices"]
    allowed = f" One of {', '.join(choices)}." if choices else ""
    return f"{field.metadata['doc']}{allowed} Empty leaves it to the parameter file."


def given(context: LaunchContext, name: str) -> str:
    """The value of an argument; empty if it was not given."""
    return LaunchConfiguration(name).perform(context)


def logger_name(context: LaunchContext) -> str:
    """Of the node: its namespaces, which a group around this file may add to, and its name."""
    outer = context.launch_configurations.get("ros_namespace", "")
    own = given(context, "namespace")
    parts = [own] if own.startswith("/") else [outer, own]
    words = [word for part in parts for word in part.split("/") if word]
    return ".".join([*words, given(context, "name")])


def calibrator(context: LaunchContext) -> list[Node]:
    """The node, with the parameters that were given."""
    types = {name: value_type(field) for name, field in PARAMETERS.items()} | {"use_sim_time": bool}
    parameters = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for name, kind in types.items()
        if given(context, name)
    }
    level = given(context, "log_level")
    return [
        Node(
            package="hand_eye_calib",
            executable="calibrator",
            name=LaunchConfiguration("name"),
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("config_file"), parameters],
            remappings=[
                ("parent_odom", LaunchConfiguration("parent_topic")),
                ("child_odom", LaunchConfiguration("child_topic")),
            ],
            ros_arguments=["--log-level", f"{logger_name(context)}:={level}"] if level else [],
            respawn=given(context, "respawn").lower() == "true",
            output="screen",
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Arguments and node."""
    arguments = ARGUMENTS | {name: ("", describe(field)) for name, field in PARAMETERS.items()}
    return LaunchDescription(
        [
            DeclareLaunchArgument(name, default_value=default, description=description)
            for name, (default, description) in arguments.items()
        ]
        + [OpaqueFunction(function=calibrator)]
    )
