"""``hand_eye_calib COMMAND``: run a command, and turn errors into one line and an exit code.

A command is a module with ``add_arguments(parser)`` and ``run(arguments) -> int``. Only the module
of the requested command is imported. So a missing optional package disables no other command.
"""

import argparse
import os
import re
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

from hand_eye_calib.core.base.errors import (
    ConfigError,
    HandEyeCalibError,
    InputError,
    UnclearStreamsError,
    installing,
)
from hand_eye_calib.core.base.option import did_you_mean
from hand_eye_calib.core.base.registry import COMMANDS
from hand_eye_calib.core.base.text import listing, shown_value
from hand_eye_calib.formats.files import limit_memory
from hand_eye_calib.offline.cli.options import (
    Exit,
    as_typed,
    command_with,
    fail,
)
from hand_eye_calib.offline.cli.paths import calibrating, misplaced

_EPILOG = """\
examples:
  hand_eye_calib calibrate lidar.tum camera.tum  calibrate from two trajectory files
  hand_eye_calib calibrate my_bag --out result   calibrate from a bag, with report.html
  hand_eye_calib COMMAND --help                  a command in short; --help all: every option

exit codes: 0 good, 1 bad input, not converged or a prior contradicted, 2 wrong usage, 3 solved
but an axis is unobservable or the verdict is DO NOT USE, 4 compare, batch: the sensor has moved,
130 interrupted"""

# Endings of the names of Python packages that belong to ROS 2.
_ROS_SUFFIXES = ("rclpy", "_msgs", "_srvs", "_interfaces", "tf2_ros")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; print the help if the arguments contain no command.

    Parameters
    ----------
    argv : list of str, optional
        Arguments after the program's name; by default those of the process.

    Returns
    -------
    int
        The exit code: 0 good; 1 bad input, not converged or a prior contradicted; 2 wrong usage; 3
        solved, but an axis is unobservable or the verdict is DO NOT USE; 4 moved; 130
        interrupted.

    Raises
    ------
    SystemExit
        From argparse: code 2 for wrong usage, 0 after ``--help``.
    """
    words = sys.argv[1:] if argv is None else argv
    return exit_code_of(lambda: _run(words))


def exit_code_of(run: Callable[[], int]) -> int:
    """Run a function that returns an exit code, and return this code.

    If the function raises an error that the user can correct, the error is printed in one line on
    stderr, and its exit code is returned.
    """
    # Linear algebra uses one thread. The matrices are small, so threads would wait for each other,
    # and take three times as long on a busy processor.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    limit_memory()
    try:
        code = run()
        sys.stdout.flush()
        return code
    except HandEyeCalibError as error:
        return fail(
            error, Exit.USAGE if isinstance(error, ConfigError) else Exit.FAILED
        )
    except ModuleNotFoundError as error:
        name = error.name or "hand_eye_calib"
        package = name.partition(".")[0]
        if package == "hand_eye_calib":
            raise
        text = f"this needs the Python package {name!r}, which is not installed; install it"
        if package.endswith(_ROS_SUFFIXES):
            text = (
                f"this needs ROS 2's Python packages ({name} is missing): source the setup file of "
                f"a ROS 2 installation, or {installing('ros')}"
            )
        return fail(text)
    except BrokenPipeError:
        # The program that reads stdout has closed it. Replace stdout; otherwise the interpreter
        # raises another error when it flushes stdout at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return Exit.BROKEN_PIPE
    except OSError as error:
        if error.filename is None:
            raise
        name = shown_value(error.filename)
        return fail(f"cannot use {name}: {error.strerror}; choose another path")
    except KeyboardInterrupt:
        return Exit.INTERRUPTED


def named_command() -> int:
    """Run the command that is the name of the executable.

    ``ros2 run hand_eye_calib replay`` calls the executable ``replay``.
    """
    executable, *words = sys.argv
    return main([Path(executable).stem, *words])


# Message of argparse about a value that is not an allowed choice.
_WRONG_CHOICE = re.compile(r"invalid choice: '([^']*)' \(choose from (.*)\)$")


class CommandParser(argparse.ArgumentParser):
    """Parser whose errors are one line on stderr, with exit code 2."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
            **settings,
        )

    def error(self, message: str) -> NoReturn:
        """Print one line on stderr and exit with code 2."""
        hint = ""
        if wrong := _WRONG_CHOICE.search(message):
            hint = did_you_mean(wrong[1], re.findall(r"[\w-]+", wrong[2]))
        text = as_typed(f"{message}{hint} (see {self.prog} --help)")
        self.exit(Exit.USAGE, f"hand_eye_calib: error: {text}\n")


