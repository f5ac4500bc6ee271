"""``report.html`` of a rig: the tree of its sensors, drawn and in numbers, and whether results for
two sensors at a time close.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.covariance import AXES, TRANSLATIONS
from hand_eye_calib.report.report import TONES, page
from hand_eye_calib.report.style import (
    BAD,
    CHILD,
    GREEN,
    GRID,
    INK,
    PARENT,
    WIDTH,
    as_svg,
    new_figure,
    page_style,
)
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.rig.result import RigCalibration
from hand_eye_calib.text import counted, with_sigma

_VIEWS = ((0, 1), (0, 2))
# Of the figure's extent: the axes of a sensor; the least extent, m.
_AXIS_SHARE, _LEAST_EXTENT = 0.12, 0.1
_SAID = (
    "Axes of every sensor: x red, y green, z blue; one standard deviation of its position. "
    "Directions that the motion does not show have none."
)


def render_rig(rig: RigCalibration, inputs: Sequence[str]) -> str:
    """The page as HTML.

    Parameters
    ----------
    rig : RigCalibration
    inputs : sequence of str
        Where the trajectories came from.
    """
    verdict = rig.verdict.value
    return page(
        "rig.html",
        TONES[verdict],
        verdict,
        "",
        count=counted(len(rig.sensors), "sensor"),
        first=rig.sensors[0],
        inputs=inputs,
        axes=[(name, "m" if name in TRANSLATIONS else "°") for name in AXES],
        sensors=[_sensor(each) for each in rig.calibrations],
        figures=[{"name": "rig", "title": "Where they are", "said": _SAID, "svg": draw_rig(rig)}],
        closures=[each.sentence for each in rig.closures],
        closes=all(each.closes for each in rig.closures),
    )


def _sensor(calibration: Calibration) -> dict[str, Any]:
    values = {}
    for name, row in calibration.rows().items():
        factor, decimals = (1.0, 3) if row["unit"] == "m" else (float(np.degrees(1.0)), 2)
        values[name] = with_sigma(factor * row["value"], factor * row["sigma"], decimals)
    return {
        "name": calibration.child_frame,
        "headline": calibration.headline,
        "reasons": [f"{each.sentence}: {each.what_to_do}" for each in calibration.reasons],
        "values": values,
    }


def draw_rig(rig: RigCalibration) -> str:
    """SVG of where the sensors are and how they are turned, in two planes of the first one, with
    the standard deviations of their positions.
    """
    Xs = rig.Xs
    extent = max(float(np.ptp(Xs[:, :3, 3], axis=0).max()), _LEAST_EXTENT)
    with page_style():
        figure = new_figure(WIDTH, 3.9)
        for panel, (across, up) in zip(figure.subplots(1, 2), _VIEWS, strict=True):
            title = f"{'xyz'[across]}-{'xyz'[up]} plane of {rig.sensors[0]}"
            panel.set_title(title, loc="left", parse_math=False)
            panel.set(xlabel=f"{'xyz'[across]}, m", ylabel=f"{'xyz'[up]}, m")
            panel.set_aspect("equal", adjustable="datalim")
            panel.margins(0.25)
            for name, X in zip(rig.sensors, Xs, strict=True):
                _draw_sensor(panel, X[[across, up]], name, _AXIS_SHARE * extent)
            for each in rig.calibrations:
                x, y = each.T_parent_child[[across, up], 3]
                sigmas = np.where(np.isfinite(each.sigmas), each.sigmas, 0.0)
                panel.plot([0.0, x], [0.0, y], color=GRID, lw=0.9, zorder=0)
                panel.errorbar(x, y, sigmas[up], sigmas[across], color=CHILD, elinewidth=1.0)
        return as_svg(figure, "rig")


def _draw_sensor(panel: Axes, seen: FloatArray, name: str, length: float) -> None:
    """A sensor's axes at its origin, and its name; ``seen`` are two rows of its transform."""
    at = seen[:, 3]
    for axis, colour in zip(seen[:, :3].T, (BAD, GREEN, PARENT), strict=True):
        panel.plot(*np.stack([at, at + length * axis], axis=1), color=colour, lw=1.6)
    panel.annotate(
        name, (at[0], at[1]), (4, 5), textcoords="offset points", color=INK, parse_math=False
    )
