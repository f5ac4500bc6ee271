"""Lengths in other units: what a ratio of lengths says, and what it does not."""

import numpy as np
import pytest
from findings import codes_of
from motions import as_trajectory, child_of, disturbed, wandering_poses
from numpy.testing import assert_allclose

import hand_eye_calib as hec
from hand_eye_calib.core.alignment.scale import estimate_scale
from hand_eye_calib.core.checks.check import CheckResult
from hand_eye_calib.core.checks.clock_and_scale import beside_solved_scale
from hand_eye_calib.core.checks.findings import finding
from hand_eye_calib.core.checks.streams import (
    check_lengths,
    is_too_fast,
    is_too_slow,
)
from hand_eye_calib.core.checks.units import in_other_units
from hand_eye_calib.core.engine import poses
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import deviation
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.extras.simulation.drive import simulate_drive
from hand_eye_calib.extras.simulation.options import HILLY_DRIVE, NoiseConfig
from reproduction.coverage import classes, mixed
from reproduction.coverage.classes import make

UNITS = {
    "millimetres": 1e-3,
    "centimetres": 1e-2,
    "inches": 0.0254,
    "feet": 0.3048,
}


@pytest.fixture(scope="module")
def hand():
    """Metres at walking speed, as hand-held sensors move."""
    poses = wandering_poses(400)
    child = disturbed(child_of(poses), 1, 0.002, 0.001)
    return as_trajectory(poses), as_trajectory(child)


@pytest.fixture(scope="module")
def expected(hand):
    return hec.calibrate(*hand, reference="B5").T_parent_child


def moving_at(speed_m_s):
    """Ten seconds along a line that bends."""
    times_s = 0.1 * np.arange(100)
    places = speed_m_s * np.stack(
        [times_s, np.sin(0.3 * times_s), 0.0 * times_s], axis=1
    )
    return Trajectory.from_positions(
        np.round(1e9 * times_s).astype(np.int64), places
    )


class TestRatio:
    """``in_other_units`` of a scale, with both streams at these speeds as they are given."""

    @pytest.mark.parametrize("unit", UNITS)
    def test_a_child_in_another_unit_is_named_within_three_sigma(self, unit):
        factor = UNITS[unit]
        streams = moving_at(0.5), moving_at(0.5 / factor)
        finding = in_other_units(1.002 * factor, 0.001 * factor, *streams)
        assert (finding.code, finding.stream) == ("units", "child")
        assert finding.options == {"scale": factor}
        assert unit in finding.what
        assert in_other_units(1.004 * factor, 0.001 * factor, *streams) is None

    @pytest.mark.parametrize("unit", UNITS)
    def test_a_ratio_alone_never_changes_the_parent(self, unit):
        factor = UNITS[unit]
        streams = moving_at(2.0), moving_at(2.0 * factor)
        finding = in_other_units(1.002 / factor, 0.001 / factor, *streams)
        if unit == "millimetres":
            assert finding is None  # a child at 2 mm/s is not in metres
        else:
            assert finding.code == "unit_or_scale"
            assert "parent_scale" not in finding.options
            assert f"parent_scale {factor:g}" in finding.advice

    @pytest.mark.parametrize(
        ("off", "is_exact"),
        [(1.002, 1.0), (1.004, 1.0), (1.006, 0.0), (0.96, 0.0)],
    )
    def test_a_ratio_near_a_unit_is_a_question(self, off, is_exact):
        streams = moving_at(2.0), moving_at(0.6)
        finding = in_other_units(off / 0.3048, 0.001 / 0.3048, *streams)
        assert (finding.code, finding.evidence["is_exact"]) == (
            "unit_or_scale",
            is_exact,
        )

    @pytest.mark.parametrize("unit", ["millimetres", "centimetres"])
    def test_a_parent_faster_than_sound_in_metres_is_in_that_unit(self, unit):
        factor = UNITS[unit]
        finding = in_other_units(
            1.0 / factor,
            0.001 / factor,
            moving_at(8.0 / factor),
            moving_at(8.0),
        )
        assert (finding.code, finding.stream) == ("units", "parent")
        assert finding.options == {"parent_scale": factor}

    @pytest.mark.parametrize(
        "scale", [1.05, 3.09, 3.48, 2.0, 10.0, 0.1, 0.28, 0.32]
    )
    def test_a_scale_near_no_unit_is_a_scale(self, scale):
        assert (
            in_other_units(scale, 0.005, moving_at(1.0), moving_at(1.0 / scale))
            is None
        )

    def test_speeds_of_sensors(self):
        speeds = [0.004, 0.05, 30.0, 500.0]
        assert [is_too_slow(moving_at(speed)) for speed in speeds] == [
            True,
            False,
            False,
            False,
        ]
        assert [is_too_fast(moving_at(speed)) for speed in speeds] == [
            False,
            False,
            False,
            True,
        ]


