"""``index.html`` of a batch.

The page contains the common result of each vehicle, with a figure of each axis over time. It also
has a row for each recording, with a link to the report of the recording.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import printable
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.base.text import ABOUT, counted, listing, with_sigma
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.extras.fleet.records import Recorded
from hand_eye_calib.extras.fleet.together import row_of_result
from hand_eye_calib.offline.report.report import TONES, page
from hand_eye_calib.offline.report.style import (
    BAD,
    GRID,
    INK,
    LOOK,
    PARENT,
    Drawn,
    as_drawn,
    page_style,
    recordings_axis,
)

_AXES = {
    "x": "m",
    "y": "m",
    "z": "m",
    "roll": "deg",
    "pitch": "deg",
    "yaw": "deg",
}
# Tones of verdicts, the gravest first.
_GRAVITY = ("bad", "warn", "good")
# Height of the figure of a vehicle, inches.
_HEIGHT = 3.9
_CAPTION = (
    "Difference of each recording from the common value along and about the parent's axes, "
    "with its standard deviation, which includes the usual scatter between recordings. "
    "The band is three standard deviations of the common value, "
    "without the allowance for constant errors, which all recordings share. "
    "Squares are recordings that contradict the others."
)


def render_batch(
    title: str,
    rows: Sequence[Document],
    vehicles: Mapping[str, Calibration],
    with_report: Collection[str],
) -> str:
    """Return the page as HTML, the gravest recordings and vehicles first.

    Parameters
    ----------
    title : str
        Name of the batch, such as the pattern of its bags.
    rows : sequence of mappings
        Row of each recording.
    vehicles : mapping of str to Calibration
        Common result of each vehicle with several recordings.
    with_report : collection of str
        Names of the recordings that have a report.
    """
    cells = [_cells(row, row["name"] in with_report) for row in rows]
    cells.sort(key=lambda cells_of_row: _gravity(cells_of_row.verdict))
    counts = Counter(cells_of_row.verdict for cells_of_row in cells)
    ordered = sorted(
        vehicles.items(), key=lambda item: _gravity(item[1].verdict.value)
    )
    shown_vehicles = []
    for number, (name, result) in enumerate(
        ordered[: LOOK.max_vehicles], start=1
    ):
        values = _values(row_of_result(result.to_dict()))
        shown_vehicles.append((name, result, values, _trend(result, number)))
    return page(
        Path(__file__).with_name("batch.html"),
        TONES.get(cells[0].verdict, "bad"),
        counted(len(rows), "recording"),
        listing(
            [f"{count:,} {verdict}" for verdict, count in counts.most_common()]
        ),
        batch=Path(title.rstrip("/*")).name or title,
        vehicles_left_out=max(0, len(ordered) - LOOK.max_vehicles),
        vehicles=shown_vehicles,
        rows=cells,
        tones=TONES,
        headings=[f"{name} {unit}" for name, unit in _AXES.items()],
    )


def _gravity(verdict: str) -> int:
    """Return the place of a verdict in the order of gravity. Failures are first."""
    return _GRAVITY.index(TONES.get(verdict, "bad"))


@page_style(path_simplify=False)
def _trend(result: Calibration, number: int) -> Drawn:
    """Draw the differences of a vehicle's recordings from their common extrinsic over time.

    ``number`` is the number of the vehicle on the page.
    """
    together = result.parts.get("together")
    recordings = together.recordings if together else ()
    figure = Figure(figsize=(LOOK.width, _HEIGHT), layout="constrained")
    panels = figure.subplots(2, 3, sharex=True).ravel()
    starts_ns = [recording.stamp_ns for recording in recordings]
    days = recordings_axis(panels, starts_ns, "recording")
    for axis, panel, sigma in zip(
        _AXES, panels, result.sigmas_measured, strict=True
    ):
        _draw_axis(panel, axis, sigma, days, recordings)
    title = "Each recording against the common extrinsic"
    return as_drawn(figure, f"vehicle-{number}", title, _CAPTION)


def _draw_axis(
    panel: Any,
    axis: str,
    sigma: float,
    days: FloatArray,
    recordings: Sequence[Recorded],
) -> None:
    """Draw the differences of recordings from the common value of an axis (m or rad).

    ``sigma`` is the measured standard deviation of the common value. ``days`` has the places of the
    recordings on the x axis.
    """
    factor = 100.0
    unit = "cm"
    title = axis
    if axis in ABOUT:
        factor = np.degrees(1.0)
        unit = "deg"
        title = f"about {ABOUT[axis]}"
    is_apart = np.array([bool(recording.left_out) for recording in recordings])
    points = [
        (recording.deviations[axis], recording.sigmas[axis])
        for recording in recordings
    ]
    values, sigmas = factor * np.where(np.isfinite(points), points, np.nan).T
    band = factor * LOOK.sigmas * sigma
    is_determined = np.isfinite(band)
    title += f", {unit}" if is_determined else ": not determined"
    panel.set_title(title, loc="left")
    panel.axhline(0, color=GRID, lw=0.8)
    if is_determined:
        panel.axhspan(-band, band, color=PARENT, alpha=0.15, lw=0)
    # A dot is drawn as a line of length 0, because markers would make a large page.
    gap = np.full(len(days), np.nan)
    for half, width in ((sigmas, 0.8), (0 * sigmas, 3.2)):
        # The NaN after each line separates it from the next line.
        ends = np.stack([values - half, values + half, gap], axis=1)
        for group, colour, cap in (
            (~is_apart, INK, "round"),
            (is_apart, BAD, "projecting"),
        ):
            (line,) = panel.plot(
                np.repeat(days[group], 3), ends[group].ravel(), color=colour
            )
            line.set(lw=width, solid_capstyle=cap)


def _values(row: Document) -> list[str]:
    """Return the numbers of a row with their standard deviations as text, by axis."""
    values = []
    for name, unit in _AXES.items():
        column = f"{name}_{unit}"
        decimals = 3 if unit == "m" else 2
        values.append(with_sigma(row[column], row[f"sigma_{column}"], decimals))
    return values


class _Cells(NamedTuple):
    """Cells of a recording in the table.

    Attributes
    ----------
    name, vehicle, verdict, start : str
    is_linked : int
        1 if the recording has a report, else 0.
    values : list of str or str
        Numbers with their standard deviations by axis; the error of a failed recording.
    """

    name: str
    vehicle: str
    verdict: str
    start: str
    is_linked: int
    values: list[str] | str


def _cells(row: Document, is_linked: bool) -> _Cells:
    """Return the cells of the row of a recording."""
    values: list[str] | str = row["error"]
    if row["verdict"] is not None and not row["error"]:
        values = [text.replace(" +/- ", " ") for text in _values(row)]
    # Date and time up to the minutes.
    start = (row["start"] or "")[:16].replace("T", " ")
    verdict = "failed" if row["error"] else row["verdict"]
    return _Cells(
        name=printable(row["name"]),
        vehicle=row["vehicle"],
        verdict=verdict,
        start=start,
        is_linked=int(is_linked),
        values=values,
    )
