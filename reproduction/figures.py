"""Figures 3, 5 and S1-S5 (errors on simulated drives) and 4 (components of the motions), with their
comparisons.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from reproduction import comparison
from reproduction.published import REFERENCES, SIMULATED, Case
from reproduction.rows import ALI_AS_PUBLISHED, METRICS, TITLES, Row
from reproduction.statistics import Summary, Table, quartile_summary
from reproduction.writing import bullets, markdown_table, percent, write_csv, write_text

if TYPE_CHECKING:
    from reproduction.results import Results

# Data set, method, reference; with level and metric.
Choice = tuple[str, str, str]
Point = tuple[str, float | None, str, str, str]
# By component and reference.
Components = dict[str, dict[str, Summary]]

_FIG5_METHODS = (ALI_AS_PUBLISHED, "ali", "dnl", "dnlo", "park", "taylor", "zhuang")
FIGURE_METHODS = {
    "fig3": ("dnlo",),
    "fig5": _FIG5_METHODS,
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
# Columns of a figure's points.
_COLUMNS = (
    *("dataset", "level", "method", "reference", "metric"),
    *("statistic", "centre", "low", "high", "runs"),
)
_COMPONENTS = ("x", "y", "z", "roll", "pitch", "yaw")


def write_error_figure(name: str, results: Results) -> list[Path]:
    """Write a figure of errors, its numbers and its comparison; returns the paths.

    Parameters
    ----------
    name : str
        A key of :data:`FIGURE_METHODS`.
    results : Results
    """
    methods = FIGURE_METHODS[name]
    choices = [
        choice for dataset in SIMULATED for choice in _choices(dataset, methods, results.ours)
    ]
    title, note = _titles(name, results)
    points = [
        (dataset, level, method, reference, metric)
        for dataset, method, reference in choices
        for level in results.ours.levels(dataset, method)
        for metric in METRICS
    ]
    paths = _draw(title, note, choices, results, results.out / name)
    paths.append(
        write_csv(
            results.out / f"{name}.csv",
            _COLUMNS,
            (_numbers(point, results.ours.summary(*point)) for point in points),
        )
    )
    return paths + _compare(name, points, choices, results)


def _choices(dataset: str, methods: Sequence[str], table: Table) -> list[Choice]:
    """(dataset, method, reference) shown: every reference of a single method, else the best of
    each.
    """
    if len(methods) == 1:
        return [(dataset, methods[0], reference) for reference in REFERENCES]
    return [(dataset, method, table.best_reference(dataset, method)) for method in methods]


def _titles(name: str, results: Results) -> tuple[str, str]:
    label = name.removeprefix("fig").removesuffix("_proper")
    number = f"Figure {label}" if results.same_cases else f"As Figure {label}"
    runs = results.n_runs
    where = (
        f"{runs} published trajectories"
        if results.same_cases
        else f"{runs} drives of our simulator"
    )
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

    panels = {}
    one_method = len({method for _, method, _ in choices}) == 1
    for dataset in SIMULATED:
        chosen = [choice for choice in choices if choice[0] == dataset]
        groups = (
            [[choice] for choice in chosen] if one_method else _coinciding(chosen, results.ours)
        )
        for metric in METRICS:
            panels[dataset, metric] = [
                _line(paper_figures, group, one_method, metric, results.ours) for group in groups
            ]
    return paper_figures.draw_errors(title, note, panels, stem)


def _coinciding(choices: Sequence[Choice], table: Table) -> list[list[Choice]]:
    """Choices whose errors are the same at every level (Park and Taylor): one line is drawn for all
    of a group.
    """
    groups: list[tuple[list[Choice], list[float]]] = []
    for dataset, method, reference in choices:
        centres = [
            table.summary(dataset, level, method, reference, metric).centre
            for level in table.levels(dataset, method)
            for metric in METRICS
        ]
        for group, other in groups:
            if np.allclose(centres, other, rtol=1e-6, atol=1e-6):
                group.append((dataset, method, reference))
                break
        else:
            groups.append(([(dataset, method, reference)], centres))
    return [group for group, _ in groups]


def _line(
    paper_figures: ModuleType, group: Sequence[Choice], one_method: bool, metric: str, table: Table
) -> Any:
    dataset, method, reference = group[0]
    levels = table.levels(dataset, method)
    summaries = tuple(table.summary(dataset, level, method, reference, metric) for level in levels)
    levels = () if levels == (None,) else levels
    if one_method:
        return paper_figures.Line(
            reference, "", paper_figures.REFERENCE_LOOKS[reference], levels, summaries
        )
    names = ", ".join(TITLES[method] for _, method, _ in group)
    label = "Ali publ." if method == ALI_AS_PUBLISHED else TITLES[method]
    return paper_figures.Line(
        label, f"{names} {reference}", paper_figures.METHOD_LOOKS[method], levels, summaries
    )


def _numbers(point: Point, summary: Summary) -> list[Any]:
    statistic = "median and quartiles" if summary.is_median else "mean and 95 % interval"
    dataset, level, *rest = point
    shown = "" if level is None else level
    return [dataset, shown, *rest, statistic, summary.centre, summary.low, summary.high, summary.n]


def _compare(
    name: str, points: Sequence[Point], choices: Sequence[Choice], results: Results
) -> list[Path]:
    if results.theirs is None:
        text = "Nothing to compare with: name the folder of the published data with --data-folder."
        return [
            write_text(
                results.out / f"{name}_comparison.md",
                f"# {name}: comparison with the published results",
                text,
            )
        ]
    rows: dict[tuple[Any, ...], list[Row]] = {}
    for row in results.rows:
        rows.setdefault((row.dataset, row.level, row.method, row.reference), []).append(row)
    compared = []
    for point in points:
        ours, theirs = results.ours.summary(*point), results.theirs.summary(*point)
        same = comparison.compare_summaries(ours, theirs, results.same_cases)
        why = "" if same else _why(point, rows, results.same_cases)
        compared.append([*_numbers(point, ours), theirs.centre, theirs.low, theirs.high, same, why])
    header = [
        *_COLUMNS,
        "published_centre",
        "published_low",
        "published_high",
        "agrees",
        "why",
    ]
    paths = [write_csv(results.out / f"{name}_comparison.csv", header, compared)]
    measure = (
        "to 0.1 % or 1e-6 (m, deg)"
        if results.same_cases
        else "in that their 95 % intervals overlap (other trajectories)"
    )
    blocks = [
        f"# {name}: comparison with the published results",
        _count(compared, measure),
        _by_dataset(compared),
    ]
    if name == "fig5":
        blocks.append(_best_variants(choices, results.ours, results.theirs))
    if results.same_cases:
        shown = [
            row for row in results.rows if (row.dataset, row.method, row.reference) in set(choices)
        ]
        blocks += ["## Row by row", comparison.describe_rows(shown)]
        if "dnlo" in FIGURE_METHODS[name]:
            blocks.append(comparison.describe_dnlo(shown))
        paths.append(comparison.write_rows(results.out / f"{name}_rows.csv", shown))
    paths.append(write_text(results.out / f"{name}_comparison.md", *blocks))
    return paths


def _why(point: Point, rows: Mapping[tuple[Any, ...], Sequence[Row]], same_cases: bool) -> str:
    if same_cases:
        return comparison.reasons(rows[point[:4]])
    return (
        "published quaternion was never normalised"
        if point[2] == "ali"
        else "95 % intervals do not overlap"
    )


def _count(compared: Sequence[Sequence[Any]], measure: str) -> str:
    """How many points agree; the proper Ali, which the paper does not have, counts separately."""
    lines = []
    for proper in (False, True):
        chosen = [line for line in compared if (line[2] == "ali") == proper]
        if chosen:
            agreeing = sum(line[-2] for line in chosen)
            inside = sum(line[11] <= line[6] <= line[12] for line in chosen if not line[-2])
            whose = "Points of the proper Ali" if proper else "Plotted points"
            rest = f"; of the others {inside} lie within the published interval" if inside else ""
            lines.append(f"{whose} that agree {measure}: {percent(agreeing, len(chosen))}{rest}.")
    return "\n".join(lines)


def _by_dataset(compared: Sequence[Sequence[Any]]) -> str:
    lines = []
    for dataset, group in groupby(compared, key=lambda line: line[0]):
        of_dataset = list(group)
        agreeing = sum(line[-2] for line in of_dataset)
        lines.append([dataset, percent(agreeing, len(of_dataset)), _farthest(of_dataset)])
    return markdown_table(
        ["data set", "plotted points that agree", "farthest from the published value"], lines
    )


def _farthest(group: Sequence[Sequence[Any]]) -> str:
    differing = [line for line in group if not line[-2]]
    if not differing:
        return "-"
    line = max(differing, key=lambda line: abs(np.log((line[6] + 1e-6) / (line[10] + 1e-6))))
    level = f" at {line[1]:g}" if line[1] != "" else ""
    return f"{TITLES[line[2]]} {line[3]}{level}, {line[4]}: {line[6]:.4g}, published {line[10]:.4g}"


def _best_variants(choices: Sequence[Choice], ours: Table, theirs: Table) -> str:
    lines = []
    for dataset, method, reference in choices:
        published = theirs.best_reference(dataset, method)
        score = ours.score(dataset, method, reference)
        other = theirs.score(dataset, method, published)
        lines.append(
            [dataset, TITLES[method], reference, f"{score:.4f}", published, f"{other:.4f}"]
        )
    header = [
        "data set",
        "method",
        "best variant",
        "its e_at (m)",
        "published best",
        "its e_at (m)",
    ]
    return (
        "Best variants, by the mean of e_at over levels and runs (mixture: median):\n\n"
        + markdown_table(header, lines)
    )


def write_components(name: str, results: Results) -> list[Path]:
    """Figure 4: the absolute components of the parent's relative motions on the drives without
    noise; returns the paths.
    """
    from reproduction import paper_figures

    ours = components(results.source.cases("noise", 0.0))
    titles = {
        "x": "|x|",
        "y": "|y|",
        "z": "|z|",
        "roll": "|roll|",
        "pitch": "|pitch|",
        "yaw": "|yaw|",
    }
    where = (
        "published trajectories without noise"
        if results.same_cases
        else "drives of our simulator without noise"
    )
    number = "Figure 4" if results.same_cases else "As Figure 4"
    paths = paper_figures.draw_components(
        f"{number}. Components of the relative motions of {results.n_runs} {where}",
        "Median, quartiles, whiskers to 1.5 interquartile ranges. Of the parent sensor; "
        "angles are ZYX Euler angles.",
        {titles[component]: ours[component] for component in _COMPONENTS},
        results.out / name,
    )
    header = [
        "component",
        "reference",
        "unit",
        "median",
        "lower_quartile",
        "upper_quartile",
        "motions",
    ]
    paths.append(write_csv(results.out / f"{name}.csv", header, _component_rows(ours)))
    return paths + _compare_components(name, ours, results)


def components(cases: Sequence[Case]) -> Components:
    """Summaries of the absolute components (m, deg) of all relative motions, by component and
    reference.
    """
    found: Components = {component: {} for component in _COMPONENTS}
    for reference in REFERENCES:
        motions = np.concatenate([case.pairs(reference).Ts_parenti_parentj for case in cases])
        angles = Rotation.from_matrix(motions[:, :3, :3]).as_euler("ZYX", degrees=True)[:, ::-1]
        for component, values in zip(
            _COMPONENTS, np.abs(np.hstack([motions[:, :3, 3], angles])).T, strict=True
        ):
            found[component][reference] = quartile_summary(values)
    return found


def _component_rows(found: Components) -> Iterator[list[Any]]:
    for component in _COMPONENTS:
        unit = "m" if component in "xyz" else "deg"
        for reference, summary in found[component].items():
            yield [component, reference, unit, summary.centre, summary.low, summary.high, summary.n]


def _describe_ratios(reference: str, ours: Components) -> str:
    x, y, z, roll, pitch, yaw = (ours[name][reference].centre for name in _COMPONENTS)
    return (
        f"{reference}: |z| is {z / max(x, y):.2f} of the larger of |x| and |y|; |roll| and |pitch| "
        f"are {roll / yaw:.2f} and {pitch / yaw:.2f} of |yaw| (medians)"
    )


def _compare_components(name: str, ours: Components, results: Results) -> list[Path]:
    heading = f"# {name}: comparison with the paper"
    ratios = [_describe_ratios(reference, ours) for reference in REFERENCES]
    blocks = [
        heading,
        "The paper gives no numbers for this figure; it says that the motions are "
        "heavily partial to x, y and yaw:",
        bullets(ratios),
    ]
    if results.same_cases or results.theirs_source is None:
        return [write_text(results.out / f"{name}_comparison.md", *blocks)]
    theirs = components(results.theirs_source.cases("noise", 0.0))
    lines = []
    for component, reference, unit, median, low, high, _ in _component_rows(ours):
        other = theirs[component][reference]
        overlap = low <= other.centre <= high and other.low <= median <= other.high
        lines.append(
            [
                component,
                reference,
                unit,
                median,
                low,
                high,
                other.centre,
                other.low,
                other.high,
                overlap,
            ]
        )
    header = [
        "component",
        "reference",
        "unit",
        "median",
        "lower_quartile",
        "upper_quartile",
        "published_median",
        "published_lower_quartile",
        "published_upper_quartile",
        "medians_within_quartiles",
    ]
    blocks += [
        "Our simulator beside the published trajectories:",
        markdown_table(
            header,
            [
                [f"{cell:.4g}" if isinstance(cell, float) else cell for cell in line]
                for line in lines
            ],
        ),
    ]
    return [
        write_csv(results.out / f"{name}_comparison.csv", header, lines),
        write_text(results.out / f"{name}_comparison.md", *blocks),
    ]
