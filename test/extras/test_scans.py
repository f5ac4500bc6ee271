"""Odometry from the points of two lidars in a room, made here by casting rays."""

from functools import partial

import numpy as np
import pytest
from bag_making import cloud_of_rows, write_messages
from numpy.testing import assert_allclose
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

import hand_eye_calib as hec
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.offline.cli.main import main

pytest.importorskip("small_gicp", reason="needs small_gicp")

POINTS = "sensor_msgs/msg/PointCloud2"
RATE = 10.0
COLUMNS = 180
ELEVATIONS = np.radians(np.linspace(-25.0, 25.0, 16))
START_NS = 1_700_000_000_000_000_000

# Lower and upper corners: of the room, seen from inside, and of what stands in it.
ROOM = np.array([[-6.0, -5.0, 0.0], [6.0, 5.0, 3.5]])
BOXES = np.array(
    [
        [[3.0, 2.0, 0.0], [4.0, 3.5, 2.0]],
        [[-4.5, 1.0, 0.0], [-3.0, 2.0, 1.2]],
        [[1.5, -4.5, 0.0], [2.5, -3.5, 3.0]],
        [[-4.0, -4.0, 0.0], [-3.5, -2.0, 1.8]],
    ]
)


def ranges(origins, directions):
    """Of rays (N, 3) that begin in the room."""
    with np.errstate(divide="ignore"):
        inverse = 1.0 / directions
    distances = np.maximum(
        *((corner - origins) * inverse for corner in ROOM)
    ).min(axis=1)
    for lower, upper in BOXES:
        first = (lower - origins) * inverse
        second = (upper - origins) * inverse
        near = np.minimum(first, second).max(axis=1)
        far = np.maximum(first, second).min(axis=1)
        distances = np.where(
            (near < far) & (near > 0.0), np.minimum(distances, near), distances
        )
    return distances


class Body:
    """Moves through the room by hand."""

    def __init__(self, seconds, rng):
        knots = np.arange(-1.5, seconds + 3.0, 1.5)
        sizes = (len(knots), 3)
        self.place = CubicSpline(
            knots, [0.0, 0.0, 1.5] + rng.uniform(-1, 1, sizes) * [0.8, 0.8, 0.3]
        )
        turns = Rotation.from_rotvec(rng.uniform(-0.35, 0.35, sizes))
        self.turn = RotationSpline(knots, turns)

    def poses(self, times):
        return se3.from_rotation_translation(
            self.turn(times).as_matrix(), self.place(times)
        )


def scans(body, T_body_lidar, too_far, count, rng):
    """Per scan: points (N, 3) and times (N,) since its first ray."""
    azimuth = -2.0 * np.pi * np.arange(COLUMNS) / COLUMNS
    level = np.cos(ELEVATIONS)
    x = np.outer(np.cos(azimuth), level)
    y = np.outer(np.sin(azimuth), level)
    rays = np.stack([x, y, np.tile(np.sin(ELEVATIONS), (COLUMNS, 1))], axis=-1)
    since = np.arange(COLUMNS) / COLUMNS / RATE
    for number in range(count):
        Ts = body.poses(number / RATE + since) @ T_body_lidar
        directions = np.einsum("cij,crj->cri", Ts[:, :3, :3], rays).reshape(
            -1, 3
        )
        distances = ranges(np.repeat(Ts[:, :3, 3], 16, axis=0), directions)
        distances += 0.01 * rng.standard_normal(len(distances)) + np.tile(
            too_far, COLUMNS
        )
        yield distances[:, None] * rays.reshape(-1, 3), np.repeat(since, 16)


def cloud(typestore, stamp_ns, points, times, frame, of_time="time"):
    """As drivers write it: rings of points with their times, ``time`` in s or ``t`` in ns."""
    kind = {"time": (7, "<f4", 1.0), "t": (6, "<u4", 1e9)}[of_time]
    formats = ["<f4", "<f4", "<f4", kind[1]]
    offsets = [0, 4, 8, 18]
    named = {
        "names": ["x", "y", "z", of_time],
        "formats": formats,
        "offsets": offsets,
    }
    layout = np.dtype({**named, "itemsize": 24})
    rows = np.zeros(len(points), layout)
    for axis, values in zip("xyz", points.T, strict=True):
        rows[axis] = values
    rows[of_time] = times * kind[2]
    field = typestore.types["sensor_msgs/msg/PointField"]
    fields = [
        field(
            name=name,
            offset=int(layout.fields[name][1]),
            datatype=code,
            count=1,
        )
        for name, code in zip(layout.names, (7, 7, 7, kind[0]), strict=True)
    ]
    return cloud_of_rows(typestore, stamp_ns, rows, fields, frame)


def test_two_lidars_from_their_points(tmp_path, capsys, no_figures):
    rng = np.random.default_rng(11)
    count = 70
    body = Body(7.0, rng)
    X = se3.exp([0.6, -0.3, 0.2, 0.1, -0.2, 0.9])
    messages = []
    too_far = 0.005 * rng.standard_normal((2, len(ELEVATIONS)))
    for k, (topic, T, of_time) in enumerate(
        (("/front", np.eye(4), "time"), ("/rear", X, "t"))
    ):
        for number, scan in enumerate(scans(body, T, too_far[k], count, rng)):
            stamp_ns = START_NS + round(number / RATE * 1e9)
            make = partial(
                cloud, stamp_ns=stamp_ns, frame=topic[1:], of_time=of_time
            )
            make = partial(make, points=scan[0], times=scan[1])
            messages.append((stamp_ns, topic, POINTS, make))
    bag = write_messages(tmp_path / "drive", messages)
    command = [
        "calibrate",
        str(bag),
        "--parent-topic",
        "/front",
        "--child-topic",
        "/rear",
    ]
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    assert "odometry from 70 scans" in capsys.readouterr().err
    result = hec.load(tmp_path / "out")
    off = se3.log(se3.inverse(X) @ result.T_parent_child)
    assert (
        np.linalg.norm(off.reshape(2, 3), axis=1) < [0.01, np.radians(0.1)]
    ).all()
    assert (result.parent_frame, result.child_frame) == ("front", "rear")
    # A pose is that of the middle of its scan. With a constant motion in each, 0.016 deg.
    middle_s = (np.arange(count) + 0.5 - 0.5 / COLUMNS) / RATE
    rings = np.round(180.0 + 2.0 * np.degrees(ELEVATIONS)).astype(int)
    for name, T_body_lidar, k in (("front", np.eye(4), 0), ("rear", X, 1)):
        kept = tmp_path / f"drive.{name}.odometry.npz"
        stored = np.load(kept)
        truth = body.poses(middle_s) @ T_body_lidar
        assert_allclose(
            stored["stamps_ns"], START_NS + middle_s * 1e9, atol=1e3
        )
        poses = se3.from_quat_xyzw(
            stored["poses"][:, :3], stored["poses"][:, 3:]
        )
        turns = [
            se3.log(se3.inverse(T[:-1]) @ T[1:])[:, 3:] for T in (poses, truth)
        ]
        assert np.degrees(np.sqrt(np.mean((turns[0] - turns[1]) ** 2))) < 0.0135
        # Without the correction, the ratio is 1.
        assert np.std(stored["too_far_m"][rings] - too_far[k]) < 0.6 * np.std(
            too_far[k]
        )
    # The second time, what is kept is read.
    before = kept.stat().st_mtime_ns
    with PoseBag(bag) as opened:
        assert len(opened.poses("/front", "/rear")) == 140
    assert kept.stat().st_mtime_ns == before