class TestResult:
    @pytest.mark.parametrize("unit", UNITS)
    def test_a_child_in_another_unit_is_repaired(self, hand, expected, unit):
        parent, child = hand
        result = hec.calibrate(
            parent, child.scaled(1.0 / UNITS[unit]), reference="B5"
        )
        assert result.scale == UNITS[unit]
        assert_allclose(result.T_parent_child, expected, atol=0.01)
        assert result.findings == ()

    def test_a_parent_in_millimetres_is_repaired_with_care(
        self, hand, expected
    ):
        parent, child = hand
        result = hec.calibrate(parent.scaled(1000.0), child, reference="B5")
        assert_allclose(result.T_parent_child, expected, atol=0.01)
        assert result.verdict is hec.Verdict.USE_WITH_CARE
        assert ("units", "parent") in {
            (finding.code, finding.stream) for finding in result.findings
        }

    def test_a_parent_in_feet_is_asked_about(self, hand, expected):
        parent, child = hand
        parent = parent.scaled(1.0 / 0.3048)
        result = hec.calibrate(parent, child, reference="B5")
        assert result.verdict is hec.Verdict.DO_NOT_USE
        (finding,) = (
            finding for finding in result.findings if finding.makes_unusable
        )
        assert finding.code == "unit_or_scale"
        assert result.scale == pytest.approx(3.2808, abs=0.01)
        answered = hec.calibrate(
            parent, child, reference="B5", parent_scale=0.3048
        )
        assert_allclose(answered.T_parent_child, expected, atol=0.01)
        assert not any(finding.makes_unusable for finding in answered.findings)
        assert (
            "all lengths of the result are then 3.281 times as long"
            in answered.warnings[0]
        )
        scaled = hec.calibrate(parent, child, reference="B5", scale="estimate")
        assert not any(finding.makes_unusable for finding in scaled.findings)

    @pytest.mark.parametrize("scale", [3.24, 3.32, 39.0, 98.0, 1030.0])
    def test_a_camera_without_a_unit_leaves_the_parent_in_metres(
        self, hand, expected, scale
    ):
        parent, child = hand
        result = hec.calibrate(
            parent, child.scaled(1.0 / scale), reference="B5"
        )
        assert result.scale == pytest.approx(scale, rel=0.005)
        assert_allclose(result.T_parent_child, expected, atol=0.02)
        assert not any(finding.makes_unusable for finding in result.findings)
        codes = set(codes_of(result.findings))
        assert codes == (set() if scale == 1030.0 else {"unit_or_scale"})

    @pytest.mark.parametrize("name", ["car_ins_lidar", "arm_target"])
    @pytest.mark.parametrize("unit", ["millimetres", "feet"])
    def test_no_platform_is_wrong_without_a_word(self, name, unit):
        drive = make(name, 31)
        result = hec.calibrate(
            drive.parent.scaled(1.0 / UNITS[unit]), drive.child
        )
        error_m = np.abs(
            deviation(result.T_parent_child, drive.T_parent_child)
        )[:3].max()
        assert error_m < 0.2 or result.verdict is hec.Verdict.DO_NOT_USE


def test_positions_are_asked_about_as_poses_are():
    drive = simulate_drive(5, HILLY_DRIVE, NoiseConfig(gaussian=0.001))
    antenna = Trajectory.from_positions(
        drive.child.stamps_ns, drive.child.poses[:, :3, 3]
    )
    feet = hec.calibrate(drive.parent.scaled(1.0 / 0.3048), antenna)
    assert feet.verdict is hec.Verdict.DO_NOT_USE
    # Nothing that drives changes its velocity so fast.
    centimetres = hec.calibrate(drive.parent.scaled(100.0), antenna)
    expected = drive.T_parent_child[:3, 3]
    assert_allclose(centimetres.T_parent_child[:3, 3], expected, atol=0.02)
    assert centimetres.verdict is hec.Verdict.USE_WITH_CARE


class TestNoisyChild:
    """Noise of the child beside short motion looks like a scale below 1."""

    @staticmethod
    def recorded(noise_m, noise_rad, scale=1.0):
        poses = wandering_poses(80, seed=6).copy()
        poses[:, :3, 3] *= 0.07
        child = disturbed(child_of(poses), 7, noise_m, noise_rad)
        return as_trajectory(poses), as_trajectory(child).scaled(1.0 / scale)

    def fit(self, *streams):
        return estimate_scale(whole_snapshot(*streams, {}).pose_pairs)

    def test_the_child_has_no_unit_of_its_own(self):
        fit = self.fit(*self.recorded(0.01, 0.02))
        assert 1.0 - fit.scale > 5.0 * fit.scale_sigma
        assert not fit.has_own_unit

    def test_a_true_scale_of_that_size_is_found(self):
        fit = self.fit(*self.recorded(0.0005, 0.001, scale=0.914))
        assert fit.scale == pytest.approx(0.914, abs=0.005)
        assert fit.has_own_unit

    def test_the_lengths_of_the_child_are_kept(self):
        result = hec.calibrate(*self.recorded(0.01, 0.02), method="dnlo")
        assert result.scale == 1.0


