"""Two pose streams in, a judged extrinsic out: no file, no ROS."""

from typing import Any

from hand_eye_calib.core.base.registry import KINDS


def register() -> None:
    """Register two streams of poses as a kind of data."""
    KINDS["poses"] = _poses


def _poses() -> Any:
    from hand_eye_calib.core.engine.poses import POSES

    return POSES
