"""Calibration from streams that have positions, rotations or angular rates only."""

from typing import Any

from hand_eye_calib.core.base.registry import FINDING_WORDS, KINDS, RESULT_PARTS


def register() -> None:
    """Register positions, rotations and rates as kinds of data, with their results and findings."""
    RESULT_PARTS["rate_bias"] = _rate_bias
    FINDING_WORDS["partial"] = _words
    KINDS["positions"] = _positions
    KINDS["rotations"] = _rotations


def _positions() -> Any:
    from hand_eye_calib.extras.partial.kinds import POSITIONS

    return POSITIONS


def _rotations() -> Any:
    from hand_eye_calib.extras.partial.kinds import ROTATIONS

    return ROTATIONS


def _rate_bias() -> Any:
    from hand_eye_calib.core.results.parts import Part
    from hand_eye_calib.extras.partial.rate_bias import RateBias

    return Part("rate_bias", lambda: RateBias)


def _words() -> Any:
    from hand_eye_calib.extras.partial.words import WORDS

    return WORDS
