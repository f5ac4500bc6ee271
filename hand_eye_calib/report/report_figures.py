"""The figures of the report: SVG that takes its colours from the page, so that one drawing is right
in light, in dark and on paper.
"""

import io
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.assessment.covariance import AXES
from hand_eye_calib.assessment.excitation import MIN_ROTATION
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.engine.evidence import Evidence, StreamView
from hand_eye_calib.errors import printable
from hand_eye_calib.report.captions import (
    figures_of,
    measured_axes,
    residual_sizes,
    time_axis,
)
from hand_eye_calib.report.style import drawing_style, house_style, plain_decades
from hand_eye_calib.results.calibration import Calibration

# Colours as drawn, each with the name of the page's own colour that replaces it.
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

WIDTH = 8.6  # inches; the page shows them at about 96 pixels an inch

_TEXT_COLOURS = ("text.color", "axes.labelcolor", "axes.titlecolor")
_STYLE: dict[str, Any] = {
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

# Points drawn of a line, and of dots that each stand alone.
_MOST_ON_A_LINE, _MOST_DOTS, _MOST_OUTLIERS = 1500, 600, 300

# Share of a motion's length that may well be noise.
_NOISE_SHARE = 0.3

_SMALLEST_CM, _SMALLEST_DEG = 1e-4, 1e-5

# A path is flat if it extends less than this share of its second extent along the third.
_FLAT = 0.5

# From metres and radians, for translations and rotations.
_TO_CM, _TO_DEG = 100.0, 180 / np.pi

_Maker = Callable[[Calibration, Evidence], Figure | None]


def draw_all(calibration: Calibration, evidence: Evidence) -> dict[str, str]:
    """SVG of every figure, by name; without those for which there is too little data."""
    makers: dict[str, _Maker] = {
        "trajectories": _trajectories,
        "residuals": _residuals,
        "convergence": _convergence,
        "excitation": _excitation,
        "methods": _methods,
        "halves": _halves,
    }
    wanted = figures_of(calibration)
    with page_style():
        drawn = {
            name: make(calibration, evidence) for name, make in makers.items() if name in wanted
        }
        names = (calibration.parent_frame, calibration.child_frame)
        drawn["streams"] = _streams(evidence.streams, names)
        return {name: as_svg(figure, name) for name, figure in drawn.items() if figure}


def draw_streams(seen: StreamView, names: tuple[str, str]) -> str:
    """SVG of both streams before any solve.

    Parameters
    ----------
    seen : StreamView
    names : (str, str)
        Of the parent and the child.
    """
    with page_style():
        return as_svg(_streams(seen, names), "streams")


@contextmanager
def page_style() -> Iterator[None]:
    with house_style(), drawing_style(_STYLE), warnings.catch_warnings():
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


def _figure(
    height: float,
    rows: int,
    columns: int,
    *,
    left: float,
    bottom: float,
    gap: float = 0.2,
    between: float = 0.25,
    top: float = 0.3,
    **options: Any,
) -> tuple[Figure, Any]:
    """A figure with panels; margins are given in inches, because measuring the text takes more time
    than all else.
    """
    figure = Figure(figsize=(WIDTH, height))
    right = 0.12
    width = (WIDTH - left - right - gap * (columns - 1)) / columns
    tall = (height - top - bottom - between * (rows - 1)) / rows
    spacing = {
        "left": left / WIDTH,
        "right": 1 - right / WIDTH,
        "bottom": bottom / height,
        "top": 1 - top / height,
        "wspace": gap / width,
        "hspace": between / tall,
    }
    return figure, figure.subplots(rows, columns, gridspec_kw=spacing, **options)


def _trajectories(calibration: Calibration, evidence: Evidence) -> Figure | None:
    tracks = evidence.tracks
    shown = _downsample(len(tracks.times_s), _MOST_ON_A_LINE)
    factor, unit = time_axis(tracks.times_s[-1])
    first, second, across = _plane_of_motion(tracks.parent)
    figure, (plane, side) = _figure(4.1, 1, 2, left=0.7, bottom=0.85, gap=0.7)
    names = [calibration.parent_frame, calibration.child_frame]
    is_reversed = calibration.measured == "positions" and not evidence.has_positions_of_parent
    names[0 if is_reversed else 1] += ", through the result"
    for points, colour, width, label in (
        (tracks.parent, PARENT, 3.2, names[0]),
        (tracks.child, CHILD, 1.1, names[1]),
    ):
        look: dict[str, Any] = {"color": colour, "ls": "-", "lw": width}
        plane.plot(points[shown, first], points[shown, second], label=_plain(label), **look)
        side.plot(tracks.times_s[shown] * factor, points[shown, across], **look)
    plane.plot(*tracks.parent[0, [first, second]], "o", color=INK, ms=6, label="start")
    names = [f"{axis} (m)" for axis in "xyz"]
    is_level = across == 2
    plane.set(title="From above" if is_level else "In the plane of motion")
    plane.set(xlabel=names[first], ylabel=names[second], aspect="equal", adjustable="datalim")
    side.set(title="Height" if is_level else "Across the plane of motion")
    side.set(xlabel=f"time ({unit})", ylabel=names[across])
    low, high = side.get_ylim()
    if high - low < 0.5:  # rounding is no relief
        side.set_ylim((low + high) / 2 - 0.25, (low + high) / 2 + 0.25)
    figure.legend(*plane.get_legend_handles_labels(), loc="lower center", ncols=3, borderaxespad=0)
    return figure


def _plane_of_motion(points: FloatArray) -> tuple[int, int, int]:
    """Axes to draw a path by: two in the plane of motion, and the one across it.

    A camera moves in its x and z; for it, x and y would be a view from the side. A path that fills
    all three axes is drawn from above.
    """
    extents = np.ptp(points, axis=0)
    across = int(np.argmin(extents))
    if extents[across] > _FLAT * np.sort(extents)[1]:
        across = 2
    first, second = (axis for axis in range(3) if axis != across)
    return first, second, across


def _residuals(calibration: Calibration, evidence: Evidence) -> Figure | None:
    residuals, sizes = evidence.residuals, residual_sizes(calibration, evidence)
    factor, unit = time_axis(evidence.tracks.times_s[-1])
    figure, panels = _figure(
        4.2 if len(sizes) == 2 else 2.6, len(sizes), 1,
        left=0.7, bottom=0.8, between=0.15, top=0.1, sharex=True, squeeze=False,
    )  # fmt: skip
    panels = panels[:, 0]
    dots = _sample(np.flatnonzero(~residuals.is_outlier), _MOST_DOTS)
    crosses = np.flatnonzero(residuals.is_outlier)
    largest = next(iter(sizes.values()))
    crosses = crosses[np.argsort(-largest[crosses])[:_MOST_OUTLIERS]]
    looks = {
        "x": (_TO_CM, "translation (cm)", _SMALLEST_CM),
        "yaw": (_TO_DEG, "rotation (deg)", _SMALLEST_DEG),
    }
    times = residuals.times_s * factor
    used = dict(color=PARENT, ms=2.6, mew=0, alpha=0.65, label="used")
    rejected = dict(color=BAD, ms=5.5, mew=1.5, label="rejected as outlier")
    for panel, (axis, values) in zip(panels, sizes.items(), strict=True):
        to_unit, name, smallest = looks[axis]
        values = np.maximum(values * to_unit, smallest)
        panel.plot(times[dots], values[dots], "o", **used)
        panel.plot(times[crosses], values[crosses], "x", **rejected)
        panel.axhline(np.median(values), color=INK, lw=1.0, ls="--", label="median of all")
        panel.set_ylabel(name)
        panel.yaxis.set_label_coords(-0.06, 0.5)
        _magnitude_axis(panel, values)
    panels[-1].set_xlabel(f"time ({unit})")
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="lower center", ncols=3, borderaxespad=0
    )
    return figure


