"""Draw the figures of the report, and the plot of a result.

Each figure has a caption in words and numbers. The plot draws the sensors in space from three
sides, with the uncertainty of their positions.

The verdict has its own rules; a caption only states sizes. All figures have one look: light, in
colours that the colour-blind can distinguish. They are made without pyplot, so there is neither a
display nor global state.
"""

import io
import math
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
from hand_eye_calib.core.base.errors import InputError, printable, require_type
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.base.text import amount, angle, length, listing, share
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.records import Residuals
from hand_eye_calib.offline.report.evidence import Evidence, StreamView, spread_of_position

# ---- how every figure looks

# Drawn colours. On a page, the page's own colours of these names replace them.
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
    """Sizes of pages and their figures.

    Attributes
    ----------
    width : float
        Of a figure, inches. A page has about 96 pixels an inch.
    sigmas : float
        Standard deviations that an ellipse or a band covers.
    axis : float
        Length of a sensor's axes as a share of the distance between the sensors.
    least_m : float
        Smallest distance that counts for the length of axes, m.
    distance_m : float
        Distance of the object whose error is stated, m.
    near_m : float
        The same for the camera of an arm, m.
    bar_decades : float
        Powers of ten that a bar covers.
    bar_above : float
        Powers of ten of a bar above its target.
    end_on : float
        Share of an unknown direction in a view below which its line is not drawn.
    points : int
        Most points of a line, and most single dots.
    coordinate_points : int
        Most points of a line of one coordinate over time.
    vehicles : int
        Most vehicles on the page of a batch.
    """

    width: float = 8.6
    sigmas: float = 3.0
    axis: float = 0.22
    least_m: float = 0.05
    distance_m: float = 10.0
    near_m: float = 0.5
    bar_decades: float = 4.0
    bar_above: float = 1.0
    end_on: float = 0.1
    points: int = 1000
    coordinate_points: int = 400
    vehicles: int = 4


LOOK = Look()

# The settings of Matplotlib that replace its defaults.
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
    # Equal figures give equal files.
    "svg.hashsalt": "hand_eye_calib",
    "svg.fonttype": "none",
}


@contextmanager
def page_style(**more: Any) -> Iterator[None]:
    """Draw in the style of HTML pages inside the block.

    ``more`` are settings of Matplotlib, with _ for the dots in their names.
    """
    changed = {name.replace("_", "."): value for name, value in more.items()}
    defaults: Any = matplotlib.rcParamsDefault
    context: Any = matplotlib.rc_context
    with context({**defaults, **_STYLE, **changed}), warnings.catch_warnings():
        # The browser draws the text with its own fonts.
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        yield


@dataclass(frozen=True)
class Drawn:
    """A figure of a page: the name of its element, title, caption and SVG."""

    name: str
    title: str
    caption: str
    svg: str


def as_drawn(figure: Figure, name: str, title: str, caption: str) -> Drawn:
    """Return a figure as an element of a page, with its own ids and the page's colours."""
    buffer = io.StringIO()
    no_metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    figure.savefig(buffer, format="svg", metadata=no_metadata)
    _, _, svg = buffer.getvalue().partition("<svg")  # without prologue
    svg = re.sub(r' (width|height)="[^"]*"', "", svg, count=2)
    svg = f'<svg aria-hidden="true" focusable="false"{svg}'
    # Comments, indentation and name spaces.
    svg = re.sub(r'<!--.*?-->|(?<=\n) +| xmlns(:\w+)?="[^"]*"', "", svg, flags=re.DOTALL)
    # Ids of groups, which nothing refers to; the other ids get the name of the figure.
    svg = re.sub(r'<g id="[^"]*"', "<g", svg)
    svg = re.sub(r'\bid="', f'id="{name}-', svg)
    svg = svg.replace('xlink:href="#', f'href="#{name}-')
    svg = svg.replace("url(#", f"url(#{name}-")
    svg = re.sub(r"(font: [\d.]+px|font-family:) [^;\"]*", r"\1 var(--sans)", svg)
    # Two decimals of paths and uses are enough.
    svg = re.sub(r"<[pu][^>]*>", lambda shape: re.sub(r"(\.\d\d)\d+", r"\1", shape[0]), svg)
    for colour, variable in _VARIABLES.items():
        svg = svg.replace(colour.lower(), f"var(--{variable})")
    return Drawn(name, title, caption, svg)


def plain_label(label: str) -> str:
    """Return a name that Matplotlib draws as it is, without formulas.

    A zero-width space precedes a leading underscore, which would hide the name from the legend.
    """
    text = printable(label).replace("$", r"\$")
    return f"\u200b{text}" if text.startswith("_") else text


