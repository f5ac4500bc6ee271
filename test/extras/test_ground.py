"""The ground and gravity beside the motion, on simulated machines."""

import json
import shutil
from dataclasses import replace
from functools import cache, partial

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
from ground_making import ELEVATIONS, START_NS, Machine
from published_data import data_folder

import hand_eye_calib as hec
from hand_eye_calib.core.base.errors import ConfigError, InputError, NotEnoughDataError
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.ground import bags
from hand_eye_calib.extras.ground.bags import vertical_topics, vertical_track
from hand_eye_calib.extras.ground.planes import ground_of
from hand_eye_calib.extras.ground.tracks import driving_direction, turning_axis
from hand_eye_calib.formats.bags.points import rows_of_points
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.offline.cli.main import main

IMU = "sensor_msgs/msg/Imu"
# Targets of the ground: z (m), roll and pitch (rad).
Z_M = 0.02
TILT = np.radians(0.15)


@cache
def machine(place="yard", noise=1.0):
    """A machine, and the scans of both lidars, one a second."""
    drive = Machine(3, place, 70.0, noise=noise)
    mounts = (drive.T_base_parent, drive.T_base_child)
    return drive, [list(drive.clouds(mount, 10)) for mount in mounts]


def tracks_of_lidars(drive, clouds):
    streams = (drive.parent, drive.child)
    return [hec.ground_from_clouds(*both) for both in zip(clouds, streams, strict=True)]


def tracks_of_lidar_and_imu(drive, clouds):
    ground = hec.ground_from_clouds(clouds[0], drive.parent, "gravity")
    accelerations = drive.accelerations(drive.T_base_child)
    return [ground, hec.gravity_from_accelerations(*accelerations, drive.child)]


def errors_of(result, drive):
    """Errors along (m) and about (rad) the axes of the parent."""
    return np.abs(se3.deviation(result.T_parent_child, drive.T_parent_child))


def test_two_lidars_on_a_flat_yard_get_all_six_axes():
    drive, clouds = machine()
    alone = hec.calibrate(drive.parent, drive.child)
    assert alone.hidden == ["z"]
    result = hec.calibrate_on_ground(
        drive.parent, drive.child, *tracks_of_lidars(drive, clouds)
    )
    errors = errors_of(result, drive)
    assert result.hidden == []
    assert result.verdict.value == "USE"
    assert errors[2] < Z_M
    assert errors[3:5].max() < TILT
    assert (errors < 3.3 * result.sigmas).all()
    assert result.headline.endswith("roll, pitch and z are mostly from the ground")
    assert [axis.name for axis in result.ground.axes] == ["roll", "pitch", "z"]
    assert not np.isfinite(result.ground.axes[2].motion_sigma)


def test_without_noise_the_ground_is_exact():
    drive, clouds = machine(noise=0.0)
    result = hec.calibrate_on_ground(
        drive.parent, drive.child, *tracks_of_lidars(drive, clouds)
    )
    assert errors_of(result, drive)[2:5].max() < 2e-3


@pytest.mark.parametrize("place", ["yard", "slope"])
def test_a_slope_does_not_turn_the_mount_of_a_lidar_and_an_imu(place):
    drive, clouds = machine(place)
    tracks = tracks_of_lidar_and_imu(drive, clouds)
    result = hec.calibrate_on_ground(drive.parent, drive.child, *tracks)
    assert result.hidden == ["z"]
    assert errors_of(result, drive)[3:5].max() < TILT
    assert (result.ground.parent, result.ground.child) == ("ground", "gravity")
    tilts = [axis.ground - axis.motion for axis in result.ground.axes]
    assert np.abs(tilts).max() < np.radians(0.5)


def test_on_a_ramp_the_ground_agrees_with_the_motion():
    drive, clouds = machine("ramp")
    result = hec.calibrate_on_ground(
        drive.parent, drive.child, *tracks_of_lidars(drive, clouds)
    )
    assert result.ground.is_joined
    z = result.ground.axes[2]
    assert z.motion_sigma < 0.05
    assert z.ground == pytest.approx(z.motion, abs=0.05)
    assert errors_of(result, drive)[2] < Z_M


def test_attitudes_of_two_ins_give_roll_and_pitch():
    drive, _ = machine()
    streams = []
    for T_base_sensor, frame in ((drive.T_base_parent, "a"), (drive.T_base_child, "b")):
        Ts = drive.Ts_world_base[::10] @ T_base_sensor
        streams.append(hec.Trajectory(drive.parent.stamps_ns, Ts, frame))
    verticals = [hec.gravity_from_attitude(stream) for stream in streams]
    result = hec.calibrate_on_ground(*streams, *verticals)
    assert errors_of(result, drive)[3:5].max() < 1e-4


