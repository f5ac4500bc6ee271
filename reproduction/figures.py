"""Figures 3, 5 and S1-S5 (errors on simulated drives) and 4 (components of the motions), with their
comparisons.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from reproduction import comparison
from reproduction.published import REFERENCES, SIMULATED, Case
from reproduction.rows import ALI_AS_PUBLISHED, METRICS, TITLES, Row
from reproduction.statistics import Summary, Table, quartile_summary
from reproduction.writing import bullets, markdown_table, percent, write_csv, write_text

if TYPE_CHECKING:
    from reproduction.paper_figures import Line
    from reproduction.results import Results

# Data set, method, reference; with level and metric.
Choice = tuple[str, str, str]
Point = tuple[str, float | None, str, str, str]
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


def write_error_figure(name: str, results: Results) -> list[Path]:
    """Write a figure of :data:`FIGURE_METHODS`, its numbers and comparison; returns the paths."""
    table, methods = results.ours, FIGURE_METHODS[name]
    choices = [choice for dataset in SIMULATED for choice in _choices(dataset, methods, table)]
    points = [
        (dataset, level, method, reference, metric)
        for dataset, method, reference in choices
        for level in table.levels(dataset, method)
        for metric in METRICS
    ]
    numbers = (_numbers(point, table.summary(*point)) for point in points)
    return [
        *_draw(*_titles(name, results), choices, results, results.out / name),
        write_csv(results.out / f"{name}.csv", numbers),
        *_compare(name, points, choices, results),
    ]


def _choices(dataset: str, methods: Sequence[str], table: Table) -> list[Choice]:
    """(dataset, method, reference) shown: every reference of a single method, else the best of
    each.
    """
    if len(methods) == 1:
        return [(dataset, methods[0], reference) for reference in REFERENCES]
    return [(dataset, method, table.best_reference(dataset, method)) for method in methods]


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

    panels = {}
    one_method = len({method for _, method, _ in choices}) == 1
    for dataset in SIMULATED:
        chosen = [choice for choice in choices if choice[0] == dataset]
        if one_method:
            groups = [[choice] for choice in chosen]
        else:
            groups = _coinciding(chosen, results.ours)
        for metric in METRICS:
            panels[dataset, metric] = [
                _line(group, one_method, metric, results.ours) for group in groups
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


def _line(group: Sequence[Choice], one_method: bool, metric: str, table: Table) -> Line:
    from reproduction.paper_figures import METHOD_LOOKS, REFERENCE_LOOKS, Line

    dataset, method, reference = group[0]
    levels = table.levels(dataset, method)
    summaries = tuple(table.summary(dataset, level, method, reference, metric) for level in levels)
    levels = () if levels == (None,) else levels
    if one_method:
        return Line(reference, "", REFERENCE_LOOKS[reference], levels, summaries)
    names = ", ".join(TITLES[method] for _, method, _ in group)
    label = "Ali publ." if method == ALI_AS_PUBLISHED else TITLES[method]
    return Line(label, f"{names} {reference}", METHOD_LOOKS[method], levels, summaries)


def _numbers(point: Point, summary: Summary) -> dict[str, Any]:
    """A row of the figure's table."""
    dataset, level, method, reference, metric = point
    return {
        "dataset": dataset,
        "level": "" if level is None else level,
        "method": method,
        "reference": reference,
        "metric": metric,
        "statistic": "median and quartiles" if summary.is_median else "mean and 95 % interval",
        "centre": summary.centre,
        "low": summary.low,
        "high": summary.high,
        "runs": summary.n,
    }


def _compare(
    name: str, points: Sequence[Point], choices: Sequence[Choice], results: Results
) -> list[Path]:
    page = results.out / f"{name}_comparison.md"
    heading = f"# {name}: comparison with the published results"
    if results.theirs is None:
        text = "Nothing to compare with: name the folder of the published data with --data-folder."
        return [write_text(page, heading, text)]
    rows: dict[tuple[Any, ...], list[Row]] = {}
    for row in results.rows:
        rows.setdefault((row.dataset, row.level, row.method, row.reference), []).append(row)
    compared = []
    for point in points:
        ours, theirs = results.ours.summary(*point), results.theirs.summary(*point)
        same = comparison.compare_summaries(ours, theirs, results.same_cases)
        line = _numbers(point, ours)
        for part in ("centre", "low", "high"):
            line[f"published_{part}"] = getattr(theirs, part)
        why = "" if same else _why(point, rows, results.same_cases)
        compared.append({**line, "agrees": same, "why": why})
    measure = (
        "to 0.1 % or 1e-6 (m, deg)"
        if results.same_cases
        else "in that their 95 % intervals overlap (other trajectories)"
    )
    paths = [write_csv(results.out / f"{name}_comparison.csv", compared)]
    blocks = [heading, _count(compared, measure), _by_dataset(compared)]
    if name == "fig5":
        blocks.append(_best_variants(choices, results.ours, results.theirs))
    if results.same_cases:
        chosen = set(choices)
        shown = [row for row in results.rows if (row.dataset, row.method, row.reference) in chosen]
        blocks += ["## Row by row", comparison.describe_rows(shown)]
        if "dnlo" in FIGURE_METHODS[name]:
            blocks.append(comparison.describe_dnlo(shown))
        paths.append(comparison.write_rows(results.out / f"{name}_rows.csv", shown))
    return [*paths, write_text(page, *blocks)]


