"""Measurements of the extrinsic from the bag of a recording, in addition to its motion."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hand_eye_calib.core.base.registry import BESIDE_MOTION

if TYPE_CHECKING:
    from hand_eye_calib.core.engine.snapshot import Snapshot


def switched_off(values: Mapping[str, Any]) -> list[str]:
    """Return the names of the sources that options or parsed arguments switch off."""
    return [name for name in BESIDE_MOTION if values.get(name) == "off"]


def with_measurements(
    snapshot: "Snapshot", paths: Sequence[Path], without: Collection[str] = ()
) -> "tuple[Snapshot, list[str]]":
    """Add the measurements in a bag that do not come from motion, and the paths of the bag.

    Parameters
    ----------
    snapshot : Snapshot
        Streams of the bag.
    paths : sequence of Path
        The bag, or its parts.
    without : collection of str
        Names of the sources that are switched off.

    Returns
    -------
    snapshot : Snapshot
    notes : list of str
        Which topics are used, and why other topics are not.
    """
    measurements: list[Any] = []
    notes: list[str] = []
    for name, source in BESIDE_MOTION.items():
        if name in without:
            continue
        found, remarks = source.find(paths, snapshot)
        measurements += found
        notes += remarks
    measured = replace(
        snapshot, beside_motion=tuple(measurements), bags=tuple(paths)
    )
    return measured, notes
