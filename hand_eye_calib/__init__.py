"""Extrinsic calibration of two sensors from their motion alone: the public Python API.

>>> import hand_eye_calib as hec
>>> parent, child = hec.read_trajectory("lidar.txt"), hec.read_trajectory("camera.txt")
>>> hec.calibrate(parent, child, method="dnlo", reference="B5").T_parent_child

Names are imported when first used, so that importing the package costs nothing and needs nothing
but Python.
"""

import importlib

_HOMES = {
    "Calibration": "calibration",
    "SolveStatus": "calibration",
    "Calibrator": "engine.calibrator",
    "CalibratorConfig": "config",
    "HandEyeCalibError": "errors",
    "Trajectory": "geometry.trajectory",
    "calibrate": "engine.offline",
    "load": "io.results",
    "read_trajectory": "io.trajectory_files",
    "save": "io.results",
    "write_trajectory": "io.trajectory_files",
}
_ORIGINAL_NAMES = {"load": "load_result", "save": "save_result"}

__all__ = sorted(_HOMES)


def __getattr__(name):
    if name == "__version__":
        from importlib.metadata import version

        return version("hand_eye_calib")
    if name not in _HOMES:
        raise AttributeError(f"module 'hand_eye_calib' has no attribute {name!r}")
    module = importlib.import_module(f"hand_eye_calib.{_HOMES[name]}")
    return getattr(module, _ORIGINAL_NAMES.get(name, name))


def __dir__():
    return sorted([*__all__, "__version__"])
