"""The engine gives the same answer however the messages arrive, or says what it refused."""

from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from motions import T_PARENT_CHILD, as_trajectory, child_of, wandering_poses

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.calibrator import Calibrator, UnusablePose
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory

CONFIG = CalibratorConfig(reference="B3", max_gap=0.15)


def messages(apart_ns):
    """Both at 10 Hz, so far apart; the child lies where the parent is interpolated."""
    parent = as_trajectory(wandering_poses(60))
    between = parent.stamps_ns[:-1] + apart_ns
    streams = {"parent": parent, "child": Trajectory(between, child_of(parent.at(between)))}
    return [
        (stream, stamp_ns, tuple(pose[:3, 3]), tuple(quat))
        for stream, trajectory in streams.items()
        for stamp_ns, pose, quat in zip(
            trajectory.stamps_ns.tolist(),
            trajectory.poses,
            se3.to_quat_xyzw(trajectory.poses),
            strict=True,
        )
    ]


MESSAGES, TOGETHER = messages(30_000_000), messages(0)


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
    st.lists(st.sampled_from(MESSAGES), min_size=1, max_size=40), st.randoms(use_true_random=False)
)
def test_repetitions_change_nothing_and_are_counted(repeated, random):
    sequence = MESSAGES + repeated
    random.shuffle(sequence)
    result, calibrator, taken = estimate(sequence)
    assert np.array_equal(result.T_parent_child, IN_ORDER.T_parent_child)
    refused = sum(calibrator.statistics(stream).refused_duplicate for stream in ("parent", "child"))
    assert refused == len(repeated) == taken.count(False)


@settings(max_examples=25)
@given(st.integers(0, 100), st.integers(1, 25), st.randoms(use_true_random=False))
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
    assert set(calibrator.snapshot().pose_pairs().stamps_ns.tolist()) <= stamps["child"]
    np.testing.assert_allclose(result.T_parent_child, T_PARENT_CHILD, atol=1e-6)


def fed_one_by_one(names, stamps_ns, poses):
    """A calibrator, which poses it took, and the error that ended it."""
    calibrator, taken = Calibrator(CONFIG), []
    for name, stamp_ns, pose in zip(names, stamps_ns.tolist(), poses.tolist(), strict=True):
        try:
            taken.append(calibrator.add_pose(name, stamp_ns, pose[:3], pose[3:]))
        except InputError as error:
            return calibrator, taken, str(error)
    return calibrator, taken, None


def fed_at_once(names, stamps_ns, poses, cuts):
    """The same, the poses between two cuts at once."""
    calibrator, taken = Calibrator(CONFIG), []
    for first, last in pairwise([0, *cuts, len(names)]):
        part = slice(first, last)
        try:
            taken += calibrator.add_poses(
                names[part], stamps_ns[part], poses[part, :3], poses[part, 3:]
            ).tolist()
        except UnusablePose as error:
            return calibrator, error.index + first, str(error)
    return calibrator, taken, None


def assert_same_state(first, second):
    """The same statistics, pairs and poses that wait."""
    for stream in ("parent", "child"):
        assert first.statistics(stream) == second.statistics(stream)
    first, second = first.snapshot(), second.snapshot()
    assert first.paired_at == second.paired_at
    for name in ("kept", "buffered_parent", "buffered_child"):
        found, expected = (vars(getattr(each, name)) for each in (first, second))
        assert found.keys() == expected.keys()
        for part, values in expected.items():
            np.testing.assert_array_equal(found[part], values, err_msg=f"{name} {part}")


NUMBERS = st.one_of(st.floats(-5, 5), st.sampled_from([np.nan, np.inf, 1.7e308]))
QUATERNIONS = st.sampled_from([(0.0, 0.0, 0.0, 1.0), (0.6, 0.0, 0.0, 0.8), (0.0, 0.0, 0.0, 1.009)])
BAD_QUATERNIONS = st.sampled_from(
    [(0.0, 0.0, 0.0, 1.02), (0.0, 0.0, 0.0, 0.0), (np.nan,) * 4, (1e200,) * 4]
)


@settings(max_examples=60)
@given(st.data())
def test_many_poses_at_once_are_the_same_as_one_by_one(data):
    """Statistics, waiting poses and pairs to the last bit; or the same error at the same pose, with
    all before it taken.
    """
    names = data.draw(
        st.lists(st.sampled_from(["parent", "child"]), min_size=1, max_size=60)
    ) * data.draw(st.integers(1, 90))
    steps = data.draw(st.lists(st.integers(-3, 12), min_size=1, max_size=20))
    stamps_ns = 10_000_000 * np.cumsum(np.resize(steps, len(names)))
    places = data.draw(st.lists(st.tuples(st.floats(-5, 5), QUATERNIONS), min_size=1, max_size=40))
    poses = np.resize([(x, 0.0, 0.0, *quat_xyzw) for x, quat_xyzw in places], (len(names), 7))
    if data.draw(st.booleans()):
        wrong = data.draw(st.integers(0, len(names) - 1))
        poses[wrong] = [
            data.draw(NUMBERS),
            0.0,
            0.0,
            *data.draw(st.one_of(QUATERNIONS, BAD_QUATERNIONS)),
        ]
    one_by_one, taken, refused = fed_one_by_one(names, stamps_ns, poses)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(names)), max_size=3)))
    at_once, taken_at_once, refused_at_once = fed_at_once(names, stamps_ns, poses, cuts)
    assert refused_at_once == refused
    assert taken_at_once == (len(taken) if refused else taken)
    assert_same_state(at_once, one_by_one)


def test_many_poses_of_a_long_session_are_the_same_as_one_by_one():
    """Far beyond the capacity of the buffers: poses are paired and dropped, in the end without a
    partner.
    """
    random = np.random.default_rng(4)
    names = np.where(random.random(60_000) < np.linspace(0.2, 1.8, 60_000), "parent", "child")
    stamps_ns = np.cumsum(random.integers(0, 20_000_000, len(names)))
    stamps_ns[random.choice(len(names), 300, replace=False)] -= random.integers(
        0, 60_000_000_000, 300
    )
    positions = np.cumsum(random.normal(size=(len(names), 3)) * 0.01, axis=0)
    poses = np.concatenate([positions, np.tile([0.6, 0.0, 0.0, 0.8], (len(names), 1))], axis=1)
    one_by_one, taken, _ = fed_one_by_one(names.tolist(), stamps_ns, poses)
    at_once, taken_at_once, _ = fed_at_once(names, stamps_ns, poses, range(7001, len(names), 7001))
    statistics = one_by_one.statistics("parent")
    assert (
        min(
            statistics.refused_late,
            statistics.dropped_unpaired,
            len(one_by_one.snapshot().kept),
        )
        > 10
    )
    assert taken_at_once == taken
    assert_same_state(at_once, one_by_one)
