"""``report.html`` of a rig: the tree of its sensors, drawn and in numbers, the noise of every
sensor, and whether answers for two sensors at a time close.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.covariance import AXES, TRANSLATIONS
from hand_eye_calib.report.report import environment, verdict_of
from hand_eye_calib.report.report_figures import (
    BAD,
    CHILD,
    GRID,
    INK,
    PARENT,
    WIDTH,
    as_svg,
    page_style,
)
from hand_eye_calib.report.style import GREEN, new_figure
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.rig.result import RigCalibration
from hand_eye_calib.text import angle, counted, length, with_sigma

_VIEWS = ((0, 1), (0, 2))
# Of the figure's extent: the axes of a sensor; the least extent, m.
_AXIS_SHARE, _LEAST_EXTENT = 0.12, 0.1


def render_rig(rig: RigCalibration, inputs: Sequence[str]) -> str:
    """The page as HTML.

    Parameters
    ----------
    rig : RigCalibration
    inputs : sequence of str
        Where the trajectories came from.
    """
    closes = all(each.closes for each in rig.closures)
    return (
        environment()
        .get_template("rig.html")
        .render(
            count=counted(len(rig.sensors), "sensor"),
            first=rig.sensors[0],
            inputs=inputs,
            verdict=rig.verdict.value,
            looks=_looks(rig),
            axes=[(name, "m" if name in TRANSLATIONS else "°") for name in AXES],
            sensors=[_sensor(each) for each in rig.calibrations],
            svg=draw_rig(rig),
            closures=[each.sentence for each in rig.closures],
            closes=closes,
            noise=_noise(rig),
        )
    )


def _looks(rig: RigCalibration) -> dict[str, str]:
    """Tone and mark of the gravest verdict."""
    gravest = next(each for each in rig.calibrations if each.verdict is rig.verdict)
    return verdict_of(gravest)


def _sensor(calibration: Calibration) -> dict[str, Any]:
    factors = {"m": (1.0, 3), "rad": (float(np.degrees(1.0)), 2)}
    values = {}
    for name, row in calibration.rows().items():
        factor, decimals = factors[row["unit"]]
        values[name] = with_sigma(factor * row["value"], factor * row["sigma"], decimals)
    return {
        "name": calibration.child_frame,
        "verdict": calibration.verdict.value,
        "headline": calibration.headline.partition(": ")[2],
        "reasons": [f"{each.sentence}: {each.what_to_do}" for each in calibration.reasons],
        "values": values,
    }


def _noise(rig: RigCalibration) -> list[tuple[str, ...]]:
    """A row for every sensor."""
    return [
        (
            name,
            length(noise.translation_white),
            angle(noise.rotation_white),
            length(noise.translation_drift),
            angle(noise.rotation_drift),
        )
        for name, noise in rig.noise.items()
    ]


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
            panel.set_xlabel(f"{'xyz'[across]}, m")
            panel.set_ylabel(f"{'xyz'[up]}, m")
            panel.set_aspect("equal", adjustable="datalim")
            panel.margins(0.25)
            for name, X in zip(rig.sensors, Xs, strict=True):
                _draw_sensor(panel, X, name, (across, up), _AXIS_SHARE * extent)
            for each in rig.calibrations:
                _draw_edge(panel, each, (across, up))
        return as_svg(figure, "rig")


def _draw_sensor(
    panel: Axes, X: FloatArray, name: str, view: tuple[int, int], length: float
) -> None:
    """A sensor's axes at its origin, and its name."""
    across, up = view
    at = X[[across, up], 3]
    for axis, colour in zip(X[:3, :3].T, (BAD, GREEN, PARENT), strict=True):
        tip = at + length * axis[[across, up]]
        panel.plot([at[0], tip[0]], [at[1], tip[1]], color=colour, lw=1.6)
    panel.annotate(
        name,
        (at[0], at[1]),
        xytext=(4, 5),
        textcoords="offset points",
        color=INK,
        parse_math=False,
    )


def _draw_edge(panel: Axes, calibration: Calibration, view: tuple[int, int]) -> None:
    """The line from the first sensor to another one, and the other's standard deviations."""
    across, up = view
    at = calibration.T_parent_child[:3, 3]
    panel.plot([0.0, at[across]], [0.0, at[up]], color=GRID, lw=0.9, zorder=0)
    sigmas = np.where(np.isfinite(calibration.sigmas), calibration.sigmas, 0.0)
    panel.errorbar(
        at[across], at[up], xerr=sigmas[across], yerr=sigmas[up], color=CHILD, elinewidth=1.0
    )
