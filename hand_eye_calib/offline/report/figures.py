"""Draw the figures of the report, each with a caption in words and numbers.

A caption states values and does not judge them. Only the verdict judges, by its own rules.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.base.text import amount, angle, length, listing, share
from hand_eye_calib.core.results.calibration import Calibration, Verdict
from hand_eye_calib.core.results.records import Residuals
from hand_eye_calib.offline.report.evidence import (
    Evidence,
    StreamView,
    moved_onto,
    turning_part,
)
from hand_eye_calib.offline.report.style import (
    BAD,
    CHILD,
    INK,
    LOOK,
    MUTED,
    PARENT,
    Drawn,
    as_drawn,
    make_panels,
    page_style,
    plain_label,
)
from hand_eye_calib.offline.report.views import (
    VIEWS,
    VIEWS_OF_VEHICLE,
    figure_of_views,
)

# Factor from SI units to the unit of a figure, and label of its axis, for translations ("x") and
# rotations ("yaw").
UNITS = {
    "x": (100.0, "translation (cm)"),
    "yaw": (180 / np.pi, "rotation (deg)"),
}
# The same for the stops of an arm, because their table has millimetres.
_UNITS_OF_STOPS = {**UNITS, "x": (1000.0, "translation (mm)")}

_AXIS_LABELS = ("x (m)", "y (m)", "z (m)")

# Why the rates of both streams must coincide, by the quantity that is drawn.
_WHY_EQUAL = {
    "angular rate": "Two sensors on one rigid body have the same angular rate at every moment, "
    "however they are mounted: the two curves must coincide, up to the bias of a gyroscope.",
    "speed": "Two points of one rigid body have the same speed while it does not rotate: the two "
    "curves must rise and fall together.",
}


class _Curve(NamedTuple):
    """Curves of one colour in six panels: columns (N, 6), colour, width of the line, and name."""

    columns: FloatArray
    colour: str
    width: float
    name: str


def figures_of(
    calibration: Calibration, evidence: Evidence | None
) -> list[Drawn]:
    """Draw all figures of a result; ``evidence`` is None for the stops of an arm."""
    figures = []
    titles = _titles_of_views(evidence)
    if calibration.reference == "windows":
        # The path of the wheels has nominal radii, so it is not comparable.
        evidence = None
    if calibration.measured != "rotations":
        figures.append(figure_of_views([calibration], titles))
        if evidence and evidence.without_lever_arm is not None:
            figures.append(
                _figure_of_track(
                    calibration, evidence, evidence.without_lever_arm
                )
            )
        if evidence:
            figures.append(_figure_of_paths(calibration, evidence))
        if "stops" in calibration.parts:
            figures.append(_figure_of_stops(calibration))
    if evidence and evidence.angles is not None:
        figures.append(_figure_of_coordinates(calibration, evidence))
    if evidence and evidence.without_lever_arm is not None:
        figures.append(
            _figure_of_positions(
                calibration, evidence, evidence.without_lever_arm
            )
        )
    if calibration.motion_residuals:
        figures.append(
            _figure_of_residuals(calibration, calibration.motion_residuals)
        )
    if evidence:
        names = (calibration.parent_frame, calibration.child_frame)
        figures.append(figure_of_streams(evidence.streams, names))
    return figures


def _titles_of_views(evidence: Evidence | None) -> dict[str, str]:
    """Return the titles of the three views. They name directions of a vehicle only for vehicles."""
    if evidence is None or not evidence.is_upright:
        return VIEWS
    if evidence.excitation.has_vehicle_axes:
        return VIEWS_OF_VEHICLE
    return VIEWS | {"xy": VIEWS_OF_VEHICLE["xy"]}


@page_style()
def _figure_of_stops(calibration: Calibration) -> Drawn:
    """Draw position and viewing direction of the child at all stops, in the child's world."""
    rows = calibration.parts["stops"].rows
    positions = np.array([row.position_m for row in rows])
    directions = np.array([row.direction for row in rows])
    is_used = np.array([row.is_used for row in rows])
    # Length of the line of a viewing direction: a quarter of the median distance.
    line_m = 0.25 * float(np.median(np.linalg.norm(positions, axis=1)))
    child = calibration.child_frame
    world = calibration.parts["worlds"].child_world_frame
    figure, panels = make_panels(3.25, 1, 3, gap=0.36)
    for panel, (axes, title) in zip(panels, VIEWS.items(), strict=True):
        columns = ["xyz".index(axis) for axis in axes]
        points = positions[:, columns]
        ends = (positions + line_m * directions)[:, columns]
        # (2, 2, N): axis of the view, start or end, stop. Each stop is a separate line.
        directed = np.stack([points, ends], axis=1).T
        panel.plot(*directed, color=MUTED, lw=0.7)
        panel.plot(
            *points[is_used].T,
            "o",
            color=CHILD,
            ms=3.5,
            label=plain_label(child),
        )
        if not is_used.all():
            panel.plot(
                *points[~is_used].T, "x", color=BAD, ms=5.5, label="left out"
            )
        panel.plot(0.0, 0.0, "s", color=PARENT, ms=6, label=plain_label(world))
        panel.set(xlabel=f"{axes[0]} (m)", ylabel=f"{axes[1]} (m)", title=title)
        panel.set_aspect("equal", adjustable="datalim")
    lines, _ = panels[0].get_legend_handles_labels()
    caption = (
        f"Places of {child} at the {len(rows)} stops in the axes of {world}; a line is the viewing "
        f"direction (z of {child}). Good stops view {world} from several sides."
    )
    return as_drawn(figure, "stops", "The stops", caption, lines)


