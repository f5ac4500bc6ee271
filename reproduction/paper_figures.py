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

# Colours of Okabe and Ito 2008, without yellow, which is hardly visible on white.
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
    dict.fromkeys(_SMALL, 7.0)
    | _WHITE
    | {"savefig_dpi": 200, "lines_linewidth": 1.1}
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
    "e_rt": "$e_{rt}$ (m)\nrelative translation",
    "e_rR": "$e_{rR}$ (deg)\nrelative rotation",
    "e_at": "$e_{at}$ (m)\nabsolute translation",
    "e_aR": "$e_{aR}$ (deg)\nabsolute rotation",
}
_DATASET_TITLES = {
    "noise": ("(a) Gaussian noise", "level $a$ (m, 2$a$ rad)"),
    "outliers": ("(b) outliers", "share of poses (%)"),
    "drift": ("(c) drift", "rate (m/m)"),
    "mixture": ("(d) mixed noise", ""),
}
# The axis is linear below a power of ten and logarithmic above it: errors span five decades, and
# some are zero. The smallest error above this value (m, deg) determines the power of ten.
_LINEAR_BELOW = {"e_rt": 1e-3, "e_rR": 1e-2, "e_at": 1e-3, "e_aR": 1e-2}

# Errors (m or deg) below this are rounding.
_ZERO = 1e-6

# Smallest distance between two labels, as a share of the height of the axes.
_LABEL_GAP = 0.088
# Room right of the curves for a label, as a share of the range of levels.
_LABEL_ROOM = 0.12
# Additional room for each letter, as a share of the range of levels.
_LETTER = 0.075

_SMALL_BOLD: dict[str, Any] = {"fontweight": "bold", "fontsize": 6.2}
_BARS: dict[str, Any] = {
    "elinewidth": 0.7,
    "capsize": 1.2,
    "capthick": 0.7,
    "mew": 0.8,
}
_LEGEND: dict[str, Any] = {
    "loc": "center left",
    "bbox_to_anchor": (1.0, 0.5),
    "frameon": False,
    "handlelength": 2.0,
    "fontsize": 6.5,
    "title": "by $e_{at}$, worst first",
    "title_fontsize": 6.0,
    "alignment": "left",
}


@dataclass(frozen=True)
class Line:
    """Line or box of a reference or method in a panel."""

    # Short name beside the line.
    label: str
    # Full name for the legend; empty if the label is enough.
    name: str
    # Colour, marker, dashes.
    look: tuple[str, str, str]
    # Levels of noise; empty in a box plot.
    levels: tuple[float, ...]
    # A summary for each level; a single summary in a box plot.
    summaries: tuple[Summary, ...]


def draw_errors(
    title: str,
    note: str,
    panels: Mapping[tuple[str, str], Sequence[Line]],
    stem: Path,
) -> list[Path]:
    """Draw errors of several references or methods; return the paths of the files.

    The page has a row for each data set and a column for each metric. ``panels`` maps (dataset,
    metric) to lines. ``stem`` is the path of the files without their ending.
    """
    drawn = {dataset for dataset, _ in panels}
    datasets = [dataset for dataset in _DATASET_TITLES if dataset in drawn]
    n_rows = len(datasets)
    with page_style(**_STYLE):
        figure = _new_page(2.05 * n_rows + 0.7, title, note)
        axes = figure.subplots(n_rows, len(METRIC_TITLES), squeeze=False)
        for row, dataset in zip(axes, datasets, strict=True):
            dataset_title, level_title = _DATASET_TITLES[dataset]
            for ax, metric in zip(row, METRIC_TITLES, strict=True):
                _draw_panel(ax, dataset, metric, panels[dataset, metric])
                ax.set_xlabel(level_title)
            row[0].set_ylabel(dataset_title, fontweight="bold", fontsize=8)
            _add_legend(row[-1], panels[dataset, "e_at"])
        for ax, metric_title in zip(
            axes[0], METRIC_TITLES.values(), strict=True
        ):
            ax.set_title(metric_title, fontsize=6.8)
        return _save(figure, stem)


