"""Faults that give a wrong extrinsic in confidence are found and named, in a simulated drive."""

import functools

import numpy as np
import pytest

from hand_eye_calib.checks.check import check_streams
from hand_eye_calib.checks.findings import Severity
from hand_eye_calib.checks.streams import check_stream
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.simulation.drive import simulate_drive
from hand_eye_calib.simulation.options import HILLY_DRIVE, NoiseConfig
from reproduction.fault_cases import FAULTS

# Seen by a solve or with no effect at that severity: too little noise, or a part of the tilt.
STRONGEST = {"S13": 1, "S10b": 2}


@functools.cache
def drive(seed=0):
    return simulate_drive(seed, HILLY_DRIVE, NoiseConfig(gaussian=0.003))


@pytest.mark.parametrize("fault", FAULTS, ids=[fault.code for fault in FAULTS])
def test_every_fault_is_named(fault):
    severity = fault.severities[STRONGEST.get(fault.code, -1)]
    sound = drive()
    streams = fault.damage(sound.parent, sound.child, severity, np.random.default_rng(0))
    findings = check_streams(*streams).findings
    assert {found.code for found in findings} & fault.named
    for found in findings:
        assert found.what
        assert found.advice


@pytest.mark.parametrize("seed", range(3))
def test_a_sound_drive_has_no_finding(seed):
    assert [found.code for found in check_streams(*_streams(drive(seed))).findings] == []


def _streams(simulated):
    return simulated.parent, simulated.child


@pytest.mark.parametrize("level", [1e-3, 0.02])
def test_the_time_of_a_loose_mount_does_not_depend_on_noise(level):
    sound = simulate_drive(4, HILLY_DRIVE, NoiseConfig(gaussian=level))
    loosened = next(fault for fault in FAULTS if fault.code == "S8")
    streams = loosened.damage(sound.parent, sound.child, 5.0, np.random.default_rng(1))
    (found,) = (f for f in check_streams(*streams).findings if f.code == "mount_moved")
    assert dict(found.evidence)["at_s"] == pytest.approx(60.0, abs=3.0)
    assert "60 s after the start" in found.what or "5" in found.what


class TestGrid:
    def test_steps_of_rounded_positions_are_measured(self):
        child = drive().child
        poses = child.poses.copy()
        poses[:, :3, 3] = np.round(poses[:, :3, 3] / 0.05) * 0.05
        (found,) = check_stream(Trajectory(child.stamps_ns, poses), "child")
        assert (found.code, found.severity) == ("coarse_positions", Severity.ERROR)
        assert dict(found.evidence)["step_m"] == pytest.approx(0.05)
        assert "32 bits" not in str(found)

    def test_numbers_of_32_bits_are_named(self):
        child = drive().child
        poses = child.poses.copy()
        poses[:, :3, 3] = (poses[:, :3, 3] + [5e5, 4.5e6, 0]).astype(np.float32)
        (found,) = check_stream(Trajectory(child.stamps_ns, poses), "child")
        assert dict(found.evidence)["step_m"] == pytest.approx(0.5)
        assert "32 bits" in str(found)

    def test_steady_motion_is_no_grid(self):
        poses = np.tile(np.eye(4), (300, 1, 1))
        poses[:, 0, 3] = 0.25 * np.arange(300)
        stamps_ns = np.arange(300) * 10**8
        assert check_stream(Trajectory(stamps_ns, poses), "child") == []
