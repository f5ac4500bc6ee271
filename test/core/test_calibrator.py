"""The engine fed pose by pose, also over sessions that outgrow its buffers, and the function."""

import dataclasses

import numpy as np
import pytest
from faults import reordered
from motions import (
    T_PARENT_CHILD,
    as_trajectory,
    child_of,
    disturbed,
    feed,
    messages,
    noisy_pair,
    wandering_poses,
)
from numpy.testing import assert_allclose, assert_array_equal

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import InputError, NotEnoughDataError
from hand_eye_calib.core.base.plain import plain
from hand_eye_calib.core.engine.attempts import check
from hand_eye_calib.core.engine.calibrator import BufferLimits, Calibrator
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import SolveStatus
from hand_eye_calib.offline.calibrate import calibrate


def drive(n_poses=200, seed=0):
    """Parent at 10 Hz, child at 50 Hz, 13 ms apart; smooth, so that interpolation costs little."""
    parent = as_trajectory(wandering_poses(n_poses, seed), 10)
    steps_ns = np.arange(5) * 20_000_000
    fine_stamps_ns = parent.stamps_ns[:-1, None] + steps_ns
    fine = parent.at(fine_stamps_ns.ravel())
    child = as_trajectory(child_of(fine), 50)
    return parent, child


def test_python_function_finds_the_truth_at_different_rates():
    parent, child = drive()

    result = calibrate(parent, child, reference="B3")

    assert_allclose(result.T_parent_child, T_PARENT_CHILD, atol=1e-6)
    assert result.status is SolveStatus.OK
    assert result.method == "dnlo"
    assert result.reference == "B3"
    assert result.backend == "fast"
    assert result.n_pairs == result.n_poses - 3
    assert result.n_inliers == result.n_pairs
    identity = result.T_parent_child @ result.T_child_parent
    assert_allclose(identity, np.eye(4), atol=1e-12)


def test_the_engine_and_the_function_agree_to_the_last_bit():
    parent, child = drive()
    calibrator = Calibrator(CalibratorConfig(reference="B3"))
    feed(calibrator, "child", child)
    feed(calibrator, "parent", parent)
    fed = calibrator.estimate()
    through_quaternions = [
        Trajectory.from_quat_xyzw(
            t.stamps_ns, t.poses[:, :3, 3], se3.to_quat_xyzw(t.poses)
        )
        for t in (parent, child)
    ]
    assert np.array_equal(
        fed.T_parent_child,
        calibrate(*through_quaternions, reference="B3").T_parent_child,
    )


def test_adaptive_describes_the_noise():
    parent, child = drive()
    noisy_poses = disturbed(child.poses, 1, 0.002, 0.002)
    noisy = dataclasses.replace(child, poses=noisy_poses)

    result = calibrate(parent, noisy, method="adaptive")

    assert_allclose(result.T_parent_child, T_PARENT_CHILD, atol=0.01)
    assert result.status is SolveStatus.OK
    noise = result.noise
    assert noise.systematic == "none"
    assert noise.translation_white_m == pytest.approx(0.002, rel=0.3)
    document = result.to_dict()
    assert document["noise"] == plain(noise)
    for dof in result.observability:
        assert dof.sigma < 0.02, f"{dof.name} is good to {dof.sigma} only"


def test_adaptive_adds_the_lag_it_finds_to_a_time_offset_unless_that_was_set():
    poses = wandering_poses(400, 5)
    parent = as_trajectory(poses)
    noisy_poses = disturbed(poses, 1, 1e-4, 1e-4)
    child = as_trajectory(child_of(noisy_poses)).shifted(0.02)
    whole = whole_snapshot(parent, child, {"method": "adaptive"})
    for offset_s in (0.0, -0.015):
        config = dataclasses.replace(whole.config, time_offset=offset_s)
        snapshot = dataclasses.replace(whole, config=config)

        estimated = snapshot.estimate()
        result = calibrate(
            parent, child, method="adaptive", time_offset=offset_s
        )

        assert estimated.time_offset_s == pytest.approx(-0.02, abs=1e-3)
        assert result.time_offset_s == offset_s


def test_time_offset_and_scale_are_applied_to_the_child():
    parent, child = drive()
    late = child.shifted(-12.5).scaled(1 / 2.5)

    result = calibrate(
        parent, late, reference="B3", time_offset=12.5, scale=2.5
    )

    assert_allclose(result.T_parent_child, T_PARENT_CHILD, atol=1e-6)
    assert result.time_offset_s == 12.5
    assert result.scale == 2.5


