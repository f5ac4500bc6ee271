"""Checks of a single stream, and of one beside another."""

import itertools

import numpy as np

from hand_eye_calib.core.assessment.covariance import usual_speed
from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.stats import median, quantile
from hand_eye_calib.core.checks.findings import LIMITS, Finding, finding, graded
from hand_eye_calib.core.checks.sampling import check_sampling, step_excess
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory, repetitions
from hand_eye_calib.core.pairing.motion_pairs import find_leap

# An interval is a gap if it is longer than the limit and than this many median intervals.
_GAP_INTERVALS = 5.0

# A step is a jump if it differs from the steps around it by this many times the median difference,
# and by this many times a fast step.
_JUMP_SIGMAS = 12.0
_JUMP_STEPS = 3.0

# Poses, heights and verticals (m, rad) this close are the same, to rounding.
_SAME = 1e-6

# Smallest tilt of a stream that is not flat (rad).
_TILTS = 0.02

# Shortest time (s) for which a frozen stream repeats its pose, and the longest part of that time
# that is asked for motion at once: a car may stand for a minute and then drive.
_FROZEN_S = 1.0
_PART_S = 10.0

# Smallest net motion of a sensor that does not stand: in m and rad, and as a share of the usual
# speed times the duration. Odometry drifts by up to 6 cm and 0.05 rad while a car waits 42 s at
# traffic lights.
_MOVES_M = 0.02
_MOVES_RAD = 0.1
_MOVES_SHARE = 0.1

# Motion must also exceed the noise of positions and angles by this factor. Noise is the median
# second difference; of white noise the largest distance was 2.2 times that in 6,000 draws.
_MOVES_NOISES = 2.5

# Two sensors take turns if a stream is this many times rougher from pose to pose than over some
# longer lag (in poses), by at least so many metres. Repeated poses are another matter.
_ALTERNATES = 2.0
_MAX_PERIOD = 6
_LEAST_LEVELS_M = 0.01
_MAX_REPEATS = 0.1
# Their levels are steady over so many turns, in the world or in the sensor's axes, and make up this
# share of the roughness: a body that shakes, or walks, in step with the poses soon falls out of it.
_TURNS = 40
_STEADY_SHARE = 0.6

# Positions are on a grid if this share of so many differences, those of a few steps, are multiples
# of the smallest, to this share of a step.
_MIN_GRID = 30
_ON_GRID = 0.98
_GRID_TOLERANCE = 0.06
_MAX_MULTIPLE = 200.0
_MIN_DIFFERENT = 5
_MAX_MOVING = 0.9

# No vehicle that calibrates its sensors by motion goes faster than sound (m/s), or bears five times
# gravity in a tenth of all seconds (m/s^2). Recordings have 6 at most; arms, which move least, 0.1,
# and so exceed that in millimetres; what hand-held sensors have exceeds it in centimetres.
_FASTEST = 340.0
_HARDEST = 49.0
# A sensor more than 3 m from the other is on a car or a larger machine. Tyres and rails hold about
# 8 m/s^2; simulated cars change their velocity by up to 7.2 m/s within a second.
_LONG_LEVER_M = 3.0
_HARDEST_OF_LARGE = 9.8
# Usual changes of velocity within a second (m/s): cars have the largest, arms the smallest, 0.1.
_MOST_USUAL = 8.0
_LEAST_USUAL = 0.1
# Slowest usual speed (m/s) of a sensor while it is calibrated. Arms have 0.05.
_SLOWEST = 0.01

# Velocities are over so long (s), so that noise adds little. A tenth of them may be of jumps.
_STEP_S = 1.0
USUAL = 0.9


def coarse(trajectory: Trajectory, step_s: float) -> Trajectory:
    """The first pose in every step of ``step_s`` seconds that has one."""
    steps = (trajectory.stamps_ns - trajectory.stamps_ns[0]) // round(step_s * 1e9)
    return trajectory[np.unique(steps, return_index=True)[1]]


