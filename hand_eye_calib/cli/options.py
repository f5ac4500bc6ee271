"""Command-line options made from the option dataclasses, and the configuration file that may stand
for them.
"""

import argparse
import dataclasses
import re
from pathlib import Path

from hand_eye_calib.cli.console import note
from hand_eye_calib.config import CalibratorConfig, NodeConfig, check_value, option_name
from hand_eye_calib.errors import ConfigError, InputError

_FIELDS = {option_name(field): field for field in dataclasses.fields(CalibratorConfig)}
_NODE_OPTIONS = {option_name(field) for field in dataclasses.fields(NodeConfig)}
_ROS_OPTIONS = ("use_sim_time", "start_type_description_service", "qos_overrides")
_NODE_NAMES = ("calibrator", "**", "*")
_PREFIX = "option "
_PRIOR = "prior."


def add_config_arguments(parser):
    """Add ``--config`` and an option for every field of CalibratorConfig."""
    # argparse takes -1e-3, -90deg+/-2deg and the like for options otherwise.
    parser._negative_number_matcher = re.compile(r"-\.?\d")
    group = parser.add_argument_group("calibration options")
    group.add_argument(
        "--config",
        metavar="FILE",
        type=Path,
        help="YAML file with these options by name, or a ROS parameter file",
    )
    for name, field in _FIELDS.items():
        meta = field.metadata
        unit = f" Unit: {meta['unit']}." if meta["unit"] else ""
        default = "" if field.default == "" else f" Default: {field.default}."
        group.add_argument(
            f"--{flag(name)}",
            dest=_PREFIX + name,
            default=argparse.SUPPRESS,
            type=_argument_type(field),
            metavar=_metavar(name, meta),
            help=f"{meta['doc']}{unit}{default}".replace("%", "%%"),
        )
    axes = ", ".join(name.removeprefix(_PRIOR) for name in _FIELDS if name.startswith(_PRIOR))
    group.add_argument(
        "--prior",
        metavar="AXIS=VALUE+/-SIGMA",
        action="append",
        type=_prior_argument,
        default=argparse.SUPPRESS,
        help=f"the same as --prior-AXIS VALUE+/-SIGMA, for one of {axes}; may be repeated",
    )


def add_output_arguments(parser):
    """Add ``--out`` and ``--json``."""
    group = parser.add_argument_group("output")
    group.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="save the result in this directory: extrinsic.yaml, extrinsic.urdf.xacro and static_transform.launch.py",
    )
    add_json_argument(group)


def add_json_argument(parser):
    """Add ``--json``."""
    parser.add_argument(
        "--json", action="store_true", help="print one JSON document on stdout instead of text"
    )


def flag(name):
    """An option's name as it is typed, without the leading dashes."""
    return name.replace(".", "-").replace("_", "-")


def options_from(arguments):
    """The options that were set, by their public names: the command line before the file.

    Raises
    ------
    ConfigError
        Where the file sets something that does not exist or cannot be.
    InputError
        Where the file cannot be read.
    """
    options = _read_config(arguments.config) if arguments.config else {}
    options |= dict(getattr(arguments, "prior", ()))
    return options | {
        name.removeprefix(_PREFIX): value
        for name, value in vars(arguments).items()
        if name.startswith(_PREFIX)
    }


def config_from(arguments):
    """The CalibratorConfig that was asked for: :func:`options_from` before the defaults."""
    return CalibratorConfig.from_options(options_from(arguments))


def _prior_argument(text):
    axis, equals, value = text.partition("=")
    if not equals or _PRIOR + axis not in _FIELDS:
        axes = ", ".join(name.removeprefix(_PRIOR) for name in _FIELDS if name.startswith(_PRIOR))
        raise argparse.ArgumentTypeError(
            f"expected AXIS=VALUE+/-SIGMA with AXIS one of {axes}; got {text!r}"
        )
    try:
        return _PRIOR + axis, check_value(_FIELDS[_PRIOR + axis], value)
    except ConfigError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _metavar(name, meta):
    if meta["choices"]:
        return "{" + ",".join(meta["choices"]) + "}"
    return "|".join([*meta["words"], flag(name).rpartition("-")[2].upper()])


def _argument_type(field):
    def parse(text):
        try:
            return check_value(field, _from_text(field, text))
        except ConfigError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return parse


def _from_text(field, text):
    """Numbers arrive as text; what is none is left for check_value to complain about."""
    kind = type(field.default)
    try:
        return kind(text) if kind in (int, float) else text
    except ValueError:
        return text


def read_yaml(path):
    """What a YAML file holds.

    Raises
    ------
    InputError
        Where it cannot be read, or is not YAML.
    """
    import yaml

    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not YAML: {' '.join(str(error).split())}") from None


def _read_config(path):
    document = read_yaml(path)
    if document is None:
        return {}
    if not isinstance(document, dict):
        raise ConfigError(
            f"{path}: expected a mapping of options to values; found {type(document).__name__}"
        )
    options, ignored = {}, []
    for name, value in _flatten(_parameters(path, document)).items():
        if name in _FIELDS:
            options[name] = _checked(path, _FIELDS[name], value)
        elif name in _NODE_OPTIONS or name.partition(".")[0] in _ROS_OPTIONS:
            ignored.append(name)
        else:
            raise ConfigError(
                f"{path}: unknown option {name!r}; known are {', '.join(sorted(_FIELDS))}"
            )
    if ignored:
        note(f"{path}: only the node uses {', '.join(ignored)}; ignored here")
    return options


def _checked(path, field, value):
    try:
        return check_value(field, _from_text(field, value) if isinstance(value, str) else value)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def _parameters(path, document):
    """Of a ROS parameter file what is meant for the node ``calibrator``, of any other all."""
    sections = dict(_ros_sections(document))
    if not sections:
        return document
    ours = [
        parameters
        for node, parameters in sections.items()
        if node.rpartition("/")[2] in _NODE_NAMES
    ]
    if not ours:
        raise ConfigError(
            f"{path}: no parameters for a node named calibrator; found some for {', '.join(sections)}"
        )
    return {name: value for parameters in ours for name, value in _flatten(parameters).items()}


def _ros_sections(mapping, node=""):
    for name, value in mapping.items():
        if name == "ros__parameters":
            yield node, value or {}
        elif isinstance(value, dict):
            yield from _ros_sections(value, f"{node}/{str(name).strip('/')}")


def _flatten(mapping, prefix=""):
    """Nested mappings to dotted names."""
    flat = {}
    for name, value in mapping.items():
        flat |= (
            _flatten(value, f"{prefix}{name}.")
            if isinstance(value, dict)
            else {f"{prefix}{name}": value}
        )
    return flat
