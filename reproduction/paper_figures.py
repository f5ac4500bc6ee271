"""The figures of Välimäki et al. 2023: errors against the level of noise, box plots, components of
the motions.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator

from hand_eye_calib.offline.report.style import page_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from reproduction.results import Summary

# Okabe, Ito 2008, without the yellow that vanishes on white.
_BLACK = "#000000"
_SKY = "#56B4E9"
_GREEN = "#009E73"
_BLUE = "#0072B2"
_VERMILION = "#D55E00"
_PURPLE = "#CC79A7"
_GREY = "#666666"
_SMALL = (
    "font_size",
    "axes_labelsize",
    "xtick_labelsize",
    "ytick_labelsize",
    "axes_titlesize",
)
_WHITE = dict.fromkeys(("figure_facecolor", "savefig_facecolor"), "white")
_STYLE = (
    dict.fromkeys(_SMALL, 7.0) | _WHITE | {"savefig_dpi": 200, "lines_linewidth": 1.1}
)

REFERENCE_LOOKS = {
    "A": (_BLACK, "D", "-"),
    "B1": (_VERMILION, "o", "-"),
    "B5": (_SKY, "o", "-"),
    "B10": (_BLUE, "o", "-"),
    "C5": (_PURPLE, "s", "--"),
    "C10": (_GREEN, "s", "--"),
}
METHOD_LOOKS = {
    "ali": (_BLACK, "v", ":"),
    "ali_as_published": (_GREY, "^", "--"),
    "dnl": (_SKY, "o", "-"),
    "dnlo": (_VERMILION, "D", "-"),
    "park": (_GREEN, "s", "-"),
    "taylor": (_BLUE, "x", "-"),
    "zhuang": (_PURPLE, "P", "--"),
}

METRIC_TITLES = {
    "e_rt": "$e_{rt}$ (m)\nrelative translation", "e_rR": "$e_{rR}$ (deg)\nrelative rotation",
    "e_at": "$e_{at}$ (m)\nabsolute translation", "e_aR": "$e_{aR}$ (deg)\nabsolute rotation",
}  # fmt: skip
_DATASET_TITLES = {
    "noise": ("(a) Gaussian noise", "level $a$ (m, 2$a$ rad)"),
    "outliers": ("(b) outliers", "share of poses (%)"),
    "drift": ("(c) drift", "rate (m/m)"),
    "mixture": ("(d) mixed noise", ""),
}
# Below a power of ten, at least this, the axis is linear, above logarithmic: errors span five
# decades and some are zero.
_LINEAR_BELOW = {"e_rt": 1e-3, "e_rR": 1e-2, "e_at": 1e-3, "e_aR": 1e-2}

# Errors (m or deg) below this are rounding.
_ZERO = 1e-6

# Of the axes' height: distance of labels. Of the levels' range: room for a label, and for each of
# its letters.
_LABEL_GAP = 0.088
_LABEL_ROOM = 0.12
_LETTER = 0.075

_SMALL_BOLD: dict[str, Any] = {"fontweight": "bold", "fontsize": 6.2}
_BARS: dict[str, Any] = {"elinewidth": 0.7, "capsize": 1.2, "capthick": 0.7, "mew": 0.8}
_LEGEND: dict[str, Any] = {
    "loc": "center left", "bbox_to_anchor": (1.0, 0.5), "frameon": False, "handlelength": 2.0,
    "fontsize": 6.5, "title": "by $e_{at}$, worst first", "title_fontsize": 6.0,
    "alignment": "left",
}  # fmt: skip


@dataclass(frozen=True)
class Line:
    """One reference or method in a panel."""

    # Short name beside the line.
    label: str
    # Full name for the legend; empty if the label is enough.
    name: str
    # Colour, marker, dashes.
    look: tuple[str, str, str]
    # Empty in a box plot.
    levels: tuple[float, ...]
    # One per level; one in a box plot.
    summaries: tuple[Summary, ...]


def draw_errors(
    title: str, note: str, panels: Mapping[tuple[str, str], Sequence[Line]], stem: Path
) -> list[Path]:
    """Errors of several references or methods: a row per data set, a column per metric. ``panels``
    maps (dataset, metric) to lines; ``stem`` is the path of the files without their ending. Gives
    the paths.
    """
    datasets = [
        name for name in _DATASET_TITLES if any(key[0] == name for key in panels)
    ]
    with page_style(**_STYLE):
        figure = _new_page(2.05 * len(datasets) + 0.7, title, note)
        axes = figure.subplots(len(datasets), len(METRIC_TITLES), squeeze=False)
        for row, dataset in zip(axes, datasets, strict=True):
            for ax, metric in zip(row, METRIC_TITLES, strict=True):
                lines = panels[dataset, metric]
                _scale(ax, lines, metric)
                (_draw_boxes if dataset == "mixture" else _draw_lines)(ax, lines)
                ax.set_xlabel(_DATASET_TITLES[dataset][1])
            row[0].set_ylabel(
                _DATASET_TITLES[dataset][0], fontweight="bold", fontsize=8
            )
            named = [line for line in panels[dataset, "e_at"] if line.name]
            if named:
                named.sort(key=lambda line: line.summaries[-1].centre, reverse=True)
                handles = [_handle(line.name, *line.look) for line in named]
                row[-1].legend(handles=handles, **_LEGEND)
        for ax, metric in zip(axes[0], METRIC_TITLES, strict=True):
            ax.set_title(METRIC_TITLES[metric], fontsize=6.8)
        return _save(figure, stem)


def _new_page(height: float, title: str, note: str) -> Figure:
    figure = Figure(figsize=(7.2, height), layout="constrained")
    figure.suptitle(title, fontsize=9, fontweight="bold", x=0.01, ha="left")
    figure.supxlabel(note, fontsize=6.5, x=0.01, ha="left", color=_GREY)
    return figure


def _handle(label: str, colour: str, marker: str, dashes: str) -> Line2D:
    return Line2D([], [], color=colour, marker=marker, ls=dashes, mew=0.8, label=label)


def _save(figure: Figure, stem: Path) -> list[Path]:
    """Write ``stem``.png and ``stem``.svg; returns both paths."""
    paths = [stem.with_name(f"{stem.name}.{kind}") for kind in ("png", "svg")]
    figure.savefig(paths[0], metadata={"Software": None})
    figure.set_layout_engine("none")  # that of the first file serves for the second
    figure.savefig(paths[1], metadata={"Date": None})
    return paths


def _scale(ax: Axes, lines: Sequence[Line], metric: str) -> None:
    """A logarithmic axis that includes zero; box plots need none, their errors are never zero."""
    centres = [summary.centre for line in lines for summary in line.summaries]
    if not lines[0].levels:
        ax.set_yscale("log")
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        _write_plainly(ax)
        return
    above = [centre for centre in centres if centre > _LINEAR_BELOW[metric]]
    decade = (
        10.0 ** math.floor(math.log10(min(above))) if above else _LINEAR_BELOW[metric]
    )
    ax.set_yscale("symlog", linthresh=decade, linscale=0.35)
    _write_plainly(ax)


def _write_plainly(ax: Axes) -> None:
    """Powers of ten up the axis as 0.01, without minor ticks."""
    ax.yaxis.set_major_formatter("{x:g}")
    ax.minorticks_off()


def _draw_lines(ax: Axes, lines: Sequence[Line]) -> None:
    first = lines[0].levels[0]
    last = lines[0].levels[-1]
    span = last - first
    for number, line in enumerate(lines):
        # Side by side, so that the intervals can be told apart.
        shift = 0.012 * span * (number - (len(lines) - 1) / 2)
        centres = [summary.centre for summary in line.summaries]
        # An error is not negative, however wide the interval of its mean.
        below = [summary.centre - max(summary.low, 0.0) for summary in line.summaries]
        above = [summary.high - summary.centre for summary in line.summaries]
        colour, marker, dashes = line.look
        at = [level + shift for level in line.levels]
        look: dict[str, Any] = {"color": colour, "marker": marker, "ls": dashes}
        ax.errorbar(at, centres, yerr=[below, above], **look, **_BARS)
    largest = max(summary.high for line in lines for summary in line.summaries)
    if largest < _ZERO:
        ax.text(0.5, 0.5, "all zero", transform=ax.transAxes, ha="center", color=_GREY)
    ax.set_ylim(0.0, None if largest >= _ZERO else 1.0)
    room = _LABEL_ROOM + _LETTER * max(len(line.label) for line in lines)
    ax.set_xlim(first - 0.06 * span, last + room * span)
    ax.set_xticks([first, last], [f"{first:g}", f"{last:g}"])
    ax.set_xticks(lines[0].levels, minor=True)
    _label_ends(ax, lines, span)


def _label_ends(ax: Axes, lines: Sequence[Line], span: float) -> None:
    """The name of each line at its right end, moved apart where they would overlap."""
    to_fraction = ax.transData + ax.transAxes.inverted()
    last = lines[0].levels[-1]
    heights = [
        to_fraction.transform((last, line.summaries[-1].centre))[1] for line in lines
    ]
    placed = list(heights)
    order = sorted(range(len(heights)), key=lambda index: heights[index])
    for before, after in pairwise(order):
        placed[after] = max(placed[after], placed[before] + _LABEL_GAP)
    shift = max(0.0, 0.02 - min(placed)) - max(0.0, max(placed) - 0.98)
    right, text = (
        to_fraction.transform((last + x * span, 0.0))[0] for x in (0.04, 0.09)
    )
    for line, height, place in zip(lines, heights, placed, strict=True):
        look: dict[str, Any] = {"color": line.look[0], "transform": ax.transAxes}
        ax.plot([right, text], [height, place + shift], lw=0.5, **look)
        ax.text(
            text, place + shift, f" {line.label}", va="center", **_SMALL_BOLD, **look
        )


def _draw_boxes(ax: Axes, lines: Sequence[Line]) -> None:
    for place, line in enumerate(lines):
        _draw_box(ax, place, line.summaries[0], line.look[0])
    labels = [line.label for line in lines]
    _coloured_ticks(ax, labels, [line.look[0] for line in lines], **_SMALL_BOLD)
    if max(map(len, labels)) > 4:
        ax.tick_params(axis="x", rotation=90)


def _coloured_ticks(
    ax: Axes, labels: Iterable[str], colours: Iterable[str], **look: Any
) -> None:
    labels = list(labels)
    ax.set_xticks(range(len(labels)), labels)
    for tick, colour in zip(ax.get_xticklabels(), colours, strict=True):
        tick.set(color=colour, **look)


def _draw_box(ax: Axes, place: float, summary: Summary, colour: str) -> None:
    low, high = summary.whiskers
    quartiles = {"med": summary.centre, "q1": summary.low, "q3": summary.high}
    thin = {"color": colour, "lw": 0.8}
    ax.bxp(
        [{**quartiles, "whislo": low, "whishi": high}],
        positions=[place],
        widths=0.62,
        showfliers=False,
        patch_artist=True,
        whiskerprops=thin,
        capprops=thin,
        boxprops={"facecolor": colour, "alpha": 0.3, "edgecolor": colour, "lw": 0.8},
        medianprops={"color": colour, "lw": 1.8},
        manage_ticks=False,
    )


def draw_components(
    title: str, note: str, components: Mapping[str, Mapping[str, Summary]], stem: Path
) -> list[Path]:
    """Box plots of the components of the relative motions, by component with its unit and by
    reference; gives the paths.
    """
    with page_style(**_STYLE):
        figure = _new_page(4.0, title, note)
        axes = figure.subplots(2, 3, sharey="row")
        for ax, (name, summaries) in zip(axes.flat, components.items(), strict=True):
            colours = [REFERENCE_LOOKS[reference][0] for reference in summaries]
            for place, (summary, colour) in enumerate(
                zip(summaries.values(), colours, strict=True)
            ):
                _draw_box(ax, place, summary, colour)
            ax.set_title(name)
            _coloured_ticks(ax, summaries, colours, fontweight="bold")
        for row, unit, lowest in zip(axes, ("m", "deg"), (3e-4, 3e-2), strict=True):
            row[0].set_ylabel(unit)
            row[0].set_yscale("log")
            _write_plainly(row[0])
            row[0].set_ylim(bottom=lowest)
        return _save(figure, stem)
