"""Sensors in space from three sides, with the uncertainty of their positions."""

import io
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.report.style import (
    BAD,
    CHILD,
    GREEN,
    INK,
    LOOK,
    MUTED,
    PARENT,
    page_style,
    plain_label,
)
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.text import listing

# The three views: which axes of the parent go across and up, and what that is on a vehicle.
_VIEWS = {"xy": "from above", "xz": "from the side", "yz": "from the front"}


class ShownFigure(Figure):
    """A figure that notebooks show without pyplot."""

    def _repr_png_(self) -> bytes:
        written = io.BytesIO()
        self.savefig(written, format="png", dpi=130)
        return written.getvalue()


def plot(calibration: Calibration) -> Figure:
    """Draw where both sensors are and how they are turned, in three views of the parent sensor's
    frame, with three standard deviations of the child's position.

    Parameters
    ----------
    calibration : Calibration

    Returns
    -------
    matplotlib.figure.Figure
        Notebooks show it; ``savefig`` writes it to a file.

    Examples
    --------
    >>> hec.plot(result).savefig("result.png")
    """
    with page_style(figure_facecolor="white", savefig_facecolor="white"):
        figure = ShownFigure(figsize=(LOOK.width, 3.3), layout="constrained")
        FigureCanvasAgg(figure)
        draw_views(figure.subplots(1, 3), calibration)
        figure.suptitle(calibration.headline, fontsize=8, fontweight="bold", wrap=True)
        figure.supxlabel(said_of_views(calibration), fontsize=7.5, wrap=True)
    return figure


def said_of_views(*calibrations: Calibration) -> str:
    """What the three views show, in words."""
    sigmas = np.array([each.sigmas_with_floor[:3] for each in calibrations])
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
                covariance = R @ calibration.covariance_with_floor[:3, :3] @ R.T
                values, vectors = np.linalg.eigh(covariance)
                wide, high = 2 * LOOK.sigmas * np.sqrt(np.maximum(values, 0.0))
                turned = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
                ellipse = Ellipse((at[0], at[1]), wide, high, angle=turned, color=CHILD, alpha=0.3)
                panel.add_patch(ellipse)
            lines = (panel.axhline, panel.axvline)
            for line, fixed, known in zip(lines, at[::-1], is_known, strict=True):
                if not known:
                    line(fixed, color=CHILD, ls="--", lw=1.0)
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
    panel.annotate(
        plain_label(name), (at[0], at[1]), (5, below), textcoords="offset points", color=INK
    )
