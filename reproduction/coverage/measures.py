"""What the study measures, as rows that can be kept, printed and compared with those of before."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import FloatArray

# Medians of chi-squared with 6 and 3 degrees of freedom.
MEDIAN_6, MEDIAN_3 = 5.348, 2.366

# Intervals that are meant to cover so much.
COVERAGE = 0.90

# Names of the rows that hold all cases of a table.
POOLED = {
    "simulated": "all classes",
    "mixed": "all mixtures",
    "known answer": "all known answers",
    "rig": "all rigs",
    "parts": "all parts",
    "refused": "all that leave something open",
}

# Errors below these are rounding.
LEAST = {"mm": 0.01, "deg": 0.001}

_RESAMPLES = 400
_CONFIDENCE = 0.95


@dataclass(frozen=True)
class Kind:
    """A kind of measure."""

    title: str
    # Of the cases, a list of arrays, one per group: recordings of a class, axes of a set.
    statistic: Callable[[list[FloatArray]], float]
    # Of the statistic; larger is worse.
    badness: Callable[[float], float]
    # A badness larger by no more than this is no worse.
    tolerance: float


def _root_of_median(median: float) -> Callable[[list[FloatArray]], float]:
    """Geometric mean over the groups of the root of the median over what is expected."""

    def statistic(groups: list[FloatArray]) -> float:
        return float(np.exp(np.mean([0.5 * np.log(np.median(g) / median) for g in groups])))

    return statistic


def _median(groups: list[FloatArray]) -> float:
    return float(np.median(np.concatenate(groups)))


def _mean(groups: list[FloatArray]) -> float:
    return float(np.mean(np.concatenate(groups)))


def _root_mean(groups: list[FloatArray]) -> float:
    return float(np.sqrt(_mean(groups)))


def _log_above(least: float) -> Callable[[float], float]:
    return lambda value: float(np.log(max(value, least)))


def _log_distance(expected: float) -> Callable[[float], float]:
    return lambda value: float(abs(np.log(max(value, 1e-9) / expected)))


KINDS = {
    "bound": Kind("error / bound", _root_of_median(MEDIAN_6), _log_above(0.1), np.log(1.05)),
    "bound_t": Kind("translation", _root_of_median(MEDIAN_3), _log_above(0.1), np.log(1.10)),
    "bound_r": Kind("rotation", _root_of_median(MEDIAN_3), _log_above(0.1), np.log(1.10)),
    "nees": Kind("median NEES", _median, _log_distance(MEDIAN_6), np.log(1.25)),
    "covers": Kind("90 % covers", _mean, lambda value: abs(value - COVERAGE), 0.03),
    "covers_floor": Kind("with the floor", _mean, lambda value: max(COVERAGE - value, 0.0), 0.03),
    "covers_truth": Kind(
        "with the truth's own sigma", _mean, lambda value: max(COVERAGE - value, 0.0), 0.03
    ),
    "scatter": Kind("scatter / sigma", _root_mean, _log_distance(1.0), np.log(1.10)),
    "mm": Kind("error (mm)", _median, _log_above(LEAST["mm"]), np.log(1.10)),
    "deg": Kind("error (deg)", _median, _log_above(LEAST["deg"]), np.log(1.10)),
    "mm_truth": Kind("truth known to (mm)", _median, lambda value: 0.0, 0.0),
    "deg_truth": Kind("truth known to (deg)", _median, lambda value: 0.0, 0.0),
    "z": Kind("largest error / sigma", _median, _log_above(1.0), np.log(1.15)),
    "chi2": Kind("chi2 (6)", _median, _log_above(6.0), np.log(1.10)),
    "answered": Kind("answered", _mean, lambda value: -value, 0.0),
    "refused": Kind("refused", _mean, lambda value: -value, 0.0),
}


@dataclass(frozen=True)
class Row:
    """Measures of one class, rig or cycle by one method."""

    table: str
    name: str
    method: str
    # Kind of measure to its cases: key ``group/case`` to value.
    cases: Mapping[str, Mapping[str, float]]
    # Processor time of one answer, median; not compared.
    seconds: float = 0.0

    @property
    def key(self) -> str:
        """Name of the row among all."""
        return f"{self.method}, {self.table}: {self.name}"

    def value(self, kind: str) -> float:
        """A measure; NaN if it was not taken."""
        cases = self.cases.get(kind)
        return KINDS[kind].statistic(_groups(cases, list(cases))) if cases else float("nan")


def pooled(table: str, name: str, method: str, rows: Iterable[Row]) -> Row:
    """All cases of the rows of a table as one row."""
    cases: dict[str, dict[str, float]] = {}
    chosen = [row for row in rows if (row.table, row.method) == (table, method)]
    for row in chosen:
        for kind, found in row.cases.items():
            cases.setdefault(kind, {}).update(
                {f"{row.name}/{key}": value for key, value in found.items()}
            )
    return Row(table, name, method, cases, float(sum(row.seconds for row in chosen)))


def _groups(cases: Mapping[str, float], keys: list[str]) -> list[FloatArray]:
    """Values by what their keys have before the last slash."""
    found: dict[str, list[float]] = {}
    for key in keys:
        found.setdefault(key.rpartition("/")[0], []).append(cases[key])
    return [np.array(values) for values in found.values()]


@dataclass(frozen=True)
class Worse:
    """A measure that got worse beyond its noise."""

    row: str
    kind: str
    before: float
    now: float

    def __str__(self) -> str:
        return f"{self.row}: {KINDS[self.kind].title} {self.now:.4g}, before {self.before:.4g}"


def worsened(rows: Iterable[Row], before: Mapping[str, Row]) -> list[Worse]:
    """Measures of the rows that are worse than before, beyond tolerance and noise.

    Only cases that both have are compared, so that fewer seeds than before can be run. The noise
    is that of the cases: 95 % of the paired resamples must be worse.
    """
    found = []
    for row in rows:
        if row.key not in before:
            continue
        for kind in row.cases:
            was = before[row.key].cases.get(kind, {})
            worse = _is_worse(KINDS[kind], row.cases[kind], was)
            if worse is not None:
                found.append(Worse(row.key, kind, *worse))
    return found


def _is_worse(
    kind: Kind, now: Mapping[str, float], before: Mapping[str, float]
) -> tuple[float, float] | None:
    """The measure before and now, None unless it is worse."""
    keys = [key for key in before if key in now]
    if not keys:
        return None
    groups = list(zip(_groups(before, keys), _groups(now, keys), strict=True))

    def values(chosen: list[tuple[FloatArray, FloatArray]]) -> tuple[float, float]:
        was, current = zip(*chosen, strict=True)
        return kind.statistic(list(was)), kind.statistic(list(current))

    def growth(pair: tuple[float, float]) -> float:
        return kind.badness(pair[1]) - kind.badness(pair[0])

    if growth(values(groups)) <= kind.tolerance:
        return None
    rng = np.random.default_rng(0)
    growths = []
    for _ in range(_RESAMPLES):
        picks = [rng.integers(len(was), size=len(was)) for was, _ in groups]
        growths.append(
            growth(values([(a[i], b[i]) for (a, b), i in zip(groups, picks, strict=True)]))
        )
    return values(groups) if np.mean(np.array(growths) > 0.0) >= _CONFIDENCE else None
