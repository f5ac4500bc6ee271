"""Page with the mounts of a fleet: for each vehicle, the history that its digests contain."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from hand_eye_calib.core.assessment import change
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.text import ABOUT, amount, axes_in_words, counted
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.extras.mount.history import History
from hand_eye_calib.offline.report.report import page
from hand_eye_calib.offline.report.style import (
    BAD,
    GRID,
    LOOK,
    MUTED,
    PARENT,
    Drawn,
    as_drawn,
    page_style,
    recordings_axis,
)

# Height of the figure of a vehicle, inches.
_HEIGHT = 3.9

# Largest number of vehicles with a figure. All vehicles are in the table.
_MAX_FIGURES = 12

# An axis is drawn if its standard deviation is below this share of the standard deviation of an
# unknown offset.
_DETERMINED = 0.3

_CAPTION = (
    "Offset from the installed pose along and about the parent's axes, from all sessions since the "
    "last change. The band is three standard deviations; it shrinks with the sessions. A dashed "
    "line is a change of the mount, a dotted line an alarm that the history does not confirm. An "
    "axis that the motion does not determine has no line."
)


class _Row(NamedTuple):
    """Row of a vehicle in the table of the page."""

    vehicle: str
    tone: str
    word: str
    since: str
    what: str
    n_sessions: int
    newest: str


def render_fleet(histories: Mapping[str, History]) -> str:
    """Return the page as HTML. Vehicles with the newest change or alarm are first.

    Parameters
    ----------
    histories : mapping of str to History
        History of each vehicle, by its name.
    """
    ordered = sorted(
        histories.items(),
        key=lambda item: item[1].newest_event_ns,
        reverse=True,
    )
    rows = [_row(name, history) for name, history in ordered]
    n_moved = sum(row.tone != "good" for row in rows)
    figures = [
        _figure(history, index)
        for index, (_, history) in enumerate(ordered[:_MAX_FIGURES])
    ]
    verdict = (
        f"{n_moved} of {counted(len(rows), 'mount')} to check"
        if n_moved
        else "No mount moved"
    )
    n_sessions = sum(row.n_sessions for row in rows)
    sentence = (
        f"{counted(len(rows), 'vehicle')}, {counted(n_sessions, 'session')}"
    )
    return page(
        Path(__file__).with_name("fleet_page.html"),
        "bad" if n_moved else "good",
        verdict,
        sentence,
        rows=rows,
        vehicles=[
            (row, history.events, _precision(history), figure)
            for row, (_, history), figure in zip(
                rows, ordered, figures, strict=False
            )
        ],
        n_without_figure=len(rows) - len(figures),
    )


def _row(name: str, history: History) -> _Row:
    """Return the row of a vehicle, with its newest change or alarm."""
    n_sessions = len(history.sessions)
    newest = history.sessions[-1].day
    if not history.events:
        return _Row(name, "good", "NOT MOVED", "", "", n_sessions, newest)
    event = history.events[-1]
    word = "MOVED" if history.changes else "ALARM"
    return _Row(name, "bad", word, event.day, event.what, n_sessions, newest)


def _precision(history: History) -> list[tuple[str, str, str]]:
    """Return the standard deviation of the offset after the first and the last session, per axis.

    Only sessions since the last change or alarm count.
    """
    first = history.offsets[max(history.cuts, default=0)]
    last = history.offsets[-1]
    return [
        (
            axes_in_words([axis]),
            f"\u00b1 {amount(axis, first.axes[axis].sigma)}",
            f"\u00b1 {amount(axis, last.axes[axis].sigma)}",
        )
        for axis in AXES
    ]


@page_style()
def _figure(history: History, number: int) -> Drawn:
    """Draw the offset of each axis over time; ``number`` is that of the vehicle on the page."""
    figure = Figure(figsize=(LOOK.width, _HEIGHT), layout="constrained")
    panels = figure.subplots(2, 3, sharex=True).ravel()
    starts_ns = [digest.start_ns for digest in history.digests]
    days = recordings_axis(panels, starts_ns, "session")
    cuts = sorted(history.cuts)
    for axis, panel in zip(AXES, panels, strict=True):
        _draw_axis(panel, axis, days, history.offsets, cuts)
        for event in history.events:
            style = "--" if event.is_change else ":"
            panel.axvline(days[event.index], color=BAD, lw=1.0, ls=style)
    return as_drawn(
        figure, f"mount-{number}", "Offset from the installed pose", _CAPTION
    )


def _draw_axis(
    panel: Any,
    axis: str,
    days: FloatArray,
    offsets: Sequence[change.Moved],
    cuts: Sequence[int],
) -> None:
    """Draw the offset of an axis and its band, interrupted at each change of the mount."""
    factor, unit = (100.0, "cm") if axis in "xyz" else (np.degrees(1.0), "deg")
    rows = [offset.axes[axis] for offset in offsets]
    values = factor * np.array([row.difference for row in rows])
    bands = factor * LOOK.sigmas * np.array([row.sigma for row in rows])
    unknown = factor * LOOK.sigmas * float(change.UNKNOWN[AXES.index(axis)])
    is_determined = bands < _DETERMINED * unknown
    name = f"about {ABOUT[axis]}" if axis in ABOUT else axis
    panel.set_title(
        f"{name}, {unit}" if is_determined.any() else f"{name}: not determined"
    )
    panel.axhline(0, color=GRID, lw=0.8)
    edges = [0, *cuts, len(days)]
    for start, end in pairwise(edges):
        part = np.arange(start, end)[is_determined[start:end]]
        panel.fill_between(
            days[part],
            (values - bands)[part],
            (values + bands)[part],
            color=PARENT,
            alpha=0.2,
            lw=0,
        )
        panel.plot(
            days[part],
            values[part],
            color=PARENT,
            marker="." if len(part) == 1 else "",
        )
    panel.tick_params(axis="y", colors=MUTED)
