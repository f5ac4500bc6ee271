"""Samples of a robot arm: at each stop, the poses of the hand and of a target in a camera.

Files that are read:

- MoveIt's calibration: YAML of ``effector_wrt_world`` and ``object_wrt_sensor``, or JSON of pairs
  of matrices;
- easy_handeye and easy_handeye2. Names of frames and the place of the camera are in the samples, or
  in the calibration of the same name;
- pairs ``T1_0``, ``T2_0``, ... in a FileStorage of OpenCV;
- the stacks ``robot`` and ``tracking`` of an ``.npz``;
- the arguments of OpenCV's ``calibrateHandEye`` by their names, in any of these files;
- a folder with a file for each pose (ViSP), see :mod:`hand_eye_calib.extras.stops.pose_files`.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import InputError, located
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import numbers_of, pose_of, pose_stack
from hand_eye_calib.extras.stops.pose_files import read_pose_folder
from hand_eye_calib.formats.files import LONGEST_NAME, path_of
from hand_eye_calib.formats.npz import read_arrays
from hand_eye_calib.formats.saved_results import refuse_saved_result
from hand_eye_calib.formats.yaml_files import read_yaml

# Names of the two poses of a sample in files of other programs: robot first, then target.
_NAMES = (
    ("effector_wrt_world", "object_wrt_sensor"),
    ("robot", "tracking"),
    ("robot", "optical"),
)

# Keys of the names of frames in files of easy_handeye and easy_handeye2.
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

# Name of an argument of OpenCV's solvers, such as R_gripper2base: quantity, source frame, target
# frame.
_OPENCV_NAME = re.compile(r"([a-z]+)_([a-z]+)2([a-z]+)")
# Name of the value of one stop, such as R_gripper2base_0.
_NUMBERED_NAME = re.compile(r"(.*[a-z])_?([0-9]{1,9})")
_QUANTITIES = {
    "r": "rotation",
    "rvec": "rotation",
    "rvecs": "rotation",
    "t": "translation",
    "tvec": "translation",
    "tvecs": "translation",
}
_OPENCV_FRAMES = {
    **dict.fromkeys(
        ("gripper", "hand", "ee", "eef", "flange", "tool", "tcp"), "hand"
    ),
    **dict.fromkeys(("base", "robot"), "base"),
    **dict.fromkeys(
        ("target", "world", "board", "marker", "tag", "object", "obj"), "target"
    ),
    **dict.fromkeys(("cam", "camera", "sensor"), "camera"),
}


# Folder of easy_handeye2's calibrations, beside that of its samples, and the ending of their names.
_CALIBRATIONS = "calibrations"
_CALIBRATION_ENDING = ".calib"

_CALIBRATION = "a calibration of easy_handeye2, in YAML"

# Key of the type of a calibration in files of easy_handeye.
_TYPE = "calibration_type"
_SETUPS = {"eye_in_hand": "hand", "eye_on_base": "beside"}


@dataclass(frozen=True)
class ArmSamples:
    """Samples of an arm: the poses of the hand and of the target at N stops.

    Attributes
    ----------
    robot : (N, 4, 4) array
        Poses of the hand in the robot's base.
    tracking : (N, 4, 4) array
        Poses of the target in the camera.
    frames : mapping of str to str
        Names of the frames, with the keys base, hand, camera and target. Empty if the file has no
        names.
    setup : {"hand", "beside"} or None
        Place of the camera according to the file, if stated.
    calibration : Path or None
        Second file, if ``frames`` and ``setup`` come from it; otherwise None.

    Raises
    ------
    InputError
        If the numbers of poses of the robot and of the target differ.
    """

    robot: FloatArray
    tracking: FloatArray
    frames: Mapping[str, str]
    setup: str | None = None
    calibration: Path | None = None

    def __post_init__(self) -> None:
        if len(self.robot) != len(self.tracking):
            raise InputError(
                f"{len(self.robot)} poses of the robot, {len(self.tracking)} of the target: each "
                "stop needs one of both"
            )


def read_arm_samples(path: str | Path) -> ArmSamples:
    """Read the samples of an arm from a file, or from a folder with a file for each pose.

    ``sample:arm.yaml`` comes with the package.

    Raises
    ------
    InputError
        If the file cannot be read or has no samples. The message has one line and names the file.

    Notes
    -----
    Arguments of OpenCV are read by their names, including base2gripper and cam2target. For a camera
    beside the robot, OpenCV expects the poses of the base in the gripper under the name
    gripper2base. Set ``parent_invert="poses"`` in this case.

    Examples
    --------
    >>> hec.read_arm_samples("samples.yaml").robot.shape
    (40, 4, 4)
    """
    path = path_of("path", path)
    refuse_saved_result(path)
    if path.is_dir():
        robot, tracking = read_pose_folder(path)
        return ArmSamples(robot, tracking, {})
    is_npz = path.suffix == ".npz"
    document: Any = read_arrays(path) if is_npz else read_yaml(path, _EXPECTED)
    if document is None:
        raise InputError(f"{path}: the file is empty; expected {_EXPECTED}")
    with located(path):
        samples = (
            _opencv_samples(document) if isinstance(document, Mapping) else None
        )
        if is_npz:
            samples = samples or _stacked_samples(document)
    return samples or _listed_samples(path, document)


def _listed_samples(path: str | Path, document: Any) -> ArmSamples:
    """Return the samples of a document that lists stop by stop (MoveIt, easy_handeye)."""
    parameters: Mapping[str, Any] = {}
    calibration = None
    if isinstance(document, Mapping) and "samples" in document:
        parameters = _parameters_of(document)
        if not parameters.get(_TYPE):
            calibration = _calibration_beside(Path(path))
        if calibration is not None:
            parameters = _parameters_of(read_yaml(calibration, _CALIBRATION))
    poses = []
    for number, sample in enumerate(_samples_in(path, document), 1):
        with located(f"{path}, sample {number}"):
            poses.append([pose_of(value) for value in _both_poses(sample)])
    robot, tracking = np.swapaxes(poses, 0, 1)
    frames = {
        name: parameters[key]
        for name, key in _FRAMES.items()
        if parameters.get(key)
    }
    setup = _SETUPS.get(str(parameters.get(_TYPE)))
    # For a camera beside the robot, easy_handeye stores the pose of the base in the hand.
    if setup == "beside":
        robot = se3.inverse(robot)
    return ArmSamples(robot, tracking, frames, setup, calibration)


def _samples_in(path: str | Path, document: Any) -> list[Any]:
    """Return the samples of a document, one sample for each stop.

    Raises
    ------
    InputError
        If the document has no samples.
    """
    samples = document
    if isinstance(document, Mapping):
        has_list = "samples" in document
        samples = (
            document["samples"] if has_list else [*_numbered_pairs(document)]
        )
    if not isinstance(samples, list) or not samples:
        empty = "the list of samples is empty; " if samples == [] else ""
        raise InputError(f"{path}: {empty}expected {_EXPECTED}")
    return samples


def _parameters_of(document: Any) -> Mapping[str, Any]:
    """Return the parameters of a document of easy_handeye: names of frames, type of calibration."""
    parameters = (
        document.get("parameters") if isinstance(document, Mapping) else None
    )
    return parameters if isinstance(parameters, Mapping) else {}


def _calibration_beside(samples: Path) -> Path | None:
    """Return easy_handeye2's calibration with the same name as the samples, or None.

    The calibration is in the folder of the samples, or in the folder ``calibrations`` beside it.
    The samples of easy_handeye2 have empty parameters.
    """
    name = samples.with_suffix(_CALIBRATION_ENDING).name
    folder = samples.absolute().parent
    files = (folder / name, folder.parent / _CALIBRATIONS / name)
    return next((file for file in files if file.is_file()), None)


def _stacked_samples(stacks: Mapping[str, FloatArray]) -> ArmSamples:
    """Return the samples of the arrays of an .npz: two stacks of poses, (N, 4, 4) or (N, 7)."""
    for names in _NAMES:
        if {*names} <= stacks.keys():
            robot, tracking = (pose_stack(stacks[name], name) for name in names)
            return ArmSamples(robot, tracking, {})
    raise InputError(
        f"expected {_EXPECTED}; found {', '.join(stacks) or 'nothing'}"
    )


def _numbered_pairs(document: Mapping[str, Any]) -> Iterator[tuple[Any, Any]]:
    """Yield the pairs T1_0, T2_0, T1_1, T2_1, ... of a document."""
    for number in range(len(document)):
        robot = document.get(f"T1_{number}")
        tracking = document.get(f"T2_{number}")
        if robot is not None and tracking is not None:
            yield robot, tracking


def _both_poses(sample: Any) -> Sequence[Any]:
    """Return both poses of a sample, first that of the robot."""
    if isinstance(sample, Mapping):
        names = next(
            (names for names in _NAMES if {*names} <= sample.keys()), ()
        )
        if not names:
            _refuse_half_sample(sample)
        sample = [sample[name] for name in names]
    if not isinstance(sample, Sequence) or len(sample) != 2:
        raise InputError(f"expected {_EXPECTED}")
    return sample


def _refuse_half_sample(sample: Mapping[str, Any]) -> None:
    """Raise an InputError if a sample has only one of both poses."""
    for names in _NAMES:
        missing = [name for name in names if name not in sample]
        if len(missing) == 1:
            (present,) = {*names} - {*missing}
            raise InputError(
                f"{present} has no {missing[0]}; each sample needs both poses: complete or remove "
                "the sample"
            )


# ------------------------------------------------------------------ arguments of OpenCV


def _opencv_samples(document: Mapping[str, Any]) -> ArmSamples | None:
    """Return the samples of a document with OpenCV's arguments, or None if some are missing."""
    # For each pair of source and target frame: rotation and translation.
    transforms: dict[tuple[str, str], dict[str, Any]] = {}
    for name, value in _with_stacks(document).items():
        match = _OPENCV_NAME.fullmatch(name)
        if match is None or match[1] not in _QUANTITIES:
            continue
        frames = (
            _OPENCV_FRAMES.get(match[2], ""),
            _OPENCV_FRAMES.get(match[3], ""),
        )
        transforms.setdefault(frames, {})[_QUANTITIES[match[1]]] = value
    robot = _opencv_poses(transforms, "hand", "base")
    tracking = _opencv_poses(transforms, "target", "camera")
    if robot is None or tracking is None:
        return None
    return ArmSamples(robot, tracking, {})


