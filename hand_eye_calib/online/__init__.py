"""The live session, the ROS node around it, and what shows it."""

from typing import Any

from hand_eye_calib.core.base.registry import COMMANDS, Command


def register() -> None:
    """Register the commands ``calibrator`` and ``watch``."""
    COMMANDS["calibrator"] = Command("run the ROS 2 node", _calibrator)
    COMMANDS["watch"] = Command("show the live node on the terminal, or in a browser", _watch)


def _calibrator() -> Any:
    from hand_eye_calib.online.ros import calibrator

    return calibrator


def _watch() -> Any:
    from hand_eye_calib.online.ros import watch

    return watch
