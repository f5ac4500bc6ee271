"""Choose by noise and shape of the motion whether both streams are inverse, or neither."""

import re
from dataclasses import replace

import numpy as np
import pytest
from faults import inverted, reordered
from findings import codes_of
from motions import as_trajectory, child_of, wandering_poses
from numpy.testing import assert_allclose
from published_data import data_folder

import hand_eye_calib as hec
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.checks import hypotheses, shape
from hand_eye_calib.core.checks.hypothesis import PLAIN, Hypothesis, Readings
from hand_eye_calib.core.checks.stream_pair import StreamPair
from hand_eye_calib.core.engine.readings import decide
from hand_eye_calib.core.engine.run import review
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import deviation
from hand_eye_calib.core.noise.readings import loss_difference
from hand_eye_calib.formats.trajectory_files.reading import read_trajectory
from reproduction.coverage import mixed
from reproduction.coverage.classes import make
from reproduction.pose_faults import faulty, largest_ratio

BOTH = {"parent_invert": "poses", "child_invert": "poses"}
NONE = {"parent_invert": "none", "child_invert": "none"}
INVERSE = Hypothesis(("inverse",), ("inverse",))


def thinned(drive):
    """Return every second pose."""
    return replace(drive, parent=drive.parent[::2], child=drive.child[::2])


@pytest.fixture(scope="module")
def hand():
    """Return the motion of a hand-held rig in a small room."""
    return thinned(make("hand_mixture_30s", 912))


@pytest.fixture(scope="module")
def arm():
    """Return a slow arm with only white noise, which is the same in both readings."""
    return thinned(mixed.make("mixed_arm", 812))


def errors(result, drive):
    """Metres and degrees."""
    error = np.abs(deviation(result.T_parent_child, drive.T_parent_child))
    return error[:3].max(), np.degrees(error[3:].max())


def loss_of_inverse(parent, child):
    upright = parent.poses, child.poses
    return loss_difference(
        parent.stamps_ns, upright, tuple(map(se3.inverse, upright))
    )


class TestNoise:
    def test_right_poses_are_likelier_and_their_inverses_are_not(self, hand):
        right = loss_of_inverse(hand.parent, hand.child)
        wrong = loss_of_inverse(inverted(hand.parent), inverted(hand.child))
        assert right > 100.0
        assert wrong == pytest.approx(-right, rel=1e-3)

    def test_a_camera_that_sees_a_target_is_as_likely_as_inverse_poses(
        self, arm
    ):
        assert abs(loss_of_inverse(arm.parent, arm.child)) < 20.0

    def test_jumps_in_one_reading_do_not_decide(self, hand):
        child = hand.child.poses.copy()
        child[225:, :3, 3] += 5.0
        jumping = replace(hand.child, poses=child)
        assert loss_of_inverse(hand.parent, jumping) > 100.0


class TestDecision:
    @pytest.mark.parametrize(
        ("difference", "shape", "paths", "is_small", "index"),
        [
            (-21.0, 0.1, 0.0, False, 1),
            (21.0, 0.1, 0.0, False, 0),
            (19.0, 0.1, 0.0, False, None),
            (-19.0, 0.5, 0.3, False, 1),
            (-19.0, -0.1, -0.1, False, 0),
            # Noise and a clear shape contradict each other: both readings are reported.
            (21.0, 1.5, 0.3, False, None),
            (-21.0, -1.5, -0.3, False, None),
            (-21.0, 1.5, 0.3, False, 1),
            # Near an arm, the noise of a camera that sees a target is that of inverse poses.
            (-19.0, 1.5, 0.3, True, None),
            (-21.0, 1.5, 0.3, True, 1),
            (-500.0, -0.1, 0.0, True, None),
            (500.0, 1.5, 0.3, True, None),
            (500.0, 0.5, -0.4, True, 0),
            (500.0, 0.1, 0.1, True, 0),
        ],
    )
    def test_the_noise_is_believed_first(
        self, difference, shape, paths, is_small, index
    ):
        readings = Readings(
            hypotheses=(PLAIN, INVERSE),
            shape=shape,
            paths=paths,
            is_small=is_small,
        )
        assert decide(readings, difference) == index

    @pytest.mark.parametrize(
        ("difference", "shape", "index"),
        [
            (731.0, 1.7, 1),
            (-489.0, -1.7, 0),
            (-69.0, -0.1, None),
            (500.0, -0.1, 0),
        ],
    )
    def test_a_clear_shape_decides_about_late_stamps(
        self, difference, shape, index
    ):
        readings = Readings(
            hypotheses=(PLAIN, INVERSE),
            shape=shape,
            paths=shape,
            is_small=False,
        )
        assert decide(readings, difference, has_late_stamps=True) == index

    def test_of_two_inverted_readings_the_shape_decides_in_a_small_space_too(
        self,
    ):
        of_child = Hypothesis((), ("inverse",))
        of_parent = Hypothesis(("inverse",), ())
        readings = Readings(
            hypotheses=(of_child, of_parent),
            shape=0.6,
            paths=0.1,
            is_small=True,
        )
        assert decide(readings, 0.0) == 1
        assert decide(replace(readings, shape=-0.6), 0.0) == 0
        assert decide(replace(readings, shape=0.3), 0.0) is None
        assert decide(replace(readings, shape=0.3, paths=0.0), 500.0) == 0
        # The noise of a camera that sees a target is that of the wrong reading.
        assert decide(replace(readings, paths=0.05), 500.0) == 1
        assert decide(replace(readings, paths=-0.4), 500.0) == 0


