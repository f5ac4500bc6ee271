"""Commands that run ``calibrate`` for one kind of input, such as ``arm`` and ``rig``.

Such a command has all arguments of ``calibrate``, and its own short help.
"""

import argparse
from collections.abc import Callable
from typing import NamedTuple

from hand_eye_calib.offline.cli import calibrate


class Job(NamedTuple):
    """Command that passes its arguments to ``calibrate``.

    Attributes
    ----------
    usage : str
        Arguments in the usage line.
    brief : str
        Help that fits on one screen.
    prepare : callable
        Function that converts the parsed arguments to arguments of ``calibrate``. It raises a
        ConfigError if they do not fit the command.
    """

    usage: str
    brief: str
    prepare: Callable[[argparse.Namespace], None]

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare the command's arguments."""
        calibrate.add_arguments(parser)
        parser.usage = f"%(prog)s {self.usage}"
        parser.set_defaults(brief=self.brief)

    def run(self, arguments: argparse.Namespace) -> int:
        """Calibrate, and return the exit code."""
        self.prepare(arguments)
        return calibrate.run(arguments)
