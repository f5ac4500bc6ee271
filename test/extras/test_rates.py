"""Streams without positions: rotations, and the angular rates of a gyroscope."""

import dataclasses
import json

import numpy as np
import pytest
from bag_making import JAZZY, fix, imu
from motions import (
    T_PARENT_CHILD,
    child_of,
    planar_poses,
    read_trajectory_file,
    wandering_poses,
)
from numpy.testing import assert_array_equal
from rosbags.rosbag2 import Writer

import hand_eye_calib as hec
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.engine.attempts import check
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.rates import RateIntegrator
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.document import usable_numbers
from hand_eye_calib.extras.partial.rotation_checks import measured_stream
from hand_eye_calib.formats.bags.unpacking import MessageReader, unpack_poses
from hand_eye_calib.formats.bags.writer import write_bag
from hand_eye_calib.offline.cli.main import main

BIAS = np.array([0.02, -0.01, 0.03])
OFFSET_S = 0.02
STEP_NS = 50_000_000
START_NS = 1_700_000_000_000_000_000


def smooth_streams(n_poses=600, noise_rad=2e-4, seed=1):
    """Poses of the parent every 50 ms, and rates of the child five times as often, late and with a
    bias."""
    random = np.random.default_rng(seed)
    stamps_ns = START_NS + STEP_NS * np.arange(n_poses)
    parent_poses = wandering_poses(n_poses, seed)
    child = Trajectory(stamps_ns, child_of(parent_poses))

    n_fine = 5 * (n_poses - 1)
    fine_step_ns = STEP_NS // 5
    fine_ns = START_NS + fine_step_ns * np.arange(n_fine)
    rotations = child.at(fine_ns)[:, :3, :3]
    back = np.swapaxes(rotations[:-1], 1, 2)
    turns = se3.rotation_log(back @ rotations[1:])
    rates = turns / (STEP_NS / 5 * 1e-9) + BIAS
    offset_ns = round(OFFSET_S * 1e9)
    middle_ns = fine_ns[:-1] + STEP_NS // 10 - offset_ns

    no_shift = np.zeros((n_poses, 3))
    turn_noise = noise_rad * random.normal(size=(n_poses, 3))
    noise = se3.exp(np.c_[no_shift, turn_noise])
    parent = Trajectory(stamps_ns, parent_poses @ noise, "lidar")
    return parent, middle_ns, rates


@pytest.fixture(scope="module")
def streams():
    parent, stamps_ns, rates = smooth_streams()
    return parent, Trajectory.from_rates(stamps_ns, rates, "imu")


@pytest.fixture(scope="module")
def result(streams):
    return hec.calibrate(*streams)


def angle_to(rotation, result):
    estimated = result.T_parent_child[:3, :3]
    difference = rotation.T @ estimated
    return float(se3.rotation_angle(difference))