def _opencv_poses(
    transforms: Mapping[tuple[str, str], Mapping[str, Any]],
    source: str,
    target: str,
) -> FloatArray | None:
    """Return the poses (N, 4, 4) of frame ``source`` in frame ``target``; None if missing.

    If only the poses of ``target`` in ``source`` exist, they are inverted.
    """
    for frames in ((source, target), (target, source)):
        transform = transforms.get(frames, {})
        if {"rotation", "translation"} <= transform.keys():
            pair = _arrays_of(transform["rotation"], transform["translation"])
            Ts = pose_stack(pair, f"{frames[0]} in {frames[1]}")
            return Ts if frames == (source, target) else se3.inverse(Ts)
    return None


def _with_stacks(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document with lower-case names, in which the values of numbered names are lists."""
    values: dict[str, Any] = {}
    stacks: dict[str, dict[int, Any]] = {}
    for key, value in document.items():
        name = str(key)[:LONGEST_NAME].lower()
        numbered = _NUMBERED_NAME.fullmatch(name)
        if numbered is None:
            values[name] = value
        else:
            stacks.setdefault(numbered[1], {})[int(numbered[2])] = value
    for name, stack in stacks.items():
        values.setdefault(name, [stack[number] for number in sorted(stack)])
    return values


def _arrays_of(rotations: Any, translations: Any) -> tuple[Any, Any]:
    """Return rotations and translations of a FileStorage of OpenCV as arrays.

    A FileStorage has one matrix for all stops, or a list with one matrix per stop. Other values are
    returned unchanged.
    """
    if not (_are_matrices(rotations) and _are_matrices(translations)):
        return rotations, translations
    positions = _numbers_of_matrices(translations)
    angles = _numbers_of_matrices(rotations)
    n_stops = len(positions) // 3
    if len(positions) % 3 or len(angles) not in (3 * n_stops, 9 * n_stops):
        raise InputError(
            f"rotations of {len(angles)} numbers and translations of {len(positions)}; each stop "
            "needs 9 or 3 numbers of a rotation and 3 of a translation"
        )
    shape = (3, 3) if len(angles) == 9 * n_stops else (3,)
    return angles.reshape(n_stops, *shape), positions.reshape(n_stops, 3)


def _are_matrices(value: Any) -> bool:
    """Return whether a value is a matrix of a FileStorage, or a list of such matrices."""
    matrices = value if isinstance(value, list) else [value]
    return all(isinstance(matrix, Mapping) for matrix in matrices)


def _numbers_of_matrices(value: Any) -> FloatArray:
    """Return the numbers of one or several matrices of a FileStorage."""
    matrices = value if isinstance(value, list) else [value]
    return np.concatenate([[], *map(numbers_of, matrices)])
