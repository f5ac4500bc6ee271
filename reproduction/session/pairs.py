"""Recordings of one rig, compared: nothing has moved between them. And with one of them shifted: is
the shift found where the comparison says that it would be?
"""

import dataclasses
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hand_eye_calib.arrays import BoolArray
from hand_eye_calib.assessment.covariance import AXES
from hand_eye_calib.engine.offline import calibrate
from hand_eye_calib.errors import HandEyeCalibError
from hand_eye_calib.geometry import se3
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.session.compare import Change, Difference, compare
from reproduction.recordings import Rig
from reproduction.writing import counted, markdown_table

# Injected along and about each axis of the parent sensor.
INJECTED = {"3 cm": 0.03, "0.3 deg": float(np.radians(0.3))}


@dataclass(frozen=True)
class Pair:
    """Two recordings of one rig: how they compare as they are, and with a shift of each axis in the
    second one.
    """

    rig: str
    names: str
    difference: Difference
    # Whether such a shift would be seen, as the comparison says, and whether it was (6,).
    announced: BoolArray
    found: BoolArray


def solved(rig: Rig, name: str) -> dict[str, dict[str, Any]]:
    """Plain results of a recording, and of its halves if it is cut: group to name to result."""
    recording = rig.recordings[name]
    result = calibrate(recording.parent, recording.child, method="auto", **rig.options)
    halves: dict[str, Any] = {}
    for number, half in enumerate(
        recording.parts(2, result.time_offset_s) if rig.is_cut else (), 1
    ):
        try:
            part = calibrate(half.parent, half.child, method="auto", **rig.options)
        except HandEyeCalibError:
            continue
        halves[f"half {number}"] = part.to_dict()
    return {rig.name: {name: result.to_dict()}, f"{rig.name} {name}, halves": halves}


def compared(results: Iterable[Mapping[str, Mapping[str, Any]]]) -> list[Pair]:
    """Every pair of results of a group."""
    groups: dict[str, dict[str, Calibration]] = {}
    for of_recording in results:
        for group, named in of_recording.items():
            found = {name: Calibration.from_dict(plain) for name, plain in named.items()}
            groups.setdefault(group, {}).update(found)
    return [
        _pair(group, first, second, named)
        for group, named in groups.items()
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
    """A row per rig."""
    rigs: dict[str, list[Pair]] = {}
    for pair in pairs:
        rigs.setdefault(pair.rig.split(" ")[0], []).append(pair)
    return markdown_table(_row(rig, of_rig) for rig, of_rig in rigs.items())


def _row(rig: str, pairs: Sequence[Pair]) -> dict[str, object]:
    metres, radians = (
        min(pair.difference.visible[part].max() for pair in pairs)
        for part in (slice(0, 3), slice(3, 6))
    )
    return {
        "rig": rig,
        "pairs": len(pairs),
        "verdicts": counted(pair.difference.verdict.value for pair in pairs),
        "largest chi2 of 6": f"{max(pair.difference.chi2 for pair in pairs):.1f}",
        "best pair: would be seen from": (f"{100 * metres:.1f} cm, {np.degrees(radians):.2f} deg"),
        "shifts as said found": (
            f"{sum(int((pair.announced & pair.found).sum()) for pair in pairs)} of "
            f"{sum(int(pair.announced.sum()) for pair in pairs)}"
        ),
    }


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
