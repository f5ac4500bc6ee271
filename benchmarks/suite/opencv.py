"""What a user would run instead: OpenCV's ``calibrateHandEye``.

Its "gripper to base" is our pose of the parent in its world, its "target to camera" the inverse of
our pose of the child in its: then its "camera to gripper" is T_parent_child. It makes a pair of
every two poses.
"""

import numpy as np

from hand_eye_calib.geometry import se3

METHODS = ("PARK", "TSAI", "HORAUD", "ANDREFF", "DANIILIDIS")


def load():
    """The module, None where it is not installed."""
    try:
        import cv2
    except ImportError:
        return None
    return cv2


def calibrate(cv2, method, Ts_pw_p, Ts_cw_c):
    """T_parent_child (4, 4) by one of METHODS."""
    Ts_child_world = se3.inverse(Ts_cw_c)
    rotation, translation = cv2.calibrateHandEye(
        list(Ts_pw_p[:, :3, :3]),
        list(Ts_pw_p[:, :3, 3]),
        list(Ts_child_world[:, :3, :3]),
        list(Ts_child_world[:, :3, 3]),
        method=getattr(cv2, f"CALIB_HAND_EYE_{method}"),
    )
    return se3.from_rotation_translation(rotation, np.ravel(translation))
