"""Options that the user has set: on the command line, and in a file of options.

A file is YAML with options by name, or a ROS parameter file of the node.
"""

import argparse
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import hand_eye_calib.core.base.config as config
from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.option import Options, OptionValue, did_you_mean
from hand_eye_calib.offline.cli.options import (
    OPTION_FIELDS,
    checked_option,
    note,
)

# Options in a parameter file that only the node uses, and options that rclpy declares.
_NODE_OPTIONS = config.NodeConfig.by_name()

_ROS_OPTIONS = (
    "use_sim_time",
    "start_type_description_service",
    "qos_overrides",
)

# Names of nodes in a parameter file whose section is for the calibrator.
_NODES = ("calibrator", "**", "*", "")

# Options of the command line that choose topics. The node has remaps instead.
_TOPICS = ("parent_topic", "child_topic")

# Key of the parameters of a node in a parameter file.
_ROS_SECTION = "ros__parameters"


def options_from(arguments: argparse.Namespace) -> Options:
    """Return the options that the user has set, by their public names.

    Options on the command line override options in the file of ``--config``.

    Raises
    ------
    ConfigError
        If the file has an unknown option or a bad value.
    """
    file_options = _read_config(arguments.config) if arguments.config else {}
    return {**file_options, **dict(arguments.options)}


def _is_of_node(option: str) -> bool:
    """Return whether an option belongs to the node only, or to all nodes of ROS."""
    group, _, _ = option.partition(".")
    return option in _NODE_OPTIONS or group in _ROS_OPTIONS


def _read_config(path: Path) -> Options:
    """Return the options of a YAML file with options by name, or of a ROS parameter file."""
    from hand_eye_calib.formats.yaml_files import read_yaml

    document = read_yaml(path)
    if not isinstance(document, dict | None):
        kind = type(document).__name__
        raise ConfigError(
            f"{path}: expected a mapping of options to values; found {kind}"
        )
    settings = _settings_of_file(document or {})
    options: dict[str, OptionValue] = {}
    ignored = []
    for option, value in settings.values:
        if option in OPTION_FIELDS:
            options |= [_option_in_file(path, option, value)]
        elif _is_of_node(option):
            ignored.append(repr(option))
        elif value is not None or not option.endswith(_ROS_SECTION):
            # An empty section ros__parameters looks like a name without value. It is not an option.
            raise _unknown_option(path, option)
    if settings.other_nodes and not (options or ignored):
        nodes = ", ".join(settings.other_nodes)
        raise ConfigError(
            f"{path}: no parameters of a node named calibrator; the file has those of {nodes}: "
            "name the section calibrator or /**"
        )
    if ignored:
        note(f"{path}: only the node uses {', '.join(ignored)}; ignored here")
    return options


class _Settings(NamedTuple):
    """Names and values for the calibrator in a file, and the names of other nodes."""

    values: list[tuple[str, Any]]
    other_nodes: list[str]


def _settings_of_file(document: Mapping[str, Any]) -> _Settings:
    """Return the settings of a file; names are without the sections of a ROS parameter file."""
    values = []
    # The keys of this mapping are an ordered set.
    other_nodes: dict[str, None] = {}
    for name, value in _flat(document):
        node, is_ros_parameter, option = name.rpartition(f"{_ROS_SECTION}.")
        if (
            is_ros_parameter
            and re.split("[./]", node.rstrip("."))[-1] not in _NODES
        ):
            other_nodes[f"/{node.strip('/.')}"] = None
        else:
            values.append((option, value))
    return _Settings(values, [*other_nodes])


def _option_in_file(
    path: Path, option: str, value: object
) -> tuple[str, OptionValue]:
    """Return the name and the checked value of an option. An error names the file."""
    try:
        return checked_option(option, value)
    except ConfigError as error:
        # Quotes protect the name from as_typed(), so that it keeps the spelling of the file.
        text = str(error).replace(option, repr(option), 1)
        raise ConfigError(f"{path}: {text}") from None


def _unknown_option(path: Path, option: str) -> ConfigError:
    """Return the error about an unknown option in a file of options."""
    if option in _TOPICS:
        typed = f"--{option.replace('_', '-')}"
        remap = option.replace("_topic", "_odom")
        return ConfigError(
            f"{path}: {option!r} is no parameter; give {typed} TOPIC (for the node: "
            f"-r {remap}:=TOPIC)"
        )
    section, _, rest = option.partition(".")
    if rest in OPTION_FIELDS:
        return ConfigError(
            f"{path}: leave out the section {section!r}: options are at the top level, or below "
            f"calibrator: {_ROS_SECTION}"
        )
    # Quotes protect the names from as_typed(), so that they keep the spelling of the file.
    names = sorted(map(repr, OPTION_FIELDS))
    hint = (
        did_you_mean(repr(option), names) or f"; known are {', '.join(names)}"
    )
    return ConfigError(f"{path}: unknown option {option!r}{hint}")


def _flat(
    mapping: Mapping[str, Any], prefix: str = ""
) -> Iterator[tuple[str, Any]]:
    """Yield names and values of nested mappings. A name has the joined keys, with dots between."""
    for name, value in mapping.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
