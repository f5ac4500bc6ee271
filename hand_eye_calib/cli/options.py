"""Command-line options made from the option dataclasses, and the configuration file that sets the
same options by name.
"""

import argparse
import dataclasses
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hand_eye_calib.cli.console import OPTION_FIELDS, flag, note
from hand_eye_calib.config import (
    CalibratorConfig,
    NodeConfig,
    check_value,
    did_you_mean,
    option_name,
)
from hand_eye_calib.errors import ConfigError

Options = dict[str, Any]

_NODE_OPTIONS = {option_name(field) for field in dataclasses.fields(NodeConfig)}
_ROS_OPTIONS = ("use_sim_time", "start_type_description_service", "qos_overrides")
_NODE_NAMES = ("calibrator", "**", "*")
_DEST = "option "
_PRIOR = "prior."

# What most people set: the help has these options first.
_COMMON = ("method", "reference", "time_offset", "scale", "parent_frame", "child_frame")


def argument_type(parse: Callable[[str], Any], prefix: str = "") -> Callable[[str], Any]:
    """The type of an argument: a ConfigError is wrong usage, its message without ``prefix``."""

    def parsed(text: str) -> Any:
        try:
            return parse(text)
        except ConfigError as error:
            raise argparse.ArgumentTypeError(str(error).removeprefix(prefix)) from None

    return parsed


def at_least(minimum: int) -> Callable[[str], int]:
    """The type of an argument that is a whole number of at least ``minimum``."""

    def parse(text: str) -> int:
        if not text.isdecimal() or int(text) < minimum:
            raise ConfigError(f"expected a whole number of at least {minimum}, got {text!r}")
        return int(text)

    return argument_type(parse)


def add_config_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--config`` and an option for every field of CalibratorConfig."""
    # argparse takes -1e-3, -90deg+/-2deg and the like for options otherwise.
    parser._negative_number_matcher = re.compile(r"-\.?\d")
    group = parser.add_argument_group("calibration options")
    for name in _COMMON:
        _add_option(group, name)
    _add_prior_and_config(group)
    rare = parser.add_argument_group("calibration options that are rarely needed")
    for name in OPTION_FIELDS:
        if name not in _COMMON:
            _add_option(rare, name)


def offer(action: argparse.Action, values: Callable[[argparse.Namespace], Sequence[str]]) -> None:
    """Let a shell offer values for an option, given what has been typed before."""
    setattr(action, "completer", lambda parsed_args, **_: values(parsed_args))  # noqa: B010


def _add_option(group: argparse._ArgumentGroup, name: str) -> None:
    field = OPTION_FIELDS[name]
    meta = field.metadata
    unit = f" Unit: {meta['unit']}." if meta["unit"] else ""
    default = "" if field.default == "" else f" Default: {field.default}."
    action = group.add_argument(
        f"--{flag(name)}",
        dest=_DEST + name,
        default=argparse.SUPPRESS,
        type=argument_type(lambda text: _value(field, text), f"{name} "),
        metavar=_metavar(name, meta),
        help=f"{meta['doc']}{unit}{default}".replace("%", "%%"),
    )
    words = [*(meta["choices"] or ()), *meta["words"]]
    if words:
        offer(action, lambda _: words)


def _add_prior_and_config(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--prior",
        metavar="AXIS=VALUE+/-SIGMA",
        action="append",
        type=_prior_argument,
        default=argparse.SUPPRESS,
        help="what is known of an axis beforehand, such as z=1.85+/-0.02 (m) or yaw=-90deg+/-2deg; "
        f"AXIS is one of {_axes()}; may be repeated",
    )
    group.add_argument(
        "--config",
        metavar="FILE",
        type=Path,
        help="YAML file with these options by name, or a ROS parameter file",
    )


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--out`` and ``--json``."""
    group = parser.add_argument_group("output")
    group.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="save the result in this directory: extrinsic.yaml, extrinsic.urdf.xacro, "
        "static_transform.launch.py and report.html",
    )
    add_json_argument(group)


def add_json_argument(parser: argparse._ActionsContainer) -> None:
    """Add ``--json``."""
    parser.add_argument(
        "--json", action="store_true", help="print one JSON document on stdout instead of text"
    )


