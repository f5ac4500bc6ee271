"""Faults that give a wrong extrinsic in confidence are found and named, in a simulated drive."""

import dataclasses
import functools

import numpy as np
import pytest
from findings import codes_of
from motions import (
    T_PARENT_CHILD,
    as_trajectory,
    child_of,
    disturbed,
    noisy_pair,
    wandering_poses,
)
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter1d

import hand_eye_calib as hec
from hand_eye_calib.core.checks.check import check_streams
from hand_eye_calib.core.checks.findings import Severity
from hand_eye_calib.core.checks.open_delay import faulty_variance
from hand_eye_calib.core.checks.streams import check_stream
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import Verdict
from hand_eye_calib.extras.simulation.drive import simulate_drive
from hand_eye_calib.extras.simulation.options import (
    HILLY_DRIVE,
    REALISTIC,
    NoiseConfig,
)
from reproduction import pose_faults
from reproduction.coverage.classes import make
from reproduction.fault_cases import FAULTS
from reproduction.later_faults import LATER, SILENT

# Not the strongest: seen by a solve or with no effect then, or named already if it is small.
STRONGEST = {"S13": 1, "S10b": 2, "V1": 1, "U7": 0, "U12": 1}
LATE_POSITIONS = next(fault for fault in LATER if fault.code == "V1")
EXCHANGED = next(fault for fault in LATER if fault.code == "U12")
NAMED = [fault for fault in (*FAULTS, *LATER, *SILENT) if fault.named]


@functools.cache
def drive(seed=0):
    return simulate_drive(seed, HILLY_DRIVE, NoiseConfig(gaussian=0.003))


@pytest.mark.parametrize("fault", NAMED, ids=lambda fault: fault.code)
def test_every_fault_is_named(fault):
    severity = fault.severities[STRONGEST.get(fault.code, -1)]
    sound = drive()
    streams = fault.damage(
        sound.parent, sound.child, severity, np.random.default_rng(0)
    )
    findings = check_streams(*streams).findings
    assert set(codes_of(findings)) & fault.named
    for finding in findings:
        assert finding.what
        assert finding.advice


@pytest.mark.parametrize("seed", range(3))
def test_a_sound_drive_has_no_finding(seed):
    assert [
        finding.code
        for finding in check_streams(*_streams(drive(seed))).findings
    ] == []


@functools.cache
def late_parent(delay_s):
    """Streams of the drive whose parent has late positions, and their result."""
    sound = drive()
    late = LATE_POSITIONS.damage(
        sound.parent, sound.child, delay_s, np.random.default_rng(0)
    )
    return late, hec.calibrate(*late)


def test_sigma_contains_a_delay_of_positions_below_the_limit_of_a_finding():
    _, result = late_parent(0.02)
    (note,) = result.findings
    assert (note.code, note.stream, note.severity) == (
        "position_clock",
        "parent",
        Severity.NOTE,
    )
    error = se3.deviation(result.T_parent_child, drive().T_parent_child)
    assert abs(error[0]) > 0.025  # m: 20 ms at 1.5 m/s
    assert (np.abs(error) < 2.0 * result.sigmas).all()
    assert result.detectability.errors["x"] > 3.0 * result.allowance[0]
    sound = hec.calibrate(*_streams(drive()))
    assert sound.findings == ()
    assert (sound.sigmas[:3] < 0.0095).all()


def test_a_prior_limits_the_sigma_of_an_open_delay():
    late, result = late_parent(0.02)
    truth = float(drive().T_parent_child[0, 3])
    known = hec.calibrate(*late, prior={"x": (truth, 0.005)})
    assert known.sigmas[0] < 0.012 < 0.02 < result.sigmas[0]


