"""Clouds of two lidars in the report: merged through the result, before and after."""

import re
from dataclasses import replace
from functools import cache, partial

import browser
import numpy as np
import pytest
from bag_making import (
    ODOMETRY,
    POINTS,
    cloud_message,
    pose_message,
    write_messages,
)
from ground_making import YARD, Machine

import hand_eye_calib as hec
from hand_eye_calib.core.assessment.comparison import with_comparison
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import Extrinsic
from hand_eye_calib.extras.clouds import merging
from hand_eye_calib.extras.clouds.figure import figures_of_clouds
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.offline.cli.main import main

# Noise of a range (m), as the machines have it.
RANGE_NOISE_M = 0.02


@cache
def machine():
    """A machine, and the scans of both lidars, one a second."""
    drive = Machine(31, duration_s=40.0)
    clouds = []
    for mount in (drive.T_base_parent, drive.T_base_child):
        scans = []
        for stamp_ns, points in drive.clouds(mount, 10):
            # Farther points are rays into the sky, cut by the simulation.
            is_near = np.linalg.norm(points, axis=1) < 58.0
            scans.append((stamp_ns, points[is_near]))
        clouds.append(scans)
    return drive, clouds


def write_bag(
    path, topics=("/a/points", "/b/points"), raised_m=0.0, storage="mcap"
):
    """Write the bag of the machine; ``raised_m`` raises the points of the child."""
    drive, clouds = machine()
    messages = []
    # A third sensor has no clouds. Its noise is 2 mm and 1 mrad.
    noise = np.random.default_rng(3).normal(size=(len(drive.child), 6))
    noise *= np.repeat([0.002, 0.001], 3)
    poses = drive.child.poses @ se3.exp(noise)
    third = replace(drive.child, poses=poses, sensor_frame="camera")
    streams = (("/a", drive.parent), ("/b", drive.child), ("/c", third))
    for topic, stream in streams:
        rows = se3.to_rows(stream.poses)
        for stamp_ns, row in zip(stream.stamps_ns.tolist(), rows, strict=True):
            make = pose_message(
                ODOMETRY, stamp_ns, row, "odom", stream.sensor_frame
            )
            messages.append((stamp_ns, topic, ODOMETRY, make))
    for topic, frame, scans, up_m in zip(
        ("/a/points", "/b/points"),
        ("lidar", "rear"),
        clouds,
        (0.0, raised_m),
        strict=True,
    ):
        for stamp_ns, points in scans if topic in topics else ():
            make = partial(
                cloud_message,
                stamp_ns=stamp_ns,
                points=np.add(points, [0.0, 0.0, up_m]),
                frame=frame,
            )
            # The recorder receives a cloud after its scan.
            messages.append((stamp_ns + 80_000_000, topic, POINTS, make))
    return write_messages(path, messages, storage)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = write_bag(tmp_path_factory.mktemp("clouds") / "bag")
    with pytest.warns(UserWarning, match="ground"):
        return path, hec.calibrate(path, parent_topic="/a", child_topic="/b")


def distances_from_walls(merged, points, low, high):
    """Distances (m) of the points that are at the height of the walls from the next wall.

    The points are moved back into the world of the machine, where the walls are known.
    """
    drive, _ = machine()
    parent = drive.parent
    instants_ns = merging._instants(parent, drive.child)
    T_picture_world, _ = merging._axes_of_picture(
        parent, instants_ns[0], np.empty((0, 3))
    )
    # Odometry begins at the identity.
    T_world = (drive.Ts_world_base[0] @ drive.T_base_parent) @ se3.inverse(
        T_picture_world
    )
    places = points @ T_world[:3, :3].T + T_world[:3, 3]
    places = places[(places[:, 2] > low) & (places[:, 2] < high)]
    lower, upper = YARD[:, 0], YARD[:, 1]
    outside = np.maximum(lower - places[:, None], places[:, None] - upper)
    return np.linalg.norm(np.maximum(outside, 0.0), axis=2).min(axis=1)


def test_walls_are_single_lines_after_and_not_before(recorded):
    _, result = recorded
    merged = merging.merge(result, result.recording)
    assert merged.is_upright
    assert merged.turn_rad > np.radians(60.0)
    of_parent = distances_from_walls(merged, merged.parent, 0.7, 2.0)
    before = distances_from_walls(merged, merged.before, 0.7, 2.0)
    after = distances_from_walls(merged, merged.after, 0.7, 2.0)
    assert len(after) > 300
    # The odometry drifts by some centimetres between the scans.
    assert np.median(of_parent) < 3 * RANGE_NOISE_M
    assert np.median(after) < 3 * RANGE_NOISE_M
    assert np.median(before) > 0.3
    surfaces = [
        merging.distances_from_surfaces(merged.parent, cloud)
        for cloud in (merged.before, merged.after)
    ]
    medians_m = [np.nanmedian(distances) for distances in surfaces]
    assert medians_m[1] < 2 * RANGE_NOISE_M
    assert medians_m[0] > 5 * medians_m[1]


def dots_of(svg, variable):
    """Dots of a colour in each of the four panels, as (N, 2) in the units of the page."""
    paths = re.findall(r'<path d="((?:M[\d. -]+h0)+)"[^>]*?var\(--(\w+)\)', svg)
    return [
        np.array(re.findall(r"M([\d.-]+) ([\d.-]+)h0", path), dtype=float)
        for path, colour in paths
        if colour == variable
    ]


