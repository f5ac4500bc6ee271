"""What is installed now: from a robot description, an earlier result, a file of another program, a
bag, or numbers.
"""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import EXPORT_FORMATS
from hand_eye_calib.core.base.errors import ConfigError, InputError, located
from hand_eye_calib.core.base.text import frame_name, parse_pose
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import Extrinsic, FrameTree, numbers_of, pose_of
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.records import AXES, ROTATIONS, TRANSLATIONS
from hand_eye_calib.formats.exports import arranged, formats
from hand_eye_calib.formats.files import read_bytes
from hand_eye_calib.formats.results import FILE_NAME, load_result
from hand_eye_calib.formats.yaml_files import read_yaml

# Results say what they are.
_FORMAT = "hand_eye_calib/extrinsic"
_DESCRIPTIONS = (".urdf", ".xml", ".xacro")
_DOCUMENTS = (".yaml", ".yml", ".json", ".txt", ".calib")
_EXPECTED = (
    f"a calibration: extrinsic.yaml of this package, or a file of {', '.join(EXPORT_FORMATS)}; "
    "parameters of PX4 have a position and no rotation, give six numbers instead"
)


def open_installed(text: str) -> Callable[[str, str], Extrinsic]:
    """Read what is installed before the sensors' frames are known: the parent's and the child's
    give the pose of the child sensor in the parent sensor's frame, or an InputError.

    Parameters
    ----------
    text : str
        A robot description (``.urdf``), a result (``extrinsic.yaml``, or its directory), a file of
        another program, one of formats/exports.py, a bag with ``/tf_static``, or
        ``X Y Z ROLL PITCH YAW`` in m and rad; an InputError if it cannot be read, a ConfigError if
        it is neither a file nor six numbers.
    """
    path = Path(text)
    if not os.path.exists(text):
        try:
            values = parse_pose("installed", text)
        except ConfigError as error:
            raise ConfigError(
                "what is installed must be a file that exists (URDF, extrinsic.yaml, bag) or six "
                f"numbers in m and rad: {error}"
            ) from None
        T = se3.from_rotation_translation(se3.rotation_from_rpy(values[3:]), values[:3])
        return lambda parent_frame, child_frame: Extrinsic(T, text)
    if (path / FILE_NAME).exists():
        path = path / FILE_NAME
    if path.suffix in _DESCRIPTIONS:
        find = read_urdf(path).pose
    elif path.suffix in _DOCUMENTS:
        document = read_yaml(path, _EXPECTED)
        if isinstance(document, Mapping) and document.get("format") == _FORMAT:
            return partial(_of_result, load_result(path), path)
        find = partial(_find, document)
    else:
        find = frames_of_bag(path).pose
    return partial(stated, find, str(path))


def stated(
    find: Callable[[str, str], FloatArray], origin: str, parent_frame: str, child_frame: str
) -> Extrinsic:
    """The installed pose that a source finds by the names of both frames; if it does not, an
    InputError that begins with the origin.
    """
    with located(origin):
        return Extrinsic(find(parent_frame, child_frame), origin)


def frames_of_bag(path: str | Path) -> FrameTree:
    """The frames of a bag's ``/tf_static``."""
    from hand_eye_calib.formats.bags.reader import PoseBag

    with PoseBag(path) as bag:
        return bag.static_frames


def _of_result(result: Calibration, path: Path, parent_frame: str, child_frame: str) -> Extrinsic:
    found = frame_name(result.parent_frame), frame_name(result.child_frame)
    wanted = frame_name(parent_frame), frame_name(child_frame)
    if found == wanted[::-1]:
        result = result.inverse()
    elif found != wanted:
        raise InputError(
            f"{path}: is about {found[1]} in {found[0]}; expected {child_frame} in {parent_frame}"
        )
    return Extrinsic(
        result.T_parent_child, str(path), result.covariance_measured, is_calibration=True
    )


# ---- files of other programs