def test_an_uncertain_delay_does_not_change_its_prior():
    assert faulty_variance(0.0, 1.0) < 0.1 * 0.03**2 * 1.05
    assert faulty_variance(0.0, 0.002) < 1e-6
    assert faulty_variance(0.03, 0.002) == pytest.approx(0.03**2, rel=0.02)
    assert faulty_variance(0.01, 0.004) < faulty_variance(0.02, 0.004)


# Machines on flat ground whose streams are exchanged: one rotation explains both parts.
@pytest.mark.parametrize(
    ("platform", "seed", "share"), [("agv", 674704, 0.3), ("car", 674702, 0.3)]
)
def test_exchanged_streams_on_flat_ground_are_named_by_their_displacements(
    platform, seed, share
):
    streams = pose_faults.clean(platform, seed)
    exchanged = EXCHANGED.damage(
        streams.parent, streams.child, share, np.random.default_rng(0)
    )
    found = check_streams(*exchanged, earlier=None).findings
    assert "exchanged" in {
        finding.code for finding in found if finding.makes_unusable
    }


@pytest.mark.parametrize("seed", range(3))
def test_a_drift_on_a_flat_floor_is_no_scale_of_heights(seed):
    noise = dataclasses.replace(REALISTIC, drift=0.01)
    flat = simulate_drive(
        seed, dataclasses.replace(HILLY_DRIVE, terrain_height=0.0), noise
    )
    assert "axis_scale" not in codes_of(check_streams(*_streams(flat)).findings)


def _streams(simulated):
    return simulated.parent, simulated.child


@pytest.mark.parametrize("level", [1e-3, 0.02])
def test_the_time_of_a_loose_mount_does_not_depend_on_noise(level):
    sound = simulate_drive(4, HILLY_DRIVE, NoiseConfig(gaussian=level))
    loosened = next(fault for fault in FAULTS if fault.code == "S8")
    streams = loosened.damage(
        sound.parent, sound.child, 5.0, np.random.default_rng(1)
    )
    (finding,) = (
        f for f in check_streams(*streams).findings if f.code == "mount_moved"
    )
    assert finding.evidence["at_s"] == pytest.approx(60.0, abs=3.0)
    assert "60 s after the start" in finding.what or "5" in finding.what


def rounded_pair(step_m, in_mm):
    """Two precise streams that move slowly; the positions of those in millimetres are multiples of
    a step.
    """
    poses = wandering_poses(900, 3, step_m=0.004, step_rad=0.04)
    streams = dict(
        zip(("parent", "child"), noisy_pair(poses, 1, 3e-4, 5e-4), strict=True)
    )
    for name, stream in streams.items():
        if in_mm in (name, "both"):
            poses = stream.poses.copy()
            poses[:, :3, 3] = (
                np.round(poses[:, :3, 3] / step_m) * step_m * 1000.0
            )
            streams[name] = Trajectory(stream.stamps_ns, poses)
    return streams["parent"], streams["child"]


