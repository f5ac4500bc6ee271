"""Starts the node ``calibrator`` on two topics with poses.

ros2 launch hand_eye_calib calibrator.launch.py parent_topic:=/lidar/odom child_topic:=/camera/odom

Every parameter of the node is an argument of the same name; one that is not given is left to the
parameter file.
"""

import contextlib
import dataclasses
from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from hand_eye_calib.core.base.config import CalibratorConfig, NodeConfig, other_names
from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.option import check_value, option_name

PARAMETERS = {
    option_name(field): field
    for config in (CalibratorConfig, NodeConfig)
    for field in dataclasses.fields(config)
}

# Beside this folder, in the repository as in an installed package.
CONFIG_FILE = Path(__file__).parents[1] / "config" / "calibrator.yaml"

# Topics that may be other ones: argument to the node's own name.
REMAPPED = {"parent_topic": "parent_odom", "child_topic": "child_odom"}
REMAPPED |= {f"{name}_topic": f"{name}_odom" for name in other_names()}
REMAPPED |= {"tf_topic": "/tf", "tf_static_topic": "/tf_static"}

# Name, default and description of the arguments that are not parameters of the node's own.
ARGUMENTS = {name: (topic, f"Topic in place of {topic}.") for name, topic in REMAPPED.items()} | {
    "config_file": (str(CONFIG_FILE), "File with the node's parameters."),
    "name": ("calibrator", "Name of the node."),
    "namespace": ("", "Namespace of the node; relative topics are looked for in it."),
    "use_sim_time": ("", "true follows /clock, as with a bag played with --clock."),
    "log_level": ("", "Of this node: debug, info, warn, error or fatal."),
    "respawn": ("false", "true starts the node again if it dies; use it with journal:=resume."),
}


def value_of(text: str, field: dataclasses.Field) -> bool | int | float | str:
    """Value of a parameter as it is typed.

    Raises
    ------
    ConfigError
        If it is not allowed.
    """
    kind = float if field.metadata["words"] else type(field.default)
    value: bool | int | float | str = text
    if kind is bool:
        value = {"true": True, "false": False}.get(text.lower(), text)
    elif kind is not str:
        with contextlib.suppress(ValueError):
            value = kind(text)
    return check_value(field, value)


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


def is_true(context: LaunchContext, name: str) -> bool:
    """Whether an argument is true.

    Raises
    ------
    ConfigError
        If it is neither true nor false.
    """
    text = given(context, name).lower()
    if text not in ("true", "false"):
        raise ConfigError(f"{name} must be true or false; got '{text}'")
    return text == "true"


def calibrator(context: LaunchContext) -> list[Node]:
    """The node, with the parameters that were given."""
    parameters = {}
    for name, field in PARAMETERS.items():
        if text := given(context, name):
            value = value_of(text, field)
            is_text = isinstance(value, str)  # which launch would read as YAML
            as_it_is = ParameterValue(LaunchConfiguration(name), value_type=str)
            parameters[name] = as_it_is if is_text else value
    if given(context, "use_sim_time"):
        parameters["use_sim_time"] = is_true(context, "use_sim_time")
    level = given(context, "log_level")
    return [
        Node(
            package="hand_eye_calib",
            executable="calibrator",
            name=LaunchConfiguration("name"),
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("config_file"), parameters],
            remappings=[(old, LaunchConfiguration(name)) for name, old in REMAPPED.items()],
            ros_arguments=["--log-level", f"{logger_name(context)}:={level}"] if level else [],
            respawn=is_true(context, "respawn"),
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
