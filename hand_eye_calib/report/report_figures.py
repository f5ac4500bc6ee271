"""The figures of the report: SVG that takes its colours from the page, so that one drawing is right
in light, in dark and on paper.
"""

import io
import re
import warnings
from contextlib import contextmanager

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from hand_eye_calib.assessment.covariance import AXES
from hand_eye_calib.assessment.excitation import MIN_ROTATION
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.report.style import house_style, plain_decades

# Colours as drawn, each with the name of the page's own colour that replaces it.
INK, MUTED, GRID, PAPER = "#1b1f24", "#5c6670", "#d9dee3", "#fefefd"
PARENT, CHILD, BAD, BAND = "#0072b2", "#d98300", "#c8452f", "#0072b3"
_VARIABLES = {
    INK: "ink", MUTED: "muted", GRID: "grid", PAPER: "card", PARENT: "parent", CHILD: "child", BAD: "bad", BAND: "parent",
}  # fmt: skip

WIDTH = 8.6  # inches; the page shows them at about 96 pixels an inch

_STYLE = {
    "font.family": "sans-serif", "font.size": 9.0, "axes.labelsize": 9.0, "axes.titlesize": 9.5, "xtick.labelsize": 8.5, "ytick.labelsize": 8.5,
    "legend.fontsize": 8.5, "text.color": INK, "axes.labelcolor": INK, "axes.titlecolor": INK, "xtick.labelcolor": INK, "ytick.labelcolor": INK,
    "axes.edgecolor": MUTED, "xtick.color": MUTED, "ytick.color": MUTED, "grid.color": GRID, "axes.grid.axis": "both", "legend.frameon": False,
    "figure.facecolor": "none", "axes.facecolor": "none", "savefig.facecolor": "none", "lines.linewidth": 1.5, "path.simplify_threshold": 0.3,
}  # fmt: skip

# Points drawn of a line, and of dots that each stand alone.
_MOST_ON_A_LINE, _MOST_DOTS, _MOST_OUTLIERS = 1500, 600, 300

# Share of a motion's length that may well be noise.
_NOISE_SHARE = 0.3

_SMALLEST_CM, _SMALLEST_DEG = 1e-4, 1e-5


def draw_all(calibration, evidence):
    """SVG of every figure, by name."""
    makers = {
        "trajectories": _trajectories, "residuals": _residuals, "convergence": _convergence,
        "excitation": _excitation, "methods": _methods, "halves": _halves,
    }  # fmt: skip
    with _page_style():
        drawn = {name: make(calibration, evidence) for name, make in makers.items()}
        drawn["streams"] = _streams(
            evidence.streams, (calibration.parent_frame, calibration.child_frame)
        )
        return {name: _svg(figure, name) for name, figure in drawn.items() if figure}


def draw_streams(seen, names):
    """SVG of what the streams say before any solve.

    Parameters
    ----------
    seen : StreamsSeen
    names : (str, str)
        Of the parent and the child.
    """
    with _page_style():
        return _svg(_streams(seen, names), "streams")


@contextmanager
def _page_style():
    with house_style(), matplotlib.rc_context(_STYLE), warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", message="Glyph .* missing"
        )  # text is drawn by the browser, with its own fonts
        yield


def _svg(figure, name):
    """The figure as an element that can stand in a page: no prologue, names of its own, the page's
    colours.
    """
    written = io.StringIO()
    figure.savefig(
        written, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type"))
    )
    svg = written.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r' xmlns(:\w+)?="[^"]*"', "", svg)
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(
        r'(<svg[^>]*?) height="[^"]*"', r'\1 aria-hidden="true" focusable="false"', svg, count=1
    )
    svg = re.sub(r'\bid="', f'id="{name}-', svg)
    svg = re.sub(r'href="#', f'href="#{name}-', svg).replace("url(#", f"url(#{name}-")
    svg = re.sub(r"font: ([\d.]+)px [^;\"]*", r"font: \1px var(--sans)", svg)
    svg = re.sub(r"<!--.*?-->\n?", "", svg, flags=re.DOTALL)
    for drawn, variable in _VARIABLES.items():
        svg = svg.replace(drawn, f"var(--{variable})")
    return svg


def _figure(height, rows, columns, left, bottom, gap=0.2, between=0.25, top=0.3, **options):
    """A figure with panels; room is given in inches, for finding out what the text takes costs more
    time than all else.
    """
    figure = Figure(figsize=(WIDTH, height))
    right = 0.12
    width = (WIDTH - left - right - gap * (columns - 1)) / columns
    tall = (height - top - bottom - between * (rows - 1)) / rows
    edges = dict(
        left=left / WIDTH, right=1 - right / WIDTH, bottom=bottom / height, top=1 - top / height
    )
    panels = figure.subplots(
        rows,
        columns,
        gridspec_kw=edges | dict(wspace=gap / width, hspace=between / tall),
        **options,
    )
    return figure, panels


