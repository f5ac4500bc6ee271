"""Read the installed extrinsic, which the robot uses at present.

Sources are a robot description, an earlier result, a file of another program, a bag, or numbers.
"""

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import EXPORT_FORMATS
from hand_eye_calib.core.base.errors import ConfigError, InputError, located
from hand_eye_calib.core.base.text import frame_name, parse_pose, shown_value
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import (
    Extrinsic,
    FrameTree,
    numbers_of,
    pose_of,
)
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.records import AXES, ROTATIONS, TRANSLATIONS
from hand_eye_calib.formats.exports import Layout, arranged, formats
from hand_eye_calib.formats.files import local_path, read_bytes, similar
from hand_eye_calib.formats.results import FILE_NAME, load_result
from hand_eye_calib.formats.yaml_files import read_yaml

# Value of the key "format" in a result of this package.
_FORMAT = "hand_eye_calib/extrinsic"
# Endings of robot descriptions.
_DESCRIPTIONS = (".urdf", ".xml", ".xacro")
# Endings of results, and of files of other programs.
_DOCUMENTS = (".yaml", ".yml", ".json", ".txt", ".calib")
# Endings of the files of bags.
_BAGS = (".bag", ".mcap", ".db3")
# Description of a file with an extrinsic, for messages.
_EXPECTED = (
    f"a calibration: extrinsic.yaml of this package, or a file of {', '.join(EXPORT_FORMATS)}; "
    "parameters of PX4 have a position but no rotation; set six numbers instead"
)


def _typed_pose(text: str) -> FloatArray:
    """Return the pose (4, 4) from a text of six numbers.

    Raises
    ------
    ConfigError
        If the text is anything else; it is then taken for a file that does not exist.
    """
    try:
        values = parse_pose("installed", text)
    except ConfigError:
        words = text.split()
        if len(words) == len(AXES):
            raise
        are_numbers = all(re.fullmatch(r"-?[\d.]+", word) for word in words)
        if len(words) > 1 and are_numbers:
            raise ConfigError(
                f"installed: {len(words)} numbers; X Y Z ROLL PITCH YAW are {len(AXES)}"
            ) from None
        raise ConfigError(
            f"installed: no file {shown_value(text)}{similar(text)}; expected a URDF, "
            "extrinsic.yaml, a bag, or X Y Z ROLL PITCH YAW in m and rad"
        ) from None
    rotation = se3.rotation_from_rpy(values[3:])
    return se3.from_rotation_translation(rotation, values[:3])


def open_installed(text: str) -> Callable[[str, str], Extrinsic]:
    """Read the source of an installed extrinsic before the frames of the sensors are known.

    Parameters
    ----------
    text : str
        A robot description (``.urdf``), a result (``extrinsic.yaml`` or its directory), a file of
        another program (see formats/exports.py), a bag with ``/tf_static``, or
        ``X Y Z ROLL PITCH YAW`` in m and rad.

    Returns
    -------
    callable
        Function ``find(parent_frame, child_frame)`` that returns the pose of the child sensor in
        the parent sensor's frame. It raises an InputError if the source has no such pose.

    Raises
    ------
    InputError
        If the source cannot be read.
    ConfigError
        If the text is neither a file nor six numbers.
    """
    path = local_path(text)
    if not os.path.exists(path):
        T = _typed_pose(text)
        return lambda parent_frame, child_frame: Extrinsic(T, text)
    if (path / FILE_NAME).exists():
        path = path / FILE_NAME
    if path.suffix in (".tum", ".txt"):
        T = _only_pose(path)
        return lambda parent_frame, child_frame: Extrinsic(T, text)
    if path.suffix in _DESCRIPTIONS:
        find = read_urdf(path).pose
    elif path.suffix in _DOCUMENTS:
        document = read_yaml(path, _EXPECTED)
        if isinstance(document, Mapping) and document.get("format") == _FORMAT:
            return partial(_of_result, load_result(path), path)
        find = partial(_find, document)
    elif path.is_file() and path.suffix not in _BAGS:
        raise InputError(
            f"{path}: unknown kind of file; expected {_EXPECTED}, or a bag"
        )
    else:
        find = frames_of_bag(path).pose
    return partial(stated, find, str(path))


def _only_pose(path: Path) -> FloatArray:
    """Return the pose (4, 4) of a TUM file with one pose, such as the truth of a simulation."""
    lines = read_bytes(path).decode("utf-8", "replace").splitlines()
    rows = [
        line.split()
        for line in lines
        if line.strip() and not line.startswith("#")
    ]
    with located(path):
        if len(rows) != 1:
            raise InputError(
                f"{len(rows)} poses; an installed transform is one pose"
            )
        return pose_of(rows[0][1:])


