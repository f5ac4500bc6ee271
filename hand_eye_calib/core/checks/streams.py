"""Checks of one stream's stamps and poses, and of its motion against the other stream."""

import itertools
import math
from collections.abc import Sequence

import numpy as np

from hand_eye_calib.core.assessment.common_mode import usual_speed
from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.stats import median, quantile
from hand_eye_calib.core.checks.findings import LIMITS, Finding, finding, graded
from hand_eye_calib.core.checks.sampling import check_sampling, step_velocities
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import (
    SAME_POSE,
    Trajectory,
    repetitions,
)
from hand_eye_calib.core.pairing.motion_pairs import find_leap

# A gap is longer than the option max_gap, and longer than this multiple of the median interval.
_GAP_INTERVALS = 5.0

# A step is a jump if its excess over the neighbouring steps exceeds the next two limits. First
# limit, as a multiple of the median excess.
_JUMP_EXCESSES = 12.0
# Second limit, as a multiple of the USUAL quantile of the speeds.
_JUMP_SPEEDS = 3.0

# A stream counts as flat if its tilt (root mean square, rad) is at most this angle.
_MIN_TILT_RAD = 0.02

# Shortest time (s) for which a pose must repeat before a stream counts as frozen.
_MIN_FROZEN_S = 1.0
# The motion of the other sensor is checked in parts of about this duration (s): a car may wait for
# a minute before it drives.
_PART_S = 10.0

# A sensor moves if its distance or its angle from the start of a part exceeds the next three
# limits. Measured: odometry drifts by up to 6 cm and 0.05 rad while a car waits 42 s at traffic
# lights. Limit of the distance, m.
_MOVES_M = 0.02
# Limit of the angle, rad.
_MOVES_RAD = 0.1
# Limit of the distance, as a share of the distance that the sensor usually travels in the part.
_MOVES_SHARE = 0.1

# Smallest ratio of the distance or the angle to the noise, for a sensor that moves. The noise is
# the median second difference. Measured: white noise had ratios up to 2.2 in 6,000 draws.
_MOVES_NOISES = 2.5

# If several sensors publish on one topic in turn, the positions repeat with a period (in poses).
# The roughness from pose to pose then exceeds the roughness over a period by at least this factor.
_MIN_ROUGHNESS_RATIO = 2.0
# Longest period, in poses.
_MAX_PERIOD = 6
# Smallest roughness (m) from pose to pose that is judged.
_MIN_ROUGHNESS_M = 0.01
# Largest share of repeated positions. Streams that repeat poses are rough for this other reason.
_MAX_REPEATS = 0.1
# The level of a sensor is the mean deviation of its positions from the line between the
# neighbouring positions. Number of periods in this mean.
_PERIODS_OF_LEVEL = 40
# Smallest share of the mean squared deviation that the levels must explain. The motion of a body
# that shakes or walks may have nearly the same period, but its levels vary and explain less.
_MIN_EXPLAINED_BY_LEVELS = 0.6

# Positions are rounded to a grid if most differences are multiples of the smallest difference (the
# step). Fewest differences that are judged.
_MIN_GRID = 30
# Smallest share of the differences that are multiples of the step.
_ON_GRID = 0.98
# Largest deviation from a multiple, as a share of the step.
_GRID_TOLERANCE = 0.06
# Differences above this multiple of the step are skipped.
_MAX_MULTIPLE = 200.0
# Fewest different multiples in a stream whose motion is rarely interrupted. Without rounding,
# steady motion also has equal differences.
_MIN_DIFFERENT = 5
# Smallest share of the other differences that a difference of zero follows. Rounding often
# interrupts slow motion; a vehicle that drives steadily and then parks is interrupted once.
_MIN_INTERRUPTED = 0.1

# Speed (m/s) above which lengths cannot be in metres: the speed of sound.
_FASTEST = 340.0
# Change of velocity within a second (m/s^2) that a tenth of all seconds may exceed if lengths are
# in metres: five times gravity. Recordings have at most 6. Arms have the smallest changes, 0.1; in
# millimetres they exceed the limit. Hand-held sensors exceed it in centimetres.
_HARDEST = 49.0
# If the sensors are farther apart than this (m), they are on a car or a larger machine.
_LONG_LEVER_M = 3.0
# The same limit (m/s^2) for such machines. Tyres and rails transmit about 8 m/s^2. Simulated cars
# change their velocity by up to 7.2 m/s within a second.
_HARDEST_OF_LARGE = 9.8
# Largest usual change of velocity within a second (m/s), of cars.
_MOST_USUAL = 8.0
# Smallest usual change of velocity within a second (m/s), of arms.
_LEAST_USUAL = 0.1
# Smallest usual speed (m/s) of a sensor during a calibration. Arms have 0.05.
_SLOWEST = 0.01

