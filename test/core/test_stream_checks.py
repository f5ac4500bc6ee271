"""Each usual mistake is found and named; sound streams are left in peace."""

import dataclasses
import functools
import re
import tracemalloc

import motions
import numpy as np
import pytest
from faults import (
    FAULTS,
    frozen,
    inverted,
    mirrored,
    reordered,
    with_swapped_axes,
)
from findings import codes_of

from hand_eye_calib.core.alignment.similarity import EXPLAINED, fit_similarity
from hand_eye_calib.core.alignment.time_offset import (
    TimeOffset,
    estimate_time_offset,
)
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.checks import hypotheses
from hand_eye_calib.core.checks.check import check_streams
from hand_eye_calib.core.checks.clock_and_scale import check_offset
from hand_eye_calib.core.checks.findings import Severity
from hand_eye_calib.core.checks.hypothesis import HOLDS
from hand_eye_calib.core.checks.streams import (
    check_frozen,
    check_stream,
    frozen_intervals,
)
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.extras.simulation.drive import simulate, simulate_drive
from hand_eye_calib.extras.simulation.options import (
    MIXTURE,
    PUBLISHED_DRIVE,
    NoiseConfig,
)
from hand_eye_calib.offline.cli.main import main
from hand_eye_calib.offline.report.evidence import summarise


def drive(seed=0, noise=0.001, wander=motions.wandering_poses, n_poses=500):
    """A walk far from the origin, so that it matters whose pose is in which frame."""
    start = se3.from_rotation_translation(np.eye(3), [30.0, -20.0, 2.0])
    return motions.noisy_pair(
        start @ wander(n_poses, seed), seed + 1, noise, noise
    )


def driving_car(n_poses=600):
    """Two sensors of a car that takes curves at 8 m/s, ten poses a second."""
    steps = np.zeros((n_poses - 1, 6))
    steps[:, 0] = 0.8
    steps[:, 5] = 0.03 * np.sin(np.arange(n_poses - 1) / 25.0)
    return motions.noisy_pair(motions.walked(se3.exp(steps)), 1, 0.003, 0.0005)


# Pose at which a car stops.
_STOP_AT = 300


def with_stop(stream, duration_s, drift):
    """A stop of so many seconds, during which the pose drifts by (rho, phi) ``drift`` (6,)."""
    n_poses = round(10 * duration_s)
    shares = np.arange(1, n_poses + 1)[:, None] / n_poses
    standing = stream.poses[_STOP_AT] @ se3.exp(shares * drift)
    onward = (
        standing[-1]
        @ se3.inverse(stream.poses[_STOP_AT])
        @ stream.poses[_STOP_AT + 1 :]
    )
    poses = np.concatenate([stream.poses[: _STOP_AT + 1], standing, onward])
    return motions.as_trajectory(poses)


def frozen_time_s(stream, other):
    """Time in which a stream repeats its pose while the other sensor moves."""
    lengths_ns = [
        until - since for since, until in frozen_intervals(stream, other)
    ]
    return 1e-9 * sum(lengths_ns)


def grave(agreement):
    return [
        (finding.code, finding.stream)
        for finding in agreement.findings
        if finding.severity is not Severity.NOTE
    ]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    "wander", [motions.wandering_poses, motions.planar_poses]
)
def test_no_false_alarm(seed, wander):
    agreement = check_streams(*drive(seed, wander=wander))
    assert grave(agreement) == []


@pytest.mark.parametrize(
    "wander", [motions.wandering_poses, motions.planar_poses]
)
def test_no_rival_is_taken_for_noisy_streams_that_agree(wander, monkeypatch):
    fits = []

    def counted(*arguments, **options):
        fits.append(fit_similarity(*arguments, **options))
        return fits[-1]

    monkeypatch.setattr(hypotheses, "fit_similarity", counted)
    assert grave(check_streams(*drive(1, noise=0.02, wander=wander))) == []
    assert EXPLAINED < fits[0].unexplained < HOLDS
    assert len(fits) > 1


@pytest.mark.parametrize("centred", ["parent", "child"])
def test_a_body_that_rotates_about_one_of_its_sensors(centred):
    """The translations of that sensor are noise, and any small scale would fit them."""
    rotating = motions.wandering_poses(500, 3)
    rotating[:, :3, 3] = 0.0
    streams = [rotating, motions.child_of(rotating, T_cw_pw=np.eye(4))]
    parent, child = (
        motions.as_trajectory(
            motions.disturbed(se3.inverse(poses[0]) @ poses, seed, 0.005, 0.001)
        )
        for seed, poses in enumerate(
            streams if centred == "parent" else streams[::-1]
        )
    )
    assert grave(check_streams(parent, child)) == []


