"""Robot descriptions: which frames are fixed to each other.

Only plain URDF is understood. A file with xacro macros is refused, as nobody can tell where in it a
value comes from.
"""

import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.frames import FrameTree
from hand_eye_calib.io.files import read_bytes

LARGEST_URDF = 64 << 20


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
        try:
            data = read_bytes(Path(path), LARGEST_URDF)
        except OSError as error:
            raise InputError(f"cannot read {path}: {error.strerror}") from None
        try:
            self.frames = _frames(data)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None


def _frames(data: bytes) -> FrameTree:
    if b"<!DOCTYPE" in data:
        raise InputError("has a document type; expected a plain URDF file")
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        if b"<xacro:" not in data:
            raise InputError(f"not XML: {error}; expected a URDF file") from None
    if b"<xacro:" in data:
        raise InputError("has xacro macros; give the URDF that xacro makes of it")
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
        if child in found.edges:
            raise InputError(f"link {child!r} has two parents")
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
    origins, name = joint.findall("origin"), joint.get("name", "")
    attributes = dict(origins[0].attrib) if origins else {}
    if len(origins) > 1 or set(attributes) - {"xyz", "rpy"}:
        raise InputError(f"the origin of joint {name!r} is not one pair of xyz and rpy")
    try:
        texts = (attributes.get(each, "0 0 0").split() for each in ("xyz", "rpy"))
        values = [float(text) for three in texts for text in three]
    except ValueError:
        values = []
    if len(values) != 6 or not all(map(math.isfinite, values)):
        raise InputError(
            f"the origin of joint {name!r} is not six numbers: {attributes}; xacro expressions "
            "must be evaluated first"
        )
    return values
