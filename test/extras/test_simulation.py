"""The simulator: exact relations without noise, the statistics of each kind of noise, and the
likeness to the published drives.
"""

import dataclasses
import functools

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from published_data import data_folder
from scipy.spatial.transform import Rotation

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import motion_pairs
from hand_eye_calib.extras.simulation import options
from hand_eye_calib.extras.simulation import simulate as simulate_command
from hand_eye_calib.extras.simulation.drive import simulate_drive, surface
from hand_eye_calib.formats.trajectory_files.reading import read_trajectory

# --- the drive ------------------------------------------------------------------------


def test_noise_free_sensors_move_as_one_body():
    drive = simulate_drive(4)
    assert drive == simulate_drive(4) != simulate_drive(5)
    pairs = motion_pairs(drive.parent.poses, drive.child.poses, "B5")
    assert_allclose(
        pairs.Ts_parenti_parentj @ drive.T_parent_child,
        drive.T_parent_child @ pairs.Ts_childi_childj,
        atol=1e-12,
    )
    assert_allclose(
        drive.parent.poses
        @ drive.T_parent_child
        @ se3.inverse(drive.child.poses),
        np.tile(drive.T_pw_cw, (100, 1, 1)),
        atol=1e-12,
    )


def test_sensors_at_different_rates_are_on_one_body():
    config = dataclasses.replace(
        options.DriveConfig(),
        parent_rate=200.0,
        child_rate=31.0,
        child_delay=0.0051,
        poses=400,
    )
    drive = simulate_drive(1, config)
    inside = drive.child.stamps_ns <= drive.parent.stamps_ns[-1]
    Ts_pw_p = drive.parent.at(drive.child.stamps_ns[inside])
    world = (
        Ts_pw_p @ drive.T_parent_child @ se3.inverse(drive.child.poses[inside])
    )
    assert inside.sum() > 50
    # All that is left is what interpolation over 5 ms leaves.
    assert_allclose(
        world, np.tile(drive.T_pw_cw, (len(world), 1, 1)), atol=2e-3
    )
    assert not set(drive.child.stamps_ns[:20]) & set(drive.parent.stamps_ns)


def test_vehicle_drives_at_its_speed_and_turns_within_its_limit():
    config = dataclasses.replace(
        options.DriveConfig(), terrain_height=0.0, poses=2001, parent_rate=100.0
    )

    poses = simulate_drive(7, config).parent.poses

    moves = np.diff(poses[:, :3, 3], axis=0)
    yaw = np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
    yaw_rates = np.diff(yaw) * 100.0
    assert_allclose(np.linalg.norm(moves, axis=1), 0.005, rtol=1e-4)
    assert np.abs(yaw_rates).max() <= 2.0 + 1e-9
    # Held for half a second: 50 steps; a change falls into one step or between two.
    is_change = np.abs(np.diff(yaw_rates)) > 1e-6
    assert 38 <= np.count_nonzero(is_change) <= 80
    drawn_rates = yaw_rates[::50]
    assert abs(drawn_rates.mean()) < 0.6
    # Uniform over +/-2: 1.155.
    assert 0.9 < drawn_rates.std() < 1.4
    # It moves where it looks.
    heading = np.arctan2(moves[:, 1], moves[:, 0])
    half_way = 0.5 * (yaw[:-1] + yaw[1:])
    assert_allclose(np.exp(1j * heading), np.exp(1j * half_way), atol=1e-9)


# --- against the published trajectories -----------------------------------------------


@pytest.fixture(scope="module")
def published_folder():
    return data_folder() / "valimaki2023" / "simulation_tests"


@functools.cache
def published_runs(folder, level):
    return [
        [
            read_trajectory(run / f"{name}.txt").poses
            for name in ("T_S1_W1", "T_S2_W2")
        ]
        for run in sorted((folder / level).iterdir())
    ]


def test_published_drives_lie_on_our_terrain_with_our_attitude(
    published_folder,
):
    for parent, _ in published_runs(published_folder, "noise/noise_0.000000"):
        x, y, height = parent[:, :3, 3].T
        to_body = np.swapaxes(parent[:, :3, :3], 1, 2)
        yaw, pitch, roll = Rotation.from_matrix(to_body).as_euler("ZYX").T

        z, slope_x, slope_y = surface(options.DriveConfig(), x, y)

        assert_allclose(height, z, atol=1e-12)
        normals = np.column_stack([-slope_x, -slope_y, np.ones_like(z)])
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        assert_allclose(np.sin(pitch), normals[:, 0], atol=0.01)
        assert_allclose(np.sin(roll), normals[:, 1], atol=0.01)
        # Circular arcs: a chord points half-way between the headings at its ends.
        chords = np.arctan2(np.diff(y), np.diff(x))
        turns = np.angle(np.exp(1j * np.diff(yaw)))
        half_way = yaw[:-1] + 0.5 * turns
        assert_allclose(np.exp(1j * chords), np.exp(1j * half_way), atol=1e-9)


