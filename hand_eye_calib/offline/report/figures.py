"""The figures of the report, and what there is to see in each, in words and numbers; and the plot
of a result: sensors in space from three sides, with the uncertainty of their positions.

The verdict judges, by rules of its own; a caption says how large something is. All figures look
alike: light, in colours that the colour-blind can tell apart. They are made without pyplot: no
display, no global state.
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
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.errors import printable
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.base.text import amount, angle, length, listing, share
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.records import Residuals
from hand_eye_calib.offline.report.evidence import Evidence, StreamView

# ---- how every figure looks

# Colours as drawn on a page, each with the name of the page's own colour that replaces it.
INK = "#1b1f24"
MUTED = "#5c6670"
GRID = "#d9dee3"
PARENT = "#0072b2"
CHILD = "#d98300"
BAD = "#c8452f"
GREEN = "#009e73"
_VARIABLES = {INK: "ink", MUTED: "muted", GRID: "grid", PARENT: "parent", CHILD: "child"}
_VARIABLES |= {BAD: "bad", GREEN: "good"}


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
    vehicles: int = 4


LOOK = Look()

_INK = ("text.color", "axes.labelcolor", "axes.titlecolor", "xtick.labelcolor", "ytick.labelcolor")
_SMALL = ("xtick.labelsize", "ytick.labelsize", "legend.fontsize")
_STYLE: Document = {
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


@dataclass(frozen=True)
class Drawn:
    """A figure of a page: ``name`` of its element, title, caption and SVG."""

    name: str
    title: str
    said: str
    svg: str


def as_drawn(figure: Figure, name: str, title: str, said: str) -> Drawn:
    """The figure as an element of a page: no prologue, ids of its own, the page's colours."""
    written = io.StringIO()
    figure.savefig(
        written, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type"))
    )
    svg = re.sub(r' (width|height)="[^"]*"', "", written.getvalue().partition("<svg")[2], count=2)
    svg = f'<svg aria-hidden="true" focusable="false"{svg}'
    svg = re.sub(r'<!--.*?-->|(?<=\n) +| xmlns(:\w+)?="[^"]*"', "", svg, flags=re.DOTALL)
    svg = re.sub(r'\bid="', f'id="{name}-', re.sub(r'<g id="[^"]*"', "<g", svg))
    svg = svg.replace('xlink:href="#', f'href="#{name}-').replace("url(#", f"url(#{name}-")
    svg = re.sub(r"(font: [\d.]+px|font-family:) [^;\"]*", r"\1 var(--sans)", svg)
    svg = re.sub(r"<[pu][^>]*>", lambda shape: re.sub(r"(\.\d\d)\d+", r"\1", shape[0]), svg)
    for colour, variable in _VARIABLES.items():
        svg = svg.replace(colour.lower(), f"var(--{variable})")
    return Drawn(name, title, said, svg)


def plain_label(label: str) -> str:
    """A name that matplotlib takes as it is: no formulas, and no leading underscore, which would
    hide it from the legend.
    """
    text = printable(label).replace("$", r"\$")
    return f"\u200b{text}" if text.startswith("_") else text


# ---- figures

# From m and rad to the units of the figures.
UNITS = {"x": (100.0, "translation (cm)"), "yaw": (180 / np.pi, "rotation (deg)")}

_WHAT_COINCIDES = {
    "angular rate": "Two sensors on one rigid body have the same angular rate at every moment, "
    "however they are mounted: the two curves must coincide, up to the bias of a gyroscope.",
    "speed": "Two points of one rigid body have the same speed while it does not rotate: the two "
    "curves must rise and fall together.",
}


def figures_of(calibration: Calibration, evidence: Evidence | None) -> list[Drawn]:
    """The figures that a result of its kind has; stops have no evidence of streams."""
    drawn = []
    if calibration.measured != "rotations":
        drawn.append(figure_of_views([calibration]))
        if evidence:
            drawn.append(_trajectories(calibration, evidence))
    if calibration.motion_residuals:
        drawn.append(_residuals(calibration, calibration.motion_residuals))
    if evidence:
        names = (calibration.parent_frame, calibration.child_frame)
        drawn.append(figure_of_streams(evidence.streams, names))
    return drawn


@page_style()
def figure_of_views(calibrations: Sequence[Calibration]) -> Drawn:
    """Where the child sensors of one or several results are in their parent's frame."""
    figure, panels = _figure(3.1, 1, 3, gap=0.36)
    draw_views(panels, *calibrations)
    return as_drawn(figure, "views", "The sensors in space", said_of_views(*calibrations))