class _ShowHelp(argparse.Action):
    """Action of ``--help``: print the help of a command.

    A command with many options has a short help that fits on a screen. It is the default ``brief``
    of the parser. ``--help all`` prints all options.
    """

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> NoReturn:
        """Print the help and exit with code 0."""
        brief = parser.get_default("brief")
        if brief and values is None:
            print(f"{parser.format_usage()}\n{parser.description}\n\n{brief}\n")
            print(f"all options: {parser.prog} --help all")
        else:
            parser.print_help()
        parser.exit()


def _unknown_command(word: str, argv: Sequence[str]) -> str:
    """Return the message about a first word that is no command."""
    if word == "help":
        return "write hand_eye_calib COMMAND --help"
    if word == "version":
        return "write hand_eye_calib --version"
    if line := calibrating(argv):
        return f"{word!r} is a path; put a command before it: {line}"
    known = ", ".join(COMMANDS)
    hint = did_you_mean(word, COMMANDS)
    return f"invalid choice: {word!r}, expected one of {known}{hint}"


def _run(argv: Sequence[str]) -> int:
    """Parse the arguments, and run the command."""
    command = next((word for word in argv if not word.startswith("-")), None)
    parser = CommandParser(
        prog="hand_eye_calib",
        usage="%(prog)s [--help] [--version] COMMAND ...",
        description=_description(),
        epilog=_EPILOG,
    )
    parser.add_argument(
        "--version", action="store_true", help="show the version and exit"
    )
    if command is not None and command not in COMMANDS:
        parser.error(_unknown_command(command, argv))
    parsers = _add_commands(parser)
    if command is not None:
        module = COMMANDS[command].load()
        parsers[command].description = COMMANDS[command].help
        module.add_arguments(parsers[command])
        _refuse_repeated(parsers[command], argv)
    arguments, rest = parser.parse_known_args(argv)
    if rest and command != "calibrator":
        flags = [word for word in argv if word.startswith("-")]
        if message := misplaced(arguments.command, rest, flags):
            parsers[arguments.command].error(message)
        _refuse(rest, parsers.get(command or "", parser))
    if arguments.version:
        from hand_eye_calib.core.base.version import version_of

        print(f"hand_eye_calib {version_of()}")
    elif command is None:
        parser.print_help()
    else:
        arguments.passed_on = rest
        arguments.typed = list(argv)
        return _run_command(module, arguments)
    return 0


def _run_command(module: Any, arguments: argparse.Namespace) -> int:
    """Run a command.

    If the streams of a bag are unclear, the error ends with a command that names the streams.
    """
    try:
        return int(module.run(arguments))
    except UnclearStreamsError as error:
        if not error.options:
            raise
        command = command_with(arguments.typed, error.options)
        raise InputError(f"{error}. Run: {command}") from None


def _description() -> str:
    """Return the purpose of the program, and a line for each command."""
    lines = [
        "Extrinsic calibration of two sensors on one rigid body from their motion.",
        "",
    ]
    lines.append("commands:")
    lines += [
        f"  {name:<12}{command.help}" for name, command in COMMANDS.items()
    ]
    return "\n".join(lines)


def _add_commands(
    parser: argparse.ArgumentParser,
) -> dict[str, argparse.ArgumentParser]:
    """Add all commands to a parser, and return their parsers by name."""
    # Without ``prog``, the usage of each command would begin with the usage of the program.
    commands = parser.add_subparsers(
        dest="command",
        metavar="COMMAND",
        prog=parser.prog,
        help=argparse.SUPPRESS,
    )
    parsers = {}
    for name in COMMANDS:
        parsers[name] = commands.add_parser(name, add_help=False)
        parsers[name].add_argument(
            "-h",
            "--help",
            nargs="?",
            choices=("all",),
            metavar="all",
            action=_ShowHelp,
            help="print the help and exit; all: with every option",
        )
    return parsers


