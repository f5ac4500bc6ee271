"""Extrinsic calibration of two sensors from their motion alone: the public Python API.

>>> import hand_eye_calib as hec
>>> result = hec.calibrate("lidar.tum", "camera.tum")
>>> result.T_parent_child.shape, result.verdict.value
((4, 4), 'USE')

Names are imported when they are first used, so that importing the package takes no time and needs
nothing but Python.
"""

import importlib
from typing import TYPE_CHECKING, Any

# The home of every public name.
_HOMES = {
    "Calibration": "results.calibration",
    "Calibrator": "engine.calibrator",
    "CalibratorConfig": "config",
    "HandEyeCalibError": "errors",
    "Reason": "results.verdict",
    "Residuals": "results.records",
    "RigCalibration": "rig.calibrate",
    "SolveStatus": "results.records",
    "Trajectory": "geometry.trajectory",
    "Verdict": "results.verdict",
    "calibrate": "engine.offline",
    "calibrate_arm": "engine.stops",
    "calibrate_many": "session.together",
    "calibrate_rig": "rig.calibrate",
    "calibrate_stops": "engine.stops",
    "calibrate_together": "session.together",
    "compare": "session.together",
    "cross_check": "engine.offline",
    "load": "io.results",
    "plot": "report.figures",
    "read_arm_samples": "io.stops",
    "read_trajectory": "io.trajectory_files.reading",
    "save": "io.results",
    "simulate": "simulation.drive",
    "write_trajectory": "io.trajectory_files.table",
}

__all__ = [*_HOMES]

if TYPE_CHECKING:
    # The same for editors and type checkers.
    from hand_eye_calib.config import CalibratorConfig as CalibratorConfig
    from hand_eye_calib.engine.calibrator import Calibrator as Calibrator
    from hand_eye_calib.engine.offline import calibrate as calibrate
    from hand_eye_calib.engine.offline import cross_check as cross_check
    from hand_eye_calib.engine.stops import calibrate_arm as calibrate_arm
    from hand_eye_calib.engine.stops import calibrate_stops as calibrate_stops
    from hand_eye_calib.errors import HandEyeCalibError as HandEyeCalibError
    from hand_eye_calib.geometry.trajectory import Trajectory as Trajectory
    from hand_eye_calib.io.results import load as load
    from hand_eye_calib.io.results import save as save
    from hand_eye_calib.io.stops import read_arm_samples as read_arm_samples
    from hand_eye_calib.io.trajectory_files.reading import read_trajectory as read_trajectory
    from hand_eye_calib.io.trajectory_files.table import write_trajectory as write_trajectory
    from hand_eye_calib.report.figures import plot as plot
    from hand_eye_calib.results.calibration import Calibration as Calibration
    from hand_eye_calib.results.records import Residuals as Residuals
    from hand_eye_calib.results.records import SolveStatus as SolveStatus
    from hand_eye_calib.results.verdict import Reason as Reason
    from hand_eye_calib.results.verdict import Verdict as Verdict
    from hand_eye_calib.rig.calibrate import RigCalibration as RigCalibration
    from hand_eye_calib.rig.calibrate import calibrate_rig as calibrate_rig
    from hand_eye_calib.session.together import calibrate_many as calibrate_many
    from hand_eye_calib.session.together import calibrate_together as calibrate_together
    from hand_eye_calib.session.together import compare as compare
    from hand_eye_calib.simulation.drive import simulate as simulate

    __version__: str
else:

    def __getattr__(name: str) -> Any:
        if name == "__version__":
            from hand_eye_calib.version import package_version

            return package_version()
        if name not in _HOMES:
            raise AttributeError(f"module 'hand_eye_calib' has no attribute {name!r}")
        module = importlib.import_module(f"hand_eye_calib.{_HOMES[name]}")
        return getattr(module, name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
