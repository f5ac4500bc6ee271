"""The mount monitor: quiet without a shift, quick with one, and honest about what it cannot see."""

import numpy as np
import pytest
from scipy.signal import lfilter

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.extras.mount.monitor import TUNING, MountMonitor

X = se3.exp(np.array([0.4, -0.3, 0.2, 1.1, -0.7, 0.5]))
EXACT = np.zeros((6, 6))
SECOND_NS = 1_000_000_000


def motion(
    duration_s,
    seed=0,
    flat=False,
    sigma=(0.003, 0.002),
    start_s=0.0,
    rate_hz=10.0,
):
    """Pose pairs with white errors, that turn about all axes or about z only."""
    n_poses = round(duration_s * rate_hz)
    s = start_s + np.arange(n_poses) / rate_hz
    phases = np.outer(s, [0.7, 0.9, 0.4]) + np.array([0.0, 1.0, 0.0])
    amplitudes = [0.0, 0.0, 0.8] if flat else [0.5, 0.4, 0.8]
    rotations = se3.rotation_exp(np.sin(phases) * amplitudes)
    y = 2.0 * np.sin(0.5 * s)
    z = np.zeros(n_poses)
    positions = np.stack([s, y, z], axis=1)
    Ts = se3.from_rotation_translation(rotations, positions)
    return measured_pairs(s, Ts, sigma, seed)


def measured_pairs(times_s, Ts, sigma, seed):
    """Pose pairs of both sensors at true poses of the parent, with white errors (m, rad)."""
    standard = np.random.default_rng(seed).normal(size=(2, len(times_s), 6))
    parent_errors, child_errors = standard * np.repeat(sigma, 3)
    stamps_ns = (times_s * SECOND_NS).astype(np.int64)
    parent = Ts @ se3.exp(parent_errors)
    child = Ts @ X @ se3.exp(child_errors)
    return PosePairs(stamps_ns, parent, child)


def shifted(pairs, from_s, axis, size):
    """The child knocked at a time, along or about an axis of the parent."""
    in_parent = np.zeros(6)
    in_parent[axis] = size
    to_child = np.kron(np.eye(2), X[:3, :3].T)
    shift = se3.exp(to_child @ in_parent)
    child = pairs.Ts_cw_c.copy()
    is_after = pairs.stamps_ns >= from_s * SECOND_NS
    child[is_after] = child[is_after] @ shift
    return PosePairs(pairs.stamps_ns, pairs.Ts_pw_p, child)


def fed(pairs, covariance=EXACT, T=X, chunk=370):
    monitor = MountMonitor(T, covariance)
    alarms = [
        monitor.add(pairs[first : first + chunk])
        for first in range(0, len(pairs), chunk)
    ]
    return monitor, [alarm for alarm in alarms if alarm is not None]


def test_a_mount_that_stays_raises_no_alarm():
    monitor, alarms = fed(motion(1500.0))
    assert (alarms, monitor.alarm) == ([], None)
    assert monitor.seconds == pytest.approx(1500, abs=3)
    assert 1.0 < monitor.long_run < 20.0


def test_the_size_of_the_chunks_changes_nothing():
    pairs = shifted(motion(300.0), 200.0, 5, np.radians(0.5))
    (first,) = fed(pairs, chunk=7)[1]
    (other,) = fed(pairs, chunk=600)[1]
    assert first.shift == other.shift
    assert first.raised_ns == other.raised_ns


@pytest.mark.parametrize(
    ("axis", "size"), [(0, 0.03), (2, -0.03), (4, 0.02), (5, -0.02)]
)
def test_a_shift_is_found_with_its_axis_size_and_time(axis, size):
    monitor, alarms = fed(shifted(motion(400.0), 250.0, axis, size))

    assert len(alarms) == 1
    assert 250.0 <= alarms[0].raised_ns / SECOND_NS < 300.0
    since_s = monitor.alarm.since_ns / SECOND_NS
    assert abs(since_s - 250.0) < 30.0
    axes = monitor.alarm.shift.axes.values()
    values = np.array([axis_shift.difference for axis_shift in axes])
    sigmas = np.array([axis_shift.sigma for axis_shift in axes])
    expected = np.zeros(6)
    expected[axis] = size
    assert np.abs((values - expected) / sigmas).max() < 4.0
    assert np.argmax(np.abs(values) / sigmas) == axis


def test_a_shift_that_was_there_from_the_beginning_is_found_after_learning():
    pairs = shifted(motion(400.0), 0.0, 5, np.radians(2.0))
    _, alarms = fed(pairs)
    (alarm,) = alarms
    raised_s = alarm.raised_ns / SECOND_NS
    assert raised_s == pytest.approx(TUNING.learning_s, abs=10)


