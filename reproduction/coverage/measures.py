"""Measures of the coverage study, as rows that can be pooled and printed."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray

# Medians of chi-squared with 6 and 3 degrees of freedom.
MEDIAN_6 = 5.348
MEDIAN_3 = 2.366

# Nominal coverage of the intervals.
COVERAGE = 0.90

# Half-width of a 90 % interval of a normal error, in standard deviations.
HALF_WIDTH_90 = 1.645

# Names of the pooled rows, which contain all cases of a table.
POOLED = {
    "simulated": "all classes",
    "known answer": "all known answers",
    "rig": "all rigs",
    "parts": "all parts",
    "refused": "all with an undetermined axis",
}

# Statistic of values in groups: an array for each group, such as the recordings of a class.
_Statistic = Callable[[list[FloatArray]], float]


def _root_of_median(median: float) -> _Statistic:
    """Return a statistic: the geometric mean over the groups of sqrt(median / expected median)."""

    def statistic(groups: list[FloatArray]) -> float:
        logs = [0.5 * np.log(np.median(group) / median) for group in groups]
        return float(np.exp(np.mean(logs)))

    return statistic


def _median(groups: list[FloatArray]) -> float:
    return float(np.median(np.concatenate(groups)))


def _mean(groups: list[FloatArray]) -> float:
    return float(np.mean(np.concatenate(groups)))


# Title and statistic of each kind of measure.
KINDS: dict[str, tuple[str, _Statistic]] = {
    "bound": ("error / bound", _root_of_median(MEDIAN_6)),
    "bound_t": ("translation", _root_of_median(MEDIAN_3)),
    "bound_r": ("rotation", _root_of_median(MEDIAN_3)),
    "nees": ("median NEES", _median),
    "covers": ("90 % covers", _mean),
    "covers_floor": ("with the floor", _mean),
    "covers_truth": ("with the truth's own sigma", _mean),
    "scatter": (
        "scatter / sigma",
        lambda groups: float(np.sqrt(_mean(groups))),
    ),
    "mm": ("error (mm)", _median),
    "deg": ("error (deg)", _median),
    "z": ("largest error / sigma", _median),
    "chi2": ("chi2 (6)", _median),
    "refused": ("refused", _mean),
}


@dataclass(frozen=True)
class Row:
    """Measures of one class, rig or cycle by one method."""

    table: str
    name: str
    method: str
    # Values by kind of measure, then by key ``group/case``.
    cases: Mapping[str, Mapping[str, float]]

    def value(self, kind: str) -> float:
        """Return the statistic of a kind of measure; NaN without values."""
        cases = self.cases.get(kind)
        if not cases:
            return float("nan")
        _, statistic = KINDS[kind]
        return statistic(_groups(cases))


def pooled(table: str, name: str, method: str, rows: Iterable[Row]) -> Row:
    """Combine the cases of all rows of a table and a method into one row."""
    cases: dict[str, dict[str, float]] = {}
    for row in rows:
        if (row.table, row.method) != (table, method):
            continue
        for kind, figures in row.cases.items():
            pool = cases.setdefault(kind, {})
            for key, value in figures.items():
                pool[f"{row.name}/{key}"] = value
    return Row(table, name, method, cases)


def _groups(cases: Mapping[str, float]) -> list[FloatArray]:
    """Group values by the part of their keys before the last slash."""
    groups: dict[str, list[float]] = {}
    for key, value in cases.items():
        group, _, _ = key.rpartition("/")
        groups.setdefault(group, []).append(value)
    return [np.array(values) for values in groups.values()]