def _convergence(calibration: Calibration, evidence: Evidence) -> Figure | None:
    estimates = evidence.convergence
    if len(estimates) < 3:
        return None
    factor, unit = time_axis(estimates[-1].until_s)
    times = np.array([estimate.until_s for estimate in estimates]) * factor
    moved, sigmas = _relative_to(calibration, [one.calibration for one in estimates])
    axes = np.flatnonzero(measured_axes(calibration))
    figure, panels = _figure(
        4.4 if len(axes) == 6 else 2.6, len(axes) // 3, 3,
        left=0.7, bottom=0.5, gap=0.15, between=0.4, sharex=True, squeeze=False,
    )  # fmt: skip
    for index, panel in zip(axes.tolist(), panels.flat, strict=True):
        limit = _limit(moved, sigmas, calibration.sigmas * _FACTORS, index)
        _draw_convergence(panel, times, moved[:, index], sigmas[:, index], limit)
        panel.set(ylim=(-limit, limit), title=AXES[index], xlim=(0, times[-1] * 1.04))
        if index % 3:
            panel.set_yticklabels([])
    for row, first in zip(panels, axes[::3].tolist(), strict=True):
        row[0].set_ylabel(f"{'cm' if first < 3 else 'deg'} from the result")
    for panel in panels[-1]:
        panel.set_xlabel(f"recording used ({unit})")
        panel.locator_params(axis="x", nbins=5, prune="upper")
    return figure


