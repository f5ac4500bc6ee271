"""Geometry that figures of the report draw."""

import dataclasses
import re

import numpy as np
import pytest

pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

from matplotlib.figure import Figure

from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.extras.simulation.demo import DRIVE
from hand_eye_calib.extras.simulation.drive import simulate_drive
from hand_eye_calib.extras.simulation.options import REALISTIC
from hand_eye_calib.offline.report import evidence
from hand_eye_calib.offline.report.figures import figures_of
from hand_eye_calib.offline.report.style import LOOK, recordings_axis


def points_of(svg):
    """Points of the lines and of the dots of a figure, by the variables of their colours."""
    points = {}
    for path, style in re.findall(
        r'<path d="([^"]*)"[^>]*style="([^"]*)"', svg
    ):
        colour = re.search(r"stroke: var\(--(\w+)\)", style)
        found = np.array(
            re.findall(r"[ML] ([\d.-]+) ([\d.-]+)", path), dtype=float
        )
        # Axes and ticks are shorter.
        if colour and len(found) > 20:
            points.setdefault(colour[1], []).append(found)
    dots = re.findall(
        r'<use [^>]*x="([\d.]+)" y="([\d.]+)" style="fill: var\(--child', svg
    )
    return points, np.array(dots, dtype=float)


def test_the_track_goes_through_the_dots_only_with_the_lever_arm():
    drive = simulate_drive(91, dataclasses.replace(DRIVE, poses=600), REALISTIC)
    child = dataclasses.replace(drive.child, measures="positions")
    frames = {"parent_frame": "lidar", "child_frame": "antenna"}
    snapshot = whole_snapshot(drive.parent, child, frames)
    calibration = snapshot.estimate()
    gathered = evidence.gather(calibration, snapshot)
    drawn = {
        figure.name: figure for figure in figures_of(calibration, gathered)
    }
    assert [name for _, name in drawn["track"].key] == [
        "lidar, no lever arm",
        "lidar, through the result",
        "antenna",
    ]
    lines, dots = points_of(drawn["track"].svg)
    assert 20 < len(dots) <= LOOK.max_dots
    medians = {}
    for colour in ("muted", "parent"):
        # The first line of a colour is in the left panel.
        path = lines[colour][0]
        # The path is simplified: points between its corners are on it, too.
        along = np.linspace(0, len(path) - 1, 2000)
        rows = np.arange(len(path))
        dense = np.column_stack(
            [np.interp(along, rows, axis) for axis in path.T]
        )
        distances = np.linalg.norm(dots[:, None] - dense, axis=2).min(axis=1)
        medians[colour] = np.median(distances)
    assert medians["parent"] < 0.5 * medians["muted"]


def test_the_turning_part_of_a_path_is_its_turn():
    times_s = np.arange(0.0, 100.0, 0.1)
    # Straight ahead at 1 m/s, but a circle of 2 m from 40 s on, for 12.6 s.
    rates = np.where((times_s > 40.0) & (times_s < 52.6), 0.5, 0.0)
    headings = np.cumsum(rates) * 0.1
    steps = 0.1 * np.column_stack(
        [np.cos(headings), np.sin(headings), 0 * headings]
    )
    part = evidence.turning_part(np.cumsum(steps, axis=0), times_s, 10.0)
    assert times_s[part.start] > 39.0
    assert times_s[part.stop - 1] < 54.0
    short = evidence.turning_part(
        np.cumsum(steps[:50], axis=0), times_s[:50], 10.0
    )
    assert short == slice(0, 50)


@pytest.mark.parametrize(
    ("starts_h", "hours"), [([0, 100], 110.0), ([0], 1.0), ([0, 0.2], 1.0)]
)
def test_an_axis_of_recordings_is_as_long_as_their_time(starts_h, hours):
    panel = Figure().subplots()
    stamps_ns = [round(hour * 3_600e9) for hour in starts_h]
    days = recordings_axis([panel], stamps_ns, "recording")
    first, last = panel.get_xlim()
    assert 24 * (last - first) == pytest.approx(hours)
    assert 24 * (days - days[0]) == pytest.approx(starts_h, abs=1e-4)


def test_recordings_of_one_time_are_drawn_by_their_number():
    panel = Figure().subplots()
    places = recordings_axis([panel], [0, 0, 0], "recording")
    assert places.tolist() == [1.0, 2.0, 3.0]
    assert panel.get_xlabel() == "number of the recording"
