"""Study of several recordings of one rig.

How much more accurate is their common result, does its interval contain the truth, and is a
recording after a knock of the mount detected?
"""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np

from hand_eye_calib.core.assessment.comparison import compare
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import deviation
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.extras.fleet.together import together
from hand_eye_calib.offline.calibrate import calibrate
from reproduction.coverage.classes import CLASSES, simulate
from reproduction.coverage.measures import HALF_WIDTH_90
from reproduction.recordings import Rig, Truth
from reproduction.writing import markdown_table

# Classes of the simulated rigs.
SIMULATED = ("hand_vio_walk", "agv_ramps", "drone_gnss_vio", "car_ins_lidar")
# Duration of a recording (s).
_SECONDS = 90.0
# Number of recordings of a rig.
_RECORDINGS = 6
# Scatter of the mount between recordings, per axis (m, rad). For each rig, the scatter is
# multiplied by a random factor between 1/2 and 2.
_SCATTER = np.repeat([0.008, np.radians(0.12)], 3)
# Shift of the mount of the recording after a knock, in a random direction.
_KNOCK_M = 0.05
_KNOCK_RAD = np.radians(2.0)


@dataclass(frozen=True)
class Recorded:
    """Results of the recordings of one rig by their names, and its true extrinsic."""

    rig: str
    results: Mapping[str, Calibration]
    truth: Truth | None
    # True extrinsic of each recording of a simulated rig, whose mount scatters.
    own: Mapping[str, Truth] = field(default_factory=dict)


def simulated(name: str, seed: int) -> dict[str, Any]:
    """Calibrate the recordings of a simulated rig.

    Returns plain values: results, the extrinsic of the rig, and the extrinsic of each recording.
    """
    kind = dataclasses.replace(CLASSES[name], duration_s=_SECONDS)
    rng = np.random.default_rng((31, seed, sorted(CLASSES).index(name)))
    X = simulate(
        dataclasses.replace(kind, duration_s=5.0), (32, seed)
    ).T_parent_child
    scatter = 2.0 ** rng.uniform(-1.0, 1.0) * _SCATTER
    results = {}
    own = {}
    for number in range(_RECORDINGS):
        made = simulate(
            kind, (33, seed, number, sorted(CLASSES).index(name)), X
        )
        result = calibrate(made.parent, made.child, checks=False)
        moved = se3.exp(scatter * rng.standard_normal(6))
        result = dataclasses.replace(
            result, T_parent_child=result.T_parent_child @ moved
        )
        results[str(number)] = result.to_dict()
        own[str(number)] = (X @ moved).tolist()
    return {"results": results, "truth": X.tolist(), "own": own}


def real(rig: Rig, name: str) -> dict[str, Any]:
    """Calibrate a real recording, and return its result as plain values."""
    recording = rig.recordings[name]
    return calibrate(
        recording.parent, recording.child, method="auto", **rig.options
    ).to_dict()


def rigs_of(
    solved: Mapping[str, Mapping[str, Any]],
    rigs: Iterable[Rig],
    records: Mapping[str, Any],
) -> Iterator[Recorded]:
    """Yield the rigs with their results.

    ``solved`` contains simulated rigs by name. ``records`` contains results of real recordings by
    ``RIG NAME``. The last rig combines both odometries of EuRoC.
    """
    for name, plain in solved.items():
        results = {
            key: Calibration.from_dict(document)
            for key, document in plain["results"].items()
        }
        exact = Truth.within(np.array(plain["truth"]), 0.0, 0.0)
        own = {
            key: Truth.within(np.array(T), 0.0, 0.0)
            for key, T in plain["own"].items()
        }
        yield Recorded(f"simulated {name.split()[0]}", results, exact, own)
    euroc: dict[str, Calibration] = {}
    truth = None
    for rig in rigs:
        results = {
            name: Calibration.from_dict(records[f"{rig.name} {name}"])
            for name in rig.recordings
        }
        yield Recorded(rig.name, results, rig.truth)
        if rig.name.startswith("euroc"):
            truth = rig.truth
            euroc |= {
                f"{rig.name} {name}": result for name, result in results.items()
            }
    if euroc:
        yield Recorded("euroc, both", euroc, truth)


