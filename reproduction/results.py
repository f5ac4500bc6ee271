"""Results of an experiment, and summaries of many runs as in the paper's figures.

A summary is the mean with its 95 % confidence interval, or the median with the quartiles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from hand_eye_calib.core.base.arrays import FloatArray
from reproduction.published import METHODS, REFERENCES
from reproduction.rows import ALI_AS_PUBLISHED, METRICS, PUBLISHED
from reproduction.sources import Source

SIMULATION_METHODS = (*METHODS, ALI_AS_PUBLISHED)


@dataclass(frozen=True)
class Summary:
    """Statistics of one error over the runs of a level."""

    # Mean and its 95 % confidence interval (Student's t), or median and quartiles.
    centre: float
    low: float
    high: float
    # Smallest and largest value for a mean. For a median, values that are farther than 1.5
    # interquartile ranges outside of the quartiles do not count.
    whiskers: tuple[float, float]
    # Number of runs.
    n: int


def mean_summary(values: ArrayLike) -> Summary:
    """Return the mean of values (N,) and its 95 % confidence interval."""
    values = np.asarray(values)
    mean = values.mean()
    n = len(values)
    half = np.inf
    if n > 1:
        half = stdtrit(n - 1, 0.975) * values.std(ddof=1) / np.sqrt(n)
    whiskers = float(values.min()), float(values.max())
    return Summary(
        float(mean), float(mean - half), float(mean + half), whiskers, n
    )


def quartile_summary(values: ArrayLike) -> Summary:
    """Return the median and the quartiles of values (N,)."""
    values = np.sort(values)
    low, median, high = np.quantile(values, (0.25, 0.5, 0.75))
    reach = 1.5 * (high - low)
    inside = values[(values >= low - reach) & (values <= high + reach)]
    whiskers = float(inside[0]), float(inside[-1])
    return Summary(
        float(median), float(low), float(high), whiskers, len(values)
    )


class Table:
    """Errors of many rows (m and deg), by data set, level, method and reference.

    Groups of rows with a missing error are left out.
    """

    def __init__(self, rows: pd.DataFrame) -> None:
        keys = ["dataset", "level", "method", "reference"]
        self._errors: dict[tuple[str, float | None, str, str], FloatArray] = {}
        for key, group in rows.groupby(keys, dropna=False):
            errors = group[list(METRICS)].to_numpy()
            if np.isfinite(errors).all():
                dataset, number, method, reference = key
                level = None if np.isnan(number) else number
                self._errors[dataset, level, method, reference] = errors

    def values(
        self,
        dataset: str,
        level: float | None,
        method: str,
        reference: str,
        metric: str,
    ) -> FloatArray:
        """Return the errors (N,) of the runs."""
        return self._errors[dataset, level, method, reference][
            :, METRICS.index(metric)
        ]

    def levels(self, dataset: str, method: str) -> tuple[float | None, ...]:
        """Return the levels of a data set, ascending; (None,) for the mixture."""
        levels = set()
        for dataset_of_key, level, method_of_key, _ in self._errors:
            if (dataset_of_key, method_of_key) == (dataset, method):
                levels.add(level)
        return tuple(sorted(levels, key=lambda level: level or 0.0))

    def summary(
        self,
        dataset: str,
        level: float | None,
        method: str,
        reference: str,
        metric: str,
    ) -> Summary:
        """Summarise as the paper does: the mixture by quartiles, other data sets by the mean."""
        values = self.values(dataset, level, method, reference, metric)
        return (
            quartile_summary(values)
            if dataset == "mixture"
            else mean_summary(values)
        )

    def score(
        self, dataset: str, method: str, reference: str, metric: str = "e_at"
    ) -> float:
        """Return the value by which variants are compared.

        The value is the mean of the runs, averaged over the levels; for the mixture, the median of
        the runs.
        """
        levels = self.levels(dataset, method)
        summaries = [
            self.summary(dataset, level, method, reference, metric)
            for level in levels
        ]
        return float(np.mean([summary.centre for summary in summaries]))

    def ranking(
        self, dataset: str, method: str, metric: str = "e_at"
    ) -> list[str]:
        """Return the references from the smallest to the largest score."""
        return sorted(
            REFERENCES,
            key=lambda name: self.score(dataset, method, name, metric),
        )

    def best_reference(
        self, dataset: str, method: str, metric: str = "e_at"
    ) -> str:
        """Return the reference with the smallest score."""
        return self.ranking(dataset, method, metric)[0]


@dataclass(frozen=True)
class Results:
    """Solved rows (:func:`~reproduction.rows.table_of`) and the output directory."""

    source: Source
    rows: pd.DataFrame
    out: Path
    # Number of processes for artefacts that are not solved by cells, such as the certificate.
    jobs: int = 1

    @cached_property
    def ours(self) -> Table:
        """Our errors."""
        return Table(self.rows)

    @cached_property
    def theirs(self) -> Table:
        """The published errors of the same trajectories."""
        named = dict(zip(PUBLISHED, METRICS, strict=True))
        return Table(
            self.rows.drop(columns=list(METRICS)).rename(columns=named)
        )

    def of(self, dataset: str, method: str) -> pd.DataFrame:
        """Return the rows of a method on a data set."""
        return self.rows[
            (self.rows["dataset"] == dataset) & (self.rows["method"] == method)
        ]
