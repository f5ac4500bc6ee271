"""Clouds of both sensors in the report: merged through the result, before and after."""

from typing import Any

from hand_eye_calib.core.base.registry import REPORT_PICTURES


def register() -> None:
    """Register the figure of the merged clouds."""
    REPORT_PICTURES["clouds"] = _figures


def _figures(calibration: Any, snapshot: Any, suffix: str) -> Any:
    from hand_eye_calib.extras.clouds.figure import figures_of_clouds

    return figures_of_clouds(calibration, snapshot, suffix)
