"""Scale and clock offset: estimated by whatever motion there is, with outliers, with their standard
deviations, and refused where the evidence is weak.
"""

import dataclasses

import motions
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sigmas import assert_errors_over_sigmas

from hand_eye_calib.core.alignment.rate_correlation import correlate_rates
from hand_eye_calib.core.alignment.scale import estimate_scale
from hand_eye_calib.core.alignment.time_offset import estimate_time_offset
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.engine.calibrator import BufferLimits, Calibrator
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.offline.calibrate import calibrate


def streams(
    n_poses=400, seed=0, scale=1.0, noise=0.0, poses=motions.wandering_poses
):
    """Return two streams at 10 Hz. The child's lengths must be multiplied by ``scale``."""
    true_poses = poses(n_poses, seed)
    parent, child = motions.noisy_pair(true_poses, seed + 1, noise, noise)
    return parent, child.scaled(1 / scale)


def pose_pairs(parent, child):
    return PosePairs(parent.stamps_ns, parent.poses, child.poses)


@pytest.mark.parametrize("scale", [1e-3, 0.3048, 1.0, 3.34, 1000.0])
@pytest.mark.parametrize(
    "poses", [motions.wandering_poses, motions.planar_poses]
)
def test_noise_free_scale_is_exact(scale, poses):
    parent, child = streams(scale=scale, poses=poses)
    pairs = pose_pairs(parent, child)
    fit = estimate_scale(pairs)
    assert fit.scale == pytest.approx(scale, rel=1e-5)
    assert fit.explains_translation


def test_most_pairs_decide_whatever_the_others_say():
    parent, child = streams(scale=2.5, noise=0.002)
    random = np.random.default_rng(0)
    is_wrong = random.random(len(child)) < 0.12
    errors = random.normal(size=(int(is_wrong.sum()), 6))
    poses = child.poses.copy()
    poses[is_wrong] = poses[is_wrong] @ se3.exp(errors)
    wrong_child = dataclasses.replace(child, poses=poses)
    pairs = pose_pairs(parent, wrong_child)

    fit = estimate_scale(pairs)

    assert fit.scale == pytest.approx(2.5, rel=0.01)


def test_standard_deviation_is_of_the_size_of_the_errors():
    ratios = []
    for seed in range(0, 60, 5):
        parent, child = streams(seed=seed, scale=1.7, noise=0.01)
        fit = estimate_scale(pose_pairs(parent, child))
        error = fit.scale - 1.7
        ratios.append(error / fit.scale_sigma)
    assert_errors_over_sigmas(ratios, 0.3, 3.0)


@pytest.mark.parametrize(
    "method", ["dnlo", "dnl", "park", "taylor", "zhuang", "ali"]
)
def test_every_method_takes_it(method):
    options = {
        "method": method,
        "reference": "B10",
        "scale": "estimate",
        "checks": False,
    }
    result = calibrate(*streams(scale=2.0, noise=0.0005), **options)
    assert result.scale == pytest.approx(2.0, rel=0.005)
    assert 0 < result.scale_sigma < 0.01
    assert_allclose(result.T_parent_child, motions.T_PARENT_CHILD, atol=0.02)


def test_auto_estimates_only_where_the_streams_call_for_it():
    same_streams = streams(noise=0.002)
    other_streams = streams(scale=0.9, noise=0.002)

    same = calibrate(*same_streams, reference="B10", scale="auto")
    other = calibrate(*other_streams, reference="B10", scale="auto")

    assert same.scale == 1.0
    assert same.scale_sigma == 0.0
    assert other.scale == pytest.approx(0.9, rel=0.01)
    assert "multiplied by 0.9" in "\n".join(other.warnings)


def test_uncertainty_of_the_scale_enters_that_of_the_extrinsic():
    parent, child = streams(noise=0.005)
    options = {"reference": "B10", "checks": False}
    estimated = calibrate(parent, child, scale="estimate", **options)
    with_scale = calibrate(parent, child, scale=estimated.scale, **options)
    assert np.trace(estimated.covariance_measured) > np.trace(
        with_scale.covariance_measured
    )


def test_a_scale_that_explains_nothing_is_refused():
    parent, _ = streams(seed=1)
    _, other = streams(seed=9)
    with pytest.raises(
        NotEnoughDataError, match="scale cannot be estimated: even with a scale"
    ):
        calibrate(parent, other, reference="B10", scale="estimate")
    assert calibrate(parent, other, reference="B10", scale="auto").scale == 1.0


RATES_HZ = 20.0, 33.0