# ---- figures

# Factor from m and rad to the unit of the figures, and its name.
UNITS = {"x": (100.0, "translation (cm)"), "yaw": (180 / np.pi, "rotation (deg)")}

_WHAT_COINCIDES = {
    "angular rate": "Two sensors on one rigid body have the same angular rate at every moment, "
    "however they are mounted: the two curves must coincide, up to the bias of a gyroscope.",
    "speed": "Two points of one rigid body have the same speed while it does not rotate: the two "
    "curves must rise and fall together.",
}


def figures_of(calibration: Calibration, evidence: Evidence | None) -> list[Drawn]:
    """Draw all figures of a result; stops have no evidence of streams."""
    figures = []
    if calibration.measured != "rotations":
        figures.append(figure_of_views([calibration]))
        if evidence:
            figures.append(_trajectories(calibration, evidence))
        if "stops" in calibration.parts:
            figures.append(_figure_of_stops(calibration))
    if evidence and evidence.angles is not None:
        figures.append(_coordinates(calibration, evidence))
    if calibration.motion_residuals:
        figures.append(_residuals(calibration, calibration.motion_residuals))
    if evidence:
        names = (calibration.parent_frame, calibration.child_frame)
        figures.append(figure_of_streams(evidence.streams, names))
    return figures


@page_style()
def figure_of_views(calibrations: Sequence[Calibration]) -> Drawn:
    """Draw the child sensors of one or several results in their parent's frame."""
    figure, panels = _figure(3.1, 1, 3, gap=0.36)
    draw_views(panels, *calibrations)
    return as_drawn(figure, "views", "The sensors in space", caption_of_views(*calibrations))


@page_style()
def _figure_of_stops(calibration: Calibration) -> Drawn:
    """Draw the places and viewing directions of the child at all stops, in its world."""
    rows = calibration.parts["stops"].rows
    positions = np.array([row.position_m for row in rows])
    directions = np.array([row.direction for row in rows])
    is_used = np.array([row.is_used for row in rows])
    # A line of the viewing direction is a quarter of the usual distance.
    line_m = 0.25 * float(np.median(np.linalg.norm(positions, axis=1)))
    child = calibration.child_frame
    world = calibration.parts["worlds"].child_world_frame
    figure, panels = _figure(3.6, 1, 3, bottom=0.85, gap=0.36)
    for panel, axes in zip(panels, _VIEWS, strict=True):
        shown = ["xyz".index(axis) for axis in axes]
        ends = positions + line_m * directions
        lines = np.stack([positions, ends], axis=1)[:, :, shown]
        panel.plot(*lines.T, color=MUTED, lw=0.7)
        points = positions[:, shown]
        panel.plot(*points[is_used].T, "o", color=CHILD, ms=3.5, label=plain_label(child))
        if not is_used.all():
            panel.plot(*points[~is_used].T, "x", color=BAD, ms=5.5, label="left out")
        panel.plot(0.0, 0.0, "s", color=PARENT, ms=6, label=plain_label(world))
        panel.set(xlabel=f"{axes[0]} (m)", ylabel=f"{axes[1]} (m)")
        panel.set_aspect("equal", adjustable="datalim")
    handles = panels[0].get_legend_handles_labels()
    figure.legend(*handles, loc="lower center", ncols=3, borderaxespad=0)
    caption = (
        f"Places of {child} at the {len(rows)} stops in the axes of {world}; a line is the viewing "
        f"direction (z of {child}). Good stops view {world} from several sides."
    )
    return as_drawn(figure, "stops", "The stops", caption)


