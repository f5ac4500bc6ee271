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
    squares = []
    nees = []
    for case, one in zip(cases, found, strict=True):
        if one is None:
            continue
        to_parent = np.kron(np.eye(2), one[0][:3, :3])
        off = deviation(one[0], case.T_parent_child)
        told = one[3] & np.isfinite(case.sigmas)
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
        cells["over bound"] = f"{np.sqrt(np.median(squares) / MEDIAN_6):.2f}"
        cells["NEES"] = f"{np.median(nees):.1f}"
    return cells


def table(cases: list[Case], package: Path, against: Path) -> str:
    """A row for every family, and one for all."""
    found = solved(cases, package, {})
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
