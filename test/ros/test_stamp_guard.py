"""Which stamps start a new session."""

import numpy as np
import pytest

from hand_eye_calib.ros.stamp_guard import BACKWARD_JUMP_NS, FORWARD_JUMP_NS, StampGuard, Verdict

START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000


def stamps(n, start_ns=START_NS):
    return [start_ns + k * STEP_NS for k in range(n)]


def run(guard, sequence, now_s=0.0):
    """Verdicts, and the stamps that came back in any."""
    verdicts, back = [], []
    for stamp_ns in sequence:
        verdict, messages = guard.check(stamp_ns, str(stamp_ns), now_s)
        assert all(message == str(stamp) for stamp, message in messages)
        verdicts.append(verdict)
        back += [stamp for stamp, _ in messages]
    return verdicts, back


def test_messages_in_order_and_late_ones_pass():
    sequence = stamps(20)
    sequence[5:8] = sequence[5:8][::-1]
    verdicts, back = run(StampGuard(), sequence)
    assert set(verdicts) == {Verdict.TAKE}
    assert back == sequence


@pytest.mark.parametrize(
    "corrupt_ns", [0, START_NS + 10**18, START_NS - 2 * BACKWARD_JUMP_NS, 2**63 - 1]
)
@pytest.mark.parametrize("times", [1, 2])
def test_a_corrupt_stamp_is_left_out_and_changes_nothing(corrupt_ns, times):
    guard = StampGuard()
    sequence = stamps(20)
    verdicts, back = run(guard, sequence[:10] + [corrupt_ns] * times + sequence[10:])
    assert Verdict.JUMPED_BACK not in verdicts
    assert back == sequence
    assert guard.discarded == times


def test_scattered_corrupt_stamps_never_confirm_each_other():
    random = np.random.default_rng(0)
    guard, sequence = StampGuard(), stamps(50)
    corrupt = [int(stamp) for stamp in random.integers(0, 2**62, 20)]
    verdicts, back = run(guard, sequence + corrupt + stamps(50, sequence[-1] + STEP_NS))
    assert Verdict.JUMPED_BACK not in verdicts
    assert back == sequence + stamps(50, sequence[-1] + STEP_NS)


def test_a_bag_that_loops_starts_over_with_every_message_of_the_new_lap():
    guard = StampGuard()
    run(guard, stamps(50))
    verdicts, back = run(guard, stamps(50))
    assert verdicts.count(Verdict.JUMPED_BACK) == 1
    assert verdicts[:3] == [Verdict.HOLD, Verdict.HOLD, Verdict.JUMPED_BACK]
    assert back == stamps(50)


def test_a_long_pause_is_no_new_session_and_loses_nothing():
    guard = StampGuard()
    sequence = stamps(10) + stamps(10, START_NS + 10 * FORWARD_JUMP_NS)
    verdicts, back = run(guard, sequence)
    assert Verdict.JUMPED_BACK not in verdicts
    assert back == sequence


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
        verdicts, back = run(self.guard(), stamps(10)[2:], now_s=10.1)
        assert Verdict.JUMPED_BACK not in verdicts
        assert back == stamps(10)

    def test_its_messages_of_the_old_lap_are_left_out(self):
        guard = self.guard()
        assert run(guard, stamps(3, START_NS + 50 * STEP_NS), now_s=10.1) == (
            [Verdict.OUTDATED] * 3,
            [],
        )
        assert run(guard, stamps(10)[2:], now_s=10.2)[1] == stamps(10)

    def test_goes_on_where_only_the_first_stream_had_jumped(self):
        later = stamps(3, START_NS + 50 * STEP_NS)
        assert run(self.guard(), later, now_s=20.0) == ([Verdict.TAKE] * 3, later)


def test_a_new_session_takes_any_stamp():
    guard = StampGuard()
    run(guard, stamps(5))
    guard.restart()
    assert run(guard, [5])[1] == [5]
