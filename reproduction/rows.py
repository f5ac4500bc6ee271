"""One row of results per (case, method, reference): ours, the published one, whether they agree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment import metrics
from hand_eye_calib.assessment.metrics import Errors
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.pairing.motion_pairs import MotionPairs
from hand_eye_calib.solvers import dnl, dnlo
from hand_eye_calib.solvers.registry import Method
from reproduction import ali_as_published
from reproduction.published import KITTI, LEVELS, REFERENCES, Case, path_to
from reproduction.sources import Source

METRICS = ("e_rt", "e_rR", "e_at", "e_aR")
UNITS = {"e_rt": "m", "e_rR": "deg", "e_at": "m", "e_aR": "deg"}

# The published simulation results of Ali come from a quaternion that was not normalised; under this
# name we do the same.
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

# Errors agree within this share of the published one, or this many metres or degrees.
_RELATIVE, _ABSOLUTE = 1e-3, 1e-6

# An objective is above another when it is so by more than this share, and by more than the rounding
# of a perfect fit.
_OBJECTIVE_SHARE, _OBJECTIVE_FLOOR = 1e-6, 1e-15


@dataclass(frozen=True)
class Cell:
    """Unit of solving and storing: all runs and references of a method at a level of a data set."""

    dataset: str
    level: float | None
    method: str

    @property
    def name(self) -> str:
        """Such as noise_0.002_dnlo."""
        return "_".join([*path_to(self.dataset, self.level), self.method])


@dataclass(frozen=True)
class Row:
    """A solved case."""

    # What was solved, and how.
    dataset: str
    level: float | None
    run: str
    method: str
    reference: str
    # e_rt (m), e_rR (deg), e_at (m), e_aR (deg).
    errors: tuple[float, ...]
    # The method's own cost.
    objective: float
    converged: bool
    # Row by row.
    T_parent_child: tuple[float, ...]
    # As ``errors``; None where nothing is published.
    published: tuple[float, ...] | None
    # Our formula at the published answer; dnl and dnlo only.
    published_objective: float | None

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Row:
        """The row of these attributes; lists stand for tuples."""
        frozen: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in plain.items()
        }
        return cls(**frozen)

    @property
    def name(self) -> str:
        """Such as noise/0.002/run_12."""
        return "/".join([*path_to(self.dataset, self.level), self.run])

    @property
    def transform(self) -> FloatArray:
        """``T_parent_child`` as (4, 4) array."""
        return np.reshape(self.T_parent_child, (4, 4))

    @property
    def theirs(self) -> tuple[float, ...]:
        """The published errors of a row that has them."""
        if self.published is None:
            raise ValueError(f"nothing is published for {self.name}")
        return self.published

    @property
    def agrees(self) -> bool:
        """Whether all four errors are the published ones."""
        return all(map(agree, self.errors, self.theirs))

    @property
    def is_e_at_the_same(self) -> bool:
        """Whether e_at is the published one."""
        return agree(self.errors[2], self.theirs[2])

    @property
    def objective_verdict(self) -> str:
        """Of dnl and dnlo: whether our objective is "lower", "equal" or "higher" than at the
        published answer.
        """
        theirs = self.published_objective
        if theirs is None:
            raise ValueError(f"no objective is published for {self.name}")
        if is_above(self.objective, theirs):
            return "higher"
        return "lower" if is_above(theirs, self.objective) else "equal"

    def why(self) -> str:
        """Why this row does not agree with the published one; empty where it does."""
        if self.published is None or self.agrees:
            return ""
        if self.published_objective is not None:
            return {
                "lower": "published answer is not the minimum: ours has the lower objective",
                "equal": "same objective, another answer: the minimum is flat",
                "higher": "our objective is higher",
            }[self.objective_verdict]
        if self.method == "ali" and self.dataset not in KITTI:
            return "published quaternion was never normalised"
        if not self.converged:
            return "the iteration does not settle: its last step depends on rounding"
        return "unexplained"


def agree(ours: float, theirs: float) -> bool:
    """Whether two errors (m or deg) are the same."""
    return abs(ours - theirs) <= max(_RELATIVE * abs(theirs), _ABSOLUTE)


def is_above(objective: float, other: float) -> bool:
    """Whether an objective is larger by more than rounding."""
    return objective > other * (1 + _OBJECTIVE_SHARE) + _OBJECTIVE_FLOOR


def cells(datasets: Sequence[str], methods: Sequence[str]) -> list[Cell]:
    """Cells of data sets at all levels, by method in turn."""
    return [
        Cell(dataset, level, method)
        for dataset in datasets
        for level in LEVELS.get(dataset, (None,))
        for method in methods
    ]


def solve_plain(source: Source, cell: Cell) -> list[dict[str, Any]]:
    """The attributes of every Row of a cell."""
    return [vars(row) for row in solve_cell(source, cell)]


def solve_cell(source: Source, cell: Cell) -> list[Row]:
    """List of Row of a cell, by run and reference."""
    return [
        _solve(case, cell.method, reference)
        for case in _cases(source, cell.dataset, cell.level)
        for reference in REFERENCES
    ]


def in_m_and_deg(errors: Errors) -> tuple[float, float, float, float]:
    """The four metrics as a tuple, rotations in degrees."""
    e_rR, e_aR = (float(np.degrees(angle)) for angle in (errors.e_rR, errors.e_aR))
    return errors.e_rt, e_rR, errors.e_at, e_aR


def published_name(method: str) -> str:
    """Name of a method in the published results."""
    return "ali" if method == ALI_AS_PUBLISHED else method


# A process solves the methods of one level in turn.
@lru_cache(maxsize=1)
def _cases(source: Source, dataset: str, level: float | None) -> list[Case]:
    return source.cases(dataset, level)


def _solve(case: Case, method: str, reference: str) -> Row:
    pairs = case.pairs(reference)
    solution = (
        ali_as_published.solve(pairs) if method == ALI_AS_PUBLISHED else Method(method).solve(pairs)
    )
    result = case.results.get((published_name(method), reference))
    return Row(
        case.dataset,
        case.level,
        case.run,
        method,
        reference,
        in_m_and_deg(metrics.errors(pairs, solution.T_parent_child, case.T_parent_child)),
        solution.objective,
        solution.converged,
        tuple(solution.T_parent_child.ravel().tolist()),
        in_m_and_deg(result.errors) if result else None,
        _objective(method, pairs, result.T_parent_child) if result else None,
    )


def _objective(method: str, pairs: MotionPairs, T_parent_child: FloatArray) -> float | None:
    if method not in ("dnl", "dnlo"):
        return None
    costs = dnl.pair_costs(pairs, T_parent_child)
    if method == "dnl":
        return float(costs.sum())
    options = CalibratorConfig()
    return float(
        dnlo.truncate(costs, options.threshold, options.min_inlier_fraction * len(pairs))[1]
    )
