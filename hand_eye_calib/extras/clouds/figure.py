"""Draw the merged clouds of both sensors from above and from the side, before and after."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from hand_eye_calib.core.assessment.comparison import installed_transform
from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.base.text import angle, length, share
from hand_eye_calib.core.engine.snapshot import Snapshot
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.extras.clouds.merging import (
    MergedClouds,
    distances_from_surfaces,
    merge,
)
from hand_eye_calib.offline.report.style import (
    CHILD,
    PARENT,
    Drawn,
    as_drawn,
    make_panels,
    page_style,
    plain_label,
)

# Half the thickness (m) of the slice of the view from the side.
_HALF_SLICE_M = 1.5
# The view from above contains points that are higher above the ground than this (m). Rings on the
# ground would hide the walls.
_ABOVE_GROUND_M = 0.5
# Share of the points that may be outside a view, at each end of each axis.
_OUTSIDE = 0.01
# Number of cells along an axis of a view. Each cell has at most one dot.
_CELLS = 250
# Smallest share of the child's points near surfaces of the parent. With less, the clouds hardly
# overlap, and their distance has no meaning.
_MIN_SHARED = 0.05


def figures_of_clouds(
    calibration: Calibration, snapshot: Snapshot | None, suffix: str = ""
) -> list[Drawn]:
    """Return the figure of the merged clouds as a list, which is empty without clouds.

    The name of the figure ends in ``suffix``. If the clouds cannot be read, the figure is a text
    with the reason.
    """
    if snapshot is None or calibration.has_failed:
        return []
    try:
        merged = merge(calibration, snapshot)
    except InputError as error:
        caption = f"The clouds cannot be read: {error}."
        return [Drawn(f"clouds{suffix}", _title(calibration), caption, "")]
    return (
        []
        if merged is None
        else [_drawn(calibration, merged, f"clouds{suffix}")]
    )


def _title(calibration: Calibration) -> str:
    return f"Clouds of {calibration.parent_frame} and {calibration.child_frame}, merged"


@page_style()
def _drawn(calibration: Calibration, merged: MergedClouds, name: str) -> Drawn:
    """Draw two views from above and two from the side: before at the left, after at the right."""
    figure, panels = make_panels(5.3, 2, 2, gap=0.12, height_ratios=(2.6, 1.0))
    has_installed = installed_transform(calibration) is not None
    titles = ("Before: as installed" if has_installed else "Before", "After")
    is_parent_tall, is_child_tall = _above_ground(merged)
    tall = merged.parent[is_parent_tall]
    limits = np.quantile(
        np.vstack([tall, merged.after[is_child_tall]]),
        (_OUTSIDE, 1 - _OUTSIDE),
        axis=0,
    )
    # A margin of 5 %, and at least half a metre for heights.
    margin = np.maximum(0.05 * np.ptp(limits, axis=0), 0.5)
    low = limits[0] - margin
    high = limits[1] + margin
    # The ground is in the view from the side.
    low[2] = min(low[2], np.quantile(merged.parent[:, 2], _OUTSIDE) - margin[2])
    panel_inches = np.multiply(
        panels[0].get_position().size, figure.get_size_inches()
    )
    above, side = panels[:2], panels[2:]
    low[:2], high[:2] = _with_equal_scales(panel_inches, low[:2], high[:2])
    for column, child in enumerate((merged.before, merged.after)):
        above[column].set(title=titles[column])
        _draw_view(
            above[column], (tall, child[is_child_tall]), (0, 1), low, high
        )
        slices = (_slice(merged.parent), _slice(child))
        _draw_view(side[column], slices, (0, 2), low, high)
        side[column].set_xlabel("x (m)")
    names = ("along z", "along y")
    if merged.is_upright:
        names = ("from above", "from the side")
    above[0].set_ylabel(f"{names[0]}: y (m)")
    side[0].set_ylabel(f"{names[1]}: z (m)")
    lines = []
    for colour, sensor in (
        (PARENT, calibration.parent_frame),
        (CHILD, calibration.child_frame),
    ):
        lines.append(Line2D([], [], color=colour, label=plain_label(sensor)))
    caption = _caption(calibration, merged)
    drawn = as_drawn(figure, name, _title(calibration), caption, lines)
    # A dot is a line of zero length: "M x y L x y" becomes the shorter "Mx yh0".
    svg = re.sub(r"M ([\d.-]+ [\d.-]+) \nL \1 \n?", r"M\1h0", drawn.svg)
    return replace(drawn, svg=svg)


def _with_equal_scales(
    panel_inches: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return wider limits (2,) of a view, so that both of its axes have one scale."""
    half = float(np.max((high - low) / panel_inches)) * panel_inches / 2
    center = (low + high) / 2
    return center - half, center + half