def test_the_drawn_dots_of_both_colours_coincide_after(recorded):
    _, result = recorded
    (figure,) = figures_of_clouds(result, result.recording)
    assert figure.key == (("parent", "lidar"), ("child", "rear"))
    assert len(figure.svg) < 300_000
    parent = dots_of(figure.svg, "parent")
    child = dots_of(figure.svg, "child")
    # Before and after: from above, then from the side.
    assert len(parent) == len(child) == 4
    medians = []
    for own, other in zip(parent[:2], child[:2], strict=True):
        distances = np.linalg.norm(own[:, None] - other, axis=2).min(axis=0)
        medians.append(np.median(distances))
    before, after = medians
    # A dot has a size of 1 and a panel of 280 units.
    assert after < 2.0 < 5.0 < before


def test_a_report_with_clouds_is_printed_on_two_pages(recorded, tmp_path):
    page = recorded[1].report(tmp_path / "report.html")
    assert 'id="figure-clouds"' in page.read_text(encoding="utf-8")
    assert browser.printed_pages(page, tmp_path) == 2


def test_a_rig_has_a_picture_of_each_pair_of_lidars(tmp_path):
    bag = write_bag(tmp_path / "bag")
    rig = ["rig", str(bag), "--topics", "/a", "/b", "/c"]
    assert main([*rig, "--out", str(tmp_path / "out")]) == 0
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert re.findall(r'<figure[^>]*id="figure-(\w[^"]*)"', page) == [
        "views",
        "clouds-1",
    ]
    parent, child = [dots_of(page, colour)[1] for colour in ("parent", "child")]
    distances = np.linalg.norm(parent[:, None] - child, axis=2).min(axis=0)
    assert np.median(distances) < 2.0


def test_the_installed_transform_is_before(recorded):
    _, result = recorded
    T_installed = result.T_parent_child @ se3.exp([0.4, 0, 0, 0, 0, 0.1])
    compared = with_comparison(result, Extrinsic(T_installed, "cad.urdf"))
    merged = merging.merge(compared, result.recording)
    right = merging.merge(result, result.recording)
    exact = replace(result, T_parent_child=T_installed)
    assert merged.before == pytest.approx(
        merging.merge(exact, result.recording).after, abs=1e-9
    )
    assert merged.after == pytest.approx(right.after)
    (figure,) = figures_of_clouds(compared, result.recording)
    assert "left picture is as installed" in figure.caption


def test_a_wrong_result_is_visible(recorded):
    _, result = recorded
    wrong = replace(
        result,
        T_parent_child=result.T_parent_child @ se3.exp([0, 0, 0, 0, 0, 0.2]),
    )
    merged = merging.merge(wrong, result.recording)
    assert np.median(distances_from_walls(merged, merged.after, 0.7, 2.0)) > 0.2


def test_clouds_without_overlap_are_said_to_prove_nothing(tmp_path):
    path = write_bag(tmp_path / "bag", raised_m=30.0)
    result = hec.calibrate(
        path, parent_topic="/a", child_topic="/b", ground="off"
    )
    (figure,) = figures_of_clouds(result, result.recording)
    assert "proves nothing" in figure.caption


def points_between(rng, count, **fixed):
    """Points within 3 m of the origin, with some coordinates fixed."""
    points = []
    for axis in "xyz":
        if axis in fixed:
            points.append(np.full(count, fixed[axis]))
        else:
            points.append(rng.uniform(-3, 3, count))
    return np.column_stack(points)


def test_walls_are_parallel_to_an_axis_of_the_picture_if_a_sensor_moves_in_all_directions():
    rng = np.random.default_rng(5)
    # Floor and two walls of a room, with few points on the floor.
    floor = points_between(rng, 400, z=-1.0)
    wall = points_between(rng, 900, x=3.0)
    other_wall = points_between(rng, 800, y=-3.0)
    noise_m = 0.005 * rng.standard_normal((2100, 3))
    room = np.vstack([floor, wall, other_wall]) + noise_m
    rotation = se3.rotation_from_rpy([0.3, -0.4, 1.0])
    up = np.array([0.0, 0.0, 1.0])

    axis = merging._axis_of_surfaces(room @ rotation.T, up)

    true_up = rotation[:, 2]
    angle = np.arccos(axis @ true_up)
    assert np.degrees(angle) < 0.5


def test_one_lidar_alone_has_no_picture(tmp_path):
    path = write_bag(tmp_path / "bag", topics=("/a/points",))
    result = hec.calibrate(path, parent_topic="/a", child_topic="/b")
    assert figures_of_clouds(result, result.recording) == []
    drive, _ = machine()
    files = hec.calibrate(drive.parent, drive.child, checks=False)
    assert figures_of_clouds(files, files.recording) == []


@pytest.mark.parametrize("storage", ["mcap", "sqlite3", "rosbag1"])
def test_only_the_wanted_span_of_a_bag_is_read(tmp_path, storage):
    path = write_bag(tmp_path / "run.bag", storage=storage)
    with PoseBag(path) as bag:
        span_ns = (bag.start_ns + 10_000_000_000, bag.start_ns + 12_500_000_000)
        (run,) = bag.runs(["/a/points"], span_ns)
        (everything,) = bag.runs(["/a/points"])
    is_in_span = (everything.bag_ns >= span_ns[0]) & (
        everything.bag_ns < span_ns[1]
    )
    assert 0 < is_in_span.sum() < len(everything.bag_ns)
    assert run.bag_ns.tolist() == everything.bag_ns[is_in_span].tolist()
