"""What commands take, and what they print beside their result: notes, errors and progress, all on
stderr.

Options are those of the engine, made from the option dataclasses, with the configuration file that
sets the same by name; what is read; what is written.

Nothing here loads a library: ``--help`` is quick.
"""

import argparse
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from enum import IntEnum
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import hand_eye_calib.core.base.config as config
from hand_eye_calib.core.base.errors import ConfigError, printable
from hand_eye_calib.core.base.option import Options, OptionValue, check_value, did_you_mean
from hand_eye_calib.core.base.text import quantities

_Item = TypeVar("_Item")

STREAMS = ("parent", "child")
OPTION_FIELDS = config.CalibratorConfig.by_name()

_NODE_OPTIONS = config.NodeConfig.by_name()
_ROS_OPTIONS = ("use_sim_time", "start_type_description_service", "qos_overrides")
_NODES = ("calibrator", "**", "*", "")
_OF_ROS = "ros__parameters"
_AXES = ", ".join(name.removeprefix("prior.") for name in OPTION_FIELDS if "prior." in name)

# What most people set: the help has these options first.
_COMMON = ("method", "reference", "time_offset", "scale", "parent_frame", "child_frame")

# How a trajectory file is read. By name, what argparse needs.
FILE_OPTIONS: dict[str, dict[str, Any]] = {
    "format": {
        "choices": config.TRAJECTORY_FORMATS,
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
        "choices": tuple(config.STAMP_UNITS),
        "help": "unit of the stamps. Default: recognised from their size",
    },
}

# Where the stamps of a bag's poses come from.
STAMPS = ("header", "receive")

_OF_FILES = (*FILE_OPTIONS, "pair_by", "stamps")
_OPTIONS = {*OPTION_FIELDS, *_OF_FILES, *(f"{one}_{name}" for one in STREAMS for name in _OF_FILES)}

# Names in backticks; and names that are no words of the language, such as max_gap and prior.z, or
# stand before a value, wherever they stand, but not in a path, after dashes or in quotes.
_NAMES = re.compile(
    r"`([\w.]+)`|(?<![\w./\\='-])([a-z]+(?:[._]+[a-z]+)+|scale(?= (?:none|auto|estimate\b|\d)))"
    r"(?![\w/=-]|\.\w)( VALUE)?"
)


# ------------------------------------------------------------ what commands print


class Exit(IntEnum):
    """Exit codes: failed or bad input; wrong usage; solved, but an axis is unobservable or the
    verdict is DO NOT USE; and what a shell reports for SIGINT and SIGPIPE.
    """

    GOOD = 0
    FAILED = 1
    USAGE = 2
    NOT_ALL = 3
    INTERRUPTED = 130
    BROKEN_PIPE = 141


# How a terminal shows the verdict that a line begins with: bold green, yellow, red.
_STYLES = {"USE": "\x1b[1;32m", "USE WITH CARE": "\x1b[1;33m", "DO NOT USE": "\x1b[1;31m"}


def flag(name: str) -> str:
    """The option of the command line for a public option name, without the leading dashes."""
    return name.replace(".", "-").replace("_", "-")


def typed_options(options: Iterable[tuple[str, object]]) -> str:
    """Options by their public names, as they are typed."""
    return " ".join(f"--{flag(name)} {value}" for name, value in options)


def as_typed(text: str) -> str:
    """A message of the engine with its option names, which are those of Python and the node, as
    they are typed: ``raise max_gap`` becomes ``raise --max-gap``.
    """

    def typed(match: re.Match[str]) -> str:
        name = match[1] or match[2]
        value = match[3] or ""
        if name in _OPTIONS and name.startswith("prior."):
            return f"--prior {name.removeprefix('prior.')}{value.replace(' ', '=')}"
        return f"--{flag(name)}{value}" if name in _OPTIONS else match[0]

    return _NAMES.sub(typed, text)


def note(*texts: object) -> None:
    """Print what is good to know, each in one line."""
    for text in texts:
        print(f"hand_eye_calib: note: {printable(as_typed(str(text)))}", file=sys.stderr)


def fail(error: object, code: int = Exit.FAILED) -> int:
    """Print in one line what went wrong; returns ``code``."""
    print(f"hand_eye_calib: error: {printable(as_typed(str(error)))}", file=sys.stderr)
    return code


@contextmanager
def waiting_for(what: str) -> Iterator[None]:
    """On a terminal, show what is being done for as long as it lasts."""
    is_watched = sys.stderr.isatty()
    print(f"{what} ..." * is_watched, end="", file=sys.stderr, flush=True)
    try:
        yield
    finally:
        print("\r\x1b[K" * is_watched, end="", file=sys.stderr, flush=True)


