"""The ground and gravity beside the motion, on simulated machines."""

from dataclasses import replace

import numpy as np
import pytest
from ground_cases import TILT, Z_M, errors_of, machine
from ground_making import START_NS
from published_data import data_folder

import hand_eye_calib as hec
from hand_eye_calib.core.base.errors import InputError, NotEnoughDataError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.ground.bags import vertical_topics, vertical_track
from hand_eye_calib.extras.ground.planes import ground_of
from hand_eye_calib.extras.ground.tracks import driving_direction, turning_axis
from hand_eye_calib.formats.bags.reader import PoseBag

IMU = "sensor_msgs/msg/Imu"


def tracks_of_lidars(drive, clouds):
    streams = (drive.parent, drive.child)
    return [
        hec.ground_from_clouds(*both)
        for both in zip(clouds, streams, strict=True)
    ]


def tracks_of_lidar_and_imu(drive, clouds):
    ground = hec.ground_from_clouds(clouds[0], drive.parent, "gravity")
    accelerations = drive.accelerations(drive.T_base_child)
    return [ground, hec.gravity_from_accelerations(*accelerations, drive.child)]


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
    assert result.headline.endswith(
        "roll, pitch and z are mostly from the ground"
    )
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
    for T_base_sensor, frame in (
        (drive.T_base_parent, "a"),
        (drive.T_base_child, "b"),
    ):
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
    assert [
        reason.axes for reason in result.reasons if reason.rule == "ground"
    ] == [("z",)]


def test_scans_of_a_loading_edge_are_outliers():
    drive, clouds = machine()
    scans = []
    for number, (stamp_ns, points) in enumerate(clouds[1]):
        # A quarter of the scans see a platform, 0.6 m high.
        scans.append(
            (stamp_ns, np.add(points, [0.0, 0.0, 0.6 * (number % 4 == 0)]))
        )
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
        result = hec.calibrate_on_ground(
            drive.parent, drive.child, parent, track
        )
        sigmas.append(result.ground.axes[0].ground_sigma)
        assert (errors_of(result, drive) < 3.3 * result.sigmas).all()
    assert sigmas[1] > 1.2 * sigmas[0]


def test_too_few_scans_with_ground_are_an_error():
    drive, clouds = machine()
    high = [
        (stamp_ns, np.add(points, [0.0, 0.0, 30.0]))
        for stamp_ns, points in clouds[0]
    ]
    with pytest.raises(
        NotEnoughDataError, match="0 of 70 scans contain the ground"
    ):
        hec.ground_from_clouds(high, drive.parent)


def test_accelerations_without_gravity_are_an_error():
    drive, _ = machine()
    stamps_ns, forces = drive.accelerations(drive.T_base_child)
    with pytest.raises(NotEnoughDataError, match="not that of gravity"):
        hec.gravity_from_accelerations(
            stamps_ns, forces - [0, 0, 9.81], drive.child
        )
    with pytest.raises(NotEnoughDataError, match="less than 15 s"):
        hec.gravity_from_accelerations(
            stamps_ns[:100], forces[:100], drive.child
        )


def test_a_real_imu_without_gravity_is_refused():
    bag = data_folder() / "bags" / "fuse" / "turtlebot3.bag"
    poses = hec.read_trajectory(bag, topic="/odom")
    with PoseBag(bag) as messages:
        assert vertical_topics(messages) == {
            "/imu": ("gravity", "base_footprint")
        }
        with pytest.raises(
            NotEnoughDataError, match="must not subtract gravity"
        ):
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