@pytest.mark.parametrize(
    ("kind", "name", "seed"),
    [
        (classes, "arm_target", 2002),
        (classes, "arm_target", 7003),
        (mixed, "mixed_arm", 2002),
    ],
    ids=["target", "small bias", "mixed"],
)
def test_a_parent_in_feet_is_asked_about_where_noise_shrinks_the_scale(
    kind, name, seed
):
    drive = kind.make(name, seed)
    result = hec.calibrate(drive.parent.scaled(1.0 / 0.3048), drive.child)
    assert result.verdict is hec.Verdict.DO_NOT_USE
    assert "unit_or_scale" in {
        finding.code for finding in result.findings if finding.makes_unusable
    }


PLATFORMS = (
    "hand_vio_walk",
    "car_ins_lidar",
    "agv_ramps",
    "drone_gnss_vio",
    "arm_target",
)


@pytest.mark.parametrize("measures", ["poses", "positions"])
@pytest.mark.parametrize(
    ("unit", "factor"), [("millimetres", 1e-3), ("centimetres", 1e-2)]
)
@pytest.mark.parametrize("platform", PLATFORMS)
def test_both_streams_in_a_small_unit_are_named_first(
    platform, unit, factor, measures
):
    drive = make(platform, 1701)
    parent = drive.parent.scaled(1.0 / factor)
    child = drive.child.scaled(1.0 / factor)
    result = hec.calibrate(parent, child, child_measures=measures)
    assert result.verdict is hec.Verdict.DO_NOT_USE
    first = result.findings[0]
    assert (first.code, first.stream) == ("lengths", "both")
    assert unit in first.what
    right = hec.calibrate(
        parent,
        child,
        child_measures=measures,
        parent_scale=factor,
        scale=factor,
    )
    assert "lengths" not in codes_of(right.findings)


class TestSmallUnit:
    """``check_lengths`` of streams that agree in one unit."""

    @pytest.mark.parametrize(
        ("lever_arm_m", "codes"), [(2.9, []), (3.0, ["lengths"])]
    )
    def test_a_large_machine_changes_its_velocity_slowly(
        self, lever_arm_m, codes
    ):
        poses = wandering_poses(1200, step_m=0.6)
        arm = as_trajectory(poses)
        lengths = check_lengths(arm, arm, lever_arm_m)
        assert codes_of(lengths) == codes

    def test_a_child_in_metres_is_not_asked_about(self, hand):
        parent, child = hand
        (finding,) = check_lengths(parent.scaled(1000.0), child)
        assert (finding.stream, [*finding.options]) == (
            "parent",
            ["parent_scale"],
        )

    @pytest.mark.parametrize(
        ("n_poses", "step_m"), [(360, 0.1), (360, 0.17), (180, 0.17)]
    )
    def test_noisy_poses_in_millimetres_are_not_taken_for_inverse(
        self, n_poses, step_m
    ):
        poses = wandering_poses(n_poses, step_m=step_m)
        X = se3.exp(np.array([0.1, -0.05, 0.03, -1.5, 0.1, -1.6]))
        parent = as_trajectory(disturbed(poses, 10, 0.01, 0.002)).scaled(1000.0)
        child = as_trajectory(disturbed(poses @ X, 1, 0.01, 0.002)).scaled(
            1000.0
        )
        result = hec.calibrate(parent, child)
        codes = [
            finding.code
            for finding in result.findings
            if finding.makes_unusable
        ]
        assert codes == ["lengths"]


@pytest.mark.parametrize(
    ("key", "is_contradiction"),
    [("scale", True), ("units", False), ("time_offset", False)],
)
def test_a_scale_beside_an_estimated_scale_is_a_contradiction(
    key, is_contradiction
):
    values = {"scale": 1.0765, "sigma": 0.011}
    found = finding(key, "child", options={"scale": 1.077}, **values)
    beside = beside_solved_scale(found, 1.0103, 0.0057)
    assert (beside != found) is is_contradiction
    if is_contradiction:
        assert (beside.code, beside.options) == ("scale", {})
        assert beside.severity is found.severity
        assert "1.0765 +/- 0.011, the solution by 1.0103 +/- 0.0057" in (
            beside.what
        )
        assert beside.advice.startswith("use a longer part")


def test_an_estimate_that_the_check_contradicts_proposes_a_longer_part(
    hand, monkeypatch
):
    """The check computes another scale than the solve of the same streams."""
    wrong = finding(
        "scale", "child", options={"scale": 1.08}, scale=1.08, sigma=0.01
    )
    monkeypatch.setattr(
        poses.checking,
        "check_streams",
        lambda *_, **__: CheckResult((wrong,)),
    )
    for option, key in (("none", "scale"), ("estimate", "scale_contradicted")):
        snapshot = whole_snapshot(*hand, {"scale": option})
        checked = poses.check(snapshot, snapshot.estimate(cross_check=False))
        assert key in [found.key for found in checked.findings]
