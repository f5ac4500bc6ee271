"""``index.html`` of a batch: what the recordings of each vehicle say together, how each axis goes
with time, and a row for each recording with a link to its report.
"""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.extrinsic import sigmas_rpy
from hand_eye_calib.report.report import environment
from hand_eye_calib.report.report_figures import (
    BAD,
    BAND,
    GRID,
    INK,
    MUTED,
    WIDTH,
    as_svg,
    page_style,
)
from hand_eye_calib.report.style import new_figure
from hand_eye_calib.results.verdict import Verdict
from hand_eye_calib.session.agreement import Agreement, Kind
from hand_eye_calib.text import counted, with_sigma

Plain = Mapping[str, Any]

_AXES = (("x", "m"), ("y", "m"), ("z", "m"), ("roll", "deg"), ("pitch", "deg"), ("yaw", "deg"))
_PANELS = ("x, mm", "y, mm", "z, mm", "about x, deg", "about y, deg", "about z, deg")
_TO_SHOWN = np.r_[np.full(3, 1000.0), np.full(3, np.degrees(1.0))]
# Results that are drawn with their own number of standard deviations.
_BAND = 2.0
_TONES = {
    Kind.SINGLE: "warn",
    Kind.AGREE: "good",
    Kind.SCATTER: "warn",
    Kind.ONE_OFF: "bad",
    Kind.MOVED: "bad",
    Kind.DIFFER: "bad",
}
_MARKS = {"good": "✓", "warn": "!", "bad": "✗"}
_VERDICTS = {
    Verdict.USE.value: "good",
    Verdict.USE_WITH_CARE.value: "warn",
    Verdict.DO_NOT_USE.value: "bad",
}


def render_batch(
    batch: str, rows: Sequence[Plain], vehicles: Sequence[Plain], with_report: Sequence[bool]
) -> str:
    """The page as HTML.

    Parameters
    ----------
    batch : str
        Name of the batch file.
    rows : sequence of dict
        One for each recording.
    vehicles : sequence of dict
        ``name``, ``frames``, ``rows``, ``agreement``, ``sentence`` and ``newest`` of each vehicle.
    with_report : sequence of bool
        Whether a recording has a report.

    Returns
    -------
    str
    """
    shown = [_vehicle(vehicle, number) for number, vehicle in enumerate(vehicles, start=1)]
    table = [_cells(row, linked) for row, linked in zip(rows, with_report, strict=True)]
    failed = sum(bool(row["error"]) for row in rows)
    return (
        environment()
        .get_template("batch.html")
        .render(
            batch=batch.rpartition("/")[2],
            count=counted(len(rows), "recording"),
            failed=failed,
            vehicles=shown,
            rows=table,
            with_vehicles=any(row["vehicle"] for row in rows),
            headings=[f"{name} {unit}" for name, unit in _AXES],
        )
    )


def _vehicle(vehicle: Plain, number: int) -> dict[str, Any]:
    found: Agreement = vehicle["agreement"]
    rows, newest = vehicle["rows"], vehicle["newest"]
    tone = _TONES[found.kind]
    return {
        "title": vehicle["name"],
        "id": f"vehicle-{number}",
        "frames": " in ".join(reversed(vehicle["frames"])),
        "count": counted(len(rows), "recording"),
        "sentence": vehicle["sentence"],
        "newest": f"{rows[-1]['name']} against the earlier ones: {newest.sentence}."
        if newest
        else "",
        "tone": tone,
        "mark": _MARKS[tone],
        "values": _common(found),
        "svg": draw_trend(found, [row["start_ns"] for row in rows], number)
        if len(rows) > 1
        else "",
    }


