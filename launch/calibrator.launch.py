"""Launch file of the node ``calibrator``, on two topics with poses; with page and recording.

ros2 launch hand_eye_calib calibrator.launch.py parent_topic:=/lidar/odom child_topic:=/camera/odom
    watch:=true record:=drive

Every parameter of the node is an argument of the same name. An argument that is not set leaves its
parameter to the parameter file.
"""

import contextlib
import dataclasses
import sys
from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from hand_eye_calib.core.base.config import (
    CalibratorConfig,
    NodeConfig,
    other_names,
)
from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.option import check_value, option_name

PARAMETERS = {
    option_name(field): field
    for config in (CalibratorConfig, NodeConfig)
    for field in dataclasses.fields(config)
}

# The folder config is next to the folder launch, in the repository and when installed.
CONFIG_FILE = Path(__file__).parents[1] / "config" / "calibrator.yaml"

# Topics that may be remapped: arguments of this file, and names in the node.
REMAPPED = {"parent_topic": "parent_odom", "child_topic": "child_odom"}
REMAPPED |= {f"{name}_topic": f"{name}_odom" for name in other_names()}
REMAPPED |= {"tf_topic": "/tf", "tf_static_topic": "/tf_static"}

# Arguments that are no parameters of the node: name, default and description.
ARGUMENTS = {
    name: (topic, f"Topic in place of {topic}.")
    for name, topic in REMAPPED.items()
} | {
    "config_file": (str(CONFIG_FILE), "File with the node's parameters."),
    "name": ("calibrator", "Name of the node."),
    "namespace": (
        "",
        "Namespace of the node; relative topics are looked for in it.",
    ),
    "use_sim_time": (
        "",
        "true follows /clock, as with a bag played with --clock.",
    ),
    "log_level": ("", "Of this node: debug, info, warn, error or fatal."),
    "watch": (
        "false",
        "true also serves the page of watch; its address is in the output.",
    ),
    "record": (
        "",
        "Directory of a bag with the poses and the results, by ros2 bag record.",
    ),
    "respawn": (
        "false",
        "true starts the node again if it dies; use it with journal:=resume.",
    ),
}


def value_of(text: str, field: dataclasses.Field) -> bool | int | float | str:
    """Return the value of a parameter from its text.

    Raises
    ------
    ConfigError
        If the value is not allowed.
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
    """Return the help of the argument of a parameter."""
    choices = field.metadata["choices"]
    allowed = f" One of {', '.join(choices)}." if choices else ""
    return f"{field.metadata['doc']}{allowed} Empty leaves it to the parameter file."


def argument(context: LaunchContext, name: str) -> str:
    """Return the value of an argument; empty if it is not set."""
    return LaunchConfiguration(name).perform(context)


def full_namespace(context: LaunchContext) -> str:
    """Return the node's namespace, with the namespaces of groups around this file."""
    outer = context.launch_configurations.get("ros_namespace", "")
    own = argument(context, "namespace")
    namespace = own if own.startswith("/") else f"/{outer}/{own}"
    return "".join(f"/{name}" for name in namespace.split("/") if name)


def logger_name(context: LaunchContext) -> str:
    """Return the name of the node's logger."""
    names = [*full_namespace(context).split("/"), argument(context, "name")]
    return ".".join(filter(None, names))


def is_true(context: LaunchContext, name: str) -> bool:
    """Return whether an argument is true.

    Raises
    ------
    ConfigError
        If the argument is neither true nor false.
    """
    text = argument(context, name).lower()
    if text not in ("true", "false"):
        raise ConfigError(f"{name} must be true or false; got '{text}'")
    return text == "true"


def page(context: LaunchContext) -> list[ExecuteProcess]:
    """Return the program that serves the page of watch, if asked for."""
    if not is_true(context, "watch"):
        return []
    command = [sys.executable, "-m", "hand_eye_calib", "watch", "--web"]
    return [ExecuteProcess(cmd=command, name="watch", output="screen")]


def recording(context: LaunchContext) -> list[ExecuteProcess]:
    """Return the program that records poses, transforms, results and state, if asked for."""
    directory = argument(context, "record")
    if not directory:
        return []
    others = other_names(int(argument(context, "other_children") or 0))
    names = [f"{name}_topic" for name in ("parent", "child", *others)]
    names += ["tf_topic", "tf_static_topic"]
    own_name = argument(context, "name")
    results = ("extrinsic", "extrinsic_with_covariance", "progress")
    topics = [argument(context, name) for name in names]
    topics += [f"{own_name}/{name}" for name in results]
    namespace = full_namespace(context)
    topics = [
        name if name.startswith("/") else f"{namespace}/{name}"
        for name in topics
    ]
    topics.append("/diagnostics")
    command = ["ros2", "bag", "record", "-o", directory, *topics]
    return [ExecuteProcess(cmd=command, name="record", output="screen")]


def calibrator(context: LaunchContext) -> list[Node]:
    """Return the node, with the parameters that are set."""
    parameters = {}
    for name, field in PARAMETERS.items():
        if text := argument(context, name):
            value = value_of(text, field)
            # launch would read a text as YAML.
            if isinstance(value, str):
                value = ParameterValue(
                    LaunchConfiguration(name), value_type=str
                )
            parameters[name] = value
    if argument(context, "use_sim_time"):
        parameters["use_sim_time"] = is_true(context, "use_sim_time")
    level = argument(context, "log_level")
    return [
        Node(
            package="hand_eye_calib",
            executable="calibrator",
            name=LaunchConfiguration("name"),
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("config_file"), parameters],
            remappings=[
                (old, LaunchConfiguration(name))
                for name, old in REMAPPED.items()
            ],
            ros_arguments=["--log-level", f"{logger_name(context)}:={level}"]
            if level
            else [],
            respawn=is_true(context, "respawn"),
            output="screen",
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Return arguments, node, page and recording."""
    arguments = ARGUMENTS | {
        name: ("", describe(field)) for name, field in PARAMETERS.items()
    }
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                name, default_value=default, description=description
            )
            for name, (default, description) in arguments.items()
        ]
        + [
            OpaqueFunction(function=function)
            for function in (calibrator, page, recording)
        ]
    )