# Step (s) over which velocities are computed. It is long, so that noise contributes little.
_STEP_S = 1.0
# Shortest part (ns) without a fault that is worth a calibration: ten seconds.
_MIN_SOUND_NS = 10_000_000_000
# Quantile of speeds and sizes that counts as usual: up to a tenth may be jumps.
USUAL = 0.9


def coarse(trajectory: Trajectory, step_s: float) -> Trajectory:
    """Return the first pose in each interval of ``step_s`` seconds; empty intervals are skipped."""
    elapsed_ns = trajectory.stamps_ns - trajectory.stamps_ns[0]
    steps = elapsed_ns // round(step_s * 1e9)
    _, first_rows = np.unique(steps, return_index=True)
    return trajectory[first_rows]


def are_gaps(intervals_s: FloatArray, max_gap_s: float) -> BoolArray:
    """Return which of the intervals (N,) between poses, in seconds, are gaps.

    A gap is longer than ``max_gap_s``, and much longer than the median interval of the stream.
    """
    usual_s = median(intervals_s) if len(intervals_s) else 0.0
    return intervals_s > max(max_gap_s, _GAP_INTERVALS * usual_s)


def check_stream(
    trajectory: Trajectory,
    stream: str,
    max_gap_s: float = CalibratorConfig.max_gap,
) -> list[Finding]:
    """Return the findings about one stream of poses.

    Jumps and sampling are checked only if stamps and positions have no fault other than gaps.

    Parameters
    ----------
    trajectory : Trajectory
    stream : str
        "parent" or "child".
    max_gap_s : float
        Longest interval that is interpolated, s.
    """
    findings = check_positions(trajectory, stream, max_gap_s)
    if any(found.code != "gaps" for found in findings):
        return findings
    are_jumps = np.zeros(len(trajectory) - 1, dtype=bool)
    velocities = step_velocities(trajectory)
    for steps in velocities:
        usual = _JUMP_EXCESSES * (median(steps.excess) + 1e-12)
        fast = _JUMP_SPEEDS * quantile(steps.speeds, USUAL)
        are_jumps |= steps.excess > max(usual, fast)
    share = float(are_jumps.mean())
    jumps = graded(
        "jumps", stream, share, options={"method": "dnlo"}, share=share
    )
    findings += check_sampling(trajectory, velocities, stream)
    return [*findings, jumps] if jumps else findings


def check_positions(
    trajectory: Trajectory, stream: str, max_gap_s: float
) -> list[Finding]:
    """Return the findings about the stamps and the positions of one stream."""
    if len(trajectory) < 4:
        return [finding("too_few_poses", stream, poses=str(len(trajectory)))]
    if leap := find_leap(trajectory.stamps_ns):
        return [finding("leap", stream, leap=leap[0], remedy=leap[1])]
    intervals_s = np.diff(trajectory.stamps_ns) * 1e-9
    findings = []
    if (gaps := are_gaps(intervals_s, max_gap_s)).any():
        share = float(intervals_s[gaps].sum() / intervals_s.sum())
        longest_s = float(intervals_s.max())
        n_gaps = int(gaps.sum())
        findings = [
            finding(
                "gaps", stream, gaps=n_gaps, longest_s=longest_s, share=share
            )
        ]
    if apart_m := _interleaved(trajectory):
        return [*findings, finding("interleaved", stream, distance_m=apart_m)]
    step_m = max(
        _grid_step(column) for column in se3.translation_of(trajectory.poses).T
    )
    # For a stream without orientations the finding is at most a warning: its rounding acts like
    # other noise.
    largest_m = (
        np.inf if trajectory.has_rotations else LIMITS["coarse_positions"].error
    )
    rounded = graded(
        "coarse_positions", stream, min(step_m, largest_m), step_m=step_m
    )
    return [*findings, rounded] if rounded else findings


