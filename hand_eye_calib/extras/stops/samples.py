"""Samples of a robot arm: at each stop the pose of the hand, and that of a target before a camera.

Read are the samples of MoveIt's calibration (YAML of ``effector_wrt_world``,
``object_wrt_sensor``, or JSON of pairs of matrices), of easy_handeye and easy_handeye2, pairs
``T1_0``, ``T2_0`` ... in a FileStorage of OpenCV, the stacks ``robot`` and ``tracking`` of an
``.npz``, and the arguments of OpenCV's ``calibrateHandEye`` by their names, in any of these files.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import InputError, located
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import pose_of, pose_stack
from hand_eye_calib.formats.files import LONGEST_NAME
from hand_eye_calib.formats.npz import read_arrays
from hand_eye_calib.formats.yaml_files import read_yaml

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
    "tracking (easy_handeye2), of pairs of 4 x 4 matrices, T1_0, T2_0, ... (OpenCV), or "
    "R_gripper2base, t_gripper2base, R_target2cam, t_target2cam (OpenCV)"
)

# Names of the arguments of OpenCV's solvers: the quantity, and the frames it leads from and to.
_OF_OPENCV = re.compile(r"([a-z]+)_([a-z]+)2([a-z]+)")
_QUANTITIES = {
    "r": "rotation",
    "rvec": "rotation",
    "rvecs": "rotation",
    "t": "translation",
    "tvec": "translation",
    "tvecs": "translation",
}
_OPENCV_FRAMES = {
    **dict.fromkeys(("gripper", "hand", "ee", "eef", "flange", "tool", "tcp"), "hand"),
    **dict.fromkeys(("base", "robot"), "base"),
    **dict.fromkeys(("target", "world", "board", "marker", "tag", "object", "obj"), "target"),
    **dict.fromkeys(("cam", "camera", "sensor"), "camera"),
}


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

    Notes
    -----
    Arguments of OpenCV are read by their names, also those of base2gripper and cam2target. For a
    camera beside the robot OpenCV takes the poses of the base in the gripper under the name
    gripper2base: give ``parent_invert="poses"`` then.

    Examples
    --------
    >>> hec.read_arm_samples("samples.yaml").robot.shape
    (40, 4, 4)
    """
    is_npz = Path(path).suffix == ".npz"
    document: Any = read_arrays(path) if is_npz else read_yaml(path, _EXPECTED)
    if isinstance(document, Mapping):
        with located(path):
            if samples := _of_opencv(document):
                return samples
    if is_npz:
        document = _rows_of_stacks(path, document)
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


def _rows_of_stacks(
    path: str | Path, stacks: Mapping[str, FloatArray]
) -> list[dict[str, FloatArray]]:
    """The samples of two stacks of poses, (N, 4, 4) or (N, 7)."""
    names = next((names for names in _NAMES if {*names} <= stacks.keys()), None)
    if names is None or any(stacks[name].ndim < 2 for name in names):
        raise InputError(f"{path}: expected {_EXPECTED}; found {', '.join(stacks) or 'nothing'}")
    robot, tracking = (stacks[name] for name in names)
    if len(robot) != len(tracking):
        raise InputError(
            f"{path}: {len(robot)} poses of the robot, {len(tracking)} of the target: each stop "
            "needs one of both"
        )
    pairs = zip(robot, tracking, strict=True)
    return [dict(zip(names, pair, strict=True)) for pair in pairs]


def _of_opencv(document: Mapping[str, Any]) -> ArmSamples | None:
    """The samples of OpenCV's arguments, such as R_gripper2base; None if there are none."""
    parts: dict[tuple[str, str], dict[str, Any]] = {}
    for name, value in document.items():
        match = _OF_OPENCV.fullmatch(str(name)[:LONGEST_NAME].lower())
        if match is None or match[1] not in _QUANTITIES:
            continue
        frames = _OPENCV_FRAMES.get(match[2], ""), _OPENCV_FRAMES.get(match[3], "")
        parts.setdefault(frames, {})[_QUANTITIES[match[1]]] = value
    robot = _joined(parts, "hand", "base")
    tracking = _joined(parts, "target", "camera")
    if robot is None or tracking is None:
        return None
    if len(robot) != len(tracking):
        raise InputError(
            f"{len(robot)} poses of the robot, {len(tracking)} of the target: each stop needs one "
            "of both"
        )
    return ArmSamples(robot, tracking, {})


def _joined(
    parts: Mapping[tuple[str, str], Mapping[str, Any]], source: str, target: str
) -> FloatArray | None:
    """Poses (N, 4, 4) of one frame in another, of rotations and translations either way."""
    for frames in ((source, target), (target, source)):
        pair = parts.get(frames, {})
        if "rotation" in pair and "translation" in pair:
            rotation = pair["rotation"]
            translation = pair["translation"]
            Ts = pose_stack((rotation, translation), f"{frames[0]} in {frames[1]}")
            return Ts if frames == (source, target) else se3.inverse(Ts)
    return None


def _pair(sample: Any) -> Sequence[Any]:
    """Both poses of a sample."""
    if isinstance(sample, Mapping):
        found = (names for names in _NAMES if all(name in sample for name in names))
        sample = [sample[name] for name in next(found, ())]
    if not isinstance(sample, Sequence) or len(sample) != 2:
        raise InputError(f"expected {_EXPECTED}")
    return sample