clean_drive = functools.cache(simulate_drive)


@pytest.mark.parametrize(
    ("level", "config"),
    [
        ("noise/noise_0.010000", options.NoiseConfig(gaussian=0.01)),
        ("outliers/outliers_10", options.NoiseConfig(outliers=0.1)),
        ("drift/drift_0.050000", options.NoiseConfig(drift=0.05)),
        ("mixture", options.MIXTURE),
    ],
)
def test_noise_is_as_strong_as_published(published_folder, level, config):
    """RMS error of the poses, both sensors: median over the runs, ours and published."""
    clean = published_runs(published_folder, "noise/noise_0.000000")
    noisy = published_runs(published_folder, level)

    def rms(noisy, clean):
        errors = noisy[:, :3, 3] - clean[:, :3, 3]
        squared_distances = np.square(errors).sum(axis=1)
        return np.sqrt(squared_distances.mean())

    theirs = [
        list(map(rms, *sensors)) for sensors in zip(noisy, clean, strict=True)
    ]
    ours = [
        [
            rms(noisy_drive.parent.poses, two.parent.poses),
            rms(noisy_drive.child.poses, two.child.poses),
        ]
        for noisy_drive, two in (
            (simulate_drive(k, noise=config), clean_drive(k)) for k in range(60)
        )
    ]
    medians = np.median(ours, axis=0), np.median(theirs, axis=0)
    assert_allclose(*medians, rtol=0.25, atol=1e-9)


# --- the command ----------------------------------------------------------------------


def test_command_writes_the_published_layout(tmp_path, run):
    options_given = ["--runs", "3", "--seed", "4", "--poses", "20", "--mixture"]
    code, output, _ = run(
        "simulate", "--out", tmp_path / "sims", *options_given
    )
    assert (code, output) == (
        0,
        f"3 recordings written to {tmp_path / 'sims'}\n",
    )
    folders = sorted((tmp_path / "sims").iterdir())
    assert [path.name for path in folders] == ["run_01", "run_02", "run_03"]
    for number, folder in enumerate(folders):
        expected = simulate_drive(
            (4, number),
            dataclasses.replace(options.PUBLISHED_DRIVE, poses=20),
            options.MIXTURE,
        )
        for name, trajectory in (
            ("T_S1_W1", expected.parent),
            ("T_S2_W2", expected.child),
        ):
            written = read_trajectory(folder / f"{name}.txt")
            assert_array_equal(written.stamps_ns, trajectory.stamps_ns)
            assert_allclose(written.poses, trajectory.poses, atol=1e-12)
        truth = read_trajectory(folder / "T_S2_S1.txt").poses
        assert_allclose(truth, [expected.T_parent_child], atol=1e-12)


@pytest.mark.parametrize(
    ("storage", "name"),
    [("mcap", "bag"), ("sqlite3", "bag"), ("rosbag1", "bag.bag")],
)
def test_command_writes_bags(tmp_path, run, storage, name):
    from hand_eye_calib.formats.bags.reader import PoseBag

    arguments = f"--drive hilly --poses 30 --bag {storage}".split()
    assert run("simulate", "--out", tmp_path / "sims", *arguments)[0] == 0
    drive = simulate_drive(
        (0, 0),
        dataclasses.replace(options.HILLY_DRIVE, poses=30),
        options.REALISTIC,
    )
    with PoseBag(tmp_path / "sims" / "run_01" / name) as bag:
        topics = simulate_command.PARENT_TOPIC, simulate_command.CHILD_TOPIC
        poses = bag.poses(*topics)
    for stream, trajectory in (
        ("parent", drive.parent),
        ("child", drive.child),
    ):
        ours = poses[poses.streams == stream]
        assert ours.stamps_ns.tolist() == trajectory.stamps_ns.tolist()
        assert ({*ours.sensor_frames}, {*ours.world_frames}) == (
            {stream},
            {f"{stream}_odom"},
        )
        assert_array_equal(ours.poses[:, :3], trajectory.poses[:, :3, 3])


def test_command_overwrites_nothing(tmp_path, run):
    precious = tmp_path / "thesis.txt"
    precious.write_text("results")
    code, _, error = run("simulate", "--out", tmp_path)
    assert (code, len(error.splitlines())) == (1, 1)
    assert "not empty" in error
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_recordings_of_one_mount_have_the_extrinsic_of_the_first(run, tmp_path):
    for name, more in (("one", ["--same-mount"]), ("two", [])):
        run("simulate", "--out", tmp_path / name, "--runs", 2, *more)
        truths = [
            read_trajectory(
                tmp_path / name / folder / "T_S2_S1.txt", "tum"
            ).poses
            for folder in ("run_01", "run_02")
        ]
        assert np.array_equal(*truths) == bool(more)
