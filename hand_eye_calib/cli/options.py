"""Command-line options: those of the engine, made from the option dataclasses, with the
configuration file that sets the same by name; what is read; what is written.

Nothing here loads a library: ``--help`` is quick.
"""

import argparse
import contextlib
import dataclasses
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hand_eye_calib.cli.console import OPTION_FIELDS, flag, note
from hand_eye_calib.config import (
    STAMP_UNITS,
    TRAJECTORY_FORMATS,
    CalibratorConfig,
    NodeConfig,
    check_value,
    did_you_mean,
    option_name,
)
from hand_eye_calib.errors import ConfigError

if TYPE_CHECKING:
    from hand_eye_calib.io.transforms import TfSource

Options = dict[str, Any]

STREAMS = ("parent", "child")

_NODE_OPTIONS = {option_name(field) for field in dataclasses.fields(NodeConfig)}
_ROS_OPTIONS = ("use_sim_time", "start_type_description_service", "qos_overrides")
_NODES = ("calibrator", "**", "*", "ros__parameters")
_DEST = "option "
_PRIOR = "prior."
_AXES = ", ".join(name.removeprefix(_PRIOR) for name in OPTION_FIELDS if _PRIOR in name)

# What most people set: the help has these options first.
_COMMON = ("method", "reference", "time_offset", "scale", "parent_frame", "child_frame")

# How a trajectory file is read. By name, what argparse needs.
FILE_OPTIONS: dict[str, dict[str, Any]] = {
    "format": {
        "choices": TRAJECTORY_FORMATS,
        "help": "tum: t x y z qx qy qz qw; kitti: 12 numbers, with --times; euroc: ns, qw first; "
        "csv: columns by the names in the header, or with --columns: positions as x y z or lat lon "
        "height, orientations as quaternion, roll pitch yaw or heading. Default: what the file "
        "looks like",
    },
    "columns": {
        "metavar": "NAMES",
        "help": "names of the columns of a csv file without a header, in their order: "
        "t,x,y,z,qw,qx,qy,qz",
    },
    "times": {
        "metavar": "FILE",
        "type": Path,
        "help": "stamps of the poses of a kitti file, one per line",
    },
    "stamp_unit": {
        "choices": tuple(STAMP_UNITS),
        "help": "unit of the stamps. Default: recognised from their size",
    },
}


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


# ------------------------------------------------------- options of the engine