# ------------------------------------------------------------------- wrong ground


def test_a_tilted_plane_is_not_joined_and_named():
    drive, clouds = machine()
    parent, child = tracks_of_lidars(drive, clouds)
    turn = se3.rotation_from_rpy([np.radians(4.0), 0.0, 0.0])
    wrong = replace(child, ups=child.ups @ turn.T)
    result = hec.calibrate_on_ground(drive.parent, drive.child, parent, wrong)
    assert result.hidden == ["z"]
    assert not result.ground.is_joined
    (reason,) = [reason for reason in result.reasons if reason.rule == "ground"]
    assert {*reason.axes} <= {"roll", "pitch"}
    assert "by the motion" in reason.sentence
    assert 'ground="off"' in reason.what_to_do


def test_a_loading_edge_beside_a_ramp_is_not_joined():
    drive, clouds = machine("ramp")
    parent, child = tracks_of_lidars(drive, clouds)
    on_edge = replace(child, heights_m=child.heights_m - 1.2)
    result = hec.calibrate_on_ground(drive.parent, drive.child, parent, on_edge)
    assert not result.ground.is_joined
    assert [reason.axes for reason in result.reasons if reason.rule == "ground"] == [
        ("z",)
    ]


def test_scans_of_a_loading_edge_are_outliers():
    drive, clouds = machine()
    scans = []
    for number, (stamp_ns, points) in enumerate(clouds[1]):
        # A quarter of the scans see a platform, 0.6 m high.
        scans.append((stamp_ns, np.add(points, [0.0, 0.0, 0.6 * (number % 4 == 0)])))
    tracks = tracks_of_lidars(drive, (clouds[0], scans))
    result = hec.calibrate_on_ground(drive.parent, drive.child, *tracks)
    assert np.ptp(tracks[1].heights_m) > 0.5
    assert errors_of(result, drive)[2] < Z_M


def test_walls_and_ceilings_are_no_ground():
    drive, clouds = machine()
    up, ahead = turning_axis(drive.parent), driving_direction(drive.parent)
    plane = ground_of(clouds[0][0][1], up, ahead, 4.0)
    assert plane.height_m == pytest.approx(drive.T_base_parent[2, 3], abs=0.05)
    grid = np.stack(
        np.meshgrid(np.linspace(-8, 8, 60), np.linspace(-8, 8, 60)), -1
    ).reshape(-1, 2)
    ceiling = np.column_stack([grid, np.full(len(grid), 3.0)])
    wall = np.column_stack([np.full(len(grid), 3.0), grid])
    assert ground_of(ceiling, up, ahead, 4.0) is None
    assert ground_of(wall, up, ahead, 4.0) is None
    assert ground_of(np.empty((0, 3)), up, ahead, 4.0) is None


def test_tall_grass_on_one_side_widens_sigma():
    drive, clouds = machine()
    to_base = drive.T_base_child
    scans = []
    for stamp_ns, points in clouds[1]:
        in_base = points @ to_base[:3, :3].T + to_base[:3, 3]
        is_grass = (in_base[:, 1] > 1.0) & (in_base[:, 2] < 0.3)
        up = to_base[2, :3]
        scans.append((stamp_ns, points + np.outer(0.12 * is_grass, up)))
    parent, child = tracks_of_lidars(drive, clouds)
    grassy = hec.ground_from_clouds(scans, drive.child)
    assert grassy.bend_rad > 3 * child.bend_rad
    sigmas = []
    for track in (child, grassy):
        result = hec.calibrate_on_ground(drive.parent, drive.child, parent, track)
        sigmas.append(result.ground.axes[0].ground_sigma)
        assert (errors_of(result, drive) < 3.3 * result.sigmas).all()
    assert sigmas[1] > 1.2 * sigmas[0]


def test_too_few_scans_with_ground_are_an_error():
    drive, clouds = machine()
    high = [
        (stamp_ns, np.add(points, [0.0, 0.0, 30.0])) for stamp_ns, points in clouds[0]
    ]
    with pytest.raises(NotEnoughDataError, match="0 of 70 scans contain the ground"):
        hec.ground_from_clouds(high, drive.parent)


def test_accelerations_without_gravity_are_an_error():
    drive, _ = machine()
    stamps_ns, forces = drive.accelerations(drive.T_base_child)
    with pytest.raises(NotEnoughDataError, match="not that of gravity"):
        hec.gravity_from_accelerations(stamps_ns, forces - [0, 0, 9.81], drive.child)
    with pytest.raises(NotEnoughDataError, match="less than 15 s"):
        hec.gravity_from_accelerations(stamps_ns[:100], forces[:100], drive.child)


