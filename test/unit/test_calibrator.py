import dataclasses

import numpy as np
import pytest
from motions import T_PARENT_CHILD, as_trajectory, child_of, disturbed, feed, wandering_poses

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.calibrator import BufferLimits, Calibrator
from hand_eye_calib.engine.offline import calibrate
from hand_eye_calib.engine.snapshot import whole_snapshot
from hand_eye_calib.errors import InputError, NotEnoughDataError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.plain import plain
from hand_eye_calib.results.calibration import SolveStatus


def drive(n_poses=200, seed=0):
    """Parent at 10 Hz, child at 50 Hz, 13 ms apart; smooth, so that interpolation costs little."""
    parent = as_trajectory(wandering_poses(n_poses, seed), 10)
    fine = parent.at((parent.stamps_ns[:-1, None] + np.arange(5) * 2 * 10**7).ravel())
    return parent, as_trajectory(child_of(fine), 50)


def test_python_function_finds_the_truth_at_different_rates():
    parent, child = drive()
    result = calibrate(parent, child, reference="B3")
    np.testing.assert_allclose(result.T_parent_child, T_PARENT_CHILD, atol=1e-6)
    assert result.status is SolveStatus.OK
    assert (result.method, result.reference, result.backend) == ("dnlo", "B3", "fast")
    assert result.n_pairs == result.n_poses - 3 == result.n_inliers
    np.testing.assert_allclose(result.T_parent_child @ result.T_child_parent, np.eye(4), atol=1e-12)


def test_the_engine_and_the_function_agree_to_the_last_bit():
    parent, child = drive()
    calibrator = Calibrator(CalibratorConfig(reference="B3"))
    feed(calibrator, "child", child)
    feed(calibrator, "parent", parent)
    fed = calibrator.estimate()
    through_quaternions = [
        Trajectory.from_quat_xyzw(t.stamps_ns, t.poses[:, :3, 3], se3.to_quat_xyzw(t.poses))
        for t in (parent, child)
    ]
    assert np.array_equal(
        fed.T_parent_child, calibrate(*through_quaternions, reference="B3").T_parent_child
    )


def test_adaptive_describes_the_noise():
    parent, child = drive()
    result = calibrate(parent, disturb(child), method="adaptive")
    np.testing.assert_allclose(result.T_parent_child, T_PARENT_CHILD, atol=0.01)
    assert result.status is SolveStatus.OK
    assert result.noise.systematic == "none"
    assert result.noise.translation_white_m == pytest.approx(0.002, rel=0.3)
    assert result.to_dict()["noise"] == plain(result.noise)
    assert all(dof.sigma < 0.02 for dof in result.observability)


def disturb(trajectory):
    return dataclasses.replace(trajectory, poses=disturbed(trajectory.poses, 1, 0.002, 0.002))


def test_adaptive_adds_the_lag_it_finds_to_a_time_offset_unless_that_was_set():
    poses = wandering_poses(400, 5)
    parent = as_trajectory(poses)
    child = as_trajectory(child_of(disturbed(poses, 1, 1e-4, 1e-4))).shifted(0.02)
    whole = whole_snapshot(parent, child, {"method": "adaptive"})
    for offset_s in (0.0, -0.015):
        config = dataclasses.replace(whole.config, time_offset=offset_s)
        snapshot = dataclasses.replace(whole, config=config)
        assert snapshot.estimate().time_offset_s == pytest.approx(-0.02, abs=1e-3)
        result = calibrate(parent, child, method="adaptive", time_offset=offset_s)
        assert result.time_offset_s == offset_s


def test_time_offset_and_scale_are_applied_to_the_child():
    parent, child = drive()
    late = dataclasses.replace(child.shifted(-12.5), poses=child.scaled(1 / 2.5).poses)
    result = calibrate(parent, late, reference="B3", time_offset=12.5, scale=2.5)
    np.testing.assert_allclose(result.T_parent_child, T_PARENT_CHILD, atol=1e-6)
    assert (result.time_offset_s, result.scale) == (12.5, 2.5)


class TestRefusals:
    @pytest.mark.parametrize(
        ("position", "quat", "message"),
        [
            ((0, np.nan, 0), (0, 0, 0, 1), "not finite"),
            ((1.7e308, 1.7e308, 0), (0, 0, 0, 1), r"is more than 1e\+08 m from the origin"),
            ((0, 0, 0), (0, 0, 0, 0), "of length 0, expected 1"),
            ((0, 0, 0), (0.5, 0.5, 0.5, 0.6), "of length 1.05"),
            ((0, 0, 0), (0, 0, np.nan, 1), "not finite"),
        ],
    )
    def test_impossible_poses(self, position, quat, message):
        calibrator = Calibrator()
        with pytest.raises(InputError, match=message):
            calibrator.add_pose("parent", 0, position, quat)
        assert calibrator.statistics("parent").received == 0

    def test_frames(self):
        calibrator = Calibrator()
        with pytest.raises(InputError, match="parent stream's sensor frame is empty"):
            calibrator.set_frame("parent", "")
        calibrator.set_frame("parent", "lidar")
        calibrator.set_frame("parent", "lidar")
        with pytest.raises(InputError, match="changed from 'lidar' to 'camera'"):
            calibrator.set_frame("parent", "camera")
        calibrator.set_frame("child", "lidar")
        with pytest.raises(InputError, match="both streams name 'lidar'"):
            calibrator.estimate()
        named = Calibrator(CalibratorConfig(child_frame="camera"))
        named.set_frame("child", "")
        named.set_frame("child", "base_link")
        snapshot = named.snapshot()
        assert (snapshot.parent_frame, snapshot.child_frame) == ("parent_sensor", "camera")
        assert "parent stream does not name" in snapshot.warnings[0]


@pytest.mark.parametrize(
    ("n_poses", "parent_s", "child_s", "options", "message"),
    [
        (12, 0.0, 0.0, {"reference": "B50"}, "too few common poses for the chosen reference"),
        (40, 0.005, 0.0, {"max_gap": 0.01}, "raise max_gap"),
    ],
)
def test_missing_data_is_named(n_poses, parent_s, child_s, options, message):
    parent, child = drive(n_poses)
    with pytest.raises(NotEnoughDataError, match=message):
        calibrate(parent.shifted(parent_s), child.shifted(child_s), **options)
    with pytest.raises(NotEnoughDataError, match="no poses on the parent stream"):
        Calibrator().estimate()


def test_a_stream_on_its_own_does_not_fill_the_memory():
    parent, child = drive(400)
    calibrator = Calibrator(CalibratorConfig(reference="B3"), BufferLimits(capacity=100))
    feed(calibrator, "parent", parent)
    assert calibrator.statistics("parent").dropped_unpaired > 0
    assert len(calibrator.snapshot().parent) <= 100
    feed(calibrator, "child", child)
    assert len(calibrator.snapshot().pose_pairs) > 20


def test_a_snapshot_does_not_change_when_poses_come_in():
    parent, child = drive(60)
    calibrator = Calibrator(CalibratorConfig(reference="B3"))
    feed(calibrator, "child", child)
    feed(calibrator, "parent", parent[:40])
    snapshot = calibrator.snapshot()
    before = snapshot.estimate()
    feed(calibrator, "parent", parent[40:])
    assert np.array_equal(snapshot.estimate().T_parent_child, before.T_parent_child)
    assert calibrator.estimate().n_poses > before.n_poses
