"""Figures 3, 5 and S1-S5 (errors on simulated drives) and 4 (components of the motions), with their
comparisons.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from reproduction import comparison, paper_figures
from reproduction.paper_figures import METHOD_LOOKS, REFERENCE_LOOKS, Line
from reproduction.published import REFERENCES, SIMULATED, Case
from reproduction.results import Results, Summary, Table, quartile_summary
from reproduction.rows import ALI_AS_PUBLISHED, METRICS, TITLES, agree
from reproduction.writing import percent, write_csv, write_text

# Data set, method, reference.
Choice = tuple[str, str, str]

FIGURE_METHODS = {
    "fig3": ("dnlo",),
    "fig5": (
        ALI_AS_PUBLISHED,
        "ali",
        "dnl",
        "dnlo",
        "park",
        "taylor",
        "zhuang",
    ),
    "figS1": (ALI_AS_PUBLISHED,),
    "figS1_proper": ("ali",),
    "figS2": ("dnl",),
    "figS3": ("park",),
    "figS4": ("taylor",),
    "figS5": ("zhuang",),
}
_INTERVALS = (
    "Mean and 95 % confidence interval; mixed noise: median, quartiles, whiskers to 1.5 "
    "interquartile ranges. Axes linear near zero, then logarithmic."
)
_COMPONENTS = ("x", "y", "z", "roll", "pitch", "yaw")
_POINT = ["dataset", "level", "method", "reference", "metric"]


def write_error_figure(name: str, results: Results) -> list[Path]:
    """Write a figure of :data:`FIGURE_METHODS`, its numbers and comparison; returns the paths."""
    table = results.ours
    methods = FIGURE_METHODS[name]
    choices = [
        choice
        for dataset in SIMULATED
        for choice in _choices(dataset, methods, table)
    ]
    numbers = _numbers(choices, table)
    paths = [
        *_draw(*_titles(name, results), choices, results, results.out / name),
        write_csv(results.out / f"{name}.csv", numbers),
    ]
    if results.source.is_published:
        paths += _compare(name, numbers, choices, results)
    return paths


def _choices(
    dataset: str, methods: Sequence[str], table: Table
) -> list[Choice]:
    """(dataset, method, reference) shown: every reference of a single method, else the best of
    each.
    """
    if len(methods) == 1:
        return [(dataset, methods[0], reference) for reference in REFERENCES]
    return [
        (dataset, method, table.best_reference(dataset, method))
        for method in methods
    ]


def _numbers(choices: Sequence[Choice], table: Table) -> pd.DataFrame:
    """Return a row for each plotted point."""
    rows = []
    for dataset, method, reference in choices:
        statistic = "mean" if dataset != "mixture" else "median"
        for level, metric in product(table.levels(dataset, method), METRICS):
            point = (dataset, level, method, reference, metric)
            summary = table.summary(*point)
            row = dict(zip(_POINT, point, strict=True))
            row |= {
                "statistic": statistic,
                "centre": summary.centre,
                "low": summary.low,
                "high": summary.high,
                "runs": summary.n,
            }
            rows.append(row)
    return pd.DataFrame(rows)


def _where(number: str, results: Results) -> tuple[str, str]:
    runs = results.source.runs
    if results.source.is_published:
        return f"Figure {number}", f"{runs} published trajectories"
    return f"As Figure {number}", f"{runs} drives of our simulator"


def _titles(name: str, results: Results) -> tuple[str, str]:
    label = name.removeprefix("fig").removesuffix("_proper")
    number, where = _where(label, results)
    if name == "fig5":
        note = (
            f"{_INTERVALS}\nThe variant of each method is the one with the smallest e_at; Ali "
            "as published: its quaternion was never normalised."
        )
        return (
            f"{number}. Calibration errors of each method's best variant on {where}",
            note,
        )
    method = TITLES[FIGURE_METHODS[name][0]]
    if name == "figS1_proper":
        method = "the proper Ali"
        number = f"Beside {label}"
    return (
        f"{number}. Calibration errors of {method} for every reference, on {where}",
        _INTERVALS,
    )


def _draw(
    title: str,
    note: str,
    choices: Sequence[Choice],
    results: Results,
    stem: Path,
) -> list[Path]:
    panels: dict[tuple[str, str], list[Line]] = {}
    one_method = len({method for _, method, _ in choices}) == 1
    for group in _coinciding(choices, results.ours, alone=one_method):
        dataset, method, reference = group[0]
        levels = results.ours.levels(dataset, method)
        names = ", ".join(TITLES[method] for _, method, _ in group)
        short = "Ali publ." if method == ALI_AS_PUBLISHED else TITLES[method]
        for metric in METRICS:
            line = Line(
                label=reference if one_method else short,
                name="" if one_method else f"{names} {reference}",
                look=REFERENCE_LOOKS[reference]
                if one_method
                else METHOD_LOOKS[method],
                levels=tuple(level for level in levels if level is not None),
                summaries=tuple(
                    results.ours.summary(
                        dataset, level, method, reference, metric
                    )
                    for level in levels
                ),
            )
            panels.setdefault((dataset, metric), []).append(line)
    return paper_figures.draw_errors(title, note, panels, stem)


def _coinciding(
    choices: Sequence[Choice], table: Table, alone: bool
) -> list[list[Choice]]:
    """Choices whose errors are the same at every level (Park and Taylor): one line is drawn for all
    of a group. ``alone``: each is a group.
    """
    groups: list[tuple[list[Choice], str, pd.Series]] = []
    for choice in choices:
        centres = _numbers([choice], table)["centre"]
        for group, dataset, other in groups:
            if (
                not alone
                and dataset == choice[0]
                and np.allclose(centres, other, 1e-6, 1e-6)
            ):
                group.append(choice)
                break
        else:
            groups.append(([choice], choice[0], centres))
    return [group for group, _, _ in groups]


def _compare(
    name: str,
    numbers: pd.DataFrame,
    choices: Sequence[Choice],
    results: Results,
) -> list[Path]:
    compared = numbers.copy()
    theirs = _numbers(choices, results.theirs)
    parts = ["centre", "low", "high"]
    published = [f"published_{statistic}" for statistic in parts]
    compared[published] = theirs[parts]
    compared["agrees"] = agree(
        numbers[parts].to_numpy(), theirs[parts].to_numpy()
    ).all(axis=1)
    rows = dict(list(results.rows.groupby(["dataset", "method", "reference"])))
    whys = []
    for point in compared.itertuples():
        some = rows[point.dataset, point.method, point.reference]
        some = some[some["level"].eq(point.level) | some["level"].isna()]
        whys.append("" if point.agrees else comparison.reasons(some))
    others = compared[~compared["agrees"]]
    inside = (
        others["centre"]
        .between(others["published_low"], others["published_high"])
        .sum()
    )
    keys = pd.MultiIndex.from_frame(
        results.rows[["dataset", "method", "reference"]]
    )
    shown = results.rows[keys.isin(pd.MultiIndex.from_tuples(choices))]
    return [
        write_csv(
            results.out / f"{name}_comparison.csv", compared.assign(why=whys)
        ),
        write_text(
            results.out / f"{name}_comparison.md",
            f"# {name}: comparison with the published results",
            "Plotted points that agree to 0.1 % or 1e-6 (m, deg): "
            f"{percent(compared['agrees'].sum(), len(compared))}; of the others {inside} lie "
            "within the published interval.",
            "## Row by row",
            comparison.describe_rows(shown),
            comparison.describe_dnlo(shown)
            if "dnlo" in FIGURE_METHODS[name]
            else "",
        ),
    ]


def write_components(name: str, results: Results) -> list[Path]:
    """Figure 4: the absolute components of the parent's relative motions on the drives without
    noise; returns the paths.
    """
    summaries = components(results.source.cases("noise", 0.0))
    number, where = _where("4", results)
    table = pd.DataFrame(
        {
            "component": component,
            "reference": reference,
            "unit": "m" if component in "xyz" else "deg",
            "median": summary.centre,
            "lower_quartile": summary.low,
            "upper_quartile": summary.high,
            "motions": summary.n,
        }
        for component, of_component in summaries.items()
        for reference, summary in of_component.items()
    )
    return [
        *paper_figures.draw_components(
            f"{number}. Components of the relative motions of {where} without noise",
            "Median, quartiles, whiskers to 1.5 interquartile ranges. Of the parent sensor; "
            "angles are ZYX Euler angles.",
            {
                f"|{component}|": summaries[component]
                for component in _COMPONENTS
            },
            results.out / name,
        ),
        write_csv(results.out / f"{name}.csv", table),
    ]


def components(cases: Sequence[Case]) -> dict[str, dict[str, Summary]]:
    """Summaries of the absolute components (m, deg) of all relative motions, by component and
    reference.
    """
    summaries: dict[str, dict[str, Summary]] = {
        component: {} for component in _COMPONENTS
    }
    for reference in REFERENCES:
        motions = np.concatenate(
            [case.pairs(reference).Ts_parenti_parentj for case in cases]
        )
        angles = Rotation.from_matrix(motions[:, :3, :3]).as_euler(
            "ZYX", degrees=True
        )[:, ::-1]
        values = np.abs(np.hstack([motions[:, :3, 3], angles])).T
        for component, of_component in zip(_COMPONENTS, values, strict=True):
            summaries[component][reference] = quartile_summary(of_component)
    return summaries
