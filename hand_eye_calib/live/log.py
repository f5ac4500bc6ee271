"""The node's log: a message that repeats is written once in a while."""

import time
from collections.abc import Callable, Hashable
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

    def info(self, text: str, key: Hashable = None, period_s: float = LOG_PERIOD_S) -> None:
        """Write what a person may want to know."""
        self._write(self._logger.info, text, key, period_s)

    def warning(self, text: str, key: Hashable = None, period_s: float = LOG_PERIOD_S) -> None:
        """Write what a person should look at."""
        self._write(self._logger.warning, text, key, period_s)

    def error(self, text: str, key: Hashable = None, period_s: float = LOG_PERIOD_S) -> None:
        """Write what went wrong."""
        self._write(self._logger.error, text, key, period_s)

    def _write(
        self, write: Callable[[str], bool], text: str, key: Hashable, period_s: float
    ) -> None:
        now_s = time.monotonic()
        if key is not None:
            if now_s - self._written_at_s.get(key, -float("inf")) < period_s:
                return
            self._written_at_s[key] = now_s
        write("\n".join(map(printable, text.split("\n"))))  # without other control characters