class TestRates:
    def test_rotation_bias_and_offset_are_found(self, result):
        assert angle_to(T_PARENT_CHILD[:3, :3], result) < np.radians(0.1)
        assert result.rate_bias.of == "child"
        assert result.rate_bias.rad_per_s == pytest.approx(BIAS, abs=1e-3)
        assert result.time_offset_s == pytest.approx(OFFSET_S, abs=1e-3)
        assert 0 < result.time_offset_sigma_s < 1e-3
        assert result.allowance[3:] == pytest.approx(np.radians(0.15))

    def test_the_translation_is_out_of_reach_and_no_number(self, result):
        assert result.measured == "rotations"
        assert result.out_of_reach == ("x", "y", "z")
        assert np.isinf(result.sigmas_measured[:3]).all()
        assert result.covariance_measured[0, 0] > 1.0
        assert usable_numbers(result)["x"] == "MEASURE_X_BY_HAND"
        assert result.reasons == ()
        assert "out of reach" in result.headline

    def test_the_other_way_round_it_is_the_inverse(self, streams, result):
        parent, child = streams
        inverse = hec.calibrate(child, parent, checks=False)
        assert result.cross_check["yaw"].of_methods > 0.0
        assert not inverse.cross_check
        product = inverse.T_parent_child[:3, :3] @ result.T_parent_child[:3, :3]
        assert float(se3.rotation_angle(product)) < np.radians(0.05)
        assert inverse.rate_bias.of == "parent"
        assert inverse.rate_bias.rad_per_s == pytest.approx(BIAS, abs=1e-3)
        assert inverse.time_offset_s == pytest.approx(-OFFSET_S, abs=1e-3)

    def test_a_prior_gives_the_translation(self, streams):
        prior = {
            axis: (value, 0.01)
            for axis, value in zip("xyz", (0.4, -0.2, 0.7), strict=True)
        }
        with_prior = hec.calibrate(*streams, prior=prior, checks=False)
        assert with_prior.out_of_reach == ()
        assert with_prior.T_parent_child[:3, 3] == pytest.approx(
            [0.4, -0.2, 0.7], abs=1e-3
        )

    def test_rotations_alone_need_no_bias(self, streams):
        parent, _ = streams
        child = Trajectory(
            parent.stamps_ns, child_of(parent.poses), measures="rotations"
        )
        result = hec.calibrate(parent, child, checks=False)
        assert result.rate_bias is None
        assert angle_to(T_PARENT_CHILD[:3, :3], result) < np.radians(0.1)

    def test_about_a_single_axis_the_angle_around_it_is_unobservable(
        self, streams
    ):
        poses = planar_poses(400, seed=2)
        stamps_ns = START_NS + STEP_NS * np.arange(400)
        noise = 1e-3 * np.random.default_rng(0).normal(size=(2, 400, 6))
        parent, child = (
            Trajectory(stamps_ns, Ts @ se3.exp(errors), measures="rotations")
            for Ts, errors in zip((poses, child_of(poses)), noise, strict=True)
        )
        result = hec.calibrate(parent, child)
        assert result.unobservable() == ["x", "y", "z", "yaw"]
        assert result.status is hec.SolveStatus.UNOBSERVABLE
        assert (
            "the rotation about z cannot be determined"
            in result.reasons[0].sentence
        )

    def test_a_sensor_that_stands_still_is_not_to_be_used(self, streams):
        parent, _ = streams
        _, stamps_ns, rates = smooth_streams()
        result = hec.calibrate(
            parent, Trajectory.from_rates(stamps_ns, 0.0 * rates)
        )
        assert result.verdict is hec.Verdict.DO_NOT_USE

    @pytest.mark.parametrize(
        "options",
        [
            {"method": "dnlo"},
            {"reference": "B5"},
            {"backend": "ipopt"},
            {"scale": "estimate"},
        ],
    )
    def test_options_that_mean_nothing_here_are_refused(self, streams, options):
        with pytest.raises(ConfigError, match="needs poses of both sensors"):
            hec.calibrate(*streams, **options)

    def test_positions_and_rates_show_nothing_together(self, streams):
        parent, child = streams
        with pytest.raises(ConfigError, match="beside poses"):
            hec.calibrate(
                Trajectory.from_positions(
                    parent.stamps_ns, parent.poses[:, :3, 3]
                ),
                child,
            )


class TestIntegration:
    def test_parts_give_the_same_as_the_whole(self):
        _, stamps_ns, rates = smooth_streams(n_poses=50)
        whole = RateIntegrator().rotations(stamps_ns, rates)
        integrator = RateIntegrator()
        parts = [
            integrator.rotations(stamps_ns[chunk], rates[chunk])
            for chunk in (slice(0, 1), slice(1, 90), slice(90, None))
        ]
        assert np.abs(np.concatenate(parts) - whole).max() < 1e-12

    def test_a_rate_that_is_not_finite_is_refused(self):
        stamps_ns = np.arange(2)
        rates = [[0, 0, 0], [np.nan, 0, 0]]
        with pytest.raises(InputError, match="rate 1"):
            Trajectory.from_rates(stamps_ns, rates)