def _interleaved(trajectory: Trajectory) -> float:
    """Return the roughness (m) of positions from several sensors in turn, or 0 for one sensor.

    Several sensors on one topic publish in turn, with a period in poses. Neighbouring poses then
    differ more than poses one period apart. The levels of the sensors are constant either in the
    axes of the world or in those of the sensor.
    """
    positions = se3.translation_of(trajectory.poses)
    stamps_ns = trajectory.stamps_ns
    repeats = np.abs(np.diff(positions, axis=0)).max(axis=1) < SAME_POSE
    fewest = (_PERIODS_OF_LEVEL + 2) * _MAX_PERIOD
    if len(positions) < fewest or repeats.mean() > _MAX_REPEATS:
        return 0.0
    # Deviation of each position from the line between the positions ``lag`` poses before and after.
    deviations = []
    for lag in range(1, _MAX_PERIOD + 1):
        before = positions[: -2 * lag]
        after = positions[2 * lag :]
        elapsed = (stamps_ns[2 * lag :] - stamps_ns[: -2 * lag]).astype(float)
        share = (stamps_ns[lag:-lag] - stamps_ns[: -2 * lag]) / elapsed
        deviations.append(
            positions[lag:-lag] - before - share[:, None] * (after - before)
        )
    roughness_m = [
        median(np.linalg.norm(vectors, axis=1)) for vectors in deviations
    ]
    # Positions of several sensors are rough from pose to pose, and smooth over whole periods.
    period = 2 + int(np.argmin(roughness_m[1:]))
    if roughness_m[0] < max(
        _MIN_ROUGHNESS_RATIO * roughness_m[period - 1], _MIN_ROUGHNESS_M
    ):
        return 0.0
    in_world = deviations[0]
    in_sensor = np.einsum(
        "kji,kj->ki", trajectory.poses[1:-1, :3, :3], in_world
    )
    for vectors in (in_world, in_sensor):
        if _explained_by_levels(vectors, period) >= _MIN_EXPLAINED_BY_LEVELS:
            return roughness_m[0]
    return 0.0


def _explained_by_levels(deviations: FloatArray, period: int) -> float:
    """Return the share of the squared deviations (N, 3) that constant levels explain.

    Pose k belongs to the sensor k modulo ``period``. The level of a sensor is the mean of its
    deviations in a window of time; the result is the median over the windows.
    """
    n_windows = len(deviations) // (_PERIODS_OF_LEVEL * period)
    n_used = n_windows * _PERIODS_OF_LEVEL * period
    windows = deviations[:n_used].reshape(
        n_windows, _PERIODS_OF_LEVEL, period, 3
    )
    levels = windows.mean(axis=1)
    level_squares = (levels**2).sum(axis=-1).mean(axis=-1)
    total_squares = (windows**2).sum(axis=-1).mean(axis=(1, 2))
    return median(level_squares / np.maximum(total_squares, 1e-300))


def _grid_step(values: FloatArray) -> float:
    """Return the step (m) of the grid to which values (N,) are rounded, or 0 without a grid."""
    steps = np.abs(np.diff(values))
    is_moving = steps > SAME_POSE
    differences = steps[is_moving]
    if len(differences) < _MIN_GRID:
        return 0.0
    step = float(differences.min())
    multiples = differences / step
    n_different = len(np.unique(np.round(multiples)))
    n_interruptions = np.count_nonzero(is_moving[:-1] & ~is_moving[1:])
    is_steady = n_interruptions < _MIN_INTERRUPTED * len(differences)
    if is_steady and n_different < _MIN_DIFFERENT:
        return 0.0
    from_multiple = np.abs(multiples - np.round(multiples))
    are_small = multiples < _MAX_MULTIPLE
    are_on_grid = from_multiple[are_small] < _GRID_TOLERANCE
    is_grid = are_small.mean() > 0.5 and are_on_grid.mean() > _ON_GRID
    return step if is_grid else 0.0


