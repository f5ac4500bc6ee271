"""Draw the sensors of a result from three sides, with the uncertainty of their positions.

:func:`plot` is the public function; the report has the same three views as a figure.
"""

import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.text import Annotation

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import InputError, require_type
from hand_eye_calib.core.base.text import listing
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.offline.report.evidence import spread_of_position
from hand_eye_calib.offline.report.style import (
    BAD,
    CHILD,
    GREEN,
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

# Longest name of a sensor that fits into a view, in characters.
_MAX_NAME = 14

# The three views, with their titles. The key has the parent's axes to the right and upwards. The
# title has the axis along which the reader looks.
VIEWS = {"xy": "along z", "xz": "along y", "yz": "along x"}
# Titles for a vehicle, with x forward and z up.
VIEWS_OF_VEHICLE = {
    "xy": "from above",
    "xz": "from the side",
    "yz": "from the front",
}


class NotebookFigure(Figure):
    """A figure that notebooks display without pyplot."""

    def _repr_png_(self) -> bytes:
        """Return the figure as PNG; notebooks call this method."""
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
        Axes to draw into. By default a new figure is made.

    Returns
    -------
    matplotlib.figure.Figure
        The figure of ``ax``, or a new one. Notebooks display it; its method ``savefig`` writes a
        file.

    Raises
    ------
    InputError
        If ``calibration`` is not a Calibration, or ``ax`` does not have three axes.

    Examples
    --------
    >>> hec.plot(result).savefig("result.png")
    """
    require_type("the result", calibration, Calibration)
    if ax is not None:
        if np.size(ax) != len(VIEWS):
            raise InputError(
                f"ax must be three axes of Matplotlib; got {type(ax).__name__}"
            )
        draw_views(ax, calibration)
        return ax[0].figure
    with page_style(figure_facecolor="white", savefig_facecolor="white"):
        figure = NotebookFigure(figsize=(LOOK.width, 3.3), layout="constrained")
        FigureCanvasAgg(figure)
        draw_views(figure.subplots(1, 3), calibration)
        figure.suptitle(
            calibration.headline, fontsize=8, fontweight="bold", wrap=True
        )
        figure.supxlabel(caption_of_views(calibration), fontsize=7.5, wrap=True)
    return figure


def caption_of_views(*calibrations: Calibration) -> str:
    """Return the caption of the three views: colours of axes, ellipses and dashed lines."""
    sigmas = np.array([calibration.sigmas[:3] for calibration in calibrations])
    is_finite = np.isfinite(sigmas)
    text = "Axes of all sensors: x red, y green, z blue."
    if is_finite.any():
        text += (
            f" Ellipse: {LOOK.sigmas:g} standard deviations of the position."
        )
    unknown = np.array([*"xyz"])[~is_finite.all(axis=0)].tolist()
    if unknown:
        text += f" Unknown along {listing(unknown)}: the dashed line."
    return text


def draw_views(
    panels: Sequence[Axes],
    *calibrations: Calibration,
    titles: Mapping[str, str] = VIEWS,
) -> None:
    """Draw the parent sensor and all child sensors in its frame, with one view per panel.

    Several calibrations have the same parent sensor. ``titles`` has the keys of :data:`VIEWS`.
    """
    distances = [
        float(np.linalg.norm(calibration.translation))
        for calibration in calibrations
    ]
    axis_m = LOOK.axis_share * max(*distances, LOOK.min_distance_m)
    parent = _short_name(calibrations[0].parent_frame, "parent")
    is_pair = len(calibrations) == 1
    children = [
        _short_name(calibration.child_frame, "child" if is_pair else "")
        for calibration in calibrations
    ]
    for panel, (axes, title) in zip(panels, titles.items(), strict=True):
        rows = ["xyz".index(axis) for axis in axes]
        _draw_sensor(
            panel,
            np.eye(4)[rows],
            parent,
            PARENT,
            axis_m,
            6,
        )
        for calibration, child in zip(calibrations, children, strict=True):
            T = calibration.T_parent_child[rows]
            # A dotted line from the parent's origin to the child's.
            panel.plot(
                *T[:, 3:] * [[0.0, 1.0]], color=MUTED, lw=0.8, ls=":", zorder=1
            )
            _draw_sensor(panel, T, child, CHILD, axis_m, -14)
            _draw_uncertainty(panel, T, calibration, rows)
        panel.set(xlabel=f"{axes[0]} (m)", ylabel=f"{axes[1]} (m)", title=title)
        panel.set_aspect("equal", adjustable="datalim")
        panel.margins(0.3)
        _keep_names_inside(panel)


def _keep_names_inside(panel: Axes) -> None:
    """Put the names of sensors in the right half of a panel to the left of their sensors."""
    panel.apply_aspect()
    middle = np.mean(panel.get_xlim())
    for name in panel.texts:
        if isinstance(name, Annotation) and name.xy[0] > middle:
            offset, below = name.get_position()
            name.set_horizontalalignment("right")
            name.set_position((-offset, below))


def _short_name(frame: str, role: str) -> str:
    """Return the name of a sensor in a view: its frame or, if this is too long, its role.

    Without a role, the middle of a long name is left out.
    """
    if len(frame) <= _MAX_NAME:
        return frame
    half = _MAX_NAME // 2
    return role or f"{frame[:half]}…{frame[-half:]}"


def _draw_uncertainty(
    panel: Axes, T: FloatArray, calibration: Calibration, rows: Sequence[int]
) -> None:
    """Draw the ellipse of the child's position, or a line along each unknown direction.

    Parameters
    ----------
    panel : Axes
    T : (2, 4) array
        Rows of the child's pose for the two axes of the view.
    calibration : Calibration
    rows : sequence of int
        Indices of the two axes of the view: to the right and upwards.
    """
    x, y = T[:, 3]
    covariance, unknown = spread_of_position(calibration)
    has_line = False
    for right, up in unknown[:, rows]:
        if math.hypot(right, up) > LOOK.min_in_view:
            has_line = True
            slope = up / right if abs(right) > 1e-9 else math.inf
            panel.axline((x, y), slope=slope, color=CHILD, ls="--", lw=1.0)
    if has_line:
        return
    variances, axes = np.linalg.eigh(covariance[np.ix_(rows, rows)])
    width, height = 2 * LOOK.sigmas * np.sqrt(np.maximum(variances, 0.0))
    angle_deg = float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])))
    panel.add_patch(
        Ellipse((x, y), width, height, angle=angle_deg, color=CHILD, alpha=0.3)
    )


def _draw_sensor(
    panel: Axes,
    T: FloatArray,
    name: str,
    colour: str,
    axis_m: float,
    below: float,
) -> None:
    """Draw a sensor's axes and its name.

    ``T`` (2, 4) has the rows of the pose for the two axes of the view. ``axis_m`` is the length of
    the sensor's axes, and ``below`` the vertical offset of the name (points).
    """
    origin = T[:, 3]
    for axis, axis_colour in zip(T[:, :3].T, (BAD, GREEN, PARENT), strict=True):
        tip = origin + axis_m * axis
        horizontal, vertical = np.stack([origin, tip], axis=1)
        panel.plot(horizontal, vertical, color=axis_colour)
    panel.plot(*origin, "o", color=colour, ms=5)
    panel.annotate(
        plain_label(name),
        xy=(*origin,),
        xytext=(5, below),
        textcoords="offset points",
        color=INK,
    )


@page_style()
def figure_of_views(
    calibrations: Sequence[Calibration], titles: Mapping[str, str] = VIEWS
) -> Drawn:
    """Draw the child sensors of one or several results in their parent's frame."""
    figure, panels = make_panels(3.1, 1, 3, gap=0.36)
    draw_views(panels, *calibrations, titles=titles)
    return as_drawn(
        figure, "views", "The sensors in space", caption_of_views(*calibrations)
    )
