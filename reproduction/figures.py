"""Figures 3, 5 and S1-S5 (errors on simulated drives) and 4 (components of the motions), with their
comparisons.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from reproduction import comparison
from reproduction.published import REFERENCES, SIMULATED, Case
from reproduction.results import Results, Summary, Table, quartile_summary
from reproduction.rows import ALI_AS_PUBLISHED, METRICS, TITLES
from reproduction.writing import bullets, markdown_table, percent, write_csv, write_text

# Data set, method, reference.
Choice = tuple[str, str, str]
# By component and reference.
Components = dict[str, dict[str, Summary]]

FIGURE_METHODS = {
    "fig3": ("dnlo",),
    "fig5": (ALI_AS_PUBLISHED, "ali", "dnl", "dnlo", "park", "taylor", "zhuang"),
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
    table, methods = results.ours, FIGURE_METHODS[name]
    choices = [choice for dataset in SIMULATED for choice in _choices(dataset, methods, table)]
    numbers = _numbers(choices, table)
    return [
        *_draw(*_titles(name, results), choices, results, results.out / name),
        write_csv(results.out / f"{name}.csv", numbers),
        *_compare(name, numbers, choices, results),
    ]


def _choices(dataset: str, methods: Sequence[str], table: Table) -> list[Choice]:
    """(dataset, method, reference) shown: every reference of a single method, else the best of
    each.
    """
    if len(methods) == 1:
        return [(dataset, methods[0], reference) for reference in REFERENCES]
    return [(dataset, method, table.best_reference(dataset, method)) for method in methods]


def _numbers(choices: Sequence[Choice], table: Table) -> pd.DataFrame:
    """A row for every plotted point."""
    return pd.DataFrame(
        {
            **dict(zip(_POINT, (dataset, level, method, reference, metric), strict=True)),
            "statistic": "median and quartiles" if found.is_median else "mean and 95 % interval",
            "centre": found.centre,
            "low": found.low,
            "high": found.high,
            "runs": found.n,
        }
        for dataset, method, reference in choices
        for level in table.levels(dataset, method)
        for metric in METRICS
        for found in [table.summary(dataset, level, method, reference, metric)]
    )


def _titles(name: str, results: Results) -> tuple[str, str]:
    label, runs = name.removeprefix("fig").removesuffix("_proper"), results.n_runs
    number, where = f"As Figure {label}", f"{runs} drives of our simulator"
    if results.same_cases:
        number, where = f"Figure {label}", f"{runs} published trajectories"
    if name == "fig5":
        note = (
            f"{_INTERVALS}\nThe variant of each method is the one with the smallest e_at; Ali "
            "as published: its quaternion was never normalised."
        )
        return f"{number}. Calibration errors of each method's best variant on {where}", note
    method = TITLES[FIGURE_METHODS[name][0]]
    if name == "figS1_proper":
        method, number = "the proper Ali", f"Beside {label}"
    return f"{number}. Calibration errors of {method} for every reference, on {where}", _INTERVALS


def _draw(
    title: str, note: str, choices: Sequence[Choice], results: Results, stem: Path
) -> list[Path]:
    # Imported here: tables need no Matplotlib.
    from reproduction import paper_figures
    from reproduction.paper_figures import METHOD_LOOKS, REFERENCE_LOOKS, Line

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
                look=REFERENCE_LOOKS[reference] if one_method else METHOD_LOOKS[method],
                levels=tuple(level for level in levels if level is not None),
                summaries=tuple(
                    results.ours.summary(dataset, level, method, reference, metric)
                    for level in levels
                ),
            )
            panels.setdefault((dataset, metric), []).append(line)
    return paper_figures.draw_errors(title, note, panels, stem)


def _coinciding(choices: Sequence[Choice], table: Table, alone: bool) -> list[list[Choice]]:
    """Choices whose errors are the same at every level (Park and Taylor): one line is drawn for all
    of a group. ``alone``: each is a group.
    """
    groups: list[tuple[list[Choice], str, Any]] = []
    for choice in choices:
        centres = _numbers([choice], table)["centre"]
        for group, dataset, other in groups:
            if not alone and dataset == choice[0] and np.allclose(centres, other, 1e-6, 1e-6):
                group.append(choice)
                break
        else:
            groups.append(([choice], choice[0], centres))
    return [group for group, _, _ in groups]


def _compare(
    name: str, numbers: pd.DataFrame, choices: Sequence[Choice], results: Results
) -> list[Path]:
    page = results.out / f"{name}_comparison.md"
    heading = f"# {name}: comparison with the published results"
    if results.theirs is None:
        text = "Nothing to compare with: name the folder of the published data with --data-folder."
        return [write_text(page, heading, text)]
    compared = _compared(numbers, choices, results, results.theirs)
    measure = (
        "to 0.1 % or 1e-6 (m, deg)"
        if results.same_cases
        else "in that their 95 % intervals overlap (other trajectories)"
    )
    paths = [write_csv(results.out / f"{name}_comparison.csv", compared)]
    blocks = [heading, _count(compared, measure)]
    if results.same_cases:
        keys = pd.MultiIndex.from_tuples(choices)
        shown = results.rows[
            pd.MultiIndex.from_frame(results.rows[["dataset", "method", "reference"]]).isin(keys)
        ]
        blocks += ["## Row by row", comparison.describe_rows(shown)]
        if "dnlo" in FIGURE_METHODS[name]:
            blocks.append(comparison.describe_dnlo(shown))
    return [*paths, write_text(page, *blocks)]


def _compared(
    numbers: pd.DataFrame, choices: Sequence[Choice], results: Results, theirs: Table
) -> pd.DataFrame:
    """The plotted points with the published ones, and why they differ."""
    compared = numbers.copy()
    of_theirs = _numbers(choices, theirs)
    for part in ("centre", "low", "high"):
        compared[f"published_{part}"] = of_theirs[part]
    agrees, whys = [], []
    rows = dict(list(results.rows.groupby(["dataset", "method", "reference"])))
    for point in compared.itertuples():
        level = None if np.isnan(point.level) else point.level
        key = point.dataset, level, point.method, point.reference, point.metric
        ours, other = results.ours.summary(*key), theirs.summary(*key)
        agrees.append(comparison.compare_summaries(ours, other, results.same_cases))
        why = "95 % intervals do not overlap"
        if results.same_cases:
            some = rows[point.dataset, point.method, point.reference]
            why = comparison.reasons(some[some["level"].eq(point.level) | some["level"].isna()])
        elif point.method == "ali":
            why = "published quaternion was never normalised"
        whys.append("" if agrees[-1] else why)
    return compared.assign(agrees=agrees, why=whys)


def _count(compared: pd.DataFrame, measure: str) -> str:
    """How many points agree; the proper Ali, which the paper does not have, counts separately."""
    lines = []
    for is_proper, chosen in compared.groupby(compared["method"] == "ali"):
        others = chosen[~chosen["agrees"]]
        inside = others["centre"].between(others["published_low"], others["published_high"]).sum()
        whose = "Points of the proper Ali" if is_proper else "Plotted points"
        rest = f"; of the others {inside} lie within the published interval" if inside else ""
        share = percent(len(chosen) - len(others), len(chosen))
        lines.append(f"{whose} that agree {measure}: {share}{rest}.")
    return "\n".join(lines)


def write_components(name: str, results: Results) -> list[Path]:
    """Figure 4: the absolute components of the parent's relative motions on the drives without
    noise; returns the paths.
    """
    from reproduction import paper_figures

    ours = components(results.source.cases("noise", 0.0))
    number, where = "As Figure 4", "drives of our simulator without noise"
    if results.same_cases:
        number, where = "Figure 4", "published trajectories without noise"
    return [
        *paper_figures.draw_components(
            f"{number}. Components of the relative motions of {results.n_runs} {where}",
            "Median, quartiles, whiskers to 1.5 interquartile ranges. Of the parent sensor; "
            "angles are ZYX Euler angles.",
            {f"|{component}|": ours[component] for component in _COMPONENTS},
            results.out / name,
        ),
        write_csv(results.out / f"{name}.csv", _component_rows(ours)),
        *_compare_components(name, ours, results),
    ]


def components(cases: Sequence[Case]) -> Components:
    """Summaries of the absolute components (m, deg) of all relative motions, by component and
    reference.
    """
    found: Components = {component: {} for component in _COMPONENTS}
    for reference in REFERENCES:
        motions = np.concatenate([case.pairs(reference).Ts_parenti_parentj for case in cases])
        angles = Rotation.from_matrix(motions[:, :3, :3]).as_euler("ZYX", degrees=True)[:, ::-1]
        values = np.abs(np.hstack([motions[:, :3, 3], angles])).T
        for component, of_component in zip(_COMPONENTS, values, strict=True):
            found[component][reference] = quartile_summary(of_component)
    return found


def _component_rows(found: Mapping[str, Mapping[str, Summary]]) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "component": component,
            "reference": reference,
            "unit": "m" if component in "xyz" else "deg",
            "median": summary.centre,
            "lower_quartile": summary.low,
            "upper_quartile": summary.high,
            "motions": summary.n,
        }
        for component, of_component in found.items()
        for reference, summary in of_component.items()
    )


def _describe_ratios(reference: str, ours: Components) -> str:
    x, y, z, roll, pitch, yaw = (ours[name][reference].centre for name in _COMPONENTS)
    return (
        f"{reference}: |z| is {z / max(x, y):.2f} of the larger of |x| and |y|; |roll| and |pitch| "
        f"are {roll / yaw:.2f} and {pitch / yaw:.2f} of |yaw| (medians)"
    )


def _compare_components(name: str, ours: Components, results: Results) -> list[Path]:
    page = results.out / f"{name}_comparison.md"
    blocks = [
        f"# {name}: comparison with the paper",
        "The paper gives no numbers for this figure; it says that the motions are "
        "heavily partial to x, y and yaw:",
        bullets(_describe_ratios(reference, ours) for reference in REFERENCES),
    ]
    if results.same_cases or results.theirs_source is None:
        return [write_text(page, *blocks)]
    table = _component_rows(ours).drop(columns="motions")
    theirs = _component_rows(components(results.theirs_source.cases("noise", 0.0)))
    for part in ("median", "lower_quartile", "upper_quartile"):
        table[f"published_{part}"] = theirs[part]
    table["medians_within_quartiles"] = theirs["median"].between(
        table["lower_quartile"], table["upper_quartile"]
    ) & table["median"].between(theirs["lower_quartile"], theirs["upper_quartile"])
    printed = (
        {name: f"{x:.4g}" if isinstance(x, float) else x for name, x in line.items()}
        for line in table.to_dict("records")
    )
    blocks += ["Our simulator beside the published trajectories:", markdown_table(printed)]
    return [
        write_csv(results.out / f"{name}_comparison.csv", table),
        write_text(page, *blocks),
    ]