class TestInverse:
    @pytest.mark.parametrize("method", ["auto", "dnlo"])
    def test_both_streams_are_repaired(self, hand, method):
        result = hec.calibrate(
            inverted(hand.parent), inverted(hand.child), method=method
        )
        metres, degrees = errors(result, hand)
        assert metres < 0.05
        assert degrees < 0.5
        (text,) = (
            text for text in result.warnings if text.startswith("repaired")
        )
        assert 'parent_invert="poses", child_invert="poses"' in text
        assert result.verdict is not hec.Verdict.DO_NOT_USE

    @pytest.mark.parametrize("stream", ["parent", "child"])
    def test_one_stream_is_repaired(self, hand, stream):
        streams = {"parent": hand.parent, "child": hand.child}
        streams[stream] = inverted(streams[stream])
        result = hec.calibrate(**streams)
        metres, degrees = errors(result, hand)
        assert metres < 0.05
        assert degrees < 0.5

    def test_with_another_clock_scale_and_order_of_quaternions(self, hand):
        parent = reordered(inverted(hand.parent))
        child = reordered(inverted(hand.child)).shifted(-0.4).scaled(0.5)
        result = hec.calibrate(parent, child)
        metres, degrees = errors(result, hand)
        assert metres < 0.05
        assert degrees < 0.5
        assert result.time_offset_s == pytest.approx(0.4, abs=0.02)
        assert result.scale == pytest.approx(2.0, rel=0.02)

    def test_the_node_repairs_as_the_command_does(self, hand):
        snapshot = whole_snapshot(
            inverted(hand.parent), inverted(hand.child), {}
        )
        run = review(snapshot.estimate(), snapshot)
        assert {name: run.options[name] for name in BOTH} == BOTH
        assert errors(run.calibration, hand)[0] < 0.05


class TestUnclear:
    def test_both_answers_are_shown_and_none_is_to_be_used(self, arm):
        result = hec.calibrate(inverted(arm.parent), inverted(arm.child))
        assert result.verdict is hec.Verdict.DO_NOT_USE
        (finding,) = (
            finding for finding in result.findings if finding.makes_unusable
        )
        assert finding.code == "inverse_both"
        answers = re.findall(r"x (\S+), y (\S+), z (\S+) m", finding.what)
        places = [[float(number) for number in answer] for answer in answers]
        assert_allclose(places[0], result.T_parent_child[:3, 3], atol=0.1)
        assert_allclose(places[1], arm.T_parent_child[:3, 3], atol=0.02)
        assert abs(finding.evidence["difference"]) < 20.0

    @pytest.mark.parametrize("options", [NONE, BOTH])
    def test_an_option_decides(self, arm, options):
        result = hec.calibrate(
            inverted(arm.parent), inverted(arm.child), **options
        )
        assert not any(finding.makes_unusable for finding in result.findings)
        is_right = errors(result, arm)[0] < 0.05
        assert is_right == (options == BOTH)


class TestSimulatedMachines:
    """Streams in one world, in which the lever arm between the worlds is nearly zero."""

    @pytest.mark.parametrize(
        ("platform", "fault", "seed", "is_inverse"),
        [
            # Stamps of arrival of a swinging cab look like noise of inverse poses.
            ("excavator", "stamps of arrival, 30 ms", 339200, False),
            ("excavator", "stamps of arrival, 30 ms", 5519, True),
            ("drone", "clean", 339201, True),
        ],
    )
    def test_the_right_reading_is_used(self, platform, fault, seed, is_inverse):
        streams = faulty(platform, fault, seed)
        parent, child = streams.parent, streams.child
        if is_inverse:
            parent, child = inverted(parent), inverted(child)

        result = hec.calibrate(parent, child)

        assert largest_ratio(result, streams.T_parent_child) < 3.3
        assert result.verdict is not hec.Verdict.DO_NOT_USE
        is_late = "arrival" in codes_of(result.findings)
        assert is_late == (fault != "clean")


