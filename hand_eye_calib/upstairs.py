"""Functions of rooms above, for the few methods of results that save, draw or read: found by name
when they are called, so that nothing below imports what lies above.
"""

from importlib import import_module
from typing import Any


def upstairs(module: str, name: str) -> Any:
    """A function of a module of the package, such as ``io.results`` and ``save_result``."""
    return getattr(import_module(f"hand_eye_calib.{module}"), name)