def check_flat(parent: Trajectory, child: Trajectory) -> list[Finding]:
    """Return the finding that a stream has only x, y and yaw although the other tilts, or none."""
    for name, flat, other, whole in (
        ("parent", parent, "child", child),
        ("child", child, "parent", parent),
    ):
        vertical = flat.poses[:, 2, 2]
        heights = flat.poses[:, 2, 3]
        if (
            np.abs(vertical - vertical[0]).max() > SAME_POSE
            or np.ptp(heights) > SAME_POSE
        ):
            continue
        # Find the direction in the other sensor whose image in the world scatters least. Its
        # scatter measures the tilt.
        mean = whole.poses[::10, :3, :3].mean(axis=0)
        variances = np.linalg.eigvalsh(np.eye(3) - mean.T @ mean)
        tilt_rad = float(np.sqrt(max(variances[0], 0.0)))
        if tilt_rad > _MIN_TILT_RAD:
            return [
                finding(
                    "flat",
                    name,
                    other=other,
                    tilt_deg=float(np.degrees(tilt_rad)),
                )
            ]
    return []


def check_frozen(parent: Trajectory, child: Trajectory) -> list[Finding]:
    """Return the findings about a stream that repeats a pose while the other sensor moves.

    Both streams are on one clock.
    """
    first_ns = max(parent.stamps_ns[0], child.stamps_ns[0])
    last_ns = min(parent.stamps_ns[-1], child.stamps_ns[-1])
    findings = []
    for name, stream, other in (
        ("parent", parent, child),
        ("child", child, parent),
    ):
        intervals_ns = frozen_intervals(stream, other)
        if not intervals_ns:
            continue
        frozen_s = 1e-9 * sum(until - since for since, until in intervals_ns)
        share = frozen_s / max(stream.duration_s, 1e-9)
        found = graded(
            "frozen",
            name,
            share,
            share=share,
            frozen_s=frozen_s,
            longest=_longest_between(intervals_ns, first_ns, last_ns),
        )
        if found:
            findings.append(found)
    return findings


def _longest_between(
    intervals_ns: Sequence[tuple[int, int]], first_ns: int, last_ns: int
) -> str:
    """Return the advice to calibrate the longest part of a recording without frozen poses.

    ``intervals_ns`` are the frozen intervals in the order of time. The recording has poses of both
    streams from ``first_ns`` to ``last_ns``.
    """
    starts_ns = [first_ns, *(until for _, until in intervals_ns)]
    ends_ns = [*(since for since, _ in intervals_ns), last_ns]
    lengths_ns = np.subtract(ends_ns, starts_ns)
    longest = int(np.argmax(lengths_ns))
    if lengths_ns[longest] < _MIN_SOUND_NS:
        return "record again, because no part of 10 s is"
    limits = []
    if longest > 0:
        # Round inwards, so that the part contains no frozen pose.
        start_s = math.ceil((starts_ns[longest] - first_ns) * 1e-9)
        limits.append(f"start {start_s}")
    if longest < len(intervals_ns):
        end_s = math.floor((ends_ns[longest] - first_ns) * 1e-9)
        limits.append(f"end {end_s}")
    return f"calibrate with {' and '.join(limits)}, the longest part"


def frozen_intervals(
    trajectory: Trajectory, other: Trajectory
) -> list[tuple[int, int]]:
    """Return the intervals (ns) in which a stream repeats its pose while the other sensor moves.

    Parameters
    ----------
    trajectory : Trajectory
        The stream that may be frozen. Repeated poses are equal to the last digit.
    other : Trajectory
        The stream of the other sensor, on the same clock.
    """
    usual_m_s = usual_speed(other.stamps_ns, se3.translation_of(other.poses))
    intervals_ns: list[tuple[int, int]] = []
    for from_ns, until_ns in repetitions(trajectory, _MIN_FROZEN_S):
        n_parts = max(1, round((until_ns - from_ns) * 1e-9 / _PART_S))
        edges_ns = np.linspace(from_ns, until_ns, n_parts + 1).astype(np.int64)
        for first_ns, last_ns in itertools.pairwise(edges_ns.tolist()):
            is_part = (other.stamps_ns >= first_ns) & (
                other.stamps_ns <= last_ns
            )
            if _moves(other[is_part], usual_m_s):
                intervals_ns.append((first_ns, last_ns))
    return intervals_ns


def _moves(part: Trajectory, usual_m_s: float) -> bool:
    """Return whether a sensor moves in a part of its stream, by more than drift and noise."""
    if len(part) < 2:
        return False
    positions = se3.translation_of(part.poses)
    angles = se3.rotation_log(
        part.poses[0, :3, :3].T @ se3.rotation_of(part.poses)
    )
    least_m = max(_MOVES_M, _MOVES_SHARE * usual_m_s * part.duration_s)
    return _exceeds(positions - positions[0], least_m) or _exceeds(
        angles, _MOVES_RAD
    )