def options_from(arguments: argparse.Namespace) -> Options:
    """The options that were set, by their public names: the command line before the file.

    Raises
    ------
    ConfigError
        If the file sets something that does not exist or cannot be.
    InputError
        If the file cannot be read.
    """
    options = _read_config(arguments.config) if arguments.config else {}
    options |= dict(getattr(arguments, "prior", ()))
    return options | {
        name.removeprefix(_DEST): value
        for name, value in vars(arguments).items()
        if name.startswith(_DEST)
    }


def config_from(arguments: argparse.Namespace) -> CalibratorConfig:
    """The CalibratorConfig that was asked for: :func:`options_from` before the defaults."""
    return CalibratorConfig.from_options(options_from(arguments))


def _axes() -> str:
    return ", ".join(name.removeprefix(_PRIOR) for name in OPTION_FIELDS if _PRIOR in name)


@argument_type
def _prior_argument(text: str) -> tuple[str, Any]:
    axis, equals, value = text.partition("=")
    if not equals or _PRIOR + axis not in OPTION_FIELDS:
        raise ConfigError(f"expected AXIS=VALUE+/-SIGMA with AXIS one of {_axes()}; got {text!r}")
    return _PRIOR + axis, check_value(OPTION_FIELDS[_PRIOR + axis], value)


def _metavar(name: str, meta: Mapping[str, Any]) -> str:
    if meta["choices"]:
        return "{" + ",".join(meta["choices"]) + "}"
    return "|".join([*meta["words"], flag(name).rpartition("-")[2].upper()])


def _value(field: dataclasses.Field[Any], value: Any) -> Any:
    """The value of an option, from text or as YAML has it."""
    return check_value(field, _from_text(field, value) if isinstance(value, str) else value)


def _from_text(field: dataclasses.Field[Any], text: str) -> Any:
    """Numbers arrive as text; what is none is left for check_value to complain about."""
    kind = type(field.default)
    try:
        return kind(text) if kind in (int, float) else text
    except ValueError:
        return text


def _read_config(path: Path) -> Options:
    from hand_eye_calib.io.yaml_files import read_yaml

    document = read_yaml(path)
    if document is None:
        return {}
    if not isinstance(document, dict):
        raise ConfigError(
            f"{path}: expected a mapping of options to values; found {type(document).__name__}"
        )
    options, ignored = {}, []
    for name, value in _flatten(_parameters(path, document)).items():
        if name in OPTION_FIELDS:
            options[name] = _checked(path, name, value)
        elif name in _NODE_OPTIONS or name.partition(".")[0] in _ROS_OPTIONS:
            ignored.append(repr(name))
        else:
            known = sorted(OPTION_FIELDS)
            raise ConfigError(
                f"{path}: unknown option {name!r}{did_you_mean(name, known)}; "
                f"known are {', '.join(map(repr, known))}"
            )
    if ignored:
        note(f"{path}: only the node uses {', '.join(ignored)}; ignored here")
    return options


def _checked(path: Path, name: str, value: Any) -> Any:
    try:
        return _value(OPTION_FIELDS[name], value)
    except ConfigError as error:
        # In quotes it keeps the spelling of the file.
        raise ConfigError(f"{path}: {str(error).replace(name, repr(name), 1)}") from None


def _parameters(path: Path, document: Mapping[str, Any]) -> Mapping[str, Any]:
    """Of a ROS parameter file what is meant for the node ``calibrator``, of any other file all."""
    try:
        sections = dict(_ros_sections(document))
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    if not sections:
        return document
    ours = [
        parameters
        for node, parameters in sections.items()
        if node.rpartition("/")[2] in _NODE_NAMES
    ]
    if not ours:
        raise ConfigError(
            f"{path}: no parameters for a node named calibrator; found some for "
            f"{', '.join(sections)}"
        )
    return {name: value for parameters in ours for name, value in _flatten(parameters).items()}


def _ros_sections(
    mapping: Mapping[str, Any], node: str = ""
) -> Iterator[tuple[str, Mapping[str, Any]]]:
    for name, value in mapping.items():
        if name == "ros__parameters" and isinstance(value, (dict, type(None))):
            yield node, value or {}
        elif name == "ros__parameters":
            raise ConfigError(
                f"{node or '/'}: ros__parameters must be a mapping of names to values"
            )
        elif isinstance(value, dict):
            yield from _ros_sections(value, f"{node}/{str(name).strip('/')}")


def _flatten(mapping: Mapping[str, Any], prefix: str = "") -> Options:
    """Nested mappings to dotted names."""
    flat: Options = {}
    for name, value in mapping.items():
        if isinstance(value, dict):
            flat |= _flatten(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = value
    return flat