def are_gaps(intervals_s: FloatArray, max_gap_s: float) -> BoolArray:
    """Which intervals (N,) between poses, s, are gaps: longer than may be interpolated across, and
    than is usual in the stream.
    """
    usual_s = median(intervals_s) if len(intervals_s) else 0.0
    return intervals_s > max(max_gap_s, _GAP_INTERVALS * usual_s)


def check_stream(
    trajectory: Trajectory, stream: str, max_gap_s: float = CalibratorConfig.max_gap
) -> list[Finding]:
    """Findings about one stream, "parent" or "child": too short, a leap in time, gaps, jumps."""
    findings = check_positions(trajectory, stream, max_gap_s)
    if any(finding.code != "gaps" for finding in findings):
        return findings
    are_jumps = np.zeros(len(trajectory) - 1, dtype=bool)
    excesses = step_excess(trajectory)
    for excess, speed in excesses:
        of_motion = _JUMP_STEPS * quantile(speed, USUAL)
        are_jumps |= excess > max(_JUMP_SIGMAS * (median(excess) + 1e-12), of_motion)
    share = float(are_jumps.mean())
    jumps = graded("jumps", stream, share, options={"method": "dnlo"}, share=share)
    findings += check_sampling(trajectory, [excess for excess, _ in excesses], stream)
    return [*findings, jumps] if jumps else findings


def check_positions(trajectory: Trajectory, stream: str, max_gap_s: float) -> list[Finding]:
    """Findings about the stamps of one stream, and about its positions without its orientations."""
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
        findings = [finding("gaps", stream, gaps=n_gaps, longest_s=longest_s, share=share)]
    if apart_m := _interleaved(trajectory):
        return [*findings, finding("interleaved", stream, distance_m=apart_m)]
    step_m = max(_grid_step(column) for column in se3.translation_of(trajectory.poses).T)
    # Of positions alone, rounding is noise like any other.
    most = np.inf if trajectory.has_rotations else LIMITS["coarse_positions"].error
    coarse = graded("coarse_positions", stream, min(step_m, most), step_m=step_m)
    return [*findings, coarse] if coarse else findings


def _interleaved(trajectory: Trajectory) -> float:
    """Return the distance (m) of two levels between which the positions of a stream alternate.

    Two sensors on one topic take turns. Neighbouring poses then differ more than poses that are
    one period apart. The result is 0 for a stream of one sensor.
    """
    positions = se3.translation_of(trajectory.poses)
    stamps_ns = trajectory.stamps_ns
    repeats = np.abs(np.diff(positions, axis=0)).max(axis=1) < _SAME
    if len(positions) < (_TURNS + 2) * _MAX_PERIOD or repeats.mean() > _MAX_REPEATS:
        return 0.0
    # Deviations of each position from the line between the positions ``lag`` before and after.
    deviations = []
    for lag in range(1, _MAX_PERIOD + 1):
        before = positions[: -2 * lag]
        after = positions[2 * lag :]
        elapsed = (stamps_ns[2 * lag :] - stamps_ns[: -2 * lag]).astype(float)
        share = (stamps_ns[lag:-lag] - stamps_ns[: -2 * lag]) / elapsed
        deviations.append(positions[lag:-lag] - before - share[:, None] * (after - before))
    roughness_m = [median(np.linalg.norm(vectors, axis=1)) for vectors in deviations]
    # Positions that alternate are rough from pose to pose, and smooth over whole periods.
    period = 2 + int(np.argmin(roughness_m[1:]))
    if roughness_m[0] < max(_ALTERNATES * roughness_m[period - 1], _LEAST_LEVELS_M):
        return 0.0
    in_world = deviations[0]
    in_sensor = np.einsum("kji,kj->ki", trajectory.poses[1:-1, :3, :3], in_world)
    # The levels repeat with the period, in the axes of the world or in those of the sensor.
    for vectors in (in_world, in_sensor):
        n_windows = len(vectors) // (_TURNS * period)
        windows = vectors[: n_windows * _TURNS * period].reshape(n_windows, _TURNS, period, 3)
        levels = (windows.mean(axis=1) ** 2).sum(axis=-1).mean(axis=-1)
        total = (windows**2).sum(axis=-1).mean(axis=(1, 2))
        if median(levels / np.maximum(total, 1e-300)) >= _STEADY_SHARE:
            return roughness_m[0]
    return 0.0