def _common(found: Agreement) -> list[tuple[str, str]]:
    """The common extrinsic, value by value."""
    lengths = found.T_parent_child[:3, 3]
    rotation = found.T_parent_child[:3, :3]
    to_child = np.kron(np.eye(2), rotation.T)
    sigmas_m = np.sqrt(np.diag(found.covariance)[:3])
    angles = np.degrees(se3.rotation_to_rpy(rotation))
    in_child = to_child @ found.covariance @ to_child.T
    sigmas_deg = np.degrees(sigmas_rpy(found.T_parent_child, in_child))
    shown = [
        (f"{name}, m", with_sigma(value, sigma if sigma < 1 else None, 3))
        for name, value, sigma in zip("xyz", lengths, sigmas_m, strict=True)
    ]
    return shown + [
        (f"{name}, deg", with_sigma(value, sigma if sigma < 60 else None, 2))
        for name, value, sigma in zip(("roll", "pitch", "yaw"), angles, sigmas_deg, strict=True)
    ]


def _cells(row: Plain, is_linked: bool) -> dict[str, Any]:
    """A recording's row of the table."""
    is_solved = row["verdict"] is not None
    values = [
        with_sigma(row[f"{name}_{unit}"], row[f"sigma_{name}_{unit}"], 3 if unit == "m" else 2)
        for name, unit in _AXES
        if is_solved
    ]
    return {
        "name": row["name"],
        "vehicle": row["vehicle"],
        "start": (row["start"] or "").removesuffix("+00:00").replace("T", " "),
        "link": f"{row['name']}/report.html" if is_linked else "",
        "verdict": "failed" if row["error"] else row["verdict"],
        "tone": "bad" if row["error"] else _VERDICTS[row["verdict"]],
        "why": row["error"] or row["headline"] or "",
        "values": values,
    }


# ---- the figure


def draw_trend(found: Agreement, starts_ns: Sequence[int | None], number: int) -> str:
    """SVG of how the results of a vehicle lie about their common extrinsic, axis by axis.

    Parameters
    ----------
    found : Agreement
    starts_ns : sequence of int or None
        Starts of the recordings.
    number : int
        Of the vehicle on the page.
    """
    at, is_date = _abscissa(starts_ns)
    apart = np.isin(np.arange(len(at)), found.apart)
    band = _BAND * np.sqrt(np.diag(found.covariance))
    with page_style():
        figure = new_figure(WIDTH, 3.9)
        panels = figure.subplots(2, 3, sharex=True).ravel()
        for axis, (panel, title) in enumerate(zip(panels, _PANELS, strict=True)):
            panel.set_title(title, loc="left")
            _draw_axis(panel, at, found, axis, apart, band[axis])
            if is_date:
                locator = AutoDateLocator(minticks=2, maxticks=4)
                panel.xaxis.set_major_locator(locator)
                panel.xaxis.set_major_formatter(ConciseDateFormatter(locator))
        return as_svg(figure, f"trend{number}")


def _abscissa(starts_ns: Sequence[int | None]) -> tuple[FloatArray, bool]:
    """Dates of the recordings; their numbers if these are not known or all the same."""
    known = [start for start in starts_ns if start is not None]
    if len(known) < len(starts_ns) or len(set(known)) < 2:
        return np.arange(1.0, len(starts_ns) + 1), False
    dates = [datetime.fromtimestamp(start * 1e-9, UTC) for start in known]
    return np.asarray(date2num(dates), dtype=float), True


def _draw_axis(
    panel: Axes,
    at: FloatArray,
    found: Agreement,
    axis: int,
    apart: Any,
    band: float,
) -> None:
    """Deviations of one axis with their standard deviations, and the band of the common value."""
    factor = _TO_SHOWN[axis]
    values, sigmas = factor * found.deviations[:, axis], factor * found.sigmas[:, axis]
    if np.isnan(values).all():
        panel.text(0.5, 0.5, "not determined", transform=panel.transAxes, ha="center", color=MUTED)
        panel.set_yticks([])
        return
    panel.axhspan(-factor * band, factor * band, color=BAND, alpha=0.15, lw=0)
    panel.axhline(0, color=GRID, lw=0.8)
    for group, colour, marker in ((~apart, INK, "o"), (apart, BAD, "s")):
        panel.errorbar(
            at[group],
            values[group],
            sigmas[group],
            fmt=marker,
            color=colour,
            ms=3.2,
            elinewidth=0.8,
        )