class TestGrid:
    def test_steps_of_rounded_positions_are_measured(self):
        child = drive().child
        poses = child.poses.copy()
        poses[:, :3, 3] = np.round(poses[:, :3, 3] / 0.05) * 0.05
        (finding,) = check_stream(Trajectory(child.stamps_ns, poses), "child")
        assert (finding.code, finding.severity) == (
            "coarse_positions",
            Severity.ERROR,
        )
        assert finding.evidence["step_m"] == pytest.approx(0.05)

    @pytest.mark.parametrize(
        ("in_mm", "options"),
        [
            ("child", {}),
            ("child", {"scale": 0.001}),
            ("child", {"scale": "estimate"}),
            ("parent", {"parent_scale": 0.001}),
            ("both", {"parent_scale": 0.001, "scale": 0.001}),
        ],
    )
    def test_millimetres_with_one_decimal_are_fine(self, in_mm, options):
        streams = rounded_pair(step_m=1e-4, in_mm=in_mm)
        result = hec.calibrate(*streams, **options)
        assert codes_of(result.findings) == []
        assert result.verdict is Verdict.USE
        assert_allclose(result.T_parent_child, T_PARENT_CHILD, atol=2e-3)

    @pytest.mark.parametrize("stream", ["parent", "child"])
    @pytest.mark.parametrize(
        ("step_m", "severity"),
        [(0.008, Severity.WARNING), (0.05, Severity.ERROR)],
    )
    def test_coarse_millimetres_are_named_by_their_step_in_metres(
        self, stream, step_m, severity
    ):
        option = {"parent": "parent_scale", "child": "scale"}[stream]
        streams = rounded_pair(step_m=step_m, in_mm=stream)
        result = hec.calibrate(*streams, **{option: 0.001})
        (finding,) = (
            finding
            for finding in result.findings
            if finding.code == "coarse_positions"
        )
        assert (finding.stream, finding.severity) == (stream, severity)
        assert (
            finding.what
            == f"the {stream} stream's positions are multiples of {step_m:g} m"
        )

    @pytest.mark.parametrize("n_parked", [0, 100, 1000])
    @pytest.mark.parametrize("n_drives", [1, 6])
    def test_steady_motion_is_no_grid_even_if_it_stops(
        self, n_parked, n_drives
    ):
        is_step = np.tile(np.repeat([1.0, 0.0], [300, n_parked]), n_drives)
        poses = np.tile(np.eye(4), (len(is_step), 1, 1))
        poses[:, 0, 3] = 0.25 * np.cumsum(is_step)
        stream = Trajectory(np.arange(len(is_step)) * 10**8, poses)

        codes = codes_of(check_stream(stream, "child"))

        assert "coarse_positions" not in codes

    @pytest.mark.parametrize("speed_m_s", [0.2, 0.7])
    def test_rounded_positions_of_steady_motion_are_a_grid(self, speed_m_s):
        stamps_ns = np.arange(600) * 10**8
        poses = np.tile(np.eye(4), (600, 1, 1))
        poses[:, 0, 3] = np.round(speed_m_s * stamps_ns * 1e-9 / 0.1) * 0.1

        findings = check_stream(Trajectory(stamps_ns, poses), "child")

        assert "coarse_positions" in codes_of(findings)


def straight_at(stream, stamps_ns):
    """Poses at other stamps as TF interpolates them: along lines, and by slerp."""
    after = np.searchsorted(stream.stamps_ns, stamps_ns)
    after = np.clip(after, 1, len(stream) - 1)
    before = after - 1
    start_ns = stream.stamps_ns[before]
    span_ns = stream.stamps_ns[after] - start_ns
    share = ((stamps_ns - start_ns) / span_ns)[:, None]

    start = stream.poses[before]
    end = stream.poses[after]
    start_rotations = start[:, :3, :3]
    back = np.swapaxes(start_rotations, 1, 2)
    turns = se3.rotation_log(back @ end[:, :3, :3])
    rotations = start_rotations @ se3.rotation_exp(share * turns)
    moves = end[:, :3, 3] - start[:, :3, 3]
    positions = start[:, :3, 3] + share * moves
    return se3.from_rotation_translation(rotations, positions)


def rounded(poses, digits):
    quats = np.round(se3.to_quat_xyzw(poses), digits)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    positions = np.round(poses[:, :3, 3], digits)
    return se3.from_quat_xyzw(positions, quats)