def _exceeds(away: FloatArray, least: float) -> bool:
    """Return whether the longest of the vectors (N, 3) exceeds ``least`` and the noise."""
    rough = np.linalg.norm(np.diff(away, 2, axis=0), axis=1)
    noise = median(rough) if len(rough) else 0.0
    largest = float(np.linalg.norm(away, axis=1).max())
    return largest > max(least, _MOVES_NOISES * noise)


def check_lengths(
    parent: Trajectory, child: Trajectory, lever_arm_m: float = 0.0
) -> list[Finding]:
    """Return the finding that the lengths are not in metres, because no vehicle moves like this.

    Two streams in millimetres agree with each other, so that only their motion reveals the unit.

    Parameters
    ----------
    parent, child : Trajectory
        Both streams. The child's lengths contain the scale factor, if it is known.
    lever_arm_m : float
        Lower limit of the distance between the sensors, m; 0 if it is unknown.
    """
    if not is_too_fast(parent, lever_arm_m):
        return []
    speed, change = _usual_motion(parent)
    unit, factor = _unit_of_motion(speed, change)
    are_both = is_too_fast(child, lever_arm_m)
    options: dict[str, float | str] = {"parent_scale": factor}
    if are_both:
        options["scale"] = factor
    # The lower limit for large machines is exceeded, and needs the lever arm as a reason.
    is_by_lever_arm = not is_too_fast(parent)
    beside = ""
    if is_by_lever_arm:
        beside = f", {lever_arm_m:.0f} m away from the child"
    condition = ""
    if " or " in unit:
        condition = "give the factor 0.01 for centimetres; for millimetres, "
    return [
        finding(
            "lengths",
            "both" if are_both else "parent",
            None,
            options,
            unit=unit,
            speed_m_s=speed,
            acceleration_m_s2=change,
            beside=beside,
            condition=condition,
        )
    ]


def _unit_of_motion(speed: float, change: float) -> tuple[str, float]:
    """Return the unit in which a motion is usual: its name and its size in metres.

    If millimetres and centimetres are both possible, the size is that of millimetres. ``speed``
    (m/s) and the change of velocity within a second are computed as if lengths were in metres.
    """
    if speed * 0.01 >= _FASTEST or change * 0.01 > _MOST_USUAL:
        return "millimetres", 0.001
    if change * 0.001 < _LEAST_USUAL:
        return "centimetres", 0.01
    return "millimetres or centimetres", 0.001


def is_too_fast(trajectory: Trajectory, lever_arm_m: float = 0.0) -> bool:
    """Return whether a motion is too fast for any vehicle, so that lengths are not in metres.

    The limit is lower for large vehicles. The distance between the sensors is a lower limit of the
    size.
    """
    speed, change = _usual_motion(trajectory)
    hardest = _HARDEST_OF_LARGE if lever_arm_m >= _LONG_LEVER_M else _HARDEST
    return speed >= _FASTEST or change >= hardest


def is_too_slow(trajectory: Trajectory) -> bool:
    """Return whether a sensor is slower than any sensor during a calibration in metres."""
    speed, _ = _usual_motion(trajectory)
    return speed < _SLOWEST


def _usual_motion(trajectory: Trajectory) -> tuple[float, float]:
    """Return the usual speed (m/s) and the usual change of velocity within a second (m/s^2).

    Nine tenths of all seconds have smaller values. Both values are zero for streams shorter than
    four seconds.
    """
    seconds = coarse(trajectory, _STEP_S)
    if len(seconds) < 4:
        return 0.0, 0.0
    intervals_s = np.diff(seconds.stamps_ns)[:, None] * 1e-9
    velocities = (
        np.diff(se3.translation_of(seconds.poses), axis=0) / intervals_s
    )
    changes = np.diff(velocities, axis=0) / (
        0.5 * (intervals_s[1:] + intervals_s[:-1])
    )
    speed = quantile(np.linalg.norm(velocities, axis=1), USUAL)
    change = quantile(np.linalg.norm(changes, axis=1), USUAL)
    return speed, change
