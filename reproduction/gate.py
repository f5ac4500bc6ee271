"""``python -m reproduction.gate --data-folder DATA [--against FOLDER]``: what a change does to
recordings that nobody has tuned on, in ten minutes.

Real recordings with a known answer, random pieces of them, and random platforms, drawn anew at
every run: errors over those of another version of the package (a folder that holds
``hand_eye_calib``), over the Cramer-Rao bound where there is one, NEES, and how often stated 90 %
intervals hold the truth, with the common-mode floor and without.
"""

import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Container, Iterator
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.geometry.se3 import deviation
from hand_eye_calib.core.geometry.trajectory import Trajectory
from reproduction.coverage.mixed import MIXED, make
from reproduction.recordings import between, real_rigs
from reproduction.writing import markdown_table, seed_of, show, study_parser

# Runs with any version since 0.1: the answer, and its covariance without and with the allowance. In
# earlier versions covariance was without it.
_SOLVE = """
import pickle, sys, warnings
import numpy as np
import hand_eye_calib as hec
warnings.simplefilter("ignore")
found = []
for streams, options in pickle.load(open(sys.argv[1], "rb")):
    try:
        result = hec.calibrate(*(hec.Trajectory(*each) for each in streams), **options)
        known = np.isfinite([dof.sigma for dof in result.observability])
        measured = getattr(result, "covariance_measured", result.covariance)
        whole = getattr(result, "covariance_with_floor", result.covariance)
        found.append((result.T_parent_child, measured, whole, known))
    except Exception:
        found.append(None)
pickle.dump(found, open(sys.argv[2], "wb"))
"""

# Shortest and longest pieces, as shares of a recording; fewest poses of one.
_SHARES, _FEWEST = (0.2, 0.7), 100
_90_PERCENT, _MEDIAN_NEES = 1.645, 5.35


class Case(NamedTuple):
    """A recording: its truth, how well that is known (6,), and the bound (6, 6) if there is one."""

    family: str
    streams: tuple[Trajectory, Trajectory]
    options: dict[str, Any]
    T_parent_child: FloatArray
    sigmas: FloatArray
    bound: FloatArray | None = None


def real_cases(
    folder: Path, pieces: int, rng: np.random.Generator, asked: Container[str] = ("time_offset",)
) -> Iterator[Case]:
    """Recordings with a known answer, with some of their options, and random pieces of each."""
    for rig in real_rigs(folder)[0]:
        if rig.truth is None or rig.is_refused or rig.name == "boreas":
            continue
        options = {name: each for name, each in rig.options.items() if name in asked}
        truth = rig.truth.T_parent_child, rig.truth.sigmas
        family = rig.name.split("_")[0] if "kitti" not in rig.name else rig.name
        for recording in rig.recordings.values():
            streams = recording.parent, recording.child
            yield Case(family, streams, options, *truth)
            first = max(each.stamps_ns[0] for each in streams)
            length = min(each.stamps_ns[-1] for each in streams) - first
            for _ in range(pieces):
                share = np.exp(rng.uniform(*np.log(_SHARES)))
                start = first + int(rng.uniform(0.0, 1.0 - share) * length)
                piece = [between(each, start, start + int(share * length)) for each in streams]
                if min(map(len, piece)) >= _FEWEST:
                    yield Case(family, (piece[0], piece[1]), options, *truth)


def simulated_cases(seed: int, repeats: int) -> Iterator[Case]:
    """Random platforms."""
    for number, name in product(range(repeats), MIXED):
        drive = make(name, seed, number)
        truth = drive.T_parent_child, np.zeros(6)
        yield Case(name, (drive.parent, drive.child), {}, *truth, drive.bound())


def solved(cases: list[Case], package: Path, options: dict[str, Any]) -> list[Any]:
    """Answers of the version of the package in a folder."""
    with tempfile.TemporaryDirectory() as folder:
        given, found = (str(Path(folder) / name) for name in ("given", "found"))
        asked = [
            ([(each.stamps_ns, each.poses) for each in case.streams], case.options | options)
            for case in cases
        ]
        Path(given).write_bytes(pickle.dumps(asked))
        environment = os.environ | {"PYTHONPATH": str(package)}
        command = [sys.executable, "-c", _SOLVE, given, found]
        subprocess.run(command, check=True, env=environment, cwd=folder)
        return list(pickle.loads(Path(found).read_bytes()))


