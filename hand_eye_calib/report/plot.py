"""Both sensors in space from three sides, with the uncertainty of the child's position."""

import io
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from hand_eye_calib.report.style import (
    BAD,
    CHILD,
    GREEN,
    INK,
    MUTED,
    PARENT,
    WIDTH,
    page_style,
    plain_label,
)
from hand_eye_calib.results.calibration import Calibration

# The three views: which axes of the parent go across and up, and what that is on a vehicle.
_VIEWS = ((0, 1, "from above"), (0, 2, "from the side"), (1, 2, "from behind"))
# Of the distance between the sensors: axes of a sensor, the smallest ellipse that can be seen. And
# the least distance (m).
_AXIS, _SEEN, _LEAST = 0.22, 0.06, 0.05
_SIGMAS = 3.0


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
        figure = ShownFigure(figsize=(WIDTH, 3.3), layout="constrained")
        FigureCanvasAgg(figure)
        draw_views(figure.subplots(1, 3), calibration)
        figure.suptitle(calibration.headline, fontsize=8, fontweight="bold", wrap=True)
        figure.supxlabel(said_of_views(calibration), fontsize=7.5, wrap=True)
    return figure


def said_of_views(calibration: Calibration) -> str:
    """What the three views show, in words."""
    sigmas = calibration.sigmas_with_floor[:3]
    unknown = [axis for axis, sigma in zip("xyz", sigmas, strict=True) if not np.isfinite(sigma)]
    larger = _enlarged(calibration)
    text = "Axes of both sensors: x red, y green, z blue."
    if len(unknown) < 3:
        text += f" Ellipse: {_SIGMAS:g} standard deviations of the position"
        text += f", drawn {larger:,.0f} times as large." if larger > 1 else "."
    if unknown:
        text += f" Unknown along {' and '.join(unknown)}: the dashed line."
    return text


def draw_views(panels: Sequence[Axes], calibration: Calibration) -> None:
    """Draw the three views into three panels."""
    T, extent = calibration.T_parent_child, _extent(calibration)
    sigmas = calibration.sigmas_with_floor[:3]
    R = T[:3, :3]
    covariance = R @ calibration.covariance_with_floor[:3, :3] @ R.T
    for panel, (across, up, title) in zip(panels, _VIEWS, strict=True):
        seen = [across, up]
        panel.plot(*T[seen, 3][:, None] * [[0.0, 1.0]], color=MUTED, lw=0.8, ls=":", zorder=1)
        for pose, name, colour, below in (
            (np.eye(4), calibration.parent_frame, PARENT, 6),
            (T, calibration.child_frame, CHILD, -14),
        ):
            at = pose[seen, 3]
            for axis, of_axis in zip(pose[seen, :3].T, (BAD, GREEN, PARENT), strict=True):
                panel.plot(*np.stack([at, at + _AXIS * extent * axis], axis=1), color=of_axis)
            panel.plot(*at, "o", color=colour, ms=5)
            panel.annotate(
                plain_label(name), (at[0], at[1]), (5, below), textcoords="offset points", color=INK
            )
        if np.isfinite(sigmas[seen]).all():
            values, vectors = np.linalg.eigh(covariance[np.ix_(seen, seen)])
            wide, high = 2 * _SIGMAS * _enlarged(calibration) * np.sqrt(np.maximum(values, 0.0))
            turned = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
            panel.add_patch(
                Ellipse((T[across, 3], T[up, 3]), wide, high, angle=turned, color=CHILD, alpha=0.3)
            )
        for axis, line in ((across, panel.axhline), (up, panel.axvline)):
            if not np.isfinite(sigmas[axis]):
                line(T[up if axis == across else across, 3], color=CHILD, ls="--", lw=1.0)
        panel.set(xlabel=f"{'xyz'[across]} (m)", ylabel=f"{'xyz'[up]} (m)", title=title)
        panel.set_aspect("equal", adjustable="datalim")
        panel.margins(0.3)


def _extent(calibration: Calibration) -> float:
    return max(float(np.linalg.norm(calibration.translation)), _LEAST)


def _enlarged(calibration: Calibration) -> float:
    """How many times as large the ellipses are drawn, to be seen: 1, 2, 5, 10 ..."""
    sigmas = calibration.sigmas_with_floor[:3]
    widest = _SIGMAS * float(np.max(sigmas[np.isfinite(sigmas)], initial=0.0))
    wanted = _SEEN * _extent(calibration) / max(widest, 1e-9)
    steps = [step * 10**power for power in range(6) for step in (1, 2, 5)]
    return float(next((step for step in steps if step >= wanted), steps[-1]))
