"""Extrinsic calibration of two sensors from their motion alone: the public Python API.

>>> import hand_eye_calib as hec
>>> result = hec.calibrate("lidar.tum", "camera.tum")
>>> result.T_parent_child.shape, result.verdict.value
((4, 4), 'USE')

A name is imported at its first use, so that ``import hand_eye_calib`` is quick and needs no other
package.
"""

from importlib import import_module
from typing import Any

from hand_eye_calib import core, extras, formats, offline, online
from hand_eye_calib.core.base.registry import PUBLIC_NAMES

# Module of each public name of core, formats and offline. Extras register their own names.
_MODULES = {
    "CalibratorConfig": "hand_eye_calib.core.base.config",
    "Calibrator": "hand_eye_calib.core.engine.calibrator",
    "calibrate": "hand_eye_calib.offline.calibrate",
    "cross_check": "hand_eye_calib.offline.calibrate",
    "HandEyeCalibError": "hand_eye_calib.core.base.errors",
    "Trajectory": "hand_eye_calib.core.geometry.trajectory",
    "load": "hand_eye_calib.formats.results",
    "save": "hand_eye_calib.formats.results",
    "read_trajectory": "hand_eye_calib.formats.trajectory_files.reading",
    "write_trajectory": "hand_eye_calib.formats.trajectory_files.writing",
    "plot": "hand_eye_calib.offline.report.views",
    "Calibration": "hand_eye_calib.core.results.calibration",
    "Residuals": "hand_eye_calib.core.results.records",
    "SolveStatus": "hand_eye_calib.core.results.records",
    "Reason": "hand_eye_calib.core.results.reasons",
    "Verdict": "hand_eye_calib.core.results.reasons",
    "compare": "hand_eye_calib.core.assessment.comparison",
}

for _layer in (core, formats, offline, online, extras):
    _layer.register()
_MODULES |= PUBLIC_NAMES

__all__ = [*_MODULES]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from hand_eye_calib.core.base.version import version_of

        return version_of()
    if name not in _MODULES:
        raise AttributeError(
            f"module 'hand_eye_calib' has no attribute {name!r}"
        )
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
