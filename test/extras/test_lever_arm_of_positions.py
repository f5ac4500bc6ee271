"""Streams of positions alone: GNSS antennas and prisms beside the poses of another sensor."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from findings import codes_of
from motions import geodetic, planar_poses, walked, wandering_poses

import hand_eye_calib as hec
from hand_eye_calib.core.assessment.common_mode import usual_speed
from hand_eye_calib.core.engine.attempts import check
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.document import usable_numbers
from hand_eye_calib.extras.partial import positions
from hand_eye_calib.extras.partial.position_tuning import TUNING
from hand_eye_calib.offline.cli.main import main
from reproduction.partial import simulated_positions

LEVER_ARM = np.array([0.8, -0.5, 1.2])
START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
WORLD = se3.exp(np.array([50.0, -20.0, 3.0, 0.1, -0.2, 2.0]))


def antenna_of(poses, noise_m, seed=5):
    """Positions of the antenna in another world."""
    positions = (WORLD @ poses)[:, :3, :3] @ LEVER_ARM + (WORLD @ poses)[
        :, :3, 3
    ]
    return positions + noise_m * np.random.default_rng(seed).standard_normal(
        positions.shape
    )


def recorded(n_poses=300, noise_m=0.005, drift_rad=2e-4, seed=2, poses=None):
    """Odometry that drifts, and positions beside it."""
    poses = wandering_poses(n_poses, seed) if poses is None else poses
    random = np.random.default_rng(seed)
    drift = np.c_[
        np.zeros((len(poses), 3)),
        drift_rad * random.normal(size=(len(poses), 3)),
    ]
    motions = se3.inverse(poses[:-1]) @ poses[1:] @ se3.exp(drift[1:])
    stamps_ns = START_NS + STEP_NS * np.arange(len(poses))
    child = Trajectory.from_positions(
        stamps_ns, antenna_of(poses, noise_m), "antenna", "map"
    )
    return Trajectory(stamps_ns, walked(motions), "lidar", "odom"), child


@pytest.fixture(scope="module")
def streams():
    return recorded()


@pytest.fixture(scope="module")
def result(streams):
    return hec.calibrate(*streams)


def distances(result):
    """Errors over their standard deviations."""
    return (result.T_parent_child[:3, 3] - LEVER_ARM) / result.sigmas_measured[
        :3
    ]


class TestLeverArm:
    def test_it_is_found_within_its_sigma(self, result):
        assert result.T_parent_child[:3, 3] == pytest.approx(
            LEVER_ARM, abs=0.01
        )
        assert np.abs(distances(result)).max() < 4.0
        assert result.sigmas_measured[:3].max() < 0.005
        assert abs(result.time_offset_s) < 0.005

    def test_the_rotation_is_out_of_reach_and_no_number(self, result):
        assert result.measured == "positions"
        assert result.out_of_reach == ("roll", "pitch", "yaw")
        assert result.T_parent_child[:3, :3].tolist() == np.eye(3).tolist()
        assert np.isinf(result.sigmas_measured[3:]).all()
        assert result.covariance[3, 3] > 1.0
        assert usable_numbers(result)["yaw"] == "MEASURE_YAW_BY_HAND"
        assert result.status is hec.SolveStatus.OK

    def test_positions_of_the_parent_give_the_opposite(self, streams, result):
        inverse = hec.calibrate(*streams[::-1], checks=False)
        assert inverse.T_parent_child[:3, 3] == pytest.approx(
            -result.T_parent_child[:3, 3]
        )
        assert inverse.time_offset_s == pytest.approx(-result.time_offset_s)

    def test_poses_declared_as_positions_give_the_same(self, streams, result):
        parent, child = streams
        turned = child.poses @ se3.exp(np.r_[0, 0, 0, 0.5, 1.0, -0.3])
        whole = Trajectory(child.stamps_ns, turned, "antenna")
        declared = hec.calibrate(
            parent, whole, child_measures="positions", checks=False
        )
        assert declared.T_parent_child[:3, 3] == pytest.approx(
            result.T_parent_child[:3, 3], abs=1e-9
        )

    def test_imprecise_positions_at_the_start_do_not_exclude_precise_ones(self):
        """As of a GNSS receiver before its ambiguities are fixed."""
        parent, child = recorded(n_poses=600, seed=642)
        n_imprecise = 80
        errors_m = np.random.default_rng(642).normal(
            [4.0, -3.0, 2.0], 0.8, size=(n_imprecise, 3)
        )
        measured = child.poses[:, :3, 3].copy()
        measured[:n_imprecise] += errors_m

        solution = positions.solve(parent.stamps_ns, parent.poses, measured)

        assert solution.imprecise[:n_imprecise].all()
        assert solution.imprecise.sum() < n_imprecise + 15
        assert solution.lever_arm == pytest.approx(LEVER_ARM, abs=0.003)

    def test_another_clock_is_found_from_the_speeds(self):
        parent, child = recorded(
            poses=wandering_poses(400, seed=4, step_rad=0.02)
        )
        shifted = hec.calibrate(parent, child.shifted(-7.31))
        assert 'solved with time_offset="estimate"' in shifted.warnings[0]
        assert shifted.time_offset_s == pytest.approx(7.31, abs=0.01)
        assert np.abs(distances(shifted)).max() < 4.0

    def test_a_drone_whose_positions_are_smoothed_knows_its_height_no_better(
        self,
    ):
        """It tilts to accelerate, so that 5 mm per m/s^2 look like 49 mm of height."""
        times_s = STEP_NS * 1e-9 * np.arange(1200)
        random = np.random.default_rng(3)
        away_rad = 0.6 * times_s[:, None] * [1.0, 1.37, 0.0]
        path = 4.0 * np.sin(away_rad) * [1.0, 1.0, 0.0]
        pulls = -np.square([0.6, 0.6 * 1.37, 0.0]) * path
        tilt = (
            np.stack(
                [-pulls[:, 1], pulls[:, 0], 3.0 * np.sin(0.1 * times_s)], axis=1
            )
            / 9.81
        )
        truth = se3.from_rotation_translation(se3.rotation_exp(tilt), path)
        stamps_ns = START_NS + STEP_NS * np.arange(len(truth))
        antenna = antenna_of(truth, 0.0)
        bent = np.gradient(np.gradient(antenna, 0.1, axis=0), 0.1, axis=0)
        positions = (
            antenna
            + 0.005 * bent
            + 0.003 * random.standard_normal(antenna.shape)
        )
        noise = 0.001 * random.standard_normal((len(truth), 6))
        smoothed = hec.calibrate(
            Trajectory(stamps_ns, truth @ se3.exp(noise), "lidar"),
            Trajectory.from_positions(stamps_ns, positions, "antenna"),
            checks=False,
        )
        assert abs(smoothed.T_parent_child[2, 3] - LEVER_ARM[2]) > 0.02
        assert np.abs(distances(smoothed)).max() < 3.0
        assert any(
            "acceleration shifts the positions" in text
            for text in smoothed.noise.in_words
        )

    def test_the_expected_scale_of_a_tuning_is_taken_out_of_a_finding(
        self, monkeypatch
    ):
        sigmas = list(TUNING.of_positions)
        sigmas[3] = 0.0015
        tuning = replace(TUNING, of_positions=tuple(sigmas))
        solve = functools.partial(positions.solve, tuning=tuning)
        monkeypatch.setattr(positions, "solve", solve)
        parent, child = recorded()
        result = hec.calibrate(parent, child.scaled(1 / 1.02), checks=False)
        (scale,) = (
            finding for finding in result.findings if finding.code == "scale"
        )
        assert scale.evidence["scale"] == pytest.approx(1.02, abs=0.001)

    def test_a_scale_is_within_its_sigma_whatever_the_worlds(self):
        parent, child = recorded(drift_rad=1e-3, noise_m=0.02, seed=1)
        small = Trajectory(
            parent.stamps_ns, parent.scaled(0.97).poses, "camera"
        )
        result = hec.calibrate(
            small, child, scale="estimate", target_axes="z=5cm"
        )
        assert result.target_axes == {"z": 0.05}
        assert abs(result.scale - 0.97) < 4.0 * result.scale_sigma < 0.01
        assert result.T_parent_child[:3, 3] == pytest.approx(
            0.97 * LEVER_ARM, abs=0.02
        )

    def test_a_drift_with_the_path_is_within_sigma(self):
        parent, child, lever_arm = simulated_positions("car", seed=3)
        result = hec.calibrate(parent, child, checks=False)
        assert (
            np.abs(
                (result.T_parent_child[:3, 3] - lever_arm)
                / result.sigmas_measured[:3]
            ).max()
            < 4.0
        )

    def test_positions_that_are_worse_for_a_time_are_as_if_they_were_missing(
        self, streams
    ):
        parent, child = streams
        positions = child.poses[:, :3, 3].copy()
        positions[120:180] += np.cumsum(
            np.random.default_rng(3).normal(0.0, 0.2, (60, 3)), axis=0
        )
        mixed = Trajectory.from_positions(child.stamps_ns, positions, "antenna")
        result = hec.calibrate(parent, mixed, checks=False)
        good = np.r_[0:115, 185:300]
        apart = Trajectory.from_positions(
            child.stamps_ns[good], positions[good], "antenna"
        )
        apart = hec.calibrate(parent, apart, checks=False)
        left_out = next(
            sentence
            for sentence in result.noise.in_words
            if "far less precise" in sentence
        )
        assert 20 < int(left_out.partition("%")[0]) < 30
        difference = result.T_parent_child[:3, 3] - apart.T_parent_child[:3, 3]
        assert np.abs(difference / apart.sigmas_measured[:3]).max() < 0.5

    def test_float_solutions_outages_and_a_jump_do_little(self, streams):
        parent, child = streams
        random = np.random.default_rng(1)
        positions = child.poses[:, :3, 3].copy()
        positions[100:160] += 0.3 + 0.05 * random.standard_normal((60, 3))
        positions[250:] += [0.4, -0.3, 0.2]
        kept = (np.arange(len(child)) % 50) > 8
        worse = Trajectory.from_positions(
            child.stamps_ns[kept], positions[kept], "antenna"
        )
        result = hec.calibrate(parent, worse)
        assert result.T_parent_child[:3, 3] == pytest.approx(
            LEVER_ARM, abs=0.03
        )
        assert np.abs(distances(result)).max() < 4.0

    @pytest.mark.parametrize("tilt_rad", [0.0, 0.004])
    def test_on_flat_ground_height_is_unobservable_whatever_the_noise(
        self, tilt_rad
    ):
        parent, child = recorded(drift_rad=0.0, poses=planar_poses(400, seed=3))
        tilt = tilt_rad * np.random.default_rng(0).normal(size=(400, 3))
        noisy = parent.poses @ se3.exp(np.c_[np.zeros((400, 3)), tilt])
        parent = Trajectory(parent.stamps_ns, noisy, "lidar")
        result = hec.calibrate(parent, child)
        assert result.unobservable() == ["z", "roll", "pitch", "yaw"]
        assert result.status is hec.SolveStatus.UNOBSERVABLE
        assert (
            "z cannot be determined from this motion"
            in result.reasons[0].sentence
        )
        assert np.abs(distances(result)[:2]).max() < 4.0
        with_prior = hec.calibrate(
            parent, child, prior={"z": (1.2, 0.01)}, checks=False
        )
        assert with_prior.status is hec.SolveStatus.OK
        assert (
            "z of the child sensor: mostly from the prior, not the motion"
            in with_prior.warnings
        )

    @pytest.mark.parametrize(
        ("kind", "travel_s"), [("odometry", 0.005), ("exact", 0.0)]
    )
    def test_the_allowance_grows_with_the_speed_of_an_odometry(
        self, kind, travel_s
    ):
        parent, child, _ = simulated_positions("car", seed=4)
        result = hec.calibrate(parent, child, parent_kind=kind, checks=False)
        speed_m_s = usual_speed(parent.stamps_ns, parent.poses[:, :3, 3])
        assert speed_m_s > 5.0
        expected_m = np.sqrt(2.0 * 0.005**2 + (travel_s * speed_m_s) ** 2)
        assert result.allowance[:3] == pytest.approx(expected_m, rel=0.1)

    def test_positions_of_another_body_are_not_to_be_used(self, streams):
        result = hec.calibrate(streams[0], recorded(seed=8)[1])
        assert result.verdict is hec.Verdict.DO_NOT_USE

    def test_positions_in_millimetres_are_named_and_mended(self, streams):
        parent, child = streams
        result = hec.calibrate(parent, child.scaled(1000.0))
        assert "millimetres" in result.warnings[0]
        assert result.T_parent_child[:3, 3] == pytest.approx(
            LEVER_ARM, abs=0.01
        )
        assert result.verdict is not hec.Verdict.DO_NOT_USE

    def test_longitudes_without_the_cosine_of_the_latitude_are_not_used_in_silence(
        self,
    ):
        odometry, antenna = recorded()
        for factor, severity in ((1.4, "warning"), (2.0, "error")):
            positions = antenna.poses[:, :3, 3] * [factor, 1.0, 1.0]
            wide = Trajectory.from_positions(antenna.stamps_ns, positions)
            result = hec.calibrate(odometry, wide)
            assert ("unrelated", severity) in [
                (finding.code, finding.severity.value)
                for finding in result.findings
            ]
            assert result.verdict is hec.Verdict.DO_NOT_USE

    def test_the_check_says_the_same(self):
        parent, child = recorded(n_poses=320)

        def codes(parent, child):
            snapshot = whole_snapshot(parent, child, {})
            return codes_of(check(snapshot, snapshot.estimate()).findings)

        assert codes(parent, child.scaled(1000.0)) == ["units"]
        assert codes(parent, recorded(n_poses=320, seed=8)[1]) == ["unrelated"]
        two = (
            child.poses[:, :3, 3]
            + [0.5, 0.0, 0.0] * (np.arange(320) % 2)[:, None]
        )
        both = Trajectory.from_positions(child.stamps_ns, two)
        assert codes(parent, both) == ["interleaved", "unrelated"]
        north_east = Trajectory.from_positions(
            child.stamps_ns, child.poses[:, [1, 0, 2], 3]
        )
        assert codes(parent, north_east) == ["left_handed", "unrelated"]
        from_pole_to_pole = [0.0, 0.0, 6.4e6] * (-1.0) ** np.arange(320)[
            :, None
        ]
        poles = Trajectory.from_positions(child.stamps_ns, from_pole_to_pole)
        assert "unrelated" in codes(parent, poles)
        kept = np.r_[0:30, 60:80]
        fixes = Trajectory.from_positions(
            child.stamps_ns[kept], child.poses[kept, :3, 3]
        )
        assert "gaps" in codes(parent, fixes)
        flat = recorded(drift_rad=0.0, poses=planar_poses(200, seed=3))
        assert codes(*flat) == ["unchecked", "one_axis"]


def test_the_command_with_latitude_and_longitude(
    streams, result, tmp_path, capsys
):
    parent, child = streams
    lat, lon, height = geodetic(child.poses[:, :3, 3], (60.0, 25.0, 40.0))
    places = zip(child.stamps_ns.tolist(), lat, lon, height, strict=True)
    rows = [f"{stamp},{a:.11f},{b:.11f},{c:.5f}" for stamp, a, b, c in places]
    hec.write_trajectory(tmp_path / "lidar.tum", parent)
    (tmp_path / "gnss.csv").write_text(
        "\n".join(["t_ns,latitude,longitude,altitude", *rows])
    )
    code = main(
        ["calibrate", str(tmp_path / "lidar.tum"), str(tmp_path / "gnss.csv")]
    )
    printed = capsys.readouterr()
    assert code == 0
    assert "roll, pitch and yaw are not estimated" in printed.out
    assert "became metres east and north" in printed.err
