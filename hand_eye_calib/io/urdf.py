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
from hand_eye_calib.io.limits import LARGEST_TEXT


def read_urdf(path: str | Path) -> FrameTree:
    """The frames of a URDF file.

    Raises
    ------
    InputError
        If it cannot be read, is no URDF, or has xacro in it; one line that says why.
    """
    try:
        return _frames(read_bytes(Path(path), LARGEST_TEXT))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _frames(data: bytes) -> FrameTree:
    if b"<!DOCTYPE" in data:
        raise InputError("has a document type; expected a plain URDF file")
    if b"<xacro:" in data:
        raise InputError("has xacro macros; give the URDF that xacro makes of it")
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise InputError(f"not XML: {error}; expected a URDF file") from None
    if root.tag != "robot":
        raise InputError(f"expected a URDF file, found <{root.tag}>")
    joints = root.findall("joint")
    links = [[_link(joint, name) for name in ("parent", "child")] for joint in joints]
    values = np.array([_origin(joint) for joint in joints]).reshape(-1, 6)
    rotations = se3.rotation_from_rpy(values[:, 3:])
    found = FrameTree("the robot description")
    for joint, (parent, child), T_parent_child in zip(
        joints, links, se3.from_rotation_translation(rotations, values[:, :3]), strict=True
    ):
        found.add(parent, child, T_parent_child, joint.get("type") == "fixed")
    return found


def _link(joint: ElementTree.Element, name: str) -> str:
    part = joint.find(name)
    link = part.get("link", "") if part is not None else ""
    if not link:
        raise InputError(f"joint {joint.get('name', '')!r} has no {name}")
    return link


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
