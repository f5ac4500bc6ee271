"""Smallest errors of a result that its own recording contradicts."""

from typing import Any

from hand_eye_calib.core.base.registry import (
    EXTRA_RULES,
    RESULT_EXAMINATIONS,
    RESULT_PARTS,
    ExtraRule,
)


def register() -> None:
    """Register the examination of results, its part of results, and its rule of the verdict."""
    RESULT_EXAMINATIONS["detectability"] = _examine
    RESULT_PARTS["detectability"] = _part
    EXTRA_RULES["undetectable"] = ExtraRule(
        after="unconfirmed",
        forbids=False,
        when="an error of three times the size that the standard deviation makes detectable is not "
        "found in nine of ten splits of the recording",
        find=_undetectable,
    )


def _examine(result: Any, snapshot: Any) -> Any:
    from hand_eye_calib.extras.detectability.injection import examine

    return examine(result, snapshot)


def _part() -> Any:
    from hand_eye_calib.extras.detectability.record import DetectabilityPart

    return DetectabilityPart()


def _undetectable(result: Any) -> Any:
    from hand_eye_calib.extras.detectability.record import find_undetectable

    return find_undetectable(result)