@page_style()
def figure_of_streams(view: StreamView, names: tuple[str, str]) -> Drawn:
    """Draw the rates of both streams over time before any solve, and the times that have poses.

    ``names`` are those of the parent and the child.
    """
    is_speed = view.quantity == "speed"
    ends_s = [times_s[-1] for times_s, _ in view.rates if len(times_s)]
    factor, unit = _time_axis(max(ends_s, default=0.0))
    figure, (curves, strip) = _figure(3.0, 2, 1, sharex=True, height_ratios=(5, 1))
    looks = ((PARENT, 2.6), (CHILD, 1.0))
    streams = zip(view.rates, view.spans_s, names, looks, strict=True)
    for row, ((times_s, rates), spans_s, name, (colour, width)) in enumerate(streams):
        values = rates if is_speed else np.degrees(rates)
        curves.plot(times_s * factor, values, color=colour, lw=width, label=plain_label(name))
        bars = [(start_s * factor, (end_s - start_s) * factor) for start_s, end_s in spans_s]
        strip.broken_barh(bars, (0.6 - row, 0.8), color=colour, lw=0)
    curves.set(ylabel="speed (m/s)" if is_speed else "angular rate (deg/s)", ylim=(0, None))
    curves.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, borderaxespad=0)
    strip.set(ylim=(-0.6, 1.6), xlabel=f"time ({unit})")
    strip.set_yticks([1.0, 0.0], ["parent", "child"])
    strip.tick_params(axis="y", length=0)
    strip.grid(visible=False)
    comparison = "Here the streams never overlap."
    if np.isfinite(view.apart):
        apart = length(view.apart) if is_speed else angle(view.apart)
        comparison = f"Here they differ by less than {apart}/s half of the time."
    caption = (
        f"{_WHAT_COINCIDES[view.quantity]} {comparison} The bars below the curves show when there "
        "is data."
    )
    return as_drawn(figure, "streams", "Both streams before any solve", caption)


def _figure(
    height: float, rows: int, columns: int, bottom: float = 0.5, gap: float = 0.2, **options: Any
) -> tuple[Figure, Sequence[Axes]]:
    """Make a figure with panels, and ``bottom`` inches below them.

    Measuring the text instead would take more time than all other steps.
    """
    figure = Figure(figsize=(LOOK.width, height))
    spacing = {"left": 0.085, "right": 0.985, "wspace": gap, "hspace": 0.12}
    spacing |= {"bottom": bottom / height, "top": 1 - 0.3 / height}
    panels = figure.subplots(rows, columns, gridspec_kw=spacing, squeeze=False, **options)
    return figure, panels.ravel()


@page_style()
def _trajectories(calibration: Calibration, evidence: Evidence) -> Drawn:
    """Draw both paths of one sensor in the plane of motion, and across it over time."""
    rows = _downsample(len(evidence.times_s))
    factor, unit = _time_axis(evidence.times_s[-1])
    # A camera moves along its x and z axes; x and y would be a view from the side.
    across = int(np.argmin(np.ptp(evidence.parent, axis=0)))
    first, second = (axis for axis in range(3) if axis != across)
    figure, (plane, side) = _figure(4.1, 1, 2, bottom=0.85)
    parent = calibration.parent_frame
    child = calibration.child_frame
    # The path of one sensor is computed from the other sensor through the result.
    if calibration.measured == "positions" and not evidence.has_positions_of_parent:
        own, other = child, parent
        labels = (f"{parent}, through the result", child)
    else:
        own, other = parent, child
        labels = (parent, f"{child}, through the result")
    paths = ((evidence.parent, PARENT, 3.2), (evidence.child, CHILD, 1.1))
    for (points, colour, width), label in zip(paths, labels, strict=True):
        shown = points[rows]
        look: Document = {"color": colour, "lw": width}
        plane.plot(shown[:, first], shown[:, second], label=plain_label(label), **look)
        side.plot(evidence.times_s[rows] * factor, shown[:, across], **look)
    plane.plot(*evidence.parent[0, [first, second]], "o", color=INK, ms=6, label="start")
    axes = ("x (m)", "y (m)", "z (m)")
    is_level = across == 2
    plane.set(title="From above" if is_level else "In the plane of motion")
    plane.set(xlabel=axes[first], ylabel=axes[second], aspect="equal", adjustable="datalim")
    side.set(title="Height" if is_level else "Across the plane of motion")
    side.set(xlabel=f"time ({unit})", ylabel=axes[across])
    low, high = side.get_ylim()
    if high - low < 0.5:  # otherwise rounding would look like hills
        side.set_ylim((low + high) / 2 - 0.25, (low + high) / 2 + 0.25)
    figure.legend(loc="lower center", ncols=3, borderaxespad=0)
    apart_m = np.linalg.norm(evidence.parent - evidence.child, axis=1)
    furthest_s = evidence.times_s[int(np.argmax(apart_m))]
    path_m = float(np.linalg.norm(np.diff(evidence.parent, axis=0), axis=1).sum())
    caption = (
        f"The path of {own}, {length(path_m)} long, and the same path computed from the poses of "
        f"{other} and the result. Half of the time they are within "
        f"{length(float(np.median(apart_m)))} of each other, and at most "
        f"{length(apart_m.max())} apart, at {furthest_s * factor:.1f} {unit}. "
        "That includes drift and jumps of the odometry."
    )
    return as_drawn(figure, "trajectories", "Both trajectories, aligned", caption)