class TestTwoSensorsInOneStream:
    """Levels in turn; a body that shakes has none."""

    def codes(self, heights):
        poses = motions.planar_poses(len(heights), 4)
        poses[:, 2, 3] += heights
        stream = motions.as_trajectory(
            motions.disturbed(poses, 5, 0.001, 0.001)
        )
        return set(codes_of(check_stream(stream, "child")))

    @pytest.mark.parametrize("shakes_hz", [3.9, 4.2, 4.7])
    def test_shaking_at_about_half_the_rate(self, shakes_hz):
        times_s = np.arange(900) / 10.0
        assert (
            self.codes(0.03 * np.sin(2 * np.pi * shakes_hz * times_s)) == set()
        )

    def test_levels_in_turn(self):
        assert self.codes(0.03 * (np.arange(900) % 2)) == {"interleaved"}


def test_one_world_for_both_streams_is_no_sign_of_inverse_poses():
    seconds = np.arange(400) * 0.05
    turns = np.sin(
        np.outer(seconds, [0.7, 0.9, 0.1]) + np.array([0.0, 1.0, 0.0])
    ) * [
        0.3,
        0.2,
        1.2,
    ]
    places = np.outer(seconds, [0.05, 0.07, 0.8]) + np.array(
        [0.0, 0.0, np.pi / 2]
    )
    places = np.sin(places) * [20.0, 20.0, 0.5]
    poses = se3.from_rotation_translation(se3.rotation_exp(turns), places)
    noisy = motions.disturbed(
        motions.child_of(poses, T_cw_pw=np.eye(4)), 1, 1e-3, 1e-3
    )
    parent = motions.as_trajectory(poses, 20)
    child = motions.as_trajectory(noisy, 20)
    assert grave(check_streams(parent, child)) == []
    assert grave(check_streams(inverted(parent), inverted(child))) == [
        ("inverse_both", "both")
    ]


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_is_named(fault):
    damage, code = FAULTS[fault]
    parent, child = drive()
    agreement = check_streams(*damage(parent, child, drive(9)[1]))
    assert [pair for pair, _ in grave(agreement)] == [code]


@pytest.mark.parametrize(
    "noise", [MIXTURE, NoiseConfig(gaussian=0.01, outliers=0.1, drift=0.05)]
)
def test_strong_noise_is_no_fault_of_the_rig(noise):
    simulated = simulate_drive((1, 0), PUBLISHED_DRIVE, noise)
    result = check_streams(simulated.parent, simulated.child)
    assert {code for code, _ in grave(result)} <= {"jumps"}


def test_streams_that_nearly_agree_as_they_are_may_be_in_another_order():
    simulated = simulate(77, poses=500)  # hardly any roll and pitch
    result = check_streams(simulated.parent, reordered(simulated.child))
    assert grave(result)[0] == ("quaternion_order", "child")


