"""``index.html`` of a batch: what the recordings of each vehicle say together, how each axis goes
with time, and a row for each recording with a link to its report.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num
from matplotlib.figure import Figure

from hand_eye_calib.core.base.errors import printable
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.base.text import counted, listing, with_sigma
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.extras.fleet.together import row_of_result
from hand_eye_calib.offline.report.figures import (
    BAD,
    GRID,
    INK,
    LOOK,
    PARENT,
    Drawn,
    as_drawn,
    page_style,
)
from hand_eye_calib.offline.report.report import TONES, page

_AXES = {"x": "m", "y": "m", "z": "m", "roll": "deg", "pitch": "deg", "yaw": "deg"}
_TITLES = {
    "x": "x",
    "y": "y",
    "z": "z",
    "roll": "about x",
    "pitch": "about y",
    "yaw": "about z",
}
_GRAVITY = ("bad", "warn", "good")


def render_batch(
    title: str,
    rows: Sequence[Document],
    vehicles: Mapping[str, Calibration],
    with_report: Collection[str],
) -> str:
    """The page as HTML, the gravest recordings and vehicles first.

    The title says what they are of; there is a row for each, the result of each vehicle of several
    by its name, and the names of the recordings that have a report.
    """
    cells = sorted(
        (_cells(row, row["name"] in with_report) for row in rows),
        key=lambda cell: _GRAVITY.index(TONES.get(cell[2], "bad")),
    )
    counts = Counter(cell[2] for cell in cells)
    ordered = sorted(vehicles.items(), key=lambda one: _GRAVITY.index(TONES[one[1].verdict.value]))
    return page(
        Path(__file__).with_name("batch.html"),
        TONES.get(cells[0][2], "bad"),
        counted(len(rows), "recording"),
        listing([f"{count:,} {verdict}" for verdict, count in counts.most_common()]),
        batch=title.rstrip("/*").rpartition("/")[2] or title,
        vehicles_left_out=max(0, len(ordered) - LOOK.vehicles),
        vehicles=[
            (name, result, _values(row_of_result(result.to_dict())), _trend(result, number))
            for number, (name, result) in enumerate(ordered[: LOOK.vehicles], start=1)
        ],
        rows=cells,
        tones=TONES,
        headings=[f"{name} {unit}" for name, unit in _AXES.items()],
    )


@page_style(path_simplify=False)
def _trend(result: Calibration, number: int) -> Drawn:
    """The figure of a vehicle's recordings about their common extrinsic, axis by axis, over time;
    ``number`` is that of the vehicle on the page.
    """
    together = result.parts.get("together")
    recordings = together.recordings if together else ()
    at = date2num(np.array([each.stamp_ns for each in recordings], dtype="datetime64[ns]"))
    apart = np.array([bool(each.left_out) for each in recordings])
    figure = Figure(figsize=(LOOK.width, 3.9), layout="constrained")
    panels = figure.subplots(2, 3, sharex=True).ravel()
    for axis, panel, sigma in zip(_AXES, panels, result.sigmas_measured, strict=True):
        factor, unit = (100.0, "cm") if axis in "xyz" else (np.degrees(1.0), "deg")
        points = [(each.deviations[axis], each.sigmas[axis]) for each in recordings]
        values, sigmas = factor * np.where(np.isfinite(points), points, np.nan).T
        band = factor * LOOK.sigmas * sigma
        title = _TITLES[axis]
        title += f", {unit}" if np.isfinite(band) else ": not determined"
        panel.set_title(title, loc="left")
        panel.axhline(0, color=GRID, lw=0.8)
        if np.isfinite(band):
            panel.axhspan(-band, band, color=PARENT, alpha=0.15, lw=0)
        # A dot is a line of no length: a mark for each would make a page of many vehicles heavy.
        for half, width in ((sigmas, 0.8), (0 * sigmas, 3.2)):
            ends = np.stack([values - half, values + half, np.full(len(at), np.nan)], axis=1)
            for group, colour, cap in ((~apart, INK, "round"), (apart, BAD, "projecting")):
                line = panel.plot(np.repeat(at[group], 3), ends[group].ravel(), color=colour)
                line[0].set(lw=width, solid_capstyle=cap)
    locator = AutoDateLocator(minticks=2, maxticks=4)
    panels[0].xaxis.set_major_locator(locator)
    panels[0].xaxis.set_major_formatter(ConciseDateFormatter(locator))
    said = (
        "Difference of each recording from the common value along and about the parent's axes, "
        "with its standard deviation. The band is three standard deviations of the common value, "
        "without the allowance for constant errors, which all recordings share. "
        "Squares do not belong to the others."
    )
    title = "Each recording against the common extrinsic"
    return as_drawn(figure, f"vehicle-{number}", title, said)


def _values(row: Document) -> list[str]:
    return [
        with_sigma(row[f"{name}_{unit}"], row[f"sigma_{name}_{unit}"], 3 if unit == "m" else 2)
        for name, unit in _AXES.items()
    ]


def _cells(row: Document, is_linked: bool) -> list[Any]:
    """What the table shows of a recording: name, vehicle, verdict, start, whether it has a report,
    and the values, each with its standard deviation after a space, or why there are none.
    """
    known = row["verdict"] is not None and not row["error"]
    values = [text.replace(" +/- ", " ") for text in _values(row)] if known else row["error"]
    start = (row["start"] or "")[:16].replace("T", " ")  # to the minute
    verdict = "failed" if row["error"] else row["verdict"]
    return [printable(row["name"]), row["vehicle"], verdict, start, int(is_linked), values]