def _above_ground(merged: MergedClouds) -> tuple[BoolArray, BoolArray]:
    """Return which points of parent and child (through the result) are above the ground.

    If the axes of the picture are not upright, or nothing is on the ground, all points count as
    above.
    """
    heights = np.r_[merged.parent[:, 2], merged.after[:, 2]]
    bins = np.floor((heights - heights.min()) / _ABOVE_GROUND_M).astype(int)
    # The bin with most points is the ground.
    ground_m = np.median(heights[bins == np.bincount(bins).argmax()])
    is_above = heights > ground_m + _ABOVE_GROUND_M
    if not merged.is_upright or is_above.mean() < _MIN_SHARED:
        is_above[:] = True
    n_parent = len(merged.parent)
    return is_above[:n_parent], is_above[n_parent:]


def _slice(points: FloatArray) -> FloatArray:
    """Return the points (N, 3) of the slice of the view from the side."""
    return points[np.abs(points[:, 1]) < _HALF_SLICE_M]


def _draw_view(
    panel: Axes,
    clouds: Sequence[FloatArray],
    axes: Sequence[int],
    low: FloatArray,
    high: FloatArray,
) -> None:
    """Draw the clouds (N, 3) of parent and child between two corners (3,).

    ``axes`` are the two axes of the view, to the right and upwards.
    """
    axes = list(axes)
    panel.set(
        xlim=(low[axes[0]], high[axes[0]]),
        ylim=(low[axes[1]], high[axes[1]]),
    )
    cell_m = (high - low)[axes] / _CELLS
    # Thin dots of the child are drawn on thick dots of the parent, so that both colours are visible
    # on one wall.
    looks = ((PARENT, 2.4), (CHILD, 1.1))
    for points, (colour, width) in zip(clouds, looks, strict=True):
        plane = points[:, axes]
        is_in_view = ((plane > low[axes]) & (plane < high[axes])).all(axis=1)
        cells = np.unique(np.round(plane[is_in_view] / cell_m), axis=0) * cell_m
        if len(cells):
            codes = np.tile([Outline.MOVETO, Outline.LINETO], len(cells))
            dots = Outline(np.repeat(cells, 2, axis=0), codes)
            panel.add_patch(
                PathPatch(dots, ec=colour, lw=width, capstyle="round")
            )


def _caption(calibration: Calibration, merged: MergedClouds) -> str:
    """Return a caption with what to look for, and the distances of the clouds before and after."""
    parent = calibration.parent_frame
    child = calibration.child_frame
    before = "as installed"
    if installed_transform(calibration) is None:
        before = "as if both sensors had one pose"
    text = (
        f"A few scans of both sensors, placed by the poses of {parent}, which turned by "
        f"{angle(merged.turn_rad)} between them. The left picture is {before}, the right picture "
        "uses the result: there, each wall should be one thin line of both colours."
    )
    after_m = distances_from_surfaces(merged.parent, merged.after)
    shared = float(np.isfinite(after_m).mean())
    if shared < _MIN_SHARED:
        return (
            f"{text} But only {share(shared)} of the points of {child} are near surfaces of "
            f"{parent}: the clouds hardly overlap, and the picture proves nothing."
        )
    before_m = distances_from_surfaces(merged.parent, merged.before)
    before_m = before_m[np.isfinite(before_m)]
    text += (
        f" {share(shared)} of the points of {child} are near surfaces of {parent}, half of them "
        f"within {length(median(after_m[np.isfinite(after_m)]))}"
    )
    if len(before_m):
        text += f"; before, within {length(median(before_m))}"
    return f"{text}."