@page_style()
def figure_of_streams(view: StreamView, names: tuple[str, str]) -> Drawn:
    """Draw the rates of both streams over time before the solve, and bars where poses exist.

    ``names`` are the names of parent and child.
    """
    is_speed = view.quantity == "speed"
    ends_s = [times_s[-1] for times_s, _ in view.rates if len(times_s)]
    factor, unit = _time_axis(max(ends_s, default=0.0))
    figure, (curves, strip) = make_panels(
        3.0, 2, 1, sharex=True, height_ratios=(5, 1)
    )
    looks = ((PARENT, 2.6), (CHILD, 1.0))
    streams = zip(view.rates, view.spans_s, names, looks, strict=True)
    for row, ((times_s, rates), spans_s, name, (colour, width)) in enumerate(
        streams
    ):
        values = rates if is_speed else np.degrees(rates)
        curves.plot(
            times_s * factor,
            values,
            color=colour,
            lw=width,
            label=plain_label(name),
        )
        # A bar has its start and its length.
        bars = [
            (start_s * factor, (end_s - start_s) * factor)
            for start_s, end_s in spans_s
        ]
        strip.broken_barh(bars, (0.6 - row, 0.8), color=colour, lw=0)
    curves.set(
        ylabel="speed (m/s)" if is_speed else "angular rate (deg/s)",
        ylim=(0, None),
    )
    strip.set(ylim=(-0.6, 1.6), xlabel=f"time ({unit})")
    strip.set_yticks([1.0, 0.0], ["parent", "child"])
    strip.tick_params(axis="y", length=0)
    strip.grid(visible=False)
    comparison = "Here the streams never overlap."
    if np.isfinite(view.difference):
        difference = (
            length(view.difference) if is_speed else angle(view.difference)
        )
        comparison = f"Here the rates differ by less than {difference}/s half of the time."
    caption = (
        f"{_WHY_EQUAL[view.quantity]} {comparison} The bars below the curves show when there is "
        "data."
    )
    lines, _ = curves.get_legend_handles_labels()
    return as_drawn(
        figure, "streams", "Both streams before any solve", caption, lines
    )


def _axes_of_motion(positions: FloatArray) -> tuple[int, int, int]:
    """Return both axes of the plane of motion of positions (N, 3), and the axis across this plane.

    The axis with the least motion is across the plane: z on a vehicle, y for a camera.
    """
    across = int(np.argmin(np.ptp(positions, axis=0)))
    first, second = (axis for axis in range(3) if axis != across)
    return first, second, across


def _name_plane(plane: Axes, first: int, second: int) -> None:
    """Set the title of the panel of two axes, and name these axes."""
    is_level = (first, second) == (0, 1)
    plane.set(title="From above" if is_level else "In the plane of motion")
    plane.set(xlabel=_AXIS_LABELS[first], ylabel=_AXIS_LABELS[second])
    plane.set_aspect("equal", adjustable="datalim")


