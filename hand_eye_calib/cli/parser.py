"""A parser with a short help, a long one, and a guess at what a misspelt word should be."""

import argparse
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

from hand_eye_calib.cli.spelling import as_typed
from hand_eye_calib.config import did_you_mean

EXIT_USAGE = 2
_HELP_ALL = "--help-all"


class CommandParser(argparse.ArgumentParser):
    """Parser of the program or of a command.

    Wrong usage ends in one line on stderr and exit code 2. ``--help`` leaves out what
    :func:`advanced` marks, ``--help-all`` shows it.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        options.setdefault("formatter_class", _HelpFormatter)
        options.setdefault("allow_abbrev", False)
        super().__init__(*args, **options)

    def add_help_all(self) -> None:
        """Add ``--help-all``, if anything is left out of ``--help``."""
        if any(_is_advanced(action) for action in self._actions):
            self.add_argument(_HELP_ALL, action=_HelpAll, nargs=0, help="show all options and exit")

    def refuse_unknown(self, arguments: Iterable[str]) -> None:
        """End with wrong usage at an option that does not exist.

        argparse itself first complains about what is missing, which is often the word that it took
        for the value of the misspelt option.
        """
        for word in arguments:
            name = word.partition("=")[0]
            if word == "--":
                return
            if word.startswith("--") and name not in self._option_string_actions:
                self.refuse(name)

    def refuse(self, word: str) -> NoReturn:
        """End with wrong usage: an option or an argument that is none."""
        if not word.startswith("-"):
            self.error(f"unexpected argument {word!r}")
        self.error(f"unknown option {word}{did_you_mean(word, self._option_string_actions)}")

    def error(self, message: str) -> NoReturn:
        """Print one line on stderr and exit with code 2."""
        text = as_typed(f"{message} (see {self.prog} --help)")
        self.exit(EXIT_USAGE, f"hand_eye_calib: error: {text}\n")

    def format_usage(self) -> str:
        """Positional arguments and required options; all others are only mentioned."""
        return f"usage: {self.usage or self._short_usage()}\n"

    def format_help(self) -> str:
        """The help without what is advanced."""
        with _without([action for action in self._actions if _is_advanced(action)]):
            return self.format_help_all()

    def format_help_all(self) -> str:
        """The help with all options."""
        given, self.usage = self.usage, self.usage or self._short_usage()
        try:
            return super().format_help()
        finally:
            self.usage = given

    def _short_usage(self) -> str:
        words = [self.prog]
        for action in self._actions:
            name = str(action.metavar or action.dest)
            if action.option_strings and action.required:
                words.append(f"{action.option_strings[0]} {name}")
            elif not action.option_strings:
                words.append(f"{name} ..." if action.nargs in ("*", "+") else name)
        return " ".join([*words, "[options]"])

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            choices = [str(choice) for choice in action.choices]
            raise argparse.ArgumentError(
                action,
                f"invalid choice: {value!r}, expected one of {', '.join(choices)}"
                f"{did_you_mean(str(value), choices)}",
            )


class _HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Knows the width of the terminal without ``shutil``, which takes longer to load."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, width=_columns() - 2)


def _columns() -> int:
    """Columns of the terminal: as the environment says, or as it is; 80 if there is none."""
    given = os.environ.get("COLUMNS", "")
    if given.isdecimal() and int(given):
        return int(given)
    try:
        output = sys.__stdout__.fileno()  # type: ignore[union-attr]
        return os.get_terminal_size(output).columns or 80
    except (AttributeError, ValueError, OSError):
        return 80


def advanced(action: argparse.Action) -> None:
    """Leave an option out of ``--help``."""
    setattr(action, "is_advanced", True)  # noqa: B010


def _is_advanced(action: argparse.Action) -> bool:
    return getattr(action, "is_advanced", False)


@contextmanager
def _without(actions: Sequence[argparse.Action]) -> Iterator[None]:
    """Hide options from the help inside the block."""
    texts = [action.help for action in actions]
    try:
        for action in actions:
            action.help = argparse.SUPPRESS
        yield
    finally:
        for action, text in zip(actions, texts, strict=True):
            action.help = text


class _HelpAll(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        assert isinstance(parser, CommandParser)
        sys.stdout.write(parser.format_help_all())
        parser.exit()