def time_axis(duration_s):
    """Factor and name of the unit in which a drive's time is shown."""
    return (1.0, "s") if duration_s < 300 else (1 / 60, "min")


def _trajectories(calibration, evidence):
    tracks = evidence.tracks
    shown = _thin(len(tracks.times_s), _MOST_ON_A_LINE)
    factor, unit = time_axis(tracks.times_s[-1])
    figure, (above, height) = _figure(4.1, 1, 2, left=0.7, bottom=0.85, gap=0.7)
    for points, colour, dashes, width, label in (
        (tracks.parent, PARENT, "-", 3.2, calibration.parent_frame),
        (tracks.child, CHILD, "-", 1.1, f"{calibration.child_frame}, through the result"),
    ):
        drawn = dict(color=colour, ls=dashes, lw=width)
        above.plot(*points[shown, :2].T, label=_plain(label), **drawn)
        height.plot(tracks.times_s[shown] * factor, points[shown, 2], **drawn)
    above.plot(*tracks.parent[0, :2], "o", color=INK, ms=6, label="start")
    above.set(
        title="From above", xlabel="x (m)", ylabel="y (m)", aspect="equal", adjustable="datalim"
    )
    height.set(title="Height", xlabel=f"time ({unit})", ylabel="z (m)")
    low, high = height.get_ylim()
    if high - low < 0.5:  # rounding is no relief
        height.set_ylim((low + high) / 2 - 0.25, (low + high) / 2 + 0.25)
    figure.legend(*above.get_legend_handles_labels(), loc="lower center", ncols=3, borderaxespad=0)
    return figure


def _residuals(calibration, evidence):
    residuals = evidence.residuals
    factor, unit = time_axis(evidence.tracks.times_s[-1])
    figure, panels = _figure(4.2, 2, 1, left=0.7, bottom=0.8, between=0.15, top=0.1, sharex=True)
    dots = _sample(np.flatnonzero(~residuals.is_outlier), _MOST_DOTS)
    crosses = np.flatnonzero(residuals.is_outlier)
    crosses = crosses[np.argsort(-residuals.translation_m[crosses])[:_MOST_OUTLIERS]]
    for panel, values, name, smallest in (
        (panels[0], residuals.translation_m * 100, "translation (cm)", _SMALLEST_CM),
        (panels[1], np.degrees(residuals.rotation_rad), "rotation (deg)", _SMALLEST_DEG),
    ):
        values = np.maximum(values, smallest)
        times = residuals.times_s * factor
        panel.plot(
            times[dots], values[dots], "o", color=PARENT, ms=2.6, mew=0, alpha=0.65, label="used"
        )
        panel.plot(
            times[crosses],
            values[crosses],
            "x",
            color=BAD,
            ms=5.5,
            mew=1.5,
            label="left out as outlier",
        )
        panel.axhline(np.median(values), color=INK, lw=1.0, ls="--", label="median of all")
        panel.set_ylabel(name)
        panel.yaxis.set_label_coords(-0.06, 0.5)
        _magnitude_axis(panel, values)
    panels[1].set_xlabel(f"time ({unit})")
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="lower center", ncols=3, borderaxespad=0
    )
    return figure


def _convergence(calibration, evidence):
    estimates = evidence.convergence
    if len(estimates) < 3:
        return None
    factor, unit = time_axis(estimates[-1].until_s)
    times = np.array([estimate.until_s for estimate in estimates]) * factor
    moved = np.array(
        [
            deviation(estimate.calibration.T_parent_child, calibration.T_parent_child)
            for estimate in estimates
        ]
    )
    spread = np.array([estimate.calibration.sigmas for estimate in estimates])
    figure, panels = _figure(4.4, 2, 3, left=0.7, bottom=0.5, gap=0.15, between=0.4, sharex=True)
    for kind, row in enumerate(panels):
        columns = slice(3 * kind, 3 * kind + 3)
        unit_factor = (100, 180 / np.pi)[kind]
        limit = _limit(
            moved[:, columns] * unit_factor,
            spread[:, columns] * unit_factor,
            calibration.sigmas[columns] * unit_factor,
        )
        for axis, panel in enumerate(row):
            index = 3 * kind + axis
            known = np.isfinite(spread[:, index])
            values, sigma = moved[known, index] * unit_factor, spread[known, index] * unit_factor
            panel.axhline(0, color=MUTED, lw=0.8)
            if known.any():
                panel.fill_between(
                    times[known],
                    _within(values - sigma, limit),
                    _within(values + sigma, limit),
                    color=BAND,
                    alpha=0.2,
                    lw=0,
                )
                _dots(panel, times[known], values, limit)
            else:
                _say(panel, "not revealed\nby this motion")
            panel.set(ylim=(-limit, limit), title=AXES[index], xlim=(0, times[-1] * 1.04))
            if axis:
                panel.set_yticklabels([])
        row[0].set_ylabel(("cm from the result", "deg from the result")[kind])
    for panel in panels[1]:
        panel.set_xlabel(f"drive used ({unit})")
        panel.locator_params(axis="x", nbins=5, prune="upper")
    return figure


