"""``index.html`` of a batch: what the recordings of each vehicle say together, how each axis goes
with time, and a row for each recording with a link to its report.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.extrinsic import sigmas_rpy
from hand_eye_calib.report.report import TONES, page
from hand_eye_calib.report.style import (
    BAD,
    BAND,
    GRID,
    INK,
    MUTED,
    WIDTH,
    as_svg,
    new_figure,
    page_style,
)
from hand_eye_calib.session.agreement import Agreement, Kind
from hand_eye_calib.text import counted, listing, with_sigma

Plain = Mapping[str, Any]

_AXES = {"x": "m", "y": "m", "z": "m", "roll": "deg", "pitch": "deg", "yaw": "deg"}
_PANELS = ("x, mm", "y, mm", "z, mm", "about x, deg", "about y, deg", "about z, deg")
_TO_SHOWN = np.repeat([1000.0, np.degrees(1.0)], 3)
# A band of the common value in its own standard deviations.
_BAND = 2.0
_GRAVITY = ("bad", "warn", "good")
_TONES = {Kind.AGREE: "good", Kind.SINGLE: "warn", Kind.SCATTER: "warn"}
# More would make the page too large for a browser; rows.csv has all.
_MOST_ROWS, _MOST_FIGURES = 2000, 40
# Standard deviations (m, deg) from which on a common value is unknown.
_UNKNOWN = {"m": 1.0, "deg": 60.0}


def render_batch(
    batch: str, rows: Sequence[Plain], vehicles: Sequence[Plain], with_report: Collection[str]
) -> str:
    """The page as HTML.

    Parameters
    ----------
    batch : str
        Name of the batch file.
    rows : sequence of dict
        One for each recording.
    vehicles : sequence of dict
        ``name``, ``frames``, ``rows``, ``agreement``, ``sentence``, ``of_newest`` of each.
    with_report : collection of str
        Names of the recordings that have a report.

    Returns
    -------
    str
        The gravest recordings and vehicles first.
    """
    cells = [_cells(row, row["name"] in with_report) for row in rows]
    counts = Counter(cell["verdict"] for cell in cells)
    cells.sort(key=lambda cell: _GRAVITY.index(cell["tone"]))
    ordered = sorted(vehicles, key=lambda one: _GRAVITY.index(_tone_of(one)))
    tone = cells[0]["tone"]
    return page(
        "batch.html",
        tone,
        counted(len(rows), "recording"),
        listing([f"{count} {verdict}" for verdict, count in counts.most_common()]),
        batch=batch.rpartition("/")[2],
        left_out=max(0, len(rows) - _MOST_ROWS),
        vehicles=[_vehicle(one, number) for number, one in enumerate(ordered, start=1)],
        rows=cells[:_MOST_ROWS],
        with_vehicles=any(row["vehicle"] for row in rows),
        headings=[f"{name} {unit}" for name, unit in _AXES.items()],
    )


def _tone_of(vehicle: Plain) -> str:
    return _TONES.get(vehicle["agreement"].kind, "bad")


def _vehicle(vehicle: Plain, number: int) -> dict[str, Any]:
    rows = vehicle["rows"]
    found: Agreement = vehicle["agreement"]
    is_drawn = len(rows) > 1 and number <= _MOST_FIGURES
    starts_ns = [row["start_ns"] for row in rows]
    figure = {
        "name": f"vehicle-{number}",
        "title": "Each recording against the common extrinsic",
        "said": "Difference of each recording from the common value along and about the parent's "
        "axes, with its standard deviation. The band is two standard deviations of the common "
        "value. Squares do not belong to the others.",
        "svg": draw_trend(found, starts_ns, number) if is_drawn else None,
    }
    return {
        "title": vehicle["name"],
        "frames": " in ".join(reversed(vehicle["frames"])),
        "count": counted(len(rows), "recording"),
        "sentence": vehicle["sentence"],
        "newest": vehicle["of_newest"],
        "tone": _tone_of(vehicle),
        "values": _common(found),
        "figures": [figure] if is_drawn else [],
    }


def _common(found: Agreement) -> list[tuple[str, str]]:
    """The common extrinsic, value by value."""
    T = found.T_parent_child
    to_child = np.kron(np.eye(2), T[:3, :3].T)
    sigmas_deg = np.degrees(sigmas_rpy(T, to_child @ found.covariance @ to_child.T))
    values = [*T[:3, 3], *np.degrees(se3.rotation_to_rpy(T[:3, :3]))]
    sigmas = [*np.sqrt(np.diag(found.covariance)[:3]), *sigmas_deg]
    return [
        (
            f"{name}, {unit}",
            with_sigma(value, sigma if sigma < _UNKNOWN[unit] else None, 3 if unit == "m" else 2),
        )
        for (name, unit), value, sigma in zip(_AXES.items(), values, sigmas, strict=True)
    ]


def _cells(row: Plain, is_linked: bool) -> dict[str, Any]:
    """A recording's row of the table."""
    verdict = "failed" if row["error"] else row["verdict"]
    values = [
        with_sigma(row[f"{name}_{unit}"], row[f"sigma_{name}_{unit}"], 3 if unit == "m" else 2)
        for name, unit in _AXES.items()
        if row["verdict"] is not None
    ]
    return {
        "name": row["name"],
        "vehicle": row["vehicle"],
        "start": (row["start"] or "").removesuffix("+00:00").replace("T", " "),
        "link": f"{row['name']}/report.html" if is_linked else "",
        "verdict": verdict,
        "tone": TONES.get(verdict, "bad"),
        "why": row["error"] or row["headline"] or "",
        "values": values,
    }


