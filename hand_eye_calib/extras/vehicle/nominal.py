"""Nominal sizes of wheels: from a URDF, or from the parameters of a controller."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.text import listing
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import FrameTree
from hand_eye_calib.extras.vehicle.joints import LEFT, RIGHT, is_wheel
from hand_eye_calib.formats.files import read_bytes
from hand_eye_calib.formats.installed import numbers_of, read_robot
from hand_eye_calib.formats.yaml_files import read_yaml

# Parameters of the controllers of ros2_controllers, by the option that they set.
_PARAMETERS = {
    "nominal_radius": (
        "wheel_radius",
        "wheels_radius",
        "traction_wheels_radius",
        "rear_wheels_radius",
    ),
    "nominal_separation": (
        "wheel_separation",
        "traction_track_width",
        "rear_wheel_track",
    ),
}

# Decimals of sizes (m) that are compared.
_DECIMALS = 6


def nominal_sizes(path: str | Path) -> dict[str, float]:
    """Return ``nominal_radius`` and ``nominal_separation`` (m), as far as a file has them.

    Parameters
    ----------
    path : str or path-like
        A URDF file, or a YAML file with the parameters of a controller of ros2_controllers.

    Raises
    ------
    InputError
        If the file cannot be read, has no such size, or has several different ones.
    """
    is_xml = read_bytes(path).lstrip().startswith(b"<")
    values_of_options = _of_urdf(path) if is_xml else _of_controllers(path)
    sizes = {}
    for option, values in values_of_options.items():
        different = sorted({round(value, _DECIMALS) for value in values})
        if len(different) > 1:
            name = option.removeprefix("nominal_")
            texts = listing([f"{value:g}" for value in different])
            raise InputError(
                f"{path}: wheels have a {name} of {texts} m; choose one with "
                f"--{option.replace('_', '-')} in place of this file"
            )
        if different:
            sizes[option] = different[0]
    if not sizes:
        expected = "continuous joints left_wheel and right_wheel with cylinders or spheres"
        if not is_xml:
            expected = "wheel_radius or wheel_separation of a controller"
        raise InputError(f"{path}: no size of wheels; expected {expected}")
    return sizes


def _of_controllers(path: str | Path) -> dict[str, list[float]]:
    """Return the values of each size in the parameters of controllers."""
    values: dict[str, list[float]] = {option: [] for option in _PARAMETERS}
    for mapping in _mappings(read_yaml(path, "parameters of a controller")):
        for option, names in _PARAMETERS.items():
            for name in names:
                if _is_length(mapping.get(name)):
                    values[option].append(float(mapping[name]))
    return values


def _is_length(value: Any) -> bool:
    """Return whether a value is a positive number. Controllers use 0 for an unknown size."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and 0.0 < value < np.inf


def _mappings(document: Any) -> Iterator[Mapping[str, Any]]:
    """Yield a mapping and all mappings in its values."""
    if isinstance(document, Mapping):
        yield document
        for value in document.values():
            yield from _mappings(value)


def _of_urdf(path: str | Path) -> dict[str, list[float]]:
    """Return the radii of the wheels of a robot, and the distances of its pairs of wheels."""
    root, frames = read_robot(path)
    links = {link.get("name", ""): link for link in root.findall("link")}
    wheels = {
        joint.get("name", ""): joint
        for joint in root.findall("joint")
        if joint.get("type") == "continuous" and is_wheel(joint.get("name", ""))
    }
    radii = []
    for joint in wheels.values():
        link = links.get(_link_of(joint))
        if link is not None:
            radii += _radii(link)[:1]
    separations = [
        _separation(frames, left, right) for left, right in _pairs(wheels)
    ]
    return {"nominal_radius": radii, "nominal_separation": separations}


def _link_of(joint: Element) -> str:
    """Return the name of the link below a joint."""
    (child,) = joint.findall("child")
    return child.get("link", "")


def _radii(link: Element) -> list[float]:
    """Return the radii (m) of the cylinders and spheres of a link, those for collisions first."""
    radii = []
    for use in ("collision", "visual"):
        for shape in ("cylinder", "sphere"):
            for element in link.findall(f"{use}/geometry/{shape}"):
                radii += numbers_of(element.get("radius", ""))
    return [radius for radius in radii if _is_length(radius)]


def _pairs(
    wheels: Mapping[str, Element],
) -> Iterator[tuple[Element, Element]]:
    """Yield the joints of wheels whose names differ by left and right only."""
    rights = {
        re.sub(RIGHT, "", name.lower()): joint
        for name, joint in wheels.items()
        if re.search(RIGHT, name.lower())
    }
    for name, joint in wheels.items():
        rest = re.sub(LEFT, "", name.lower())
        if rest != name.lower() and rest in rights:
            yield joint, rights[rest]


def _separation(frames: FrameTree, left: Element, right: Element) -> float:
    """Return the distance (m) of two wheels along the axis of the left wheel."""
    # The wheels move; their joints have these poses at zero.
    at_zero = {
        link: edge.pose
        for link, edge in frames.edges.items()
        if edge.pose is not None
    }
    T_left_right = frames.pose(_link_of(left), _link_of(right), at_zero)
    axis = np.array([1.0, 0.0, 0.0])
    for element in left.findall("axis"):
        axis = np.array(numbers_of(element.get("xyz", "1 0 0")))
    return abs(float(se3.translation_of(T_left_right) @ axis))
