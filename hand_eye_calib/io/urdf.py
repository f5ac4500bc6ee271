"""Robot descriptions: which frames are fixed to each other, and a joint's origin changed with every
other byte left as it is.

Only plain URDF is understood. A file with xacro macros is refused, as nobody can tell where in it a
value comes from.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.frames import FrameTree
from hand_eye_calib.io.files import read_bytes

LARGEST_URDF = 64 << 20

# The rest of a tag: attributes may have > in them.
_REST = rb"\b(?:[^>\"']|\"[^\"]*\"|'[^']*')*>"
_NOT_TAGS = re.compile(rb"<!--.*?-->|<!\[CDATA\[.*?\]\]>", re.DOTALL)
_JOINT, _ORIGIN = re.compile(rb"<joint" + _REST), re.compile(rb"<origin" + _REST)
# Decimals of the numbers that are written: a millionth of a millimetre.
_DECIMALS = 9


@dataclass
class _Joint:
    """A joint; ``number`` counts the tags of that name in the file."""

    name: str
    is_fixed: bool
    parent: str
    child: str
    xyz_rpy: list[float]
    number: int


class RobotDescription:
    """A URDF file.

    Parameters
    ----------
    path : str or path-like

    Attributes
    ----------
    frames : FrameTree

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
        self._joints = self._read()
        values = np.array([joint.xyz_rpy for joint in self._joints]).reshape(-1, 6)
        rotations = se3.rotation_from_rpy(values[:, 3:])
        poses = se3.from_rotation_translation(rotations, values[:, :3])
        self.frames = FrameTree("the robot description")
        for joint, pose in zip(self._joints, poses, strict=True):
            if joint.child in self.frames.edges:
                raise InputError(f"{self._path}: link {joint.child!r} has two parents")
            self.frames.add(joint.parent, joint.child, pose, joint.is_fixed)

    def patched(self, parent_frame: str, child_frame: str, T_parent_child: FloatArray) -> bytes:
        """The file with one joint's origin changed, so that the child frame has this pose in the
        parent frame.

        Raises
        ------
        InputError
            If not exactly one fixed joint belongs to the child frame alone.
        """
        joint = self._joint_to_change(parent_frame, child_frame)
        above = self.frames.pose(parent_frame, joint.parent)
        below = self.frames.pose(joint.child, child_frame)
        origin = se3.inverse(above) @ T_parent_child @ se3.inverse(below)
        numbers = [
            " ".join(repr(round(float(value), _DECIMALS) + 0.0) for value in values)
            for values in (origin[:3, 3], se3.rotation_to_rpy(origin[:3, :3]))
        ]
        data = self._bytes
        # What is no tag keeps its place.
        tags = _NOT_TAGS.sub(lambda found: b" " * len(found[0]), data)
        start = [*_JOINT.finditer(tags)][joint.number].end()
        found = _ORIGIN.search(tags, start, tags.find(b"</joint", start))
        if found is None:
            tag = f'\n    <origin xyz="{numbers[0]}" rpy="{numbers[1]}"/>'.encode()
            return data[:start] + tag + data[start:]
        tag = data[found.start() : found.end()]
        for name, text in zip(("xyz", "rpy"), numbers, strict=True):
            pattern = rb"(\s" + name.encode() + rb"\s*=\s*)(\"[^\"]*\"|'[^']*')"
            if old := re.search(pattern, tag):
                quote = old[2][:1]
                tag = tag[: old.start()] + old[1] + quote + text.encode() + quote + tag[old.end() :]
            else:
                tag = re.sub(rb"\s*(/?>)$", f' {name}="{text}"'.encode() + rb"\1", tag)
        return data[: found.start()] + tag + data[found.end() :]

    def joint_name(self, parent_frame: str, child_frame: str) -> str:
        """Name of the joint that :meth:`patched` changes."""
        return self._joint_to_change(parent_frame, child_frame).name

    def _read(self) -> list[_Joint]:
        path, data = self._path, self._bytes
        encoding = re.match(rb"<\?xml[^>]*encoding=[\"']([\w-]+)", data)
        name = encoding[1].decode() if encoding else "utf-8"
        if data.startswith((b"\xff\xfe", b"\xfe\xff")):
            name = "UTF-16"
        if name.lower() not in ("utf-8", "us-ascii", "ascii"):
            raise InputError(f"{path}: is in {name}; expected UTF-8")
        if b"<!DOCTYPE" in data:
            raise InputError(f"{path}: has a document type; expected a plain URDF file")
        if macro := re.search(rb"<(xacro:\w+)", _NOT_TAGS.sub(b"", data)):
            raise InputError(
                f"{path}: has xacro macros (<{macro[1].decode()}>); give the URDF that xacro "
                "makes of it, or change the file by hand"
            )
        try:
            root = ElementTree.fromstring(data)
        except ElementTree.ParseError as error:
            raise InputError(f"{path}: not XML: {error}; expected a URDF file") from None
        if root.tag != "robot":
            raise InputError(f"{path}: expected a URDF file, found <{root.tag}>")
        numbers = {element: number for number, element in enumerate(root.iter("joint"))}
        return [self._joint(element, numbers[element]) for element in root.iterfind("joint")]

    def _joint(self, element: ElementTree.Element, number: int) -> _Joint:
        name = element.get("name", "")
        parent, child = (
            found.get("link", "") if (found := element.find(each)) is not None else ""
            for each in ("parent", "child")
        )
        if not parent or not child:
            raise InputError(f"{self._path}: joint {name!r} has no parent or no child")
        origins = element.findall("origin")
        attributes = origins[0].attrib if origins else {}
        if len(origins) > 1 or set(attributes) - {"xyz", "rpy"}:
            raise InputError(
                f"{self._path}: the origin of joint {name!r} is not one pair of xyz and rpy; "
                "change the file by hand"
            )
        try:
            texts = [attributes.get(each, "0 0 0").split() for each in ("xyz", "rpy")]
            values = [float(text) for three in texts for text in three]
        except ValueError:
            values = []
        if len(values) != 6 or not np.isfinite(values).all():
            raise InputError(
                f"{self._path}: the origin of joint {name!r} is not six numbers: {attributes}; "
                "xacro expressions must be evaluated first"
            )
        return _Joint(name, element.get("type") == "fixed", parent, child, values, number)

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