def _sizes(case: Case, answer: Any, known: BoolArray) -> FloatArray:
    """Errors of translation and rotation; half of what the truth is not known to counts."""
    known = known & np.isfinite(case.sigmas)
    squares = np.where(
        known, deviation(answer[0], case.T_parent_child) ** 2 + 0.25 * case.sigmas**2, 0.0
    )
    parts = slice(0, 3), slice(3, 6)
    return np.array([np.sqrt(squares[p].sum()) if known[p].any() else np.nan for p in parts])


def row(cases: list[Case], found: list[Any], others: dict[str, list[Any]]) -> dict[str, str]:
    """Figures of the recordings of one family."""
    cells = {"recordings": str(len(cases))}
    for name, answers in others.items():
        logs = [
            np.log(_sizes(case, one, one[3]) / _sizes(case, other, one[3]))
            for case, one, other in zip(cases, found, answers, strict=True)
            if one is not None and other is not None
        ]
        ratios = np.exp(np.nanmean(logs, axis=0)) if logs else [np.nan] * 2
        cells[f"over {name}"] = " ".join(f"{ratio:.2f}" for ratio in ratios)
    inside: list[list[bool]] = [[], []]
    squares, nees = [], []
    for case, one in zip(cases, found, strict=True):
        if one is None:
            continue
        to_parent = np.kron(np.eye(2), one[0][:3, :3])
        off, told = deviation(one[0], case.T_parent_child), one[3] & np.isfinite(case.sigmas)
        for index, covariance in enumerate(one[1:3]):
            variances = np.diag(to_parent @ covariance @ to_parent.T) + case.sigmas**2
            inside[index] += [*(np.abs(off) < _90_PERCENT * np.sqrt(variances))[told]]
        if case.bound is not None and one[3].all():
            xi = to_parent.T @ off
            squares.append(xi @ np.linalg.solve(case.bound, xi))
            nees.append(xi @ np.linalg.solve(one[1], xi))
    cells["in 90 %"], cells["with floor"] = (
        f"{100 * np.mean(each):.0f} %" if each else "" for each in inside
    )
    if squares:
        cells["over bound"] = f"{np.sqrt(np.median(squares) / _MEDIAN_NEES):.2f}"
        cells["NEES"] = f"{np.median(nees):.1f}"
    return cells


def table(cases: list[Case], package: Path, against: Path | None) -> str:
    """A row for every family, and one for all."""
    found = solved(cases, package, {})
    others = {}
    if against is not None:
        others = {
            "its default": solved(cases, against, {}),
            "its adaptive": solved(cases, against, {"method": "adaptive"}),
        }
    rows = []
    families = [*dict.fromkeys(case.family for case in cases)]
    for family in (*families, "all"):
        which = [i for i, case in enumerate(cases) if family in ("all", case.family)]
        rows.append(
            {"family": family}
            | row(
                [cases[i] for i in which],
                [found[i] for i in which],
                {name: [answers[i] for i in which] for name, answers in others.items()},
            )
        )
    columns = [*dict.fromkeys(name for each in rows for name in each)]
    return markdown_table([{name: each.get(name, "") for name in columns} for each in rows])


def main() -> None:
    """Draw, solve and print."""
    parser = study_parser("reproduction.gate", __doc__)
    parser.add_argument("--against", type=Path, help="folder with another version of the package")
    parser.add_argument("--pieces", type=int, default=2, help="of each real recording")
    parser.add_argument("--repeats", type=int, default=4, help="recordings of each platform")
    parser.add_argument("--seed", type=int, help="default: another one at every run")
    arguments = parser.parse_args()
    seed = seed_of(arguments.seed)
    cases = [*simulated_cases(seed, arguments.repeats)]
    if arguments.data_folder:
        rng = np.random.default_rng(seed)
        cases = [*real_cases(arguments.data_folder, arguments.pieces, rng), *cases]
    package = Path(__file__).resolve().parents[1]
    drawn_by = f"Seed {seed}, {len(cases)} recordings."
    show(arguments.page, {"gate": f"{drawn_by}\n\n{table(cases, package, arguments.against)}"})


if __name__ == "__main__":
    main()
