"""A calibration as a shell command."""

import shlex

from hand_eye_calib.calibration import Calibration


def static_transform_command(calibration: Calibration) -> str:
    """Shell command that publishes the calibration as a static transform from parent to child."""
    transform = calibration.to_dict()["T_parent_child"]
    values = dict(zip(("x", "y", "z"), transform["translation"], strict=True))
    values |= dict(zip(("qx", "qy", "qz", "qw"), transform["quat_xyzw"], strict=True))
    numbers = " ".join(f"--{name} {round(value, 9) + 0.0:.9f}" for name, value in values.items())
    parent, child = (
        shlex.quote(frame) for frame in (calibration.parent_frame, calibration.child_frame)
    )
    return (
        f"ros2 run tf2_ros static_transform_publisher {numbers} "
        f"--frame-id {parent} --child-frame-id {child}"
    )
