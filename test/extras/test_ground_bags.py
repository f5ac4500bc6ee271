"""The ground in bags: layouts of clouds, kinds of lidars, and each interface."""

import json
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from bag_making import (
    JAZZY,
    ODOMETRY,
    POINTS,
    cloud_message,
    header,
    pose_message,
    write_messages,
)
from ground_cases import TILT, errors_of, machine
from ground_making import ELEVATIONS, START_NS
from numpy.testing import assert_allclose, assert_array_equal

import hand_eye_calib as hec
from hand_eye_calib.core.base.errors import ConfigError, NotEnoughDataError
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.span import Span
from hand_eye_calib.extras.ground import bags
from hand_eye_calib.formats.bags.points import rows_of_points
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.offline.cli.main import main

IMU = "sensor_msgs/msg/Imu"


def layout(names, formats, offsets, itemsize):
    return np.dtype(
        dict(names=names, formats=formats, offsets=offsets, itemsize=itemsize)
    )


def with_layout(message, dtype, rows=1, unused=0):
    """A message with the points of another one, in another layout of bytes.

    ``rows`` and ``unused`` are the height of an organised cloud, and bytes at the end of each row.
    """
    points = np.frombuffer(message.data.tobytes(), dtype="<f4").reshape(-1, 3)
    # As many NaN points as an organised cloud needs; drivers fill missing returns with NaN.
    missing = np.full((-len(points) % rows, 3), np.nan)
    points = np.concatenate([points, missing])
    cells = np.zeros(len(points), dtype=dtype)
    for axis, column in zip("xyz", points.T, strict=True):
        cells[axis] = column
    lines = cells.view(np.uint8).reshape(rows, -1)
    data = np.pad(lines, ((0, 0), (0, unused)), constant_values=7)
    field = JAZZY.types["sensor_msgs/msg/PointField"]
    codes = {"f4": 7, "f8": 8, "u2": 4}
    fields = []
    for name, (kind, offset) in dtype.fields.items():
        code = codes[kind.str[1:]]
        fields.append(field(name=name, offset=offset, datatype=code, count=1))
    return replace(
        message,
        height=rows,
        width=len(points) // rows,
        fields=fields,
        is_bigendian=dtype["x"].str.startswith(">"),
        point_step=dtype.itemsize,
        row_step=data.shape[1],
        data=data.ravel(),
        is_dense=not len(missing),
    )


