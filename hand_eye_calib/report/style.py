"""How every figure looks: light, readable at the width of a printed page, in colours that the
colour-blind can tell apart.

Figures are made without pyplot: no display, no global state.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

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


# Wanted positions, and indices of the members.
_Group = tuple[list[float], list[int]]


def spread(positions: Sequence[float], gap: float) -> list[float]:
    """Positions moved apart as little as needed to be ``gap`` from each other, in their order:
    where labels can be read.

    Parameters
    ----------
    positions : sequence of float
    gap : float

    Returns
    -------
    list of float
        In the order given.
    """
    order = sorted(range(len(positions)), key=lambda index: positions[index])
    groups: list[_Group] = []
    for index in order:
        groups.append(([positions[index]], [index]))
        while len(groups) > 1 and _start(groups[-2], gap) + gap * len(groups[-2][1]) > _start(
            groups[-1], gap
        ):
            wanted, members = groups.pop()
            groups[-1] = (groups[-1][0] + wanted, groups[-1][1] + members)
    placed = [0.0] * len(positions)
    for group in groups:
        for place, index in enumerate(group[1]):
            placed[index] = _start(group, gap) + gap * place
    return placed


def _start(group: _Group, gap: float) -> float:
    wanted, members = group
    return sum(position - gap * place for place, position in enumerate(wanted)) / len(members)
