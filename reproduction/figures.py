"""Figures 3, 5 and S1-S5 (errors on simulated drives), Figure 4 (components of the motions), and
their comparisons with the published figures.
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

# Data set, method and reference of a plotted line.
Choice = tuple[str, str, str]

# Methods of each figure. Figures of a single method have a line for each reference.
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
# Titles that are too long for a label beside a line.
_SHORT_TITLES = {ALI_AS_PUBLISHED: "Ali publ."}
_COMPONENTS = ("x", "y", "z", "roll", "pitch", "yaw")
# Columns that identify a plotted point.
_POINT = ["dataset", "level", "method", "reference", "metric"]


def write_error_figure(name: str, results: Results) -> list[Path]:
    """Write a figure of :data:`FIGURE_METHODS`, its numbers and its comparison.

    Returns the paths of the files.
    """
    table = results.ours
    methods = FIGURE_METHODS[name]
    choices: list[Choice] = []
    for dataset in SIMULATED:
        choices += _choices(dataset, methods, table)
    numbers = _numbers(choices, table)
    title, note = _titles(name, results)
    paths = [
        *_draw(title, note, choices, results, results.out / name),
        write_csv(results.out / f"{name}.csv", numbers),
    ]
    if results.source.is_published:
        paths += _compare(name, numbers, choices, results)
    return paths


def _choices(
    dataset: str, methods: Sequence[str], table: Table
) -> list[Choice]:
    """Return the lines to plot: all references of a single method, or the best of each method."""
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
    """Return the name of a figure, and its trajectories in words."""
    runs = results.source.runs
    if results.source.is_published:
        return f"Figure {number}", f"{runs} published trajectories"
    return f"As Figure {number}", f"{runs} drives of our simulator"


def _titles(name: str, results: Results) -> tuple[str, str]:
    """Return the title and the note of a figure."""
    label = name.removeprefix("fig").removesuffix("_proper")
    number, where = _where(label, results)
    if name == "fig5":
        note = (
            f"{_INTERVALS}\nThe best variant of a method has the smallest e_at. The quaternion of "
            "Ali as published was not normalised."
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
    """Draw the figure of these choices; return the paths of its files."""
    table = results.ours
    panels: dict[tuple[str, str], list[Line]] = {}
    has_one_method = len({method for _, method, _ in choices}) == 1
    groups = [[choice] for choice in choices]
    if not has_one_method:
        groups = _coinciding(choices, table)
    for group in groups:
        dataset, method, reference = group[0]
        levels = table.levels(dataset, method)
        names = ", ".join(TITLES[method] for _, method, _ in group)
        if has_one_method:
            label = reference
            name = ""
            look = REFERENCE_LOOKS[reference]
        else:
            label = _SHORT_TITLES.get(method, TITLES[method])
            name = f"{names} {reference}"
            look = METHOD_LOOKS[method]
        for metric in METRICS:
            summaries = [
                table.summary(dataset, level, method, reference, metric)
                for level in levels
            ]
            line = Line(
                label=label,
                name=name,
                look=look,
                levels=tuple(level for level in levels if level is not None),
                summaries=tuple(summaries),
            )
            panels.setdefault((dataset, metric), []).append(line)
    return paper_figures.draw_errors(title, note, panels, stem)


def _coinciding(choices: Sequence[Choice], table: Table) -> list[list[Choice]]:
    """Group the choices whose errors are equal at every level, such as Park and Taylor.

    A group gets a single line in the figure.
    """
    groups: list[list[Choice]] = []
    centres_of_groups: list[pd.Series] = []
    for choice in choices:
        dataset, _, _ = choice
        centres = _numbers([choice], table)["centre"]
        for group, other in zip(groups, centres_of_groups, strict=True):
            is_same_dataset = group[0][0] == dataset
            if is_same_dataset and np.allclose(centres, other, 1e-6, 1e-6):
                group.append(choice)
                break
        else:
            groups.append([choice])
            centres_of_groups.append(centres)
    return groups


def _compare(
    name: str,
    numbers: pd.DataFrame,
    choices: Sequence[Choice],
    results: Results,
) -> list[Path]:
    """Write the comparison of plotted points with the published results; return the paths."""
    compared = numbers.copy()
    theirs = _numbers(choices, results.theirs)
    statistics = ["centre", "low", "high"]
    published = [f"published_{statistic}" for statistic in statistics]
    compared[published] = theirs[statistics]
    are_same = agree(
        numbers[statistics].to_numpy(), theirs[statistics].to_numpy()
    )
    compared["agrees"] = are_same.all(axis=1)
    line_keys = ["dataset", "method", "reference"]
    rows_of_lines = dict(list(results.rows.groupby(line_keys)))
    whys = []
    for point in compared.itertuples():
        rows = rows_of_lines[point.dataset, point.method, point.reference]
        is_of_point = rows["level"].eq(point.level) | rows["level"].isna()
        rows = rows[is_of_point]
        whys.append("" if point.agrees else comparison.reasons(rows))
    others = compared[~compared["agrees"]]
    is_inside = others["centre"].between(
        others["published_low"], others["published_high"]
    )
    inside = is_inside.sum()
    keys = pd.MultiIndex.from_frame(results.rows[line_keys])
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
    """Write Figure 4: absolute components of the parent's relative motions, without noise.

    Returns the paths of the files.
    """
    summaries = components(results.source.cases("noise", 0.0))
    number, where = _where("4", results)
    rows = []
    for component, of_component in summaries.items():
        for reference, summary in of_component.items():
            rows.append(
                {
                    "component": component,
                    "reference": reference,
                    "unit": "m" if component in "xyz" else "deg",
                    "median": summary.centre,
                    "lower_quartile": summary.low,
                    "upper_quartile": summary.high,
                    "motions": summary.n,
                }
            )
    table = pd.DataFrame(rows)
    return [
        *paper_figures.draw_components(
            f"{number}. Components of the relative motions of {where} without noise",
            "Median, quartiles, whiskers to 1.5 interquartile ranges. Motions of the parent "
            "sensor; angles are ZYX Euler angles.",
            {
                f"|{component}|": summaries[component]
                for component in _COMPONENTS
            },
            results.out / name,
        ),
        write_csv(results.out / f"{name}.csv", table),
    ]


def components(cases: Sequence[Case]) -> dict[str, dict[str, Summary]]:
    """Return summaries of the absolute components (m, deg) of all relative motions.

    The keys are the component and the reference.
    """
    summaries: dict[str, dict[str, Summary]] = {
        component: {} for component in _COMPONENTS
    }
    for reference in REFERENCES:
        motions = np.concatenate(
            [case.pairs(reference).Ts_parenti_parentj for case in cases]
        )
        rotations = Rotation.from_matrix(motions[:, :3, :3])
        yaw_pitch_roll = rotations.as_euler("ZYX", degrees=True)
        roll_pitch_yaw = yaw_pitch_roll[:, ::-1]
        translations = motions[:, :3, 3]
        values = np.abs(np.hstack([translations, roll_pitch_yaw])).T
        for component, of_component in zip(_COMPONENTS, values, strict=True):
            summaries[component][reference] = quartile_summary(of_component)
    return summaries
