"""Geometry that figures of the report draw."""

import dataclasses
import re

import numpy as np
import pytest

pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")


import pytest
from matplotlib.figure import Figure
from result_making import NAMES, calibration, dofs

import hand_eye_calib as hec
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.simulation.demo import DRIVE
from hand_eye_calib.extras.simulation.drive import simulate_drive
from hand_eye_calib.extras.simulation.options import REALISTIC
from hand_eye_calib.offline.report import evidence
from hand_eye_calib.offline.report.figures import figures_of
from hand_eye_calib.offline.report.style import LOOK, recordings_axis
from hand_eye_calib.offline.report.views import VIEWS, VIEWS_OF_VEHICLE


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
    # Matplotlib's own style has a white background, which is visible on a dark page.
    white = [name for name, figure in drawn.items() if "#ffffff" in figure.svg]
    assert not white


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


def test_streams_are_shown_on_one_clock_and_in_one_unit():
    drive = simulate_drive(3, dataclasses.replace(DRIVE, poses=200))
    seen = evidence.view_streams(drive.parent, drive.child, 0.5)
    (times_p, rates_p), (times_c, rates_c) = seen.rates
    assert (
        np.median(np.abs(np.interp(times_p, times_c, rates_c) - rates_p))
        < 0.01
        < rates_p.max()
    )
    assert [spans.shape for spans in seen.spans_s] == [(1, 2), (1, 2)]
    holed = evidence.view_streams(
        drive.parent, drive.child[np.r_[0:100, 150:400]], 0.5
    )
    assert [len(spans) for spans in holed.spans_s] == [1, 2]


def test_views_are_named_by_where_one_looks_from():
    from_where = {
        "from above": [0, 0, 1],
        "from the side": [0, -1, 0],
        "from the front": [1, 0, 0],
    }
    for (across, up), name in VIEWS_OF_VEHICLE.items():
        axes = np.eye(3)[["xyz".index(across), "xyz".index(up)]]
        assert np.cross(*axes).tolist() == from_where[name]
        (other,) = set("xyz") - {across, up}
        assert VIEWS[across + up] == f"along {other}"


@pytest.mark.parametrize("unknown", ["x", "y", "z"])
def test_an_unknown_axis_is_a_line_along_that_axis(unknown):
    sigmas = np.where([name == unknown for name in NAMES], np.inf, 1e-3)
    covariance = np.diag(np.full(6, 1e-6))
    covariance["xyz".index(unknown)] = np.inf
    result = calibration(
        T_parent_child=se3.exp(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])),
        covariance_measured=covariance,
        observability_measured=dofs(sigmas, unknown),
    )
    place = dict(zip("xyz", result.translation, strict=True))
    for panel, axes in zip(hec.plot(result).axes, VIEWS, strict=True):
        lines = ends_of_dashed_lines(panel)
        assert len(lines) == (unknown in axes)
        for ends in lines:
            for axis, coordinates in zip(axes, ends.T, strict=True):
                if axis == unknown:
                    assert np.ptp(coordinates) > 0.1
                else:
                    assert coordinates == pytest.approx(place[axis])


def ends_of_dashed_lines(panel):
    """Both ends of each dashed line where the panel shows it, (2, 2), in metres.

    The class of an endless line is private before matplotlib 3.9, so the drawn ends are read.
    """
    panel.figure.canvas.draw()
    to_metres = panel.transData.inverted()
    ends = []
    for line in panel.lines:
        if line.get_linestyle() == "--":
            drawn = line.get_transform().transform(line.get_xydata())
            ends.append(to_metres.transform(drawn))
    return ends


def test_an_unknown_direction_between_axes_is_drawn_as_it_is():
    direction = np.array([0.6, 0.0, 0.8])
    in_parent = np.diag(np.full(3, 1e-6)) + 9.0 * np.outer(direction, direction)
    covariance = np.diag(np.full(6, 1e-6))
    T = se3.exp(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))
    covariance[:3, :3] = T[:3, :3].T @ in_parent @ T[:3, :3]
    result = calibration(
        T_parent_child=T,
        covariance_measured=covariance,
        observability_measured=dofs([np.inf, 1e-3, np.inf, 1e-3, 1e-3, 1e-3]),
    )
    for panel, axes in zip(hec.plot(result).axes, VIEWS, strict=True):
        (ends,) = ends_of_dashed_lines(panel)
        along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        expected = direction[["xyz".index(axis) for axis in axes]]
        expected /= np.linalg.norm(expected)
        assert abs(along @ expected) == pytest.approx(1.0)
