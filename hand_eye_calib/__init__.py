"""Extrinsic calibration of two sensors from their motion alone: the public Python API.

>>> import hand_eye_calib as hec
>>> result = hec.calibrate("lidar.tum", "camera.tum")
>>> result.T_parent_child.shape, result.verdict.value
((4, 4), 'USE')

Names are imported when they are first used, so that importing the package takes no time and needs
nothing but Python.
"""

from importlib import import_module
from typing import Any

# The home of every public name, as the stub beside this file imports it.
with open(f"{__file__}i", encoding="utf-8") as _stub:
    _imports = [line.split() for line in _stub if line.startswith("from")]
_HOMES = {name: module for _, module, _, name, *_ in _imports}

__all__ = [*_HOMES]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from hand_eye_calib.version import version_of

        return version_of()
    if name not in _HOMES:
        raise AttributeError(f"module 'hand_eye_calib' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
