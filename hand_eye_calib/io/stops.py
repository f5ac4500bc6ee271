"""Samples of a robot arm: at each stop the pose of the hand, and that of a target before a camera.

Read are the samples of MoveIt's calibration (YAML of ``effector_wrt_world``,
``object_wrt_sensor``, or JSON of pairs of matrices), of easy_handeye and easy_handeye2, pairs
``T1_0``, ``T2_0`` ... in a FileStorage of OpenCV, and the stacks ``robot`` and ``tracking`` of an
``.npz``.
"""

import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.errors import InputError, located
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.frames import pose_of
from hand_eye_calib.io.yaml_files import read_yaml

# Names of both poses of a sample, the robot's first.
_NAMES = (("effector_wrt_world", "object_wrt_sensor"), ("robot", "tracking"), ("robot", "optical"))

# Frames in files of easy_handeye and easy_handeye2.
_FRAMES = {
    "base": "robot_base_frame",
    "hand": "robot_effector_frame",
    "camera": "tracking_base_frame",
    "target": "tracking_marker_frame",
}

_EXPECTED = (
    "samples of an arm: a list of effector_wrt_world and object_wrt_sensor (MoveIt), of robot and "
    "tracking (easy_handeye2), of pairs of 4 x 4 matrices, or T1_0, T2_0, ... (OpenCV)"
)


@dataclass(frozen=True)
class ArmSamples:
    """Samples of an arm: poses (N, 4, 4) of the hand in the robot's base and of the target in the
    camera, and the names of base, hand, camera and target, as far as the file has them.
    """

    robot: FloatArray
    tracking: FloatArray
    frames: Mapping[str, str]


def read_arm_samples(path: str | Path) -> ArmSamples:
    """Read the samples of an arm.

    Raises
    ------
    InputError
        If the file cannot be read or has no samples; one line that names the file.

    Examples
    --------
    >>> hec.read_arm_samples("samples.yaml").robot.shape
    (40, 4, 4)
    """
    document: Any = _stacks(path) if Path(path).suffix == ".npz" else read_yaml(path, _EXPECTED)
    frames: dict[str, str] = {}
    is_inverse = False
    if isinstance(document, Mapping) and "samples" in document:
        of_file = document.get("parameters") or {}
        frames = {name: of_file[key] for name, key in _FRAMES.items() if of_file.get(key)}
        # ``robot`` is the pose of the base in the hand then.
        is_inverse = of_file.get("calibration_type") == "eye_on_base"
        document = document["samples"]
    elif isinstance(document, Mapping):
        pairs = ((document.get(f"T1_{k}"), document.get(f"T2_{k}")) for k in range(len(document)))
        document = [pair for pair in pairs if None not in pair]
    if not isinstance(document, list) or not document:
        raise InputError(f"{path}: expected {_EXPECTED}")
    poses = []
    for number, sample in enumerate(document, 1):
        with located(f"{path}, sample {number}"):
            poses.append([pose_of(value) for value in _pair(sample)])
    robot, tracking = np.swapaxes(poses, 0, 1)
    return ArmSamples(se3.inverse(robot) if is_inverse else robot, tracking, frames)


def _stacks(path: str | Path) -> list[dict[str, FloatArray]]:
    """The samples of two stacks of poses, (N, 4, 4) or (N, 7)."""
    try:
        with np.load(path, allow_pickle=False) as stacks:
            names, poses = list(stacks), [stacks[name] for name in stacks]
        return [dict(zip(names, sample, strict=True)) for sample in zip(*poses, strict=True)]
    except (OSError, ValueError, TypeError, zipfile.BadZipFile, EOFError) as error:
        raise InputError(f"cannot read {path}: {error}") from None


def _pair(sample: Any) -> Sequence[Any]:
    """Both poses of a sample."""
    if isinstance(sample, Mapping):
        found = (names for names in _NAMES if all(name in sample for name in names))
        sample = [sample[name] for name in next(found, ())]
    if not isinstance(sample, Sequence) or len(sample) != 2:
        raise InputError(f"expected {_EXPECTED}")
    return sample
