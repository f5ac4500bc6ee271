"""Several recordings of one rig: how much better is their common result, is its interval honest,
and is a recording that does not belong named?
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
from reproduction.recordings import Rig, Truth
from reproduction.writing import markdown_table

# Simulated rigs: recordings of so many seconds, whose mounts differ by this (m, rad) per axis times
# a factor between 1/2 and 2 that is drawn for each rig.
SIMULATED = ("hand_vio_walk", "agv_ramps", "drone_gnss_vio", "car_ins_lidar")
_SECONDS = 90.0
_RECORDINGS = 6
_SCATTER = np.repeat([0.008, np.radians(0.12)], 3)
# A recording that does not belong: of a mount that was knocked, in a direction that is drawn.
_KNOCK_M = 0.05
_KNOCK_RAD = np.radians(2.0)
_NORMAL_90 = 1.645


@dataclass(frozen=True)
class Recorded:
    """Results of the recordings of one rig by their names, and what is known of it."""

    rig: str
    results: Mapping[str, Calibration]
    truth: Truth | None
    # Of the mount in each recording, which differs from that of the rig.
    own: Mapping[str, Truth] = field(default_factory=dict)


def simulated(name: str, seed: int) -> dict[str, Any]:
    """Plain results of the recordings of a simulated rig, its extrinsic, and those in each."""
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
    """Plain result of a recording."""
    recording = rig.recordings[name]
    return calibrate(
        recording.parent, recording.child, method="auto", **rig.options
    ).to_dict()


def rigs_of(
    solved: Mapping[str, Mapping[str, Any]],
    rigs: Iterable[Rig],
    records: Mapping[str, Any],
) -> Iterator[Recorded]:
    """The rigs from what was solved: simulated ones by their names, recordings by ``RIG NAME``."""
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
    """Errors and coverage by rig; and what is told of recordings that belong, and that do not."""
    rng = np.random.default_rng((34, seed))
    kinds = dict.fromkeys(rig.rig for rig in rigs if rig.truth)
    rows = [
        _row(kind, [rig for rig in rigs if rig.rig == kind]) for kind in kinds
    ]
    named = wrong = cases = accused = several = moved = pairs = 0
    for rig in rigs:
        whole = [rig.results] if len(rig.results) > 3 else []
        for some in (*whole, *_subsets(rig.results, 3)[:2]):
            agreement = together(some).parts["together"]
            several += 1
            accused += agreement is not None and agreement.kind in (
                "one off",
                "moved",
            )
            foreign = str(rng.choice([*some]))
            out = _left_out(
                dict(some) | {foreign: _knocked(some[foreign], rng)}
            )
            cases = cases + 1
            named = named + (out == {foreign})
            wrong += bool(out - {foreign})
        for couple in combinations(rig.results.values(), 2):
            pairs = pairs + 1
            moved = moved + (compare(couple).verdict == "moved")
    return (
        f"{markdown_table(rows)}\n\nIn {cases} sets of three or six recordings, the mount of one "
        f"recording was knocked by {100 * _KNOCK_M:g} cm and {np.degrees(_KNOCK_RAD):g} deg. This "
        f"recording is named in {named} sets, another one in {wrong}. In {several} sets without a "
        f"knock, a recording is named in {accused}. `compare` calls {moved} of {pairs} pairs moved."
    )


def _subsets(
    results: Mapping[str, Calibration], count: int
) -> list[dict[str, Calibration]]:
    return [
        {name: results[name] for name in some}
        for some in combinations(results, count)
    ]


def _row(kind: str, rigs: Sequence[Recorded]) -> dict[str, object]:
    row: dict[str, object] = {"rig": f"{kind} ({len(rigs)})"}
    for count, title in ((1, "one"), (3, "three"), (6, "six")):
        errors: list[list[float]] = []
        inside: list[bool] = []
        for rig in rigs:
            assert rig.truth is not None
            for some in _subsets(rig.results, count):
                joint = (
                    together(some) if count > 1 else next(iter(some.values()))
                )
                is_comparable = np.isfinite(rig.truth.sigmas) & np.isfinite(
                    joint.sigmas_measured
                )
                error = deviation(
                    joint.T_parent_child, rig.truth.T_parent_child
                )
                # One recording shows its own mount only: its interval is of that.
                of = (
                    rig.own.get(min(some), rig.truth)
                    if count == 1
                    else rig.truth
                )
                apart = deviation(joint.T_parent_child, of.T_parent_child)
                stated = (
                    joint.sigmas_measured
                    if "simulated" in kind
                    else joint.sigmas
                )
                sigmas = np.hypot(stated, rig.truth.sigmas)
                inside.extend(
                    (np.abs(apart) < _NORMAL_90 * sigmas)[is_comparable]
                )
                parts = np.split(error * is_comparable, 2)
                errors.append([float(np.linalg.norm(axes)) for axes in parts])
        words = ("-", "-")
        if errors:
            metres, radians = np.median(errors, axis=0)
            words = (
                f"{1e3 * metres:.1f} mm, {np.degrees(radians):.3f} deg",
                f"{100 * np.mean(inside):.0f} %",
            )
        row |= {
            f"error of {title}": words[0],
            f"90 % covers, {title}": words[1],
        }
    return row


def _left_out(results: Mapping[str, Calibration]) -> set[str]:
    agreement = together(results).parts["together"]
    assert agreement is not None
    return {
        recording.name
        for recording in agreement.recordings
        if recording.left_out
    }


def _knocked(result: Calibration, rng: np.random.Generator) -> Calibration:
    """The result that a recording would have given after a knock."""
    directions: FloatArray = rng.standard_normal((2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    xi = np.concatenate([_KNOCK_M * directions[0], _KNOCK_RAD * directions[1]])
    return dataclasses.replace(
        result, T_parent_child=result.T_parent_child @ se3.exp(xi)
    )
