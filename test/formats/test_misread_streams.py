"""Streams that are not what they seem: each is named, whichever stream it is, and right streams are
not: motions in place of poses, other orders of angles, positions in other axes than orientations.
"""

import dataclasses

import numpy as np
import pytest
from motions import (
    T_PARENT_CHILD,
    as_trajectory,
    noisy_pair,
    read_trajectory_file,
    smooth_poses,
    wandering_poses,
)
from numpy.testing import assert_allclose

from hand_eye_calib.core.checks.check import check_streams
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.geodetic import axes_of_places
from hand_eye_calib.formats.trajectory_files.file_options import AUTO
from hand_eye_calib.formats.trajectory_files.writing import write_trajectory

# Place on the earth (m from its centre).
HANNOVER_M = np.array([3_861_442.9, 660_048.4, 5_016_536.7])


def hilly_drive(n_poses=900):
    """(N, 4, 4) poses of a car: x forward, slopes and banks of some degrees, in loops."""
    steps = np.arange(n_poses)
    yaw = 0.01 * steps + 0.8 * np.sin(0.02 * steps)
    pitch = 0.08 * np.sin(0.031 * steps)
    roll = 0.06 * np.sin(0.043 * steps + 1.0)
    rotations = se3.rotation_from_rpy(np.c_[roll, pitch, yaw])
    positions = np.cumsum(0.8 * rotations[:, :, 0], axis=0)
    return se3.from_rotation_translation(rotations, positions)


PATHS = {"car": hilly_drive, "hand": lambda: wandering_poses(700)}


def pair(path, seed=3):
    return noisy_pair(PATHS[path](), seed, 0.003, 0.0005)


def with_poses(stream, rotations, positions):
    poses = se3.from_rotation_translation(rotations, positions)
    return dataclasses.replace(stream, poses=poses)


def of_motions(stream):
    poses = stream.poses
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    ends_ns = stream.stamps_ns[1:]
    return dataclasses.replace(stream, stamps_ns=ends_ns, poses=steps)


def of_backward_motions(stream):
    poses = stream.poses
    steps = se3.inverse(poses[1:]) @ poses[:-1]
    ends_ns = stream.stamps_ns[1:]
    return dataclasses.replace(stream, stamps_ns=ends_ns, poses=steps)


def in_turning_axes(stream):
    """Angles about turning axes, roll first, read as those about fixed axes."""
    rotations = stream.poses[:, :3, :3]
    positions = stream.poses[:, :3, 3]
    sine = np.clip(rotations[:, 0, 2], -1.0, 1.0)
    pitch = np.arcsin(sine)
    roll = np.arctan2(-rotations[:, 1, 2], rotations[:, 2, 2])
    yaw = np.arctan2(-rotations[:, 0, 1], rotations[:, 0, 0])
    misread = se3.rotation_from_rpy(np.c_[roll, pitch, yaw])
    return with_poses(stream, misread, positions)


def turned(stream):
    turn = se3.rotation_exp(np.array([0.7, -0.4, 1.1]))
    rotations = stream.poses[:, :3, :3]
    positions = stream.poses[:, :3, 3]
    return with_poses(stream, rotations, positions @ turn.T)


def from_the_centre(stream):
    """Positions from the centre of the earth with orientations in axes of the place."""
    (axes,) = axes_of_places(HANNOVER_M[None])
    rotations = stream.poses[:, :3, :3]
    positions = stream.poses[:, :3, 3]
    from_centre = positions @ axes.T + HANNOVER_M
    return with_poses(stream, rotations, from_centre)


def mirrored_about_the_vertical(stream):
    return with_poses(
        stream,
        stream.poses[:, :3, :3],
        stream.poses[:, :3, 3] * [-1.0, -1.0, 1.0],
    )


MISREAD = {
    "motions": (of_motions, "motions"),
    "backward motions": (of_backward_motions, "motions"),
    "order of angles": (in_turning_axes, "euler_order"),
    "turned positions": (turned, "positions_turned"),
    "positions from the centre of the earth": (
        from_the_centre,
        "earth_centred",
    ),
    "-x -y": (mirrored_about_the_vertical, "axes"),
}


def errors(result):
    return {
        (finding.code, finding.stream)
        for finding in result.findings
        if finding.severity.value == "error"
    }