def stated(
    find: Callable[[str, str], FloatArray],
    origin: str,
    parent_frame: str,
    child_frame: str,
) -> Extrinsic:
    """Return the installed pose of the child sensor in the parent sensor's frame.

    Parameters
    ----------
    find : callable
        Function ``find(parent_frame, child_frame)`` that returns the pose (4, 4).
    origin : str
        Name of the source, for the result and for messages.
    parent_frame, child_frame : str

    Raises
    ------
    InputError
        If the source does not contain this pose.
    """
    with located(origin):
        return Extrinsic(find(parent_frame, child_frame), origin)


def frames_of_bag(path: str | Path) -> FrameTree:
    """Return the tree of the frames in a bag, with the static transforms."""
    from hand_eye_calib.formats.bags.reader import PoseBag

    with PoseBag(path) as bag:
        return bag.static_frames


def _of_result(
    result: Calibration, path: Path, parent_frame: str, child_frame: str
) -> Extrinsic:
    """Return the pose in an earlier result of this package, inverted for exchanged sensors.

    Raises
    ------
    InputError
        If the result is for other sensors.
    """
    result_parent = frame_name(result.parent_frame)
    result_child = frame_name(result.child_frame)
    wanted = (frame_name(parent_frame), frame_name(child_frame))
    if (result_child, result_parent) == wanted:
        result = result.inverse()
    elif (result_parent, result_child) != wanted:
        raise InputError(
            f"{path}: contains {result_child} in {result_parent}; expected "
            f"{child_frame} in {parent_frame}"
        )
    return Extrinsic(
        result.T_parent_child,
        str(path),
        result.covariance_measured,
        is_calibration=True,
    )


# ---- files of other programs


def _find(document: Any, parent_frame: str, child_frame: str) -> FloatArray:
    """Return the pose (4, 4) of the child in the parent's frame, from a document of any layout.

    First choice are transforms with the names of both frames, second choice are the keys of the
    export formats. If a document has a single matrix, this is the last choice.

    Raises
    ------
    InputError
        If the document does not contain this pose.
    """
    nodes = [*_nodes(document, ())]
    frames = FrameTree("the file")
    for path, node in nodes:
        if edge := _named_transform(path, node):
            parent, child, *pose = edge
            frames.add(str(parent), str(child), pose_of(*pose))
    if frames.edges:
        return frames.pose(parent_frame, child_frame)
    for layouts in formats().values():
        fitting = [layout for layout in layouts if _fits(layout, nodes)]
        if fitting:
            layout, is_inverted, _ = arranged(
                fitting, parent_frame, child_frame
            )
            names, values = _of_sensors(
                nodes, layout.keys, {parent_frame, child_frame}
            )
            is_fixed = layout.is_inverted is not None
            if is_fixed and child_frame not in names and parent_frame in names:
                # The file names its child's frame, and this sensor is the parent here.
                is_inverted = not is_inverted
            T = pose_of(*values)
            return se3.inverse(T) if is_inverted else T
    if len(numbers_of(document)) in (12, 16):
        return pose_of(document)
    raise InputError(
        "no transform with position and rotation in it; pass extrinsic.yaml, a URDF, a bag, or "
        '"X Y Z ROLL PITCH YAW"'
    )


def _fits(layout: Layout, nodes: "Sequence[_Node]") -> bool:
    """Return whether a mapping of the document has all keys of the layout."""
    return bool(layout.keys) and any(
        _values_at(node, layout.keys) for _, node in nodes
    )


# Keys that lead to a mapping in a document, and this mapping.
_Node = tuple[tuple[str, ...], Mapping[str, Any]]


def _nodes(document: Any, path: tuple[str, ...]) -> Iterator[_Node]:
    """Iterate over all mappings in a document, at any depth.

    ``path`` are the keys that lead to the document.
    """
    if isinstance(document, Mapping):
        yield path, document
        for name, value in document.items():
            yield from _nodes(value, (*path, str(name)))
    elif isinstance(document, list):
        for item in document:
            yield from _nodes(item, path)