def _grid_step(values: FloatArray) -> float:
    """Step (m) of which all differences (N - 1,) are multiples, 0 if there is none."""
    steps = np.abs(np.diff(values))
    differences = steps[steps > _SAME]
    if len(differences) < _MIN_GRID:
        return 0.0
    step = float(differences.min())
    multiples = differences / step
    # Steady motion has equal steps, too, but not many different ones.
    different = len({*np.round(multiples).tolist()})
    if different < _MIN_DIFFERENT and len(differences) > _MAX_MOVING * len(steps):
        return 0.0
    off = np.abs(multiples - np.round(multiples))
    few = multiples < _MAX_MULTIPLE
    is_grid = few.mean() > 0.5 and (off[few] < _GRID_TOLERANCE).mean() > _ON_GRID
    return step if is_grid else 0.0


def check_flat(parent: Trajectory, child: Trajectory) -> list[Finding]:
    """Finding about a stream that has only x, y and yaw while the other tilts, or none."""
    both = ("parent", parent), ("child", child)
    for (name, flat), (other, whole) in (both, both[::-1]):
        vertical = flat.poses[:, 2, 2]
        heights = flat.poses[:, 2, 3]
        if np.abs(vertical - vertical[0]).max() > _SAME or np.ptp(heights) > _SAME:
            continue
        # The direction in the other sensor whose image in the world scatters least: its axis of
        # rotation.
        mean = whole.poses[::10, :3, :3].mean(axis=0)
        tilt_rad = float(np.sqrt(max(np.linalg.eigvalsh(np.eye(3) - mean.T @ mean)[0], 0.0)))
        if tilt_rad > _TILTS:
            return [finding("flat", name, other=other, tilt_deg=float(np.degrees(tilt_rad)))]
    return []


def check_frozen(parent: Trajectory, child: Trajectory) -> list[Finding]:
    """Findings about streams that repeat their pose while the other moves, on one clock."""
    shares = {"parent": frozen_share(parent, child), "child": frozen_share(child, parent)}
    durations_s = {"parent": parent.duration_s, "child": child.duration_s}
    findings = (
        graded("frozen", name, share, share=share, frozen_s=share * durations_s[name])
        for name, share in shares.items()
    )
    return [*filter(None, findings)]


def frozen_share(trajectory: Trajectory, other: Trajectory) -> float:
    """Return the share of the time in which a stream repeats its pose while the other sensor moves.

    Parameters
    ----------
    trajectory : Trajectory
        The stream that may be frozen. Repeated poses are equal to the last digit.
    other : Trajectory
        The stream of the other sensor, on the same clock.
    """
    usual_m_s = usual_speed(other.stamps_ns, se3.translation_of(other.poses))
    frozen_ns = 0
    for from_ns, until_ns in repetitions(trajectory, _FROZEN_S):
        n_parts = max(1, round((until_ns - from_ns) * 1e-9 / _PART_S))
        edges_ns = np.linspace(from_ns, until_ns, n_parts + 1).astype(np.int64)
        for first_ns, last_ns in itertools.pairwise(edges_ns.tolist()):
            is_part = (other.stamps_ns >= first_ns) & (other.stamps_ns <= last_ns)
            if _moves(other[is_part], usual_m_s):
                frozen_ns += last_ns - first_ns
    return frozen_ns * 1e-9 / max(trajectory.duration_s, 1e-9)


