"""Files and messages: bags, trajectory files, results, transforms."""

from typing import Any

from hand_eye_calib.registry import RESULT_METHODS


def register() -> None:
    """Register the method ``save`` of results."""
    RESULT_METHODS["save"] = _save


def _save(result: Any, directory: Any) -> Any:
    from hand_eye_calib.io.results import save_result

    return save_result(result, directory)
