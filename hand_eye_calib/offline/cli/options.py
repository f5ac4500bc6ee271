"""Arguments of the commands, and what the commands print: notes, errors, progress and results.

The options of the engine are declared once, as the fields of CalibratorConfig. From these fields
this module makes the options of the command line. All other arguments concern the input and the
output.

To make ``--help`` fast, this module imports only the standard library.
"""

import argparse
import itertools
import re
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from enum import IntEnum
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import hand_eye_calib.core.base.config as config
from hand_eye_calib.core.base.errors import ConfigError, InputError, printable
from hand_eye_calib.core.base.option import Options, OptionValue, check_value
from hand_eye_calib.core.base.spelling import (
    Interface,
    spelled,
    spelled_options,
)
from hand_eye_calib.core.base.text import quantities
from hand_eye_calib.formats.files import local_path

_Item = TypeVar("_Item")

STREAMS = ("parent", "child")
OPTION_FIELDS = config.CalibratorConfig.by_name()

_AXES = ", ".join(
    name.removeprefix("prior.") for name in OPTION_FIELDS if "prior." in name
)

# Options that most users set. They form the first group of the help.
_COMMON = (
    "method",
    "reference",
    "time_offset",
    "scale",
    "parent_frame",
    "child_frame",
)

# File formats in which a saved result can be printed.
RESULT_FORMATS = (*config.ROBOT_FORMATS, *config.EXPORT_FORMATS)

