"""Read folders with a file for each pose of an arm, such as ``pose_fPe_1.yaml`` of ViSP.

A file contains a matrix (4 x 4 or 3 x 4), ``x y z qx qy qz qw``, or a position and a rotation
vector (ViSP). Formats are text, YAML, JSON, and YAML of OpenCV (Zivid). The name of the file has
the number of the stop. The name of the file or of its folder has a word for the side, such as
``robot`` or ``target``.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import InputError, located
from hand_eye_calib.core.base.text import listing
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import numbers_of, pose_of, words_of
from hand_eye_calib.formats.files import read_text
from hand_eye_calib.formats.yaml_files import read_yaml

_SUFFIXES = (".yaml", ".yml", ".json", ".txt")

# Words in file names that stand for a side. ViSP names the pose of b in a ``aPb``, where f is the
# base, e the end effector, c the camera and o the object (target).
_ROBOT_WORDS = {
    "pe",
    "robot",
    "hand",
    "gripper",
    "flange",
    "ee",
    "eef",
    "tcp",
    "tool",
}
_TARGET_WORDS = {
    "po",
    "target",
    "marker",
    "board",
    "tag",
    "object",
    "camera",
    "cam",
    "tracking",
}

# Words for poses of the robot, used if no file name has a word above, as in ``pos01.yaml`` of
# Zivid.
_POSE_WORDS = {"pos", "pose", "poses"}

# Name of a file without its suffix: words, then the number of the stop.
_NUMBERED_NAME = re.compile(r"(.*?)([0-9]{1,9})")

# Count of numbers in a position and a rotation vector together.
_N_OF_VECTOR = 6


def files_of_sides(folder: Path) -> tuple[dict[int, Path], dict[int, Path]]:
    """Return the files of the robot and of the target in a folder, by the number of the stop.

    The files are in the folder or in its subfolders. Files without a word for a side are ignored.
    Exception: ``pos01.yaml`` belongs to the robot if no other file does.
    """
    robot: dict[int, Path] = {}
    target: dict[int, Path] = {}
    poses: dict[int, Path] = {}
    for path in sorted([*folder.glob("*"), *folder.glob("*/*")]):
        numbered = _NUMBERED_NAME.fullmatch(path.stem)
        if numbered is None or path.suffix not in _SUFFIXES:
            continue
        words = words_of(numbered[1])
        if path.parent != folder:
            words |= words_of(path.parent.name)
        stop = int(numbered[2])
        if words & _ROBOT_WORDS:
            robot[stop] = path
        elif words & _TARGET_WORDS:
            target[stop] = path
        elif words & _POSE_WORDS:
            poses[stop] = path
    return robot or poses, target


def is_pose_folder(path: Path) -> bool:
    """Return whether a path is a folder with pose files of the robot and of the target."""
    return path.is_dir() and all(files_of_sides(path))


def read_pose_folder(folder: Path) -> tuple[FloatArray, FloatArray]:
    """Return the poses (N, 4, 4) of the robot and of the target in a folder.

    Raises
    ------
    InputError
        If a file contains no pose, or a stop has only one of both poses.
    """
    robot, target = files_of_sides(folder)
    if not (robot and target):
        raise InputError(
            f"{folder}: expected a file for each pose, such as robot_1.txt and target_1.txt"
        )
    incomplete = sorted(robot.keys() ^ target.keys())
    if incomplete:
        numbers = listing([str(stop) for stop in incomplete[:8]])
        raise InputError(
            f"{folder}: each stop needs both poses; incomplete: {numbers}"
        )
    stops = sorted(robot)
    Ts_base_hand = np.stack([_read_pose(robot[stop]) for stop in stops])
    Ts_camera_target = np.stack([_read_pose(target[stop]) for stop in stops])
    return Ts_base_hand, Ts_camera_target


def read_robot_folder(folder: Path) -> FloatArray:
    """Return the poses (N, 4, 4) of the robot in a folder, in the order of their numbers.

    Raises
    ------
    InputError
        If the folder contains no such file, or a file contains no pose.
    """
    robot, _ = files_of_sides(folder)
    if not robot:
        raise InputError(
            f"{folder}: expected a file for each pose of the hand, such as robot_1.txt"
        )
    return np.stack([_read_pose(robot[stop]) for stop in sorted(robot)])


def _read_pose(path: Path) -> FloatArray:
    """Return the pose (4, 4) of a file."""
    if path.suffix == ".txt":
        document: Any = re.split(r"[\s,;]+", read_text(path, "a pose").strip())
    else:
        document = read_yaml(path, "a pose")
    with located(path):
        values = numbers_of(_only_value(document))
        if len(values) == _N_OF_VECTOR:
            rotation = se3.rotation_exp(np.array(values[3:]))
            return se3.from_rotation_translation(rotation, np.array(values[:3]))
        return pose_of(values)


def _only_value(document: Any) -> Any:
    """Return the value of a document that has a single name, such as ``PoseState`` of Zivid."""
    while isinstance(document, Mapping) and len(document) == 1:
        (document,) = document.values()
    return document