def _draw_panel(
    ax: Axes, dataset: str, metric: str, lines: Sequence[Line]
) -> None:
    """Draw the errors of a data set by a metric."""
    _scale(ax, lines, metric)
    if dataset == "mixture":
        _draw_boxes(ax, lines)
    else:
        _draw_lines(ax, lines)


def _add_legend(ax: Axes, lines: Sequence[Line]) -> None:
    """Add a legend of the lines that have a full name, the largest error first."""

    def last_centre(line: Line) -> float:
        return line.summaries[-1].centre

    named = [line for line in lines if line.name]
    named.sort(key=last_centre, reverse=True)
    if named:
        handles = [_handle(line.name, *line.look) for line in named]
        ax.legend(handles=handles, **_LEGEND)


def _new_page(height: float, title: str, note: str) -> Figure:
    figure = Figure(figsize=(7.2, height), layout="constrained")
    figure.suptitle(title, fontsize=9, fontweight="bold", x=0.01, ha="left")
    figure.supxlabel(note, fontsize=6.5, x=0.01, ha="left", color=_GREY)
    return figure


def _handle(label: str, colour: str, marker: str, dashes: str) -> Line2D:
    return Line2D(
        [], [], color=colour, marker=marker, ls=dashes, mew=0.8, label=label
    )


def _save(figure: Figure, stem: Path) -> list[Path]:
    """Write ``stem``.png and ``stem``.svg; returns both paths."""
    png = stem.with_name(f"{stem.name}.png")
    svg = stem.with_name(f"{stem.name}.svg")
    figure.savefig(png, metadata={"Software": None})
    # The second file has the layout of the first one.
    figure.set_layout_engine("none")
    figure.savefig(svg, metadata={"Date": None})
    return [png, svg]


def _scale(ax: Axes, lines: Sequence[Line], metric: str) -> None:
    """Set a logarithmic axis that includes zero; errors of a box plot are never zero."""
    if not lines[0].levels:
        ax.set_yscale("log")
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        _write_plainly(ax)
        return
    linear_below = _LINEAR_BELOW[metric]
    centres = [summary.centre for line in lines for summary in line.summaries]
    larger = [centre for centre in centres if centre > linear_below]
    if larger:
        exponent = math.floor(math.log10(min(larger)))
        linear_below = 10.0**exponent
    ax.set_yscale("symlog", linthresh=linear_below, linscale=0.35)
    _write_plainly(ax)


def _write_plainly(ax: Axes) -> None:
    """Write powers of ten on the axis as 0.01, without minor ticks."""
    ax.yaxis.set_major_formatter("{x:g}")
    ax.minorticks_off()


def _draw_lines(ax: Axes, lines: Sequence[Line]) -> None:
    levels = lines[0].levels
    first = levels[0]
    last = levels[-1]
    span = last - first
    middle = (len(lines) - 1) / 2
    for number, line in enumerate(lines):
        # Side by side, so that the intervals can be distinguished.
        shift = 0.012 * span * (number - middle)
        _draw_line(ax, line, shift)
    largest = max(summary.high for line in lines for summary in line.summaries)
    if largest < _ZERO:
        ax.text(
            0.5,
            0.5,
            "all zero",
            transform=ax.transAxes,
            ha="center",
            color=_GREY,
        )
        ax.set_ylim(0.0, 1.0)
    else:
        ax.set_ylim(0.0, None)
    longest = max(len(line.label) for line in lines)
    room = _LABEL_ROOM + _LETTER * longest
    ax.set_xlim(first - 0.06 * span, last + room * span)
    ax.set_xticks([first, last], [f"{first:g}", f"{last:g}"])
    ax.set_xticks(levels, minor=True)
    _label_ends(ax, lines, span)


def _draw_line(ax: Axes, line: Line, shift: float) -> None:
    """Draw the errors of a line and their intervals, shifted along the axis of levels."""
    levels = [level + shift for level in line.levels]
    centres = []
    below = []
    above = []
    for summary in line.summaries:
        # An error is not negative, however wide the interval of its mean.
        low = max(summary.low, 0.0)
        centres.append(summary.centre)
        below.append(summary.centre - low)
        above.append(summary.high - summary.centre)
    colour, marker, dashes = line.look
    look: dict[str, Any] = {"color": colour, "marker": marker, "ls": dashes}
    ax.errorbar(levels, centres, yerr=[below, above], **look, **_BARS)


