"""Recordings of one rig, compared: nothing has moved between them. And with one of them shifted: is
the shift found where the comparison says that it would be?
"""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hand_eye_calib.arrays import BoolArray
from hand_eye_calib.assessment.covariance import AXES
from hand_eye_calib.calibration import Calibration
from hand_eye_calib.engine.offline import calibrate
from hand_eye_calib.errors import HandEyeCalibError
from hand_eye_calib.geometry import se3
from hand_eye_calib.session.compare import Change, Difference, compare
from reproduction.coverage.real_sets import Rig
from reproduction.writing import markdown_table

# Injected along and about each axis of the parent sensor.
INJECTED = {"3 cm": 0.03, "0.3 deg": float(np.radians(0.3))}


@dataclass(frozen=True)
class Pair:
    """Two recordings of one rig: how they compare as they are, and with a shift of each axis in the
    second one.

    Attributes
    ----------
    rig, names : str
    difference : Difference
    announced, found : (6,) bool arrays
        Whether such a shift would be seen, as the comparison says, and whether it was.
    """

    rig: str
    names: str
    difference: Difference
    announced: BoolArray
    found: BoolArray


def solve(rigs: Sequence[Rig], path: Path) -> dict[str, dict[str, Calibration]]:
    """Results of every recording, and of its halves if it is cut, by rig; those in the file are
    taken from there.
    """
    known = _load(path)
    for rig in rigs:
        for name, recording in rig.recordings.items():
            if name in known.get(rig.name, {}):
                continue
            result = calibrate(recording.parent, recording.child, method="auto", **rig.options)
            _keep(path, rig.name, name, result)
            halves = recording.parts(2, result.time_offset_s) if rig.is_cut else []
            for number, half in enumerate(halves, start=1):
                try:
                    part = calibrate(half.parent, half.child, method="auto", **rig.options)
                except HandEyeCalibError:
                    continue
                _keep(path, f"{rig.name} {name}, halves", f"half {number}", part)
    return _load(path)


def _keep(path: Path, rig: str, name: str, result: Calibration) -> None:
    document = {"rig": rig, "name": name, "result": result.to_dict()}
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(document, allow_nan=False) + "\n")


def _load(path: Path) -> dict[str, dict[str, Calibration]]:
    found: dict[str, dict[str, Calibration]] = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        document = json.loads(line)
        result = Calibration.from_dict(document["result"])
        found.setdefault(document["rig"], {})[document["name"]] = result
    return found


def compared(results: Mapping[str, Mapping[str, Calibration]]) -> list[Pair]:
    """Every pair of results of a rig."""
    return [
        _pair(rig, first, second, named)
        for rig, named in results.items()
        for first, second in itertools.combinations(named, 2)
    ]


def _pair(rig: str, first: str, second: str, named: Mapping[str, Calibration]) -> Pair:
    one, other = named[first], named[second]
    (difference,) = compare([one, other]).differences
    sizes = np.repeat(list(INJECTED.values()), 3)
    found = [
        axis in compare([one, _moved(other, index, size)]).differences[0].axes(Change.MOVED)
        for index, (axis, size) in enumerate(zip(AXES, sizes, strict=True))
    ]
    names = f"{first}, {second}"
    return Pair(rig, names, difference, difference.visible <= sizes, np.array(found))


def _moved(result: Calibration, axis: int, size: float) -> Calibration:
    """The result that the recording would have given with the child shifted along or about an axis
    of the parent sensor.
    """
    T = result.T_parent_child.copy()
    T[:3, 3] += np.eye(6)[axis, :3] * size
    T[:3, :3] = se3.rotation_exp(np.eye(6)[axis, 3:] * size) @ T[:3, :3]
    return dataclasses.replace(result, T_parent_child=T)


def table(pairs: Sequence[Pair]) -> str:
    """A row per pair."""
    header = ("rig", "recordings", "chi2 of 6", "verdict", "would be seen from", "as said found")
    return markdown_table(header, [_row(pair) for pair in pairs])


def _row(pair: Pair) -> tuple[object, ...]:
    visible = pair.difference.visible
    centimetres, degrees = 100 * visible[:3].max(), np.degrees(visible[3:].max())
    announced = int(pair.announced.sum())
    seen_from = f"{degrees:.2f} deg"
    if np.isfinite(centimetres):
        seen_from = f"{centimetres:.1f} cm, {seen_from}"
    return (
        pair.rig, pair.names, f"{pair.difference.chi2:.1f}", pair.difference.verdict.value,
        seen_from,
        f"{int((pair.announced & pair.found).sum())} of {announced}" if announced else "-",
    )  # fmt: skip


def summary(pairs: Sequence[Pair]) -> str:
    """What all pairs say together."""
    moved = sum(pair.difference.verdict is Change.MOVED for pair in pairs)
    announced = np.concatenate([pair.announced for pair in pairs])
    found = np.concatenate([pair.found for pair in pairs])
    return (
        f"Of {len(pairs)} pairs, {moved} are called moved. Of {int(announced.sum())} shifts of "
        f"{' or '.join(INJECTED)} that the comparison says would be seen nine times out of ten, "
        f"{int((announced & found).sum())} are; of the {int((~announced).sum())} others, "
        f"{int((~announced & found).sum())}."
    )