# Options to read a trajectory file, with their arguments for argparse.
FILE_OPTIONS: dict[str, dict[str, Any]] = {
    "format": {
        "choices": config.TRAJECTORY_FORMATS,
        "help": "tum: t x y z qx qy qz qw; kitti: 12 numbers, with --times; "
        "euroc: ns, qw first; csv: columns by the names in the "
        "header, or with --columns: positions as x y z or lat lon "
        "height, orientations as quaternion, roll pitch yaw or "
        "heading. Default: recognised from the content",
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

# Stamps of a bag's poses: from the messages' headers, or the times at which the recorder received
# the messages.
STAMPS = ("header", "receive")

# Names of input options that appear in the messages of readers.
_INPUT_OPTIONS = (*FILE_OPTIONS, "pair_by", "stamps")
_OPTIONS_OF_READERS = {
    *_INPUT_OPTIONS,
    *("start", "end"),
    *(f"{stream}_{name}" for stream in STREAMS for name in _INPUT_OPTIONS),
}


# ------------------------------------------------------------ what commands print


class Exit(IntEnum):
    """Exit codes of the commands.

    FAILED also means bad input. NOT_ALL means that the solve succeeded, but an axis is unobservable
    or the verdict is DO NOT USE. MOVED means that results differ. A shell reports INTERRUPTED after
    SIGINT and BROKEN_PIPE after SIGPIPE.
    """

    GOOD = 0
    FAILED = 1
    USAGE = 2
    NOT_ALL = 3
    MOVED = 4
    INTERRUPTED = 130
    BROKEN_PIPE = 141


# Terminal styles of a verdict: bold green, bold yellow, bold red.
_STYLES = {
    "USE": "\x1b[1;32m",
    "USE WITH CARE": "\x1b[1;33m",
    "DO NOT USE": "\x1b[1;31m",
}


def flag(name: str) -> str:
    """Return the command line's name of a public option, without the leading dashes."""
    return name.replace(".", "-").replace("_", "-")


def typed_options(options: Iterable[tuple[str, object]]) -> str:
    """Return pairs of public option name and value as a user types them on the command line."""
    return spelled_options(options, Interface.TERMINAL)


def command_with(typed: Sequence[str], options: Options) -> str:
    """Return a command with further options, which replace its own values of these options.

    Parameters
    ----------
    typed : sequence of str
        Arguments of the command, without the name of the program.
    options : mapping
        Further options by their public names, and their values.
    """
    # Name, space and value of each further option, as typed.
    added = [typed_options([pair]).partition(" ") for pair in options.items()]
    replaced = {_flag_with_axis(name, value) for name, _, value in added}
    kept = []
    tokens = [*typed]
    while tokens:
        token = tokens.pop(0)
        name, equals, value = token.partition("=")
        value = value if equals else next(iter(tokens), "")
        if _flag_with_axis(name, value) not in replaced:
            kept.append(token)
        elif not equals:
            tokens = tokens[1:]
    return f"{shlex.join(['hand_eye_calib', *kept])} {typed_options(options.items())}"


def not_typed(typed: Sequence[str], options: Options) -> Options:
    """Return the options that a command does not set to these values yet.

    Parameters
    ----------
    typed : sequence of str
        Arguments of the command, without the name of the program.
    options : mapping
        Options by their public names, and their values.
    """
    pairs = [*itertools.pairwise(typed)]
    missing = {}
    for name, value in options.items():
        flag_name, text = shlex.split(typed_options([(name, value)]))
        is_typed = f"{flag_name}={text}" in typed or (flag_name, text) in pairs
        if not is_typed:
            missing[name] = value
    return missing


def _flag_with_axis(name: str, value: str) -> tuple[str, str]:
    """Return the name of a typed option; for a prior, which may be repeated, with its axis."""
    return name, value.partition("=")[0] if name == "--prior" else ""


def as_typed(text: str) -> str:
    """Return a message of the engine with option names as typed on the command line.

    Messages of the engine contain public option names: ``raise max_gap`` becomes ``raise
    --max-gap``.
    """
    return spelled(text, Interface.TERMINAL, _OPTIONS_OF_READERS)


def note(*texts: object) -> None:
    """Print each text as a note to the user, in one line on stderr."""
    for text in texts:
        print(
            f"hand_eye_calib: note: {printable(as_typed(str(text)))}",
            file=sys.stderr,
        )


def fail(error: object, code: int = Exit.FAILED) -> int:
    """Print an error in one line on stderr, and return ``code``."""
    print(
        f"hand_eye_calib: error: {printable(as_typed(str(error)))}",
        file=sys.stderr,
    )
    return code


@contextmanager
def waiting_for(activity: str) -> Iterator[None]:
    """Display the activity while the block runs, if stderr is a terminal."""
    if not sys.stderr.isatty():
        yield
        return
    print(f"{activity} ...", end="", file=sys.stderr, flush=True)
    try:
        yield
    finally:
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)


def with_progress(
    items: Iterable[_Item],
    total: int | None,
    doing: str,
    size: Callable[[_Item], int] = lambda item: 1,
) -> Iterator[_Item]:
    """Yield items. On a terminal, display the progress and the time left.

    Parameters
    ----------
    items : iterable
    total : int or None
        Sum of the sizes of all items; None if unknown.
    doing : str
        Activity to display.
    size : callable
        Function that returns the size of an item, such as its number of bytes. Default: 1 for every
        item.
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
    """Print a result on stdout: the document as JSON if there is one, otherwise the lines.

    On a terminal, a verdict at the start of the lines is coloured.
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


def argument_type(
    parse: Callable[[str], Any], prefix: str = ""
) -> Callable[[str], Any]:
    """Return a function that argparse can use as the type of an argument.

    A ConfigError of ``parse`` becomes an error about wrong usage. ``prefix``, such as the name of
    the option, is removed from the message, because argparse adds the name.
    """

    def parsed(text: str) -> Any:
        try:
            return parse(text)
        except ConfigError as error:
            raise argparse.ArgumentTypeError(
                str(error).removeprefix(prefix)
            ) from None

    return parsed


def at_least(minimum: int) -> Callable[[str], int]:
    """Return the type of an argument that is a whole number of at least ``minimum``."""

    def parse(text: str) -> int:
        if not text.isdecimal() or int(text) < minimum:
            raise ConfigError(
                f"expected a whole number of at least {minimum}, got {text!r}"
            )
        return int(text)

    return argument_type(parse)


# ------------------------------------------------------- options of the engine


def add_config_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--config`` and an option for every field of CalibratorConfig."""
    # A word that begins with a minus and a digit is a value, such as -1e-3 or -90deg+/-2deg.
    parser._negative_number_matcher = re.compile(r"-\.?\d")
    group = parser.add_argument_group("calibration options")
    rare = parser.add_argument_group(
        "calibration options that are rarely needed"
    )
    rest = [
        name
        for name in OPTION_FIELDS
        if name not in _COMMON and "prior." not in name
    ]
    for name in (*_COMMON, *rest):
        field = OPTION_FIELDS[name]
        meta = field.metadata
        unit = f" Unit: {meta['unit']}." if meta["unit"] else ""
        if meta["unit"] == "rad":
            unit = " Unit: rad, or typed as in 0.3deg."
        default = "" if field.default == "" else f" Default: {field.default}."
        if meta["choices"]:
            metavar = f"{{{','.join(meta['choices'])}}}"
        else:
            last_word = flag(name).rpartition("-")[2].upper()
            metavar = "|".join([*meta["words"], last_word])
        owner = group if name in _COMMON else rare
        owner.add_argument(
            f"--{flag(name)}",
            dest="options",
            action="append",
            default=[],
            type=argument_type(partial(checked_option, name), f"{name} "),
            metavar=metavar,
            help=f"{meta['doc']}{unit}{default}".replace("%", "%%"),
        )
    add = group.add_argument
    metavar = "AXIS=VALUE+/-SIGMA"
    prior = (
        "value of an axis from another measurement, with its standard "
        "deviation, such as z=1.85+/-0.02 (m) or yaw=-90deg+/-2deg; AXIS is "
        f"one of {_AXES}; may be repeated"
    )
    add(
        "--prior",
        metavar=metavar,
        dest="options",
        action="append",
        type=_prior,
        help=prior,
    )
    file = "YAML file with these options by name, or a ROS parameter file"
    add("--config", metavar="FILE", type=Path, help=file)


@argument_type
def _prior(text: str) -> tuple[str, OptionValue]:
    """Return the option of a prior and its checked value, from ``AXIS=VALUE+/-SIGMA``."""
    axis, equals, value = text.partition("=")
    name = f"prior.{axis}"
    if not equals or name not in OPTION_FIELDS:
        raise ConfigError(
            f"expected AXIS=VALUE+/-SIGMA with AXIS one of {_AXES}; got {text!r}"
        )
    return checked_option(name, value)


def checked_option(name: str, value: object) -> tuple[str, OptionValue]:
    """Return the name of an option and its checked value, from a text or from YAML.

    In a text, lengths and angles may have a unit, such as ``5cm``.

    Raises
    ------
    ConfigError
        If the value is of the wrong type or out of range.
    """
    field = OPTION_FIELDS[name]
    kind = type(field.default)
    unit = field.metadata["unit"]
    if isinstance(value, str) and kind in (int, float):
        if unit in ("m", "rad"):
            return name, check_value(
                field, *quantities(name, [unit], [value], "")
            )
        # If the text is not a number, check_value below reports the expected form.
        with suppress(ValueError):
            value = kind(value)
    checked = check_value(field, value)
    if name.endswith("_frame") and len(str(checked).split()) > 1:
        proposed = "_".join(str(checked).split())
        note(
            f"the frame name {checked!r} contains a space; {proposed!r} may be meant"
        )
    return name, checked


# -------------------------------------------------- what is read, what is written


def add_input_arguments(
    parser: argparse.ArgumentParser, help_of_paths: str
) -> None:
    """Add the arguments about the input: paths, streams of a bag, and options of files."""
    parser.add_argument(
        "paths", metavar="PATH", nargs="*", type=_path, help=help_of_paths
    )
    group = parser.add_argument_group(
        "pose streams of a bag",
        "Odometry, PoseStamped, PoseWithCovarianceStamped, TransformStamped "
        "or Path; may be omitted if the bag has only two",
    )
    for stream in STREAMS:
        topic = (
            f"topic with poses of the {stream} sensor; FIX+IMU for two "
            "topics; or two frames of /tf and /tf_static as WORLD:SENSOR, "
            "such as odom:lidar"
        )
        group.add_argument(f"--{stream}-topic", metavar="TOPIC", help=topic)
        fields = (
            "fields of the poses in messages of any type on "
            f"--{stream}-topic: t=header.stamp,x=pose.position.x,..."
        )
        group.add_argument(
            f"--{stream}-fields", metavar="NAME=PATH,...", help=fields
        )
    help_of_stamps = (
        "origin of the stamps: the header, or the time at which the recorder "
        "received the message. Default: header"
    )
    group.add_argument("--stamps", choices=STAMPS, help=help_of_stamps)
    for stream in STREAMS:
        same = f"the same for the {stream} only"
        group.add_argument(f"--{stream}-stamps", choices=STAMPS, help=same)
    _add_times(parser)
    group = parser.add_argument_group(
        "trajectory files",
        "each option also exists as --parent-... and --child-... for one of the two files",
    )
    for name, settings in FILE_OPTIONS.items():
        group.add_argument(f"--{flag(name)}", dest=name, **settings)
        for stream in STREAMS:
            for_stream = settings | {
                "help": f"the same for {stream.upper()} only"
            }
            group.add_argument(
                f"--{stream}-{flag(name)}",
                dest=f"{stream}_{name}",
                **for_stream,
            )
    pair_by = (
        "pairing of the poses of both files: time, by their stamps; row, by "
        "their order, without stamps; name, by the names of their images"
    )
    group.add_argument("--pair-by", choices=config.PAIR_BY, help=pair_by)


def _add_times(parser: argparse.ArgumentParser) -> None:
    """Add the arguments about the part of the recording that is used."""
    group = parser.add_argument_group(
        "part of the recording",
        "seconds after its start, when all streams have poses; from 1e8 on, a stamp in seconds",
    )
    for name, verb in (("start", "before"), ("end", "after")):
        group.add_argument(
            f"--{name}",
            metavar="SECONDS",
            help=f"ignore poses {verb} this time",
        )


def sources_from(arguments: argparse.Namespace) -> dict[str, str]:
    """Return the sources of a bag's streams that the user has named.

    Returns
    -------
    dict of str to str
        "parent" and "child": topic, with fields or target after a question mark, or frames
        WORLD:SENSOR. "parent_stamps" and "child_stamps": one of ``STAMPS``. Keys that the user has
        not named are missing.

    Raises
    ------
    ConfigError
        If fields are named without a topic.
    """
    sources = {}
    for stream in STREAMS:
        topic = getattr(arguments, f"{stream}_topic")
        fields = getattr(arguments, f"{stream}_fields")
        if fields and not topic:
            raise ConfigError(f"--{stream}-fields needs --{stream}-topic")
        if stream == "child" and topic and getattr(arguments, "target", None):
            fields = "@".join(
                map(str, filter(None, [arguments.target, arguments.camera]))
            )
        sources[stream] = f"{topic}?{fields}" if fields else topic
        sources[f"{stream}_stamps"] = (
            getattr(arguments, f"{stream}_stamps") or arguments.stamps
        )
    return {name: source for name, source in sources.items() if source}


def refuse_options_of_bags(arguments: argparse.Namespace) -> None:
    """Raise a ConfigError if an option about topics or stamps is set for trajectory files."""
    of_streams = [
        f"{stream}_{name}"
        for stream in STREAMS
        for name in ("stamps", "topic", "fields")
    ]
    for name in ("stamps", *of_streams):
        if getattr(arguments, name, None):
            raise ConfigError(
                f"--{flag(name)} applies to bags only; omit it for trajectory files"
            )


def add_result_argument(parser: argparse.ArgumentParser) -> None:
    """Add the path of a saved result."""
    path = "extrinsic.yaml, or the directory that contains it"
    parser.add_argument("result", metavar="RESULT", help=path)


def add_json_argument(
    parser: argparse._ActionsContainer, or_verbose: bool = False
) -> None:
    """Add ``--json``, and ``--verbose`` if there are details to print."""
    text = "print one JSON document on stdout instead of text"
    parser.add_argument("--json", action="store_true", help=text)
    if or_verbose:
        text = "also print details of the solution"
        parser.add_argument("-v", "--verbose", action="store_true", help=text)


def _path(text: str) -> Path | str:
    """Return a path. A URL stays a text, because a Path would remove one of its two slashes."""
    if "://" in text:
        return text
    try:
        return local_path(text)
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
