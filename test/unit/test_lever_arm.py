"""Rotation about one axis only: one rule, and the verdict, the finding and the hint agree."""

import numpy as np
import pytest
from motions import as_trajectory, child_of, disturbed

from hand_eye_calib.assessment.excitation import LeverArms, excitation
from hand_eye_calib.checks.check import check_streams
from hand_eye_calib.engine.offline import calibrate
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import PosePairs


def chords(rotation_vectors):
    return se3.rotation_exp(np.asarray(rotation_vectors, dtype=float)) - np.eye(3)


def about_z_and_x(share, n=200):
    """Rotation vectors about z, and about x with a share of that."""
    z = np.sin(np.arange(n))
    return np.stack([share * np.cos(np.arange(n)), 0 * z, z], axis=1) * 0.2


def test_the_axis_of_all_rotations_is_hidden():
    assert LeverArms.of(chords(about_z_and_x(0.0))).hidden_axes() == ("z",)
    assert LeverArms.of(chords(about_z_and_x(0.02))).hidden_axes() == ("z",)
    assert LeverArms.of(chords(about_z_and_x(0.3))).hidden_axes() == ()


@pytest.mark.parametrize(("pitch_rad", "hidden"), [(0.0, True), (0.004, True), (0.15, False)])
def test_verdict_finding_and_hint_agree(pitch_rad, hidden):
    n = 600
    yaw = np.cumsum(np.random.default_rng(3).normal(0, 0.08, n))
    pitch = pitch_rad * np.sin(np.arange(n) * 0.15)
    rotation = se3.rotation_exp(np.c_[0 * yaw, 0 * yaw, yaw]) @ se3.rotation_exp(
        np.c_[0 * yaw, pitch, 0 * yaw]
    )
    position = np.cumsum(0.1 * np.c_[np.cos(yaw), np.sin(yaw), 0 * yaw], axis=0)
    poses = se3.from_rotation_translation(rotation, position)
    parent = as_trajectory(disturbed(poses, 1, 1e-4, 1e-5))
    child = as_trajectory(disturbed(child_of(poses), 2, 1e-4, 1e-5))
    result = calibrate(parent, child, reference="B10")
    codes = [finding.code for finding in check_streams(parent, child).findings]
    seen = excitation(PosePairs(parent.stamps_ns, parent.poses, child.poses))
    assert ("z" in result.unobservable()) is hidden
    assert ("one_axis" in codes) is hidden
    assert ("z" in seen.hidden_axes()) is hidden
