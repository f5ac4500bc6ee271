"""Comparison of scores with a stored baseline: limits of a regression."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import InputError
from reproduction.coverage.measures import COVERAGE, MEDIAN_6
from reproduction.gate.scores import Score
from reproduction.writing import TableRow

# Verdicts from the least strict to the strictest; the last entry means no answer.
_VERDICTS = ("USE", "USE WITH CARE", "DO NOT USE", "")

# A family with fewer recordings has a row, but no limits of its own.
_FEWEST_RECORDINGS = 8

# Share of the family's median error that is added in quadrature to errors before a comparison.
# Errors that are near zero by chance then do not dominate the ratios.
_LUCK = 0.5

# Largest difference of new recordings from the baseline, in standard errors. Chance exceeds it once
# in 4,000 runs.
_CHANCE = 3.5


@dataclass(frozen=True)
class Tolerances:
    """Limits of a regression.

    Results on one machine are reproducible to the last bit. Other versions of NumPy, SciPy or their
    BLAS change decisions of the estimator in a few per cent of the recordings.
    """

    # Largest geometric mean of the errors over those of the baseline.
    error_ratio: float
    # Coverage of the measured 90 % intervals may be farther from 90 % than in the baseline by this
    # share. Coverage of the intervals with the allowance may decrease by the same share.
    coverage: float
    # Factor by which the median NEES of the measured covariance may change.
    nees: float
    # Share of recordings whose verdict may become stricter.
    stricter: float


_OF_ALL = Tolerances(error_ratio=1.03, coverage=0.02, nees=1.15, stricter=0.05)
_OF_FAMILY = Tolerances(
    error_ratio=1.15, coverage=0.10, nees=1.6, stricter=0.34
)


@dataclass(frozen=True)
class Baseline:
    """Stored scores, the seed of their recordings, and the versions of Python, NumPy and SciPy."""

    seed: int
    versions: str
    scores: dict[str, Score]

    @classmethod
    def read(cls, path: Path) -> "Baseline":
        """Read a file that :meth:`write` wrote."""
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            scores = [_score_of(values) for values in content["scores"]]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{path} is no baseline: {error}. Write one with --update"
            ) from error
        by_name = {score.name: score for score in scores}
        return cls(content["seed"], content["versions"], by_name)

    def write(self, path: Path) -> None:
        """Write a file with a line for each recording."""
        lines = [
            json.dumps(_values_of(score)) for score in self.scores.values()
        ]
        scores = ",\n".join(lines)
        head = f'"seed": {self.seed},\n"versions": {json.dumps(self.versions)}'
        path.write_text(
            f'{{\n{head},\n"scores": [\n{scores}\n]\n}}\n', encoding="utf-8"
        )


def _values_of(score: Score) -> dict[str, Any]:
    """Return the values of a score for the file: rounded, without values that are not set."""
    empty = asdict(Score(family="", name="", verdict=""))
    values = {
        name: value
        for name, value in asdict(score).items()
        if value != empty[name]
    }
    for name in ("over_bound", "nees"):
        if name in values:
            values[name] = float(f"{values[name]:.4g}")
    for name in ("errors", "robust_errors"):
        if name in values:
            values[name] = [float(f"{error:.4g}") for error in values[name]]
    return values


def _score_of(values: dict[str, Any]) -> Score:
    errors = tuple(values.get("errors", ()))
    robust_errors = tuple(values.get("robust_errors", ()))
    return Score(
        **{
            "verdict": "",
            **values,
            "errors": errors,
            "robust_errors": robust_errors,
        }
    )


@dataclass(frozen=True)
class Comparison:
    """Row of a table, and sentences about values that are worse than the tolerances."""

    row: TableRow
    failures: list[str]


def compare(scores: Sequence[Score], baseline: Baseline) -> list[Comparison]:
    """Compare scores with the baseline, family by family and then all together.

    The baseline must contain all recordings.
    """
    families = [*dict.fromkeys(score.family for score in scores)]
    comparisons = []
    for family in families:
        members = [score for score in scores if score.family == family]
        before = [baseline.scores[score.name] for score in members]
        is_judged = len(members) >= _FEWEST_RECORDINGS
        tolerances = _OF_FAMILY if is_judged else None
        comparisons.append(_comparison(family, members, before, tolerances))
    before = [baseline.scores[score.name] for score in scores]
    comparisons.append(_comparison("all", scores, before, _OF_ALL))
    return comparisons


def _comparison(
    family: str,
    now: Sequence[Score],
    before: Sequence[Score],
    tolerances: Tolerances | None,
) -> Comparison:
    """Compare the scores of a family with those of the baseline; no limits without tolerances."""
    figures = _figures(now)
    old_figures = _figures(before)
    figures["error / baseline"] = error_ratio(now, before)
    n_stricter = 0
    for new, old in zip(now, before, strict=True):
        n_stricter += _is_stricter(new, old)
    figures["stricter"] = float(n_stricter)
    row: dict[str, object] = {"family": family, "recordings": len(now)}
    for name, value in figures.items():
        text = _FORMATS[name].format(value)
        old_value = old_figures.get(name, np.nan)
        if not np.isnan(old_value):
            text += f" ({_FORMATS[name].format(old_value)})"
        row[name] = "" if np.isnan(value) else text
    failures = (
        []
        if tolerances is None
        else [*_failures(figures, old_figures, tolerances, now)]
    )
    row["result"] = _result(failures) if tolerances else ""
    return Comparison(row, [f"{family}: {failure}" for failure in failures])


_FORMATS = {
    "error / bound": "{:.2f}",
    "over robust": "{:.2f}",
    "over robust, 90 %": "{:.2f}",
    "90 % covers": "{:.1%}",
    "with allowance": "{:.1%}",
    "NEES": "{:.2f}",
    "no answer": "{:.0f}",
    "USE but wrong": "{:.0f}",
    "error / baseline": "{:.3f}",
    "stricter": "{:.0f}",
}


def _figures(scores: Sequence[Score]) -> dict[str, float]:
    """Return the values of the columns; NaN if no recording has a value."""
    over_bound = [
        score.over_bound for score in scores if score.over_bound is not None
    ]
    nees = [score.nees for score in scores if score.nees is not None]
    over_robust = over_robust_least_squares(scores)
    n_axes = sum(score.axes for score in scores) or np.nan
    n_inside = sum(score.inside for score in scores)
    n_with_allowance = sum(score.inside_allowance for score in scores)
    n_without_answer = sum(not score.verdict for score in scores)
    n_wrong = sum(score.is_wrong for score in scores)
    return {
        "error / bound": float(np.sqrt(_quantile(over_bound, 0.5) / MEDIAN_6)),
        "over robust": _quantile(over_robust, 0.5),
        "over robust, 90 %": _quantile(over_robust, 0.9),
        "90 % covers": n_inside / n_axes,
        "with allowance": n_with_allowance / n_axes,
        "NEES": _quantile(nees, 0.5),
        "no answer": float(n_without_answer),
        "USE but wrong": float(n_wrong),
    }


def _quantile(values: Sequence[float], share: float) -> float:
    """Return a quantile of values; NaN without values."""
    return float(np.quantile(values, share)) if len(values) else np.nan


def over_robust_least_squares(scores: Sequence[Score]) -> list[float]:
    """Return the errors over those of robust least squares on the same recordings.

    Each recording has two ratios, of translation and of rotation. A ratio is skipped if one of its
    two errors is zero.
    """
    ratios = []
    for score in scores:
        for error, robust_error in zip(
            score.errors, score.robust_errors, strict=False
        ):
            if error > 0.0 and robust_error > 0.0:
                ratios.append(error / robust_error)
    return ratios


def error_ratio(now: Sequence[Score], before: Sequence[Score]) -> float:
    """Return the geometric mean of the ratios of errors to the errors in the baseline."""
    logs: list[float] = []
    for family in dict.fromkeys(score.family for score in before):
        pairs = [
            (new.errors, old.errors)
            for new, old in zip(now, before, strict=True)
            if old.family == family
            and old.errors
            and len(new.errors) == len(old.errors)
        ]
        if pairs:
            errors = np.array(pairs)
            luck = _LUCK * np.median(errors[:, 1], axis=0)
            tempered = np.hypot(errors, luck)
            logs += list(np.log(tempered[:, 0] / tempered[:, 1]).ravel())
    return float(np.exp(np.mean(logs))) if logs else np.nan


def _is_stricter(new: Score, old: Score) -> bool:
    return _VERDICTS.index(new.verdict) > _VERDICTS.index(old.verdict)


def _failures(
    figures: dict[str, float],
    old_figures: dict[str, float],
    tolerances: Tolerances,
    scores: Sequence[Score],
) -> Iterator[str]:
    """Yield a sentence for each value outside its tolerance; NaN is never outside."""
    if figures["error / baseline"] > tolerances.error_ratio:
        yield (
            f"errors are {figures['error / baseline']:.3f} times those of the baseline; the limit "
            f"is {tolerances.error_ratio}"
        )
    distance = abs(figures["90 % covers"] - COVERAGE)
    old_distance = abs(old_figures["90 % covers"] - COVERAGE)
    if distance > old_distance + tolerances.coverage:
        yield (
            f"90 % intervals cover {figures['90 % covers']:.1%}, before "
            f"{old_figures['90 % covers']:.1%}"
        )
    if (
        figures["with allowance"]
        < old_figures["with allowance"] - tolerances.coverage
    ):
        yield (
            f"90 % intervals with the allowance cover {figures['with allowance']:.1%}, before "
            f"{old_figures['with allowance']:.1%}"
        )
    if abs(np.log(figures["NEES"] / old_figures["NEES"])) > np.log(
        tolerances.nees
    ):
        yield f"the median NEES is {figures['NEES']:.2f}, before {old_figures['NEES']:.2f}"
    for name in ("no answer", "USE but wrong"):
        if figures[name] > old_figures[name]:
            yield f"{name}: {figures[name]:.0f} recordings, before {old_figures[name]:.0f}"
    if figures["stricter"] > max(1.0, tolerances.stricter * len(scores)):
        yield f"{figures['stricter']:.0f} verdicts are stricter"


def compare_new_draw(
    scores: Sequence[Score], old_scores: Sequence[Score]
) -> Comparison:
    """Compare new recordings with the stored recordings of the same families.

    An estimator can be tuned to the recordings of the baseline, but not to new ones. Differences
    above ``_CHANCE`` standard errors are failures.
    """
    figures = _figures(scores)
    old_figures = _figures(old_scores)
    failures = []
    if _excess([_log_errors(scores), _log_errors(old_scores)]) > _CHANCE:
        failures.append(
            "new draw: errors over their bound are larger than in the baseline"
        )
    shares = [_shares_outside(scores), _shares_outside(old_scores)]
    if _excess(shares) > _CHANCE:
        failures.append(
            "new draw: 90 % intervals cover less than in the baseline"
        )
    row: dict[str, object] = {
        "family": "platforms drawn anew",
        "recordings": len(scores),
    }
    for name, form in _FORMATS.items():
        is_known = name in figures
        text = f"{form} ({form})"
        row[name] = (
            text.format(figures[name], old_figures[name]) if is_known else ""
        )
    return Comparison(row | {"result": _result(failures)}, failures)


def _log_errors(scores: Sequence[Score]) -> FloatArray:
    return np.array(
        [np.log(score.over_bound) for score in scores if score.over_bound]
    )


def _shares_outside(scores: Sequence[Score]) -> FloatArray:
    return np.array(
        [1.0 - score.inside / score.axes for score in scores if score.axes]
    )


def _excess(samples: Sequence[FloatArray]) -> float:
    """Return the mean of the first sample minus that of the second, in standard errors."""
    new, old = samples
    error = np.sqrt(new.var(ddof=1) / len(new) + old.var(ddof=1) / len(old))
    return float((new.mean() - old.mean()) / error)


def _result(failures: Sequence[str]) -> str:
    return "worse" if failures else "ok"
