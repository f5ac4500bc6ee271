"""How every figure looks: light, readable at the width of a printed page, in colours that the
colour-blind can tell apart.

Figures are made without pyplot: no display, no global state.
"""

import io
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from hand_eye_calib.errors import printable

# Okabe, Ito 2008, without the yellow that vanishes on white.
BLACK, SKY, GREEN, BLUE, VERMILION, PURPLE = (
    "#000000",
    "#56B4E9",
    "#009E73",
    "#0072B2",
    "#D55E00",
    "#CC79A7",
)
GREY, LIGHT_GREY = "#666666", "#DDDDDD"

PAGE_WIDTH = 7.2  # inches

_STYLE: dict[str, Any] = {
    **dict.fromkeys(("font.size", "axes.labelsize"), 7.0),
    **dict.fromkeys(("xtick.labelsize", "ytick.labelsize"), 6.5),
    **dict.fromkeys(("axes.spines.top", "axes.spines.right"), False),
    **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), GREY),
    **dict.fromkeys(("xtick.labelcolor", "ytick.labelcolor"), BLACK),
    **dict.fromkeys(("axes.linewidth", "xtick.major.width", "ytick.major.width"), 0.6),
    **dict.fromkeys(("xtick.major.size", "ytick.major.size"), 2.5),
    **dict.fromkeys(("figure.facecolor", "savefig.facecolor"), "white"),
    "font.family": "DejaVu Sans",
    "axes.titlesize": 7.5,
    "axes.titleweight": "bold",
    "xtick.minor.size": 1.5,
    "xtick.minor.width": 0.4,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.axisbelow": True,
    "grid.color": LIGHT_GREY,
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.1,
    "lines.markersize": 3.2,
    "savefig.dpi": 200,
    # The same figure gives the same file.
    "svg.hashsalt": "hand_eye_calib",
    "svg.fonttype": "none",
}


# Colours as drawn on a page, each with the name of the page's own colour that replaces it.
INK, MUTED, GRID, PAPER = "#1b1f24", "#5c6670", "#d9dee3", "#fefefd"
PARENT, CHILD, BAD, BAND = "#0072b2", "#d98300", "#c8452f", "#0072b3"
_VARIABLES = {
    INK: "ink",
    MUTED: "muted",
    GRID: "grid",
    PAPER: "card",
    PARENT: "parent",
    CHILD: "child",
    BAD: "bad",
    BAND: "parent",
}

WIDTH = 8.6  # inches; a page shows them at about 96 pixels an inch

_TEXT_COLOURS = ("text.color", "axes.labelcolor", "axes.titlecolor")
_PAGE_STYLE: dict[str, Any] = {
    **dict.fromkeys(_TEXT_COLOURS, INK),
    **dict.fromkeys(("xtick.labelcolor", "ytick.labelcolor"), INK),
    **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), MUTED),
    **dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), "none"),
    **dict.fromkeys(("font.size", "axes.labelsize"), 9.0),
    **dict.fromkeys(("xtick.labelsize", "ytick.labelsize", "legend.fontsize"), 8.5),
    "axes.titlesize": 9.5,
    "font.family": "sans-serif",
    "grid.color": GRID,
    "axes.grid.axis": "both",
    "legend.frameon": False,
    "lines.linewidth": 1.5,
    "path.simplify_threshold": 0.3,
}


@contextmanager
def house_style() -> Iterator[None]:
    """Draw in this style inside the block."""
    defaults: Any = matplotlib.rcParamsDefault
    with drawing_style({**defaults, **_STYLE}):
        yield


def drawing_style(settings: Mapping[str, Any]) -> AbstractContextManager[None]:
    """Draw with these settings of Matplotlib inside the block."""
    context: Any = matplotlib.rc_context
    return context(dict(settings))


def new_figure(width: float, height: float) -> Figure:
    """A figure of so many inches, laid out by itself."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def new_page(height: float, title: str, note: str) -> Figure:
    """A figure as wide as a page, with a title above and a note below."""
    figure = new_figure(PAGE_WIDTH, height)
    figure.suptitle(title, fontsize=9, fontweight="bold", x=0.01, ha="left")
    figure.supxlabel(note, fontsize=6.5, x=0.01, ha="left", color=GREY)
    return figure


def plain_decades(axis: Axis, marks: Sequence[float] = (1,)) -> None:
    """Ticks at powers of ten, times ``marks``, written as 0.01 and not as a power; no minor ones.
    Zero is kept if the axis has it.
    """
    if axis.get_scale() == "log":
        axis.set_major_locator(LogLocator(subs=marks))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def handle(label: str, colour: str, marker: str, dashes: str) -> Line2D:
    """What a legend shows of a line."""
    return Line2D([], [], color=colour, marker=marker, ls=dashes, mew=0.8, label=label)


def save(figure: Figure, stem: Path) -> list[Path]:
    """Write ``stem``.png and ``stem``.svg; returns both paths."""
    paths = [stem.with_name(f"{stem.name}.{kind}") for kind in ("png", "svg")]
    figure.savefig(paths[0], metadata={"Software": None})
    # The layout of the first file serves for the second.
    figure.set_layout_engine("none")
    figure.savefig(paths[1], metadata={"Date": None})
    return paths


def spread(positions: Sequence[float], gap: float) -> list[float]:
    """Positions moved up as little as needed to be ``gap`` from each other, in their order: where
    labels can be read.
    """
    placed = list(positions)
    order = sorted(range(len(placed)), key=lambda index: placed[index])
    for before, after in pairwise(order):
        placed[after] = max(placed[after], placed[before] + gap)
    return placed


# ------------------------------------------------------------ figures of pages


@contextmanager
def page_style() -> Iterator[None]:
    """Draw in the style of HTML pages inside the block."""
    with house_style(), drawing_style(_PAGE_STYLE), warnings.catch_warnings():
        # Text is drawn by the browser, with its own fonts.
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        yield


def as_svg(figure: Figure, name: str) -> str:
    """The figure as an element of a page: no prologue, ids of its own, the page's colours."""
    written = io.StringIO()
    figure.savefig(
        written, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type"))
    )
    svg = written.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r' xmlns(:\w+)?="[^"]*"', "", svg)
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    hidden = r'\1 aria-hidden="true" focusable="false"'
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', hidden, svg, count=1)
    svg = re.sub(r'\bid="', f'id="{name}-', svg)
    svg = re.sub(r'href="#', f'href="#{name}-', svg).replace("url(#", f"url(#{name}-")
    svg = re.sub(r"font: ([\d.]+)px [^;\"]*", r"font: \1px var(--sans)", svg)
    svg = re.sub(r"<!--.*?-->\n?", "", svg, flags=re.DOTALL)
    for drawn, variable in _VARIABLES.items():
        svg = svg.replace(drawn, f"var(--{variable})")
    return svg


def plain_label(label: str) -> str:
    """A name that matplotlib takes as it is: no formulas, and no leading underscore, which would
    hide it from the legend.
    """
    text = printable(label).replace("$", r"\$")
    return f"\u200b{text}" if text.startswith("_") else text