class TestWhichStreamAndWhatToDo:
    @pytest.mark.parametrize("factor", [np.pi / 180, 0.5])
    def test_angles_in_another_unit_or_halved(self, factor):
        parent, child = drive(wander=motions.planar_poses)
        turns = se3.rotation_exp(
            factor * se3.rotation_log(child.poses[:, :3, :3])
        )
        poses = se3.from_rotation_translation(turns, child.poses[:, :3, 3])
        other = dataclasses.replace(child, poses=poses)
        assert grave(check_streams(parent, other)) == [
            ("rotation_gain", "child")
        ]

    @pytest.mark.parametrize(
        ("damage", "code"),
        [(reordered, "quaternion_order"), (inverted, "inverse")],
    )
    def test_the_parent_is_named_where_it_is_the_parent(self, damage, code):
        parent, child = drive()
        assert grave(check_streams(damage(parent), child)) == [(code, "parent")]

    def test_offset_and_scale_come_as_options(self):
        parent, child = drive()
        findings = {
            f.code: f
            for f in check_streams(
                parent, child.shifted(-7.25).scaled(0.5)
            ).findings
        }
        assert findings["time_offset"].options["time_offset"] == pytest.approx(
            7.25, abs=0.002
        )
        assert findings["scale"].options["scale"] == pytest.approx(
            2.0, rel=0.005
        )
        result = check_streams(
            parent,
            child.shifted(-7.25).scaled(0.5),
            time_offset_s=7.25,
            scale=2.0,
        )
        assert grave(result) == []
        tiny = [
            finding.options
            for finding in check_streams(parent, child.scaled(2e5)).findings
        ]
        assert {"scale": pytest.approx(5e-6, rel=0.005)} in tiny
        # The solve may have found a scale of its own beside the unit.
        result = check_streams(parent.scaled(1000.0), child, scale=1.17)
        (units,) = (
            finding for finding in result.findings if finding.code == "units"
        )
        assert units.options == {"parent_scale": 0.001}

    def test_which_axes_are_swapped(self):
        parent, child = drive()
        finding = check_streams(
            parent, with_swapped_axes(child, (0, 2, 1))
        ).findings[0]
        assert (finding.code, finding.stream) == ("axes", "child")
        assert "(x z y)" in finding.what

    def test_left_handed_axes_and_two_mistakes_at_once(self):
        parent, child = drive()
        assert grave(check_streams(parent, mirrored(child))) == [
            ("left_handed", "child")
        ]
        findings = grave(
            check_streams(
                parent, reordered(child).shifted(-33.0).scaled(1000.0)
            )
        )
        codes = "quaternion_order", "time_offset", "units"
        assert sorted(findings) == [(code, "child") for code in codes]

    def test_turning_about_one_axis_is_named_in_the_parent_frame(self):
        lying = se3.from_rotation_translation(
            se3.rotation_exp(np.array([np.pi / 2, 0, 0])), np.zeros(3)
        )
        parent, child = drive(wander=motions.planar_poses)
        note = check_streams(
            motions.as_trajectory(parent.poses @ lying), child
        ).findings[0]
        assert (note.code, note.severity) == ("one_axis", Severity.NOTE)
        assert (
            note.what
            == "y cannot be determined from this motion, and will be unknown"
        )
        assert note.options == {"prior.y": "VALUE+/-SIGMA"}