def _find(document: Any, parent_frame: str, child_frame: str) -> FloatArray:
    """The pose of the child sensor in the parent sensor's frame, in a document of any format; an
    InputError if it is not there.
    """
    nodes = [*_nodes(document, ())]
    frames = FrameTree("the file")
    for parent, child, *pose in filter(None, (_named(*each) for each in nodes)):
        frames.add(str(parent), str(child), pose_of(*pose))
    if frames.edges:
        return frames.pose(parent_frame, child_frame)
    for layouts in formats().values():
        fitting = [
            each for each in layouts if each.keys and any(_at(node, each.keys) for _, node in nodes)
        ]
        if fitting:
            layout, is_inverted, _ = arranged(fitting, parent_frame, child_frame)
            names, values = _of_sensors(nodes, layout.keys, {parent_frame, child_frame})
            if layout.is_inverted is not None and child_frame not in names:
                is_inverted ^= parent_frame in names  # where the format names its child
            return se3.inverse(pose_of(*values)) if is_inverted else pose_of(*values)
    if len(numbers_of(document)) in (12, 16):
        return pose_of(document)
    raise InputError(f"expected {_EXPECTED}")


# A mapping, and the keys that lead to it.
_Node = tuple[tuple[str, ...], Mapping[str, Any]]


def _nodes(document: Any, above: tuple[str, ...]) -> Iterator[_Node]:
    """All mappings of a document."""
    if isinstance(document, Mapping):
        yield above, document
        for name, each in document.items():
            yield from _nodes(each, (*above, str(name)))
    elif isinstance(document, list):
        for each in document:
            yield from _nodes(each, above)


def _named(above: tuple[str, ...], node: Mapping[str, Any]) -> tuple[Any, ...]:
    """Parent, child and pose of a node that names both frames; empty for another one."""
    header = node.get("header")
    about = node.get("parameters")
    if isinstance(header, Mapping) and "child_frame_id" in node:  # TransformStamped
        return header.get("frame_id"), node["child_frame_id"], node.get("transform")
    if {"parent", "child", "value"} <= node.keys():
        return node["parent"], node["child"], node["value"]
    if {*AXES} <= node.keys() and len(above) > 1:
        rpy_deg = np.degrees(numbers_of([node[name] for name in ROTATIONS]))
        return *above[-2:], [node[name] for name in TRANSLATIONS], rpy_deg
    if isinstance(about, Mapping) and "transform" in node:  # easy_handeye2
        is_fixed = about.get("calibration_type") == "eye_on_base"
        robot = about.get("robot_base_frame" if is_fixed else "robot_effector_frame")
        return robot, about.get("tracking_base_frame"), node["transform"]
    return ()


def _of_sensors(
    nodes: list[_Node], keys: Sequence[str], frames: set[str]
) -> tuple[set[str], list[Any]]:
    """What stands under some keys, and which of the frames name it, beside or else above; of
    several, that of these frames.
    """
    found = []
    for above, node in nodes:
        if values := _at(node, keys):
            beside = frames & {frame_name(str(value)) for value in node.values()}
            found.append((beside or frames & {*above}, values))
    if len(found) > 1:
        found = [each for each in found if each[0]]
    if len(found) != 1:
        raise InputError(
            "it has several extrinsics, and the names of the frames do not say which is meant "
            f"({' or '.join(sorted(frames))}); delete the others"
        )
    return found[0]


def _at(node: Mapping[str, Any], keys: Sequence[str]) -> list[Any]:
    """What stands under keys such as ``T`` or ``extrinsics.T``; empty if one is not there."""
    found = []
    for key in keys:
        value: Any = node
        for part in [key] if key in node else key.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        found.append(value)
    return [] if None in found else found


# ---- robot descriptions


def read_urdf(path: str | Path) -> FrameTree:
    """The frames of a URDF file; an InputError if it cannot be read, is no URDF, or has macros of
    xacro in it, as nobody can tell where in such a file a value comes from.
    """
    data = read_bytes(path)
    with located(path):
        return _frames(data)


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
    given = {"xyz": "0 0 0", "rpy": "0 0 0"} | (origin.attrib if origin is not None else {})
    values = numbers_of(" ".join(given.values()))
    if len(given) != 2 or len(values) != 6 or not np.isfinite(values).all():
        name = joint.get("name", "")
        raise InputError(f"the origin of joint {name!r} is not six numbers, xyz and rpy: {given}")
    return values