class TestFiles:
    @pytest.mark.parametrize(
        ("text", "largest"),
        [
            (
                "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1]",
                1,
            ),
            ("t,gyro_x_dps,gyro_y_dps,gyro_z_dps", np.pi / 180),
            ("t wx wy wz", 1),
        ],
    )
    def test_columns_of_rates(self, tmp_path, text, largest):
        separator = "," if "," in text else " "
        rows = [
            separator.join(map(str, (1_700_000_000 + k, 0.0, 0.0, 1.0)))
            for k in range(3)
        ]
        path = tmp_path / "imu.csv"
        path.write_text("\n".join([text, *rows]))
        trajectory = read_trajectory_file(
            path, "auto", stamp_unit="s"
        ).trajectory
        assert trajectory.measures == "rates"
        assert np.abs(
            se3.rotation_log(trajectory.poses[1, :3, :3])
        ).max() == pytest.approx(largest)

    def test_large_rates_without_a_unit_are_degrees_and_that_is_said(
        self, tmp_path
    ):
        path = tmp_path / "imu.csv"
        path.write_text("t,wx,wy,wz\n1,90,0,0\n2,90,0,0\n")
        reading = read_trajectory_file(path, "auto")
        assert se3.rotation_log(reading.trajectory.poses[1, :3, :3])[
            0
        ] == pytest.approx(np.pi / 2)
        assert any("deg/s" in text for text in reading.guesses)

    def test_four_columns_without_names_need_to_be_told(self, tmp_path):
        path = tmp_path / "data.txt"
        path.write_text("1 0 0 1\n2 0 0 1\n")
        with pytest.raises(
            InputError, match="name the 4 columns with `columns`"
        ):
            read_trajectory_file(path, "auto")
        for columns, measures in (
            ("t,wx,wy,wz", "rates"),
            ("t,x,y,z", "positions"),
        ):
            trajectory = read_trajectory_file(
                path, "auto", columns=columns
            ).trajectory
            assert trajectory.measures == measures

    def test_the_command(self, streams, tmp_path, capsys):
        parent, stamps_ns, rates = smooth_streams()
        hec.write_trajectory(tmp_path / "lidar.tum", parent)
        rows = [
            f"{stamp},{x:.9f},{y:.9f},{z:.9f}"
            for stamp, (x, y, z) in zip(stamps_ns.tolist(), rates, strict=True)
        ]
        (tmp_path / "imu.csv").write_text("\n".join(["t_ns,wx,wy,wz", *rows]))
        files = [str(tmp_path / name) for name in ("lidar.tum", "imu.csv")]
        assert main(["calibrate", *files]) == 0
        assert "x, y and z are not estimated" in capsys.readouterr().out
        assert main(["check", *files]) == 0
        out = capsys.readouterr().out
        assert out.startswith("No fault found in these streams")
        assert "none" in next(
            line for line in out.splitlines() if line.startswith("child  ")
        )


