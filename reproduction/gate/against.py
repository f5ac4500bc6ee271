"""Answers of this version and of another one on the same recordings.

Errors over those of the other version, over the Cramer-Rao bound where there is one, NEES, and how
often stated 90 % intervals hold the truth, with the common-mode floor and without.
"""

import os
import pickle
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.geometry.se3 import deviation
from reproduction.coverage.measures import MEDIAN_6
from reproduction.gate.cases import Case
from reproduction.writing import markdown_table

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

_90_PERCENT = 1.645


def solved(cases: list[Case], package: Path, options: dict[str, Any]) -> list[Any]:
    """Answers of the version of the package in a folder."""
    with tempfile.TemporaryDirectory() as folder:
        cases_file, answers_file = (
            str(Path(folder) / name) for name in ("given", "found")
        )
        asked = [
            (
                [(stream.stamps_ns, stream.poses) for stream in case.streams],
                case.options | options,
            )
            for case in cases
        ]
        Path(cases_file).write_bytes(pickle.dumps(asked))
        environment = os.environ | {"PYTHONPATH": str(package)}
        command = [sys.executable, "-c", _SOLVE, cases_file, answers_file]
        subprocess.run(command, check=True, env=environment, cwd=folder)
        return list(pickle.loads(Path(answers_file).read_bytes()))


def _sizes(case: Case, answer: Any, is_determined: BoolArray) -> FloatArray:
    """Errors of translation and rotation; half of what the truth is not known to counts."""
    is_determined = is_determined & np.isfinite(case.sigmas)
    squares = np.where(
        is_determined,
        deviation(answer[0], case.T_parent_child) ** 2 + 0.25 * case.sigmas**2,
        0.0,
    )
    parts = slice(0, 3), slice(3, 6)
    return np.array(
        [np.sqrt(squares[p].sum()) if is_determined[p].any() else np.nan for p in parts]
    )


def row(
    cases: list[Case], own_answers: list[Any], others: dict[str, list[Any]]
) -> dict[str, str]:
    """Figures of the recordings of one family."""
    cells = {"recordings": str(len(cases))}
    for name, answers in others.items():
        logs = [
            np.log(_sizes(case, answer, answer[3]) / _sizes(case, other, answer[3]))
            for case, answer, other in zip(cases, own_answers, answers, strict=True)
            if answer is not None and other is not None
        ]
        ratios = np.exp(np.nanmean(logs, axis=0)) if logs else [np.nan] * 2
        cells[f"over {name}"] = " ".join(f"{ratio:.2f}" for ratio in ratios)
    inside: list[list[bool]] = [[], []]
    squares = []
    nees = []
    for case, answer in zip(cases, own_answers, strict=True):
        if answer is None:
            continue
        to_parent = np.kron(np.eye(2), answer[0][:3, :3])
        off = deviation(answer[0], case.T_parent_child)
        is_comparable = answer[3] & np.isfinite(case.sigmas)
        for index, covariance in enumerate(answer[1:3]):
            variances = np.diag(to_parent @ covariance @ to_parent.T) + case.sigmas**2
            inside[index] += [
                *(np.abs(off) < _90_PERCENT * np.sqrt(variances))[is_comparable]
            ]
        if case.bound is not None and answer[3].all():
            xi = to_parent.T @ off
            squares.append(xi @ np.linalg.solve(case.bound, xi))
            nees.append(xi @ np.linalg.solve(answer[1], xi))
    cells["in 90 %"], cells["with floor"] = (
        f"{100 * np.mean(values):.0f} %" if values else "" for values in inside
    )
    if squares:
        cells["over bound"] = f"{np.sqrt(np.median(squares) / MEDIAN_6):.2f}"
        cells["NEES"] = f"{np.median(nees):.1f}"
    return cells


def table(cases: list[Case], package: Path, against: Path) -> str:
    """A row for every family, and one for all."""
    own_answers = solved(cases, package, {})
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
                [own_answers[i] for i in which],
                {name: [answers[i] for i in which] for name, answers in others.items()},
            )
        )
    columns = [*dict.fromkeys(name for cells_of_row in rows for name in cells_of_row)]
    return markdown_table(
        [
            {name: cells_of_row.get(name, "") for name in columns}
            for cells_of_row in rows
        ]
    )
