"""A calibration as a shell command."""

import shlex

from hand_eye_calib.calibration import Calibration


def static_transform_command(calibration: Calibration) -> str:
    """Shell command that publishes the child's pose as a static transform, in the frame that it is
    mounted on.

    Empty if the verdict is DO NOT USE. For an axis that the motion does not show it has a word that
    static_transform_publisher refuses.
    """
    numbers = calibration.usable_numbers()
    if not numbers:
        return ""
    told = " ".join(f"--{name} {_number(value)}" for name, value in numbers.items())
    mounted_on = calibration.mounting[0]
    parent, child = (shlex.quote(frame) for frame in (mounted_on, calibration.child_frame))
    return (
        f"ros2 run tf2_ros static_transform_publisher {told} "
        f"--frame-id {parent} --child-frame-id {child}"
    )


def _number(value: float | str) -> str:
    return value if isinstance(value, str) else f"{round(value, 9) + 0.0:.9f}"