SMALL = layout(["x", "y", "z"], ["<f4"] * 3, [0, 4, 8], 12)
# Layouts of points, and further arguments.
LAYOUTS = {
    "organised, with NaN": (SMALL, 16),
    "organised, rows with unused bytes": (SMALL, 16, 20),
    "big-endian": (layout(["x", "y", "z"], [">f4"] * 3, [0, 4, 8], 12),),
    "float64": (layout(["x", "y", "z"], ["<f8"] * 3, [0, 8, 16], 24),),
    "unused bytes": (
        layout(
            ["x", "y", "z", "ring"], ["<f4"] * 3 + ["<u2"], [4, 8, 12, 20], 32
        ),
    ),
    "z first": (layout(["z", "x", "y"], ["<f4"] * 3, [0, 8, 16], 22),),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_clouds_in_any_layout_have_the_same_points(name):
    _, clouds = machine()
    plain = cloud_message(JAZZY, START_NS, clouds[0][0][1], "lidar")
    expected = rows_of_points(plain)
    read = rows_of_points(with_layout(plain, *LAYOUTS[name]))
    for axis in "xyz":
        values = read[axis].astype(float)
        assert_allclose(values[np.isfinite(values)], expected[axis], rtol=1e-6)


def test_fields_with_the_same_name_are_no_damage():
    _, clouds = machine()
    plain = cloud_message(JAZZY, START_NS, clouds[0][0][1], "lidar")
    field = JAZZY.types["sensor_msgs/msg/PointField"]
    unused = [field(name="_", offset=0, datatype=2, count=1)] * 2
    read = rows_of_points(replace(plain, fields=[*plain.fields, *unused]))
    assert_array_equal(read["x"], rows_of_points(plain)["x"])


def from_above(drive, mount, rays):
    """One scan a second by other rays than those of a rotating lidar with 16 rings."""
    rng = np.random.default_rng(5)
    for row in range(0, len(drive.times_s), 100):
        T = drive.Ts_world_base[row] @ mount
        directions = rays(rng)
        ranges = drive._ranges(T[:3, 3], directions @ T[:3, :3].T)
        hit = ranges < 60.0
        noise_m = rng.normal(0, 0.02, hit.sum())
        stamp_ns = START_NS + round(drive.times_s[row] * 1e9)
        yield stamp_ns, (ranges[hit] + noise_m)[:, None] * directions[hit]


def directions_of(azimuths, elevations):
    level = np.cos(elevations)
    columns = [
        level * np.cos(azimuths),
        level * np.sin(azimuths),
        np.sin(elevations),
    ]
    return np.stack(columns, axis=1)


def livox(rng):
    """A pattern that does not repeat and has no rings: 70 deg wide, 77 deg high."""
    angles = rng.uniform(
        np.radians([-35, -38.5]), np.radians([35, 38.5]), (6000, 2)
    )
    return directions_of(*angles.T)


def rings(count):
    lowest, highest = ELEVATIONS[count]

    def rays(rng):
        elevation = np.radians(np.linspace(lowest, highest, count))
        azimuth = np.radians(np.arange(0.0, 360.0, 2.0))
        return directions_of(*map(np.ravel, np.meshgrid(azimuth, elevation)))

    return rays


REFUSED = "scans contain the ground: it must be visible between 5 and 12 m, and the z axis"
# Rays, height of the lidar (m), whether it hangs upside down, and the message if it is refused.
LIDARS = {
    "livox": (livox, 1.4, False, ""),
    "16 rings at 4 m": (rings(16), 4.0, False, REFUSED),
    "64 rings at 4 m": (rings(64), 4.0, False, ""),
    "16 rings at 0.3 m": (rings(16), 0.3, False, ""),
    "upside down": (rings(16), 1.4, True, REFUSED),
}


@pytest.mark.parametrize("name", LIDARS)
def test_lidars_of_all_kinds_are_right_or_refused(name):
    rays, height_m, is_upside_down, message = LIDARS[name]
    drive, _ = machine()
    mount = se3.from_rotation_translation(
        se3.rotation_from_rpy(np.radians([3.0, -4.0, 2.0])),
        np.array([0.8, 0.0, height_m]),
    )
    if is_upside_down:
        mount[:3, :3] = mount[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    poses = hec.Trajectory(
        drive.parent.stamps_ns, drive.Ts_world_base[::10] @ mount
    )
    clouds = from_above(drive, mount, rays)
    if message:
        with pytest.raises(NotEnoughDataError, match=message):
            hec.ground_from_clouds(clouds, poses)
        return
    track = hec.ground_from_clouds(clouds, poses)
    assert np.median(track.heights_m) == pytest.approx(height_m, abs=0.02)
    up = np.median(track.ups, axis=0)
    assert np.abs(up - mount[2, :3]).max() < np.radians(0.3)


def test_empty_clouds_are_scans_without_ground():
    drive, clouds = machine()
    some = [
        (stamp_ns, points[: len(points) * (row % 5 > 0)])
        for row, (stamp_ns, points) in enumerate(clouds[0])
    ]
    track = hec.ground_from_clouds(some, drive.parent)
    assert len(track) == 56
    with pytest.raises(
        NotEnoughDataError, match="0 of 70 scans contain the ground"
    ):
        hec.ground_from_clouds(
            [(stamp_ns, points[:0]) for stamp_ns, points in some], drive.parent
        )


def test_a_deck_that_hides_the_ground_is_no_ground():
    """The lidar sees the deck it stands on, 5 m long, and nothing below."""
    drive, _ = machine()
    mount = drive.T_base_parent
    rays = rings(16)
    deck = []
    for row in range(70):
        directions = rays(None)
        up = mount[2, :3]
        with np.errstate(divide="ignore"):
            ranges = -1.0 / (directions @ up)
        points = ranges[:, None] * directions
        is_deck = (ranges > 0) & (np.linalg.norm(points, axis=1) < 5.0)
        deck.append((START_NS + row * 10**9, points[is_deck]))
    with pytest.raises(NotEnoughDataError, match=REFUSED):
        hec.ground_from_clouds(deck, drive.parent)


def imu_message(typestore, stamp_ns, force, frame):
    types = typestore.types
    vector = partial(types["geometry_msgs/msg/Vector3"])
    nothing = np.zeros(9)
    return types[IMU](
        header(typestore, stamp_ns, frame),
        types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
        nothing,
        vector(0.0, 0.0, 0.0),
        nothing,
        vector(*force.tolist()),
        nothing,
    )


def odometry_messages(trajectory, topic):
    rows = se3.to_rows(trajectory.poses)
    for stamp_ns, row in zip(trajectory.stamps_ns.tolist(), rows, strict=True):
        message = pose_message(
            ODOMETRY, stamp_ns, row, "odom", trajectory.sensor_frame
        )
        yield stamp_ns, topic, ODOMETRY, message


def write_drive(path, child_frame="rear", with_imu=False, names="xyz"):
    """Write a bag of two lidars, or of a lidar and an IMU, with their odometry."""
    drive, clouds = machine()
    messages = [
        *odometry_messages(drive.parent, "/a"),
        *odometry_messages(drive.child, "/b"),
    ]
    third = replace(drive.child, sensor_frame="camera")
    messages += odometry_messages(third, "/c")
    for topic, frame, scans in (
        ("/a/points", "lidar", clouds[0]),
        ("/b/points", "rear", clouds[1]),
    ):
        if topic == "/b/points" and with_imu:
            stamps_ns, forces = drive.accelerations(drive.T_base_child)
            for stamp_ns, force in zip(
                stamps_ns[::4].tolist(), forces[::4], strict=True
            ):
                make = partial(
                    imu_message,
                    stamp_ns=stamp_ns,
                    force=force,
                    frame=child_frame,
                )
                messages.append((stamp_ns, "/b/imu", IMU, make))
            continue
        frame = child_frame if frame == "rear" else frame
        for stamp_ns, points in scans:
            make = partial(
                cloud_message, stamp_ns=stamp_ns, points=points, frame=frame
            )
            make = partial(make, names=names)
            messages.append((stamp_ns, topic, POINTS, make))
    write_messages(path, messages)
    return drive


def calibrated(folder, bag, capsys, *options):
    topics = ["--parent-topic", "/a", "--child-topic", "/b"]
    code = main(
        ["calibrate", str(bag), *topics, "--out", str(folder / "out"), *options]
    )
    return code, hec.load(folder / "out"), capsys.readouterr()


@pytest.mark.parametrize("with_imu", [False, True])
def test_a_bag_uses_the_ground_by_itself(
    tmp_path, capsys, no_figures, with_imu
):
    drive = write_drive(tmp_path / "bag", with_imu=with_imu)
    _, result, printed = calibrated(tmp_path, tmp_path / "bag", capsys)
    second = "gravity from /b/imu" if with_imu else "ground from /b/points"
    assert f"ground from /a/points and {second} are used" in printed.err
    assert result.ground.is_joined
    assert result.hidden == (["z"] if with_imu else [])
    assert "roll by the ground" in printed.out
    assert errors_of(result, drive)[3:5].max() < TILT
    assert hec.load(tmp_path / "out").ground == result.ground


def test_ground_off_uses_the_motion_alone(tmp_path, capsys, no_figures):
    write_drive(tmp_path / "bag")
    code, result, printed = calibrated(
        tmp_path, tmp_path / "bag", capsys, "--ground", "off"
    )
    assert (code, result.ground, result.hidden) == (3, None, ["z"])
    assert "are used" not in printed.err


def test_clouds_in_another_frame_are_not_used(tmp_path, capsys, no_figures):
    write_drive(tmp_path / "bag", child_frame="base_link")
    _, result, printed = calibrated(tmp_path, tmp_path / "bag", capsys)
    assert result.ground is None
    assert "are used" not in printed.err


def test_clouds_that_cannot_be_read_are_a_note(tmp_path, capsys, no_figures):
    write_drive(tmp_path / "bag", names="abc")
    code, result, printed = calibrated(tmp_path, tmp_path / "bag", capsys)
    assert (code, result.ground) == (3, None)
    assert (
        "not used: /a/points: points have no x, y, z, but a, b, c"
        in printed.err
    )


def test_pairs_of_a_rig_read_the_ground_of_the_first_sensor_once(
    tmp_path, monkeypatch
):
    drive = write_drive(tmp_path / "bag")
    reads = []

    def ground(clouds, stream, beside):
        reads.append(stream.sensor_frame)
        return hec.ground_from_clouds(clouds, stream, beside)

    monkeypatch.setattr(bags, "ground_from_clouds", ground)
    for child in (drive.child, drive.child[:-1]):
        pairs, _ = bags.verticals_of_bag(
            [tmp_path / "bag"], whole_snapshot(drive.parent, child, {})
        )
        assert len(pairs) == 1
    assert reads == ["lidar", "rear", "rear"]


# ------------------------------------------------------------------- all interfaces and commands

TOPICS = ("--parent-topic", "/a", "--child-topic", "/b")


def by_command(*words):
    """Calibrate by a command with the bag, which saves its result."""

    def run(bag, out, ground):
        main([*words, str(bag), *TOPICS, "--out", str(out), "--ground", ground])
        return hec.load(out)

    return run


def by_batch(bag, out, ground):
    main(
        [
            "batch",
            str(bag),
            *TOPICS,
            "--out",
            str(out),
            "--ground",
            ground,
            "--no-report",
        ]
    )
    return hec.load(out / bag.name)


def by_recordings(bag, out, ground):
    again = out.parent / "again"
    shutil.copytree(bag, again)
    main(
        [
            "calibrate",
            str(bag),
            str(again),
            *TOPICS,
            "--out",
            str(out),
            "--ground",
            ground,
        ]
    )
    return hec.load(out)


def by_rig(bag, out, ground):
    arguments = [
        "--topics",
        "/a",
        "/b",
        "/c",
        "--out",
        str(out),
        "--ground",
        ground,
    ]
    main(["rig", str(bag), *arguments])
    return hec.load(out / "rear")


def by_python(bag, out, ground):
    return hec.calibrate(
        bag, parent_topic="/a", child_topic="/b", ground=ground
    )


INTERFACES = {
    "calibrate": by_command("calibrate"),
    "replay": by_command("replay"),
    "batch": by_batch,
    "recordings": by_recordings,
    "rig": by_rig,
    "Python": by_python,
}


@pytest.fixture(scope="module")
def bag_of_lidars(tmp_path_factory):
    """A bag of two lidars with clouds, and of a third sensor that has only poses."""
    path = tmp_path_factory.mktemp("lidars") / "bag"
    write_drive(path)
    return path


def test_a_part_of_a_recording_uses_the_clouds_of_this_part(
    bag_of_lidars, tmp_path, capsys
):
    with PoseBag(bag_of_lidars) as bag:
        stream, _ = bag.trajectory("/a")
        part = Span(5.0, 15.0).cut([stream], ["/a"])[0]
        whole_ns = [
            stamp_ns for stamp_ns, _ in bags._clouds(bag, "/a/points", stream)
        ]
        part_ns = [
            stamp_ns for stamp_ns, _ in bags._clouds(bag, "/a/points", part)
        ]
    elapsed_s = (np.array(part_ns) - stream.stamps_ns[0]) * 1e-9
    assert 0 < len(part_ns) < len(whole_ns)
    assert elapsed_s.min() >= 4.0
    assert elapsed_s.max() <= 16.0
    limits = ("--start", "2", "--end", str(int(stream.duration_s) - 2))
    calibrated(tmp_path, bag_of_lidars, capsys, *limits)
    assert (tmp_path / "out" / "report.html").exists()


@pytest.mark.filterwarnings("ignore:ground from")
@pytest.mark.parametrize("ground", ["auto", "off"])
@pytest.mark.parametrize("interface", INTERFACES)
def test_every_interface_uses_the_ground_of_a_bag(
    interface, ground, bag_of_lidars, tmp_path, no_figures
):
    result = INTERFACES[interface](bag_of_lidars, tmp_path / "out", ground)
    assert result.hidden == ([] if ground == "auto" else ["z"])


def test_python_names_what_it_uses(bag_of_lidars):
    with pytest.warns(
        UserWarning, match="ground from /a/points and ground from /b/points are"
    ):
        hec.calibrate(
            bag_of_lidars, parent_topic="/a", child_topic="/b", checks=False
        )


@pytest.mark.parametrize(
    ("ground", "child", "message"),
    [
        ("none", None, "must be 'auto' or 'off'"),
        ("auto", "b.tum", "call calibrate_on_ground"),
    ],
)
def test_python_refuses_the_ground_of_trajectories(ground, child, message):
    with pytest.raises(ConfigError, match=message):
        hec.calibrate("a.tum", child, ground=ground)


def test_the_list_names_ground_and_gravity(tmp_path, capsys):
    write_drive(tmp_path / "bag", with_imu=True)
    main(["calibrate", str(tmp_path / "bag"), "--list", "--json"])
    rows = {
        row["name"]: row
        for row in json.loads(capsys.readouterr().out)["topics"]
    }
    assert rows["/a"]["measures"] == ""
    assert (rows["/a/points"]["measures"], rows["/a/points"]["frames"]) == (
        "ground",
        ["lidar"],
    )
    assert (rows["/b/imu"]["measures"], rows["/b/imu"]["frames"]) == (
        "gravity",
        ["rear"],
    )
