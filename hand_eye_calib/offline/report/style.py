"""The look of all figures: colours, sizes and fonts, and their conversion to elements of a page.

All figures have light backgrounds, and colours that colour-blind people can distinguish. They are
made without pyplot, so they need no display and no global state.
"""

import io
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import printable
from hand_eye_calib.core.base.plain import Document

# Colours of the figures. In a page, variables of the style sheet replace them, so that a dark page
# has lighter colours.
INK = "#1b1f24"
MUTED = "#5c6670"
GRID = "#d9dee3"
PARENT = "#0072b2"
CHILD = "#d98300"
BAD = "#c8452f"
GREEN = "#009e73"
_VARIABLES = {
    INK: "ink",
    MUTED: "muted",
    GRID: "grid",
    PARENT: "parent",
    CHILD: "child",
    BAD: "bad",
    GREEN: "good",
}


class Look(NamedTuple):
    """Sizes and limits of pages and figures.

    Attributes
    ----------
    width : float
        Width of a figure (inches). A page has about 96 pixels an inch.
    sigmas : float
        Half width of an ellipse or a band, in standard deviations.
    axis_share : float
        Length of a sensor's axes as a share of the distance between the sensors.
    min_distance_m : float
        Smallest distance (m) from which the length of the axes is computed. For nearer sensors the
        axes have the same length.
    object_m : float
        Distance (m) of the object whose position error is stated.
    near_object_m : float
        The same distance for the camera of an arm (m).
    bar_decades : float
        Length of the logarithmic scale of a bar, in powers of ten.
    decades_above : float
        Part of this scale above the target, in powers of ten.
    min_in_view : float
        An unknown direction is drawn only if the length of its unit vector in a view exceeds this.
        Otherwise it is nearly perpendicular to the view.
    max_points : int
        Largest number of points of a line, and of single dots.
    max_coordinate_points : int
        Largest number of points of a line of one coordinate over time.
    min_turn_s : float
        Shortest duration (s) of the part of a path that is drawn enlarged.
    max_dots : int
        Largest number of dots along an enlarged line.
    max_vehicles : int
        Largest number of vehicles on the page of a batch.
    """

    width: float = 8.6
    sigmas: float = 3.0
    axis_share: float = 0.22
    min_distance_m: float = 0.05
    object_m: float = 10.0
    near_object_m: float = 0.5
    bar_decades: float = 4.0
    decades_above: float = 1.0
    min_in_view: float = 0.1
    max_points: int = 1000
    max_coordinate_points: int = 400
    min_turn_s: float = 10.0
    max_dots: int = 60
    max_vehicles: int = 4


LOOK = Look()

# Settings of Matplotlib that differ from its defaults.
_STYLE: Document = {
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "font.size": 9.0,
    "axes.labelsize": 9.0,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.fontsize": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.grid": True,
    "grid.color": GRID,
    "grid.linewidth": 0.5,
    "legend.frameon": False,
    "lines.linewidth": 1.5,
    "path.simplify_threshold": 0.3,
    # A fixed salt, so that equal figures have equal files.
    "svg.hashsalt": "hand_eye_calib",
    "svg.fonttype": "none",
}


@contextmanager
def page_style(**more: Any) -> Iterator[None]:
    """Draw in the style of HTML pages inside the block.

    The user's own settings of Matplotlib have no effect. ``more`` has further settings, whose names
    have underscores instead of dots.
    """
    changed = {name.replace("_", "."): value for name, value in more.items()}
    defaults: Any = matplotlib.rcParamsDefault
    context: Any = matplotlib.rc_context
    with context({**defaults, **_STYLE, **changed}), warnings.catch_warnings():
        # Matplotlib's font may lack a character. The browser draws it with its own fonts.
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        yield


@dataclass(frozen=True)
class Drawn:
    """Figure of a page.

    Attributes
    ----------
    name : str
        Name of the HTML element.
    title, caption : str
    svg : str
        Empty if there is only a caption.
    key : tuple of (str, str)
        Colours as variables of the style sheet, with their names. The page puts them above the
        figure, where they are visible on a narrow screen.
    """

    name: str
    title: str
    caption: str
    svg: str
    key: tuple[tuple[str, str], ...] = ()