@page_style()
def _coordinates(calibration: Calibration, evidence: Evidence) -> Drawn:
    """Draw position and angles of the parent over time, from both streams."""
    assert evidence.angles is not None
    rows = _downsample(len(evidence.times_s), LOOK.coordinate_points)
    factor, unit = _time_axis(evidence.times_s[-1])
    times = evidence.times_s[rows] * factor
    measured = np.hstack([evidence.parent, np.degrees(evidence.angles[0])])
    computed = np.hstack([evidence.child, np.degrees(evidence.angles[1])])
    figure, panels = _figure(5.4, 3, 2, bottom=0.8, sharex=True)
    labels = ("x (m)", "y (m)", "z (m)", "roll (deg)", "pitch (deg)", "yaw (deg)")
    parent = calibration.parent_frame
    child = calibration.child_frame
    for column, label in enumerate(labels):
        # Positions are the left panels of each row, angles the right ones.
        panel = panels[2 * (column % 3) + column // 3]
        panel.plot(times, measured[rows, column], color=PARENT, lw=3.2, label=plain_label(parent))
        panel.plot(
            times,
            computed[rows, column],
            color=CHILD,
            lw=1.1,
            label=plain_label(f"{child}, through the result"),
        )
        panel.set_ylabel(label, labelpad=2)
    for panel in panels[-2:]:
        panel.set_xlabel(f"time ({unit})")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="lower center", ncols=2)
    apart = np.median(np.abs(measured - computed), axis=0)
    caption = (
        f"Position of {parent}, and its angles against the first pose: as measured, and computed "
        f"from the poses of {child} and the result. Half of the time, the worst axis differs by "
        f"less than {length(float(apart[:3].max()))} and "
        f"{angle(float(np.radians(apart[3:].max())))}. That includes drift."
    )
    return as_drawn(figure, "coordinates", "Both streams over time, aligned", caption)


@page_style()
def _residuals(calibration: Calibration, residuals: Residuals) -> Drawn:
    """Draw the sizes of the residuals of a result, translations above rotations."""
    # An axis stands for the residuals that a result of this kind has.
    sizes = {"x": residuals.translation_m, "yaw": residuals.rotation_rad}
    if calibration.measured == "rotations":
        del sizes["x"]
    if calibration.measured == "positions":
        del sizes["yaw"]
    is_out = ~residuals.is_inlier
    if calibration.reference == "stops":
        what = "stops"
        times = np.arange(1.0, len(residuals) + 1)
        label = "stop"
    else:
        what = "motion pairs"
        if calibration.measured == "positions":
            what = "distances from one position to the next"
        first_ns = residuals.start_ns.min(initial=residuals.end_ns[0])
        times_s = (residuals.end_ns - first_ns) * 1e-9
        factor, unit = _time_axis(float(times_s.max()))
        times = times_s * factor
        label = f"time ({unit})"
    figure, panels = _figure(1.2 + 1.6 * len(sizes), len(sizes), 1, bottom=0.8, sharex=True)
    for panel, (axis, values) in zip(panels, sizes.items(), strict=True):
        to_unit, unit_label = UNITS[axis]
        _draw_residuals(panel, times, np.maximum(values * to_unit, 1e-5), is_out)
        panel.set_ylabel(unit_label)
    panels[-1].set_xlabel(label)
    handles = panels[0].get_legend_handles_labels()
    figure.legend(*handles, loc="lower center", ncols=3, borderaxespad=0)
    medians = [amount(axis, float(np.median(values))) for axis, values in sizes.items()]
    largest = [amount(axis, float(np.max(values))) for axis, values in sizes.items()]
    rejected = f"{is_out.sum():,} ({share(float(is_out.mean()))})" if is_out.any() else "None"
    caption = (
        f"Half of the {len(residuals):,} {what} agree with the result to {listing(medians)}, all "
        f"of them to {listing(largest)}. {rejected} of them are rejected as outliers."
    )
    return as_drawn(figure, "residuals", "Residuals", caption)


def _draw_residuals(panel: Axes, times: FloatArray, values: FloatArray, is_out: BoolArray) -> None:
    """Draw the sizes (K,) of residuals, all positive, and mark the rejected ones."""
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
    """Return the factor from seconds to the unit of a time axis, and its name."""
    return (1.0, "s") if duration_s < 300 else (1 / 60, "min")


def _downsample(count: int, most: int = LOOK.points) -> IntArray:
    """Return the indices of the points that are drawn, with the first and the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


# ---- sensors in space

# The views by the axes of the parent across and up, and their names on a vehicle.
_VIEWS = {"xy": "from above", "xz": "from the side", "yz": "from the front"}


class ShownFigure(Figure):
    """A figure that notebooks show without pyplot."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=130)
        return buffer.getvalue()