@page_style()
def figure_of_streams(seen: StreamView, names: tuple[str, str]) -> Drawn:
    """Rates of both streams over time before any solve, and when there are poses; ``names`` are of
    the parent and the child.
    """
    is_speed = seen.quantity == "speed"
    factor, unit = _time_axis(max(times[-1] if len(times) else 0.0 for times, _ in seen.rates))
    figure, (rate, strip) = _figure(3.0, 2, 1, sharex=True, height_ratios=(5, 1))
    looks = ((PARENT, 2.6), (CHILD, 1.0))
    streams = zip(seen.rates, seen.spans_s, names, looks, strict=True)
    for row, ((times, rates), spans, name, (colour, width)) in enumerate(streams):
        values = rates if is_speed else np.degrees(rates)
        rate.plot(times * factor, values, color=colour, lw=width, label=plain_label(name))
        bars = [(start * factor, (end - start) * factor) for start, end in spans]
        strip.broken_barh(bars, (0.6 - row, 0.8), color=colour, lw=0)
    rate.set(ylabel="speed (m/s)" if is_speed else "angular rate (deg/s)", ylim=(0, None))
    rate.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, borderaxespad=0)
    strip.set(ylim=(-0.6, 1.6), xlabel=f"time ({unit})")
    strip.set_yticks([1.0, 0.0], ["parent", "child"])
    strip.tick_params(axis="y", length=0)
    strip.grid(visible=False)
    differ = "Here the streams never overlap."
    if np.isfinite(seen.apart):
        apart = length(seen.apart) if is_speed else angle(seen.apart)
        differ = f"Here they differ by less than {apart}/s half of the time."
    said = (
        f"{_WHAT_COINCIDES[seen.quantity]} {differ} The bars below the curves show when there is "
        "data."
    )
    return as_drawn(figure, "streams", "Both streams before any solve", said)


def _figure(
    height: float, rows: int, columns: int, bottom: float = 0.5, gap: float = 0.2, **options: Any
) -> tuple[Figure, Sequence[Axes]]:
    """A figure with its panels, with ``bottom`` inches below them: to measure the text instead
    takes more time than all else.
    """
    figure = Figure(figsize=(LOOK.width, height))
    spacing = {"left": 0.085, "right": 0.985, "wspace": gap, "hspace": 0.12}
    spacing |= {"bottom": bottom / height, "top": 1 - 0.3 / height}
    panels = figure.subplots(rows, columns, gridspec_kw=spacing, squeeze=False, **options)
    return figure, panels.ravel()


@page_style()
def _trajectories(calibration: Calibration, evidence: Evidence) -> Drawn:
    shown = _downsample(len(evidence.times_s))
    factor, unit = _time_axis(evidence.times_s[-1])
    # A camera moves in its x and z: x and y would be a view from the side.
    across = int(np.argmin(np.ptp(evidence.parent, axis=0)))
    first, second = (axis for axis in range(3) if axis != across)
    figure, (plane, side) = _figure(4.1, 1, 2, bottom=0.85)
    names = [calibration.parent_frame, calibration.child_frame]
    is_reversed = calibration.measured == "positions" and not evidence.has_positions_of_parent
    through = 0 if is_reversed else 1  # whose path is computed through the result
    labels = [name + ", through the result" * (n == through) for n, name in enumerate(names)]
    paths = ((evidence.parent, PARENT, 3.2), (evidence.child, CHILD, 1.1))
    for (points, colour, width), label in zip(paths, labels, strict=True):
        in_plane = points[shown, first], points[shown, second]
        plane.plot(*in_plane, label=plain_label(label), color=colour, lw=width)
        side.plot(evidence.times_s[shown] * factor, points[shown, across], color=colour, lw=width)
    plane.plot(*evidence.parent[0, [first, second]], "o", color=INK, ms=6, label="start")
    axes = [f"{axis} (m)" for axis in "xyz"]
    is_level = across == 2
    plane.set(title="From above" if is_level else "In the plane of motion")
    plane.set(xlabel=axes[first], ylabel=axes[second], aspect="equal", adjustable="datalim")
    side.set(title="Height" if is_level else "Across the plane of motion")
    side.set(xlabel=f"time ({unit})", ylabel=axes[across])
    low, high = side.get_ylim()
    if high - low < 0.5:  # rounding is no relief
        side.set_ylim((low + high) / 2 - 0.25, (low + high) / 2 + 0.25)
    figure.legend(loc="lower center", ncols=3, borderaxespad=0)
    apart = np.linalg.norm(evidence.parent - evidence.child, axis=1)
    furthest_s = evidence.times_s[int(np.argmax(apart))]
    path_m = float(np.linalg.norm(np.diff(evidence.parent, axis=0), axis=1).sum())
    said = (
        f"The path of {names[1 - through]}, {length(path_m)} long, and the same path "
        f"computed from the poses of {names[through]} and the result. Half of the time "
        f"they are within {length(float(np.median(apart)))} of each other, and at most "
        f"{length(apart.max())} apart, at {furthest_s * factor:.1f} {unit}. "
        "That includes drift and jumps of the odometry."
    )
    return as_drawn(figure, "trajectories", "Both trajectories, aligned", said)


