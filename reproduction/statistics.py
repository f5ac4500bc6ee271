"""Summaries of many runs as in the paper's figures: mean and 95 % confidence interval, or median
and quartiles.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from hand_eye_calib.arrays import FloatArray
from reproduction.published import REFERENCES, Case
from reproduction.rows import METRICS, Row, in_m_and_deg, published_name


@dataclass(frozen=True)
class Summary:
    """Statistics of one error over the runs of a level."""

    # Mean and its 95 % confidence interval (Student's t), or median and quartiles.
    centre: float
    low: float
    high: float
    # The farthest values within 1.5 times the interquartile range of the quartiles.
    whiskers: tuple[float, float]
    # Number of runs.
    n: int
    # Median and quartiles, not mean and interval.
    is_median: bool


def mean_summary(values: ArrayLike) -> Summary:
    """Mean and 95 % confidence interval of (N,) values."""
    values = np.asarray(values)
    mean, n = values.mean(), len(values)
    half = stdtrit(n - 1, 0.975) * values.std(ddof=1) / np.sqrt(n) if n > 1 else np.inf
    whiskers = float(values.min()), float(values.max())
    return Summary(float(mean), float(mean - half), float(mean + half), whiskers, n, False)


def quartile_summary(values: ArrayLike) -> Summary:
    """Median and quartiles of (N,) values."""
    values = np.sort(values)
    low, median, high = np.quantile(values, (0.25, 0.5, 0.75))
    inside = values[(values >= low - 1.5 * (high - low)) & (values <= high + 1.5 * (high - low))]
    whiskers = float(inside[0]), float(inside[-1])
    return Summary(float(median), float(low), float(high), whiskers, len(values), True)


def summarise(dataset: str, values: ArrayLike) -> Summary:
    """As the paper does: the mixture by quartiles, the others by mean."""
    return quartile_summary(values) if dataset == "mixture" else mean_summary(values)


# Data set, level, method, reference, errors.
Entry = tuple[str, float | None, str, str, tuple[float, ...]]


class Table:
    """Errors of many rows: data set, level, method, reference, the four metrics (m and deg)."""

    def __init__(self, entries: Iterable[Entry]) -> None:
        collected: dict[tuple[Any, ...], list[tuple[float, ...]]] = {}
        for *key, errors in entries:
            collected.setdefault(tuple(key), []).append(errors)
        self._errors = {key: np.array(errors) for key, errors in collected.items()}

    def values(
        self, dataset: str, level: float | None, method: str, reference: str, metric: str
    ) -> FloatArray:
        """(N,) errors of the runs; m or deg."""
        return self._errors[dataset, level, method, reference][:, METRICS.index(metric)]

    def levels(self, dataset: str, method: str) -> tuple[float | None, ...]:
        """Levels of a data set, ascending; (None,) for the mixture."""
        found = {key[1] for key in self._errors if (key[0], key[2]) == (dataset, method)}
        return tuple(sorted(found, key=lambda level: level or 0.0))

    def summary(
        self, dataset: str, level: float | None, method: str, reference: str, metric: str
    ) -> Summary:
        """:class:`Summary` of the runs."""
        return summarise(dataset, self.values(dataset, level, method, reference, metric))

    def score(self, dataset: str, method: str, reference: str, metric: str = "e_at") -> float:
        """The value that variants are compared by: the mean over levels of the mean over runs; of
        the mixture, the median.
        """
        summaries = (
            self.summary(dataset, level, method, reference, metric)
            for level in self.levels(dataset, method)
        )
        return float(np.mean([summary.centre for summary in summaries]))

    def best_reference(self, dataset: str, method: str, metric: str = "e_at") -> str:
        """The reference with the smallest score."""
        return self.ranking(dataset, method, metric)[0]

    def ranking(self, dataset: str, method: str, metric: str = "e_at") -> list[str]:
        """References from the smallest score to the largest."""
        return sorted(REFERENCES, key=lambda name: self.score(dataset, method, name, metric))


def of_rows(rows: Sequence[Row], which: str = "errors") -> Table:
    """:class:`Table` of our errors, or of the ``published`` ones of the same rows."""
    return Table(
        (row.dataset, row.level, row.method, row.reference, getattr(row, which))
        for row in rows
        if getattr(row, which)
    )


def theirs_of_cases(cases: Iterable[Case], methods: Sequence[str]) -> Table:
    """:class:`Table` of the published errors of cases, whatever was solved."""
    return Table(
        (
            case.dataset,
            case.level,
            method,
            reference,
            in_m_and_deg(case.results[published_name(method), reference].errors),
        )
        for case in cases
        for method in methods
        for reference in REFERENCES
    )
