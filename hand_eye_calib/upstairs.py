"""Functions of rooms above. The few methods of a result that save, draw or read find them by name
when they are called, so that no room imports one above it.
"""

from importlib import import_module
from typing import Any


def upstairs(module: str, name: str) -> Any:
    """A function of a module of the package, such as ``io.results`` and ``save_result``."""
    return getattr(import_module(f"hand_eye_calib.{module}"), name)