class TestOneStreamComputedFromTheOther:
    QUESTION = (
        ". Was one computed from the other (TF, fusion)? Then this result only returns the old "
        "transform"
    )
    SENTENCE = f"both streams agree to less than 0.001 deg, which two sensors hardly do{QUESTION}"

    def found(self, parent, child):
        findings = check_streams(parent, child).findings
        return [
            finding.what for finding in findings if finding.code[:3] != "one"
        ]

    @pytest.mark.parametrize("rate_hz", [4.0, 11.0, 37.0])
    def test_at_any_rate(self, rate_hz):
        parent = drive().parent
        n_poses = int((parent.duration_s - 0.1) * rate_hz)
        start_ns = int(parent.stamps_ns[0]) + 7_300_000
        stamps_ns = as_trajectory(
            np.tile(np.eye(4), (n_poses, 1, 1)), rate_hz, start_ns
        ).stamps_ns
        child = Trajectory(stamps_ns, child_of(straight_at(parent, stamps_ns)))
        assert self.found(parent, child) == [self.SENTENCE]

    @pytest.mark.parametrize("delay_s", [0.0, 0.05])
    def test_in_a_text_file_of_six_digits_and_with_a_delay(self, delay_s):
        parent = drive().parent
        child = Trajectory(
            parent.stamps_ns, rounded(child_of(parent.poses), 6)
        ).shifted(-delay_s)
        parent = Trajectory(parent.stamps_ns, rounded(parent.poses, 6))
        assert self.SENTENCE in self.found(parent, child)

    @pytest.mark.parametrize(
        ("error_m", "width"), [(0.0, 0.01), (0.05, 0.01), (0.005, 1.0)]
    )
    def test_with_a_little_noise_and_slow_errors_of_its_own(
        self, error_m, width
    ):
        stamps_ns = drive().parent.stamps_ns
        poses = gaussian_filter1d(drive().parent.poses, width, axis=0)
        poses[:, :3, :3] = se3.nearest_rotation(poses[:, :3, :3])
        slow = error_m * np.sin(
            np.outer(np.arange(len(poses)) / 40, [1, 0, 0, 0, 0.2, 0])
        )
        own = disturbed(
            child_of(poses) @ se3.exp(slow),
            1,
            *(width < 1) * np.array([1e-4, 3e-5]),
        )
        sentences = self.found(
            Trajectory(stamps_ns, poses), Trajectory(stamps_ns, own)
        )
        assert sentences == [
            f"the noise of both streams is unusually alike{self.QUESTION}"
        ]

    def test_orientations_alone(self):
        parent, child = _streams(drive())
        X = drive().T_parent_child
        inner = parent[1:-1]
        world = child.at(inner.stamps_ns[:1]) @ se3.inverse(inner.poses[:1] @ X)
        poses = child.at(inner.stamps_ns)
        wrong = se3.from_rotation_translation(
            se3.rotation_exp([0.2, -0.1, 0.3]), np.zeros(3)
        )
        poses[:, :3, :3] = (world @ inner.poses @ X @ wrong)[:, :3, :3]
        assert (
            self.found(parent, Trajectory(inner.stamps_ns, poses))[0]
            == self.SENTENCE
        )

    def test_never_use(self):
        parent = drive().parent
        result = hec.calibrate(
            parent, Trajectory(parent.stamps_ns, child_of(parent.poses))
        )
        assert result.verdict is Verdict.DO_NOT_USE
        assert result.reasons[0].sentence == self.SENTENCE

    def test_streams_that_the_user_called_exact_are_a_question_for_care(self):
        parent = drive().parent
        child = Trajectory(parent.stamps_ns, child_of(parent.poses))
        kinds = {"parent_kind": "exact", "child_kind": "exact"}
        result = hec.calibrate(parent, child, **kinds)
        assert result.verdict is Verdict.USE_WITH_CARE
        assert [reason.sentence for reason in result.reasons] == [self.SENTENCE]

    @pytest.mark.parametrize("rate_hz", [10.0, 100.0])
    @pytest.mark.parametrize("noise", [2e-5, 5e-5, 2e-4, 5e-4, 2e-3])
    def test_two_precise_sensors_are_no_copies(self, rate_hz, noise):
        poses = wandering_poses(600, 4, 1.0 / rate_hz, 0.8 / rate_hz)
        findings = check_streams(
            *noisy_pair(poses, 1, noise, noise, rate_hz=rate_hz)
        ).findings
        assert [finding.what for finding in findings] == []