@page_style()
def _figure_of_paths(calibration: Calibration, evidence: Evidence) -> Drawn:
    """Draw both paths of a sensor: in the plane of motion, and across this plane over time."""
    rows = evenly_spaced_rows(len(evidence.times_s))
    factor, unit = _time_axis(evidence.times_s[-1])
    first, second, across = _axes_of_motion(evidence.parent)
    figure, (plane, side) = make_panels(3.75, 1, 2)
    parent = calibration.parent_frame
    child = calibration.child_frame
    # One path is measured by a sensor. The other path of the same sensor is computed from the other
    # sensor's poses and the result.
    if (
        calibration.measured == "positions"
        and not evidence.has_positions_of_parent
    ):
        own, other = child, parent
        labels = (f"{parent}, through the result", child)
    else:
        own, other = parent, child
        labels = (parent, f"{child}, through the result")
    paths = ((evidence.parent, PARENT, 3.2), (evidence.child, CHILD, 1.1))
    for (path, colour, width), label in zip(paths, labels, strict=True):
        points = path[rows]
        look: Document = {"color": colour, "lw": width}
        plane.plot(
            points[:, first],
            points[:, second],
            label=plain_label(label),
            **look,
        )
        side.plot(evidence.times_s[rows] * factor, points[:, across], **look)
    plane.plot(*evidence.parent[0, [first, second]], "o", color=INK, ms=6)
    _name_plane(plane, first, second)
    side.set(title="Height" if across == 2 else "Across the plane of motion")
    side.set(xlabel=f"time ({unit})", ylabel=_AXIS_LABELS[across])
    # Show at least half a metre. Otherwise rounding would look like hills on a flat road.
    low, high = side.get_ylim()
    if high - low < 0.5:
        side.set_ylim((low + high) / 2 - 0.25, (low + high) / 2 + 0.25)
    distances_m = np.linalg.norm(evidence.parent - evidence.child, axis=1)
    farthest_s = evidence.times_s[int(np.argmax(distances_m))]
    caption = (
        f"The path of {own}, and the same path computed from the poses of "
        f"{other} and the result. Half of the time both paths are within "
        f"{length(float(np.median(distances_m)))} of each other. The largest distance is "
        f"{length(distances_m.max())}, at {farthest_s * factor:.1f} {unit}."
    )
    if calibration.verdict is not Verdict.DO_NOT_USE:
        caption += (
            " These distances are mostly drift and jumps of the odometry, not an error of the "
            "result."
        )
    caption += " The dot is the start."
    lines, _ = plane.get_legend_handles_labels()
    title = "Both trajectories, aligned"
    return as_drawn(figure, "trajectories", title, caption, lines)


