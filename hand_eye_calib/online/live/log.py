"""Log of the node. Lines that differ only in their numbers are written once."""

import re
import time
from typing import Any

from hand_eye_calib.core.base.errors import printable

# A warning or an error is not repeated within this time (s), unless a new session begins.
ONCE_S = 1800.0

# News that come repeatedly, such as a better result, are not repeated within this time (s).
GOES_ON_S = 60.0

_NUMBERS = re.compile(r"[\d.,+-]+")


class NodeLog:
    """Log that does not repeat a text within a certain time.

    The throttle of a ROS logger belongs to a line of code, so it would mix the warnings of two
    topics. Here, texts that differ only in their numbers count as equal. All texts with the same
    ``key`` also count as equal. A text is not repeated within ``every_s`` (s).
    """

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._written_at_s: dict[str, float] = {}

    def restart(self) -> None:
        """Begin a new session, in which every text may be written again."""
        self._written_at_s.clear()

    # rclpy accepts only one severity per line of code. Therefore each method calls the logger
    # itself.
    def debug(self, text: str) -> None:
        """Write a detail that helps to find a fault."""
        self._logger.debug(_escaped(text))

    def info(self, text: str, every_s: float = 0.0, key: str = "") -> None:
        """Write news that require no action."""
        if self._is_due(f"info {key or text}", every_s):
            self._logger.info(_escaped(text))

    def warning(
        self, text: str, every_s: float = ONCE_S, key: str = ""
    ) -> None:
        """Write a fault that a person should look at."""
        if self._is_due(f"warning {key or text}", every_s):
            self._logger.warning(_escaped(text))

    def error(self, text: str) -> None:
        """Write a failure."""
        if self._is_due(f"error {text}", ONCE_S):
            self._logger.error(_escaped(text))

    def _is_due(self, text: str, every_s: float) -> bool:
        """Whether a text may be written now; if so, store the time."""
        key = _NUMBERS.sub("", text)
        now_s = time.monotonic()
        is_due = now_s - self._written_at_s.get(key, -float("inf")) >= every_s
        # Limit the memory. A sound session has far fewer different texts.
        if is_due and len(self._written_at_s) < 10_000:
            self._written_at_s[key] = now_s
        return is_due


def _escaped(text: str) -> str:
    """Return a text with all control characters escaped, except line ends."""
    return "\n".join(map(printable, text.split("\n")))