def with_progress(
    items: Iterable[_Item],
    total: int | None,
    doing: str,
    size: Callable[[_Item], int] = lambda item: 1,
) -> Iterator[_Item]:
    """Pass on items. On a terminal, show how much of the sum of their sizes is done and the time
    left.
    """
    if not sys.stderr.isatty():
        yield from items
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(doing, total=total)
        for item in items:
            yield item
            progress.advance(task, size(item))


def print_result(lines: Iterable[str], document: object = None) -> None:
    """Print what a command found: its document as JSON, if there is one; otherwise as text, on a
    terminal with the verdict that it begins with in its colour.
    """
    if document is None:
        text = "\n".join(map(printable, lines))
    else:
        from hand_eye_calib.core.base.plain import json_text

        text = json_text(document)
    verdict, colon, rest = text.partition(":")
    if sys.stdout.isatty() and verdict in _STYLES:
        text = f"{_STYLES[verdict]}{verdict}\x1b[0m{colon}{rest}"
    print(text, flush=True)


# ------------------------------------------------------------ the types of arguments


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
    # argparse takes -1e-3, -90deg+/-2deg and the like for options otherwise.
    parser._negative_number_matcher = re.compile(r"-\.?\d")
    group = parser.add_argument_group("calibration options")
    rare = parser.add_argument_group("calibration options that are rarely needed")
    rest = [name for name in OPTION_FIELDS if name not in _COMMON and "prior." not in name]
    for name in (*_COMMON, *rest):
        field = OPTION_FIELDS[name]
        meta = field.metadata
        unit = f" Unit: {meta['unit']}." if meta["unit"] else ""
        default = "" if field.default == "" else f" Default: {field.default}."
        value = "|".join([*meta["words"], flag(name).rpartition("-")[2].upper()])
        (group if name in _COMMON else rare).add_argument(
            f"--{flag(name)}",
            dest="options",
            action="append",
            default=[],
            type=argument_type(partial(_named, name), f"{name} "),
            metavar=f"{{{','.join(meta['choices'])}}}" if meta["choices"] else value,
            help=f"{meta['doc']}{unit}{default}".replace("%", "%%"),
        )
    add = group.add_argument
    metavar = "AXIS=VALUE+/-SIGMA"
    prior = (
        "what is known of an axis beforehand, such as z=1.85+/-0.02 (m) or yaw=-90deg+/-2deg; AXIS "
        f"is one of {_AXES}; may be repeated"
    )
    add("--prior", metavar=metavar, dest="options", action="append", type=_prior, help=prior)
    file = "YAML file with these options by name, or a ROS parameter file"
    add("--config", metavar="FILE", type=Path, help=file)


@argument_type
def _prior(text: str) -> tuple[str, OptionValue]:
    axis, equals, value = text.partition("=")
    name = f"prior.{axis}"
    if not equals or name not in OPTION_FIELDS:
        raise ConfigError(f"expected AXIS=VALUE+/-SIGMA with AXIS one of {_AXES}; got {text!r}")
    return _named(name, value)


def _named(name: str, value: object) -> tuple[str, OptionValue]:
    """An option and its value, from text or as YAML has it; lengths and angles may name a unit."""
    field = OPTION_FIELDS[name]
    kind = type(field.default)
    unit = field.metadata["unit"]
    if isinstance(value, str) and kind in (int, float):
        if unit in ("m", "rad"):
            return name, check_value(field, *quantities(name, [unit], [value], ""))
        with suppress(ValueError):  # check_value says what it should be
            value = kind(value)
    return name, check_value(field, value)


def options_from(arguments: argparse.Namespace) -> Options:
    """The options that were set, by their public names: the command line before the file, of which
    a ConfigError says what does not exist or cannot be.
    """
    of_file = _read_config(arguments.config) if arguments.config else {}
    return {**of_file, **dict(arguments.options)}


