"""Extrinsics read from the files of other programs, those of
:data:`~hand_eye_calib.results.exports.FORMATS`.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.extrinsic import Extrinsic
from hand_eye_calib.geometry.frames import FrameTree, checked_pose
from hand_eye_calib.io.files import read_text
from hand_eye_calib.io.limits import LARGEST_YAML
from hand_eye_calib.io.yaml_files import parse_yaml
from hand_eye_calib.results.exports import FORMATS, arranged
from hand_eye_calib.results.status import ROTATIONS, TRANSLATIONS

#: How their files end, beside a result's own.
SUFFIXES = (".yaml", ".yml", ".json", ".txt", ".calib", ".npy")
# A matrix whose rotation is further than this from one is none.
_ROTATION_WITHIN = 1e-3
_EXPECTED = "a calibration: extrinsic.yaml of this package, or a file of " + ", ".join(FORMATS)


def open_export(path: Path) -> "ForeignExtrinsics":
    """Read a file of another program.

    Raises
    ------
    InputError
        If it cannot be read; one line that names the file.
    """
    if path.suffix == ".npy":
        try:
            return ForeignExtrinsics(
                path, np.load(path, allow_pickle=False, mmap_mode="r").tolist()
            )
        except (OSError, ValueError, EOFError) as error:
            raise InputError(f"cannot read {path}: {error}") from None
    text = read_text(path, _EXPECTED, LARGEST_YAML)
    if "EKF2_EV_POS_X" in text or "EKF2_GPS_POS_X" in text:
        raise InputError(
            f"{path}: parameters of PX4 have a position and no rotation; give six numbers instead, "
            '"X Y Z ROLL PITCH YAW"'
        )
    # OpenCV's header and tag are not of YAML, nor are comments of JSON with comments.
    text = re.sub(r"^%YAML.*|^\s*//.*|!!opencv-matrix", "", text, flags=re.MULTILINE)
    return ForeignExtrinsics(path, parse_yaml(text, str(path)))


class ForeignExtrinsics:
    """Extrinsics in a file, of any of the formats."""

    def __init__(self, path: Path, document: Any) -> None:
        self._path, self._document = path, document
        self._nodes = [*_nodes(document, ())]
        self.frames = FrameTree("the file")
        for above, node in self._nodes:
            self._add_named(above, node)

    def of(self, parent_frame: str, child_frame: str) -> Extrinsic:
        """The pose of the child sensor in the parent sensor's frame.

        Raises
        ------
        InputError
            If the file does not have it.
        """
        if self.frames.edges:
            try:
                return Extrinsic(self.frames.pose(parent_frame, child_frame), str(self._path))
            except InputError as error:
                raise InputError(f"{self._path}: {error}") from None
        for layouts in FORMATS.values():
            fitting = [each for each in layouts if each.keys and self._has(each.keys)]
            if fitting:
                layout, is_inverted, _ = arranged(fitting, parent_frame, child_frame)
                T = self._pose(layout.keys, parent_frame, child_frame)
                return Extrinsic(se3.inverse(T) if is_inverted else T, str(self._path))
        if len(numbers := _numbers(self._document)) in (12, 16):
            return Extrinsic(self._checked([numbers]), str(self._path))
        raise InputError(f"{self._path}: expected {_EXPECTED}")

    def _add_named(self, above: tuple[str, ...], node: Mapping[str, Any]) -> None:
        """Add the pose of a node that names both frames."""
        header = node.get("header")
        if isinstance(header, Mapping) and "child_frame_id" in node:  # TransformStamped
            self._add(header.get("frame_id"), node["child_frame_id"], node.get("transform"))
        elif {"parent", "child", "value"} <= node.keys():
            self._add(node["parent"], node["child"], node["value"])
        elif {*TRANSLATIONS, *ROTATIONS} <= node.keys() and len(above) > 1:
            T = _of_angles(_numbers([node[name] for name in (*TRANSLATIONS, *ROTATIONS)]))
            self._add(above[-2], above[-1], T)
        elif isinstance(about := node.get("parameters"), Mapping) and "transform" in node:
            is_fixed = about.get("calibration_type") == "eye_on_base"
            robot = about.get("robot_base_frame" if is_fixed else "robot_effector_frame")
            self._add(robot, about.get("tracking_base_frame"), node["transform"])

    def _add(self, parent: Any, child: Any, pose: Any) -> None:
        if isinstance(pose, Mapping):  # of geometry_msgs/Transform
            t, q = pose.get("translation"), pose.get("rotation")
            if not isinstance(t, Mapping) or not isinstance(q, Mapping):
                raise InputError(f"{self._path}: expected translation and rotation of a transform")
            pose = [*(t.get(axis) for axis in "xyz"), *(q.get(axis) for axis in "xyzw")]
        if not isinstance(pose, np.ndarray):
            pose = self._checked([_numbers(pose)])
        if str(child) not in self.frames.edges:
            self.frames.add(str(parent).lstrip("/"), str(child).lstrip("/"), pose, True)

    def _has(self, keys: tuple[str, ...]) -> bool:
        return any(_at(node, keys) is not None for _, node in self._nodes)

    def _pose(self, keys: tuple[str, ...], parent_frame: str, child_frame: str) -> FloatArray:
        """The pose that stands under some keys; of several, that of these sensors."""
        found = [
            ({*above, *(str(each) for each in node.values())}, values)
            for above, node in self._nodes
            if (values := _at(node, keys)) is not None
        ]
        if len(found) > 1:
            names = {parent_frame, child_frame}
            named = [each for each in found if any(name.strip("/") in names for name in each[0])]
            if len(named) != 1:
                raise InputError(
                    f"{self._path}: has {len(found)} extrinsics, and none or several of them are "
                    f"named {child_frame}; leave the one that is meant"
                )
            found = named
        return self._checked([_numbers(value) for value in found[0][1]])

    def _checked(self, values: list[list[float]]) -> FloatArray:
        """A pose from one or two lists of numbers; how many there are says what they are."""
        sizes, T = tuple(map(len, values)), np.eye(4)
        flat = np.array([number for each in values for number in each])
        try:
            if sizes in ((16,), (12,)):
                T[:3] = flat[:12].reshape(3, 4)
            elif sizes == (7,):
                T = checked_pose(values[0][:3], values[0][3:])
            elif sizes == (3, 4):  # scalar first
                T = checked_pose(values[0], [*values[1][1:], values[1][0]])
            elif sizes == (3, 9):
                T[:3, 3], T[:3, :3] = flat[:3], flat[3:].reshape(3, 3)
            elif sizes == (3, 3):
                T = _of_angles([*flat[:3], *np.radians(flat[3:])])
            else:
                raise InputError("expected a matrix, or translation and rotation, in numbers")
            rotation = se3.nearest_rotation(T[:3, :3])
            if not np.isfinite(T).all() or np.abs(rotation - T[:3, :3]).max() > _ROTATION_WITHIN:
                raise InputError("the rotation is not one, or not finite")
        except (InputError, ValueError, np.linalg.LinAlgError) as error:
            raise InputError(f"{self._path}: {error}") from None
        return se3.from_rotation_translation(rotation, T[:3, 3])


def _nodes(
    document: Any, above: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], Mapping[str, Any]]]:
    """All mappings of a document, each with the keys that lead to it."""
    if isinstance(document, Mapping):
        yield above, document
        for name, each in document.items():
            yield from _nodes(each, (*above, str(name)))
    elif isinstance(document, list):
        for each in document:
            yield from _nodes(each, above)


def _at(node: Mapping[str, Any], keys: tuple[str, ...]) -> list[Any] | None:
    """What stands under keys such as ``T`` or ``extrinsics.T``; None if one is not there."""
    found: list[Any] = []
    for key in keys:
        value: Any = node.get(key)
        if value is None and "." in key:
            first, _, last = key.partition(".")
            inner = node.get(first)
            value = inner.get(last) if isinstance(inner, Mapping) else None
        if value is None:
            return None
        found.append(value)
    return found


def _numbers(value: Any) -> list[float]:
    """The numbers of nested lists, of OpenCV's matrix or of a text, in their order; empty if
    something else is among them.
    """
    if isinstance(value, Mapping):
        return _numbers(value.get("data"))
    if isinstance(value, str):
        value = value.split()
    try:
        return np.array(value, dtype=float).ravel().tolist() if value is not None else []
    except (TypeError, ValueError):
        return []


def _of_angles(values: Any) -> FloatArray:
    """A pose (4, 4) from x, y, z, roll, pitch, yaw."""
    if len(values) != 6:
        raise InputError("expected six numbers: x, y, z, roll, pitch, yaw")
    return se3.from_rotation_translation(
        se3.rotation_from_rpy(np.array(values[3:])), np.array(values[:3])
    )
