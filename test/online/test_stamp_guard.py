"""Which stamps start a new session, and which change nothing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_eye_calib.online.live.stamp_guard import MIN_HELD, NEAR_NS, StampGuard

START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
TEN_YEARS_NS = 10 * 365 * 86_400 * 10**9


def stamps(n, start_ns=START_NS, step_ns=STEP_NS):
    return [start_ns + k * step_ns for k in range(n)]


def run(guard, sequence, now_s=0.0, step_s=0.1):
    """Whether each message began a session, stamps taken and stamps dropped."""
    jumps = []
    taken = []
    dropped = []

    def use(judgement):
        assert all(message == str(stamp) for stamp, message in judgement.taken)
        jumps.append(judgement.jumped_back)
        taken.extend(stamp for stamp, _ in judgement.taken)
        dropped.extend(judgement.dropped)

    for stamp_ns in sequence:
        use(guard.check(stamp_ns, str(stamp_ns), now_s))
        now_s += step_s
    return jumps, taken, dropped


OVERTAKEN = stamps(40)
OVERTAKEN[25:28] = OVERTAKEN[25:28][::-1]
INTERVALS_NS = np.random.default_rng(1).exponential(1e8, 1000).astype(int)


@pytest.mark.parametrize(
    "sequence",
    [
        OVERTAKEN,
        (START_NS + np.cumsum(INTERVALS_NS)).tolist(),
        *(
            stamps(100)
            + stamps(200, START_NS + 100 * STEP_NS, round(STEP_NS * factor))
            for factor in (0.1, 0.5, 2, 10)
        ),
        stamps(10) + stamps(10, START_NS + 600 * 10**9),
        stamps(50) + stamps(50, START_NS + 50 * STEP_NS - NEAR_NS // 2),
    ],
    ids=[
        "overtaken",
        "irregular",
        "10 times",
        "twice",
        "half",
        "tenth",
        "pause",
        "back",
    ],
)
def test_nothing_is_lost_where_stamps_are_right(sequence):
    jumps, taken, dropped = run(StampGuard(), sequence)
    assert not any(jumps)
    assert (sorted(taken), dropped) == (sorted(sequence), [])


def test_a_regular_stream_does_not_wait():
    guard = StampGuard()
    run(guard, stamps(20))
    for stamp_ns in stamps(20, START_NS + 20 * STEP_NS):
        assert guard.check(stamp_ns, "", 3.0).taken == [(stamp_ns, "")]


offsets = st.one_of(
    st.integers(1, TEN_YEARS_NS),
    st.integers(0, 58).map(lambda power: min(2**power, TEN_YEARS_NS)),
    st.integers(1, 200).map(
        lambda periods: periods * STEP_NS
    ),  # onto others' places
)
corruptions = st.lists(
    st.tuples(st.integers(12, 186), offsets, st.sampled_from([-1, 1])),
    min_size=1,
    max_size=5,
    unique_by=lambda corruption: corruption[0],
)


@settings(max_examples=500, deadline=None)
@given(corruptions)
def test_corrupt_stamps_change_nothing(corrupt):
    sequence = stamps(200)
    for index, offset_ns, sign in corrupt:
        sequence[index] += sign * offset_ns
    jumps, taken, dropped = run(StampGuard(), sequence)
    assert not any(jumps)
    assert sorted(taken + dropped) == sorted(sequence)
    corrupted = {index for index, _, _ in corrupt}
    right = {
        stamp for index, stamp in enumerate(sequence) if index not in corrupted
    }
    assert right <= set(taken)


@pytest.mark.parametrize("offset_ns", [10**8, 3 * 10**9, TEN_YEARS_NS])
@pytest.mark.parametrize(("sign", "times"), [(-1, 5), (1, 1), (1, 5)])
def test_a_clock_that_is_wrong_for_up_to_five_messages_changes_nothing(
    offset_ns, sign, times
):
    sequence = stamps(60)
    for index in range(30, 30 + times):
        sequence[index] += sign * offset_ns
    jumps, taken, dropped = run(StampGuard(), sequence)
    assert not any(jumps)
    assert taken + dropped == sequence or offset_ns > NEAR_NS
    assert len(dropped) == (times if offset_ns > NEAR_NS else 0)
    assert set(stamps(60)[:30] + stamps(60)[30 + times :]) <= set(taken)


def test_corrupt_stamps_at_the_start_are_dropped():
    sequence = stamps(60)
    sequence[0] += 10**17
    sequence[2] -= 10**17
    jumps, taken, dropped = run(StampGuard(), sequence)
    assert not any(jumps)
    assert taken == stamps(60)[3:]
    assert len(dropped) == 3


def test_a_bag_that_loops_starts_over_with_every_message_of_the_new_lap():
    guard = StampGuard()
    run(guard, stamps(50))
    jumps, taken, _ = run(guard, stamps(50))
    assert jumps.count(True) == 1
    assert jumps.index(True) == MIN_HELD - 1
    assert taken == stamps(50)


class TestTheOtherStream:
    """Another stream has jumped back first."""

    @staticmethod
    def guard():
        guard = StampGuard()
        run(guard, stamps(50))
        run(guard, stamps(2))  # has begun to jump itself
        guard.restart(now_s=10.0)
        return guard

    def test_follows_without_another_new_session(self):
        jumps, taken, _ = run(self.guard(), stamps(20)[2:], now_s=10.1)
        assert not any(jumps)
        assert taken == stamps(20)

    def test_its_messages_of_the_old_lap_are_left_out(self):
        guard = self.guard()
        old = run(guard, stamps(3, START_NS + 50 * STEP_NS), now_s=10.1)
        assert old == ([False] * 3, [], [])
        assert run(guard, stamps(20)[2:], now_s=10.4)[1] == stamps(20)

    def test_goes_on_if_only_the_first_stream_had_jumped(self):
        later = stamps(20, START_NS + 50 * STEP_NS)
        jumps, taken, _ = run(self.guard(), later, now_s=20.0)
        assert not any(jumps)
        assert taken == later


def test_a_new_session_takes_any_stamp():
    guard = StampGuard()
    run(guard, stamps(5))
    guard.restart()
    assert run(guard, stamps(20, 5))[1] == stamps(20, 5)


@pytest.mark.parametrize("jump_s", [0.35, 30.0, 1000.0])
def test_the_last_message_before_a_silence_costs_no_session_if_it_is_corrupt(
    jump_s,
):
    guard = StampGuard()
    run(guard, [*stamps(50), START_NS + 49 * STEP_NS + round(jump_s * 1e9)])
    rest = stamps(50, START_NS + 51 * STEP_NS)
    jumps, taken, _ = run(guard, rest, now_s=100.0)
    assert not any(jumps)
    assert set(rest) <= set(taken)
