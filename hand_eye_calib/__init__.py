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

from hand_eye_calib import extras, io, offline, online

# Module of every public name.
_MODULES = {
    "CalibratorConfig": "hand_eye_calib.config",
    "Calibrator": "hand_eye_calib.engine.calibrator",
    "calibrate": "hand_eye_calib.engine.offline",
    "cross_check": "hand_eye_calib.engine.offline",
    "calibrate_arm": "hand_eye_calib.engine.stops",
    "calibrate_stops": "hand_eye_calib.engine.stops",
    "HandEyeCalibError": "hand_eye_calib.errors",
    "Trajectory": "hand_eye_calib.geometry.trajectory",
    "load": "hand_eye_calib.io.results",
    "save": "hand_eye_calib.io.results",
    "read_arm_samples": "hand_eye_calib.io.stops",
    "read_trajectory": "hand_eye_calib.io.trajectory_files.reading",
    "write_trajectory": "hand_eye_calib.io.trajectory_files.table",
    "plot": "hand_eye_calib.report.figures",
    "Calibration": "hand_eye_calib.results.calibration",
    "Residuals": "hand_eye_calib.results.records",
    "SolveStatus": "hand_eye_calib.results.records",
    "Reason": "hand_eye_calib.results.verdict",
    "Verdict": "hand_eye_calib.results.verdict",
    "RigCalibration": "hand_eye_calib.session.rig",
    "calibrate_rig": "hand_eye_calib.session.rig",
    "calibrate_many": "hand_eye_calib.session.together",
    "calibrate_together": "hand_eye_calib.session.together",
    "compare": "hand_eye_calib.assessment.comparison",
    "simulate": "hand_eye_calib.simulation.drive",
}

__all__ = [*_MODULES]

for _layer in (io, offline, online, extras):
    _layer.register()


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from hand_eye_calib.version import version_of

        return version_of()
    if name not in _MODULES:
        raise AttributeError(f"module 'hand_eye_calib' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