def add_config_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--config`` and an option for every field of CalibratorConfig."""
    # argparse takes -1e-3, -90deg+-2deg and the like for options otherwise.
    parser._negative_number_matcher = re.compile(r"-\.?\d")
    group = parser.add_argument_group("calibration options")
    for name in _COMMON:
        _add_option(group, name)
    group.add_argument(
        "--prior",
        metavar="AXIS=VALUE+-SIGMA",
        action="append",
        type=_prior_argument,
        default=argparse.SUPPRESS,
        help="what is known of an axis beforehand, such as z=1.85+-0.02 (m) or yaw=-90deg+-2deg; "
        f"AXIS is one of {_AXES}; may be repeated",
    )
    group.add_argument(
        "--config",
        metavar="FILE",
        type=Path,
        help="YAML file with these options by name, or a ROS parameter file",
    )
    rare = parser.add_argument_group("calibration options that are rarely needed")
    for name in OPTION_FIELDS:
        if name not in _COMMON:
            _add_option(rare, name)


def _add_option(group: argparse._ArgumentGroup, name: str) -> None:
    field = OPTION_FIELDS[name]
    meta = field.metadata
    unit = f" Unit: {meta['unit']}." if meta["unit"] else ""
    default = "" if field.default == "" else f" Default: {field.default}."
    value = "|".join([*meta["words"], flag(name).rpartition("-")[2].upper()])
    group.add_argument(
        f"--{flag(name)}",
        dest=_DEST + name,
        default=argparse.SUPPRESS,
        type=argument_type(lambda text: _value(field, text), f"{name} "),
        metavar=f"{{{','.join(meta['choices'])}}}" if meta["choices"] else value,
        help=f"{meta['doc']}{unit}{default}".replace("%", "%%"),
    )


@argument_type
def _prior_argument(text: str) -> tuple[str, Any]:
    axis, equals, value = text.partition("=")
    if not equals or _PRIOR + axis not in OPTION_FIELDS:
        raise ConfigError(f"expected AXIS=VALUE+-SIGMA with AXIS one of {_AXES}; got {text!r}")
    return _PRIOR + axis, check_value(OPTION_FIELDS[_PRIOR + axis], value)


def _value(field: dataclasses.Field[Any], value: Any) -> Any:
    """The value of an option, from text or as YAML has it."""
    kind = type(field.default)
    if isinstance(value, str) and kind in (int, float):
        with contextlib.suppress(ValueError):  # check_value says what it should be
            value = kind(value)
    return check_value(field, value)


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


# ------------------------------------------------------ the configuration file


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
            try:
                options[name] = _value(OPTION_FIELDS[name], value)
            except ConfigError as error:
                # In quotes it keeps the spelling of the file.
                text = str(error).replace(name, repr(name), 1)
                raise ConfigError(f"{path}: {text}") from None
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


def _parameters(path: Path, document: Mapping[str, Any]) -> Mapping[str, Any]:
    """Of a ROS parameter file what is meant for the node ``calibrator``, of any other file all."""
    key, ending = "ros__parameters", ".ros__parameters"
    flat = _flatten(document, until=key)
    sections = {name.removesuffix(ending): each for name, each in flat.items() if key in name}
    for node, each in sections.items():
        if not isinstance(each, dict | None):
            raise ConfigError(f"{path}: {node}: {key} must be a mapping of names to values")
    if not sections:
        return document
    ours = [each or {} for node, each in sections.items() if re.split("[./]", node)[-1] in _NODES]
    if not ours:
        found = ", ".join(f"/{node.strip('/').replace('.', '/')}" for node in sections)
        raise ConfigError(
            f"{path}: no parameters for a node named calibrator; found some for {found}"
        )
    return {name: value for each in ours for name, value in _flatten(each).items()}


def _flatten(mapping: Mapping[str, Any], prefix: str = "", until: str = "") -> Options:
    """Nested mappings to dotted names, but for what lies below the name ``until``."""
    flat: Options = {}
    for name, value in mapping.items():
        if isinstance(value, dict) and name != until:
            flat |= _flatten(value, f"{prefix}{name}.", until)
        else:
            flat[f"{prefix}{name}"] = value
    return flat


# -------------------------------------------------- what is read, what is written


def add_input_arguments(parser: argparse.ArgumentParser, help_of_paths: str) -> None:
    """Add the recording: paths, how files are read, and which streams of a bag are meant."""
    parser.add_argument("paths", metavar="PATH", nargs="*", type=_path, help=help_of_paths)
    group = parser.add_argument_group(
        "pose streams of a bag",
        "Odometry, PoseStamped, PoseWithCovarianceStamped, TransformStamped or Path; may be left "
        "out if the bag has only two",
    )
    for stream in STREAMS:
        source = group.add_mutually_exclusive_group()
        source.add_argument(
            f"--{stream}-topic",
            metavar="TOPIC",
            help=f"poses of the {stream} sensor, of any type, or FIX+IMU of two topics",
        )
        source.add_argument(
            f"--{stream}-tf",
            metavar="WORLD:SENSOR",
            type=_tf_source,
            help="the same from /tf and /tf_static: fixed frame and the sensor's, as odom:lidar",
        )
        parser.add_argument(
            f"--{stream}-fields",
            metavar="NAME=PATH,...",
            default="",
            help=f"where the poses are in messages of any type on --{stream}-topic: "
            "t=header.stamp,x=pose.position.x,...",
        )
    group = parser.add_argument_group(
        "trajectory files", "each also as --parent-... and --child-... for one of the two files"
    )
    for name, settings in FILE_OPTIONS.items():
        group.add_argument(f"--{flag(name)}", dest=name, **settings)
        for stream in STREAMS:
            of_one = settings | {"help": f"the same for {stream.upper()} only"}
            group.add_argument(f"--{stream}-{flag(name)}", dest=f"{stream}_{name}", **of_one)


def _label(text: str) -> tuple[str, str]:
    name, sign, value = text.partition("=")
    if not (name and sign and value):
        raise ConfigError(f"expected NAME=VALUE, such as vehicle=7; got {text!r}")
    return name, value


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--out``, ``--label``, ``--json`` and ``--verbose``."""
    group = parser.add_argument_group("output")
    group.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="save the result in this directory: extrinsic.yaml, extrinsic.urdf.xacro, "
        "static_transform.launch.py and report.html",
    )
    group.add_argument(
        "--label",
        metavar="NAME=VALUE",
        nargs="+",
        action="extend",
        default=[],
        type=argument_type(_label),
        help="what the report and the files say of the recording, such as vehicle=7 operator=Kim",
    )
    add_json_argument(group)
    add_verbose_argument(group)


def add_json_argument(parser: argparse._ActionsContainer) -> None:
    """Add ``--json``."""
    parser.add_argument(
        "--json", action="store_true", help="print one JSON document on stdout instead of text"
    )


def add_verbose_argument(parser: argparse._ActionsContainer) -> None:
    """Add ``--verbose``."""
    parser.add_argument(
        "-v", "--verbose", action="store_true", help="print details of the solution, too"
    )


def _path(text: str) -> Path | str:
    """A path; a URL stays as it is, for a path has no two slashes in a row."""
    return text if "://" in text else Path(text)


@argument_type
def _tf_source(text: str) -> "TfSource":
    from hand_eye_calib.io.transforms import TfSource

    return TfSource.parse(text)