def _moves(part: Trajectory, usual_m_s: float) -> bool:
    """Return whether a sensor moves in a part of its stream: drift and noise are no motion."""
    if len(part) < 2:
        return False
    positions = se3.translation_of(part.poses)
    angles = se3.rotation_log(part.poses[0, :3, :3].T @ se3.rotation_of(part.poses))
    least_m = max(_MOVES_M, _MOVES_SHARE * usual_m_s * part.duration_s)
    return _exceeds(positions - positions[0], least_m) or _exceeds(angles, _MOVES_RAD)


def _exceeds(away: FloatArray, least: float) -> bool:
    """Return whether vectors (N, 3) from the start become longer than ``least`` and their noise."""
    rough = np.linalg.norm(np.diff(away, 2, axis=0), axis=1)
    noise = median(rough) if len(rough) else 0.0
    largest = float(np.linalg.norm(away, axis=1).max())
    return largest > max(least, _MOVES_NOISES * noise)


def check_lengths(parent: Trajectory, child: Trajectory, lever_arm_m: float = 0.0) -> list[Finding]:
    """Return a finding about motion that no vehicle has: two streams in millimetres agree, and only
    their motion shows it.

    Parameters
    ----------
    parent, child : Trajectory
        On one scale, if it is known.
    lever_arm_m : float
        Distance of the sensors, at least; 0 if it is not known.
    """
    if not is_too_fast(parent, lever_arm_m):
        return []
    speed, change = _usual_motion(parent)
    unit, factor = _unit_of_motion(speed, change)
    are_both = is_too_fast(child, lever_arm_m)
    options: dict[str, float | str] = {"parent_scale": factor}
    if are_both:
        options["scale"] = factor
    is_clear = " or " not in unit
    is_by_lever_arm = not is_too_fast(parent)
    return [
        finding(
            "lengths",
            "both" if are_both else "parent",
            None,
            options,
            unit=unit,
            speed_m_s=speed,
            acceleration_m_s2=change,
            beside=f", {lever_arm_m:.0f} m away from the child" if is_by_lever_arm else "",
            condition="" if is_clear else "0.01 is for centimetres; if they are millimetres, ",
        )
    ]


def _unit_of_motion(speed: float, change: float) -> tuple[str, float]:
    """Return the unit in words, and its size (m), in which a speed and the change of velocity
    within a second are usual; millimetres where centimetres are possible as well.
    """
    if speed * 0.01 >= _FASTEST or change * 0.01 > _MOST_USUAL:
        return "millimetres", 0.001
    if change * 0.001 < _LEAST_USUAL:
        return "centimetres", 0.01
    return "millimetres or centimetres", 0.001


def is_too_fast(trajectory: Trajectory, lever_arm_m: float = 0.0) -> bool:
    """Whether no vehicle moves like this, so that the lengths are not in metres. The distance to
    the other sensor shows the least size of the vehicle.
    """
    speed, change = _usual_motion(trajectory)
    hardest = _HARDEST_OF_LARGE if lever_arm_m >= _LONG_LEVER_M else _HARDEST
    return speed >= _FASTEST or change >= hardest


def is_too_slow(trajectory: Trajectory) -> bool:
    """Whether hardly any sensor moves so slowly while it is calibrated by its motion."""
    speed, _ = _usual_motion(trajectory)
    return speed < _SLOWEST


def _usual_motion(trajectory: Trajectory) -> tuple[float, float]:
    """Return the speed (m/s) and the change of velocity (m/s^2) that nine tenths of all seconds do
    not exceed; zeros for fewer than four seconds.
    """
    few = coarse(trajectory, _STEP_S)
    if len(few) < 4:
        return 0.0, 0.0
    intervals_s = np.diff(few.stamps_ns)[:, None] * 1e-9
    velocities = np.diff(se3.translation_of(few.poses), axis=0) / intervals_s
    changes = np.diff(velocities, axis=0) / (0.5 * (intervals_s[1:] + intervals_s[:-1]))
    speed = quantile(np.linalg.norm(velocities, axis=1), USUAL)
    change = quantile(np.linalg.norm(changes, axis=1), USUAL)
    return speed, change