def tables(rigs: Sequence[Recorded], seed: int) -> str:
    """Return a table of errors and coverage by rig, and a text about knocked recordings."""
    rng = np.random.default_rng((34, seed))
    kinds = dict.fromkeys(rig.rig for rig in rigs if rig.truth)
    rows = [
        _row(kind, [rig for rig in rigs if rig.rig == kind]) for kind in kinds
    ]
    n_sets = 0
    n_accused = 0
    n_named = 0
    n_wrong = 0
    n_pairs = 0
    n_moved = 0
    for rig in rigs:
        whole = [rig.results] if len(rig.results) > 3 else []
        for results in (*whole, *_subsets(rig.results, 3)[:2]):
            n_sets += 1
            agreement = together(results).parts["together"]
            if agreement is not None:
                n_accused += agreement.kind in ("one off", "moved")
            knocked = str(rng.choice([*results]))
            changed = {knocked: _knocked(results[knocked], rng)}
            left_out = _left_out(dict(results) | changed)
            n_named += left_out == {knocked}
            n_wrong += bool(left_out - {knocked})
        for pair in combinations(rig.results.values(), 2):
            n_pairs += 1
            n_moved += compare(pair).verdict == "moved"
    return (
        f"{markdown_table(rows)}\n\nIn {n_sets} sets of three or six recordings, the mount of one "
        f"recording was knocked by {100 * _KNOCK_M:g} cm and {np.degrees(_KNOCK_RAD):g} deg. This "
        f"recording is named in {n_named} sets, another recording in {n_wrong}. In the same sets "
        f"without the knock, a recording is named in {n_accused}. `compare` calls {n_moved} of "
        f"{n_pairs} pairs moved."
    )


def _subsets(
    results: Mapping[str, Calibration], count: int
) -> list[dict[str, Calibration]]:
    """Return all choices of ``count`` results, by name."""
    subsets = []
    for names in combinations(results, count):
        subsets.append({name: results[name] for name in names})
    return subsets


def _row(kind: str, rigs: Sequence[Recorded]) -> dict[str, object]:
    """Return the row of a rig: errors and coverage of one, three and six recordings."""
    row: dict[str, object] = {"rig": f"{kind} ({len(rigs)})"}
    for count, title in ((1, "one"), (3, "three"), (6, "six")):
        errors: list[list[float]] = []
        inside: list[bool] = []
        for rig in rigs:
            for results in _subsets(rig.results, count):
                sizes, flags = _errors_of(results, rig)
                errors.append(sizes)
                inside += flags
        error_text = "-"
        coverage_text = "-"
        if errors:
            metres, radians = np.median(errors, axis=0)
            error_text = f"{1e3 * metres:.1f} mm, {np.degrees(radians):.3f} deg"
            coverage_text = f"{100 * np.mean(inside):.0f} %"
        row[f"error of {title}"] = error_text
        row[f"90 % covers, {title}"] = coverage_text
    return row


def _errors_of(
    results: Mapping[str, Calibration], rig: Recorded
) -> tuple[list[float], list[bool]]:
    """Return the errors (m, rad) of the common result, and whether axes are in their intervals."""
    assert rig.truth is not None
    truth = rig.truth
    (name, joint), *others = results.items()
    own_truth = rig.own.get(name, truth)
    if others:
        joint = together(results)
        own_truth = truth
    is_known = np.isfinite(truth.sigmas)
    is_comparable = is_known & np.isfinite(joint.sigmas_measured)
    error = deviation(joint.T_parent_child, truth.T_parent_child)
    sizes = [
        float(np.linalg.norm(axes))
        for axes in np.split(error * is_comparable, 2)
    ]
    # The interval of a single recording is about the mount during this recording.
    own_error = deviation(joint.T_parent_child, own_truth.T_parent_child)
    is_simulated = bool(rig.own)
    stated = joint.sigmas_measured if is_simulated else joint.sigmas
    sigmas = np.hypot(stated, truth.sigmas)
    is_inside = np.abs(own_error) < HALF_WIDTH_90 * sigmas
    return sizes, is_inside[is_comparable].tolist()


def _left_out(results: Mapping[str, Calibration]) -> set[str]:
    agreement = together(results).parts["together"]
    assert agreement is not None
    return {
        recording.name
        for recording in agreement.recordings
        if recording.left_out
    }


def _knocked(result: Calibration, rng: np.random.Generator) -> Calibration:
    """Return the result of a recording as if it were recorded after a knock of the mount."""
    directions: FloatArray = rng.standard_normal((2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    xi = np.concatenate([_KNOCK_M * directions[0], _KNOCK_RAD * directions[1]])
    return dataclasses.replace(
        result, T_parent_child=result.T_parent_child @ se3.exp(xi)
    )
