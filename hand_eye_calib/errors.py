"""The exceptions this package raises on purpose.

Every message says what was expected, what was found and what to do about it, in one line: command
line and node print it as it is. Anything else that escapes is a defect of the package and keeps its
traceback.
"""


class HandEyeCalibError(Exception):
    """Base of every error a caller is expected to handle."""


class ConfigError(HandEyeCalibError, ValueError):
    """An option or parameter has a value it cannot have."""


class InputError(HandEyeCalibError, ValueError):
    """Data that cannot be used: not finite, wrong shape, unreadable, contradictory."""


class NotEnoughDataError(InputError):
    """The data is sound, but there is too little of it to solve."""


class MissingDependencyError(HandEyeCalibError, ImportError):
    """An optional package is needed for what was asked and is not installed."""