def plot(calibration: Calibration, ax: Any = None) -> Figure:
    """Draw the poses of both sensors in three views of the parent sensor's frame.

    An ellipse covers three standard deviations of the child's position.

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
    require_type("the result", calibration, Calibration)
    if ax is not None:
        if np.size(ax) != len(_VIEWS):
            raise InputError(f"ax must be three axes of Matplotlib; got {type(ax).__name__}")
        draw_views(ax, calibration)
        return ax[0].figure
    with page_style(figure_facecolor="white", savefig_facecolor="white"):
        figure = ShownFigure(figsize=(LOOK.width, 3.3), layout="constrained")
        FigureCanvasAgg(figure)
        draw_views(figure.subplots(1, 3), calibration)
        figure.suptitle(calibration.headline, fontsize=8, fontweight="bold", wrap=True)
        figure.supxlabel(caption_of_views(calibration), fontsize=7.5, wrap=True)
    return figure


def caption_of_views(*calibrations: Calibration) -> str:
    """Return the caption of the three views."""
    sigmas = np.array([calibration.sigmas[:3] for calibration in calibrations])
    is_known = np.isfinite(sigmas)
    text = "Axes of all sensors: x red, y green, z blue."
    if is_known.any():
        text += f" Ellipse: {LOOK.sigmas:g} standard deviations of the position."
    unknown = [axis for axis, known in zip("xyz", is_known.all(axis=0), strict=True) if not known]
    if unknown:
        text += f" Unknown along {listing(unknown)}: the dashed line."
    return text


def draw_views(panels: Sequence[Axes], *calibrations: Calibration) -> None:
    """Draw the parent sensor, and the child sensors of one or several results in its frame.

    There is one view in each of the three panels.
    """
    distances = [float(np.linalg.norm(calibration.translation)) for calibration in calibrations]
    axis_m = LOOK.axis * max(*distances, LOOK.least_m)
    for panel, (axes, title) in zip(panels, _VIEWS.items(), strict=True):
        rows = ["xyz".index(axis) for axis in axes]
        _draw_sensor(panel, np.eye(4)[rows], calibrations[0].parent_frame, PARENT, axis_m, 6)
        for calibration in calibrations:
            T = calibration.T_parent_child[rows]
            panel.plot(*T[:, 3:] * [[0.0, 1.0]], color=MUTED, lw=0.8, ls=":", zorder=1)
            _draw_sensor(panel, T, calibration.child_frame, CHILD, axis_m, -14)
            _draw_uncertainty(panel, T, calibration, rows)
        panel.set(xlabel=f"{axes[0]} (m)", ylabel=f"{axes[1]} (m)", title=title)
        panel.set_aspect("equal", adjustable="datalim")
        panel.margins(0.3)


def _draw_uncertainty(
    panel: Axes, T: FloatArray, calibration: Calibration, rows: Sequence[int]
) -> None:
    """Draw the ellipse of the child's position, or a line along each unknown direction.

    ``T`` are two rows of the child's pose, ``rows`` the axes of the view.
    """
    x, y = T[:, 3]
    covariance, unknown = spread_of_position(calibration)
    is_unknown = False
    for across, up in unknown[:, rows]:
        if math.hypot(across, up) > LOOK.end_on:
            is_unknown = True
            slope = up / across if abs(across) > 1e-9 else math.inf
            panel.axline((x, y), slope=slope, color=CHILD, ls="--", lw=1.0)
    if is_unknown:
        return
    variances, axes = np.linalg.eigh(covariance[np.ix_(rows, rows)])
    width, height = 2 * LOOK.sigmas * np.sqrt(np.maximum(variances, 0.0))
    angle_deg = float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])))
    panel.add_patch(Ellipse((x, y), width, height, angle=angle_deg, color=CHILD, alpha=0.3))


def _draw_sensor(
    panel: Axes, T: FloatArray, name: str, colour: str, axis_m: float, below: float
) -> None:
    """Draw a sensor's axes at its origin, and its name; ``T`` are two rows of its pose."""
    origin = T[:, 3]
    for axis, axis_colour in zip(T[:, :3].T, (BAD, GREEN, PARENT), strict=True):
        panel.plot(*np.stack([origin, origin + axis_m * axis], axis=1), color=axis_colour)
    panel.plot(*origin, "o", color=colour, ms=5)
    panel.annotate(plain_label(name), (*origin,), (5, below), textcoords="offset points", color=INK)