def _named_transform(
    path: tuple[str, ...], node: Mapping[str, Any]
) -> tuple[Any, ...]:
    """Return parent frame, child frame and pose of a mapping that is a transform with names.

    The pose is one value, in any form of :func:`.frames.pose_of`, or two values: translation (m)
    and roll, pitch, yaw (deg). The result is empty for other mappings.
    """
    header = node.get("header")
    parameters = node.get("parameters")
    # TransformStamped of ROS.
    if isinstance(header, Mapping) and "child_frame_id" in node:
        return (
            header.get("frame_id"),
            node["child_frame_id"],
            node.get("transform"),
        )
    # One of several transforms in a list.
    if {"parent", "child", "value"} <= node.keys():
        return node["parent"], node["child"], node["value"]
    # A mapping {parent: {child: {x: ..., yaw: ...}}}.
    if {*AXES} <= node.keys() and len(path) > 1:
        rpy_deg = np.degrees(numbers_of([node[name] for name in ROTATIONS]))
        return *path[-2:], [node[name] for name in TRANSLATIONS], rpy_deg
    # easy_handeye2: the frame of the robot is its base or its hand.
    if isinstance(parameters, Mapping) and "transform" in node:
        is_fixed = parameters.get("calibration_type") == "eye_on_base"
        robot = parameters.get(
            "robot_base_frame" if is_fixed else "robot_effector_frame"
        )
        return robot, parameters.get("tracking_base_frame"), node["transform"]
    return ()


def _of_sensors(
    nodes: list[_Node], keys: Sequence[str], frames: set[str]
) -> tuple[set[str], list[Any]]:
    """Return the values under ``keys`` in the mapping about two sensors, and the frames in it.

    ``frames`` are the frames of both sensors. A mapping names a frame in one of its values, or in a
    key that leads to the mapping. If several mappings have the keys, mappings without the name of a
    frame are ignored.

    Raises
    ------
    InputError
        If there is no mapping, or more than one remains.
    """
    extrinsics = []
    for path, node in nodes:
        if values := _values_at(node, keys):
            names = frames & {frame_name(str(value)) for value in node.values()}
            extrinsics.append((names or frames & {*path}, values))
    if len(extrinsics) > 1:
        extrinsics = [(names, values) for names, values in extrinsics if names]
    if len(extrinsics) != 1:
        raise InputError(
            "it has several extrinsics, and the names of the frames do not "
            f"select one ({' or '.join(sorted(frames))}); delete the others"
        )
    return extrinsics[0]


def _values_at(node: Mapping[str, Any], keys: Sequence[str]) -> list[Any]:
    """Return the values of keys such as ``T`` or ``extrinsics.T``; empty if one is missing."""
    values = []
    for key in keys:
        value: Any = node
        for name in [key] if key in node else key.split("."):
            value = value.get(name) if isinstance(value, Mapping) else None
        if value is None:
            return []
        values.append(value)
    return values


# ---- robot descriptions


def read_urdf(path: str | Path) -> FrameTree:
    """Return the frames of a URDF file.

    Raises
    ------
    InputError
        If the file cannot be read, is not a URDF file, or contains macros of xacro.
    """
    _, frames = read_robot(path)
    return frames


def read_robot(path: str | Path) -> tuple[ElementTree.Element, FrameTree]:
    """Return the root element and the frames of a URDF file; raises as :func:`read_urdf`."""
    data = read_bytes(path)
    with located(path):
        root = _root(data)
        return root, _frames(root)


def _root(data: bytes) -> ElementTree.Element:
    """Return the root element of the text of a URDF file; raises as :func:`read_urdf`."""
    if b"<xacro:" in data:
        raise InputError(
            "has xacro macros; pass the URDF that xacro makes from it"
        )
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise InputError(f"not XML: {error}; expected a URDF file") from None
    if root.tag != "robot":
        raise InputError(f"expected a URDF file, found <{root.tag}>")
    return root


def _frames(root: ElementTree.Element) -> FrameTree:
    """Return the frames of a robot; raises as :func:`read_urdf`."""
    joints = root.findall("joint")
    values = np.array([_origin(joint) for joint in joints]).reshape(-1, 6)
    poses = se3.from_rotation_translation(
        se3.rotation_from_rpy(values[:, 3:]), values[:, :3]
    )
    frames = FrameTree("the robot description")
    for joint, T_parent_child in zip(joints, poses, strict=True):
        elements = [*joint.findall("parent"), *joint.findall("child")]
        links = [element.get("link", "") for element in elements]
        if len(links) != 2 or not all(links):
            raise InputError(
                f"joint {joint.get('name', '')!r} has no parent or no child"
            )
        frames.add(
            links[0], links[1], T_parent_child, joint.get("type") == "fixed"
        )
    return frames


def _origin(joint: ElementTree.Element) -> list[float]:
    """Return x, y, z (m), roll, pitch and yaw (rad) of a joint's origin; 0 without an origin."""
    attributes = {"xyz": "0 0 0", "rpy": "0 0 0"}
    for origin in joint.findall("origin")[:1]:
        attributes |= origin.attrib
    values = numbers_of(" ".join(attributes.values()))
    if (
        len(attributes) != 2
        or len(values) != 6
        or not np.isfinite(values).all()
    ):
        name = joint.get("name", "")
        raise InputError(
            f"the origin of joint {name!r} is not six numbers, xyz and rpy: {attributes}"
        )
    return values
