"""The figure of a result for notebooks: its residuals, and how well each axis is known."""

import io

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.report.style import (
    BLUE,
    LIGHT_GREY,
    PAGE_WIDTH,
    VERMILION,
    house_style,
    plain_decades,
)
from hand_eye_calib.results.calibration import Calibration

_CM_DEG = (100.0, float(np.degrees(1.0)))
# Smallest residual that is drawn (cm, deg): a logarithm has no zero.
_SMALLEST = 1e-4


class ShownFigure(Figure):
    """A figure that notebooks show without pyplot."""

    def _repr_png_(self) -> bytes:
        written = io.BytesIO()
        self.savefig(written, format="png", dpi=130)
        return written.getvalue()


def plot(calibration: Calibration) -> Figure:
    """Draw a result: residuals of its motion pairs over time, and the standard deviation of every
    axis.

    Parameters
    ----------
    calibration : Calibration
        As it was solved: a result read from a file has no residuals.

    Returns
    -------
    matplotlib.figure.Figure
        Notebooks show it; ``savefig`` writes it to a file.

    Raises
    ------
    InputError
        If the result was read from a file.
    """
    residuals = calibration.residuals()
    times_s = (residuals.end_ns - residuals.start_ns.min(initial=residuals.end_ns[0])) * 1e-9
    with house_style():
        figure = ShownFigure(figsize=(PAGE_WIDTH, 3.4), layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(2, 2, width_ratios=(3, 1))
        panels[0, 0].sharex(panels[1, 0])
        panels[0, 0].tick_params(labelbottom=False)
        panels[0, 0].set_title("residuals of the motion pairs")
        sizes = (residuals.translation_m, residuals.rotation_rad)
        names = ("translation (cm)", "rotation (deg)")
        for row, size, factor, name in zip(panels, sizes, _CM_DEG, names, strict=True):
            _draw_residuals(row[0], times_s, size * factor, residuals.is_inlier)
            row[0].set_ylabel(name)
        panels[1, 0].set_xlabel("time (s)")
        panels[1, 0].legend(loc="upper center", bbox_to_anchor=(0.5, -0.28), ncols=2, frameon=False)
        for index, unit in enumerate(("cm", "deg")):
            _draw_axes(panels[index, 1], calibration, index, unit)
        figure.suptitle(calibration.headline, fontsize=8, fontweight="bold")
    return figure


def _draw_residuals(panel: Axes, times_s: FloatArray, values: FloatArray, used: BoolArray) -> None:
    values = np.maximum(values, _SMALLEST)
    panel.set_yscale("log")
    panel.plot(times_s[used], values[used], ".", color=BLUE, ms=2.5, label="inlier")
    panel.plot(times_s[~used], values[~used], "x", color=VERMILION, ms=4, label="outlier")
    plain_decades(panel.yaxis)


def _draw_axes(panel: Axes, calibration: Calibration, index: int, unit: str) -> None:
    """Standard deviations of three axes; an unknown one is a grey bar across the panel."""
    names = [dof.name for dof in calibration.observability][3 * index : 3 * index + 3]
    sigmas = [row["sigma"] for row in calibration.rows().values()][3 * index : 3 * index + 3]
    values = np.array(sigmas) * _CM_DEG[index]
    known = np.isfinite(values)
    longest = values[known].max(initial=_SMALLEST)
    colours = [BLUE if is_known else LIGHT_GREY for is_known in known]
    panel.barh(range(3), np.where(known, values, longest), color=colours, height=0.6)
    for row, (value, is_known) in enumerate(zip(values, known, strict=True)):
        at, text = (value, f"{value:.2g}") if is_known else (0.0, "unknown")
        panel.text(at + 0.04 * longest, row, text, va="center")
    limits = (0, 1.5 * longest)
    panel.set(yticks=range(3), yticklabels=names, xlim=limits, title=f"sigma ({unit})")
    panel.set_xticks([])
    panel.invert_yaxis()