class TestOneStream:
    def test_gaps(self):
        parent, _ = drive()
        keep = np.ones(len(parent), dtype=bool)
        keep[100:130] = False
        finding = check_stream(parent[keep], "parent")[0]
        assert (finding.code, finding.severity) == ("gaps", Severity.NOTE)
        assert "gaps: 1, of up to 3.10 s" in finding.what

    def test_jumps(self):
        parent, _ = drive()
        poses = parent.poses.copy()
        poses[200:, :3, 3] += 3.0  # a lasting one
        poses[[50, 300], :3, 3] -= 2.0  # there and back
        jumps = [
            f
            for f in check_stream(
                dataclasses.replace(parent, poses=poses), "child"
            )
            if f.code == "jumps"
        ]
        assert "1.0% of the child stream's steps" in jumps[0].what

    def test_frozen_only_while_the_other_moves(self):
        parent, child = drive()
        frozen_s = frozen_time_s(frozen(child, 0.75), parent)
        assert frozen_s / child.duration_s == pytest.approx(0.25, abs=0.01)
        assert frozen_intervals(child, parent) == []
        assert frozen_intervals(frozen(child, 0.75), frozen(parent, 0.75)) == []

    @pytest.mark.parametrize("repeating", ["parent", "child"])
    @pytest.mark.parametrize("duration_s", [4.0, 42.0, 120.0])
    def test_drift_of_one_odometry_at_traffic_lights_is_no_motion(
        self, repeating, duration_s
    ):
        streams = dict(zip(("parent", "child"), driving_car(), strict=True))
        drift = np.r_[0.05, -0.03, 0.01, 0.01, 0.0, 0.04]
        for name, stream in streams.items():
            streams[name] = with_stop(
                stream, duration_s, np.zeros(6) if name == repeating else drift
            )
        assert check_frozen(**streams) == []
        codes = set(codes_of(check_streams(**streams).findings))
        assert "frozen" not in codes

    @pytest.mark.parametrize("repeating", ["parent", "child"])
    def test_noise_of_a_camera_beside_wheels_that_stand_is_no_motion(
        self, repeating
    ):
        streams = dict(
            zip(("parent", "child"), drive(n_poses=500), strict=True)
        )
        for seed, (name, stream) in enumerate(streams.items()):
            stopped = with_stop(stream, 20.0, np.zeros(6))
            if name != repeating:
                poses = motions.disturbed(stopped.poses, seed, 0.02, 0.03)
                stopped = dataclasses.replace(stopped, poses=poses)
            streams[name] = stopped
        assert check_frozen(**streams) == []

    @pytest.mark.parametrize("frozen_stream", ["parent", "child"])
    @pytest.mark.parametrize("duration_s", [2.0, 3.5, 6.0])
    @pytest.mark.parametrize("of", ["car", "hand"])
    def test_a_freeze_of_seconds_during_motion_is_found(
        self, frozen_stream, duration_s, of
    ):
        pair = driving_car() if of == "car" else drive(n_poses=600)
        streams = dict(zip(("parent", "child"), pair, strict=True))
        stream = streams[frozen_stream]
        poses = stream.poses.copy()
        poses[200 : 201 + int(10 * duration_s)] = poses[200]
        streams[frozen_stream] = dataclasses.replace(stream, poses=poses)
        (finding,) = check_frozen(**streams)
        assert (finding.code, finding.stream, finding.severity) == (
            "frozen",
            frozen_stream,
            Severity.ERROR,
        )
        share = duration_s / stream.duration_s
        assert finding.evidence["share"] == pytest.approx(share, abs=0.004)

    def test_only_the_part_of_a_freeze_in_which_the_car_drives_counts(self):
        parent, child = driving_car()
        parent = with_stop(parent, 40.0, np.zeros(6))
        child = with_stop(child, 40.0, np.zeros(6))
        poses = child.poses.copy()
        poses[_STOP_AT + 400 : _STOP_AT + 500] = poses[_STOP_AT]
        stuck = dataclasses.replace(child, poses=poses)
        assert 6.0 < frozen_time_s(stuck, parent) < 14.0

    @pytest.mark.parametrize(
        ("at", "few"), [(3, "the first 3"), (497, "the last 3")]
    )
    def test_a_stamp_years_away_is_one_line_and_takes_no_memory(self, at, few):
        parent, child = drive()
        stamps_ns = child.stamps_ns.copy()
        stamps_ns[at:] += 3 * 365 * 86_400 * 10**9
        far = Trajectory(stamps_ns, child.poses)
        tracemalloc.start()
        (finding,) = check_streams(parent, far).findings
        summarise(far)
        assert tracemalloc.get_traced_memory()[1] < 50e6
        tracemalloc.stop()
        assert (finding.code, finding.stream, finding.severity) == (
            "leap",
            "child",
            Severity.ERROR,
        )
        assert f"leap by 1,095 days after pose {at} of 500" in finding.what
        assert (
            finding.advice == f"repair the stamps, or remove {few} of its poses"
        )
        with pytest.raises(InputError, match="leap by 1,095 days"):
            estimate_time_offset(parent, far)

    def test_too_short_and_the_numbers_of_one_that_is_not(self):
        parent, child = drive()
        assert grave(check_streams(parent[:3], child)) == [
            ("too_short", "parent")
        ]
        summary = summarise(drive(noise=0.0)[0])
        assert (summary.poses, summary.rate_hz) == (500, pytest.approx(10.0))
        assert summary.duration_s == pytest.approx(49.9)
        assert summary.longest_interval_s == pytest.approx(0.1)


class TestCommand:
    @pytest.fixture
    def files(self, tmp_path):
        return functools.partial(motions.write_pair, tmp_path)

    def test_good_streams(self, files, capsys):
        assert main(["check", *files(*drive())]) == 0
        out, err = capsys.readouterr()
        assert out.startswith("No fault found in these streams; run calibrate")
        assert "500" in out
        assert err == ""

    def test_a_fault_is_one_line_on_stderr_and_a_table_on_stdout(
        self, files, capsys
    ):
        parent, child = drive()
        assert main(["check", *files(parent, child.shifted(-2.0))]) == 1
        out, err = capsys.readouterr()
        assert "ERROR    time_offset" in out
        assert out.startswith(
            "DO NOT USE these streams unchanged: calibrate with --time-offset estimate.\n"
        )
        assert len(err.splitlines()) == 1
        assert (
            main(
                [
                    "check",
                    *files(parent, child.shifted(-2.0)),
                    "--time-offset",
                    "2",
                ]
            )
            == 0
        )

    def test_a_finding_that_the_options_answer_is_a_note(self, files, capsys):
        parent, child = drive()
        poses = child.poses.copy()
        poses[250:, :3, 3] += 0.7
        poses[330:, :3, 3] -= 0.9
        jumping = files(parent, dataclasses.replace(child, poses=poses))
        assert main(["check", *jumping]) == 0
        out, err = capsys.readouterr()
        assert re.search(r"^note +jumps", out, re.MULTILINE)
        assert "No fault found" in out
        assert err == ""
        assert main(["check", *jumping, "--method", "park"]) == 0
        out, err = capsys.readouterr()
        assert "calibrate with --method dnlo" in out
        assert err == ""


