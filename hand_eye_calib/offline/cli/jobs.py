"""Commands that do one job with ``calibrate``.

They take arguments of ``calibrate``, but have a short help of their own.
"""

import argparse
from collections.abc import Callable
from typing import NamedTuple

from hand_eye_calib.offline.cli import calibrate


class Job(NamedTuple):
    """A command that hands its arguments to ``calibrate``.

    Attributes
    ----------
    usage : str
        Arguments in the usage line.
    brief : str
        Help that fits on one screen.
    prepare : callable
        Change the parsed arguments to those of ``calibrate``; raise ConfigError if they are not
        those of the job.
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
