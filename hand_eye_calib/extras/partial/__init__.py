"""Streams of positions, rotations or angular rates alone."""

from typing import Any

from hand_eye_calib.core.base.registry import ESTIMATORS, RESULT_PARTS


def register() -> None:
    """Register the estimators of both kinds of streams."""
    RESULT_PARTS["rate_bias"] = _rate_bias
    ESTIMATORS["positions"] = _lever_arm
    ESTIMATORS["rotations"] = _rotation


def _lever_arm(pose_pairs: Any, config: Any, cross_check: bool) -> Any:
    """Estimate the lever arm; positions have no cross-check."""
    from hand_eye_calib.extras.partial.partial import estimate_lever_arm

    return estimate_lever_arm(pose_pairs, config)


def _rotation(pose_pairs: Any, config: Any, cross_check: bool) -> Any:
    from hand_eye_calib.extras.partial.partial import estimate_rotation

    return estimate_rotation(pose_pairs, config, cross_check=cross_check)


def _rate_bias() -> Any:
    from hand_eye_calib.core.results.parts import Part
    from hand_eye_calib.extras.partial.rate_bias import RateBias

    return Part("rate_bias", lambda: RateBias)