@page_style()
def _residuals(calibration: Calibration, residuals: Residuals) -> Drawn:
    # Of translations under "x", of rotations under "yaw": those that streams of this kind have.
    sizes = {"x": residuals.translation_m, "yaw": residuals.rotation_rad}
    sizes.pop({"rotations": "x", "positions": "yaw"}.get(calibration.measured, ""), None)
    is_out = ~residuals.is_inlier
    if calibration.reference == "stops":
        what = "stops"
        times = np.arange(1.0, len(residuals) + 1)
        unit = ""
        label = "stop"
    else:
        first_ns = residuals.start_ns.min(initial=residuals.end_ns[0])
        times = (residuals.end_ns - first_ns) * 1e-9
        factor, unit = _time_axis(float(times.max()))
        times = times * factor
        label = f"time ({unit})"
        is_of_positions = calibration.measured == "positions"
        what = "distances from one position to the next" if is_of_positions else "motion pairs"
    figure, panels = _figure(1.2 + 1.6 * len(sizes), len(sizes), 1, bottom=0.8, sharex=True)
    for panel, (name, values) in zip(panels, sizes.items(), strict=True):
        to_unit, of_axis = UNITS[name]
        _draw_residuals(panel, times, np.maximum(values * to_unit, 1e-5), is_out)
        panel.set_ylabel(of_axis)
    panels[-1].set_xlabel(label)
    handles = panels[0].get_legend_handles_labels()
    figure.legend(*handles, loc="lower center", ncols=3, borderaxespad=0)
    halves, furthest = (
        listing([amount(name, float(of(values))) for name, values in sizes.items()])
        for of in (np.median, np.max)
    )
    rejected = f"{is_out.sum():,} ({share(float(is_out.mean()))})" if is_out.any() else "None"
    said = (
        f"Half of the {len(residuals):,} {what} agree with the result to {halves}, all of them to "
        f"{furthest}. {rejected} of them are rejected as outliers."
    )
    return as_drawn(figure, "residuals", "Residuals", said)


def _draw_residuals(panel: Axes, times: FloatArray, values: FloatArray, is_out: BoolArray) -> None:
    """Sizes (K,) of residuals, above zero, and which were rejected."""
    dots = np.flatnonzero(~is_out)
    crosses = np.flatnonzero(is_out)
    dots = dots[_downsample(len(dots))]
    crosses = crosses[np.argsort(-values[crosses])[: LOOK.points]]
    used = (times[dots], values[dots], "o")
    rejected = (times[crosses], values[crosses], "x")
    panel.plot(*used, color=PARENT, ms=2.6, mew=0, alpha=0.65, label="used")
    panel.plot(*rejected, color=BAD, ms=5.5, mew=1.5, label="rejected as outlier")
    panel.axhline(np.median(values), color=INK, lw=1.0, ls="--", label="median of all")
    panel.yaxis.set_label_coords(-0.06, 0.5)
    if values.max() > 15 * np.median(values):  # the largest would hide the others
        panel.set_yscale("log")
        panel.yaxis.set_major_formatter("{x:g}")
        panel.minorticks_off()
    else:
        panel.set_ylim(0, 1.08 * values.max())


def _time_axis(duration_s: float) -> tuple[float, str]:
    """Factor and name of the unit in which the time of a recording is shown."""
    return (1.0, "s") if duration_s < 300 else (1 / 60, "min")