def fused(parent, child, X, tau_s):
    """The parent's odometry, corrected towards the child's poses through the mount ``X``."""
    aims = child.at(parent.stamps_ns) @ se3.inverse(X)
    steps = se3.inverse(parent.poses[:-1]) @ parent.poses[1:]
    interval_s = np.diff(parent.stamps_ns).mean() * 1e-9
    gain = 1.0 - np.exp(-interval_s / tau_s)
    poses = [aims[0]]
    for step, aim in zip(steps, aims[1:], strict=True):
        predicted = poses[-1] @ step
        innovation = se3.log(se3.inverse(predicted) @ aim)
        poses.append(predicted @ se3.exp(gain * innovation))
    return Trajectory(parent.stamps_ns, np.array(poses))


class TestParentFusedFromTheChild:
    """Through a mount that is 3.5 deg and 8 cm wrong."""

    WRONG_ROTATION = np.radians([2.0, -2.0, 2.0])
    WRONG = se3.exp(np.r_[0.05, -0.05, 0.04, WRONG_ROTATION])

    @pytest.mark.parametrize("tau_s", [0.1, 0.2, 0.5])
    @pytest.mark.parametrize("kind", ["hand_vio_walk", "hand_gm_1s"])
    def test_short_motions_show_another_mount_than_long_ones(self, kind, tau_s):
        truth = make(kind, 901)
        inside = slice(2, -2)
        parent = fused(
            truth.parent[inside],
            truth.child,
            truth.T_parent_child @ self.WRONG,
            tau_s,
        )
        result = hec.calibrate(parent, truth.child)
        assert result.verdict is not Verdict.USE
        codes = set(codes_of(result.findings))
        # Positions that are turned against orientations show the longest times.
        assert codes & {"not_independent", "worlds_turned"}
        clean = hec.calibrate(truth.parent, truth.child)
        assert (clean.verdict, clean.findings) == (Verdict.USE, ())

    @pytest.mark.parametrize("tau_s", [0.3, 2.0])
    @pytest.mark.parametrize("filtered", ["parent", "child"])
    def test_the_finding_names_the_error_of_the_assumed_mount(
        self, filtered, tau_s
    ):
        truth = make("hand_vio_walk", 902)
        parent = truth.parent[2:-2]
        child = truth.child
        assumed = truth.T_parent_child @ self.WRONG
        if filtered == "parent":
            parent = fused(parent, child, assumed, tau_s)
        else:
            child = fused(
                child[2:-2], truth.parent, se3.inverse(assumed), tau_s
            )
        findings = check_streams(parent, child).findings
        (finding,) = [
            found for found in findings if found.code == "not_independent"
        ]
        assert finding.severity is Severity.ERROR
        wrong_rad = np.linalg.norm(self.WRONG_ROTATION)
        assert finding.evidence["turn_rad"] == pytest.approx(wrong_rad, rel=0.4)
        # Only the nearest of four time constants is fitted.
        assert finding.evidence["time_constant_s"] in (0.3, 1.0, 3.0)

    def test_a_wrong_lever_arm_alone_is_questioned(self):
        truth = make("hand_vio_walk", 902)
        shift = se3.from_rotation_translation(
            np.eye(3), np.array([0.05, -0.05, 0.04])
        )
        parent = fused(
            truth.parent[2:-2], truth.child, truth.T_parent_child @ shift, 0.1
        )
        (finding,) = check_streams(parent, truth.child).findings
        assert (finding.code, finding.severity) == (
            "not_independent",
            Severity.WARNING,
        )
        assert finding.evidence["shift_m"] == pytest.approx(0.081, rel=0.2)

    @pytest.mark.parametrize("seed", [61, 62])
    def test_rotations_about_one_axis_show_no_other_mount(self, seed):
        flat = make("flat_agv", seed)
        codes = codes_of(check_streams(flat.parent, flat.child).findings)
        assert codes == ["one_axis"]

    @pytest.mark.parametrize("kind", ["car_ins_lidar", "agv_long"])
    def test_streams_that_never_drift_apart_on_a_long_path_are_questioned(
        self, kind
    ):
        truth = make(kind, 901)
        copies = truth.child.poses @ se3.inverse(
            truth.T_parent_child @ self.WRONG
        )
        parent = Trajectory(
            truth.child.stamps_ns, disturbed(copies, 3, 0.01, 0.002)
        )
        (finding,) = check_streams(parent, truth.child).findings
        assert (finding.code, finding.severity) == (
            "not_independent",
            Severity.WARNING,
        )
        assert finding.what.startswith("the streams drift apart by only ")
        assert finding.what.endswith(TestOneStreamComputedFromTheOther.QUESTION)
        assert check_streams(parent, truth.child, are_exact=True).findings == ()
        assert check_streams(truth.parent, truth.child).findings == ()

    @pytest.mark.parametrize("kind", ["hand_vio_walk", "drone_two_vios"])
    def test_a_copy_with_noise_of_its_own_is_questioned_on_a_short_path(
        self, kind
    ):
        truth = make(kind, 901)
        copies = truth.child.poses @ se3.inverse(
            truth.T_parent_child @ self.WRONG
        )
        parent = Trajectory(
            truth.child.stamps_ns, disturbed(copies, 3, 0.003, 0.0015)
        )
        (finding,) = check_streams(parent, truth.child).findings
        assert (finding.code, finding.severity) == (
            "not_independent",
            Severity.WARNING,
        )
        assert finding.what.endswith(TestOneStreamComputedFromTheOther.QUESTION)
        assert check_streams(parent, truth.child, are_exact=True).findings == ()

    def test_two_sensors_with_white_noise_are_not_questioned(self):
        truth = make("hand_white", 901)
        assert check_streams(truth.parent, truth.child).findings == ()


