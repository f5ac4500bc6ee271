"""The node's log: what differs in its numbers only is not written again and again."""

import re
import time
from typing import Any

from hand_eye_calib.core.base.errors import printable

# A warning or an error is written once for each reason: in a session, and in so many seconds.
ONCE_S = 1800.0

# What goes on, such as a result that becomes better, is written so often (s).
GOES_ON_S = 60.0

_NUMBERS = re.compile(r"[\d.,+-]+")


class NodeLog:
    """Writes to a ROS logger, whose own throttle cannot tell two topics apart. The methods take a
    text, and how often it may be written: texts that differ in their numbers only are the same, and
    so are all with the same ``key``.
    """

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._written_at_s: dict[str, float] = {}

    def restart(self) -> None:
        """Begin a new session, in which everything may be said again."""
        self._written_at_s.clear()

    # rclpy ties a place in the code to its severity: each method writes by itself.
    def debug(self, text: str) -> None:
        """Write what somebody looks for who has asked for it."""
        self._logger.debug(_escaped(text))

    def info(self, text: str, every_s: float = 0.0, key: str = "") -> None:
        """Write what a person may want to know."""
        if self._is_due(f"info {key or text}", every_s):
            self._logger.info(_escaped(text))

    def warning(self, text: str, every_s: float = ONCE_S, key: str = "") -> None:
        """Write what a person should look at."""
        if self._is_due(f"warning {key or text}", every_s):
            self._logger.warning(_escaped(text))

    def error(self, text: str) -> None:
        """Write what went wrong, once."""
        if self._is_due(f"error {text}", ONCE_S):
            self._logger.error(_escaped(text))

    def _is_due(self, text: str, every_s: float) -> bool:
        key = _NUMBERS.sub("", text)
        now_s = time.monotonic()
        is_due = now_s - self._written_at_s.get(key, -float("inf")) >= every_s
        if is_due and len(self._written_at_s) < 10_000:
            self._written_at_s[key] = now_s
        return is_due


def _escaped(text: str) -> str:
    """Text of one or more lines without other control characters."""
    return "\n".join(map(printable, text.split("\n")))
