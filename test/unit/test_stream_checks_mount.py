"""A mount that moved within a recording is seen with its time and size; noise is not one."""

import dataclasses

import numpy as np
import pytest

from hand_eye_calib.assessment.mount_change import (
    find_change,
    information,
    log_ratio,
    long_run_variance,
    possible_shift,
)
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.synchronise import synchronise
from hand_eye_calib.simulation.drive import simulate_drive
from hand_eye_calib.simulation.options import HILLY_DRIVE, NoiseConfig

NOISE = NoiseConfig(gaussian=0.003)
SHIFT = np.r_[0.03, -0.02, 0.01, np.radians([1.0, -0.5, 1.5])]


def recording(seed=0, shift=None, share=0.5):
    """Pose pairs of a simulated drive whose mount shifts after a share of it, and its truth."""
    drive = simulate_drive(seed, HILLY_DRIVE, NOISE)
    child = drive.child
    if shift is not None:
        poses = child.poses.copy()
        poses[int(share * len(poses)) :] = poses[int(share * len(poses)) :] @ se3.exp(shift)
        child = dataclasses.replace(child, poses=poses)
    return synchronise(drive.parent, child, 0.5), drive.T_parent_child


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_a_shift_is_found_with_its_time_and_size(share):
    pose_pairs, truth = recording(1, SHIFT, share)
    change = find_change(information(pose_pairs, truth))
    assert change.is_significant
    assert change.is_step
    at_s = (change.at_ns - pose_pairs.stamps_ns[0]) * 1e-9
    assert at_s == pytest.approx(120 * share, abs=2.0)
    assert change.earliest_ns <= change.at_ns <= change.latest_ns
    error = change.xi - SHIFT
    assert error @ np.linalg.solve(change.covariance, error) < 25.0


@pytest.mark.parametrize("periods", [0.6, 0.7, 0.8])
def test_errors_that_wander_over_minutes_are_no_step(periods):
    drive = simulate_drive(6, HILLY_DRIVE, NOISE)
    phases = np.linspace(0, 2 * np.pi * periods, len(drive.child.poses))
    errors = np.sin(phases)[:, None] * SHIFT
    child = dataclasses.replace(drive.child, poses=drive.child.poses @ se3.exp(errors))
    pose_pairs = synchronise(drive.parent, child, 0.5)
    change = find_change(information(pose_pairs, drive.T_parent_child))
    assert change.is_significant
    assert not change.is_step


@pytest.mark.parametrize("seed", range(5))
def test_noise_is_no_shift(seed):
    change = find_change(information(*recording(seed)))
    assert not change.is_significant


def test_a_wrong_extrinsic_is_no_shift_within_the_recording():
    pose_pairs, truth = recording(2)
    change = find_change(information(pose_pairs, truth @ se3.exp(SHIFT)))
    assert not change.is_significant


def test_blocks_add_up_to_the_shift_from_an_old_extrinsic():
    pose_pairs, truth = recording(3)
    T, shift = truth @ se3.exp(-SHIFT), np.zeros(6)
    long_run = long_run_variance(information(pose_pairs, truth))
    for _ in range(3):
        found = information(pose_pairs, T)
        H, S = found.H.sum(axis=0), found.S.sum(axis=0)
        if not shift.any():
            assert log_ratio(H, S, long_run) > 50.0
        T = T @ se3.exp(np.linalg.solve(H, S))
        shift = se3.log(se3.inverse(truth @ se3.exp(-SHIFT)) @ T)
    assert shift == pytest.approx(SHIFT, abs=0.004)
    assert log_ratio(H, S, long_run) < 3.0


def test_too_short_to_tell():
    pose_pairs, truth = recording(4)
    assert find_change(information(pose_pairs[:200], truth)) is None


def products_of(steps, sigma=0.01):
    """Products of parts that each show a shift (6,) to this standard deviation."""
    parts = []
    for step in steps:
        rows = np.concatenate([np.eye(6), -np.asarray(step)[:, None]], axis=1) / sigma
        parts.append(rows.T @ rows)
    return np.array(parts)


def test_a_shift_between_parts_counts_with_half_of_it():
    noise = np.random.default_rng(0).normal(0.0, 0.01, (20, 6))
    moved = noise + np.where(np.arange(20)[:, None] < 8, 0.0, SHIFT)
    assert possible_shift(products_of(noise), 1.0) is None
    found = possible_shift(products_of(moved), 1.0)
    np.testing.assert_allclose(np.sqrt(np.diag(found.spread)), np.abs(SHIFT) / 2, atol=4e-3)
    np.testing.assert_allclose(found.xi, SHIFT, atol=8e-3)
    assert (found.probability > 0.99, found.share) == (True, 0.4)
    assert "The first 40% and the last 60%" in found.warnings[0]
    assert possible_shift(products_of(moved[:7]), 1.0) is None


def test_a_shift_that_noise_explains_does_not_count():
    noise = np.random.default_rng(1).normal(0.0, 0.01, (20, 6))
    steps = noise + np.where(np.arange(20)[:, None] < 8, 0.0, 0.2 * SHIFT)
    found = possible_shift(products_of(steps), 1.0)
    assert found is None or (np.diag(found.spread).max() < 1e-6 and not found.warnings)
