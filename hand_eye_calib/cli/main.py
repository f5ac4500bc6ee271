"""``hand_eye_calib COMMAND``: find the command, run it, turn errors into one line and an exit code.

A command is a module with ``add_arguments(parser)`` and ``run(arguments) -> int``. It is imported
when it is asked for, so that a missing optional package breaks no other command.
"""

import argparse
import importlib
import os
import sys
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

from hand_eye_calib.cli import completion
from hand_eye_calib.cli.console import fail
from hand_eye_calib.cli.parser import EXIT_USAGE, CommandParser
from hand_eye_calib.errors import ConfigError, HandEyeCalibError

EXIT_FAILED = 1
EXIT_INTERRUPTED = 128 + 2  # what a shell reports for SIGINT and SIGPIPE
EXIT_BROKEN_PIPE = 128 + 13

COMMANDS = {
    "replay": "calibrate from the poses in a bag",
    "calibrate": "calibrate from two trajectory files",
    "check": "check two pose streams before any solve",
    "calibrator": "run the ROS 2 node",
    "watch": "show the live node on the terminal, or in a browser",
    "compare": "compare results with what is installed, or with each other",
    "info": "show a saved result",
    "simulate": "simulate trajectories or a bag with known truth",
    "completion": "print what a shell needs to complete commands and options",
    "demo": "simulate a recording and calibrate from it, offline and live",
}

_EPILOG = """\
examples:
  hand_eye_calib replay my_bag --out result   calibrate from a bag, with report.html
  hand_eye_calib check my_bag                 check both pose streams first
  hand_eye_calib COMMAND --help               options and examples of a command

exit codes: 0 good, 1 bad input or failed, 2 wrong usage, 3 solved but something is
unobservable or the verdict is DO NOT USE"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code.

    Parameters
    ----------
    argv : list of str, optional
        Arguments after the program's name; by default those of the process.

    Returns
    -------
    int
        0 good; 1 bad input or failed; 2 wrong usage; 3 solved, but something is unobservable or the
        verdict is DO NOT USE; 130 interrupted.

    Raises
    ------
    SystemExit
        From argparse: code 2 for wrong usage, 0 after ``--help``.
    """
    return exit_code_of(lambda: _run(sys.argv[1:] if argv is None else argv))


def exit_code_of(run: Callable[[], int]) -> int:
    """What ``run()`` returns; an error that a person can act on becomes one line on stderr and an
    exit code.
    """
    # The matrices are small. Several threads would wait for each other, and take three times as
    # long if other programs run.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    try:
        code = run()
        sys.stdout.flush()
        return code
    except ConfigError as error:
        return fail(error, EXIT_USAGE)
    except HandEyeCalibError as error:
        return fail(error, EXIT_FAILED)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] == "hand_eye_calib":
            raise
        return fail(
            f"this needs the Python package {error.name!r}, which is not installed; install it and "
            "try again",
            EXIT_FAILED,
        )
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        _discard_stdout()
        return EXIT_BROKEN_PIPE


def named_command() -> int:
    """Entry point of the executables that are called like a command, as in ``ros2 run
    hand_eye_calib replay BAG``.
    """
    return main([Path(sys.argv[0]).stem, *sys.argv[1:]])


def _run(argv: Sequence[str]) -> int:
    if completion.is_asked_for():
        return _complete()
    chosen = next((argument for argument in argv if not argument.startswith("-")), None)
    # The other commands matter only if the first word is none, but --help, say.
    parser, of_commands = _parsers(COMMANDS.keys() & argv[:1] or COMMANDS)
    module: Any = None
    if chosen in of_commands:
        module, command_parser = _with_arguments(chosen, of_commands)
        if command_parser.get_default("passed_on") is None:
            command_parser.refuse_unknown(argv[list(argv).index(chosen) + 1 :])
    arguments, rest = parser.parse_known_args(argv)
    if rest and not hasattr(arguments, "passed_on"):
        of_commands[arguments.command].refuse(rest[0])
    arguments.passed_on = rest
    arguments.typed = list(argv)
    return module.run(arguments)


def _complete() -> int:
    """Tell the shell what could be typed next."""
    parser, of_commands = _parsers(COMMANDS)
    chosen = completion.command_in_line()
    if chosen in of_commands:
        _with_arguments(chosen, of_commands)
    completion.answer(parser)
    return 0


def _with_arguments(
    chosen: str, of_commands: dict[str, CommandParser]
) -> tuple[Any, CommandParser]:
    """The module of a command, and its parser with all arguments."""
    module = importlib.import_module(f"hand_eye_calib.cli.{chosen}")
    command_parser = of_commands[chosen]
    module.add_arguments(command_parser)
    command_parser.add_help_all()
    return module, command_parser


def _parsers(names: Collection[str]) -> tuple[CommandParser, dict[str, CommandParser]]:
    """The parser of the program, and those of these commands by name, still without arguments."""
    parser = CommandParser(
        prog="hand_eye_calib",
        description="Extrinsic calibration of two sensors on one rigid body from their motion.",
        epilog=_EPILOG,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    return parser, {
        name: commands.add_parser(
            name, help=summary, description=summary, prog=f"hand_eye_calib {name}"
        )
        for name, summary in COMMANDS.items()
        if name in names
    }


class _Version(argparse.Action):
    """Look the version up only if it is asked for: that takes time."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from hand_eye_calib.version import package_version

        print(f"hand_eye_calib {package_version()}")
        parser.exit()


def _discard_stdout() -> None:
    """Keep the interpreter from complaining when it flushes at exit: the reader has gone."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
