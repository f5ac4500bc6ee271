"""A calibration as a shell command."""

import shlex

from hand_eye_calib.calibration import Calibration
from hand_eye_calib.geometry import se3


def static_transform_command(calibration: Calibration) -> str:
    """Shell command that publishes the child's pose as a static transform, in the frame that it is
    mounted on.
    """
    mounted_on, T = calibration.mounting
    values = dict(zip(("x", "y", "z"), T[:3, 3].tolist(), strict=True))
    values |= dict(zip(("qx", "qy", "qz", "qw"), se3.to_quat_xyzw(T).tolist(), strict=True))
    numbers = " ".join(f"--{name} {round(value, 9) + 0.0:.9f}" for name, value in values.items())
    parent, child = (shlex.quote(frame) for frame in (mounted_on, calibration.child_frame))
    return (
        f"ros2 run tf2_ros static_transform_publisher {numbers} "
        f"--frame-id {parent} --child-frame-id {child}"
    )
