"""The live session, the ROS node that runs it, and the views of it in a terminal and a browser."""

from typing import Any

from hand_eye_calib.core.base.registry import COMMANDS, RESULT_PARTS, Command


def register() -> None:
    """Register the commands ``calibrator`` and ``watch``, and the part ``goal`` of a result."""
    RESULT_PARTS["goal"] = _goal
    COMMANDS["calibrator"] = Command("run the ROS 2 node", _calibrator)
    COMMANDS["watch"] = Command(
        "display the live node on the terminal, or in a browser", _watch
    )


def _calibrator() -> Any:
    from hand_eye_calib.online.ros import calibrator

    return calibrator


def _watch() -> Any:
    from hand_eye_calib.online.ros import watch

    return watch


def _goal() -> Any:
    from hand_eye_calib.core.results.parts import Part
    from hand_eye_calib.online.live.progress import Progress, details

    return Part("goal", lambda: Progress, details)
