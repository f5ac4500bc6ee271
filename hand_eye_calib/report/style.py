"""How every figure looks: light, readable at the width of a printed page, and told apart by the
colour-blind too.

Figures are made without pyplot: no display, no global state.
"""

from contextlib import contextmanager

import matplotlib
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

_STYLE = {
    "font.family": "DejaVu Sans", "font.size": 7.0, "axes.titlesize": 7.5, "axes.titleweight": "bold", "axes.labelsize": 7.0,
    "xtick.labelsize": 6.5, "ytick.labelsize": 6.5, "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.6,
    "axes.edgecolor": GREY, "xtick.color": GREY, "ytick.color": GREY, "xtick.labelcolor": BLACK, "ytick.labelcolor": BLACK,
    "xtick.major.width": 0.6, "ytick.major.width": 0.6, "xtick.minor.size": 1.5, "xtick.minor.width": 0.4, "xtick.major.size": 2.5, "ytick.major.size": 2.5, "axes.grid": True,
    "axes.grid.axis": "y", "grid.color": LIGHT_GREY, "grid.linewidth": 0.5, "axes.axisbelow": True, "lines.linewidth": 1.1,
    "lines.markersize": 3.2, "figure.facecolor": "white", "savefig.facecolor": "white", "savefig.dpi": 200,
    # The same figure gives the same file.
    "svg.hashsalt": "hand_eye_calib", "svg.fonttype": "none",
}  # fmt: skip


@contextmanager
def house_style():
    """Draw in this style inside the block."""
    with matplotlib.rc_context({**matplotlib.rcParamsDefault, **_STYLE}):
        yield


def new_figure(width, height):
    """A figure of so many inches, laid out by itself."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def new_page(height, title, note):
    """A figure as wide as a page, with a title above and a note below."""
    figure = new_figure(PAGE_WIDTH, height)
    figure.suptitle(title, fontsize=9, fontweight="bold", x=0.01, ha="left")
    figure.supxlabel(note, fontsize=6.5, x=0.01, ha="left", color=GREY)
    return figure


def plain_decades(axis, marks=(1,)):
    """Ticks at powers of ten, times ``marks``, written as 0.01 and not as a power; no minor ones.
    Zero is kept where the axis has it.
    """
    if axis.get_scale() == "log":
        axis.set_major_locator(LogLocator(subs=marks))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def handle(label, colour, marker, dashes):
    """What a legend shows of a line."""
    return Line2D([], [], color=colour, marker=marker, ls=dashes, mew=0.8, label=label)


def save(figure, stem):
    """Write ``stem``.png and ``stem``.svg; returns both paths."""
    paths = [stem.with_name(f"{stem.name}.{kind}") for kind in ("png", "svg")]
    figure.savefig(paths[0], metadata={"Software": None})
    figure.savefig(paths[1], metadata={"Date": None})
    return paths


def spread(positions, gap):
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
    groups = []  # [sum of wanted positions less offsets, members]
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


def _start(group, gap):
    wanted, members = group
    return sum(position - gap * place for place, position in enumerate(wanted)) / len(members)