def test_a_real_imu_without_gravity_is_refused():
    bag = data_folder() / "bags" / "fuse" / "turtlebot3.bag"
    poses = hec.read_trajectory(bag, topic="/odom")
    with PoseBag(bag) as messages:
        assert vertical_topics(messages) == {"/imu": ("gravity", "base_footprint")}
        with pytest.raises(NotEnoughDataError, match="must not subtract gravity"):
            vertical_track(messages, "/imu", poses, "ground")


def test_a_straight_drive_has_no_vertical():
    stamps_ns = START_NS + np.arange(200) * 10**8
    straight = hec.Trajectory.from_quat_xyzw(
        stamps_ns,
        np.column_stack([np.arange(200), np.zeros((200, 2))]),
        [[0, 0, 0, 1.0]] * 200,
    )
    with pytest.raises(NotEnoughDataError, match="does not turn"):
        hec.ground_from_clouds([], straight)


def test_arguments_of_a_wrong_type_are_an_error():
    drive, _ = machine()
    with pytest.raises(InputError, match="parent_ground"):
        hec.calibrate_on_ground(drive.parent, drive.child, 1.8, 1.1)


# ------------------------------------------------------------------- bags


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
        layout(["x", "y", "z", "ring"], ["<f4"] * 3 + ["<u2"], [4, 8, 12, 20], 32),
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
        np.testing.assert_allclose(
            values[np.isfinite(values)], expected[axis], rtol=1e-6
        )


def test_fields_with_the_same_name_are_no_damage():
    _, clouds = machine()
    plain = cloud_message(JAZZY, START_NS, clouds[0][0][1], "lidar")
    field = JAZZY.types["sensor_msgs/msg/PointField"]
    unused = [field(name="_", offset=0, datatype=2, count=1)] * 2
    read = rows_of_points(replace(plain, fields=[*plain.fields, *unused]))
    np.testing.assert_array_equal(read["x"], rows_of_points(plain)["x"])


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
    columns = [level * np.cos(azimuths), level * np.sin(azimuths), np.sin(elevations)]
    return np.stack(columns, axis=1)


def livox(rng):
    """A pattern that does not repeat and has no rings: 70 deg wide, 77 deg high."""
    angles = rng.uniform(np.radians([-35, -38.5]), np.radians([35, 38.5]), (6000, 2))
    return directions_of(*angles.T)


def rings(count):
    lowest, highest = ELEVATIONS[count]

    def rays(rng):
        elevation = np.radians(np.linspace(lowest, highest, count))
        azimuth = np.radians(np.arange(0.0, 360.0, 2.0))
        return directions_of(*map(np.ravel, np.meshgrid(azimuth, elevation)))

    return rays


REFUSED = (
    "scans contain the ground: it must be visible between 5 and 12 m, and the z axis"
)
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
    poses = hec.Trajectory(drive.parent.stamps_ns, drive.Ts_world_base[::10] @ mount)
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
    with pytest.raises(NotEnoughDataError, match="0 of 70 scans contain the ground"):
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
        message = pose_message(ODOMETRY, stamp_ns, row, "odom", trajectory.sensor_frame)
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
                    imu_message, stamp_ns=stamp_ns, force=force, frame=child_frame
                )
                messages.append((stamp_ns, "/b/imu", IMU, make))
            continue
        frame = child_frame if frame == "rear" else frame
        for stamp_ns, points in scans:
            make = partial(cloud_message, stamp_ns=stamp_ns, points=points, frame=frame)
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
def test_a_bag_uses_the_ground_by_itself(tmp_path, capsys, no_figures, with_imu):
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
    assert "not used: /a/points: points have no x, y, z, but a, b, c" in printed.err


def test_pairs_of_a_rig_read_the_ground_of_the_first_sensor_once(tmp_path, monkeypatch):
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
    arguments = ["--topics", "/a", "/b", "/c", "--out", str(out), "--ground", ground]
    main(["rig", str(bag), *arguments])
    return hec.load(out / "rear")


def by_python(bag, out, ground):
    return hec.calibrate(bag, parent_topic="/a", child_topic="/b", ground=ground)


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
        hec.calibrate(bag_of_lidars, parent_topic="/a", child_topic="/b", checks=False)


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
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)["topics"]}
    assert rows["/a"]["measures"] == ""
    assert (rows["/a/points"]["measures"], rows["/a/points"]["frames"]) == (
        "ground",
        ["lidar"],
    )
    assert (rows["/b/imu"]["measures"], rows["/b/imu"]["frames"]) == (
        "gravity",
        ["rear"],
    )
