"""Part of a result of stops: the pose of the child's world in the parent's world."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.plain import Document, from_plain
from hand_eye_calib.core.base.text import frame_name
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.covariances import inverse_covariance
from hand_eye_calib.core.results.document import matrix_of
from hand_eye_calib.core.results.parts import ExtraTransform, Part
from hand_eye_calib.core.results.stored import covariance_of, transform_of

# Values of the option ``setup`` (place of the camera of an arm), with their texts.
SETUPS = {"hand": "on the hand", "beside": "beside the robot"}

# Attributes of :class:`Worlds` whose values are texts.
_TEXTS = ("parent_world_frame", "child_world_frame", "setup")


@dataclass(frozen=True, eq=False)
class Worlds:
    """Solution Z of ``A X = Z B``: the pose between both worlds, and the names of the frames.

    Attributes
    ----------
    T_world_world : (4, 4) array
        Pose of the child's world in the parent's world.
    cov_world_world : (6, 6) array
        Covariance of right perturbations of ``T_world_world``, in the frame of the child's world.
    parent_world_frame, child_world_frame : str
        Names of the frames.
    setup : {"", "hand", "beside"}
        Place of the camera of an arm: on the hand or beside the robot; empty without an arm.
    """

    T_world_world: FloatArray
    cov_world_world: FloatArray
    parent_world_frame: str
    child_world_frame: str
    setup: str = ""

    def __post_init__(self) -> None:
        for name in ("parent_world_frame", "child_world_frame"):
            object.__setattr__(self, name, frame_name(getattr(self, name)))


class WorldsPart(Part):
    """Part ``worlds`` of a result: five attributes, stored as five fields of a document."""

    def __init__(self) -> None:
        super().__init__("worlds", lambda: Worlds)
        self.without = {
            "T_world_world": None,
            "cov_world_world": None,
            **dict.fromkeys(_TEXTS, ""),
        }

    def attribute(self, value: Worlds, name: str) -> Any:
        """Return the attribute of the result with this name."""
        return getattr(value, name)

    def write(self, value: Worlds | None) -> Document:
        """Return the fields of a document. T_world_world is left to :meth:`transforms`."""
        if value is None:
            return {"parent_world_frame": "", "child_world_frame": ""}
        document: Document = {
            "parent_world_frame": value.parent_world_frame,
            "child_world_frame": value.child_world_frame,
            "cov_world_world": matrix_of(
                "error xi in T_world_world @ exp(xi)",
                value.child_world_frame,
                value.cov_world_world,
            ),
        }
        if value.setup:
            document["setup"] = value.setup
        return document

    def read(self, document: Mapping[str, Any]) -> Worlds | None:
        """Return the part in a document, or None if it has none."""
        if document.get("T_world_world") is None:
            return None
        return Worlds(
            T_world_world=transform_of(document["T_world_world"]),
            cov_world_world=covariance_of(document["cov_world_world"]),
            **{
                name: from_plain(str, document.get(name, "")) for name in _TEXTS
            },
        )

    def invert(self, value: Worlds) -> Worlds:
        """Return the part for the inverse result, whose parent and child are exchanged."""
        T = value.T_world_world
        return replace(
            value,
            T_world_world=se3.inverse(T),
            cov_world_world=inverse_covariance(T, value.cov_world_world),
            parent_world_frame=value.child_world_frame,
            child_world_frame=value.parent_world_frame,
        )

    def transforms(self, value: Worlds) -> dict[str, ExtraTransform]:
        """Return the transform between both worlds, for documents and exports."""
        transform = ExtraTransform(
            value.T_world_world,
            value.child_world_frame,
            value.parent_world_frame,
            value.cov_world_world,
        )
        return {"T_world_world": transform}

    def headline(self, value: Worlds) -> str:
        """Return the place of the camera; empty without arm."""
        return f"camera {SETUPS[value.setup]}" if value.setup in SETUPS else ""
