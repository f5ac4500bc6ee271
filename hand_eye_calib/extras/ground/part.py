"""What the ground and gravity measured, as a part of results, and its rule of the verdict."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from hand_eye_calib.core.base.text import listing, with_sigma
from hand_eye_calib.core.results.parts import Part
from hand_eye_calib.core.results.records import ROTATIONS
from hand_eye_calib.core.results.verdict import CONTRADICTED_SIGMAS, Ground


@dataclass(frozen=True)
class GroundAxis:
    """An axis of the extrinsic by the motion alone, and by the ground or gravity alone (m, rad).

    Attributes
    ----------
    name : str
        Axis of the parent.
    motion, motion_sigma : float
        Value and standard deviation; the latter is infinite if the motion does not determine it.
    ground, ground_sigma : float
        Value and standard deviation.
    distance : float
        Difference in joint standard deviations.
    is_from_ground : bool
        Whether the ground at least halves the variance of the result.
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
    """Measurements by the ground and gravity.

    Attributes
    ----------
    parent, child : {"ground", "gravity"}
        What each sensor measured.
    is_joined : bool
        Whether the result contains the measurements. They are left out if they disagree with the
        motion.
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
        """Return a line for each axis."""
        return [_line(value, axis) for axis in value.axes]

    def headline(self, value: GroundResult) -> str:
        """Return which axes are not from the motion."""
        names = [axis.name for axis in value.axes if axis.is_from_ground]
        if not names:
            return ""
        verb = "is" if len(names) == 1 else "are"
        return f"{listing(names)} {verb} mostly from {_source(value)}"


def _source(value: GroundResult) -> str:
    names = [name if name == "gravity" else "the ground" for name in (value.parent, value.child)]
    return listing([*dict.fromkeys(names)])


def _line(value: GroundResult, axis: GroundAxis) -> str:
    by_ground = _number(axis.name, axis.ground, axis.ground_sigma)
    if not np.isfinite(axis.motion_sigma):
        by_motion = "the motion does not determine it"
    else:
        by_motion = f"by motion {_number(axis.name, axis.motion, axis.motion_sigma)}"
    end = "" if value.is_joined else ": not used"
    return f"{axis.name} by {_source(value)}: {by_ground}; {by_motion}{end}"


def _number(name: str, value: float, sigma: float) -> str:
    """Return a value (m or rad) and its standard deviation in m or deg."""
    if name in ROTATIONS:
        return f"{with_sigma(np.degrees(value), np.degrees(sigma), 2)} deg"
    return f"{with_sigma(value, sigma, 3)} m"


def disagreements(result: Any) -> Iterator[Ground]:
    """Yield the ground of the verdict that ground or gravity disagree with the motion."""
    value = result.parts.get("ground")
    if value is None or value.is_joined:
        return
    farthest = max(axis.distance for axis in value.axes)
    # Chi-square may be too large although no axis alone is far.
    limit = min(CONTRADICTED_SIGMAS, farthest)
    far = [axis for axis in value.axes if axis.distance >= limit]
    texts = []
    for axis in far:
        by_ground = _number(axis.name, axis.ground, axis.ground_sigma)
        by_motion = _number(axis.name, axis.motion, axis.motion_sigma)
        texts.append(f"{axis.name} is {by_ground} by {_source(value)}, {by_motion} by the motion")
    names = tuple(axis.name for axis in far)
    yield Ground(
        "; ".join(texts),
        "check that the lidar sees the road (not a loading edge or a ramp), and that clouds and "
        "IMU data are in the frame of the sensor; --ground off leaves them out",
        names,
    )