def as_drawn(
    figure: Figure,
    name: str,
    title: str,
    caption: str,
    lines: Sequence[Any] = (),
) -> Drawn:
    """Return a figure as SVG that fits into a page.

    The page scales the SVG and sets its colours. All ids begin with the name of the figure, so that
    two figures never share an id. ``lines`` are lines of Matplotlib; their colours and labels
    become the key of the figure.
    """
    buffer = io.StringIO()
    no_metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    figure.savefig(buffer, format="svg", metadata=no_metadata)
    # Remove the XML prologue and the fixed size.
    _, _, svg = buffer.getvalue().partition("<svg")
    svg = re.sub(r' (width|height)="[^"]*"', "", svg, count=2)
    svg = f'<svg aria-hidden="true" focusable="false"{svg}'
    # Remove comments, indentation and name spaces.
    svg = re.sub(
        r'<!--.*?-->|(?<=\n) +| xmlns(:\w+)?="[^"]*"', "", svg, flags=re.DOTALL
    )
    # Remove the ids of groups, to which nothing refers. Prefix other ids with the figure's name.
    svg = re.sub(r'<g id="[^"]*"', "<g", svg)
    svg = re.sub(r'\bid="', f'id="{name}-', svg)
    svg = svg.replace('xlink:href="#', f'href="#{name}-')
    svg = svg.replace("url(#", f"url(#{name}-")
    svg = re.sub(
        r"(font: [\d.]+px|font-family:) [^;\"]*", r"\1 var(--sans)", svg
    )
    # Two decimals are sufficient for the coordinates of the elements path and use.
    svg = re.sub(
        r"<[pu][^>]*>",
        lambda shape: re.sub(r"(\.\d\d)\d+", r"\1", shape[0]),
        svg,
    )
    for colour, variable in _VARIABLES.items():
        svg = svg.replace(colour.lower(), f"var(--{variable})")
    key = [(_VARIABLES[line.get_color()], _name_of(line)) for line in lines]
    return Drawn(name, title, caption, svg, tuple(key))


def _name_of(line: Any) -> str:
    """Return the name that :func:`plain_label` has made the label of a line."""
    return str(line.get_label()).replace(r"\$", "$").removeprefix("\u200b")


# Shortest time on an axis of recordings (days): an hour.
_SHORTEST_AXIS_DAYS = 1.0 / 24.0


def recordings_axis(
    panels: Sequence[Axes], stamps_ns: Sequence[int], name: str
) -> FloatArray:
    """Return the places (N,) of recordings on the shared x axis of panels, and label this axis.

    The axis is the time from the first to the last start. If all starts are within a minute, it has
    the number of each recording.

    Parameters
    ----------
    panels : sequence of Axes
    stamps_ns : sequence of int
        Start of each recording (ns), in order of time.
    name : str
        What is counted, such as "recording".
    """
    days = date2num(np.array(stamps_ns, dtype="datetime64[ns]"))
    first = float(days.min(initial=np.inf))
    last = float(days.max(initial=-np.inf))
    # Starts within a minute would be drawn at the same place.
    if len(days) > 1 and last - first < _SHORTEST_AXIS_DAYS / 60:
        panels[0].xaxis.set_major_locator(MaxNLocator(4, integer=True))
        panels[-1].set_xlabel(f"number of the {name}")
        return np.arange(1.0, len(days) + 1.0)
    locator = AutoDateLocator(minticks=2, maxticks=4)
    panels[0].xaxis.set_major_locator(locator)
    panels[0].xaxis.set_major_formatter(ConciseDateFormatter(locator))
    if len(days):
        # The margin at either end is 5 % of the time.
        half = max(0.55 * (last - first), 0.5 * _SHORTEST_AXIS_DAYS)
        centre = 0.5 * (first + last)
        panels[0].set_xlim(centre - half, centre + half)
    return np.asarray(days, dtype=float)


def plain_label(label: str) -> str:
    """Return a name that Matplotlib draws as it is.

    A dollar sign would begin a formula. A leading underscore would remove the name from the legend,
    so a zero-width space is inserted before it.
    """
    text = printable(label).replace("$", r"\$")
    return f"\u200b{text}" if text.startswith("_") else text


def make_panels(
    height: float,
    rows: int,
    columns: int,
    bottom: float = 0.5,
    gap: float = 0.2,
    **options: Any,
) -> tuple[Figure, Sequence[Axes]]:
    """Make a figure with rows and columns of panels, and return the figure and its panels.

    Margins are fixed: measuring the text would take more time than all other steps.

    Parameters
    ----------
    height : float
        Height of the figure (inches).
    rows, columns : int
    bottom : float
        Space below the panels (inches), for labels and a legend.
    gap : float
        Space between columns, as a share of the width of a panel.
    **options
        Arguments of ``Figure.subplots``.
    """
    figure = Figure(figsize=(LOOK.width, height))
    spacing = {"left": 0.085, "right": 0.985, "wspace": gap, "hspace": 0.12}
    spacing |= {"bottom": bottom / height, "top": 1 - 0.3 / height}
    panels = figure.subplots(
        rows, columns, gridspec_kw=spacing, squeeze=False, **options
    )
    return figure, panels.ravel()