def _refuse(rest: Sequence[str], parser: argparse.ArgumentParser) -> NoReturn:
    """Exit with an error about the first unknown option, or about the first unused argument."""
    options = [word for word in rest if word.startswith("-")]
    first, *_ = [*options, *rest]
    option, _, _ = first.partition("=")
    owners = _commands_with(option) if options else {}
    if owners:
        parser.error(_option_of(owners, rest[rest.index(first) :]))
    if option in ("--parent", "--child", "--parent-file", "--child-file"):
        parser.error(
            f"unknown {option!r}: give both files without options, the parent first: "
            "hand_eye_calib calibrate PARENT CHILD"
        )
    # Compare the names without dashes, which would make short names similar.
    known = [name.lstrip("-") for name in parser._option_string_actions]
    word = _SHORT_NAMES.get(option, option).lstrip("-")
    similar = did_you_mean(word, known) if options else ""
    hint = re.sub(r"(mean|or) (?=\w)", r"\1 --", similar)
    parser.error(f"unknown {option!r}{hint}")


# Options of other programs, and the options here with the same purpose.
_SHORT_NAMES = {"-o": "--out", "--topic": "--parent-topic"}


def _commands_with(option: str) -> dict[str, argparse.ArgumentParser]:
    """Return the parsers of the commands that have an option, by the command's name.

    If the short help or the own examples of some of these commands contain the option, only these
    commands are returned.
    """
    owners: dict[str, argparse.ArgumentParser] = {}
    for name, command in COMMANDS.items():
        parser: argparse.ArgumentParser = CommandParser(
            prog=f"hand_eye_calib {name}"
        )
        with suppress(ImportError):
            command.load().add_arguments(parser)
        if option in parser._option_string_actions and option != "-h":
            owners[name] = parser
    typical = {}
    for name, parser in owners.items():
        short_help = f"{parser.get_default('brief')}\n{parser.epilog}"
        for line in map(str.strip, short_help.splitlines()):
            is_own = line.startswith(("--", f"{parser.prog} "))
            if is_own and option in line.replace(",", " ").split():
                typical[name] = parser
    return typical or owners


def _refuse_repeated(
    parser: argparse.ArgumentParser, words: Sequence[str]
) -> None:
    """Exit with an error if an option that takes a value is given twice.

    argparse would keep the last value and ignore the others. Exceptions are ``--prior``, once for
    each axis, and options that collect values, such as ``--label``.
    """
    actions = parser._option_string_actions
    names = []
    for word, following in zip(words, [*words[1:], ""], strict=True):
        if word == "--":
            break
        option, equals, value = word.partition("=")
        action = actions.get(option)
        is_single = action is not None and action.nargs != 0
        if not is_single or isinstance(action, argparse._ExtendAction):
            continue
        name = option
        if option == "--prior":
            axis, _, _ = (value if equals else following).partition("=")
            name = f"{option} {axis}"
        names.append(name)
    for name in names:
        if names.count(name) > 1:
            parser.error(f"{name} was given twice; keep one")


def _option_of(
    owners: Mapping[str, argparse.ArgumentParser], words: Sequence[str]
) -> str:
    """Return the message about an option of other commands, with the usage of one of them.

    ``words`` has the option as typed, and the arguments after it.
    """
    first, *others = words
    option, equals, _ = first.partition("=")
    parser = next(iter(owners.values()))
    typed = [first]
    if not equals and parser._option_string_actions[option].nargs != 0:
        typed += others[:1]
    usage = (parser.usage or "%(prog)s") % {"prog": parser.prog}
    usage = usage.replace("[OPTION ...] ", "")
    return f"{option} is an option of {listing([*owners])}: {usage} {shlex.join(typed)}"