def drive(
    seed=0,
    seconds=60,
    hz=RATES_HZ,
    shift_s=0.0,
    noise=0.0,
    wander=motions.wandering_poses,
):
    """Both sensors at rates of their own; the child's clock is ``shift_s`` behind, so that this is
    the offset to find.
    """
    true_poses = wander(seconds * 10, seed)
    truth = motions.as_trajectory(true_poses, 10.0)
    start_ns = int(truth.stamps_ns[0])
    end_ns = int(truth.stamps_ns[-1])
    parent_hz, child_hz = hz

    parent_ns = np.arange(start_ns, end_ns, round(1e9 / parent_hz))
    parent_poses = truth.at(parent_ns)
    noisy_parent = motions.disturbed(parent_poses, seed + 1, noise, noise)

    child_start_ns = start_ns + 7_000_000
    child_ns = np.arange(child_start_ns, end_ns, round(1e9 / child_hz))
    child_poses = motions.child_of(truth.at(child_ns))
    noisy_child = motions.disturbed(child_poses, seed + 2, noise, noise)
    child = Trajectory(child_ns, noisy_child)
    return Trajectory(parent_ns, noisy_parent), child.shifted(-shift_s)


@pytest.mark.parametrize("shift_s", [0.0, 0.1234, -3.7, 500.0, -12345.678])
def test_any_offset_is_found_also_without_common_time(shift_s):
    parent, child = drive(shift_s=shift_s, noise=0.0005)
    offset = estimate_time_offset(parent, child)
    assert offset.seconds == pytest.approx(shift_s, abs=0.002)
    assert offset.correlation.is_clear
    assert offset.sigma_s < 0.002


def test_a_body_that_rotates_about_one_of_its_sensors():
    """The scale cannot be estimated then, but the offset can."""

    def rotating(n_poses, seed):
        poses = motions.wandering_poses(n_poses, seed)
        poses[:, :3, 3] = 0.0
        return poses

    parent, child = drive(shift_s=0.1234, noise=0.002, wander=rotating)

    offset = estimate_time_offset(parent, child)

    assert offset.seconds == pytest.approx(0.1234, abs=0.002)
    assert offset.sigma_s < 0.002


@pytest.mark.statistics
@pytest.mark.parametrize(
    ("hz", "jitter_s"), [(RATES_HZ, 0.0), ((50.0, 10.0), 0.006)]
)
def test_offset_without_bias_and_its_standard_deviation_of_the_size_of_the_errors(
    hz, jitter_s
):
    ratios = []
    for seed in range(12):
        parent, child = drive(seed, hz=hz, shift_s=1.5, noise=0.003)
        late_ns = (
            np.random.default_rng(seed)
            .normal(0.0, jitter_s * 1e9, len(child))
            .astype(int)
        )
        jittered = dataclasses.replace(
            child, stamps_ns=child.stamps_ns + late_ns
        )
        offset = estimate_time_offset(parent, jittered)
        ratios.append((offset.seconds - 1.5) / offset.sigma_s)
    assert abs(np.mean(ratios)) < 1.5, "the offset is biased"
    assert_errors_over_sigmas(ratios, 0.3, 2.0)


def test_jumps_do_no_harm():
    parent, child = drive(shift_s=41.0, noise=0.001)
    random = np.random.default_rng(3)
    is_jumping = random.random(len(child)) < 0.05
    n_jumps = int(is_jumping.sum())
    jumps = se3.exp(0.5 * random.normal(size=(n_jumps, 6)))
    poses = child.poses.copy()
    poses[is_jumping] = poses[is_jumping] @ jumps
    jumping_child = dataclasses.replace(child, poses=poses)

    offset = estimate_time_offset(parent, jumping_child)

    assert offset.seconds == pytest.approx(41.0, abs=0.01)


def test_angular_rates_do_not_depend_on_conventions():
    parent, child = drive(shift_s=8.0)
    plain = correlate_rates(parent, child).offset_s
    inverse = dataclasses.replace(child, poses=se3.inverse(child.poses))
    reordered = Trajectory.from_quat_xyzw(
        child.stamps_ns,
        child.poses[:, :3, 3],
        np.roll(se3.to_quat_xyzw(child.poses), 1, axis=1),
    )
    for stream in (inverse, reordered):
        assert correlate_rates(parent, stream).offset_s == pytest.approx(
            plain, abs=1e-6
        )


