"""What the driver is told."""

import dataclasses

import numpy as np
import pytest
from findings import codes_of
from motions import (
    as_trajectory,
    child_of,
    noisy_pair,
    planar_poses,
    wandering_poses,
)
from numpy.testing import assert_allclose

from hand_eye_calib.core.assessment import excitation
from hand_eye_calib.core.assessment.covariance import (
    hidden_axes,
    lever_arm_products,
)
from hand_eye_calib.core.checks.check import check_streams
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.core.results.calibration import DofObservability, DofVerdict
from hand_eye_calib.offline.calibrate import calibrate


def seen_in(poses):
    return excitation.excitation(
        PosePairs(np.arange(len(poses)), poses, child_of(poses))
    )


def turning(amplitudes_rad, n_poses=300):
    """Poses that swing about each axis in turn, by so much to either side."""
    s = np.linspace(0, 2 * np.pi, n_poses)
    turns = np.stack(
        [a * np.sin(k * s) for k, a in enumerate(amplitudes_rad, 1)], axis=1
    )
    return se3.from_rotation_translation(
        se3.rotation_exp(turns), np.c_[s, 0 * s, 0 * s]
    )


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_turning_is_measured_about_the_axis_it_happens_about(axis):
    amplitudes = np.zeros(3)
    amplitudes[axis] = np.radians(20.0)
    seen = seen_in(turning(amplitudes))
    assert np.degrees(seen.rotation[axis]) == pytest.approx(40.0, abs=3.0)
    assert np.degrees(np.delete(seen.rotation, axis)).max() < 1e-6
    assert seen.hidden_axes() == ("xyz"[axis],)


def test_it_does_not_depend_on_the_world_and_hardly_on_the_number_of_poses():
    poses = wandering_poses(400)
    seen = seen_in(poses)
    moved = seen_in(se3.exp(np.array([5.0, 3.0, -2.0, 0.4, 1.0, -2.0])) @ poses)
    assert_allclose(moved.rotation, seen.rotation, atol=1e-9)
    many = seen_in(
        as_trajectory(poses).at(
            np.linspace(*as_trajectory(poses).stamps_ns[[0, -1]], 4000).astype(
                np.int64
            )
        )
    )
    assert_allclose(many.rotation, seen.rotation, rtol=0.2)


@pytest.mark.parametrize("n_poses", [0, 1, 20])
def test_standing_still_is_said(n_poses):
    text = excitation.what_is_missing(
        seen_in(np.repeat(np.eye(4)[None], n_poses, axis=0))
    )
    assert text == (
        "x, y and z cannot be determined from the motion so far: move in curves, to both sides"
    )


def test_after_turns_about_all_axes_only_what_a_result_says_is_missing():
    poses = wandering_poses(200)
    assert excitation.what_is_missing(seen_in(poses)) == ""
    result = calibrate(
        as_trajectory(poses), as_trajectory(child_of(poses)), reference="B5"
    )
    assert excitation.what_is_missing(seen_in(poses), result) == ""
    weak = dataclasses.replace(
        result,
        observability_measured=(
            DofObservability("x", DofVerdict.WEAK, 0.08),
            *result.observability_measured[1:],
        ),
    )
    assert excitation.what_is_missing(seen_in(poses), weak).startswith(
        "x needs more motion: "
    )
    hidden = DofObservability("yaw", DofVerdict.UNOBSERVABLE, np.inf)
    hiding = dataclasses.replace(
        result,
        observability_measured=(*result.observability_measured[:5], hidden),
    )
    assert excitation.what_is_missing(seen_in(poses), hiding) == (
        "the rotation about z cannot be determined from the motion so far: rotate the sensors more "
        "about y"
    )


def test_an_arm_is_not_told_to_drive():
    s = np.linspace(0, 4 * np.pi, 400)
    turns = np.stack([0 * s, 0 * s, np.sin(s)], axis=1)
    path = np.stack([np.sin(2 * s), np.cos(3 * s), np.sin(5 * s + 1)], axis=1)
    seen = seen_in(se3.from_rotation_translation(se3.rotation_exp(turns), path))
    assert not seen.drives
    assert excitation.what_is_missing(seen) == (
        "z cannot be determined from the motion so far: tilt the sensors about x and y, or measure "
        "it by hand"
    )
    assert (
        excitation.helpful_motion(["x"], seen)
        == "rotate the sensors more about y"
    )
    still = seen_in(
        se3.from_rotation_translation(np.tile(np.eye(3), (400, 1, 1)), path)
    )
    assert excitation.what_is_missing(still).endswith(
        "rotate the sensors, about all axes"
    )


def test_a_vehicle_is_told_to_drive_over_a_ramp():
    seen = seen_in(planar_poses(300))
    assert seen.drives
    advice = (
        "z cannot be determined from the motion so far: drive over a ramp or a kerb, or "
        "measure it by hand"
    )
    assert excitation.what_is_missing(seen) == advice
    # Only a recording may contain clouds.
    poses = planar_poses(300)
    recorded = calibrate(
        as_trajectory(poses), as_trajectory(child_of(poses)), reference="B5"
    )
    assert excitation.what_is_missing(seen, recorded) == (
        f"{advice}, or, if both sensors are lidars, record their clouds and run "
        "calibrate on the bag"
    )


def chords(rotation_vectors):
    return se3.rotation_exp(np.asarray(rotation_vectors, dtype=float)) - np.eye(
        3
    )


def about_z_and_x(share, n=200):
    """Rotation vectors about z, and about x with a share of that."""
    z = np.sin(np.arange(n))
    return np.stack([share * np.cos(np.arange(n)), 0 * z, z], axis=1) * 0.2


def test_the_axis_of_all_rotations_is_hidden():
    for share, hidden in ((0.0, ("z",)), (0.02, ("z",)), (0.3, ())):
        assert (
            hidden_axes(lever_arm_products(chords(about_z_and_x(share))))
            == hidden
        )


@pytest.mark.parametrize(
    ("pitch_rad", "hidden"), [(0.0, True), (0.004, True), (0.15, False)]
)
def test_verdict_finding_and_hint_agree(pitch_rad, hidden):
    n = 600
    yaw = np.cumsum(np.random.default_rng(3).normal(0, 0.08, n))
    pitch = pitch_rad * np.sin(np.arange(n) * 0.15)
    rotation = se3.rotation_exp(
        np.c_[0 * yaw, 0 * yaw, yaw]
    ) @ se3.rotation_exp(np.c_[0 * yaw, pitch, 0 * yaw])
    position = np.cumsum(0.1 * np.c_[np.cos(yaw), np.sin(yaw), 0 * yaw], axis=0)
    poses = se3.from_rotation_translation(rotation, position)
    parent, child = noisy_pair(poses, 1, 1e-4, 1e-5)
    result = calibrate(parent, child, reference="B10")
    codes = codes_of(check_streams(parent, child).findings)
    seen = excitation.excitation(
        PosePairs(parent.stamps_ns, parent.poses, child.poses)
    )
    assert ("z" in result.unobservable()) is hidden
    assert ("one_axis" in codes) is hidden
    assert ("z" in seen.hidden_axes()) is hidden