class TestSlowStreams:
    """Nothing is interpolated between poses that are a second or more apart."""

    @pytest.mark.parametrize("interval_s", [1.0, 20.0])
    def test_equal_stamps_have_motions_in_common(self, interval_s):
        parent, child = (
            motions.as_trajectory(stream.poses[::5], 1 / interval_s)
            for stream in drive()
        )
        assert grave(check_streams(parent, child)) == []

    def test_a_clock_offset_is_found_between_poses(self):
        parent, child = (
            motions.as_trajectory(stream.poses, 1.0)
            for stream in drive(wander=motions.planar_poses)
        )
        assert [
            code
            for code, _ in grave(check_streams(parent, child.shifted(-3.0)))
        ] == ["time_offset"]


def around_a_target(n_poses, seed):
    """Poses of a camera that an arm moves around a target at the origin, and looks at it."""
    random = np.random.default_rng(seed)
    angles = random.uniform([-0.9, 0.3, -0.5], [0.9, 1.2, 0.5], (n_poses, 3))
    azimuth, elevation, roll = angles.T
    ahead = -np.c_[
        np.cos(elevation) * np.cos(azimuth),
        np.cos(elevation) * np.sin(azimuth),
        np.sin(elevation),
    ]
    right = np.cross([0.0, 0.0, 1.0], ahead)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    axes = np.stack([right, np.cross(ahead, right), ahead], axis=2)
    rolls = se3.rotation_exp(np.c_[np.zeros((n_poses, 2)), roll])
    return se3.from_rotation_translation(
        axes @ rolls, -random.uniform(0.4, 0.6, (n_poses, 1)) * ahead
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_camera_around_its_target_is_no_sign_of_inverse_poses(seed):
    camera = around_a_target(40, seed)
    hand = motions.child_of(
        camera,
        se3.exp(np.array([0.03, -0.05, 0.08, 0.1, -0.2, 1.5])),
        np.eye(4),
    )
    hand[:, :3, 3] -= [0.05, 0.05, -0.1]
    parent = motions.as_trajectory(
        motions.disturbed(hand, seed, 2e-4, 2e-4), 1.0
    )
    child = motions.as_trajectory(
        motions.disturbed(camera, seed + 9, 1e-3, 2e-3), 1.0
    )
    assert grave(check_streams(parent, child)) == []


def test_a_short_lever_arm_is_zero_only_if_it_cannot_be_longer_than_2_mm():
    poses = motions.wandering_poses(600, 5, 0.02)
    severities = []
    for length_m, noise in (
        (0.0005, 1e-4),
        (0.004, 1e-4),
        (0.016, 0.004),
        (0.016, 0.02),
    ):
        X = se3.from_rotation_translation(
            se3.rotation_exp([0.4, -0.8, 0.3]), [length_m, 0.0, 0.0]
        )
        findings = check_streams(
            *motions.noisy_pair(poses, 1, noise, noise, mount=X)
        ).findings
        severities.append(
            {
                finding.severity
                for finding in findings
                if finding.code == "same_position"
            }
        )
    assert severities == [{Severity.ERROR}, {Severity.WARNING}, set(), set()]

    def test_a_listing_of_files_is_refused_in_one_line(self, files, capsys):
        assert main(["calibrate", *files(*drive()), "--list"]) == 1
        assert "is a trajectory file, which has none" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("offset_s", "added_s", "key", "option"),
    [
        (-0.0351, 0.035, "needless_time_offset", 0.0),
        (-0.0331, 0.035, "time_offset", 0.0019),
        (0.02, 0.0, "time_offset", 0.02),
    ],
)
def test_an_offset_that_worsens_the_clocks_is_omitted(
    offset_s, added_s, key, option
):
    offset = TimeOffset(seconds=offset_s, sigma_s=0.00012)
    (found,) = check_offset(offset, added_s)
    assert (found.key, found.code) == (key, "time_offset")
    assert found.options == {"time_offset": pytest.approx(option)}


@pytest.mark.parametrize("stream", ["parent", "child"])
def test_a_stream_that_keeps_its_orientation_is_named(stream):
    streams = dict(zip(("parent", "child"), drive(), strict=True))
    poses = streams[stream].poses.copy()
    poses[:, :3, :3] = np.eye(3)
    streams[stream] = dataclasses.replace(streams[stream], poses=poses)
    found = check_streams(**streams).findings[0]
    assert found.code == "no_turning"
    assert found.what.startswith(f"the {stream}'s orientation is the same")
    assert f"{stream}_measures positions" in found.advice