def _draw_convergence(
    panel: Axes, times: FloatArray, values: FloatArray, sigmas: FloatArray, limit: float
) -> None:
    """One axis: its value over time with one standard deviation."""
    panel.axhline(0, color=MUTED, lw=0.8)
    known = np.isfinite(sigmas)
    if not known.any():
        _write(panel, "not observable")
        return
    times, values, sigmas = times[known], values[known], sigmas[known]
    low, high = (np.clip(values + sign * sigmas, -limit, limit) for sign in (-1, 1))
    panel.fill_between(times, low, high, color=BAND, alpha=0.2, lw=0)
    panel.plot(times, np.clip(values, -limit, limit), "-", color=PARENT, lw=1.3)
    beyond = np.abs(values) > limit
    panel.plot(times[~beyond], values[~beyond], "o", color=PARENT, ms=4)
    for sign, marker in ((1, "^"), (-1, "v")):
        out = beyond & (np.sign(values) == sign)
        panel.plot(times[out], np.full(out.sum(), sign * limit * 0.94), marker, color=BAD, ms=6)


def _excitation(calibration: Calibration, evidence: Evidence) -> Figure | None:
    rotations = evidence.rotations
    if not len(rotations.times_s):
        return None
    factor, unit = time_axis(evidence.tracks.times_s[-1])
    shown = _downsample(len(rotations.times_s), _MOST_ON_A_LINE)
    figure, panels = _figure(4.2, 3, 1, left=0.8, bottom=0.5, between=0.15, top=0.1, sharex=True)
    enough = np.degrees(MIN_ROTATION)
    for index, panel in enumerate(panels):
        values = np.degrees(rotations.vectors[shown, index])
        panel.axhspan(-enough, enough, color=MUTED, alpha=0.16, lw=0)
        panel.plot(rotations.times_s[shown] * factor, values, color=PARENT, lw=1.2)
        limit = 1.1 * max(np.abs(values).max(), 1.3 * enough)
        panel.set(ylim=(-limit, limit), ylabel=f"{AXES[3 + index]}\nabout {'xyz'[index]} (deg)")
    panels[2].set_xlabel(f"time ({unit})")
    for panel in panels:
        panel.yaxis.set_label_coords(-0.06, 0.5)
    return figure


def _methods(calibration: Calibration, evidence: Evidence) -> Figure | None:
    if not evidence.comparison:
        return None
    others = [(one.label, one.calibration) for one in evidence.comparison]
    return _answers(calibration, [("this result", calibration), *others])


def _halves(calibration: Calibration, evidence: Evidence) -> Figure | None:
    if len(evidence.halves) < 2:
        return None
    halves = [(half.label, half.calibration) for half in evidence.halves]
    return _answers(calibration, [("whole recording", calibration), *halves])


