"""The engine gives the same answer however the messages arrive, or says what it refused."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from motions import (
    T_PARENT_CHILD,
    as_trajectory,
    child_of,
    messages,
    wandering_poses,
)
from numpy.testing import assert_allclose

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.engine.calibrator import Calibrator
from hand_eye_calib.core.geometry.trajectory import Trajectory

CONFIG = CalibratorConfig(reference="B3", max_gap=0.15)


def both(apart_ns):
    """Both at 10 Hz, so far apart; the child lies where the parent is interpolated."""
    parent = as_trajectory(wandering_poses(60))
    between = parent.stamps_ns[:-1] + apart_ns
    child = Trajectory(between, child_of(parent.at(between)))
    return messages("parent", parent) + messages("child", child)


MESSAGES = both(30_000_000)
TOGETHER = both(0)


def estimate(sequence):
    calibrator = Calibrator(CONFIG)
    taken = [calibrator.add_pose(*message) for message in sequence]
    return calibrator.estimate(), calibrator, taken


IN_ORDER, _, _ = estimate(MESSAGES)


@settings(max_examples=25)
@given(st.randoms(use_true_random=False))
def test_any_interleaving_gives_the_same_bits(random):
    shuffled = MESSAGES.copy()
    random.shuffle(shuffled)
    result, _, taken = estimate(shuffled)
    assert all(taken)
    assert np.array_equal(result.T_parent_child, IN_ORDER.T_parent_child)
    assert np.array_equal(result.covariance, IN_ORDER.covariance)


@settings(max_examples=25)
@given(
    st.lists(st.sampled_from(MESSAGES), min_size=1, max_size=40),
    st.randoms(use_true_random=False),
)
def test_repetitions_change_nothing_and_are_counted(repeated, random):
    sequence = MESSAGES + repeated
    random.shuffle(sequence)
    result, calibrator, taken = estimate(sequence)
    assert np.array_equal(result.T_parent_child, IN_ORDER.T_parent_child)
    refused = sum(
        calibrator.statistics(stream).refused_duplicate
        for stream in ("parent", "child")
    )
    assert refused == len(repeated) == taken.count(False)


@settings(max_examples=25)
@given(
    st.integers(0, 100), st.integers(1, 25), st.randoms(use_true_random=False)
)
def test_a_gap_leaves_pairs_out_but_invents_none(first, length, random):
    # Beside a gap interpolation knows less.
    kept = TOGETHER[:first] + TOGETHER[first + length :]
    random.shuffle(kept)
    result, calibrator, _ = estimate(kept)
    assert result.n_poses <= IN_ORDER.n_poses
    stamps = {
        stream: {message[1] for message in kept if message[0] == stream}
        for stream in ("parent", "child")
    }
    assert (
        set(calibrator.snapshot().pose_pairs.stamps_ns.tolist())
        <= stamps["child"]
    )
    assert_allclose(result.T_parent_child, T_PARENT_CHILD, atol=1e-6)
