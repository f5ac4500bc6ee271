"""A result in the frame of the robot."""

from dataclasses import replace

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.results.calibration import Calibration


def with_base(result: Calibration, base_frame: str, T_base_parent: FloatArray) -> Calibration:
    """The result with its pose in the base frame, too.

    Parameters
    ----------
    result : Calibration
    base_frame : str
    T_base_parent : (4, 4) array
        Pose of the parent sensor in that frame, as the robot's transforms have it.
    """
    return replace(result, base_frame=base_frame, T_base_parent=T_base_parent)
