"""Robot descriptions: which frames are fixed to each other.

Only plain URDF is understood. A file with xacro macros is refused, as nobody can tell where in it a
value comes from.
"""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.frames import FrameTree
from hand_eye_calib.io.files import read_bytes


def read_urdf(path: str | Path) -> FrameTree:
    """The frames of a URDF file; an InputError if it cannot be read, is no URDF, or has xacro in
    it.
    """
    data = read_bytes(path)
    try:
        return _frames(data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _frames(data: bytes) -> FrameTree:
    if b"<xacro:" in data:
        raise InputError("has xacro macros; give the URDF that xacro makes of it")
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise InputError(f"not XML: {error}; expected a URDF file") from None
    if root.tag != "robot":
        raise InputError(f"expected a URDF file, found <{root.tag}>")
    joints = root.findall("joint")
    values = np.array([_origin(joint) for joint in joints]).reshape(-1, 6)
    poses = se3.from_rotation_translation(se3.rotation_from_rpy(values[:, 3:]), values[:, :3])
    found = FrameTree("the robot description")
    for joint, T_parent_child in zip(joints, poses, strict=True):
        links = [
            part.get("link", "") for each in ("parent", "child") for part in joint.findall(each)
        ]
        if len(links) != 2 or not all(links):
            raise InputError(f"joint {joint.get('name', '')!r} has no parent or no child")
        found.add(links[0], links[1], T_parent_child, joint.get("type") == "fixed")
    return found


def _origin(joint: ElementTree.Element) -> list[float]:
    """x, y, z, roll, pitch and yaw of a joint's origin."""
    origin = joint.find("origin")
    attributes = {} if origin is None else dict(origin.attrib)
    try:
        values = [
            float(text) for name in ("xyz", "rpy") for text in attributes.pop(name, "0 0 0").split()
        ]
    except ValueError:
        values = []
    if attributes or len(values) != 6 or not np.isfinite(values).all():
        raise InputError(
            f"the origin of joint {joint.get('name', '')!r} is not six numbers, xyz and rpy: "
            f"{dict(origin.attrib) if origin is not None else {}}"
        )
    return values