def _label_ends(ax: Axes, lines: Sequence[Line], span: float) -> None:
    """Write the name of each line at its right end; names that would overlap are moved apart."""
    to_axes = ax.transData + ax.transAxes.inverted()
    last = lines[0].levels[-1]
    heights = []
    for line in lines:
        _, height = to_axes.transform((last, line.summaries[-1].centre))
        heights.append(height)
    label_heights = _moved_apart(heights)
    right, _ = to_axes.transform((last + 0.04 * span, 0.0))
    label_start, _ = to_axes.transform((last + 0.09 * span, 0.0))
    for line, height, label_height in zip(
        lines, heights, label_heights, strict=True
    ):
        look: dict[str, Any] = {
            "color": line.look[0],
            "transform": ax.transAxes,
        }
        ax.plot([right, label_start], [height, label_height], lw=0.5, **look)
        look |= _SMALL_BOLD
        ax.text(
            label_start, label_height, f" {line.label}", va="center", **look
        )


def _moved_apart(heights: Sequence[float]) -> list[float]:
    """Return heights (share of the axes) with gaps for labels, inside the axes if possible."""
    placed = list(heights)
    order = sorted(range(len(heights)), key=lambda index: heights[index])
    for before, after in pairwise(order):
        lowest = placed[before] + _LABEL_GAP
        placed[after] = max(placed[after], lowest)
    up = max(0.0, 0.02 - min(placed))
    down = max(0.0, max(placed) - 0.98)
    shift = up - down
    return [height + shift for height in placed]


def _draw_boxes(ax: Axes, lines: Sequence[Line]) -> None:
    labels = []
    colours = []
    for place, line in enumerate(lines):
        colour = line.look[0]
        _draw_box(ax, place, line.summaries[0], colour)
        labels.append(line.label)
        colours.append(colour)
    _coloured_ticks(ax, labels, colours, **_SMALL_BOLD)
    longest = max(len(label) for label in labels)
    if longest > 4:
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
    statistics = {
        "med": summary.centre,
        "q1": summary.low,
        "q3": summary.high,
        "whislo": low,
        "whishi": high,
    }
    thin = {"color": colour, "lw": 0.8}
    ax.bxp(
        [statistics],
        positions=[place],
        widths=0.62,
        showfliers=False,
        patch_artist=True,
        whiskerprops=thin,
        capprops=thin,
        boxprops={
            "facecolor": colour,
            "alpha": 0.3,
            "edgecolor": colour,
            "lw": 0.8,
        },
        medianprops={"color": colour, "lw": 1.8},
        manage_ticks=False,
    )


def draw_components(
    title: str,
    note: str,
    components: Mapping[str, Mapping[str, Summary]],
    stem: Path,
) -> list[Path]:
    """Draw box plots of the components of the relative motions; return the paths of the files.

    ``components`` maps the name of a component to its summaries by reference.
    """
    with page_style(**_STYLE):
        figure = _new_page(4.0, title, note)
        axes = figure.subplots(2, 3, sharey="row")
        for ax, (name, summaries) in zip(
            axes.flat, components.items(), strict=True
        ):
            colours = []
            for place, (reference, summary) in enumerate(summaries.items()):
                colour = REFERENCE_LOOKS[reference][0]
                _draw_box(ax, place, summary, colour)
                colours.append(colour)
            ax.set_title(name)
            _coloured_ticks(ax, summaries, colours, fontweight="bold")
        for row, unit, lowest in zip(
            axes, ("m", "deg"), (3e-4, 3e-2), strict=True
        ):
            row[0].set_ylabel(unit)
            row[0].set_yscale("log")
            _write_plainly(row[0])
            row[0].set_ylim(bottom=lowest)
        return _save(figure, stem)