def draw_trend(found: Agreement, starts_ns: Sequence[int | None], number: int) -> str:
    """SVG of how the results of a vehicle lie about their common extrinsic, axis by axis, over the
    starts of the recordings; ``number`` is that of the vehicle on the page.
    """
    known = [start for start in starts_ns if start is not None]
    is_date = len(known) == len(starts_ns) and len(set(known)) > 1
    at = np.arange(1.0, len(starts_ns) + 1)
    if is_date:
        at = np.array(date2num([datetime.fromtimestamp(start * 1e-9, UTC) for start in known]))
    apart = np.isin(np.arange(len(at)), found.apart)
    bands = _BAND * np.sqrt(np.diag(found.covariance))
    with page_style():
        figure = new_figure(WIDTH, 3.9)
        panels = figure.subplots(2, 3, sharex=True).ravel()
        for axis, (panel, title) in enumerate(zip(panels, _PANELS, strict=True)):
            panel.set_title(title, loc="left")
            values, sigmas = found.deviations[:, axis], found.sigmas[:, axis]
            _draw_axis(panel, at, np.array([values, sigmas]), bands[axis], _TO_SHOWN[axis], apart)
            if is_date:
                locator = AutoDateLocator(minticks=2, maxticks=4)
                panel.xaxis.set_major_locator(locator)
                panel.xaxis.set_major_formatter(ConciseDateFormatter(locator))
        return as_svg(figure, f"trend{number}")


def _draw_axis(
    panel: Axes,
    at: FloatArray,
    values_sigmas: FloatArray,
    band: float,
    factor: float,
    apart: BoolArray,
) -> None:
    """Deviations of one axis with their standard deviations, and the band of the common value."""
    values, sigmas = factor * values_sigmas
    if np.isnan(values).all():
        panel.text(0.5, 0.5, "not determined", transform=panel.transAxes, ha="center", color=MUTED)
        panel.set_yticks([])
        return
    panel.axhspan(-factor * band, factor * band, color=BAND, alpha=0.15, lw=0)
    panel.axhline(0, color=GRID, lw=0.8)
    for group, colour, fmt in ((~apart, INK, "o"), (apart, BAD, "s")):
        look: dict[str, Any] = {"fmt": fmt, "color": colour, "ms": 3.2, "elinewidth": 0.8}
        panel.errorbar(at[group], values[group], sigmas[group], **look)
