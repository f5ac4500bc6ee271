"""The engine over sessions that outgrow its buffers: every pose is used, whatever the order, rates
and gaps.
"""

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
    wandering_poses,
)

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.calibrator import BufferLimits, Calibrator
from hand_eye_calib.engine.run import check
from hand_eye_calib.errors import NotEnoughDataError
from hand_eye_calib.geometry import se3

# 10 s at 10 Hz, so that a short drive outgrows the buffers many times; half a second for late
# arrivals.
SMALL = BufferLimits(capacity=500, pairing_starts=100, batch=16, batch_every=4, late_ns=500_000_000)


def play(sequence, limits=SMALL, **options):
    calibrator = Calibrator(CalibratorConfig(reference="B3", **options), limits)
    for message in sequence:
        calibrator.add_pose(*message)
    return calibrator


def drive(n_poses=600, child_every=1):
    parent = as_trajectory(wandering_poses(n_poses))
    return parent, as_trajectory(child_of(parent.poses))[::child_every]


def by_stamp(parent, child):
    both = messages("parent", parent) + messages("child", child)
    return sorted(both, key=lambda message: (message[1], message[0]))


@pytest.mark.parametrize("child_every", [1, 7])
def test_every_pose_is_paired_once_and_memory_stays_small(child_every):
    parent, child = drive(child_every=child_every)
    calibrator = play(by_stamp(parent, child), max_gap=1.0)
    assert np.array_equal(calibrator.snapshot().pose_pairs.stamps_ns, child.stamps_ns)
    assert len(calibrator.snapshot().parent) < 150
    np.testing.assert_allclose(calibrator.estimate().T_parent_child, T_PARENT_CHILD, atol=1e-6)
    assert not calibrator.add_pose("parent", parent.stamps_ns[0] + 1, [0.0] * 3, [0.0, 0, 0, 1])
    assert calibrator.statistics("parent").refused_late == 1


def test_reset_forgets_and_reconfigure_keeps():
    calibrator = play(by_stamp(*drive()))
    calibrator.reconfigure(dataclasses.replace(calibrator.config, reference="B5"))
    assert calibrator.estimate().reference == "B5"
    before = len(calibrator.snapshot().pose_pairs)
    calibrator.reconfigure(dataclasses.replace(calibrator.config, time_offset=0.01))
    assert 0 < len(calibrator.snapshot().pose_pairs) < before
    calibrator.reset()
    assert calibrator.statistics("parent").received == 0
    with pytest.raises(NotEnoughDataError):
        calibrator.estimate()


def test_the_answer_is_that_of_all_poses_at_once():
    sequence = by_stamp(*drive())
    in_parts = play(sequence).estimate()
    large = dataclasses.replace(SMALL, capacity=5000, pairing_starts=500)
    at_once = play(sequence, large).estimate()
    assert np.array_equal(in_parts.T_parent_child, at_once.T_parent_child)
    assert in_parts.n_pairs == at_once.n_pairs


@pytest.mark.parametrize("seed", range(2))
def test_late_and_swapped_messages_within_the_horizon_change_nothing(seed):
    sequence = by_stamp(*drive())
    random = np.random.default_rng(seed)
    # Every message comes up to 0.4 s late.
    arrival = [message[1] + random.uniform(0, 0.4e9) for message in sequence]
    late = [sequence[k] for k in np.argsort(arrival)]
    calibrator = play(late)
    refused = [calibrator.statistics(stream).refused_late for stream in ("parent", "child")]
    assert refused == [0, 0]
    assert np.array_equal(
        calibrator.estimate().T_parent_child, play(sequence).estimate().T_parent_child
    )


def test_a_stream_that_lags_by_half_a_minute_loses_nothing():
    parent, child = drive()
    arrivals = np.r_[parent.stamps_ns, child.stamps_ns + 30 * 10**9]
    sequence = messages("parent", parent) + messages("child", child)
    calibrator = play([sequence[k] for k in np.argsort(arrivals, kind="stable")])
    assert np.array_equal(calibrator.snapshot().pose_pairs.stamps_ns, child.stamps_ns)
    assert calibrator.statistics("parent").dropped_unpaired == 0


def test_a_gap_in_one_stream_costs_the_pairs_in_it_and_no_more():
    parent, child = drive()
    kept = np.r_[0:200, 300:600]
    calibrator = play(by_stamp(parent[kept], child))
    expected = child.stamps_ns[kept]
    assert np.array_equal(calibrator.snapshot().pose_pairs.stamps_ns, expected)


def test_the_informative_pairs_are_kept_not_the_newest():
    """An hour straight ahead after two minutes of turning, which is all there is to learn from."""
    turning = wandering_poses(1200)
    straight = turning[-1] @ se3.exp(np.outer(np.arange(1, 7001), [0.1, 0, 0, 0, 0, 0]))
    parent = as_trajectory(np.concatenate([turning, straight]))
    child = dataclasses.replace(parent, poses=disturbed(child_of(parent.poses), 1, 1e-4, 1e-4))
    calibrator = play(by_stamp(parent, child), max_pairs=1500)
    stamps_ns = calibrator.snapshot().pose_pairs.stamps_ns
    assert len(stamps_ns) <= 1500
    assert (stamps_ns <= parent.stamps_ns[1199]).sum() > 900
    result = calibrator.estimate()
    np.testing.assert_allclose(result.T_parent_child[:3, 3], T_PARENT_CHILD[:3, 3], atol=2e-3)


def test_the_time_offset_a_snapshot_found_is_taken_over(monkeypatch):
    parent, child = drive(400)
    calibrator = Calibrator(CalibratorConfig(reference="B3", time_offset="estimate"), SMALL)
    feed(calibrator, "parent", parent)
    feed(calibrator, "child", child)
    snapshot = calibrator.snapshot().resolved
    calibrator.adopt(snapshot.time_offset)
    monkeypatch.setattr("hand_eye_calib.engine.calibrator.estimated_time_offset", None)
    extra = as_trajectory(wandering_poses(900))[400:]
    feed(calibrator, "parent", extra)
    assert calibrator.estimate().time_offset_s == snapshot.time_offset.seconds


@pytest.mark.parametrize("max_pairs", [5000, 300])
def test_the_whole_session_is_checked_not_only_its_end(max_pairs):
    poses = wandering_poses(400)
    parked = np.concatenate([poses, np.repeat(poses[-1:], 200, axis=0)])
    parent, child = (
        as_trajectory(disturbed(each, seed, 1e-4, 1e-4))
        for seed, each in enumerate((parked, child_of(parked)))
    )
    sound = play(by_stamp(parent, child), max_pairs=max_pairs).snapshot()
    assert check(sound).findings == ()
    assert len(sound.parent) < 150 < 250 < len(sound.streams[0])
    late = play(by_stamp(parent, reordered(child)), max_pairs=max_pairs, time_offset=0.5).snapshot()
    assert [finding.code for finding in check(late).findings][0] == "quaternion_order"
    assert late.streams[1].stamps_ns[0] in child.stamps_ns