def test_what_is_installed_may_be_off_by_its_own_standard_deviation():
    variances = np.full(6, 0.02) ** 2
    error = se3.exp(np.array([0.02, -0.01, 0.015, 0.02, -0.03, 0.01]))
    installed = X @ error

    _, alarms_of_stated = fed(motion(600.0), np.diag(variances), installed)
    _, alarms_of_exact = fed(motion(600.0), EXACT, installed)

    assert alarms_of_stated == []
    assert len(alarms_of_exact) == 1


def test_what_cannot_be_seen_is_said_before():
    level = fed(motion(400.0, flat=True))[0].visible(600.0)
    assert level[2] > 0.5
    assert (level[:2] < 0.15).all()
    assert np.isinf(MountMonitor(X, EXACT).visible(600.0)).all()


def test_standing_still_and_gaps_add_nothing():
    pairs = motion(200.0)
    errors = np.random.default_rng(1).normal(size=(2, 20_000, 6)) * np.repeat(
        [0.003, 0.002], 3
    )
    still = PosePairs(
        pairs.stamps_ns[-1] + SECOND_NS + np.arange(20_000) * 100_000_000,
        pairs.Ts_pw_p[-1] @ se3.exp(errors[0]),
        pairs.Ts_cw_c[-1] @ se3.exp(errors[1]),
    )
    monitor, _ = fed(pairs)
    before = monitor.seconds
    for first in range(0, len(still), 500):
        monitor.add(still[first : first + 500])
    assert monitor.seconds <= before + 3
    # The worlds may be others after a gap.
    world = se3.exp(np.array([5.0, 2.0, 1.0, 0.3, 0.2, 1.0]))
    later = motion(200.0, 2, start_s=5000.0)
    monitor.add(
        PosePairs(later.stamps_ns, world @ later.Ts_pw_p, later.Ts_cw_c)
    )
    assert monitor.alarm is None
    # A clock that was reset.
    before = monitor.seconds
    monitor.restart()
    monitor.add(motion(50.0, 3))
    assert monitor.seconds >= before + 45


def test_a_jump_of_one_trajectory_is_no_shift():
    pairs = motion(600.0)
    child = pairs.Ts_cw_c.copy()
    for row, jump_m in ((3000, 0.3), (4000, -0.5), (4500, 0.2)):
        jump = se3.exp(np.array([jump_m, 0.1, 0, 0, 0, jump_m / 5]))
        child[row:] = jump @ child[row:]

    _, alarms = fed(PosePairs(pairs.stamps_ns, pairs.Ts_pw_p, child))

    assert alarms == []


def car(duration_s, seed=0):
    """Wide curves to both sides at 8 m/s."""
    n_poses = round(duration_s * 10)
    s = np.arange(n_poses) / 10
    zero = np.zeros(n_poses)
    yaw_rate = 0.4 * np.sin(0.05 * s) ** 3
    yaw = 0.1 * np.cumsum(yaw_rate)
    directions = np.stack([np.cos(yaw), np.sin(yaw), zero], axis=1)
    positions = 0.8 * np.cumsum(directions, axis=0)
    rotations = se3.rotation_exp(np.stack([zero, zero, yaw], axis=1))
    Ts = se3.from_rotation_translation(rotations, positions)
    return measured_pairs(s, Ts, (3e-3, 5e-4), seed)


def scale_drifting(pairs, sigma=0.01, tau_s=40.0, seed=0):
    """The child's path with a scale that drifts, as that of visual odometry."""
    random = np.random.default_rng(seed)
    kept = np.exp(-0.1 / tau_s)
    innovation_sigma = sigma * np.sqrt(1 - kept**2)
    innovations = innovation_sigma * random.normal(size=len(pairs))
    scale = 1.0 + lfilter([1.0], [1.0, -kept], innovations)
    child = pairs.Ts_cw_c.copy()
    start = child[0, :3, 3]
    steps = np.diff(child[:, :3, 3], axis=0)
    path = np.cumsum(steps * scale[1:, None], axis=0)
    child[1:, :3, 3] = start + path
    return PosePairs(pairs.stamps_ns, pairs.Ts_pw_p, child)


def test_a_scale_that_drifts_is_no_shift_and_hides_none():
    sound = scale_drifting(car(900.0))
    moved = scale_drifting(shifted(car(400.0), 250.0, 5, np.radians(1.0)))

    _, alarms_of_sound = fed(sound)
    _, alarms_of_moved = fed(moved)

    assert alarms_of_sound == []
    (alarm,) = alarms_of_moved
    raised_s = alarm.raised_ns / SECOND_NS
    assert raised_s == pytest.approx(250, abs=30)


def test_memory_stays_constant():
    monitor, _ = fed(motion(TUNING.memory_s + 200.0, rate_hz=4.0), chunk=400)
    assert len(monitor._seconds.sums) == TUNING.memory_s
    assert len(monitor._tail) < 20