class TestRefusals:
    @pytest.mark.parametrize(
        ("position", "quat", "message"),
        [
            ((0, np.nan, 0), (0, 0, 0, 1), "not finite"),
            (
                (1.7e308, 1.7e308, 0),
                (0, 0, 0, 1),
                r"is more than 1e\+10 m from the origin",
            ),
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
        with pytest.raises(
            InputError, match="parent stream's sensor frame is empty"
        ):
            calibrator.set_frame("parent", "")
        calibrator.set_frame("parent", "lidar")
        calibrator.set_frame("parent", "lidar")
        with pytest.raises(
            InputError, match="changed from 'lidar' to 'camera'"
        ):
            calibrator.set_frame("parent", "camera")
        calibrator.set_frame("child", "lidar")
        with pytest.raises(InputError, match="both streams name 'lidar'"):
            calibrator.estimate()
        named = Calibrator(CalibratorConfig(child_frame="camera"))
        named.set_frame("child", "")
        named.set_frame("child", "base_link")
        snapshot = named.snapshot()
        assert (snapshot.parent_frame, snapshot.child_frame) == (
            "parent_sensor",
            "camera",
        )
        assert "parent stream does not name" in snapshot.frame_warnings[0]


@pytest.mark.parametrize(
    ("n_poses", "parent_s", "child_s", "options", "message"),
    [
        (
            12,
            0.0,
            0.0,
            {"reference": "B50"},
            "reference B50 needs more than 50 common poses, found 11",
        ),
        (40, 0.005, 0.0, {"max_gap": 0.01}, "raise max_gap"),
    ],
)
def test_missing_data_is_named(n_poses, parent_s, child_s, options, message):
    parent, child = drive(n_poses)
    shifted_parent = parent.shifted(parent_s)
    shifted_child = child.shifted(child_s)
    with pytest.raises(NotEnoughDataError, match=message):
        calibrate(shifted_parent, shifted_child, **options)
    with pytest.raises(
        NotEnoughDataError, match="no poses on the parent stream"
    ):
        Calibrator().estimate()


def test_a_stream_on_its_own_does_not_fill_the_memory():
    parent, child = drive(400)
    calibrator = Calibrator(
        CalibratorConfig(reference="B3"), BufferLimits(capacity=100)
    )
    feed(calibrator, "parent", parent)
    assert calibrator.statistics("parent").dropped_unpaired > 0
    assert len(calibrator.snapshot().unpaired[0]) <= 100
    feed(calibrator, "child", child)
    assert len(calibrator.snapshot().pose_pairs) > 20


def test_a_snapshot_does_not_change_when_poses_come_in():
    parent, child = drive(60)
    config = CalibratorConfig(reference="B3")
    calibrator = Calibrator(config)
    feed(calibrator, "child", child)
    feed(calibrator, "parent", parent[:40])
    snapshot = calibrator.snapshot()
    before = snapshot.estimate()

    feed(calibrator, "parent", parent[40:])

    after = snapshot.estimate()
    assert_array_equal(after.T_parent_child, before.T_parent_child)
    assert calibrator.estimate().n_poses > before.n_poses


# 10 s at 10 Hz, so that a short drive outgrows the buffers many times; half a second for late
# arrivals.
SMALL = BufferLimits(
    capacity=500,
    pairing_starts=100,
    batch=16,
    batch_every=4,
    late_ns=500_000_000,
)


def play(sequence, limits=SMALL, **options):
    calibrator = Calibrator(CalibratorConfig(reference="B3", **options), limits)
    for message in sequence:
        calibrator.add_pose(*message)
    return calibrator


def long_drive(n_poses=600, child_every=1):
    parent = as_trajectory(wandering_poses(n_poses))
    child = as_trajectory(child_of(parent.poses))
    return parent, child[::child_every]


def by_stamp(parent, child):
    both = messages("parent", parent) + messages("child", child)

    def stamp_and_stream(message):
        stream, stamp_ns, *_ = message
        return stamp_ns, stream

    return sorted(both, key=stamp_and_stream)


@pytest.mark.parametrize("child_every", [1, 7])
def test_every_pose_is_paired_once_and_memory_stays_small(child_every):
    parent, child = long_drive(child_every=child_every)

    calibrator = play(by_stamp(parent, child), max_gap=1.0)

    snapshot = calibrator.snapshot()
    assert_array_equal(snapshot.pose_pairs.stamps_ns, child.stamps_ns)
    assert len(snapshot.unpaired[0]) < 150
    result = calibrator.estimate()
    assert_allclose(result.T_parent_child, T_PARENT_CHILD, atol=1e-6)
    late_ns = parent.stamps_ns[0] + 1
    is_taken = calibrator.add_pose("parent", late_ns, [0.0] * 3, [0.0, 0, 0, 1])
    assert not is_taken
    assert calibrator.statistics("parent").refused_late == 1


def test_reset_forgets_and_reconfigure_keeps():
    def n_pairs():
        return len(calibrator.snapshot().pose_pairs)

    parent, child = long_drive()
    calibrator = play(by_stamp(parent, child))
    other_reference = dataclasses.replace(calibrator.config, reference="B5")
    calibrator.reconfigure(other_reference)
    assert calibrator.estimate().reference == "B5"

    n_before = n_pairs()
    other_offset = dataclasses.replace(calibrator.config, time_offset=0.01)
    calibrator.reconfigure(other_offset)
    assert 0 < n_pairs() < n_before

    calibrator.reset()
    assert calibrator.statistics("parent").received == 0
    with pytest.raises(NotEnoughDataError):
        calibrator.estimate()


def test_the_answer_is_that_of_all_poses_at_once():
    parent, child = long_drive()
    sequence = by_stamp(parent, child)
    large = dataclasses.replace(SMALL, capacity=5000, pairing_starts=500)

    in_parts = play(sequence).estimate()
    at_once = play(sequence, large).estimate()

    assert_array_equal(in_parts.T_parent_child, at_once.T_parent_child)
    assert in_parts.n_pairs == at_once.n_pairs


@pytest.mark.parametrize("seed", range(2))
def test_late_and_swapped_messages_within_the_horizon_change_nothing(seed):
    sequence = by_stamp(*long_drive())
    random = np.random.default_rng(seed)
    # Every message comes up to 0.4 s late.
    arrival = [message[1] + random.uniform(0, 0.4e9) for message in sequence]
    late = [sequence[k] for k in np.argsort(arrival)]
    calibrator = play(late)
    refused = [
        calibrator.statistics(stream).refused_late
        for stream in ("parent", "child")
    ]
    assert refused == [0, 0]
    assert np.array_equal(
        calibrator.estimate().T_parent_child,
        play(sequence).estimate().T_parent_child,
    )


def test_a_stream_that_lags_by_half_a_minute_loses_nothing():
    parent, child = long_drive()
    lag_ns = 30 * 10**9
    arrivals = np.r_[parent.stamps_ns, child.stamps_ns + lag_ns]
    order = np.argsort(arrivals, kind="stable")
    sequence = messages("parent", parent) + messages("child", child)
    in_order = [sequence[k] for k in order]

    calibrator = play(in_order)

    pairs = calibrator.snapshot().pose_pairs
    assert_array_equal(pairs.stamps_ns, child.stamps_ns)
    assert calibrator.statistics("parent").dropped_unpaired == 0


def test_a_gap_in_one_stream_costs_the_pairs_in_it_and_no_more():
    parent, child = long_drive()
    kept = np.r_[0:200, 300:600]
    sequence = by_stamp(parent[kept], child)

    calibrator = play(sequence)

    pairs = calibrator.snapshot().pose_pairs
    assert_array_equal(pairs.stamps_ns, child.stamps_ns[kept])


def test_the_informative_pairs_are_kept_not_the_newest():
    """An hour straight ahead after two minutes of turning, which is all there is to learn from."""
    turning = wandering_poses(1200)
    numbers = np.arange(1, 7001)
    straight_steps = np.outer(numbers, [0.1, 0, 0, 0, 0, 0])
    straight = turning[-1] @ se3.exp(straight_steps)
    parent = as_trajectory(np.concatenate([turning, straight]))
    child_poses = disturbed(child_of(parent.poses), 1, 1e-4, 1e-4)
    child = dataclasses.replace(parent, poses=child_poses)

    calibrator = play(by_stamp(parent, child), max_pairs=1500)

    stamps_ns = calibrator.snapshot().pose_pairs.stamps_ns
    end_of_turning_ns = parent.stamps_ns[1199]
    n_turning = (stamps_ns <= end_of_turning_ns).sum()
    assert len(stamps_ns) <= 1500
    assert n_turning > 900
    estimated = calibrator.estimate().T_parent_child
    assert_allclose(estimated[:3, 3], T_PARENT_CHILD[:3, 3], atol=2e-3)


def test_the_time_offset_a_snapshot_found_is_taken_over(monkeypatch):
    parent, child = long_drive(400)
    calibrator = Calibrator(
        CalibratorConfig(reference="B3", time_offset="estimate"), SMALL
    )
    feed(calibrator, "parent", parent)
    feed(calibrator, "child", child)
    snapshot = calibrator.snapshot().resolved
    calibrator.adopt(snapshot.time_offset)
    monkeypatch.setattr(
        "hand_eye_calib.core.engine.snapshot.estimated_time_offset", None
    )
    extra = as_trajectory(wandering_poses(900))[400:]
    feed(calibrator, "parent", extra)
    assert calibrator.estimate().time_offset_s == snapshot.time_offset.seconds


@pytest.mark.parametrize("max_pairs", [5000, 300])
def test_the_whole_session_is_checked_not_only_its_end(max_pairs):
    poses = wandering_poses(400)
    standing = np.repeat(poses[-1:], 200, axis=0)
    parked = np.concatenate([poses, standing])
    parent, child = noisy_pair(parked, 0, 1e-4, 5e-4)
    sequence = by_stamp(parent, child)
    wrong_sequence = by_stamp(parent, reordered(child))

    sound = play(sequence, max_pairs=max_pairs).snapshot()
    wrong = play(
        wrong_sequence, max_pairs=max_pairs, time_offset=0.5
    ).snapshot()

    assert check(sound).findings == ()
    assert len(sound.unpaired[0]) < 150
    assert len(sound.streams[0]) > 250
    assert check(wrong).findings[0].code == "quaternion_order"
    first_ns = wrong.streams[1].stamps_ns[0]
    assert first_ns in child.stamps_ns
