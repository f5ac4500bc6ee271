"""The paper's conclusions, one by one: whether our run shows them, and by which figures. Ali on
simulated drives is the paper's own unless named proper.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from reproduction.figures import components
from reproduction.published import KITTI, METHODS, REFERENCES, SIMULATED
from reproduction.results import Results, Table
from reproduction.rows import ALI_AS_PUBLISHED, METRICS, TITLES
from reproduction.tables import best_variants, with_rectified
from reproduction.writing import write_csv, write_text

_AS_PUBLISHED = (ALI_AS_PUBLISHED, "dnl", "dnlo", "park", "taylor", "zhuang")
_NOISE_FREE = 1e-6
_AT = "e_at (m)"
_RECTIFIED = "rectified: e_at (m)"


class Shown:
    """What the results show, as the rules need it."""

    def __init__(self, results: Results) -> None:
        self.results = results
        self.table: Table = results.ours

    def dnlo(self, dataset: str, metric: str = "e_at") -> dict[str, float]:
        """Scores of DNLO by reference."""
        return {
            name: self.table.score(dataset, "dnlo", name, metric) for name in REFERENCES
        }

    @cached_property
    def best(self) -> dict[str, dict[str, str]]:
        """The best reference by data set and method."""
        return {
            dataset: {
                method: self.table.best_reference(dataset, method)
                for method in _AS_PUBLISHED
            }
            for dataset in SIMULATED
        }

    def scores(self, dataset: str) -> dict[str, float]:
        """Scores of the best variants by method."""
        references = self.best[dataset].items()
        return {
            method: self.table.score(dataset, method, name)
            for method, name in references
        }

    def drift(self, method: str) -> list[float]:
        """Mean e_at with the largest drift, by reference, that of A first."""
        summaries = (
            self.table.summary("drift", 0.05, method, name, "e_at")
            for name in REFERENCES
        )
        return [summary.centre for summary in summaries]

    @cached_property
    def drives(self) -> dict[str, pd.DataFrame]:
        """Rows of each KITTI drive by method and reference, with both truths."""
        rows = self.results.rows
        return {name: with_rectified(rows[rows["dataset"] == name]) for name in KITTI}

    def variants(self, drive: str, by: str = _AT) -> dict[str, str]:
        """The best reference of each method on a drive."""
        return dict(best_variants(self.drives[drive], by).index)


# Whether a claim holds, whether it does in part, and the figures.
Found = tuple[Any, Any, str]
# Their docstrings are the claims.
RULES: list[Callable[[Shown], Found]] = []


def write(name: str, results: Results) -> list[Path]:
    """Write ``NAME.md`` and ``NAME.csv``; returns the paths."""
    shown = Shown(results)
    rows = []
    for rule in RULES:
        holds, in_part, evidence = rule(shown)
        verdict = "Holds" if holds else "Holds in part" if in_part else "Does not hold"
        claim = " ".join((rule.__doc__ or "").split())
        rows.append({"claim": claim, "verdict": verdict, "evidence": evidence})
    blocks = [
        f"**{number}. {row['claim']}**\n\n*{row['verdict']}.* {row['evidence']}"
        for number, row in enumerate(rows, start=1)
    ]
    return [
        write_text(
            results.out / f"{name}.md", "# The paper's conclusions, checked", *blocks
        ),
        write_csv(results.out / f"{name}.csv", rows),
    ]


def _listed(values: Mapping[str, Any], form: str = "") -> str:
    """Methods or references with their values."""
    return ", ".join(
        f"{TITLES.get(name, name)} {value:{form}}" for name, value in values.items()
    )


@RULES.append
def _without_noise(shown: Shown) -> Found:
    """Without noise, the reference makes no difference (4.2.1)."""
    rows = shown.results.rows
    rows = rows[rows["level"] == 0.0]
    counts = (rows["e_at"] > _NOISE_FREE).groupby(rows["method"]).sum().to_dict()
    exact = sum(counts[method] == 0 for method in _AS_PUBLISHED)
    n_rows = len(rows) // len(counts)
    evidence = f"Rows of {n_rows} with e_at above 1e-6 m: {_listed(counts)}."
    return exact == len(_AS_PUBLISHED), exact, evidence


@RULES.append
def _longer_with_noise(shown: Shown) -> Found:
    """Longer reference distances are better with Gaussian noise (DNLO; 4.2.1)."""
    score = shown.dnlo("noise")
    holds = (
        score["B10"] < score["B5"] < score["B1"]
        and score["C10"] < score["C5"] < score["B1"]
    )
    return holds, False, f"Mean e_at (m): {_listed(score, '.4f')}."


@RULES.append
def _first_pose(shown: Shown) -> Found:
    """Reference A is not the best even with Gaussian noise, and noticeably worse with outliers and
    drift (DNLO; 4.2.1).
    """
    ratio = {}
    for dataset in ("noise", "outliers", "drift"):
        a, *others = shown.dnlo(dataset).values()
        ratio[dataset] = a / min(others)
    holds = ratio["noise"] > 1 and min(ratio["outliers"], ratio["drift"]) > 2
    return (
        holds,
        False,
        f"e_at of A over that of the best other: {_listed(ratio, '.1f')}.",
    )


@RULES.append
def _smallest_motions_first(shown: Shown) -> Found:
    """With outliers and drift the references rank from the smallest motions to the largest, B1
    first (DNLO; 4.2.1).
    """
    orders = {name: shown.table.ranking(name, "dnlo") for name in ("outliers", "drift")}
    monotone = [
        [name for name in order if name[0] != "C"] == ["B1", "B5", "B10", "A"]
        and order.index("C5") < order.index("C10")
        for order in orders.values()
    ]
    first = all(order[0] == "B1" for order in orders.values())
    evidence = "; ".join(
        f"{name}: {' < '.join(order)}" for name, order in orders.items()
    )
    return all(monotone) and first, any(monotone), f"{evidence}."


@RULES.append
def _drift_of_dnlo(shown: Shown) -> Found:
    """With drift the differences between the references are minute, apart from A (DNLO)."""
    a, *others = shown.drift("dnlo")
    spread = max(others) / min(others)
    of_a = a / min(others)
    holds = spread < 2 and a > 3 * max(others)
    return (
        holds,
        False,
        f"At 0.05: factor {spread:.2f} among the others, A {of_a:.1f} times.",
    )


@RULES.append
def _components(shown: Shown) -> Found:
    """The motions are heavily partial to x, y and yaw (4.2.1, Figure 4)."""
    spreads = components(shown.results.source.cases("noise", 0.0))
    x, y, z, roll, pitch, yaw = (
        np.array([spreads[name][reference].centre for reference in REFERENCES])
        for name in ("x", "y", "z", "roll", "pitch", "yaw")
    )
    height = (z / np.minimum(x, y)).max()
    tilt = (np.maximum(roll, pitch) / yaw).max()
    evidence = (
        f"Medians: z at most {height:.2f} of x and y, roll and pitch {tilt:.2f} of yaw."
    )
    return height < 0.5 and tilt < 0.5, False, evidence


@RULES.append
def _relative_errors(shown: Shown) -> Found:
    """With mixed noise B1 is clearly best by the relative errors, but not by the absolute ones
    (DNLO; 4.2.1).
    """
    scores = {metric: shown.dnlo("mixture", metric) for metric in METRICS}
    best = {
        metric: min(values, key=lambda x: values[x])
        for metric, values in scores.items()
    }
    evidence = "; ".join(
        f"{metric}: {_listed(scores[metric], '.3f')}" for metric in METRICS[:3]
    )
    relative = best["e_rt"] == best["e_rR"] == "B1"
    return (
        relative and best["e_at"] != "B1",
        best["e_at"] != "B1",
        f"Medians of {evidence}.",
    )


@RULES.append
def _no_criterion(shown: Shown) -> Found:
    """Relative errors are no criterion for choosing the reference (4.2.1, 6)."""
    picks = {
        method: [
            shown.table.best_reference("mixture", method, x) for x in ("e_rt", "e_at")
        ]
        for method in _AS_PUBLISHED
    }
    holds = all(
        by_relative != by_absolute for by_relative, by_absolute in picks.values()
    )
    evidence = _listed({method: " / ".join(names) for method, names in picks.items()})
    return (
        holds,
        False,
        f"Mixed noise, smallest median e_rt / smallest e_at: {evidence}.",
    )


@RULES.append
def _best_with_noise(shown: Shown) -> Found:
    """With Gaussian noise B10 is the best variant of all methods but Zhuang (4.2.2)."""
    best = shown.best["noise"]
    holds = all(
        (name == "B10") == (method != "zhuang") for method, name in best.items()
    )
    return holds, False, f"{_listed(best)}."


@RULES.append
def _best_with_outliers(shown: Shown) -> Found:
    """With outliers B1 is the best variant of most methods (4.2.2)."""
    best = shown.best["outliers"]
    return sum(name == "B1" for name in best.values()) > 3, False, f"{_listed(best)}."


@RULES.append
def _dnlo_with_outliers(shown: Shown) -> Found:
    """With outliers DNLO clearly outperforms the others (4.2.2)."""
    scores = shown.scores("outliers")
    others = [score for method, score in scores.items() if method != "dnlo"]
    evidence = f"Mean e_at of the best variants (m): {_listed(scores, '.4f')}."
    return scores["dnlo"] < 0.5 * min(others), False, evidence


@RULES.append
def _ali_with_outliers(shown: Shown) -> Found:
    """The poor performance of Ali with outliers is explained by the rotation error not entering its
    cost (4.2.2).
    """
    proper, published, dnl = (
        [
            shown.table.score("outliers", method, best, metric)
            for metric in ("e_at", "e_aR")
        ]
        for method in ("ali", ALI_AS_PUBLISHED, "dnl")
        for best in [shown.table.best_reference("outliers", method)]
    )
    whose = {"as published": published, "properly": proper, "DNL": dnl}
    evidence = ", ".join(
        f"{name} {e[0]:.3f} m, {e[1]:.1f} deg" for name, e in whose.items()
    )
    return (
        all(
            ours > 0.8 * theirs for ours, theirs in zip(proper, published, strict=True)
        ),
        any(ours > 1.2 * other for ours, other in zip(proper, dnl, strict=True)),
        f"Mean errors of the best variants: {evidence}.",
    )


@RULES.append
def _separable_rotation(shown: Shown) -> Found:
    """The separable methods have very small rotation errors with outliers and drift (4.2.2)."""
    rows = shown.results.rows
    rows = rows[rows["method"].isin(["park", "taylor"])]
    largest = rows["e_aR"][rows["dataset"].isin(["outliers", "drift"])].max()
    return largest < 1e-3, False, f"Largest e_aR of Park and Taylor: {largest:.1e} deg."


@RULES.append
def _drift_of_all(shown: Shown) -> Found:
    """With drift there is very little difference between the references, apart from A, for any of
    the methods (4.2.2).
    """
    errors = {method: shown.drift(method)[1:] for method in _AS_PUBLISHED}
    factors = {method: max(values) / min(values) for method, values in errors.items()}
    evidence = f"At 0.05, worst of the others over best: {_listed(factors, '.1f')}."
    return max(factors.values()) < 2, min(factors.values()) < 2, evidence


@RULES.append
def _best_with_mixture(shown: Shown) -> Found:
    """With mixed noise B5 is the best variant of all methods (4.2.2)."""
    best = shown.best["mixture"]
    return set(best.values()) == {"B5"}, "B5" in best.values(), f"{_listed(best)}."


@RULES.append
def _dnlo_against_others(shown: Shown) -> Found:
    """DNLO either matched or outperformed the other methods in most noise conditions (6)."""
    ratios = {}
    for dataset in SIMULATED:
        scores = shown.scores(dataset)
        ratios[dataset] = scores["dnlo"] / min(scores.values())
    matched = sum(ratio < 1.05 for ratio in ratios.values())
    return (
        matched >= 3,
        matched >= 2,
        f"e_at over the best method's: {_listed(ratios, '.2f')}.",
    )


@RULES.append
def _zhuang_on_the_short_drive(shown: Shown) -> Found:
    """On the short drive Zhuang has the lowest relative errors and converges to a wrong solution
    (5.2, Table 1).
    """
    rows = shown.drives["kitti_short"]
    best = best_variants(rows)
    zhuang = best.loc["zhuang"].iloc[0]
    _, variant = best["e_rt (m)"].idxmin()
    holds = best["e_rt (m)"].idxmin()[0] == best[_AT].idxmax()[0] == "zhuang"
    dnl = rows.loc[("dnl", "B1"), "e_rt (m)"]
    evidence = (
        f"Zhuang {variant}: e_rt {zhuang['e_rt (m)']:.3f} m, e_at {zhuang[_AT]:.3f} m"
    )
    return holds, False, f"{evidence}; DNL B1: e_rt {dnl:.3f} m."


@RULES.append
def _short_drive(shown: Shown) -> Found:
    """On the short drive all other methods are best with B5 or B10 (5.2, Table 1)."""
    best = {name: shown.variants("kitti_short", name) for name in (_AT, _RECTIFIED)}
    references = {name for method, name in best[_AT].items() if method != "zhuang"}
    evidence = (
        f"{_listed(best[_AT])}; by the rectified truth {_listed(best[_RECTIFIED])}."
    )
    return references <= {"B5", "B10"}, False, evidence


@RULES.append
def _long_drive(shown: Shown) -> Found:
    """On the long drive the middle step lengths are best: B5, and for DNLO C5, marginally better
    than B5 (5.2, Table 2).
    """
    best = shown.variants("kitti_long")
    dnlo = shown.drives["kitti_long"][_AT]["dnlo"]
    is_middle = all(name in ("B5", "C5", "C10") for name in best.values())
    holds = is_middle and best["dnlo"] == "C5" and dnlo["B5"] > dnlo["C5"]
    rectified = _listed(shown.variants("kitti_long", _RECTIFIED))
    evidence = (
        f"{_listed(best)}; DNLO C5 {dnlo['C5']:.3f} m, B5 "
        f"{dnlo['B5']:.3f} m; by the rectified"
    )
    return holds, is_middle, f"{evidence} truth {rectified}."


@RULES.append
def _usual_reference(shown: Shown) -> Found:
    """The usual reference B1 is worse than others on realistic data (5.2, 6)."""
    published, rectified = (
        [
            shown.variants(drive, by)[method] for drive in KITTI for method in METHODS
        ].count("B1")
        for by in (_AT, _RECTIFIED)
    )
    ranks = [
        shown.table.ranking("mixture", method).index("B1") for method in _AS_PUBLISHED
    ]
    return (
        published <= 1,
        False,
        f"Best of {published} of 12 (method, drive) by the published truth, of {rectified} by the "
        f"rectified one. With mixed noise in the worse half of the references for "
        f"{sum(rank >= 3 for rank in ranks)} of {len(ranks)} methods.",
    )


@RULES.append
def _reference_against_method(shown: Shown) -> Found:
    """The choice of the reference matters more than the choice of the method (5.2, 6)."""
    evidence = []
    holds = []
    for dataset in (*SIMULATED, *KITTI):
        of = shown.drives[dataset][_AT] if dataset in KITTI else None
        errors = np.array(
            [
                [
                    shown.table.score(dataset, m, r) if of is None else of[m][r]
                    for r in REFERENCES
                ]
                for m in (_AS_PUBLISHED if of is None else METHODS)
            ]
        )
        by_reference, by_method = (
            np.median(errors.max(axis=axis) / errors.min(axis=axis)) for axis in (1, 0)
        )
        holds.append(by_reference > by_method)
        evidence.append(f"{dataset} {by_reference:.1f} against {by_method:.1f}")
    about = "Worst e_at over best, across references against across methods (medians)"
    return all(holds), sum(holds) > len(holds) / 2, f"{about}: {', '.join(evidence)}."
