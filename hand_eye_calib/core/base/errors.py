"""Exceptions that this package raises on purpose.

A message is one line with the expected value, the actual value, and the remedy. The command line
and the node print it unchanged. Any other exception is a defect of the package, and is printed with
its traceback.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from typing import Any


def printable(text: str) -> str:
    r"""Escape control characters, such as ``\x1b`` and line ends.

    Names from files may contain such characters, which would disturb a terminal or a log.
    """
    if text.isprintable():
        return text
    return "".join(
        letter
        if letter.isprintable()
        else letter.encode("unicode_escape").decode()
        for letter in text
    )


class HandEyeCalibError(Exception):
    """Base class of all errors that callers should handle.

    Examples
    --------
    >>> try:
    ...     hec.load("absent")
    ... except hec.HandEyeCalibError as error:
    ...     print(error)
    cannot read absent: No such file or directory
    """

    def __str__(self) -> str:
        return printable(super().__str__())


class ConfigError(HandEyeCalibError, ValueError):
    """An option or parameter has a value that is not allowed."""


class InputError(HandEyeCalibError, ValueError):
    """Data that cannot be used: not finite, wrong shape, unreadable, contradictory."""


class UnclearStreamsError(InputError):
    """A recording has no obvious pair of streams.

    Attributes
    ----------
    options : dict of str to str
        Options that select the likeliest streams; empty if the recording has no streams.
    """

    def __init__(self, message: str, options: Mapping[str, str]) -> None:
        super().__init__(message)
        self.options = {**options}


class NoPoseError(InputError):
    """A message has no pose: zero quaternion, a value that is not finite, or no GNSS fix."""


class NotEnoughDataError(InputError):
    """The data are valid, but there are too few of them to solve."""


class MissingDependencyError(HandEyeCalibError, ImportError):
    """An optional package that this request needs is not installed."""


def require_type(
    name: str, value: object, *kinds: type, remedy: str = ""
) -> None:
    """Raise InputError if an argument of the Python interface has none of these types."""
    if not isinstance(value, kinds):
        expected = " or ".join(kind.__name__ for kind in kinds)
        text = f"{name} must be of type {expected}; got {type(value).__name__}"
        raise InputError(f"{text}: {remedy}" if remedy else text)


@contextmanager
def located(where: object) -> Iterator[None]:
    """Put a place, such as a path, before the messages of errors that the block raises."""
    try:
        yield
    except HandEyeCalibError as error:
        raise type(error)(f"{where}: {error}") from None


def installing(extra: str) -> str:
    """Return the command that installs an extra from source, as no index has this package."""
    return f"pip install '.[{extra}]' in the source folder of hand_eye_calib"


def required(module: str, purpose: str, extra: str) -> Any:
    """Return a module of an optional package, or raise MissingDependencyError.

    The message contains ``purpose``, the request that needs the module, and ``extra``, the name of
    the extra.
    """
    try:
        return import_module(module)
    except ImportError:
        raise MissingDependencyError(
            f"{purpose} needs {module.partition('.')[0]}, which is not installed: "
            f"{installing(extra)}"
        ) from None