def _excitation(calibration, evidence):
    turning = evidence.turning
    if not len(turning.times_s):
        return None
    factor, unit = time_axis(evidence.tracks.times_s[-1])
    shown = _thin(len(turning.times_s), _MOST_ON_A_LINE)
    figure, panels = _figure(4.2, 3, 1, left=0.8, bottom=0.5, between=0.15, top=0.1, sharex=True)
    enough = np.degrees(MIN_ROTATION)
    for index, panel in enumerate(panels):
        values = np.degrees(turning.vectors[shown, index])
        panel.axhspan(-enough, enough, color=MUTED, alpha=0.16, lw=0)
        panel.plot(turning.times_s[shown] * factor, values, color=PARENT, lw=1.2)
        limit = 1.1 * max(np.abs(values).max(), 1.3 * enough)
        panel.set(ylim=(-limit, limit), ylabel=f"{AXES[3 + index]}\nabout {'xyz'[index]} (deg)")
    panels[2].set_xlabel(f"time ({unit})")
    for panel in panels:
        panel.yaxis.set_label_coords(-0.06, 0.5)
    return figure


def _methods(calibration, evidence):
    rows = [("this result", calibration)] + [
        (one.label, one.calibration) for one in evidence.comparison
    ]
    return _rows(calibration, rows) if len(rows) > 1 else None


def _halves(calibration, evidence):
    if len(evidence.halves) < 2:
        return None
    return _rows(
        calibration,
        [("whole drive", calibration)]
        + [(half.label, half.calibration) for half in evidence.halves],
    )


def _rows(calibration, rows):
    """A dot with its error bar for every answer (down) and axis (across), as distances from the
    result.
    """
    longest = max(len(label) for label, _ in rows)
    figure, panels = _figure(
        0.85 + 0.235 * len(rows),
        1,
        6,
        left=0.25 + 0.068 * longest,
        bottom=0.5,
        gap=0.1,
        sharey=True,
    )
    places = np.arange(len(rows))
    moved = np.array(
        [deviation(answer.T_parent_child, calibration.T_parent_child) for _, answer in rows]
    )
    spread = np.array([answer.sigmas for _, answer in rows])
    for index, panel in enumerate(panels):
        unit_factor = 100 if index < 3 else 180 / np.pi
        columns = slice(0, 3) if index < 3 else slice(3, 6)
        limit = _limit(
            moved[:, columns] * unit_factor,
            spread[:, columns] * unit_factor,
            spread[0, columns] * unit_factor,
        )
        values, sigma = moved[:, index] * unit_factor, spread[:, index] * unit_factor
        known = np.isfinite(sigma)
        if known[0]:
            panel.axvspan(-sigma[0], sigma[0], color=BAND, alpha=0.16, lw=0)
        panel.axvline(0, color=MUTED, lw=0.8)
        for place in places[known]:
            colour = INK if place == 0 else PARENT
            ends = _within(
                np.array([values[place] - sigma[place], values[place] + sigma[place]]), limit
            )
            panel.plot(ends, [place, place], color=colour, lw=1.4)
            _dots(panel, values[place : place + 1], None, limit, at=place, colour=colour)
        if not known.any():
            _say(panel, "not\nrevealed")
        panel.set(
            xlim=(-limit, limit),
            ylim=(len(rows) - 0.5, -0.5),
            title=AXES[index],
            xlabel="cm" if index < 3 else "deg",
        )
        panel.set_yticks(places, [_plain(label) for label, _ in rows])
        panel.tick_params(axis="y", length=0)
        tick = float(f"{0.75 * limit:.0e}")
        panel.set_xticks([-tick, 0, tick], [f"{-tick:g}", "0", f"{tick:g}"])
        panel.grid(axis="y", visible=False)
        panel.spines["left"].set_visible(False)
    return figure


