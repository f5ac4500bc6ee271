"""``hand_eye_calib COMMAND``: finds the command, runs it, turns what went wrong into one line and
an exit code.

A command is a module with ``add_arguments(parser)`` and ``run(arguments) -> int``. It is imported
when it is asked for, so that an optional package which is missing breaks no other command.
"""

import argparse
import importlib
import os
import sys
from pathlib import Path

from hand_eye_calib.cli.console import fail
from hand_eye_calib.errors import ConfigError, HandEyeCalibError

EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_INTERRUPTED = 128 + 2  # what a shell reports for SIGINT and SIGPIPE
EXIT_BROKEN_PIPE = 128 + 13

COMMANDS = {
    "replay": "calibrate from the poses in a bag",
    "calibrate": "calibrate from two trajectory files",
    "check": "look for what is wrong with two streams",
    "calibrator": "run the ROS 2 node",
    "info": "show a saved result",
    "simulate": "make trajectories or a bag with known truth",
    "demo": "simulate a drive and calibrate it, offline and live",
}


def main(argv=None):
    """Run a command; returns the exit code.

    Parameters
    ----------
    argv : list of str, optional
        Arguments after the program's name; those of the process where it is left out.

    Returns
    -------
    int
        0 good; 1 bad input or failed; 2 wrong usage; 3 solved, but something is unobservable; 130
        interrupted.

    Raises
    ------
    SystemExit
        From argparse: code 2 for wrong usage, 0 after ``--help``.
    """
    return exit_code_of(lambda: _run(sys.argv[1:] if argv is None else argv))


def exit_code_of(run):
    """What ``run()`` returns; an error that a person can act on becomes one line on stderr and an
    exit code.
    """
    # The matrices are small: several threads only wait for each other, and three times as long
    # where other programs run.
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
            f"this needs the Python package {error.name!r}, which is not installed; install it and try again",
            EXIT_FAILED,
        )
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        _forget_stdout()
        return EXIT_BROKEN_PIPE


def named_command():
    """Entry point of the executables that are called like a command, as in ``ros2 run
    hand_eye_calib replay BAG``.
    """
    return main([Path(sys.argv[0]).stem, *sys.argv[1:]])


def _run(argv):
    chosen = next((argument for argument in argv if not argument.startswith("-")), None)
    parser = argparse.ArgumentParser(
        prog="hand_eye_calib",
        description="Extrinsic calibration of two sensors on one rigid body from their motion.",
        epilog="exit codes: 0 good, 1 bad input or failed, 2 wrong usage, 3 solved but something is unobservable",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, summary in COMMANDS.items():
        command_parser = commands.add_parser(
            name, help=summary, description=summary, allow_abbrev=False
        )
        if name == chosen:
            command = importlib.import_module(f"hand_eye_calib.cli.{name}")
            command.add_arguments(command_parser)
    arguments, rest = parser.parse_known_args(argv)
    if rest and not hasattr(arguments, "passed_on"):
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    arguments.passed_on = rest
    return command.run(arguments)


class _Version(argparse.Action):
    """argparse's own wants the version before it is asked for, and looking it up takes time."""

    def __call__(self, parser, *_):
        from hand_eye_calib import __version__

        print(f"hand_eye_calib {__version__}")
        parser.exit()


def _forget_stdout():
    """The reader has gone: keep the interpreter from complaining when it flushes at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
