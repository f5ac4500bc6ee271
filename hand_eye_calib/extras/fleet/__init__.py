"""Several recordings: compared, together, in batches."""

from typing import Any

from hand_eye_calib.registry import COMMANDS, Command


def register() -> None:
    """Register the command ``compare``."""
    COMMANDS["compare"] = Command(
        "compare results with what is installed, or with each other", _compare
    )


def _compare() -> Any:
    from hand_eye_calib.cli import compare

    return compare
