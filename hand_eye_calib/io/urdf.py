"""Robot descriptions: which frames are fixed to each other, and a joint's origin changed with every
other byte left as it is.

Only plain URDF is understood. A file with xacro macros is refused, as nobody can tell where in it a
value comes from.
"""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.frames import FrameTree
from hand_eye_calib.io.files import read_bytes

LARGEST_URDF = 64 << 20

# A tag: attributes may have > in them.
_TAG = re.compile(rb"(?:[^>\"']|\"[^\"]*\"|'[^']*')*>")
# Decimals of the numbers that are written: a millionth of a millimetre.
_DECIMALS = 9


@dataclass
class _Joint:
    """A joint: names, and where its tags are in the file, in bytes."""

    name: str
    kind: str
    parent: str = ""
    child: str = ""
    xyz_rpy: tuple[float, ...] = (0.0,) * 6
    T_parent_child: FloatArray | None = None
    start: tuple[int, int] = (0, 0)
    origin: tuple[int, int] | None = None


class RobotDescription:
    """A URDF file.

    Parameters
    ----------
    path : str or path-like

    Raises
    ------
    InputError
        If it cannot be read, is no URDF, or has xacro in it; one line that says why.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        try:
            self._bytes = read_bytes(self._path, LARGEST_URDF)
        except OSError as error:
            raise InputError(f"cannot read {path}: {error.strerror}") from None
        self._joints = _Reader(self._path, self._bytes).joints
        self.frames = self._frames()

    def patched(self, parent_frame: str, child_frame: str, T_parent_child: FloatArray) -> bytes:
        """The file with one joint's origin changed, so that the child frame has this pose in the
        parent frame.

        Raises
        ------
        InputError
            If not exactly one fixed joint belongs to the child frame alone.
        """
        joint = self._joint_to_change(parent_frame, child_frame)
        assert joint.T_parent_child is not None
        above = self.frames.pose(parent_frame, joint.parent)
        below = self.frames.pose(joint.child, child_frame)
        origin = se3.inverse(above) @ T_parent_child @ se3.inverse(below)
        return self._with_origin(joint, origin)

    def joint_name(self, parent_frame: str, child_frame: str) -> str:
        """Name of the joint that :meth:`patched` changes."""
        return self._joint_to_change(parent_frame, child_frame).name

    def _frames(self) -> FrameTree:
        found = FrameTree("the robot description")
        for joint in self._joints:
            if joint.child in found.edges:
                raise InputError(f"{self._path}: link {joint.child!r} has two parents")
            found.add(joint.parent, joint.child, joint.T_parent_child, joint.kind == "fixed")
        return found

    def _joint_to_change(self, parent_frame: str, child_frame: str) -> _Joint:
        try:
            self.frames.pose(parent_frame, child_frame)  # raises if they are not fixed
            _, path = self.frames.route(parent_frame, child_frame)
        except InputError as error:
            raise InputError(f"{self._path}: {error}") from None
        joints = [joint for joint in self._joints if joint.child in path]
        if len(joints) == 1:
            return joints[0]
        if not joints:
            raise InputError(
                f"{self._path}: {parent_frame} is mounted on {child_frame}, so that no joint "
                "belongs to the child sensor alone; change the file by hand"
            )
        names = ", ".join(joint.name for joint in joints)
        raise InputError(
            f"{self._path}: {len(joints)} joints lead to {child_frame} ({names}), and any of them "
            "may be wrong; change the file by hand"
        )

    def _with_origin(self, joint: _Joint, origin: FloatArray) -> bytes:
        xyz = _numbers(origin[:3, 3])
        rpy = _numbers(se3.rotation_to_rpy(origin[:3, :3]))
        if joint.origin is None:
            end = joint.start[1]
            tag = f'\n    <origin xyz="{xyz}" rpy="{rpy}"/>'.encode()
            return self._bytes[:end] + tag + self._bytes[end:]
        start, end = joint.origin
        tag = self._bytes[start:end]
        for name, numbers in (("xyz", xyz), ("rpy", rpy)):
            tag = _with_attribute(tag, name, numbers)
        return self._bytes[:start] + tag + self._bytes[end:]


class _Reader:
    """Reads the joints of a file, with the places of their tags."""

    def __init__(self, path: Path, data: bytes) -> None:
        self.joints: list[_Joint] = []
        self._path, self._data = path, data
        self._open: list[str] = []
        if data.startswith((b"\xff\xfe", b"\xfe\xff")):
            raise InputError(f"{path}: is in UTF-16; expected UTF-8")
        self._parser = expat.ParserCreate()
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.StartDoctypeDeclHandler = self._refuse_doctype
        self._parser.XmlDeclHandler = self._check_encoding
        try:
            self._parser.Parse(data, True)
        except expat.ExpatError as error:
            raise InputError(f"{path}: not XML: {error}; expected a URDF file") from None
        for joint in self.joints:
            if not joint.parent or not joint.child:
                raise InputError(f"{path}: joint {joint.name!r} has no parent or no child")
        values = np.array([joint.xyz_rpy for joint in self.joints]).reshape(-1, 6)
        rotations = se3.rotation_from_rpy(values[:, 3:])
        poses = se3.from_rotation_translation(rotations, values[:, :3])
        for joint, pose in zip(self.joints, poses, strict=True):
            joint.T_parent_child = pose

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        if not self._open and name != "robot":
            raise InputError(f"{self._path}: expected a URDF file, found <{name}>")
        if name.startswith("xacro:"):
            raise InputError(
                f"{self._path}: has xacro macros (<{name}>); give the URDF that xacro makes of it, "
                "or change the file by hand"
            )
        if self._open == ["robot"] and name == "joint":
            joint = _Joint(attributes.get("name", ""), attributes.get("type", ""))
            joint.start = self._place()
            self.joints.append(joint)
        elif self._open == ["robot", "joint"]:
            self._part_of_joint(self.joints[-1], name, attributes)
        self._open.append(name)

    def _part_of_joint(self, joint: _Joint, name: str, attributes: dict[str, str]) -> None:
        if name in ("parent", "child"):
            setattr(joint, name, attributes.get("link", ""))
        elif name == "origin":
            if joint.origin is not None or set(attributes) - {"xyz", "rpy"}:
                raise InputError(
                    f"{self._path}: the origin of joint {joint.name!r} is not one pair of xyz and "
                    "rpy; change the file by hand"
                )
            joint.origin = self._place()
            joint.xyz_rpy = self._numbers(joint, attributes)

    def _numbers(self, joint: _Joint, attributes: dict[str, str]) -> tuple[float, ...]:
        try:
            texts = (attributes.get(name, "0 0 0").split() for name in ("xyz", "rpy"))
            values = tuple(float(text) for three in texts for text in three)
        except ValueError:
            values = ()
        if len(values) != 6 or not all(map(math.isfinite, values)):
            raise InputError(
                f"{self._path}: the origin of joint {joint.name!r} is not six numbers: "
                f"{attributes}; xacro expressions must be evaluated first"
            )
        return values

    def _place(self) -> tuple[int, int]:
        """Bytes from the beginning to the end of the tag that is being read."""
        start = self._parser.CurrentByteIndex
        found = _TAG.match(self._data, start)
        return start, found.end() if found else start

    def _end(self, name: str) -> None:
        self._open.pop()

    def _refuse_doctype(self, *_: Any) -> None:
        raise InputError(f"{self._path}: has a document type; expected a plain URDF file")

    def _check_encoding(self, version: str, encoding: str | None, standalone: int) -> None:
        if (encoding or "utf-8").lower() not in ("utf-8", "us-ascii", "ascii"):
            raise InputError(f"{self._path}: is in {encoding}; expected UTF-8")


def _with_attribute(tag: bytes, name: str, value: str) -> bytes:
    """A tag with this value of an attribute, which is added if it is missing."""
    pattern = re.compile(rb"(\s" + name.encode() + rb"\s*=\s*)(\"[^\"]*\"|'[^']*')")
    changed, count = pattern.subn(
        lambda found: found[1] + found[2][:1] + value.encode() + found[2][:1], tag
    )
    if count:
        return changed
    return re.sub(rb"\s*(/?>)$", lambda end: f' {name}="{value}"'.encode() + end[1], tag)


def _numbers(values: FloatArray) -> str:
    return " ".join(repr(round(float(value), _DECIMALS) + 0.0) for value in values)
