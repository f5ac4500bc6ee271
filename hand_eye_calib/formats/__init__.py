"""Read and write files and messages: bags, trajectory files, results, transforms."""

from typing import Any

from hand_eye_calib.core.base.registry import RESULT_METHODS


def register() -> None:
    """Register the methods ``save`` and ``export`` of results."""
    RESULT_METHODS["save"] = _save
    RESULT_METHODS["export"] = _export


def _save(result: Any, directory: Any) -> Any:
    """Call :func:`.results.save`, which is imported only when it is needed."""
    from hand_eye_calib.formats.results import save

    return save(result, directory)


def _export(result: Any, format: str) -> str:
    """Call :func:`.exports.export_text`, which is imported only when it is needed."""
    from hand_eye_calib.formats.exports import export_text

    return export_text(result, format)
