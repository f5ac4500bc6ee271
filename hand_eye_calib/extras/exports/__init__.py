"""Extrinsics in the files of other programs."""

from typing import Any

from hand_eye_calib.registry import RESULT_METHODS


def register() -> None:
    """Register the method ``export`` of results."""
    RESULT_METHODS["export"] = _export


def _export(result: Any, format: str) -> str:
    from hand_eye_calib.results.exports import export_text

    return export_text(result, format)