@pytest.mark.parametrize(
    "name", ["hand_vio_walk", "car_lever", "drone_gnss_vio", "arm_target"]
)
def test_right_streams_are_not_solved_twice(name, monkeypatch):
    drive = make(name, 71)
    monkeypatch.setattr(
        "hand_eye_calib.core.engine.readings.loss_difference",
        lambda *poses: pytest.fail("compared"),
    )
    result = hec.calibrate(drive.parent, drive.child)
    assert "inverse_both" not in codes_of(result.findings)


class TestStrangers:
    def test_a_right_arm_stays_right(self):
        folder = data_folder() / "strangers"
        parent = read_trajectory(folder / "kinhec_noise0_hand.tum")
        child = read_trajectory(folder / "kinhec_noise0_camera.tum")
        result = hec.calibrate(parent, child)
        expected = se3.from_quat_xyzw(
            (0.05422, -0.04398, 0.02275),
            (-0.082082, 0.121445, 0.972309, 0.182015),
        )
        error = np.abs(deviation(result.T_parent_child, expected))
        assert error[:3].max() < 0.001
        assert result.verdict is not hec.Verdict.DO_NOT_USE

    def test_a_flight_of_inverse_poses_is_repaired(self):
        folder = data_folder() / "strangers"
        with pytest.warns(UserWarning, match="sorted|stamps"):
            parent = read_trajectory(
                folder / "falcon5_imu_odom.csv", repair=True
            )
        child = read_trajectory(folder / "falcon5_vicon.csv", repair=True)
        result = hec.calibrate(parent, child, time_offset="estimate")
        expected = [-0.007, -0.034, -0.055]
        assert_allclose(result.T_parent_child[:3, 3], expected, atol=0.011)
        assert any(text.startswith("repaired") for text in result.warnings)


def test_the_inversions_are_options_of_the_engine():
    usual = CalibratorConfig()
    assert {name: getattr(usual, name) for name in NONE} == NONE


@pytest.mark.parametrize(
    ("mount", "worlds", "counts"),
    [
        (
            [0.2, 0.0, 0.0, 0.0, 0.0, 0.5],
            [3.0, -2.0, 1.0, 0.5, 0.2, -2.0],
            True,
        ),
        (
            [0.2, 0.0, 0.0, 0.0, 0.0, 0.05],
            [3.0, -2.0, 1.0, 0.5, 0.2, -2.0],
            False,
        ),
        ([2.0, 0.0, 0.0, 0.0, 0.0, 0.5], [0.1, 0.1, 0.0, 0.0, 0.0, 0.5], True),
        # Drift turns the world of one stream against the same world of the other.
        (
            [2.0, 0.0, 0.0, 0.0, 0.0, 0.5],
            [0.1, 0.1, 0.0, 0.0, 0.0, 0.05],
            False,
        ),
        ([2.0, 0.0, 0.0, 0.0, 0.0, 0.05], [0.1, 0.1, 0.0, 0.0, 0.0, 0.5], True),
    ],
)
def test_nearly_the_same_frames_are_no_evidence_about_inverse_poses(
    mount, worlds, counts
):
    Ts_pw_p = wandering_poses(200)
    child = child_of(
        Ts_pw_p, *(se3.exp(np.array(twist)) for twist in (mount, worlds))
    )
    streams = StreamPair(as_trajectory(Ts_pw_p), as_trajectory(child), 1.0)
    explanation = hypotheses.explain(streams, thorough=False)
    _, arms = shape.evidence_for_inverse(streams, explanation.fit)
    assert (arms != 0.0) == counts


def test_noise_that_contradicts_a_clear_shape_does_not_choose_alone():
    """For an exact stream and one with little noise, the noise alone would choose the inversion."""
    readings = Readings(
        hypotheses=(Hypothesis((), ("inverse",)), Hypothesis(("inverse",), ())),
        shape=-2.9,
        paths=-1.8,
        is_small=False,
    )
    assert decide(readings, -628.0) == 0
    assert decide(replace(readings, shape=-0.6), -628.0) is None
    assert decide(readings, 628.0) == 0
    assert decide(replace(readings, shape=-0.1), -628.0) == 1
