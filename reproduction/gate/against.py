"""Comparison of this version with another version of the package, on the same recordings.

The table contains ratios of the errors: to the errors of the other version, and to the Cramer-Rao
bound of simulated recordings. It also contains NEES, and the coverage of the 90 % intervals with
and without the common-mode floor.
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
from reproduction.coverage.measures import HALF_WIDTH_90, MEDIAN_6
from reproduction.gate.cases import Case
from reproduction.writing import markdown_table

# Script that runs with all versions since 0.1. It stores the extrinsic, its covariances without and
# with the allowance, and the determined axes. In old versions, ``covariance`` is without allowance.
_SOLVE = """
import pickle, sys, warnings
import numpy as np
import hand_eye_calib as hec
warnings.simplefilter("ignore")
answers = []
for streams, options in pickle.load(open(sys.argv[1], "rb")):
    try:
        parent, child = [hec.Trajectory(*stream) for stream in streams]
        result = hec.calibrate(parent, child, **options)
        known = np.isfinite([dof.sigma for dof in result.observability])
        measured = getattr(result, "covariance_measured", result.covariance)
        whole = getattr(result, "covariance_with_floor", result.covariance)
        answers.append((result.T_parent_child, measured, whole, known))
    except Exception:
        answers.append(None)
pickle.dump(answers, open(sys.argv[2], "wb"))
"""


def solved(
    cases: list[Case], package: Path, options: dict[str, Any]
) -> list[Any]:
    """Return the answers of the version of the package in the folder ``package``."""
    tasks = []
    for case in cases:
        streams = [(stream.stamps_ns, stream.poses) for stream in case.streams]
        tasks.append((streams, case.options | options))
    with tempfile.TemporaryDirectory() as folder:
        cases_file = Path(folder) / "cases"
        answers_file = Path(folder) / "answers"
        cases_file.write_bytes(pickle.dumps(tasks))
        environment = os.environ | {"PYTHONPATH": str(package)}
        command = [
            sys.executable,
            "-c",
            _SOLVE,
            str(cases_file),
            str(answers_file),
        ]
        subprocess.run(command, check=True, env=environment, cwd=folder)
        return list(pickle.loads(answers_file.read_bytes()))


def _sizes(case: Case, answer: Any, is_determined: BoolArray) -> FloatArray:
    """Return the errors of translation (m) and rotation (rad); NaN without a known axis.

    Half of the truth's standard deviation is added in quadrature.
    """
    is_determined = is_determined & np.isfinite(case.sigmas)
    errors = deviation(answer[0], case.T_parent_child)
    squares = errors**2 + 0.25 * case.sigmas**2
    sizes = []
    for axes in (slice(0, 3), slice(3, 6)):
        is_used = is_determined[axes]
        total = np.where(is_used, squares[axes], 0.0).sum()
        sizes.append(np.sqrt(total) if is_used.any() else np.nan)
    return np.array(sizes)


def _error_ratios(
    cases: list[Case], own_answers: list[Any], answers: list[Any]
) -> FloatArray:
    """Return geometric means of the ratios of own errors to other errors: translation, rotation."""
    logs = []
    for case, own, other in zip(cases, own_answers, answers, strict=True):
        if own is None or other is None:
            continue
        ratios = _sizes(case, own, own[3]) / _sizes(case, other, own[3])
        logs.append(np.log(ratios))
    return np.exp(np.nanmean(logs, axis=0)) if logs else np.full(2, np.nan)


def _per_cent(flags: list[bool]) -> str:
    return f"{100 * np.mean(flags):.0f} %" if flags else ""


def row(
    cases: list[Case], own_answers: list[Any], others: dict[str, list[Any]]
) -> dict[str, str]:
    """Return the cells of the recordings of one family."""
    cells = {"recordings": str(len(cases))}
    for name, answers in others.items():
        ratios = _error_ratios(cases, own_answers, answers)
        cells[f"over {name}"] = " ".join(f"{ratio:.2f}" for ratio in ratios)

    is_inside: list[bool] = []
    is_inside_with_floor: list[bool] = []
    over_bound = []
    nees = []
    for case, answer in zip(cases, own_answers, strict=True):
        if answer is None:
            continue
        T, measured, whole, is_known = answer
        to_parent = np.kron(np.eye(2), T[:3, :3])
        errors = deviation(T, case.T_parent_child)
        is_comparable = is_known & np.isfinite(case.sigmas)
        for flags, covariance in (
            (is_inside, measured),
            (is_inside_with_floor, whole),
        ):
            variances = (
                np.diag(to_parent @ covariance @ to_parent.T) + case.sigmas**2
            )
            is_covered = np.abs(errors) < HALF_WIDTH_90 * np.sqrt(variances)
            flags += [*is_covered[is_comparable]]
        if case.bound is not None and is_known.all():
            xi = to_parent.T @ errors
            over_bound.append(xi @ np.linalg.solve(case.bound, xi))
            nees.append(xi @ np.linalg.solve(measured, xi))

    cells["in 90 %"] = _per_cent(is_inside)
    cells["with floor"] = _per_cent(is_inside_with_floor)
    if over_bound:
        cells["over bound"] = f"{np.sqrt(np.median(over_bound) / MEDIAN_6):.2f}"
        cells["NEES"] = f"{np.median(nees):.1f}"
    return cells


def _chosen(values: list[Any], rows: list[int]) -> list[Any]:
    return [values[row] for row in rows]


def table(cases: list[Case], package: Path, against: Path) -> str:
    """Return a table with a row for each family and a row for all recordings."""
    own_answers = solved(cases, package, {})
    others = {
        "its default": solved(cases, against, {}),
        "its adaptive": solved(cases, against, {"method": "adaptive"}),
    }
    rows = []
    families = [*dict.fromkeys(case.family for case in cases)]
    for family in (*families, "all"):
        members = [
            index
            for index, case in enumerate(cases)
            if family in ("all", case.family)
        ]
        others_of_family = {
            name: _chosen(answers, members) for name, answers in others.items()
        }
        cells = row(
            _chosen(cases, members),
            _chosen(own_answers, members),
            others_of_family,
        )
        rows.append({"family": family} | cells)

    columns: dict[str, str] = {}
    for cells in rows:
        columns |= dict.fromkeys(cells, "")
    return markdown_table([columns | cells for cells in rows])
