"""Faults that give a wrong extrinsic in confidence are found and named, in a simulated drive."""

import dataclasses
import functools

import numpy as np
import pytest
from motions import as_trajectory, child_of, disturbed, wandering_poses

import hand_eye_calib as hec
from hand_eye_calib.checks.check import check_streams
from hand_eye_calib.checks.findings import Severity
from hand_eye_calib.checks.streams import check_stream
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.results.calibration import Verdict
from hand_eye_calib.simulation.drive import simulate_drive
from hand_eye_calib.simulation.options import HILLY_DRIVE, REALISTIC, NoiseConfig
from reproduction.fault_cases import FAULTS, LATER, SILENT

# Not the strongest: seen by a solve or with no effect then, or named already if it is small.
STRONGEST = {"S13": 1, "S10b": 2, "V1": 1, "U7": 0}
NAMED = [fault for fault in (*FAULTS, *LATER, *SILENT) if fault.named]


@functools.cache
def drive(seed=0):
    return simulate_drive(seed, HILLY_DRIVE, NoiseConfig(gaussian=0.003))


@pytest.mark.parametrize("fault", NAMED, ids=lambda fault: fault.code)
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


@pytest.mark.parametrize("seed", range(3))
def test_a_drift_on_a_flat_floor_is_no_scale_of_heights(seed):
    noise = dataclasses.replace(REALISTIC, drift=0.01)
    flat = simulate_drive(seed, dataclasses.replace(HILLY_DRIVE, terrain_height=0.0), noise)
    assert "axis_scale" not in {found.code for found in check_streams(*_streams(flat)).findings}


def _streams(simulated):
    return simulated.parent, simulated.child


@pytest.mark.parametrize("level", [1e-3, 0.02])
def test_the_time_of_a_loose_mount_does_not_depend_on_noise(level):
    sound = simulate_drive(4, HILLY_DRIVE, NoiseConfig(gaussian=level))
    loosened = next(fault for fault in FAULTS if fault.code == "S8")
    streams = loosened.damage(sound.parent, sound.child, 5.0, np.random.default_rng(1))
    (found,) = (f for f in check_streams(*streams).findings if f.code == "mount_moved")
    assert found.evidence["at_s"] == pytest.approx(60.0, abs=3.0)
    assert "60 s after the start" in found.what or "5" in found.what


class TestGrid:
    def test_steps_of_rounded_positions_are_measured(self):
        child = drive().child
        poses = child.poses.copy()
        poses[:, :3, 3] = np.round(poses[:, :3, 3] / 0.05) * 0.05
        (found,) = check_stream(Trajectory(child.stamps_ns, poses), "child")
        assert (found.code, found.severity) == ("coarse_positions", Severity.ERROR)
        assert found.evidence["step_m"] == pytest.approx(0.05)

    def test_steady_motion_is_no_grid(self):
        poses = np.tile(np.eye(4), (300, 1, 1))
        poses[:, 0, 3] = 0.25 * np.arange(300)
        stamps_ns = np.arange(300) * 10**8
        assert check_stream(Trajectory(stamps_ns, poses), "child") == []


def straight_at(stream, stamps_ns):
    """Poses at other stamps as TF interpolates them: along lines, and by slerp."""
    after = np.clip(np.searchsorted(stream.stamps_ns, stamps_ns), 1, len(stream) - 1)
    spans = np.diff(stream.stamps_ns)[after - 1]
    share = ((stamps_ns - stream.stamps_ns[after - 1]) / spans)[:, None]
    start, end = stream.poses[after - 1], stream.poses[after]
    turns = se3.rotation_log(np.swapaxes(start[:, :3, :3], 1, 2) @ end[:, :3, :3])
    return se3.from_rotation_translation(
        start[:, :3, :3] @ se3.rotation_exp(share * turns),
        start[:, :3, 3] + share * (end[:, :3, 3] - start[:, :3, 3]),
    )


def rounded(poses, digits):
    quats = np.round(se3.to_quat_xyzw(poses), digits)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return se3.from_quat_xyzw(np.round(poses[:, :3, 3], digits), quats)


class TestOneStreamComputedFromTheOther:
    SENTENCE = (
        "The two streams are not independent: one seems to be computed from the other. This result "
        "only repeats the transform that was used for it."
    )

    def found(self, parent, child):
        return [
            found.what for found in check_streams(parent, child).findings if found.code[:3] != "one"
        ]

    @pytest.mark.parametrize("rate_hz", [4.0, 11.0, 37.0])
    def test_at_any_rate(self, rate_hz):
        parent = drive().parent
        n_poses = int((parent.duration_s - 0.1) * rate_hz)
        start_ns = int(parent.stamps_ns[0]) + 7_300_000
        stamps_ns = as_trajectory(np.tile(np.eye(4), (n_poses, 1, 1)), rate_hz, start_ns).stamps_ns
        child = Trajectory(stamps_ns, child_of(straight_at(parent, stamps_ns)))
        assert self.found(parent, child) == [self.SENTENCE]

    @pytest.mark.parametrize("delay_s", [0.0, 0.05])
    def test_in_a_text_file_of_six_digits_and_with_a_delay(self, delay_s):
        parent = drive().parent
        child = Trajectory(parent.stamps_ns, rounded(child_of(parent.poses), 6)).shifted(-delay_s)
        parent = Trajectory(parent.stamps_ns, rounded(parent.poses, 6))
        assert self.SENTENCE in self.found(parent, child)

    def test_with_a_little_noise_of_its_own(self):
        parent = drive().parent
        own = disturbed(child_of(parent.poses), 1, 1e-4, 3e-5)
        assert self.found(parent, Trajectory(parent.stamps_ns, own)) == [self.SENTENCE]

    def test_orientations_alone(self):
        parent, child = _streams(drive())
        X = drive().T_parent_child
        inner = parent[1:-1]
        world = child.at(inner.stamps_ns[:1]) @ se3.inverse(inner.poses[:1] @ X)
        poses = child.at(inner.stamps_ns)
        wrong = se3.from_rotation_translation(se3.rotation_exp([0.2, -0.1, 0.3]), np.zeros(3))
        poses[:, :3, :3] = (world @ inner.poses @ X @ wrong)[:, :3, :3]
        child = Trajectory(inner.stamps_ns, poses)
        assert check_streams(parent, child).findings[0].what == self.SENTENCE

    def test_never_use(self):
        parent = drive().parent
        result = hec.calibrate(parent, Trajectory(parent.stamps_ns, child_of(parent.poses)))
        assert result.verdict is Verdict.DO_NOT_USE
        assert result.reasons[0].sentence == self.SENTENCE

    @pytest.mark.parametrize("rate_hz", [1.0, 10.0, 100.0])
    @pytest.mark.parametrize("noise", [2e-4, 2e-3])
    def test_two_precise_sensors_are_independent(self, rate_hz, noise):
        poses = wandering_poses(600, 4, 1.0 / rate_hz, 0.8 / rate_hz)
        parent = as_trajectory(disturbed(poses, 1, noise, noise), rate_hz)
        child = as_trajectory(disturbed(child_of(poses), 2, noise, noise), rate_hz)
        assert "not_independent" not in [f.code for f in check_streams(parent, child).findings]
