"""The paper's conclusions, one by one: whether our run shows them, and by which figures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from reproduction.figures import components
from reproduction.published import METHODS, REFERENCES, SIMULATED
from reproduction.rows import ALI_AS_PUBLISHED, TITLES, Row
from reproduction.statistics import Table
from reproduction.tables import rectified_errors
from reproduction.writing import write_csv, write_text

if TYPE_CHECKING:
    from reproduction.results import Results

_AS_PUBLISHED = (ALI_AS_PUBLISHED, "dnl", "dnlo", "park", "taylor", "zhuang")
_KITTI_TITLES = {"kitti_short": "short", "kitti_long": "long"}
_NOISE_FREE = 1e-6


@dataclass(frozen=True)
class Conclusion:
    """A claim of the paper, a verdict, and the figures behind it."""

    section: str
    claim: str
    verdict: str
    evidence: str


def write(name: str, results: Results) -> list[Path]:
    """Write ``NAME.md`` and ``NAME.csv``; returns the paths."""
    found = check(results)
    blocks = []
    for number, conclusion in enumerate(found, start=1):
        blocks.append(
            f"**{number}. {conclusion.claim}** (section "
            f"{conclusion.section})\n\n*{conclusion.verdict}.* {conclusion.evidence}"
        )
    return [
        write_text(results.out / f"{name}.md", "# The paper's conclusions, checked", *blocks),
        write_csv(
            results.out / f"{name}.csv",
            ["section", "claim", "verdict", "evidence"],
            ([item.section, item.claim, item.verdict, item.evidence] for item in found),
        ),
    ]


def check(results: Results) -> list[Conclusion]:
    """List of Conclusion for results of all methods on all data sets; Ali on simulated drives is
    the paper's own unless named proper.
    """
    table = results.ours
    return [
        *_on_references(table),
        _on_components(results),
        *_on_relative_errors(results, table),
        *_on_methods(table),
        *_on_kitti(results),
        _reference_against_method(results, table),
    ]


def _verdict(holds: Any, in_part: Any = False) -> str:
    return "Holds" if holds else "Holds in part" if in_part else "Does not hold"


def _named(method: str) -> str:
    return "Ali with a normalised quaternion" if method == "ali" else TITLES[method]


def _scores(
    table: Table,
    dataset: str,
    method: str,
    metric: str = "e_at",
    references: Sequence[str] = REFERENCES,
) -> str:
    unit = "m" if metric.endswith("t") else "deg"
    return (
        ", ".join(
            f"{reference} {table.score(dataset, method, reference, metric):.4f}"
            for reference in references
        )
        + f" {unit}"
    )


def _on_references(table: Table) -> Iterator[Conclusion]:
    counts, n_rows = {}, 0
    for method in (*_AS_PUBLISHED, "ali"):
        errors = np.concatenate(
            [
                table.values(dataset, 0.0, method, reference, "e_at")
                for dataset in ("noise", "outliers", "drift")
                for reference in REFERENCES
            ]
        )
        counts[method], n_rows = int((errors > _NOISE_FREE).sum()), len(errors)
    exact = sum(counts[method] == 0 for method in _AS_PUBLISHED)
    yield Conclusion(
        "4.2.1",
        "Without noise, the reference makes no difference.",
        _verdict(exact == len(_AS_PUBLISHED), exact > 0),
        f"Of {n_rows} rows at level 0, e_at exceeds 1e-6 m in: "
        + ", ".join(f"{_named(method)} {count}" for method, count in counts.items())
        + ".",
    )
    score = {name: table.score("noise", "dnlo", name) for name in REFERENCES}
    yield Conclusion(
        "4.2.1",
        "Longer reference distances are better with Gaussian noise (DNLO).",
        _verdict(
            score["B10"] < score["B5"] < score["B1"] and score["C10"] < score["C5"] < score["B1"]
        ),
        f"Mean e_at over the levels: {_scores(table, 'noise', 'dnlo')}.",
    )
    others = {dataset: table.score(dataset, "dnlo", "A") for dataset in ("outliers", "drift")}
    ratio = {
        dataset: value / min(table.score(dataset, "dnlo", name) for name in REFERENCES[1:])
        for dataset, value in others.items()
    }
    noise_ratio = score["A"] / min(score.values())
    rank = sorted(score, key=lambda name: score[name]).index("A") + 1
    yield Conclusion(
        "4.2.1",
        "Reference A is not the best even with Gaussian noise, and noticeably worse with "
        "outliers and drift (DNLO).",
        _verdict(rank > 1 and min(ratio.values()) > 2),
        f"With noise A is number {rank} of 6, with {noise_ratio:.1f} times the e_at of the best; "
        f"with outliers {ratio['outliers']:.1f} times, with drift {ratio['drift']:.1f} times.",
    )
    orders = {dataset: table.ranking(dataset, "dnlo") for dataset in ("outliers", "drift")}
    monotone = {
        dataset: order.index("B1") < order.index("B5") < order.index("B10") < order.index("A")
        and order.index("C5") < order.index("C10")
        for dataset, order in orders.items()
    }
    yield Conclusion(
        "4.2.1",
        "With outliers and drift the references rank from the smallest motions to the "
        "largest, B1 first (DNLO).",
        _verdict(
            all(monotone.values()) and all(order[0] == "B1" for order in orders.values()),
            any(monotone.values()),
        ),
        "; ".join(
            f"{dataset}: {' < '.join(order)} ({_scores(table, dataset, 'dnlo', references=order)})"
            for dataset, order in orders.items()
        )
        + ". The size of the motions grows in the order B1, C5, B5 or C10, B10, A.",
    )
    drift = {name: table.summary("drift", 0.05, "dnlo", name, "e_at").centre for name in REFERENCES}
    without_a = [drift[name] for name in REFERENCES if name != "A"]
    yield Conclusion(
        "4.2.1, 4.2.2",
        "With drift the differences between the references are minute, apart from A (DNLO).",
        _verdict(max(without_a) < 2 * min(without_a) and drift["A"] > 3 * max(without_a)),
        "At rate 0.05 the worst of the other five has "
        f"{max(without_a) / min(without_a):.2f} times the e_at of the best, A has "
        f"{drift['A'] / min(without_a):.1f} times.",
    )


def _on_components(results: Results) -> Conclusion:
    found = components(results.source.cases("noise", 0.0))
    worst_z = max(
        found["z"][name].centre / min(found["x"][name].centre, found["y"][name].centre)
        for name in REFERENCES
    )
    tilt = max(
        max(found["roll"][name].centre, found["pitch"][name].centre) / found["yaw"][name].centre
        for name in REFERENCES
    )
    at_a = max(found["roll"]["A"].centre, found["pitch"]["A"].centre) / found["yaw"]["A"].centre
    return Conclusion(
        "4.2.1, Figure 4",
        "The motions are heavily partial to x, y and yaw.",
        _verdict(worst_z < 0.5 and tilt < 0.5),
        f"Medians over all references: |z| is at most {worst_z:.2f} of the smaller of |x| "
        "and |y|; the larger of |roll| and |pitch| is at most "
        f"{tilt:.2f} of |yaw| ({at_a:.2f} for A).",
    )


def _on_relative_errors(results: Results, table: Table) -> Iterator[Conclusion]:
    relative = {
        metric: table.best_reference("mixture", "dnlo", metric)
        for metric in ("e_rt", "e_rR", "e_at", "e_aR")
    }
    yield Conclusion(
        "4.2.1",
        "With mixed noise B1 is clearly best by the relative errors, but not by the "
        "absolute ones (DNLO).",
        _verdict(
            relative["e_rt"] == "B1" and relative["e_rR"] == "B1" and relative["e_at"] != "B1",
            relative["e_at"] != "B1",
        ),
        "Smallest median: "
        f"{', '.join(f'{metric} {name}' for metric, name in relative.items())}. Medians "
        "of e_rt: "
        f"{_scores(table, 'mixture', 'dnlo', 'e_rt')}; of e_rR: "
        f"{_scores(table, 'mixture', 'dnlo', 'e_rR')}; of e_at: "
        f"{_scores(table, 'mixture', 'dnlo')}.",
    )
    picks = {
        method: (
            table.best_reference("mixture", method, "e_rt"),
            table.best_reference("mixture", method),
        )
        for method in _AS_PUBLISHED
    }
    hits = {method: _picked_right(results.rows, method) for method in _AS_PUBLISHED}
    yield Conclusion(
        "4.2.1, 6",
        "Relative errors are no criterion for choosing the reference.",
        _verdict(all(by_relative != by_absolute for by_relative, by_absolute in picks.values())),
        "With mixed noise, reference with the smallest median e_rt against that with the "
        "smallest e_at: "
        + ", ".join(
            f"{TITLES[method]} {first} / {second}" for method, (first, second) in picks.items()
        )
        + ". Choosing by e_rt in every single run picks the reference with the smallest e_at in "
        + ", ".join(f"{TITLES[method]} {share:.0%}" for method, share in hits.items())
        + " of the runs; by chance it would be 17 %.",
    )


def _picked_right(rows: Sequence[Row], method: str) -> float:
    """Share of the mixture's runs in which the reference with the smallest e_rt has the smallest
    e_at too.
    """
    runs: dict[str, list[Row]] = {}
    for row in rows:
        if (row.dataset, row.method) == ("mixture", method):
            runs.setdefault(row.run, []).append(row)
    return float(
        np.mean(
            [
                min(of_run, key=lambda row: row.errors[0])
                is min(of_run, key=lambda row: row.errors[2])
                for of_run in runs.values()
            ]
        )
    )


def _on_methods(table: Table) -> Iterator[Conclusion]:
    best = {
        dataset: {method: table.best_reference(dataset, method) for method in _AS_PUBLISHED}
        for dataset in SIMULATED
    }
    yield _best_with_noise(best["noise"])
    yield _best_with_outliers(best["outliers"])
    yield _dnlo_with_outliers(table, best["outliers"])
    yield _ali_with_outliers(table, best["outliers"])
    yield _separable_rotation(table)
    yield _references_with_drift(table)
    yield _best_with_mixture(table, best["mixture"])
    yield _dnlo_against_others(table, best)


def _variants(best: Mapping[str, str]) -> str:
    return ", ".join(f"{TITLES[method]} {reference}" for method, reference in best.items())


def _best_with_noise(best: Mapping[str, str]) -> Conclusion:
    return Conclusion(
        "4.2.2",
        "With Gaussian noise B10 is the best variant of all methods but Zhuang.",
        _verdict(all((name == "B10") == (method != "zhuang") for method, name in best.items())),
        f"{_variants(best)}.",
    )


def _best_with_outliers(best: Mapping[str, str]) -> Conclusion:
    return Conclusion(
        "4.2.2",
        "With outliers B1 is the best variant of most methods.",
        _verdict(sum(name == "B1" for name in best.values()) > 3),
        f"{_variants(best)}.",
    )


def _dnlo_with_outliers(table: Table, best: Mapping[str, str]) -> Conclusion:
    scores = {method: table.score("outliers", method, best[method]) for method in _AS_PUBLISHED}
    rival = min(
        (method for method in scores if method != "dnlo"), key=lambda method: scores[method]
    )
    return Conclusion(
        "4.2.2",
        "With outliers DNLO clearly outperforms the others.",
        _verdict(scores["dnlo"] < 0.5 * scores[rival]),
        f"Mean e_at of the best variants: DNLO {scores['dnlo']:.4f} m, next is "
        f"{TITLES[rival]} with {scores[rival]:.4f} m, "
        f"{scores[rival] / scores['dnlo']:.0f} times as much.",
    )


def _ali_with_outliers(table: Table, best: Mapping[str, str]) -> Conclusion:
    def errors(method: str, reference: str) -> dict[str, float]:
        return {
            metric: table.score("outliers", method, reference, metric)
            for metric in ("e_at", "e_aR")
        }

    proper = errors("ali", table.best_reference("outliers", "ali"))
    published = errors(ALI_AS_PUBLISHED, best[ALI_AS_PUBLISHED])
    dnl = errors("dnl", best["dnl"])
    return Conclusion(
        "4.2.2",
        "The poor performance of Ali with outliers is explained by the rotation error not "
        "entering its cost.",
        _verdict(
            all(proper[metric] > 0.8 * published[metric] for metric in proper),
            any(proper[metric] > 1.2 * dnl[metric] for metric in proper),
        ),
        f"Mean errors of the best variants: as published {published['e_at']:.3f} m, "
        f"{published['e_aR']:.1f} deg; with the same cost and a normalised quaternion "
        f"{proper['e_at']:.3f} m, {proper['e_aR']:.1f} deg; DNL, whose cost has the "
        f"rotation, {dnl['e_at']:.3f} m, {dnl['e_aR']:.1f} deg.",
    )


def _separable_rotation(table: Table) -> Conclusion:
    rotation = {
        dataset: max(
            table.values(dataset, level, method, reference, "e_aR").max()
            for level in table.levels(dataset, "park")
            for method in ("park", "taylor")
            for reference in REFERENCES
        )
        for dataset in ("outliers", "drift")
    }
    return Conclusion(
        "4.2.2",
        "The separable methods have very small rotation errors with outliers and drift.",
        _verdict(max(rotation.values()) < 1e-3),
        f"Largest e_aR of Park and Taylor in any run: {rotation['outliers']:.1e} deg with "
        f"outliers, {rotation['drift']:.1e} deg with drift.",
    )


def _references_with_drift(table: Table) -> Conclusion:
    factors = {}
    for method in _AS_PUBLISHED:
        values = [
            table.summary("drift", 0.05, method, name, "e_at").centre
            for name in REFERENCES
            if name != "A"
        ]
        factors[method] = max(values) / min(values)
    return Conclusion(
        "4.2.2",
        "With drift there is very little difference between the references, apart from A, "
        "for any of the methods.",
        _verdict(max(factors.values()) < 2, min(factors.values()) < 2),
        "At rate 0.05, e_at of the worst of the other five over that of the best: "
        + ", ".join(f"{TITLES[method]} {factor:.1f}" for method, factor in factors.items())
        + ".",
    )


def _best_with_mixture(table: Table, best: Mapping[str, str]) -> Conclusion:
    by_mean = {method: _best_by_mean(table, method) for method in _AS_PUBLISHED}
    return Conclusion(
        "4.2.2",
        "With mixed noise B5 is the best variant of all methods.",
        _verdict(set(best.values()) == {"B5"}, "B5" in best.values()),
        f"By the median e_at: {_variants(best)}. By the mean e_at: {_variants(by_mean)}.",
    )


def _dnlo_against_others(table: Table, best: Mapping[str, Mapping[str, str]]) -> Conclusion:
    ranks = {}
    for dataset in SIMULATED:
        scores = {
            method: table.score(dataset, method, best[dataset][method]) for method in _AS_PUBLISHED
        }
        order = sorted(scores, key=lambda method: scores[method])
        ratio = scores["dnlo"] / scores[order[0]]
        ranks[dataset] = (order.index("dnlo") + 1, order[0], ratio)
    matched = sum(ratio < 1.05 for *_, ratio in ranks.values())
    return Conclusion(
        "6",
        "DNLO either matched or outperformed the other methods in most noise conditions.",
        _verdict(matched >= 3, matched >= 2),
        "e_at of DNLO's best variant over that of the best method: "
        + ", ".join(
            f"{dataset} {ratio:.2f} (number {rank}, first {TITLES[first]})"
            for dataset, (rank, first, ratio) in ranks.items()
        )
        + ".",
    )


def _best_by_mean(table: Table, method: str) -> str:
    return min(
        REFERENCES, key=lambda name: table.values("mixture", None, method, name, "e_at").mean()
    )


def _on_kitti(results: Results) -> Iterator[Conclusion]:
    rows = {
        dataset: {
            method: {row.reference: row for row in results.of(dataset, method)}
            for method in METHODS
        }
        for dataset in _KITTI_TITLES
    }
    best = {
        dataset: {
            method: min(by.values(), key=lambda row: row.errors[2])
            for method, by in of_dataset.items()
        }
        for dataset, of_dataset in rows.items()
    }
    against_rectified = {
        dataset: {
            method: min(by.values(), key=lambda row: rectified_errors(row)[0])
            for method, by in of_dataset.items()
        }
        for dataset, of_dataset in rows.items()
    }

    def named(chosen: Mapping[str, Row], error: Callable[[Row], float]) -> str:
        return ", ".join(
            f"{TITLES[method]} {row.reference} ({error(row):.3f} m)"
            for method, row in chosen.items()
        )

    short, long = best["kitti_short"], best["kitti_long"]
    lowest = min(short.values(), key=lambda row: row.errors[0])
    yield Conclusion(
        "5.2, Table 1",
        "On the short drive Zhuang has the lowest relative errors and converges to a "
        "wrong solution.",
        _verdict(
            lowest.method == "zhuang"
            and max(short.values(), key=lambda row: row.errors[2]).method == "zhuang"
        ),
        f"Zhuang {short['zhuang'].reference}: e_rt {short['zhuang'].errors[0]:.3f} m, "
        f"e_at {short['zhuang'].errors[2]:.3f} m. It is compared in its B1 variant, and "
        "relative errors over short steps are small for every method: DNL with B1 has "
        f"e_rt {rows['kitti_short']['dnl']['B1'].errors[0]:.3f} m.",
    )
    references = {row.reference for method, row in short.items() if method != "zhuang"}
    yield Conclusion(
        "5.2, Table 1",
        "On the short drive all other methods are best with B5 or B10.",
        _verdict(references <= {"B5", "B10"}),
        f"{named(short, lambda row: row.errors[2])}. Against the rectified truth: "
        f"{named(against_rectified['kitti_short'], lambda row: rectified_errors(row)[0])}.",
    )
    dnlo = rows["kitti_long"]["dnlo"]
    middle = all(row.reference in ("B5", "C5", "C10") for row in long.values())
    marginally = long["dnlo"].reference == "C5" and dnlo["B5"].errors[2] > dnlo["C5"].errors[2]
    yield Conclusion(
        "5.2, Table 2",
        "On the long drive the middle step lengths are best: B5, and for DNLO C5, "
        "marginally better than B5.",
        _verdict(middle and marginally, middle),
        f"Published truth: {named(long, lambda row: row.errors[2])}; DNLO with B5 "
        f"{dnlo['B5'].errors[2]:.3f} m. Against the rectified truth: "
        f"{named(against_rectified['kitti_long'], lambda row: rectified_errors(row)[0])}.",
    )
    n_b1 = {
        title: sum(row.reference == "B1" for dataset in chosen for row in chosen[dataset].values())
        for title, chosen in (("published", best), ("rectified", against_rectified))
    }
    mixture = [
        method
        for method in _AS_PUBLISHED
        if results.ours.ranking("mixture", method).index("B1") >= 3
    ]
    yield Conclusion(
        "5.2, 6",
        "The usual reference B1 is worse than others on realistic data.",
        _verdict(n_b1["published"] <= 1),
        f"On the two KITTI drives B1 is the best variant of {n_b1['published']} of 12 "
        f"(method, drive) against the published truth and of {n_b1['rectified']} "
        "against the rectified one. With mixed noise B1 is in the worse half of the six "
        f"references for {len(mixture)} of {len(_AS_PUBLISHED)} methods.",
    )


def _reference_against_method(results: Results, table: Table) -> Conclusion:
    evidence, holds = [], []
    for dataset in (*SIMULATED, *_KITTI_TITLES):
        errors = {
            (method, name): _score(results, table, dataset, method, name)
            for method in (_AS_PUBLISHED if dataset in SIMULATED else METHODS)
            for name in REFERENCES
        }
        methods = {method for method, _ in errors}
        by_reference = np.median(
            [
                max(errors[method, name] for name in REFERENCES)
                / min(errors[method, name] for name in REFERENCES)
                for method in methods
            ]
        )
        by_method = np.median(
            [
                max(errors[method, name] for method in methods)
                / min(errors[method, name] for method in methods)
                for name in REFERENCES
            ]
        )
        holds.append(by_reference > by_method)
        evidence.append(f"{dataset} {by_reference:.1f} against {by_method:.1f}")
    return Conclusion(
        "5.2, 6",
        "The choice of the reference matters more than the choice of the method.",
        _verdict(all(holds), sum(holds) > len(holds) / 2),
        "Worst e_at over best e_at, across references (median over the methods) against "
        "across methods (median over the references): " + ", ".join(evidence) + ".",
    )


def _score(results: Results, table: Table, dataset: str, method: str, reference: str) -> float:
    if dataset in SIMULATED:
        return table.score(dataset, method, reference)
    return next(row.errors[2] for row in results.of(dataset, method) if row.reference == reference)
