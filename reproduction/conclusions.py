"""The paper's conclusions, checked: a verdict on every conclusion, and the numbers behind it.

On simulated drives, "Ali" is the variant as published; "Ali proper" is our implementation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hand_eye_calib.core.base.arrays import FloatArray
from reproduction.figures import components
from reproduction.published import KITTI, METHODS, REFERENCES, SIMULATED
from reproduction.results import Results, Table
from reproduction.rows import ALI_AS_PUBLISHED, METRICS, TITLES
from reproduction.tables import best_variants, with_rectified
from reproduction.writing import write_csv, write_text

_AS_PUBLISHED = (ALI_AS_PUBLISHED, "dnl", "dnlo", "park", "taylor", "zhuang")
# Errors e_at (m) up to this value count as zero.
_NOISE_FREE = 1e-6
# Columns of the tables.
_RT = "e_rt (m)"
_AT = "e_at (m)"
_RECTIFIED = "rectified: e_at (m)"


class Shown:
    """Scores and rows of a run, in the form that the rules need."""

    def __init__(self, results: Results) -> None:
        self.results = results
        self.table: Table = results.ours

    def dnlo(self, dataset: str, metric: str = "e_at") -> dict[str, float]:
        """Return the scores of DNLO by reference."""
        return {
            name: self.table.score(dataset, "dnlo", name, metric)
            for name in REFERENCES
        }

    @cached_property
    def best(self) -> dict[str, dict[str, str]]:
        """Best reference by data set and method."""
        return {
            dataset: {
                method: self.table.best_reference(dataset, method)
                for method in _AS_PUBLISHED
            }
            for dataset in SIMULATED
        }

    def scores(self, dataset: str) -> dict[str, float]:
        """Return the score of each method with its best reference."""
        scores = {}
        for method, reference in self.best[dataset].items():
            scores[method] = self.table.score(dataset, method, reference)
        return scores

    def drift(self, method: str) -> tuple[float, list[float]]:
        """Return the mean e_at with the largest drift: for reference A, and for all others."""
        means = []
        for reference in REFERENCES:
            summary = self.table.summary(
                "drift", 0.05, method, reference, "e_at"
            )
            means.append(summary.centre)
        first, *others = means
        return first, others

    @cached_property
    def drives(self) -> dict[str, pd.DataFrame]:
        """Rows of each KITTI drive by method and reference, with both truths."""
        rows = self.results.rows
        drives = {}
        for name in KITTI:
            rows_of_drive = rows[rows["dataset"] == name]
            drives[name] = with_rectified(rows_of_drive)
        return drives

    def variants(self, drive: str, by: str = _AT) -> dict[str, str]:
        """Return the reference with the smallest error ``by``, for each method on a drive."""
        best = best_variants(self.drives[drive], by)
        return dict(best.index)


@dataclass(frozen=True)
class Judgement:
    """Whether a claim holds, or holds in part, and the numbers that show it."""

    holds: Any
    evidence: str
    in_part: Any = False

    @property
    def verdict(self) -> str:
        """Verdict in words."""
        if self.holds:
            return "Holds"
        if self.in_part:
            return "Holds in part"
        return "Does not hold"


# The docstring of each rule is the claim of the paper that the rule checks.
RULES: list[Callable[[Shown], Judgement]] = []


def write(name: str, results: Results) -> list[Path]:
    """Write ``NAME.md`` and ``NAME.csv``, and return their paths."""
    shown = Shown(results)
    rows = []
    blocks = ["# The paper's conclusions, checked"]
    for number, rule in enumerate(RULES, start=1):
        judgement = rule(shown)
        verdict = judgement.verdict
        evidence = judgement.evidence
        docstring = rule.__doc__ or ""
        claim = " ".join(docstring.split())
        rows.append({"claim": claim, "verdict": verdict, "evidence": evidence})
        blocks.append(f"**{number}. {claim}**\n\n*{verdict}.* {evidence}")
    return [
        write_text(results.out / f"{name}.md", *blocks),
        write_csv(results.out / f"{name}.csv", rows),
    ]


def _listed(values: Mapping[str, Any], form: str = "") -> str:
    """Return methods or references with their values as text."""
    words = []
    for name, value in values.items():
        title = TITLES.get(name, name)
        words.append(f"{title} {value:{form}}")
    return ", ".join(words)


@RULES.append
def _without_noise(shown: Shown) -> Judgement:
    """Without noise, the reference makes no difference (4.2.1)."""
    rows = shown.results.rows
    rows = rows[rows["level"] == 0.0]
    is_wrong = rows["e_at"] > _NOISE_FREE
    counts = is_wrong.groupby(rows["method"]).sum().to_dict()
    n_exact = sum(counts[method] == 0 for method in _AS_PUBLISHED)
    n_rows = len(rows) // len(counts)
    evidence = f"Rows of {n_rows} with e_at above 1e-6 m: {_listed(counts)}."
    return Judgement(n_exact == len(_AS_PUBLISHED), evidence, in_part=n_exact)


@RULES.append
def _longer_with_noise(shown: Shown) -> Judgement:
    """Longer reference distances are better with Gaussian noise (DNLO; 4.2.1)."""
    score = shown.dnlo("noise")
    of_steps = score["B10"] < score["B5"] < score["B1"]
    of_distances = score["C10"] < score["C5"] < score["B1"]
    evidence = f"Mean e_at (m): {_listed(score, '.4f')}."
    return Judgement(of_steps and of_distances, evidence)


@RULES.append
def _first_pose(shown: Shown) -> Judgement:
    """Reference A is not the best even with Gaussian noise, and noticeably worse with outliers and
    drift (DNLO; 4.2.1).
    """
    ratio = {}
    for dataset in ("noise", "outliers", "drift"):
        a, *others = shown.dnlo(dataset).values()
        ratio[dataset] = a / min(others)
    is_worse = ratio["outliers"] > 2 and ratio["drift"] > 2
    evidence = (
        f"e_at of A over that of the best other: {_listed(ratio, '.1f')}."
    )
    return Judgement(is_worse and ratio["noise"] > 1, evidence)


@RULES.append
def _smallest_motions_first(shown: Shown) -> Judgement:
    """With outliers and drift the references rank from the smallest motions to the largest, B1
    first (DNLO; 4.2.1).
    """
    evidence = []
    are_monotone = []
    are_first = []
    for dataset in ("outliers", "drift"):
        order = shown.table.ranking(dataset, "dnlo")
        by_steps = [name for name in order if not name.startswith("C")]
        by_distance = [name for name in order if name.startswith("C")]
        are_monotone.append(
            by_steps == ["B1", "B5", "B10", "A"]
            and by_distance == ["C5", "C10"]
        )
        are_first.append(order[0] == "B1")
        evidence.append(f"{dataset}: {' < '.join(order)}")
    return Judgement(
        holds=all(are_monotone) and all(are_first),
        evidence=f"{'; '.join(evidence)}.",
        in_part=any(are_monotone),
    )


@RULES.append
def _drift_of_dnlo(shown: Shown) -> Judgement:
    """With drift the differences between the references are minute, apart from A (DNLO)."""
    first, others = shown.drift("dnlo")
    smallest = min(others)
    largest = max(others)
    spread = largest / smallest
    of_a = first / smallest
    evidence = (
        f"At 0.05: factor {spread:.2f} among the others, A {of_a:.1f} times."
    )
    return Judgement(spread < 2 and first > 3 * largest, evidence)


@RULES.append
def _components(shown: Shown) -> Judgement:
    """The motions are heavily partial to x, y and yaw (4.2.1, Figure 4)."""
    spreads = components(shown.results.source.cases("noise", 0.0))
    medians = []
    for name in ("x", "y", "z", "roll", "pitch", "yaw"):
        medians.append(
            [spreads[name][reference].centre for reference in REFERENCES]
        )
    x, y, z, roll, pitch, yaw = np.array(medians)
    height = np.max(z / np.minimum(x, y))
    tilt = np.max(np.maximum(roll, pitch) / yaw)
    evidence = f"Medians: z at most {height:.2f} of x and y, roll and pitch {tilt:.2f} of yaw."
    return Judgement(height < 0.5 and tilt < 0.5, evidence)


@RULES.append
def _relative_errors(shown: Shown) -> Judgement:
    """With mixed noise B1 is clearly best by the relative errors, but not by the absolute ones
    (DNLO; 4.2.1).
    """
    best = {}
    evidence = []
    for metric in METRICS[:3]:
        scores = shown.dnlo("mixture", metric)
        best[metric] = min(scores, key=lambda reference: scores[reference])
        evidence.append(f"{metric}: {_listed(scores, '.3f')}")
    by_relative = best["e_rt"] == best["e_rR"] == "B1"
    by_absolute = best["e_at"] == "B1"
    return Judgement(
        holds=by_relative and not by_absolute,
        evidence=f"Medians of {'; '.join(evidence)}.",
        in_part=not by_absolute,
    )


@RULES.append
def _no_criterion(shown: Shown) -> Judgement:
    """Relative errors are no criterion for choosing the reference (4.2.1, 6)."""
    choices = {}
    are_different = []
    for method in _AS_PUBLISHED:
        by_relative = shown.table.best_reference("mixture", method, "e_rt")
        by_absolute = shown.table.best_reference("mixture", method, "e_at")
        are_different.append(by_relative != by_absolute)
        choices[method] = f"{by_relative} / {by_absolute}"
    about = "Mixed noise, smallest median e_rt / smallest e_at"
    return Judgement(all(are_different), f"{about}: {_listed(choices)}.")


@RULES.append
def _best_with_noise(shown: Shown) -> Judgement:
    """With Gaussian noise B10 is the best variant of all methods but Zhuang (4.2.2)."""
    best = shown.best["noise"]
    by_b10 = {
        method for method, reference in best.items() if reference == "B10"
    }
    return Judgement(by_b10 == set(best) - {"zhuang"}, f"{_listed(best)}.")


@RULES.append
def _best_with_outliers(shown: Shown) -> Judgement:
    """With outliers B1 is the best variant of most methods (4.2.2)."""
    best = shown.best["outliers"]
    n_by_b1 = list(best.values()).count("B1")
    return Judgement(n_by_b1 > 3, f"{_listed(best)}.")


@RULES.append
def _dnlo_with_outliers(shown: Shown) -> Judgement:
    """With outliers DNLO clearly outperforms the others (4.2.2)."""
    scores = shown.scores("outliers")
    others = [score for method, score in scores.items() if method != "dnlo"]
    evidence = f"Mean e_at of the best variants (m): {_listed(scores, '.4f')}."
    return Judgement(scores["dnlo"] < 0.5 * min(others), evidence)


@RULES.append
def _ali_with_outliers(shown: Shown) -> Judgement:
    """The poor performance of Ali with outliers is explained by the rotation error not entering its
    cost (4.2.2).
    """
    titles = {ALI_AS_PUBLISHED: "as published", "ali": "properly", "dnl": "DNL"}
    errors = {}
    evidence = []
    for method, title in titles.items():
        best = shown.table.best_reference("outliers", method)
        metres = shown.table.score("outliers", method, best, "e_at")
        degrees = shown.table.score("outliers", method, best, "e_aR")
        errors[method] = np.array([metres, degrees])
        evidence.append(f"{title} {metres:.3f} m, {degrees:.1f} deg")
    proper = errors["ali"]
    return Judgement(
        holds=np.all(proper > 0.8 * errors[ALI_AS_PUBLISHED]),
        evidence=f"Mean errors of the best variants: {', '.join(evidence)}.",
        in_part=np.any(proper > 1.2 * errors["dnl"]),
    )


@RULES.append
def _separable_rotation(shown: Shown) -> Judgement:
    """The separable methods have very small rotation errors with outliers and drift (4.2.2)."""
    rows = shown.results.rows
    rows = rows[rows["method"].isin(["park", "taylor"])]
    rows = rows[rows["dataset"].isin(["outliers", "drift"])]
    largest = rows["e_aR"].max()
    evidence = f"Largest e_aR of Park and Taylor: {largest:.1e} deg."
    return Judgement(largest < 1e-3, evidence)


@RULES.append
def _drift_of_all(shown: Shown) -> Judgement:
    """With drift there is very little difference between the references, apart from A, for any of
    the methods (4.2.2).
    """
    factors = {}
    for method in _AS_PUBLISHED:
        _, others = shown.drift(method)
        factors[method] = max(others) / min(others)
    evidence = (
        f"At 0.05, worst of the others over best: {_listed(factors, '.1f')}."
    )
    in_part = min(factors.values()) < 2
    return Judgement(max(factors.values()) < 2, evidence, in_part)


@RULES.append
def _best_with_mixture(shown: Shown) -> Judgement:
    """With mixed noise B5 is the best variant of all methods (4.2.2)."""
    best = shown.best["mixture"]
    references = set(best.values())
    return Judgement(
        references == {"B5"}, f"{_listed(best)}.", "B5" in references
    )


@RULES.append
def _dnlo_against_others(shown: Shown) -> Judgement:
    """DNLO either matched or outperformed the other methods in most noise conditions (6)."""
    ratios = {}
    for dataset in SIMULATED:
        scores = shown.scores(dataset)
        ratios[dataset] = scores["dnlo"] / min(scores.values())
    n_matched = sum(ratio < 1.05 for ratio in ratios.values())
    evidence = f"e_at over the best method's: {_listed(ratios, '.2f')}."
    return Judgement(n_matched >= 3, evidence, in_part=n_matched >= 2)


@RULES.append
def _zhuang_on_the_short_drive(shown: Shown) -> Judgement:
    """On the short drive Zhuang has the lowest relative errors and converges to a wrong solution
    (5.2, Table 1).
    """
    rows = shown.drives["kitti_short"]
    best = best_variants(rows)
    zhuang = best.loc["zhuang"].iloc[0]
    lowest, variant = best[_RT].idxmin()
    farthest, _ = best[_AT].idxmax()
    dnl = rows.loc[("dnl", "B1"), _RT]
    errors = f"e_rt {zhuang[_RT]:.3f} m, e_at {zhuang[_AT]:.3f} m"
    evidence = f"Zhuang {variant}: {errors}; DNL B1: e_rt {dnl:.3f} m."
    return Judgement(lowest == farthest == "zhuang", evidence)


@RULES.append
def _short_drive(shown: Shown) -> Judgement:
    """On the short drive all other methods are best with B5 or B10 (5.2, Table 1)."""
    best = shown.variants("kitti_short")
    rectified = _listed(shown.variants("kitti_short", _RECTIFIED))
    evidence = f"{_listed(best)}; by the rectified truth {rectified}."
    references = {name for method, name in best.items() if method != "zhuang"}
    return Judgement(references <= {"B5", "B10"}, evidence)


@RULES.append
def _long_drive(shown: Shown) -> Judgement:
    """On the long drive the middle step lengths are best: B5, and for DNLO C5, marginally better
    than B5 (5.2, Table 2).
    """
    best = shown.variants("kitti_long")
    dnlo = shown.drives["kitti_long"][_AT]["dnlo"]
    of_b5 = dnlo["B5"]
    of_c5 = dnlo["C5"]
    is_middle = set(best.values()) <= {"B5", "C5", "C10"}
    rectified = _listed(shown.variants("kitti_long", _RECTIFIED))
    errors = f"DNLO C5 {of_c5:.3f} m, B5 {of_b5:.3f} m"
    evidence = f"{_listed(best)}; {errors}; by the rectified truth {rectified}."
    holds = is_middle and best["dnlo"] == "C5" and of_b5 > of_c5
    return Judgement(holds, evidence, in_part=is_middle)


@RULES.append
def _usual_reference(shown: Shown) -> Judgement:
    """The usual reference B1 is worse than others on realistic data (5.2, 6)."""
    counts = {}
    for truth in (_AT, _RECTIFIED):
        counts[truth] = 0
        for drive in KITTI:
            best = shown.variants(drive, truth)
            counts[truth] += list(best.values()).count("B1")
    n_worse = 0
    for method in _AS_PUBLISHED:
        rank = shown.table.ranking("mixture", method).index("B1")
        n_worse += rank >= 3
    evidence = (
        f"Best of {counts[_AT]} of 12 (method, drive) by the published truth, of "
        f"{counts[_RECTIFIED]} by the rectified one. With mixed noise in the worse half of the "
        f"references for {n_worse} of {len(_AS_PUBLISHED)} methods."
    )
    return Judgement(counts[_AT] <= 1, evidence)


@RULES.append
def _reference_against_method(shown: Shown) -> Judgement:
    """The choice of the reference matters more than the choice of the method (5.2, 6)."""
    evidence = []
    are_larger = []
    for dataset in (*SIMULATED, *KITTI):
        errors = _errors_of_variants(shown, dataset)
        by_reference = _median_ratio(errors, axis=1)
        by_method = _median_ratio(errors, axis=0)
        are_larger.append(by_reference > by_method)
        evidence.append(f"{dataset} {by_reference:.1f} against {by_method:.1f}")
    about = "Worst e_at over best, across references against across methods (medians)"
    return Judgement(
        holds=all(are_larger),
        evidence=f"{about}: {', '.join(evidence)}.",
        in_part=sum(are_larger) > len(are_larger) / 2,
    )


def _errors_of_variants(shown: Shown, dataset: str) -> FloatArray:
    """Return the scores e_at (methods, references) of a data set."""
    if dataset in KITTI:
        column = shown.drives[dataset][_AT]
        rows = [
            [column[method][name] for name in REFERENCES] for method in METHODS
        ]
        return np.array(rows)
    rows = []
    for method in _AS_PUBLISHED:
        rows.append(
            [shown.table.score(dataset, method, name) for name in REFERENCES]
        )
    return np.array(rows)


def _median_ratio(errors: FloatArray, axis: int) -> float:
    """Return the median of the ratios of the largest to the smallest error along an axis."""
    largest = errors.max(axis=axis)
    smallest = errors.min(axis=axis)
    return float(np.median(largest / smallest))
