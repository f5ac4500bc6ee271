"""What an experiment has solved, and summaries of many runs as in the paper's figures: mean and
95 % confidence interval, or median and quartiles.
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
    # The farthest values within 1.5 times the interquartile range of the quartiles.
    whiskers: tuple[float, float]
    # Number of runs.
    n: int


def mean_summary(values: ArrayLike) -> Summary:
    """Mean and 95 % confidence interval of (N,) values."""
    values = np.asarray(values)
    mean = values.mean()
    n = len(values)
    half = (
        stdtrit(n - 1, 0.975) * values.std(ddof=1) / np.sqrt(n)
        if n > 1
        else np.inf
    )
    whiskers = float(values.min()), float(values.max())
    return Summary(
        float(mean), float(mean - half), float(mean + half), whiskers, n
    )


def quartile_summary(values: ArrayLike) -> Summary:
    """Median and quartiles of (N,) values."""
    values = np.sort(values)
    low, median, high = np.quantile(values, (0.25, 0.5, 0.75))
    inside = values[
        (values >= low - 1.5 * (high - low))
        & (values <= high + 1.5 * (high - low))
    ]
    whiskers = float(inside[0]), float(inside[-1])
    return Summary(
        float(median), float(low), float(high), whiskers, len(values)
    )


class Table:
    """Errors of many rows by data set, level, method and reference; m and deg."""

    def __init__(self, rows: pd.DataFrame) -> None:
        keys = ["dataset", "level", "method", "reference"]
        self._errors = {
            (
                dataset,
                None if np.isnan(level) else level,
                method,
                reference,
            ): errors
            for (dataset, level, method, reference), group in rows.groupby(
                keys, dropna=False
            )
            if np.isfinite(errors := group[list(METRICS)].to_numpy()).all()
        }

    def values(
        self,
        dataset: str,
        level: float | None,
        method: str,
        reference: str,
        metric: str,
    ) -> FloatArray:
        """(N,) errors of the runs."""
        return self._errors[dataset, level, method, reference][
            :, METRICS.index(metric)
        ]

    def levels(self, dataset: str, method: str) -> tuple[float | None, ...]:
        """Levels of a data set, ascending; (None,) for the mixture."""
        of_dataset = {
            key[1]
            for key in self._errors
            if (key[0], key[2]) == (dataset, method)
        }
        return tuple(sorted(of_dataset, key=lambda level: level or 0.0))

    def summary(
        self,
        dataset: str,
        level: float | None,
        method: str,
        reference: str,
        metric: str,
    ) -> Summary:
        """As the paper does: the mixture by quartiles, the others by mean."""
        values = self.values(dataset, level, method, reference, metric)
        return (
            quartile_summary(values)
            if dataset == "mixture"
            else mean_summary(values)
        )

    def score(
        self, dataset: str, method: str, reference: str, metric: str = "e_at"
    ) -> float:
        """The value that variants are compared by: the mean over levels of the mean over runs; of
        the mixture, the median.
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
        """References from the smallest score to the largest."""
        return sorted(
            REFERENCES,
            key=lambda name: self.score(dataset, method, name, metric),
        )

    def best_reference(
        self, dataset: str, method: str, metric: str = "e_at"
    ) -> str:
        """The reference with the smallest score."""
        return self.ranking(dataset, method, metric)[0]


@dataclass(frozen=True)
class Results:
    """Solved rows (:func:`~reproduction.rows.table_of`) and the output directory."""

    source: Source
    rows: pd.DataFrame
    out: Path
    # Number of processes of the studies, which are not solved cell by cell.
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
        """Rows of a method on a data set."""
        return self.rows[
            (self.rows["dataset"] == dataset) & (self.rows["method"] == method)
        ]