def _why(point: Point, rows: Mapping[tuple[Any, ...], Sequence[Row]], same_cases: bool) -> str:
    if same_cases:
        return comparison.reasons(rows[point[:4]])
    if point[2] == "ali":
        return "published quaternion was never normalised"
    return "95 % intervals do not overlap"


def _count(compared: Sequence[Mapping[str, Any]], measure: str) -> str:
    """How many points agree; the proper Ali, which the paper does not have, counts separately."""
    lines = []
    for proper in (False, True):
        chosen = [line for line in compared if (line["method"] == "ali") == proper]
        if chosen:
            others = [line for line in chosen if not line["agrees"]]
            inside = sum(x["published_low"] <= x["centre"] <= x["published_high"] for x in others)
            whose = "Points of the proper Ali" if proper else "Plotted points"
            rest = f"; of the others {inside} lie within the published interval" if inside else ""
            share = percent(len(chosen) - len(others), len(chosen))
            lines.append(f"{whose} that agree {measure}: {share}{rest}.")
    return "\n".join(lines)


def _by_dataset(compared: Sequence[Mapping[str, Any]]) -> str:
    lines = []
    for dataset, group in groupby(compared, key=lambda line: line["dataset"]):
        some = list(group)
        lines.append(
            {
                "data set": dataset,
                "plotted points that agree": percent(sum(x["agrees"] for x in some), len(some)),
                "farthest from the published value": _farthest(some),
            }
        )
    return markdown_table(lines)


def _farthest(group: Sequence[Mapping[str, Any]]) -> str:
    differing = [line for line in group if not line["agrees"]]
    if not differing:
        return "-"
    x = max(
        differing,
        key=lambda x: abs(np.log((x["centre"] + 1e-6) / (x["published_centre"] + 1e-6))),
    )
    level = f" at {x['level']:g}" if x["level"] != "" else ""
    values = f"{x['centre']:.4g}, published {x['published_centre']:.4g}"
    return f"{TITLES[x['method']]} {x['reference']}{level}, {x['metric']}: {values}"


def _best_variants(choices: Sequence[Choice], ours: Table, theirs: Table) -> str:
    lines = []
    for dataset, method, reference in choices:
        published = theirs.best_reference(dataset, method)
        lines.append(
            {
                "data set": dataset,
                "method": TITLES[method],
                "best variant": reference,
                "ours": f"{ours.score(dataset, method, reference):.4f}",
                "published best": published,
                "theirs": f"{theirs.score(dataset, method, published):.4f}",
            }
        )
    titles = "data set | method | best variant | its e_at (m) | published best | its e_at (m)"
    about = "Best variants, by the mean of e_at over levels and runs (mixture: median):"
    return f"{about}\n\n{markdown_table(lines, titles)}"


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


def _component_rows(found: Components) -> list[dict[str, Any]]:
    return [
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
    ]


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
    theirs = components(results.theirs_source.cases("noise", 0.0))
    lines = []
    for line in _component_rows(ours):
        other = theirs[line["component"]][line["reference"]]
        del line["motions"]
        quartiles = line["lower_quartile"] <= other.centre <= line["upper_quartile"]
        line |= {
            "published_median": other.centre,
            "published_lower_quartile": other.low,
            "published_upper_quartile": other.high,
            "medians_within_quartiles": quartiles and other.low <= line["median"] <= other.high,
        }
        lines.append(line)
    printed = (
        {name: f"{x:.4g}" if isinstance(x, float) else x for name, x in line.items()}
        for line in lines
    )
    blocks += ["Our simulator beside the published trajectories:", markdown_table(printed)]
    return [
        write_csv(results.out / f"{name}_comparison.csv", lines),
        write_text(page, *blocks),
    ]