def _answers(calibration: Calibration, rows: Sequence[tuple[str, Calibration]]) -> Figure:
    """A dot with an error bar for each answer (down) and axis (across), relative to the result."""
    labels = [_plain(label) for label, _ in rows]
    moved, sigmas = _relative_to(calibration, [answer for _, answer in rows])
    axes = np.flatnonzero(measured_axes(calibration))
    figure, panels = _figure(
        0.85 + 0.235 * len(rows),
        1,
        len(axes),
        left=0.25 + 0.068 * max(map(len, labels)),
        bottom=0.5,
        gap=0.1,
        sharey=True,
    )
    for index, panel in zip(axes.tolist(), panels, strict=True):
        limit = _limit(moved, sigmas, sigmas[0], index)
        _draw_answers(panel, moved[:, index], sigmas[:, index], limit)
        panel.set(xlim=(-limit, limit), ylim=(len(rows) - 0.5, -0.5), title=AXES[index])
        panel.set_xlabel("cm" if index < 3 else "deg")
        panel.set_yticks(np.arange(len(rows)), labels)
        panel.tick_params(axis="y", length=0)
        tick = float(f"{0.75 * limit:.0e}")
        panel.set_xticks([-tick, 0, tick], [f"{-tick:g}", "0", f"{tick:g}"])
        panel.grid(axis="y", visible=False)
        panel.spines["left"].set_visible(False)
    return figure


def _draw_answers(panel: Axes, values: FloatArray, sigmas: FloatArray, limit: float) -> None:
    """One axis: a dot and a bar for each answer; a triangle at the edge for what lies beyond."""
    known = np.isfinite(sigmas)
    if known[0]:
        panel.axvspan(-sigmas[0], sigmas[0], color=BAND, alpha=0.16, lw=0)
    panel.axvline(0, color=MUTED, lw=0.8)
    if not known.any():
        _write(panel, "not\nobservable")
    for place in np.flatnonzero(known):
        value, sigma = values[place], sigmas[place]
        colour = INK if place == 0 else PARENT
        ends = np.clip([value - sigma, value + sigma], -limit, limit)
        panel.plot(ends, [place, place], color=colour, lw=1.4)
        if abs(value) > limit:
            marker = ">" if value > 0 else "<"
            panel.plot(np.sign(value) * limit * 0.9, place, marker, color=BAD, ms=6)
        else:
            panel.plot(value, place, "o", color=colour, ms=4.5)


# From m and rad to the units of the panels.
_FACTORS = np.repeat([_TO_CM, _TO_DEG], 3)


def _relative_to(
    calibration: Calibration, answers: Sequence[Calibration]
) -> tuple[FloatArray, FloatArray]:
    """Distances (N, 6) of answers from the result and their standard deviations, in cm and deg."""
    moved = [deviation(one.T_parent_child, calibration.T_parent_child) for one in answers]
    sigmas = [one.sigmas for one in answers]
    return np.array(moved) * _FACTORS, np.array(sigmas) * _FACTORS


def _streams(seen: StreamView, names: tuple[str, str]) -> Figure:
    factor, unit = time_axis(max(times[-1] if len(times) else 0.0 for times, _ in seen.rates))
    height = 6.6 if seen.is_whole else 2.95
    figure = Figure(figsize=(WIDTH, height))

    def panel(left: float, bottom: float, wide: float, tall: float, **options: Any) -> Axes:
        edges = (left / WIDTH, bottom / height, wide / WIDTH, tall / height)
        return figure.add_axes(edges, **options)

    across = WIDTH - 0.8 - 0.12
    rate = panel(0.8, height - 2.0, across, 1.7)
    strip = panel(0.8, height - 2.45, across, 0.32, sharex=rate)
    _draw_rates(rate, strip, seen, names, factor)
    strip.set_xlabel(f"time ({unit})")
    if not seen.is_whole:
        return figure
    half = (across - 0.75) / 2
    angles, along_axis = (panel(0.8 + n * (half + 0.75), 0.55, half, 2.9) for n in range(2))
    angles.set(
        title=f"Rotation angle of motions over {seen.lag_s:g} s",
        xlabel="parent (deg)",
        ylabel="child (deg)",
    )
    along_axis.set(
        title="Translation along the rotation axis", xlabel="parent (m)", ylabel="child (m)"
    )
    _identity(angles, np.degrees(seen.angles))
    # On flat ground nothing moves along the axis, and noise should not look like motion.
    _identity(along_axis, seen.along_axis, _NOISE_SHARE * seen.rms_translation)
    return figure