def _read_config(path: Path) -> Options:
    """Options of a file: plain names and values, or what a ROS parameter file has for the node."""
    from hand_eye_calib.formats.yaml_files import read_yaml

    document = read_yaml(path)
    if not isinstance(document, dict | None):
        found = type(document).__name__
        raise ConfigError(f"{path}: expected a mapping of options to values; found {found}")
    options: dict[str, OptionValue] = {}
    ignored = []
    of_others = []
    for name, value in _flat(document or {}):
        node, is_of_ros, option = name.rpartition(f"{_OF_ROS}.")
        if is_of_ros and re.split("[./]", node.rstrip("."))[-1] not in _NODES:
            of_others.append(f"/{node.strip('/.')}")
        elif option in OPTION_FIELDS:
            try:
                options |= [_named(option, value)]
            except ConfigError as error:
                # In quotes it keeps the spelling of the file.
                text = str(error).replace(option, repr(option), 1)
                raise ConfigError(f"{path}: {text}") from None
        elif option in _NODE_OPTIONS or option.partition(".")[0] in _ROS_OPTIONS:
            ignored.append(repr(option))
        elif value is not None or not option.endswith(_OF_ROS):
            known = sorted(OPTION_FIELDS)
            raise ConfigError(
                f"{path}: unknown option {option!r}{did_you_mean(option, known)}; "
                f"known are {', '.join(map(repr, known))}"
            )
    if of_others and not (options or ignored):
        found = ", ".join(dict.fromkeys(of_others))
        raise ConfigError(
            f"{path}: no parameters for a node named calibrator; found some for {found}"
        )
    if ignored:
        note(f"{path}: only the node uses {', '.join(ignored)}; ignored here")
    return options


def _flat(mapping: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Nested mappings as dotted names and values."""
    for name, value in mapping.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


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
        topic = (
            f"poses of the {stream} sensor, of any type; FIX+IMU of two topics; or from /tf and "
            "/tf_static: fixed frame and the sensor's, as odom:lidar"
        )
        group.add_argument(f"--{stream}-topic", metavar="TOPIC", help=topic)
        fields = (
            f"where the poses are in messages of any type on --{stream}-topic: "
            "t=header.stamp,x=pose.position.x,..."
        )
        group.add_argument(f"--{stream}-fields", metavar="NAME=PATH,...", help=fields)
    of_stamps = (
        "stamps of the poses: of their headers, or the times at which the recorder received them, "
        "for headers without. Default: header"
    )
    group.add_argument("--stamps", choices=STAMPS, help=of_stamps)
    for stream in STREAMS:
        same = f"the same for the {stream} only"
        group.add_argument(f"--{stream}-stamps", choices=STAMPS, help=same)
    group = parser.add_argument_group(
        "trajectory files", "each also as --parent-... and --child-... for one of the two files"
    )
    for name, settings in FILE_OPTIONS.items():
        group.add_argument(f"--{flag(name)}", dest=name, **settings)
        for stream in STREAMS:
            of_one = settings | {"help": f"the same for {stream.upper()} only"}
            group.add_argument(f"--{stream}-{flag(name)}", dest=f"{stream}_{name}", **of_one)
    pair_by = (
        "time: by the stamps; row: poses without stamps, in their order; name: poses of images of "
        "the same name. For both files"
    )
    group.add_argument("--pair-by", choices=config.PAIR_BY, help=pair_by)


def sources_from(arguments: argparse.Namespace) -> dict[str, str]:
    """Topic or frames, WORLD:SENSOR, of "parent" and "child", and where their stamps come from,
    "parent_stamps" and "child_stamps", if they are given.
    """
    found = {}
    for stream in STREAMS:
        topic, fields = (getattr(arguments, f"{stream}_{kind}") for kind in ("topic", "fields"))
        if fields and not topic:
            raise ConfigError(f"--{stream}-fields is for messages; give --{stream}-topic as well")
        if stream == "child" and topic and getattr(arguments, "target", None):
            fields = "@".join(map(str, filter(None, [arguments.target, arguments.camera])))
        found[stream] = f"{topic}?{fields}" if fields else topic
        found[f"{stream}_stamps"] = getattr(arguments, f"{stream}_stamps") or arguments.stamps
    return {stream: source for stream, source in found.items() if source}


def refuse_stamps(arguments: argparse.Namespace) -> None:
    """Raise ConfigError for the times of receipt of what is no bag."""
    names = ("stamps", *(f"{stream}_stamps" for stream in STREAMS))
    given = [name for name in names if getattr(arguments, name, None)]
    if given:
        raise ConfigError(
            f"--{flag(given[0])} is for bags; trajectory files have one kind of stamps"
        )


def add_json_argument(parser: argparse._ActionsContainer, or_verbose: bool = False) -> None:
    """Add ``--json``, and ``--verbose`` if there are details to print."""
    text = "print one JSON document on stdout instead of text"
    parser.add_argument("--json", action="store_true", help=text)
    if or_verbose:
        text = "print details of the solution, too"
        parser.add_argument("-v", "--verbose", action="store_true", help=text)


def _path(text: str) -> Path | str:
    """A path, sample:NAME of the recording that comes with the package; a URL stays as it is, for
    a path has no two slashes in a row.
    """
    if text.startswith("sample:"):
        return Path(__file__).parents[2] / "sample" / text.removeprefix("sample:")
    return text if "://" in text else Path(text)