@pytest.mark.parametrize("stream", ["parent", "child"])
@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("kind", MISREAD)
def test_what_a_stream_is_in_truth_is_named(kind, path, stream):
    spoil, code = MISREAD[kind]
    parent, child = pair(path)
    if stream == "parent":
        result = check_streams(spoil(parent), child)
    else:
        result = check_streams(parent, spoil(child))
    assert errors(result) == {(code, stream)}


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("seed", range(3))
def test_right_streams_are_not_named(path, seed):
    parent, child = pair(path, seed)
    checked = check_streams(parent, child)
    assert errors(checked) == set()


def test_streams_of_two_bodies_stay_unrelated():
    parent, _ = pair("hand", 1)
    _, child = noisy_pair(smooth_poses(np.arange(700) / 10), 2, 0.003, 0.0005)
    assert {code for code, _ in errors(check_streams(parent, child))} == {
        "unrelated"
    }


# ---- files that the motion of the sensor tells


def read(path):
    reading = read_trajectory_file(path, AUTO)
    return reading.trajectory, " ".join(reading.guesses)


@pytest.mark.parametrize("by_columns", [False, True])
@pytest.mark.parametrize("path", PATHS)
def test_rotations_before_translations_are_read_by_rows_or_by_columns(
    tmp_path, by_columns, path
):
    truth = as_trajectory(PATHS[path]() @ T_PARENT_CHILD)
    rotations = truth.poses[:, :3, :3]
    written = np.swapaxes(rotations, 1, 2) if by_columns else rotations
    rows = np.c_[
        truth.stamps_ns / 1e9, written.reshape(-1, 9), truth.poses[:, :3, 3]
    ].tolist()
    file = tmp_path / "poses.txt"
    file.write_text("\n".join(" ".join(map(repr, row)) for row in rows))
    trajectory, guesses = read(file)
    # The motion of what is held in hand does not tell, and the order is said.
    is_by_columns = by_columns and path == "car"
    order = "column by column" if is_by_columns else "row by row"
    assert f"read {order}" in guesses
    expected = rotations if is_by_columns or not by_columns else written
    assert_allclose(trajectory.poses[:, :3, :3], expected, atol=1e-9)
    assert_allclose(
        trajectory.poses[:, :3, 3], truth.poses[:, :3, 3], atol=1e-9
    )


FRAMES = {
    "axes of the earth": (lambda axes: axes, "the axes of the earth, too"),
    "east, north, up": (lambda axes: np.eye(3), "east, north and up"),
    "north, east, down": (
        lambda axes: np.array(
            [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]
        ),
        "north, east and down",
    ),
}


@pytest.mark.parametrize("frame", FRAMES)
def test_orientations_of_positions_from_the_centre_of_the_earth(
    tmp_path, frame
):
    to_file, words = FRAMES[frame]
    axes = axes_of_places(HANNOVER_M[None])[0]
    truth = as_trajectory(hilly_drive())
    positions = truth.poses[:, :3, 3] @ axes.T + HANNOVER_M
    spoiled = with_poses(
        truth, to_file(axes) @ truth.poses[:, :3, :3], positions
    )
    write_trajectory(tmp_path / "ecef.tum", spoiled)
    trajectory, guesses = read(tmp_path / "ecef.tum")
    assert words in guesses
    # Up of a place turns by 1 m / 6,378 km on the way to the next.
    assert_allclose(
        trajectory.poses[:, :3, :3], axes @ truth.poses[:, :3, :3], atol=2e-4
    )


def test_axes_of_places_are_those_of_their_latitude():
    lat = np.radians([52.2, -33.5, 0.0])
    lon = np.radians([9.7, -70.25, 0.0])
    height_m = 600.0
    flattening = 1.0 / 298.257223563
    eccentricity_2 = (2.0 - flattening) * flattening
    normal_m = 6_378_137.0 / np.sqrt(1.0 - eccentricity_2 * np.sin(lat) ** 2)
    x = np.cos(lat) * np.cos(lon)
    y = np.cos(lat) * np.sin(lon)
    z = np.sin(lat)
    positions = np.column_stack(
        [
            (normal_m + height_m) * x,
            (normal_m + height_m) * y,
            ((1.0 - eccentricity_2) * normal_m + height_m) * z,
        ]
    )

    up = axes_of_places(positions)[:, :, 2]

    expected = np.column_stack([x, y, z])
    assert_allclose(up, expected, atol=1e-9)
