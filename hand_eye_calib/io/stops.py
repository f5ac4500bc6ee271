"""Samples of a robot arm: at each stop the pose of the hand, and that of a target before a camera.

Read are the samples of MoveIt's calibration (YAML of ``effector_wrt_world``,
``object_wrt_sensor``, or JSON of pairs of matrices), of easy_handeye and easy_handeye2, pairs
``T1_0``, ``T2_0`` ... in a FileStorage of OpenCV, and two stacks in an ``.npz``.
"""

import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.files import read_text
from hand_eye_calib.io.limits import LARGEST_YAML

# Names of both poses of a sample, the robot's first.
_NAMES = (
    ("effector_wrt_world", "object_wrt_sensor"),
    ("robot", "tracking"),
    ("robot", "optical"),
    ("hand", "camera"),
    ("parent", "child"),
    ("A", "B"),
)

# Frames in files of easy_handeye and easy_handeye2.
_FRAMES = {
    "base": "robot_base_frame",
    "hand": "robot_effector_frame",
    "camera": "tracking_base_frame",
    "target": "tracking_marker_frame",
}

# With this type of easy_handeye2 ``robot`` is the pose of the base in the hand.
_BESIDE = "eye_on_base"

# A matrix whose rotation is further than this from one is none.
_ROTATION_WITHIN = 1e-2

_EXPECTED = (
    "samples of an arm: a list of effector_wrt_world and object_wrt_sensor (MoveIt), of robot and "
    "tracking (easy_handeye2), of pairs of 4 x 4 matrices, or T1_0, T2_0, ... (OpenCV)"
)


@dataclass(frozen=True)
class ArmSamples:
    """Samples of an arm.

    Attributes
    ----------
    robot, tracking : (N, 4, 4) arrays
        Of the hand in the robot's base, and of the target in the camera.
    frames : mapping of str to str
        Names of base, hand, camera and target, as far as the file has them.
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
    path = Path(path)
    if path.suffix == ".npz":
        return _of_stacks(path)
    from hand_eye_calib.io.yaml_files import parse_opencv_yaml

    text = read_text(path, _EXPECTED, LARGEST_YAML)
    document = parse_opencv_yaml(text, str(path))
    frames: dict[str, str] = {}
    is_inverse = False
    if isinstance(document, Mapping) and "samples" in document:
        of_file = document.get("parameters") or {}
        frames = {name: of_file[key] for name, key in _FRAMES.items() if of_file.get(key)}
        document, is_inverse = document["samples"], of_file.get("calibration_type") == _BESIDE
    elif isinstance(document, Mapping):
        document = _pairs_of_opencv(document)
    if not isinstance(document, list) or not document:
        raise InputError(f"{path}: expected {_EXPECTED}")
    pairs = [_pair(sample, f"{path}, sample {number}") for number, sample in enumerate(document, 1)]
    robot, tracking = (np.stack(column) for column in zip(*pairs, strict=True))
    robot = se3.inverse(robot) if is_inverse else robot
    return ArmSamples(robot, tracking, frames)


def _pairs_of_opencv(document: Mapping[str, Any]) -> list[Any]:
    """The matrices T1_k and T2_k; empty if there are none."""
    pairs: list[list[Any]] = []
    while f"T1_{len(pairs)}" in document and f"T2_{len(pairs)}" in document:
        pairs.append([document[f"{side}_{len(pairs)}"] for side in ("T1", "T2")])
    return pairs


def _pair(sample: Any, where: str) -> tuple[FloatArray, FloatArray]:
    """Both matrices of a sample."""
    if isinstance(sample, Mapping):
        names = next((names for names in _NAMES if all(name in sample for name in names)), None)
        if names is None:
            raise InputError(f"{where}: expected {_EXPECTED}; found {', '.join(sample) or 'none'}")
        sample = [sample[name] for name in names]
    if not isinstance(sample, Sequence) or len(sample) != 2:
        raise InputError(f"{where}: expected two poses")
    return _matrix(sample[0], where), _matrix(sample[1], where)


def _matrix(value: Any, where: str) -> FloatArray:
    """A pose from a matrix of OpenCV, a message or numbers."""
    if isinstance(value, Mapping) and "data" in value:
        value = value["data"]
    try:
        if isinstance(value, Mapping):
            position = value.get("translation", value.get("position"))
            quaternion = value.get("rotation", value.get("orientation"))
            numbers = [position[axis] for axis in "xyz"] + [quaternion[axis] for axis in "xyzw"]
            return _poses(np.array([numbers], dtype=float), where)[0]
        array = np.array(value, dtype=float)
        return _poses(array.reshape(1, 4, 4) if array.size == 16 else array[None], where)[0]
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{where}: expected a pose: 16 numbers of a matrix, 7 of x, y, z, qx, qy, qz, qw, or "
            "translation and rotation"
        ) from None


def _of_stacks(path: Path) -> ArmSamples:
    try:
        with np.load(path, allow_pickle=False) as stacks:
            arrays = {name: np.asarray(stacks[name]) for name in stacks.files}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise InputError(f"cannot read {path}: {error}") from None
    names = next((names for names in _NAMES if all(name in arrays for name in names)), None)
    if names is None:
        raise InputError(
            f"{path}: expected two stacks of poses named "
            f"{' or '.join(', '.join(pair) for pair in _NAMES[1:])}; found "
            f"{', '.join(arrays) or 'none'}"
        )
    robot, tracking = (_poses(arrays[name], f"{path}, {name}") for name in names)
    if len(robot) != len(tracking):
        raise InputError(
            f"{path}: {len(robot)} and {len(tracking)} poses; expected as many of both"
        )
    return ArmSamples(robot, tracking, {})


def _poses(array: FloatArray, where: str) -> FloatArray:
    """Poses (N, 4, 4) from matrices or from rows x, y, z, qx, qy, qz, qw."""
    if not np.issubdtype(array.dtype, np.number) or not np.all(np.isfinite(array)):
        raise InputError(f"{where}: a number is not finite")
    if array.ndim == 2 and array.shape[1] == 7:
        norms = np.linalg.norm(array[:, 3:], axis=1, keepdims=True)
        if np.any(np.abs(norms - 1.0) > _ROTATION_WITHIN):
            raise InputError(f"{where}: a quaternion does not have the norm 1")
        return np.asarray(se3.from_quat_xyzw(array[:, :3], array[:, 3:] / norms))
    if array.ndim != 3 or array.shape[1:] != (4, 4):
        raise InputError(f"{where}: expected poses (N, 4, 4) or (N, 7); found {array.shape}")
    rotations = se3.nearest_rotation(array[:, :3, :3])
    if np.any(np.abs(rotations - array[:, :3, :3]) > _ROTATION_WITHIN):
        raise InputError(f"{where}: a matrix is no rotation")
    return np.asarray(se3.from_rotation_translation(rotations, array[:, :3, 3]))