class TestGraveAgain:
    """Faults that spoil the answer by many standard deviations are errors, not warnings."""

    @staticmethod
    def errors(code, severity):
        sound = drive()
        fault = next(
            fault for fault in (*FAULTS, *LATER, *SILENT) if fault.code == code
        )
        random = np.random.default_rng(5)
        parent, child = fault.damage(
            sound.parent, sound.child, fault.severities[severity], random
        )
        result = hec.calibrate(parent, child, max_pairs=400, **fault.options)
        return [
            finding.code
            for finding in result.findings
            if finding.severity.value == "error"
        ]

    @pytest.mark.parametrize(
        ("code", "severity", "name"),
        [
            (
                "S2",
                0,
                "same_position",
            ),  # positions of the parent with 1 cm of noise
            ("S4", 1, "position_clock"),  # low-passed by 100 ms
            ("V1", 1, "position_clock"),  # the parent's positions 50 ms late
            ("V2", 2, "position_clock"),  # orientations 100 ms late
        ],
    )
    def test_a_fault_is_an_error(self, code, severity, name):
        assert name in self.errors(code, severity)

    @pytest.mark.parametrize("axis", [0, 1, 2])
    @pytest.mark.parametrize("share", [0.5, 0.4])
    def test_a_child_that_starts_anew_with_left_handed_axes_is_an_error(
        self, axis, share
    ):
        sound = drive(1)
        poses = sound.child.poses.copy()
        first = int(share * len(poses))
        mirror = np.diag(np.where(np.arange(4) == axis, -1.0, 1.0))
        mirrored = mirror @ poses[first:] @ mirror
        poses[first:] = se3.inverse(mirrored[0]) @ mirrored
        child = dataclasses.replace(sound.child, poses=poses)
        result = hec.calibrate(sound.parent, child, max_pairs=400)
        assert "mount_moved" in codes_of(result.findings)
        assert result.verdict is hec.Verdict.DO_NOT_USE