def _figure_of_columns(
    evidence: Evidence, labels: Sequence[str], curves: Sequence[_Curve]
) -> tuple[Figure, list[Any]]:
    """Draw six columns over time: the first three in the left panels, the others in the right.

    ``labels`` are those of the vertical axes. Return the figure and a line of each curve.
    """
    rows = evenly_spaced_rows(len(evidence.times_s), LOOK.max_coordinate_points)
    factor, unit = _time_axis(evidence.times_s[-1])
    times = evidence.times_s[rows] * factor
    figure, panels = make_panels(5.1, 3, 2, sharex=True)
    for column, label in enumerate(labels):
        panel = panels[2 * (column % 3) + column // 3]
        for curve in curves:
            values = curve.columns[rows, column]
            name = plain_label(curve.name)
            panel.plot(
                times, values, color=curve.colour, lw=curve.width, label=name
            )
        panel.set_ylabel(label, labelpad=2)
    for panel in panels[-2:]:
        panel.set_xlabel(f"time ({unit})")
    lines, _ = panels[0].get_legend_handles_labels()
    return figure, lines


@page_style()
def _figure_of_coordinates(
    calibration: Calibration, evidence: Evidence
) -> Drawn:
    """Draw position and turned angles of the parent over time, from both streams."""
    assert evidence.angles is not None
    measured = np.hstack([evidence.parent, np.degrees(evidence.angles[0])])
    computed = np.hstack([evidence.child, np.degrees(evidence.angles[1])])
    labels = (
        "x (m)",
        "y (m)",
        "z (m)",
        "about x (deg)",
        "about y (deg)",
        "about z (deg)",
    )
    parent = calibration.parent_frame
    child = calibration.child_frame
    curves = (
        _Curve(measured, PARENT, 3.2, parent),
        _Curve(computed, CHILD, 1.1, f"{child}, through the result"),
    )
    figure, lines = _figure_of_columns(evidence, labels, curves)
    distances_m = np.linalg.norm(evidence.child - evidence.parent, axis=1)
    angles_rad = np.linalg.norm(evidence.angles[1] - evidence.angles[0], axis=1)
    caption = (
        f"Position of {parent}, and the angles by which it has turned about its own axes since the "
        f"first pose: as measured, and computed from the poses of {child} and the result. Half of "
        f"the time, both poses differ by less than {length(float(np.median(distances_m)))} and "
        f"{angle(float(np.median(angles_rad)))}. The differences include drift."
    )
    title = "Both streams over time, aligned"
    return as_drawn(figure, "coordinates", title, caption, lines)


class _Positions(NamedTuple):
    """Measured and computed positions (N, 3), m, and the names of both sensors.

    ``sensor`` has measured the positions. They are computed from the poses of ``other``.
    """

    measured: FloatArray
    computed: FloatArray
    sensor: str
    other: str

    @classmethod
    def of(cls, calibration: Calibration, evidence: Evidence) -> "_Positions":
        child = calibration.child_frame
        parent = calibration.parent_frame
        if evidence.has_positions_of_parent:
            return cls(evidence.parent, evidence.child, parent, child)
        return cls(evidence.child, evidence.parent, child, parent)


@page_style()
def _figure_of_track(
    calibration: Calibration, evidence: Evidence, without_lever_arm: FloatArray
) -> Drawn:
    """Draw the sharpest turn of the track enlarged, and distances from computed positions.

    ``without_lever_arm`` (N, 3) are the positions of the other sensor, m. In the turn, both
    computed paths are fitted to the measured path, so that drift is not visible.
    """
    measured, computed, sensor, other = _Positions.of(calibration, evidence)
    part = turning_part(measured, evidence.times_s, LOOK.min_turn_s)
    turn = measured[part]
    colours = (CHILD, PARENT)
    if evidence.has_positions_of_parent:
        colours = (PARENT, CHILD)
    unmoved = moved_onto(turn, without_lever_arm[part])
    moved = moved_onto(turn, computed[part])
    paths = (
        (unmoved, MUTED, f"{other}, no lever arm"),
        (moved, colours[1], f"{other}, through the result"),
    )
    factor, unit = _time_axis(evidence.times_s[-1])
    times = evidence.times_s[part] * factor
    first, second, _ = _axes_of_motion(measured)
    figure, (plane, side) = make_panels(3.75, 1, 2)
    distances = []
    for path, colour, label in paths:
        plane.plot(
            path[:, first],
            path[:, second],
            color=colour,
            label=plain_label(label),
        )
        distances_m = np.linalg.norm(path - turn, axis=1)
        distances.append(length(float(np.median(distances_m))))
        side.plot(times, 100 * distances_m, color=colour)
    rows = evenly_spaced_rows(len(turn), LOOK.max_dots)
    dots = turn[rows]
    plane.plot(
        dots[:, first],
        dots[:, second],
        "o",
        color=colours[0],
        ms=3.5,
        label=plain_label(sensor),
    )
    _name_plane(plane, first, second)
    side.set(title="Distance from the measured positions")
    side.set(xlabel=f"time ({unit})", ylabel="distance (cm)", ylim=(0, None))
    caption = (
        f"A turn of the track, enlarged. Dots: measured positions of {sensor}. The line "
        f"computed from the poses of {other} and the result should go through the dots. Half of "
        f"the dots are within {distances[1]} of this line; without a lever arm, within "
        f"{distances[0]}."
    )
    lines, _ = plane.get_legend_handles_labels()
    return as_drawn(figure, "track", "The positions in a turn", caption, lines)


@page_style()
def _figure_of_positions(
    calibration: Calibration, evidence: Evidence, without_lever_arm: FloatArray
) -> Drawn:
    """Draw the measured positions over time, and their differences from computed positions.

    There are two differences: with the result, and ``without_lever_arm`` (N, 3), m.
    """
    measured, computed, sensor, other = _Positions.of(calibration, evidence)
    before = without_lever_arm - measured
    after = computed - measured
    nothing = np.full_like(measured, np.nan)
    labels = [
        f"{axis} ({unit})" for unit in ("m", "difference, m") for axis in "xyz"
    ]
    curves = (
        _Curve(np.hstack([measured, nothing]), PARENT, 1.6, "measured"),
        _Curve(np.hstack([nothing, before]), MUTED, 1.0, "without lever arm"),
        _Curve(np.hstack([nothing, after]), CHILD, 1.2, "with the result"),
    )
    figure, lines = _figure_of_columns(evidence, labels, curves)
    before_m = length(float(np.median(np.linalg.norm(before, axis=1))))
    after_m = length(float(np.median(np.linalg.norm(after, axis=1))))
    caption = (
        f"Left: the measured positions of {sensor}. Right: the positions computed from the poses "
        f"of {other}, minus the measured positions. Half of the differences are below {after_m} "
        f"with the result, and below {before_m} without a lever arm. They include drift."
    )
    title = "Positions over time, before and after"
    return as_drawn(figure, "coordinates", title, caption, lines)


@page_style()
def _figure_of_residuals(
    calibration: Calibration, residuals: Residuals
) -> Drawn:
    """Draw the sizes of the residuals of a result, translations above rotations."""
    # The keys are those of UNITS. Streams without positions, or without orientations, have one kind
    # only.
    sizes = {"x": residuals.translation_m, "yaw": residuals.rotation_rad}
    if calibration.measured == "rotations":
        del sizes["x"]
    if calibration.measured == "positions":
        del sizes["yaw"]
    units = UNITS
    if calibration.reference == "stops":
        units = _UNITS_OF_STOPS
        is_out = residuals.weights == 0.0
        name_of_outlier = outliers = "left out"
        items = "stops"
        times = np.arange(1.0, len(residuals) + 1)
        label = "stop"
    else:
        is_out = ~residuals.is_inlier
        name_of_outlier = "outlier"
        outliers = "outliers"
        items = "motion pairs"
        if calibration.measured == "positions":
            items = "distances from one position to the next"
        first_ns = residuals.start_ns.min(initial=residuals.end_ns[0])
        times_s = (residuals.end_ns - first_ns) * 1e-9
        factor, unit = _time_axis(float(times_s.max()))
        times = times_s * factor
        label = f"time ({unit})"
    figure, panels = make_panels(
        0.9 + 1.6 * len(sizes), len(sizes), 1, sharex=True
    )
    for panel, (axis, values) in zip(panels, sizes.items(), strict=True):
        to_unit, unit_label = units[axis]
        # A logarithmic axis needs positive values.
        shown = np.maximum(values * to_unit, 1e-5)
        _draw_residuals(panel, times, shown, is_out, name_of_outlier)
        panel.set_ylabel(unit_label)
    panels[-1].set_xlabel(label)
    lines, _ = panels[0].get_legend_handles_labels()
    medians = [
        amount(axis, float(np.median(values))) for axis, values in sizes.items()
    ]
    largest = [
        amount(axis, float(np.max(values))) for axis, values in sizes.items()
    ]
    n_out = "None"
    if is_out.any():
        n_out = f"{is_out.sum():,} ({share(float(is_out.mean()))})"
    caption = (
        f"Half of the {len(residuals):,} {items} agree with the result to {listing(medians)}, all "
        f"of them to {listing(largest)}. {n_out} of them are {outliers}."
    )
    return as_drawn(figure, "residuals", "Residuals", caption, lines)


def _draw_residuals(
    panel: Axes,
    times: FloatArray,
    values: FloatArray,
    is_out: BoolArray,
    name_of_outlier: str,
) -> None:
    """Draw the sizes (K,) of residuals, all positive, and mark the outliers.

    If there are too many points, every n-th used residual and the largest outliers are drawn.
    """
    dots = np.flatnonzero(~is_out)
    crosses = np.flatnonzero(is_out)
    dots = dots[evenly_spaced_rows(len(dots))]
    crosses = crosses[np.argsort(-values[crosses])[: LOOK.max_points]]
    used = (times[dots], values[dots], "o")
    marked = (times[crosses], values[crosses], "x")
    panel.plot(*used, color=PARENT, ms=2.6, mew=0, alpha=0.65, label="used")
    panel.plot(*marked, color=BAD, ms=5.5, mew=1.5, label=name_of_outlier)
    panel.axhline(
        np.median(values), color=INK, lw=1.0, ls="--", label="median of all"
    )
    panel.yaxis.set_label_coords(-0.06, 0.5)
    # On a linear axis, a very large residual would hide all others.
    if values.max() > 15 * np.median(values):
        panel.set_yscale("log")
        panel.yaxis.set_major_formatter("{x:g}")
        panel.minorticks_off()
    else:
        panel.set_ylim(0, 1.08 * values.max())


def _time_axis(duration_s: float) -> tuple[float, str]:
    """Return the factor from seconds to the unit of a time axis, and the name of the unit."""
    return (1.0, "s") if duration_s < 300 else (1 / 60, "min")


def evenly_spaced_rows(
    count: int, max_points: int = LOOK.max_points
) -> IntArray:
    """Return indices of evenly spaced points of ``count``, with the first and the last point."""
    n_points = min(count, max_points)
    rows = np.linspace(0, count - 1, n_points).round().astype(int)
    return np.unique(rows)