class TestCheck:
    @staticmethod
    def codes(parent, child, **options):
        snapshot = whole_snapshot(parent, child, options)
        findings = check(snapshot, snapshot.estimate()).findings
        return [
            (finding.code, finding.severity.value, dict(finding.options))
            for finding in findings
        ]

    def test_an_offset_that_a_solve_finds_is_none_and_a_long_one_an_error(self):
        parent, stamps_ns, rates = smooth_streams()
        child = Trajectory.from_rates(stamps_ns, rates)
        assert self.codes(parent, child) == []
        (finding,) = self.codes(parent, child.shifted(-7.0))
        assert (finding[0], finding[1]) == ("time_offset", "error")
        assert finding[2]["time_offset"] == pytest.approx(
            7.0 + OFFSET_S, abs=1e-3
        )

    def test_rates_of_another_body_or_in_another_unit_are_unrelated(self):
        parent, stamps_ns, rates = smooth_streams(n_poses=100, seed=7)
        other = Trajectory(parent.stamps_ns, wandering_poses(100, seed=1))
        assert self.codes(other, Trajectory.from_rates(stamps_ns, rates))[0][
            :2
        ] == (
            "unrelated",
            "error",
        )
        tenfold = Trajectory.from_rates(stamps_ns, 10 * rates)
        assert self.codes(parent, tenfold)[0][:2] == ("unrelated", "error")
        too_small = Trajectory.from_rates(stamps_ns, np.radians(rates - BIAS))
        assert self.codes(parent, too_small)[0][:2] == ("rate_unit", "error")

    def test_a_long_standstill_is_not_another_body(self):
        parent, stamps_ns, rates = smooth_streams(n_poses=50)
        still_ns = 75 * STEP_NS
        rest = np.arange(START_NS - still_ns, START_NS, STEP_NS)
        random = np.random.default_rng(0)
        at_rest = parent.poses[0] @ se3.exp(
            1e-4 * random.normal(size=(len(rest), 6))
        )
        poses = np.concatenate([at_rest, parent.poses])
        fine_ns = np.arange(stamps_ns[0] - still_ns, stamps_ns[0], STEP_NS // 5)
        quiet = BIAS + 2e-4 * random.normal(size=(len(fine_ns), 3))
        streams = (
            Trajectory(np.r_[rest, parent.stamps_ns], poses, "lidar"),
            Trajectory.from_rates(
                np.r_[fine_ns, stamps_ns], np.r_[quiet, rates], "imu"
            ),
        )
        result = whole_snapshot(*streams, {}).estimate()
        assert result.findings == ()
        assert angle_to(T_PARENT_CHILD[:3, :3], result) < np.radians(2.0)

    def test_one_axis_is_a_note_and_no_rotation_an_error(self):
        stamps_ns = START_NS + STEP_NS * np.arange(600)
        turns = np.c_[
            np.zeros((600, 5)), np.cumsum(np.sin(np.arange(600) / 9.0)) / 20
        ]
        noise = 1e-4 * np.random.default_rng(1).normal(size=(2, 600, 6))
        parent, child = (
            Trajectory(stamps_ns, se3.exp(turns) @ se3.exp(errors))
            for errors in noise
        )
        child = dataclasses.replace(child, measures="rotations")
        assert self.codes(parent, child) == [
            ("one_axis", "note", {"prior.yaw": "VALUE+/-SIGMA"})
        ]
        still, also = (
            Trajectory(stamps_ns, se3.exp(errors)) for errors in noise
        )
        (finding,) = self.codes(
            still, dataclasses.replace(also, measures="rotations")
        )
        assert finding[:2] == ("unrelated", "error")

    def test_a_frozen_gyroscope_is_named(self):
        parent, stamps_ns, rates = smooth_streams()
        rates[400:700] = 0.0
        codes = self.codes(parent, Trajectory.from_rates(stamps_ns, rates))
        assert ("frozen", "error", {}) in codes


def test_a_bag_with_an_imu(tmp_path, capsys):
    parent, stamps_ns, rates = smooth_streams(n_poses=150)
    bag = tmp_path / "bag"
    write_bag(bag, {"/odom": (parent, "nav_msgs/msg/Odometry")}, "mcap")
    with Writer(tmp_path / "imu", version=9) as writer:
        connections = [
            writer.add_connection(topic, "sensor_msgs/msg/Imu", typestore=JAZZY)
            for topic in ("/imu", "/imu_again")
        ]
        for stamp_ns, rate in zip(
            stamps_ns.tolist(), rates.tolist(), strict=True
        ):
            for connection in connections:
                writer.write(connection, stamp_ns, imu(rate, stamp_ns=stamp_ns))
    parts = [str(tmp_path / name) for name in ("bag", "imu")]
    topics = ["--parent-topic", "/odom", "--child-topic", "/imu"]
    assert main(["replay", *parts, *topics, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["measured"], document["child_frame"]) == (
        "rotations",
        "imu_link",
    )
    assert document["rate_bias"]["rad_per_s"] == pytest.approx(BIAS, abs=3e-3)
    assert document["observability"][0]["sigma"] is None
    assert document["inputs"]["options"]["child_measures"] == "rates"
    assert (
        main(["replay", *parts, *topics, "--child-measures", "positions"]) == 2
    )
    assert "/imu has messages of type" in capsys.readouterr().err
    with_itself = [
        "--parent-topic",
        "/imu",
        "--child-topic",
        "/imu_again",
        "--child-frame",
        "b",
    ]
    assert main(["check", parts[1], *with_itself, "--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert [finding["code"] for finding in document["findings"]] == [
        "same_frame"
    ]
    assert document["streams"]["child"]["path_m"] is None
    gyroscope = hec.read_trajectory(parts[1], topic="/imu")
    assert (gyroscope.measures, len(gyroscope)) == ("rates", len(stamps_ns))


class TestMessages:
    def test_values_that_a_message_says_it_does_not_have_are_not_numbers(self):
        of_imu = unpack_poses(
            [imu((0.1, 0.2, 0.3))], "sensor_msgs/msg/Imu", False
        )
        assert (of_imu.stamps_ns[0], of_imu.world_frames[0]) == (
            12_000_000_005,
            "imu_link",
        )
        assert of_imu.poses.tolist() == [[0.1, 0.2, 0.3, 0.0, 0.0, 0.6, 0.8]]
        without = unpack_poses(
            [imu((0, 0, 0), -1.0)], "sensor_msgs/msg/Imu", False
        )
        assert np.isnan(without.poses[0, :3]).all()
        fixes = unpack_poses(
            [fix(2), fix(-1)], "sensor_msgs/msg/NavSatFix", False
        ).poses
        assert_array_equal(fixes, [[60.0, 25.0, 30.0], [np.nan] * 3])

    def test_without_a_fix_a_message_is_left_out(self):
        reader = MessageReader("sensor_msgs/msg/NavSatFix", "positions")
        messages = [fix(0), fix(-1), fix(2, latitude=60.001)]
        columns, is_usable = reader.columns(messages, is_ros1=False)
        assert (reader.n_left_out, is_usable.tolist()) == (
            1,
            [True, False, True],
        )
        assert np.isnan(columns.poses[1]).all()
        assert columns.poses[0, :3] == pytest.approx([0, 0, 0])
        assert columns.poses[2, 1] == pytest.approx(111.4, abs=0.3)
        assert columns.sensor_frames[0] == "imu_link"

    def test_a_place_that_is_not_on_earth_is_refused_and_named(self):
        far = (
            {"longitude": 1e300},
            r"latitude [\d.]+ and longitude 1e\+300.*swapped",
        )
        for place, message in (
            ({"latitude": 139.7}, "latitude 139.7 and longitude 25.*swapped"),
            far,
        ):
            reader = MessageReader("sensor_msgs/msg/NavSatFix", "positions")
            with pytest.raises(InputError, match=message):
                reader.columns([fix(0), fix(0, **place)], is_ros1=False)
            with pytest.raises(InputError, match=f"^found {message}"):
                reader(fix(0, **place))


@pytest.mark.parametrize(
    ("parent_measures", "child_measures", "stream"),
    [
        ("auto", "rates", "child"),
        ("rates", "auto", "parent"),
        ("poses", "rotations", "child"),
        ("rates", "rotations", "parent"),
    ],
)
def test_faults_are_those_of_the_stream_that_measures_least(
    parent_measures, child_measures, stream
):
    """The node sets only the option of a stream whose messages are no poses."""
    assert measured_stream(parent_measures, child_measures) == stream
