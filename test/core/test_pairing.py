import numpy as np
import pytest
from motions import (
    T_PARENT_CHILD,
    as_trajectory,
    child_of,
    walked,
    wandering_poses,
)
from numpy.testing import assert_allclose, assert_array_equal

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import (
    PosePairs,
    motion_pairs,
    select_keyframes,
    slower_stream,
    synchronise,
)


@pytest.mark.parametrize(
    ("reference", "n_poses", "expected"),
    [
        ("A", 4, [(0, 1), (0, 2), (0, 3)]),
        ("B1", 4, [(0, 1), (1, 2), (2, 3)]),
        ("B3", 5, [(0, 3), (1, 4)]),
        ("B3", 3, []),
        # keyframes 0 and 3 are below 7 - 3 = 4; the one at 6 is not
        ("C3", 7, [(0, 1), (0, 2), (3, 4), (3, 5)]),
        # with 6 poses the keyframe at 3 is no longer strictly below 6 - 3
        ("C3", 6, [(0, 1), (0, 2)]),
        ("C5", 5, []),
        ("A", 1, []),
        ("A", 0, []),
    ],
)
def test_references_are_those_of_the_paper(reference, n_poses, expected):
    poses = wandering_poses(10)[:n_poses]
    pairs = motion_pairs(poses, poses, reference)
    rows = zip(pairs.i.tolist(), pairs.j.tolist(), strict=True)
    assert list(rows) == expected


@pytest.mark.parametrize(
    "reference",
    ["", "D", "B0", "B", "C1", "B-1", "b1", "A1", "B01", "auto", "B1 "],
)
def test_anything_else_is_not_a_reference(reference):
    poses = wandering_poses(10)
    with pytest.raises(ConfigError, match="must be auto, A, B<n>"):
        motion_pairs(poses, poses, reference)


def test_every_motion_pair_fulfils_ax_xb():
    parent = wandering_poses(40)
    pairs = motion_pairs(parent, child_of(parent), "C10")
    assert_allclose(
        pairs.Ts_parenti_parentj @ T_PARENT_CHILD,
        T_PARENT_CHILD @ pairs.Ts_childi_childj,
        atol=1e-12,
    )
    assert parent[pairs.i] @ pairs.Ts_parenti_parentj == pytest.approx(
        parent[pairs.j], abs=1e-12
    )


def test_map_coordinates_of_a_million_metres_cost_no_digits_of_a_motion():
    near = wandering_poses(20)
    far = near.copy()
    far[:, :3, 3] += np.array([456_789.0, 4_567_890.0, 120.0])
    near_motion = motion_pairs(near, near, "B1").Ts_parenti_parentj
    assert motion_pairs(far, far, "B1").Ts_parenti_parentj == pytest.approx(
        near_motion, abs=4e-9
    )


def test_the_slower_stream_gives_the_stamps():
    slow = as_trajectory(wandering_poses(20), rate_hz=10)
    fast = as_trajectory(wandering_poses(100), rate_hz=50)
    is_inside = slow.stamps_ns <= fast.stamps_ns[-1]
    common_ns = slow.stamps_ns[is_inside]

    slow_first = synchronise(slow, fast, 0.5)
    fast_first = synchronise(fast, slow, 0.5)

    assert slower_stream(slow.stamps_ns, fast.stamps_ns) == "parent"
    assert slower_stream(fast.stamps_ns, slow.stamps_ns) == "child"
    assert slower_stream(slow.stamps_ns, slow.stamps_ns) == "child"
    assert_array_equal(slow_first.stamps_ns, common_ns)
    assert_array_equal(fast_first.stamps_ns, common_ns)
    assert_array_equal(fast_first.Ts_cw_c, slow.poses[is_inside])


def test_nothing_is_extrapolated_and_no_gap_is_bridged():
    child = as_trajectory(wandering_poses(30), rate_hz=10)
    is_recorded = np.ones(300, dtype=bool)
    is_recorded[100:170] = False  # the 0.7 s after 1.0 s
    whole_parent = as_trajectory(wandering_poses(300), rate_hz=100)
    parent = whole_parent[is_recorded].shifted(0.25)

    paired = synchronise(parent, child, max_gap_s=0.5)
    bridged = synchronise(parent, child, max_gap_s=0.8)

    seconds = (paired.stamps_ns - child.stamps_ns[0]) * 1e-9
    # the parent runs from 0.25 s to 3.24 s, with nothing between 1.24 s and 1.95 s
    before_gap_s = np.arange(0.3, 1.25, 0.1)
    after_gap_s = np.arange(2.0, 2.95, 0.1)
    expected_s = np.r_[before_gap_s, after_gap_s]
    assert_allclose(seconds, expected_s, atol=1e-9)
    assert len(bridged) == 27


class TestKeyframes:
    @staticmethod
    def straight_then_turning():
        steps = np.zeros((9, 6))
        steps[:4, 0] = 0.1
        steps[4:, 5] = 0.2
        stamps_ns = np.arange(10) * 10**8
        poses = walked(se3.exp(steps))
        return PosePairs(stamps_ns, poses, poses)

    @pytest.mark.parametrize(
        ("thresholds", "expected"),
        [
            ((0, 0, 0), list(range(10))),
            ((0.199, 0, 0), [0, 2, 4]),
            ((0, 0.399, 0), [0, 6, 8]),
            ((0, 0, 0.3), [0, 3, 6, 9]),
            ((0.199, 0.399, 0), [0, 2, 4, 6, 8]),
            ((0.199, 0.399, 0.4), [0, 4, 8]),
        ],
    )
    def test_moving_or_turning_is_enough_but_the_interval_must_pass(
        self, thresholds, expected
    ):
        assert (
            select_keyframes(self.straight_then_turning(), *thresholds).tolist()
            == expected
        )

    def test_selection_goes_on_where_it_stopped(self):
        poses = self.straight_then_turning()
        previous = poses[2:3]

        whole = select_keyframes(poses, 0.199, 0.399, 0)
        rest = select_keyframes(poses[3:], 0.199, 0.399, 0, previous=previous)

        after_stop = whole[whole > 2]
        assert_array_equal(rest + 3, after_stop)