class TestWeakEvidenceIsRefused:
    def test_streams_that_have_nothing_to_do_with_each_other(self):
        refused = (
            "time offset cannot be estimated: .*(correlated by|times better)"
        )
        for seed in range(5):
            parent, _ = drive(seed)
            _, child_of_another_drive = drive(seed + 50)
            with pytest.raises(NotEnoughDataError, match=refused):
                estimate_time_offset(parent, child_of_another_drive)

    def test_motion_without_turns(self):
        poses = np.tile(np.eye(4), (300, 1, 1))
        poses[:, 0, 3] = np.linspace(0, 50, 300)
        straight = motions.as_trajectory(poses)
        with pytest.raises(NotEnoughDataError, match="hardly rotate"):
            estimate_time_offset(straight, straight)

    def test_motion_that_is_too_short(self):
        parent, child = drive()
        short_parent = parent[:40]
        short_child = child[:60]
        with pytest.raises(
            NotEnoughDataError, match="give time_offset in seconds"
        ):
            estimate_time_offset(short_parent, short_child)


class TestClockRate:
    def test_it_is_found_unasked_and_the_answer_is_as_without(self):
        parent, child = drive(seconds=300, hz=(10.0, 10.0), noise=0.001)
        middle_ns = int(child.stamps_ns[len(child) // 2])
        slow = child.shifted(0.0, -75e-6, middle_ns)

        result = calibrate(parent, slow)
        plain = calibrate(parent, child, checks=False)

        rate = result.clock_rate
        assert rate.is_used
        error_ppm = abs(rate.ppm - 75.0)
        assert error_ppm < 5.0
        assert error_ppm < 5.0 * rate.sigma_ppm
        assert (
            'ppm slow: solved with time_offset="estimate"' in result.warnings[0]
        )
        difference = se3.inverse(plain.T_parent_child) @ result.T_parent_child
        sigmas = np.sqrt(np.diag(plain.covariance_measured))
        ratios = np.abs(se3.log(difference)) / sigmas
        assert ratios.max() < 0.3, f"the clock rate moves it by {ratios} sigma"
        read_back = type(result).from_dict(result.to_dict())
        assert read_back.clock_rate == rate

    def test_one_that_is_not_there_is_stated_and_not_used(self):
        parent, child = drive(shift_s=0.3, noise=0.001)
        rate = estimate_time_offset(parent, child).rate
        assert abs(rate.ppm) < 5.0 * rate.sigma_ppm
        assert not rate.is_used


class TestInTheEngine:
    def test_uncertainty_of_the_offset_enters_that_of_the_extrinsic(self):
        parent, child = drive(noise=0.0005)
        options = {"reference": "B5", "checks": False}
        estimated = calibrate(parent, child, time_offset="estimate", **options)
        assert 0 < estimated.time_offset_sigma_s < 0.002
        again = type(estimated).from_dict(estimated.to_dict())
        assert again.time_offset_sigma_s == estimated.time_offset_sigma_s
        fixed = calibrate(
            parent, child, time_offset=estimated.time_offset_s, **options
        )
        assert_array_equal(fixed.T_parent_child, estimated.T_parent_child)
        assert fixed.time_offset_sigma_s == 0.0
        assert (
            np.linalg.eigvalsh(
                estimated.covariance_measured - fixed.covariance_measured
            )[-1]
            > 0
        )

    def test_long_sessions_settle_it_when_a_buffer_is_full(self):
        parent, child = drive(seconds=120, shift_s=0.2)
        calibrator = Calibrator(
            CalibratorConfig(time_offset="estimate", reference="B5"),
            BufferLimits(capacity=900),
        )
        for eighth in range(8):
            for stream, trajectory in (("parent", parent), ("child", child)):
                first, last = (
                    k * len(trajectory) // 8 for k in (eighth, eighth + 1)
                )
                motions.feed(calibrator, stream, trajectory[first:last])
        snapshot = calibrator.snapshot()
        assert len(snapshot.kept) > 0
        assert snapshot.time_offset.seconds == pytest.approx(0.2, abs=0.002)
        result = snapshot.estimate()
        assert result.time_offset_s == snapshot.time_offset.seconds
        assert_allclose(
            result.T_parent_child, motions.T_PARENT_CHILD, atol=0.02
        )

    def test_streams_that_cannot_be_aligned_do_not_fill_the_memory(self):
        calibrator = Calibrator(
            CalibratorConfig(time_offset="estimate"), BufferLimits(capacity=300)
        )
        for stream, trajectory in zip(
            ("parent", "child"), (drive(1)[0], drive(77)[1]), strict=True
        ):
            motions.feed(calibrator, stream, trajectory)
        assert calibrator.statistics("child").dropped_unpaired > 0
        with pytest.raises(NotEnoughDataError):
            calibrator.estimate()
