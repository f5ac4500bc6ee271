"""The node's log: a message that repeats is written once in a while."""

import time
from collections.abc import Hashable
from typing import Protocol

from hand_eye_calib.errors import printable

LOG_PERIOD_S = 5.0


class Logger(Protocol):
    """What is used of a ROS logger."""

    def info(self, message: str) -> bool: ...

    def warning(self, message: str) -> bool: ...

    def error(self, message: str) -> bool: ...


class NodeLog:
    """Writes to a ROS logger; rclpy's own throttle cannot tell two topics apart.

    Each method takes the text and, for a message that may repeat, a key: of messages with the same
    key only one is written per period.

    Parameters
    ----------
    logger : rclpy logger
    """

    def __init__(self, logger: Logger) -> None:
        self._logger = logger
        self._written_at_s: dict[Hashable, float] = {}

    # rclpy ties a place in the code to its severity: each method writes by itself.

    def info(self, text: str, key: Hashable = None, period_s: float = LOG_PERIOD_S) -> None:
        """Write what a person may want to know."""
        if self._is_due(key, period_s):
            self._logger.info(_escaped(text))

    def warning(self, text: str, key: Hashable = None, period_s: float = LOG_PERIOD_S) -> None:
        """Write what a person should look at."""
        if self._is_due(key, period_s):
            self._logger.warning(_escaped(text))

    def error(self, text: str, key: Hashable = None, period_s: float = LOG_PERIOD_S) -> None:
        """Write what went wrong."""
        if self._is_due(key, period_s):
            self._logger.error(_escaped(text))

    def _is_due(self, key: Hashable, period_s: float) -> bool:
        now_s = time.monotonic()
        if now_s - self._written_at_s.get(key, -float("inf")) < period_s:
            return False
        if key is not None:
            self._written_at_s[key] = now_s
        return True


def _escaped(text: str) -> str:
    """Text of one or more lines without other control characters."""
    return "\n".join(map(printable, text.split("\n")))