def _draw_rates(
    rate: Axes, strip: Axes, seen: StreamView, names: tuple[str, str], factor: float
) -> None:
    """Angular rates of both streams, and below them when there are poses."""
    looks = ((PARENT, 2.6), (CHILD, 1.0))
    streams = zip(seen.rates, seen.spans_s, names, looks, strict=True)
    for row, ((times, rates), spans, name, (colour, width)) in enumerate(streams):
        values = rates if seen.quantity == "speed" else np.degrees(rates)
        rate.plot(times * factor, values, "-", color=colour, lw=width, label=_plain(name))
        bars = [(start * factor, (end - start) * factor) for start, end in spans]
        strip.broken_barh(bars, (0.6 - row, 0.8), color=colour, lw=0)
    in_unit = {"speed": "speed (m/s)", "angular rate": "angular rate (deg/s)"}[seen.quantity]
    rate.set(ylabel=in_unit, ylim=(0, None))
    rate.tick_params(labelbottom=False)
    rate.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, borderaxespad=0)
    strip.set_ylim(-0.6, 1.6)
    strip.set_yticks([1.0, 0.0], ["parent", "child"])
    strip.tick_params(axis="y", length=0)
    strip.grid(visible=False)


def _identity(panel: Axes, values: FloatArray, least: float = 0.0) -> None:
    """Dots of the child's values (N, 2) over the parent's, and the line they should be on; the axes
    reach to ``least`` at least.
    """
    if not len(values):
        _write(panel, "nothing to compare")
        return
    reach = max(1.15 * float(np.percentile(np.abs(values), 99)), least, 1e-6)
    low = -reach if values.min() < 0 else 0.0
    panel.plot([low, reach], [low, reach], color=MUTED, lw=1.0, ls="--", zorder=1)
    beyond = (np.abs(values) > reach).any(axis=1)
    panel.plot(*values[~beyond].T, "o", color=PARENT, ms=3.2, mew=0, alpha=0.5)
    panel.plot(
        *np.clip(values[beyond], low, reach).T, "x", color=BAD, ms=5.5, mew=1.5, clip_on=False
    )
    panel.set(xlim=(low, reach), ylim=(low, reach))


def _limit(moved: FloatArray, sigmas: FloatArray, result: FloatArray, index: int) -> float:
    """How far the panel of an axis reaches, the same for all translations and for all rotations:
    what is far off is shown at the edge.
    """
    columns = slice(0, 3) if index < 3 else slice(3, 6)
    values, sigmas, result = moved[:, columns], sigmas[:, columns], result[columns]
    known = np.isfinite(sigmas)
    if not known.any():
        return 1.0
    reach = (np.abs(values) + sigmas)[known]
    nearest = 4 * np.max(result[np.isfinite(result)], initial=0.0)
    return float(max(1.25 * np.percentile(reach, 70), nearest, 1e-3))


def _magnitude_axis(panel: Axes, values: FloatArray) -> None:
    """From zero; logarithmic if the largest would hide the others."""
    if values.max() > 15 * np.median(values):
        panel.set_yscale("log")
        plain_decades(panel.yaxis)
    else:
        panel.set_ylim(0, 1.08 * values.max())


def _write(panel: Axes, text: str) -> None:
    panel.text(0.5, 0.5, text, transform=panel.transAxes, ha="center", va="center", color=MUTED)


def _plain(label: str) -> str:
    """A name that matplotlib takes as it is: no formulas, and no leading underscore, which would
    hide it from the legend.
    """
    text = printable(label).replace("$", r"\$")
    return f"\u200b{text}" if text.startswith("_") else text


def _downsample(count: int, most: int) -> IntArray:
    """Indices of at most ``most`` of so many points, first and last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def _sample(indices: IntArray, most: int) -> IntArray:
    """Some of the indices, evenly."""
    return indices[_downsample(len(indices), most)] if len(indices) else indices
