"""How every figure looks: light, in colours that the colour-blind can tell apart.

Figures are made without pyplot: no display, no global state.
"""

import io
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import matplotlib
from matplotlib.figure import Figure

from hand_eye_calib.errors import printable

# Colours as drawn on a page, each with the name of the page's own colour that replaces it.
INK, MUTED, GRID = "#1b1f24", "#5c6670", "#d9dee3"
PARENT, CHILD, BAD, GREEN = "#0072b2", "#d98300", "#c8452f", "#009e73"
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
    """Sizes of pages and their figures.

    width : of a figure, inches; a page shows them at about 96 pixels an inch.
    sigmas : standard deviations that an ellipse or a band reaches to.
    axis : length of a sensor's axes in shares of the distance between the sensors, of which
        least_m is the least, m.
    distance_m : of the object whose error is told, m.
    bar_decades, bar_above : powers of ten that a bar reaches over, and over its target.
    points : most points drawn of a line, and of dots that each stand alone.
    vehicles : most vehicles on the page of a batch.
    """

    width: float = 8.6
    sigmas: float = 3.0
    axis: float = 0.22
    least_m: float = 0.05
    distance_m: float = 10.0
    bar_decades: float = 4.0
    bar_above: float = 1.0
    points: int = 1000
    vehicles: int = 10


LOOK = Look()

_INK = ("text.color", "axes.labelcolor", "axes.titlecolor", "xtick.labelcolor", "ytick.labelcolor")
_SMALL = ("xtick.labelsize", "ytick.labelsize", "legend.fontsize")
_STYLE: dict[str, Any] = {
    **dict.fromkeys(_INK, INK),
    **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), MUTED),
    **dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), "none"),
    **dict.fromkeys(("font.size", "axes.labelsize"), 9.0),
    **dict.fromkeys(_SMALL, 8.5),
    **dict.fromkeys(("axes.spines.top", "axes.spines.right"), False),
    **dict.fromkeys(("axes.linewidth", "xtick.major.width", "ytick.major.width"), 0.6),
    **dict.fromkeys(("xtick.major.size", "ytick.major.size"), 2.5),
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.grid": True,
    "grid.color": GRID,
    "grid.linewidth": 0.5,
    "legend.frameon": False,
    "lines.linewidth": 1.5,
    "path.simplify_threshold": 0.3,
    # The same figure gives the same file.
    "svg.hashsalt": "hand_eye_calib",
    "svg.fonttype": "none",
}


@contextmanager
def page_style(**more: Any) -> Iterator[None]:
    """Draw in the style of HTML pages inside the block; ``more`` are settings of Matplotlib with _
    for the dots in their names.
    """
    changed = {name.replace("_", "."): value for name, value in more.items()}
    defaults: Any = matplotlib.rcParamsDefault
    context: Any = matplotlib.rc_context
    with context({**defaults, **_STYLE, **changed}), warnings.catch_warnings():
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
        svg = svg.replace(drawn.lower(), f"var(--{variable})")
    return svg


def plain_label(label: str) -> str:
    """A name that matplotlib takes as it is: no formulas, and no leading underscore, which would
    hide it from the legend.
    """
    text = printable(label).replace("$", r"\$")
    return f"\u200b{text}" if text.startswith("_") else text