def _streams(seen, names):
    factor, unit = time_axis(max(times[-1] if len(times) else 0.0 for times, _ in seen.rates))
    figure = Figure(figsize=(WIDTH, 6.6))

    def panel(left, bottom, width, height, **options):
        return figure.add_axes((left / WIDTH, bottom / 6.6, width / WIDTH, height / 6.6), **options)

    across = WIDTH - 0.8 - 0.12
    speed = panel(0.8, 4.6, across, 1.7)
    strip = panel(0.8, 4.15, across, 0.32, sharex=speed)
    looks = ((PARENT, "-", 2.6), (CHILD, "-", 1.0))
    for row, ((times, rates), spans, name, (colour, dashes, width)) in enumerate(
        zip(seen.rates, seen.spans_s, names, looks, strict=True)
    ):
        speed.plot(
            times * factor, np.degrees(rates), color=colour, ls=dashes, lw=width, label=_plain(name)
        )
        strip.broken_barh(
            [(start * factor, (end - start) * factor) for start, end in spans],
            (0.6 - row, 0.8),
            color=colour,
            lw=0,
        )
    speed.set(ylabel="turning (deg/s)", ylim=(0, None))
    speed.tick_params(labelbottom=False)
    speed.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, borderaxespad=0)
    strip.set(xlabel=f"time ({unit})", ylim=(-0.6, 1.6))
    strip.set_yticks([1.0, 0.0], ["parent", "child"])
    strip.tick_params(axis="y", length=0)
    strip.grid(visible=False)
    wide = (across - 0.75) / 2
    below = [panel(0.8 + column * (wide + 0.75), 0.55, wide, 2.9) for column in range(2)]
    below[0].set(
        title=f"Angle of motions over {seen.lag_s:g} s", xlabel="parent (deg)", ylabel="child (deg)"
    )
    below[1].set(title="How far they go along their axis", xlabel="parent (m)", ylabel="child (m)")
    _identity(below[0], np.degrees(seen.angles))
    # On flat ground nothing moves along the axis, and noise should not look like motion.
    _identity(below[1], seen.slides, _NOISE_SHARE * seen.moved_m)
    return figure


def _identity(panel, values, least=0.0):
    """Dots of the child's values over the parent's, and the line they should be on; the axes reach
    to ``least`` at least.
    """
    if not len(values):
        return _say(panel, "nothing to compare")
    reach = max(1.15 * float(np.percentile(np.abs(values), 99)), least, 1e-6)
    low = -reach if values.min() < 0 else 0.0
    panel.plot([low, reach], [low, reach], color=MUTED, lw=1.0, ls="--", zorder=1)
    beyond = (np.abs(values) > reach).any(axis=1)
    panel.plot(*values[~beyond].T, "o", color=PARENT, ms=3.2, mew=0, alpha=0.5)
    panel.plot(
        *np.clip(values[beyond], low, reach).T, "x", color=BAD, ms=5.5, mew=1.5, clip_on=False
    )
    panel.set(xlim=(low, reach), ylim=(low, reach))


def _dots(panel, first, second, limit, at=None, colour=PARENT):
    """Dots where they are within the limit, triangles at the edge where they are beyond."""
    if at is None:  # across time
        beyond = np.abs(second) > limit
        panel.plot(first, _within(second, limit), "-", color=colour, lw=1.3)
        panel.plot(first[~beyond], second[~beyond], "o", color=colour, ms=4)
        for sign, marker in ((1, "^"), (-1, "v")):
            out = beyond & (np.sign(second) == sign)
            panel.plot(first[out], np.full(out.sum(), sign * limit * 0.94), marker, color=BAD, ms=6)
        return
    value = float(first[0])
    if abs(value) > limit:
        panel.plot(np.sign(value) * limit * 0.9, at, ">" if value > 0 else "<", color=BAD, ms=6)
    else:
        panel.plot(value, at, "o", color=colour, ms=4.5)


def _limit(values, spread, result):
    """How far an axis reaches: all that is reasonably near, and what is far off is shown at the
    edge.
    """
    known = np.isfinite(spread)
    if not known.any():
        return 1.0
    reach = (np.abs(values) + spread)[known]
    nearest = 4 * np.max(result[np.isfinite(result)], initial=0.0)
    return float(max(1.25 * np.percentile(reach, 70), nearest, 1e-3))


def _within(values, limit):
    return np.clip(values, -limit, limit)


def _magnitude_axis(panel, values):
    """From zero; logarithmic where the largest would hide the others."""
    if values.max() > 15 * np.median(values):
        panel.set_yscale("log")
        plain_decades(panel.yaxis)
    else:
        panel.set_ylim(0, 1.08 * values.max())


def _say(panel, text):
    panel.text(0.5, 0.5, text, transform=panel.transAxes, ha="center", va="center", color=MUTED)


def _plain(label):
    """A name that matplotlib takes as it is: no formulas, and no leading underscore, which would
    hide it from the legend.
    """
    text = label.replace("$", r"\$")
    return f"\u200b{text}" if text.startswith("_") else text


def _thin(count, most):
    """Indices of at most ``most`` of so many points, first and last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def _sample(indices, most):
    """Some of the indices, evenly."""
    return indices[_thin(len(indices), most)] if len(indices) else indices
