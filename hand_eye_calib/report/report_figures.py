"""The figures of the report."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.assessment.covariance import AXES
from hand_eye_calib.engine.evidence import Evidence, StreamView
from hand_eye_calib.report.captions import measured_axes, relative_to, residual_sizes, time_axis
from hand_eye_calib.report.plot import draw_views
from hand_eye_calib.report.style import (
    BAD,
    BAND,
    CHILD,
    INK,
    MUTED,
    PARENT,
    WIDTH,
    as_svg,
    page_style,
    plain_decades,
    plain_label,
)
from hand_eye_calib.results.calibration import Calibration

# Points drawn of a line, and of dots that each stand alone.
_MOST_ON_A_LINE, _MOST_DOTS, _MOST_OUTLIERS = 1500, 600, 300

# Share of a motion's length that may well be noise.
_NOISE_SHARE = 0.3

# A path is flat if it extends less than this share of its second extent along the third.
_FLAT = 0.5

# From m and rad to the units of the figures, and the smallest residual that is drawn.
_TO_CM, _TO_DEG = 100.0, 180 / np.pi
_FACTORS = np.repeat([_TO_CM, _TO_DEG], 3)
_SMALLEST = 1e-5


def draw_all(calibration: Calibration, evidence: Evidence) -> dict[str, str]:
    """SVG of every figure, by name; without those for which there is too little data."""
    makers: dict[str, Callable[[Calibration, Evidence], Figure | None]] = {
        "views": _views,
        "trajectories": _trajectories,
        "residuals": _residuals,
        "convergence": _convergence,
        "answers": _answers,
    }
    if calibration.measured == "rotations":
        del makers["trajectories"], makers["views"]
    with page_style():
        drawn = {name: make(calibration, evidence) for name, make in makers.items()}
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


def _figure(
    height: float,
    rows: int,
    columns: int,
    *,
    left: float,
    bottom: float = 0.5,
    gap: float = 0.2,
    between: float = 0.15,
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
    panels = figure.subplots(rows, columns, gridspec_kw=spacing, squeeze=False, **options)
    return figure, panels


def _legend(figure: Figure, panel: Axes) -> None:
    handles = panel.get_legend_handles_labels()
    figure.legend(*handles, loc="lower center", ncols=3, borderaxespad=0)


def _views(calibration: Calibration, evidence: Evidence) -> Figure:
    figure, (panels,) = _figure(3.1, 1, 3, left=0.7, gap=0.75)
    draw_views(panels, calibration)
    return figure


def _trajectories(calibration: Calibration, evidence: Evidence) -> Figure:
    tracks = evidence.tracks
    shown = _downsample(len(tracks.times_s), _MOST_ON_A_LINE)
    factor, unit = time_axis(tracks.times_s[-1])
    first, second, across = _plane_of_motion(tracks.parent)
    figure, ((plane, side),) = _figure(4.1, 1, 2, left=0.7, bottom=0.85, gap=0.7)
    labels = [calibration.parent_frame, calibration.child_frame]
    is_reversed = calibration.measured == "positions" and not evidence.has_positions_of_parent
    labels[0 if is_reversed else 1] += ", through the result"
    paths = ((tracks.parent, PARENT, 3.2), (tracks.child, CHILD, 1.1))
    for (points, colour, width), label in zip(paths, labels, strict=True):
        look: dict[str, Any] = {"color": colour, "lw": width}
        plane.plot(points[shown, first], points[shown, second], label=plain_label(label), **look)
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
    _legend(figure, plane)
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


def _residuals(calibration: Calibration, evidence: Evidence) -> Figure:
    residuals, sizes = evidence.residuals, residual_sizes(calibration, evidence)
    factor, unit = time_axis(evidence.tracks.times_s[-1])
    height = 1.0 + 1.6 * len(sizes)
    figure, panels = _figure(height, len(sizes), 1, left=0.7, bottom=0.8, top=0.1, sharex=True)
    dots, crosses = (np.flatnonzero(residuals.is_outlier == is_out) for is_out in (False, True))
    dots = dots[_downsample(len(dots), _MOST_DOTS)]
    largest = next(iter(sizes.values()))
    crosses = crosses[np.argsort(-largest[crosses])[:_MOST_OUTLIERS]]
    times = residuals.times_s * factor
    used = dict(color=PARENT, ms=2.6, mew=0, alpha=0.65, label="used")
    rejected = dict(color=BAD, ms=5.5, mew=1.5, label="rejected as outlier")
    for panel, (axis, radians_or_metres) in zip(panels[:, 0], sizes.items(), strict=True):
        to_unit, name = (_TO_CM, "translation (cm)") if axis == "x" else (_TO_DEG, "rotation (deg)")
        values = np.maximum(radians_or_metres * to_unit, _SMALLEST)
        panel.plot(times[dots], values[dots], "o", **used)
        panel.plot(times[crosses], values[crosses], "x", **rejected)
        panel.axhline(np.median(values), color=INK, lw=1.0, ls="--", label="median of all")
        panel.set_ylabel(name)
        panel.yaxis.set_label_coords(-0.06, 0.5)
        if values.max() > 15 * np.median(values):  # the largest would hide the others
            panel.set_yscale("log")
            plain_decades(panel.yaxis)
        else:
            panel.set_ylim(0, 1.08 * values.max())
    panels[-1, 0].set_xlabel(f"time ({unit})")
    _legend(figure, panels[0, 0])
    return figure


def _convergence(calibration: Calibration, evidence: Evidence) -> Figure | None:
    estimates = evidence.convergence
    if len(estimates) < 3:
        return None
    factor, unit = time_axis(estimates[-1].until_s)
    times = np.array([estimate.until_s for estimate in estimates]) * factor
    moved, sigmas = _in_units(calibration, [one.calibration for one in estimates])
    axes = np.flatnonzero(measured_axes(calibration))
    height = 0.8 + 0.6 * len(axes)
    figure, panels = _figure(height, len(axes) // 3, 3, left=0.7, between=0.4, sharex=True)
    for index, panel in zip(axes.tolist(), panels.flat, strict=True):
        limit = _limit(moved, sigmas, calibration.sigmas * _FACTORS, index)
        _draw_convergence(panel, times, moved[:, index], sigmas[:, index], limit)
        panel.set(ylim=(-limit, limit), title=AXES[index], xlim=(0, times[-1] * 1.04))
        if index % 3:
            panel.set_yticklabels([])
        else:
            panel.set_ylabel(f"{'cm' if index < 3 else 'deg'} from the result")
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


def _answers(calibration: Calibration, evidence: Evidence) -> Figure | None:
    """A dot with an error bar for each answer (down) and axis (across), relative to the result."""
    others = [(one.label, one.calibration) for one in (*evidence.comparison, *evidence.halves)]
    if not others:
        return None
    rows = [("this result", calibration), *others]
    labels = [plain_label(label) for label, _ in rows]
    moved, sigmas = _in_units(calibration, [answer for _, answer in rows])
    axes = np.flatnonzero(measured_axes(calibration))
    left = 0.25 + 0.068 * max(map(len, labels))
    figure, (panels,) = _figure(
        0.85 + 0.235 * len(rows), 1, len(axes), left=left, gap=0.1, sharey=True
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


def _in_units(
    calibration: Calibration, answers: Sequence[Calibration]
) -> tuple[FloatArray, FloatArray]:
    """Distances (N, 6) of answers from the result and their standard deviations, in cm and deg."""
    sigmas = np.array([one.sigmas for one in answers])
    return relative_to(calibration, answers) * _FACTORS, sigmas * _FACTORS


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


def _streams(seen: StreamView, names: tuple[str, str]) -> Figure:
    """Rates of both streams, when there are poses, and for whole poses the motions of both."""
    factor, unit = time_axis(max(times[-1] if len(times) else 0.0 for times, _ in seen.rates))
    height = 6.6 if seen.is_whole else 2.95
    figure = Figure(figsize=(WIDTH, height))

    def panel(left: float, bottom: float, wide: float, tall: float, **options: Any) -> Axes:
        edges = (left / WIDTH, bottom / height, wide / WIDTH, tall / height)
        return figure.add_axes(edges, **options)

    across = WIDTH - 0.8 - 0.12
    rate = panel(0.8, height - 2.0, across, 1.7)
    strip = panel(0.8, height - 2.45, across, 0.32, sharex=rate)
    looks = ((PARENT, 2.6), (CHILD, 1.0))
    streams = zip(seen.rates, seen.spans_s, names, looks, strict=True)
    for row, ((times, rates), spans, name, (colour, width)) in enumerate(streams):
        values = rates if seen.quantity == "speed" else np.degrees(rates)
        rate.plot(times * factor, values, color=colour, lw=width, label=plain_label(name))
        bars = [(start * factor, (end - start) * factor) for start, end in spans]
        strip.broken_barh(bars, (0.6 - row, 0.8), color=colour, lw=0)
    in_unit = "speed (m/s)" if seen.quantity == "speed" else "angular rate (deg/s)"
    rate.set(ylabel=in_unit, ylim=(0, None))
    rate.tick_params(labelbottom=False)
    rate.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, borderaxespad=0)
    strip.set(ylim=(-0.6, 1.6), xlabel=f"time ({unit})")
    strip.set_yticks([1.0, 0.0], ["parent", "child"])
    strip.tick_params(axis="y", length=0)
    strip.grid(visible=False)
    if seen.is_whole:
        half = (across - 0.75) / 2
        # On flat ground nothing moves along the axis, and noise should not look like motion.
        for number, title, unit, values, least in (
            (0, f"Rotation angle of motions over {seen.lag_s:g} s", "deg", seen.angles, 0.0),
            (1, "Translation along the rotation axis", "m", seen.along_axis, seen.rms_translation),
        ):
            each = panel(0.8 + number * (half + 0.75), 0.55, half, 2.9)
            each.set(title=title, xlabel=f"parent ({unit})", ylabel=f"child ({unit})")
            _identity(each, values if number else np.degrees(values), _NOISE_SHARE * least)
    return figure


def _identity(panel: Axes, values: FloatArray, least: float) -> None:
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


def _write(panel: Axes, text: str) -> None:
    panel.text(0.5, 0.5, text, transform=panel.transAxes, ha="center", va="center", color=MUTED)


def _downsample(count: int, most: int) -> IntArray:
    """Indices of at most ``most`` of so many points, first and last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
