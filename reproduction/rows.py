"""Rows of results by case, method and reference: our errors, published errors, and agreement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs
from hand_eye_calib.core.solvers import all_pairs, dnlo
from hand_eye_calib.core.solvers.registry import Method
from reproduction import ali_as_published
from reproduction.metrics import Errors, errors
from reproduction.published import KITTI, LEVELS, REFERENCES, Case, path_to
from reproduction.sources import Source

METRICS = ("e_rt", "e_rR", "e_at", "e_aR")
PUBLISHED = tuple(f"published_{metric}" for metric in METRICS)
UNITS = {"e_rt": "m", "e_rR": "deg", "e_at": "m", "e_aR": "deg"}

# Our copy of the variant of Ali behind the published simulation results, whose quaternion is not
# normalised.
ALI_AS_PUBLISHED = "ali_as_published"
TITLES = {
    "ali": "Ali",
    ALI_AS_PUBLISHED: "Ali (as published)",
    "dnl": "DNL",
    "dnlo": "DNLO",
    "park": "Park",
    "taylor": "Taylor",
    "zhuang": "Zhuang",
}
_COLUMNS = (
    "dataset",
    "level",
    "run",
    "method",
    "reference",
    "converged",
    "T_parent_child",
    *METRICS,
    "objective",
    *PUBLISHED,
    "published_objective",
)

# Errors agree if they differ by less than this share of the published error ...
_RELATIVE = 1e-3
# ... or by less than this (m or deg).
_ABSOLUTE = 1e-6

# An objective is larger than another if it exceeds it by more than this share of the other ...
_OBJECTIVE_SHARE = 1e-6
# ... plus this rounding of a perfect fit.
_OBJECTIVE_FLOOR = 1e-15


@dataclass(frozen=True)
class Cell:
    """All runs and references of a method at a level of a data set; solved as a unit."""

    dataset: str
    level: float | None
    method: str


def cells(datasets: Sequence[str], methods: Sequence[str]) -> list[Cell]:
    """Return the cells of data sets at all levels, for all methods."""
    all_cells = []
    for dataset in datasets:
        for level in LEVELS.get(dataset, (None,)):
            all_cells += [Cell(dataset, level, method) for method in methods]
    return all_cells


def solve_cell(source: Source, cell: Cell) -> list[dict[str, Any]]:
    """Solve a cell; return its rows by run and reference, as plain values."""
    cases = _cases(source, cell.dataset, cell.level)
    return [
        _solve(case, cell.method, reference)
        for case, reference in product(cases, REFERENCES)
    ]


# Successive cells of a process are different methods on the same cases.
@lru_cache(maxsize=1)
def _cases(source: Source, dataset: str, level: float | None) -> list[Case]:
    return source.cases(dataset, level)


def _solve(case: Case, method: str, reference: str) -> dict[str, Any]:
    """Solve a case; return a row with our errors and, if there are any, the published errors."""
    pairs = case.pairs(reference)
    if method == ALI_AS_PUBLISHED:
        solution = ali_as_published.solve(pairs)
    else:
        solution = Method(method).solve(pairs)
    errors_of_solution = errors(
        pairs, solution.T_parent_child, case.T_parent_child
    )
    row = {
        "dataset": case.dataset,
        "level": case.level,
        "run": case.run,
        "method": method,
        "reference": reference,
        "converged": solution.converged,
        "T_parent_child": solution.T_parent_child.ravel().tolist(),
        **dict(zip(METRICS, in_m_and_deg(errors_of_solution), strict=True)),
        "objective": solution.objective,
    }
    result = case.results.get((published_name(method), reference))
    if result:
        row |= dict(zip(PUBLISHED, in_m_and_deg(result.errors), strict=True))
        row["published_objective"] = _objective(
            method, pairs, result.T_parent_child
        )
    return row


def in_m_and_deg(errors: Errors) -> tuple[float, ...]:
    """Return the four metrics, with rotations in degrees."""
    units = [1, 180 / np.pi, 1, 180 / np.pi]
    values = np.array(errors) * units
    return tuple(values.tolist())


def published_name(method: str) -> str:
    """Return the name of a method in the published results."""
    return "ali" if method == ALI_AS_PUBLISHED else method


def _objective(
    method: str, pairs: MotionPairs, T_parent_child: FloatArray
) -> float | None:
    """Return the cost of an answer, eq. (5), for dnl and dnlo; None for other methods."""
    if method not in ("dnl", "dnlo"):
        return None
    costs = all_pairs.pair_costs(pairs, T_parent_child)
    if method == "dnl":
        return float(costs.sum())
    options = CalibratorConfig()
    fewest = options.min_inlier_fraction * len(pairs)
    return float(dnlo.truncate(costs, options.threshold, fewest)[1])


def table_of(rows: Sequence[dict[str, Any]]) -> pd.DataFrame:
    """Return the rows as a table, with columns for the comparison with the published results.

    ``case`` is a name such as noise/0.002/run_12. ``agrees`` and ``same_e_at``: whether all errors,
    or e_at, equal the published errors. ``verdict`` (dnl and dnlo): whether our objective is lower
    than, equal to or higher than the objective at the published answer. ``why`` is the reason why a
    row does not agree.
    """
    table = pd.DataFrame(rows, columns=list(_COLUMNS))
    numbers = [
        "level",
        *METRICS,
        "objective",
        *PUBLISHED,
        "published_objective",
    ]
    table[numbers] = table[numbers].astype(float)
    table["case"] = [_case_name(row) for row in table.itertuples()]
    same = agree(
        table[list(METRICS)].to_numpy(), table[list(PUBLISHED)].to_numpy()
    )
    table["agrees"] = same.all(axis=1)
    table["same_e_at"] = same[:, 2]
    ours = table["objective"].to_numpy()
    theirs = table["published_objective"].to_numpy()
    table["verdict"] = np.select(
        [np.isnan(theirs), _is_above(ours, theirs), _is_above(theirs, ours)],
        ["", "higher", "lower"],
        "equal",
    )
    unsettled = (
        "the iteration does not settle: its last step depends on rounding"
    )
    # The first reason that applies to a row is used.
    reasons = {
        "": table["published_e_at"].isna() | table["agrees"],
        "published answer is not the minimum: ours has the lower objective": table[
            "verdict"
        ]
        == "lower",
        "same objective, another answer: the minimum is flat": table["verdict"]
        == "equal",
        "our objective is higher": table["verdict"] == "higher",
        "published quaternion was never normalised": (table["method"] == "ali")
        & ~table["dataset"].isin(KITTI),
        unsettled: ~table["converged"].astype(bool),
    }
    table["why"] = np.select(
        list(reasons.values()), list(reasons), "unexplained"
    )
    return table


def _case_name(row: Any) -> str:
    level = None if np.isnan(row.level) else row.level
    return "/".join([*path_to(row.dataset, level), row.run])


def agree(ours: FloatArray | float, theirs: FloatArray | float) -> BoolArray:
    """Return whether errors (m or deg) are the same within the tolerances."""
    tolerances = np.maximum(_RELATIVE * np.abs(theirs), _ABSOLUTE)
    return np.abs(ours - theirs) <= tolerances


def _is_above(objective: FloatArray, other: FloatArray) -> BoolArray:
    """Return whether objectives are larger than others by more than rounding."""
    return objective > other * (1 + _OBJECTIVE_SHARE) + _OBJECTIVE_FLOOR
