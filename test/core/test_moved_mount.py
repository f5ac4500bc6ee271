"""A mount that has moved during a recording, or between its parts."""

import dataclasses

import numpy as np
import pytest
from findings import codes_of
from numpy.testing import assert_allclose

from hand_eye_calib.core.assessment.moved import (
    SIGNIFICANT,
    find_change,
    possible_shift,
)
from hand_eye_calib.core.checks.check import check_streams
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import synchronise
from hand_eye_calib.extras.simulation.drive import simulate_drive
from hand_eye_calib.extras.simulation.options import HILLY_DRIVE, NoiseConfig
from reproduction.later_faults import heading_drift

SHIFT = np.r_[0.03, -0.02, 0.01, np.radians([1.0, -0.5, 1.5])]


def recording(seed, shift_at=None):
    """Pose pairs of a simulated drive whose mount is off by so much of SHIFT over its course (a
    function of the share of the recording), and its truth.
    """
    drive = simulate_drive(seed, HILLY_DRIVE, NoiseConfig(gaussian=0.003))
    child = drive.child
    if shift_at is not None:
        shares = shift_at(np.arange(len(child)) / len(child))
        poses = child.poses @ se3.exp(shares[:, None] * SHIFT)
        child = dataclasses.replace(child, poses=poses)
    return synchronise(drive.parent, child, 0.5), drive.T_parent_child


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_a_shift_is_found_with_its_time_and_size(share):
    pose_pairs, truth = recording(1, lambda at: np.where(at < share, 0.0, 1.0))
    change = find_change(pose_pairs, truth)
    assert change.log_ratio > SIGNIFICANT
    at_s = (change.at_ns - pose_pairs.stamps_ns[0]) * 1e-9
    assert at_s == pytest.approx(120 * share, abs=2.0)
    error = change.xi - SHIFT
    assert error @ np.linalg.solve(change.covariance, error) < 25.0


def test_the_size_of_a_small_shift_is_right_on_average():
    sizes = []
    for seed in range(5):
        pose_pairs, truth = recording(
            seed, lambda at: np.where(at < 0.5, 0.0, 0.3)
        )
        change = find_change(pose_pairs, truth)
        weights = np.linalg.inv(change.covariance)
        sizes.append(change.xi @ weights @ SHIFT / (SHIFT @ weights @ SHIFT))
    assert np.mean(sizes) == pytest.approx(0.3, rel=0.1)


def test_a_world_that_drifts_is_no_mount_that_has_moved():
    """Seen in a short recording, it looks like a shift as well."""
    drive = simulate_drive(1, HILLY_DRIVE, NoiseConfig(gaussian=0.003))
    child = heading_drift(drive.child, 20.0, None)[: len(drive.child) // 3]
    codes = codes_of(check_streams(drive.parent, child).findings)
    assert codes == ["world_drift"]


def test_noise_and_a_wrong_extrinsic_are_no_shift_and_a_short_recording_tells_nothing():
    for seed in range(4):
        pose_pairs, truth = recording(seed)
        assert find_change(pose_pairs, truth).log_ratio < SIGNIFICANT
    assert (
        find_change(pose_pairs, truth @ se3.exp(SHIFT)).log_ratio < SIGNIFICANT
    )
    assert find_change(pose_pairs[:200], truth) is None


def products_of(steps, sigma=0.01):
    """Products of parts that each show a shift (6,) to this standard deviation."""
    parts = []
    for step in steps:
        rows = (
            np.concatenate([np.eye(6), -np.asarray(step)[:, None]], axis=1)
            / sigma
        )
        parts.append(rows.T @ rows)
    return np.array(parts)


def parts(seed, size):
    noise = np.random.default_rng(seed).normal(0.0, 0.01, (20, 6))
    is_before = np.arange(20)[:, None] < 8
    return noise + np.where(is_before, 0.0, size * SHIFT)


def test_a_shift_between_parts_counts_with_half_of_it():
    for few in (parts(0, 0.0), parts(0, 1.0)[:7]):
        spread, warnings = possible_shift(products_of(few), 1.0)
        assert (spread.max(), warnings) == (0.0, ())
    spread, _ = possible_shift(products_of(parts(0, 1.0)), 1.0)
    assert_allclose(np.sqrt(np.diag(spread)), np.abs(SHIFT) / 2, atol=4e-3)
    # Noise explains this one.
    spread, warnings = possible_shift(products_of(parts(1, 0.2)), 1.0)
    assert (np.diag(spread).max() < 1e-6, warnings) == (True, ())


def test_only_what_is_more_than_recordings_scatter_is_said_to_have_moved():
    (warning,) = possible_shift(products_of(parts(0, 1.5)), 1.0)[1]
    assert "The first 40% and the last 60%" in warning
    scattered = np.where(np.arange(20)[:, None] < 8, 0.0, 0.3 * SHIFT)
    spread, warnings = possible_shift(products_of(scattered, sigma=1e-3), 1.0)
    assert (spread.max() > 0.0, warnings) == (True, ())