def _downsample(count: int) -> IntArray:
    """Indices of those of so many points that are drawn, first and last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, LOOK.points)).round().astype(int))


# ---- sensors in space

# The three views: which axes of the parent go across and up, and what that is on a vehicle.
_VIEWS = {"xy": "from above", "xz": "from the side", "yz": "from the front"}


class ShownFigure(Figure):
    """A figure that notebooks show without pyplot."""

    def _repr_png_(self) -> bytes:
        written = io.BytesIO()
        self.savefig(written, format="png", dpi=130)
        return written.getvalue()


def plot(calibration: Calibration, ax: Any = None) -> Figure:
    """Draw where both sensors are and how they are turned, in three views of the parent sensor's
    frame, with three standard deviations of the child's position.

    Parameters
    ----------
    calibration : Calibration
    ax : sequence of three matplotlib.axes.Axes, optional
        To draw into. Default: a figure of its own.

    Returns
    -------
    matplotlib.figure.Figure
        The figure of ``ax``, or a new one. Notebooks show it; ``savefig`` writes it to a file.

    Examples
    --------
    >>> hec.plot(result).savefig("result.png")
    """
    if ax is not None:
        draw_views(ax, calibration)
        return ax[0].figure
    with page_style(figure_facecolor="white", savefig_facecolor="white"):
        figure = ShownFigure(figsize=(LOOK.width, 3.3), layout="constrained")
        FigureCanvasAgg(figure)
        draw_views(figure.subplots(1, 3), calibration)
        figure.suptitle(calibration.headline, fontsize=8, fontweight="bold", wrap=True)
        figure.supxlabel(said_of_views(calibration), fontsize=7.5, wrap=True)
    return figure


def said_of_views(*calibrations: Calibration) -> str:
    """What the three views show, in words."""
    sigmas = np.array([each.sigmas[:3] for each in calibrations])
    known = np.isfinite(sigmas)
    text = "Axes of all sensors: x red, y green, z blue."
    if known.any():
        text += f" Ellipse: {LOOK.sigmas:g} standard deviations of the position."
    if not known.all():
        unknown = [axis for axis, each in zip("xyz", known.T, strict=True) if not each.all()]
        text += f" Unknown along {listing(unknown)}: the dashed line."
    return text


def draw_views(panels: Sequence[Axes], *calibrations: Calibration) -> None:
    """Draw three views into three panels: of the parent sensor, and of the child sensors of one or
    several results in its frame.
    """
    distances = [float(np.linalg.norm(each.translation)) for each in calibrations]
    axis_m = LOOK.axis * max(*distances, LOOK.least_m)
    for panel, (axes, title) in zip(panels, _VIEWS.items(), strict=True):
        seen = ["xyz".index(axis) for axis in axes]
        _draw_sensor(panel, np.eye(4)[seen], calibrations[0].parent_frame, PARENT, axis_m, 6)
        for calibration in calibrations:
            T = calibration.T_parent_child
            at = T[seen, 3]
            panel.plot(*at[:, None] * [[0.0, 1.0]], color=MUTED, lw=0.8, ls=":", zorder=1)
            _draw_sensor(panel, T[seen], calibration.child_frame, CHILD, axis_m, -14)
            is_known = np.isfinite(calibration.sigmas[seen])
            if is_known.all():
                R = T[seen, :3]
                covariance = calibration.covariance[:3, :3]
                values, vectors = np.linalg.eigh(R @ covariance @ R.T)
                wide, high = 2 * LOOK.sigmas * np.sqrt(np.maximum(values, 0.0))
                turned = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
                ellipse = Ellipse((at[0], at[1]), wide, high, angle=turned, color=CHILD, alpha=0.3)
                panel.add_patch(ellipse)
            # A line along the axis that is unknown, through what is known of the other.
            if not is_known[0]:
                panel.axhline(at[1], color=CHILD, ls="--", lw=1.0)
            if not is_known[1]:
                panel.axvline(at[0], color=CHILD, ls="--", lw=1.0)
        panel.set(xlabel=f"{axes[0]} (m)", ylabel=f"{axes[1]} (m)", title=title)
        panel.set_aspect("equal", adjustable="datalim")
        panel.margins(0.3)


def _draw_sensor(
    panel: Axes, seen: FloatArray, name: str, colour: str, axis_m: float, below: float
) -> None:
    """A sensor's axes at its origin, and its name; ``seen`` are two rows of its transform."""
    at = seen[:, 3]
    for axis, of_axis in zip(seen[:, :3].T, (BAD, GREEN, PARENT), strict=True):
        panel.plot(*np.stack([at, at + axis_m * axis], axis=1), color=of_axis)
    panel.plot(*at, "o", color=colour, ms=5)
    panel.annotate(plain_label(name), (*at,), (5, below), textcoords="offset points", color=INK)
