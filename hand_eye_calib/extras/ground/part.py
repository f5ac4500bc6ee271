"""Part of a result about the axes that the ground and gravity determine.

The part compares these axes with the same axes from the motion. If both disagree, it also has the
reasons for the verdict.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from hand_eye_calib.core.base.text import listing, with_sigma
from hand_eye_calib.core.results.parts import Part
from hand_eye_calib.core.results.reasons import Ground
from hand_eye_calib.core.results.records import ROTATIONS
from hand_eye_calib.core.results.rules import CONTRADICTED_SIGMAS


@dataclass(frozen=True)
class GroundAxis:
    """Two estimates of one axis of the extrinsic (m, rad): by motion, and by ground or gravity.

    Attributes
    ----------
    name : str
        Axis of the parent.
    motion, motion_sigma : float
        Value and standard deviation from the motion alone. The standard deviation is infinite if
        the motion does not determine the axis.
    ground, ground_sigma : float
        Value and standard deviation from the ground or gravity alone.
    distance : float
        Difference of both values in joint standard deviations.
    is_from_ground : bool
        Whether the ground or gravity at least halves the variance from the motion alone.
    """

    name: str
    motion: float
    motion_sigma: float
    ground: float
    ground_sigma: float
    distance: float
    is_from_ground: bool


@dataclass(frozen=True)
class GroundResult:
    """Measurements of the extrinsic by the ground and gravity.

    Attributes
    ----------
    parent, child : {"ground", "gravity"}
        Quantity that each sensor measured.
    is_joined : bool
        Whether the result uses the measurements. Measurements that disagree with the motion are
        not used.
    axes : tuple of GroundAxis
    """

    parent: str
    child: str
    is_joined: bool
    axes: tuple[GroundAxis, ...]


class GroundPart(Part):
    """The part ``ground`` of a result."""

    def __init__(self) -> None:
        super().__init__("ground", lambda: GroundResult)

    def details(self, value: GroundResult, result: Any) -> list[str]:
        """Return a line of the report for each axis."""
        return [_line(value, axis) for axis in value.axes]

    def headline(self, value: GroundResult) -> str:
        """Return the axes that are mostly from the ground or gravity; empty if there are none."""
        names = [axis.name for axis in value.axes if axis.is_from_ground]
        if not names:
            return ""
        verb = "is" if len(names) == 1 else "are"
        return f"{listing(names)} {verb} mostly from {_source(value)}"


def _source(value: GroundResult) -> str:
    """Return the measured quantities of both sensors, such as "the ground and gravity"."""
    words = {"ground": "the ground", "gravity": "gravity"}
    names = [words[value.parent]]
    if value.child != value.parent:
        names.append(words[value.child])
    return listing(names)


def _line(value: GroundResult, axis: GroundAxis) -> str:
    """Return the line of an axis: its value by the ground or gravity, and by the motion."""
    source = _source(value)
    by_ground = _number(axis.name, axis.ground, axis.ground_sigma)
    by_motion = "the motion does not determine it"
    if np.isfinite(axis.motion_sigma):
        number = _number(axis.name, axis.motion, axis.motion_sigma)
        by_motion = f"by motion {number}"
    end = "" if value.is_joined else ": not used"
    return f"{axis.name} by {source}: {by_ground}; {by_motion}{end}"


def _number(name: str, value: float, sigma: float) -> str:
    """Return a value and its standard deviation (m or rad) as a text in m or deg.

    ``name`` is the axis of the value.
    """
    if name in ROTATIONS:
        value_deg = np.degrees(value)
        sigma_deg = np.degrees(sigma)
        return f"{with_sigma(value_deg, sigma_deg, 2)} deg"
    return f"{with_sigma(value, sigma, 3)} m"


def disagreements(result: Any) -> Iterator[Ground]:
    """Yield the reason of a verdict: the floor or gravity disagrees with the motion."""
    value = result.parts.get("ground")
    if value is None or value.is_joined:
        return
    farthest = max(axis.distance for axis in value.axes)
    # All axes together may contradict the motion (chi-square), although no single axis does. The
    # axis with the largest distance is then named.
    limit = min(CONTRADICTED_SIGMAS, farthest)
    source = _source(value)
    names = []
    texts = []
    for axis in value.axes:
        if axis.distance < limit:
            continue
        by_ground = _number(axis.name, axis.ground, axis.ground_sigma)
        by_motion = _number(axis.name, axis.motion, axis.motion_sigma)
        names.append(axis.name)
        texts.append(
            f"{axis.name} is {by_ground} by {source}, {by_motion} by the motion"
        )
    yield Ground(
        "; ".join(texts),
        "check that the lidar sees the road (not a loading edge or a ramp), and that clouds and "
        "IMU data are in the frame of the sensor; ground off leaves them out",
        tuple(names),
    )
