"""Checks of how the poses of one stream came about: between which measurements, and when.

- Interpolated positions lie on straight lines between few measured positions.
- Propagated poses follow a prediction, and jump back at each measurement.
- Stamps of arrival scatter: poses that waited in a queue have nearly equal stamps.
"""

from collections.abc import Sequence

import numpy as np

from hand_eye_calib.core.assessment.covariance import usual_speed
from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.checks.findings import Finding, finding, graded
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory

# Positions are interpolated if more than this share lies on the line through both neighbours: 0.22
# at most in 33 real recordings without this fault.
_STRAIGHT_SHARE = 0.5
# Largest distance from that line (m). Recorded positions scatter more, also on a motorway.
_STRAIGHT_M = 1e-5
# Shortest step that has a direction (m).
_MOVES_M = 1e-3
# Fewest moving positions that are judged.
_MIN_MOVING = 12
# Rotation rates (rad/s) this close, to rounding and to this share, are constant.
_STEADY_RAD_S = 1e-6
_STEADY_SHARE = 1e-3

# A step is a correction if it differs from the steps around it by this many times the median
# difference. The corrections of strong motion only exceed the larger numbers.
_CORRECTIONS = (6.0, 12.0, 24.0)
# Fewest corrections that are judged.
_MIN_CORRECTIONS = 20
# Smallest interval between corrections, in poses.
_MIN_INTERVAL = 2.5
# Corrections are regular if this share of their intervals is the median interval, to 1.2 poses:
# 0.33 at most in 33 real recordings without this fault.
_REGULAR_SHARE = 0.6
_REGULAR_POSES = 1.2
# Smallest share of the recording that the corrections make up. Jumps of the real recordings that
# are regular by chance make up 0.06.
_LASTING_SHARE = 0.5

# A pose waited in a queue if its interval is below this share of the median interval.
_QUICK = 0.25
# Smallest share of such poses. Real recordings with stamps of measurement have none.
_QUICK_SHARE = 0.03
# Number of poses of the local line through the stamps.
_LINE_POSES = 21


def check_sampling(
    trajectory: Trajectory, excesses: Sequence[FloatArray], stream: str
) -> list[Finding]:
    """Return the findings about interpolated or propagated poses, and about stamps of arrival.

    Parameters
    ----------
    trajectory : Trajectory
        A stream of poses.
    excesses : sequence of (N - 1,) arrays
        Distance of each step from the steps around it, see :func:`step_excess`.
    stream : str
        "parent" or "child".
    """
    findings = (
        _interpolated(trajectory, stream),
        _propagated(trajectory, excesses, stream),
        _arrival(trajectory, stream),
    )
    return [found for found in findings if found]


def check_interpolated(positions: FloatArray, stream: str) -> list[Finding]:
    """Detect positions (N, 3) that were interpolated between few measured positions."""
    share, _ = _straight(positions, np.zeros(len(positions) - 2, dtype=bool))
    return [finding("interpolated", stream, share=share)] if share > _STRAIGHT_SHARE else []


def _straight(positions: FloatArray, is_steady: BoolArray) -> tuple[float, BoolArray]:
    """Return the share of positions on lines, and which inner positions (N - 2,) are not on lines.

    Positions that do not move are not judged. Positions that are ``is_steady`` (N - 2,) do not
    count as positions on a line.
    """
    steps = np.diff(positions, axis=0)
    lengths_m = np.linalg.norm(steps, axis=1)
    is_moving = np.minimum(lengths_m[1:], lengths_m[:-1]) > _MOVES_M
    if is_moving.sum() < _MIN_MOVING:
        return 0.0, np.zeros(len(is_moving), dtype=bool)
    # Distance of each position from the line through its two neighbours.
    chords = steps[1:] + steps[:-1]
    areas = np.linalg.norm(se3.cross(steps[:-1], chords), axis=1)
    distances_m = areas / np.maximum(np.linalg.norm(chords, axis=1), 1e-12)
    is_straight = distances_m < _STRAIGHT_M
    share = float((is_straight & ~is_steady)[is_moving].mean())
    return share, is_moving & ~is_straight


def _interpolated(trajectory: Trajectory, stream: str) -> Finding | None:
    """Return the finding about interpolated positions beside measured orientations, or None.

    Whole poses that were interpolated have constant rotation rates as well: they are consistent.
    """
    seconds = np.diff(trajectory.stamps_ns)[:, None] * 1e-9
    rates = _turns(trajectory) / seconds
    change = np.linalg.norm(np.diff(rates, axis=0), axis=1)
    is_steady = change < _STEADY_RAD_S + _STEADY_SHARE * np.linalg.norm(rates[1:], axis=1)
    positions = se3.translation_of(trajectory.poses)
    share, are_measured = _straight(positions, is_steady)
    if share <= _STRAIGHT_SHARE or not are_measured.any():
        return None
    # The velocity changes at the measured positions. The arc between them is off the chord by an
    # eighth of this change times their interval.
    changes = np.linalg.norm(np.diff(np.diff(positions, axis=0) / seconds, axis=0), axis=1)
    interval_s = trajectory.interval_s / (1.0 - share)
    displaced_m = median(changes[are_measured]) * interval_s / 8.0
    return graded("interpolated", stream, displaced_m, share=share, displaced_m=displaced_m)


def _turns(trajectory: Trajectory) -> FloatArray:
    """Return the rotation vectors (N - 1, 3) from pose to pose."""
    rotations = se3.rotation_of(trajectory.poses)
    return se3.rotations_between(rotations[:-1], rotations[1:])


def step_excess(trajectory: Trajectory) -> tuple[tuple[FloatArray, FloatArray], ...]:
    """Compare the velocity of each step with the steps around it, for positions and rotations.

    Returns
    -------
    two pairs of (N - 1,) arrays
        Distance from the median of five velocities, and speed: in m/s and in rad/s.
    """
    seconds = np.diff(trajectory.stamps_ns)[:, None] * 1e-9
    rotations = se3.rotation_of(trajectory.poses)
    displacements = np.diff(se3.translation_of(trajectory.poses), axis=0)
    translations = np.einsum("kji,kj->ki", rotations[:-1], displacements)
    turns = _turns(trajectory)
    return tuple(_excess(steps / seconds) for steps in (translations, turns))


def _excess(velocities: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the distance of velocities (N, 3) from the median of five, and their size, (N,)."""
    padded = np.concatenate([velocities[2:0:-1], velocities, velocities[-2:-4:-1]])
    shifted = [padded[shift : shift + len(velocities)] for shift in range(5)]
    around = np.partition(shifted, 2, axis=0)[2]
    return np.linalg.norm(velocities - around, axis=1), np.linalg.norm(velocities, axis=1)


def _propagated(
    trajectory: Trajectory, excesses: Sequence[FloatArray], stream: str
) -> Finding | None:
    """Return the finding about poses that jump back at regular corrections, or None."""
    stamps_s: FloatArray = (trajectory.stamps_ns[1:] - trajectory.stamps_ns[0]) * 1e-9
    steps_s = np.diff(trajectory.stamps_ns) * 1e-9
    for excess in excesses:
        for factor in _CORRECTIONS:
            at = np.flatnonzero(excess > factor * median(excess) + 1e-9)
            interval_s = _regular_interval(stamps_s[at], trajectory)
            if not interval_s:
                continue
            # A rotation moves a place 1 m from the sensor by as many metres as it has radians.
            size = median(excess[at] * steps_s[at])
            propagated = graded("propagated", stream, size, size_m=size, interval_s=interval_s)
            if propagated:
                return propagated
    return None


def _regular_interval(stamps_s: FloatArray, trajectory: Trajectory) -> float:
    """Return the interval (s) of corrections at stamps (N,), or 0 if they are not regular."""
    if len(stamps_s) < _MIN_CORRECTIONS:
        return 0.0
    step_s = trajectory.interval_s
    intervals_s = np.diff(stamps_s)
    usual_s = median(intervals_s)
    are_usual = np.abs(intervals_s - usual_s) < _REGULAR_POSES * step_s
    # Corrections that last as long as the recording are those of an estimator. A few seconds of
    # regular jumps are noise.
    are_lasting = len(stamps_s) * usual_s > _LASTING_SHARE * trajectory.duration_s
    is_regular = usual_s > _MIN_INTERVAL * step_s and are_usual.mean() > _REGULAR_SHARE
    return usual_s if are_lasting and is_regular else 0.0


def _arrival(trajectory: Trajectory, stream: str) -> Finding | None:
    """Return the finding about stamps of the arrival of poses, or None."""
    stamps_s = (trajectory.stamps_ns - trajectory.stamps_ns[0]) * 1e-9
    intervals_s = np.diff(stamps_s)
    share = float((intervals_s < _QUICK * median(intervals_s)).mean())
    if share < _QUICK_SHARE or len(stamps_s) < 2 * _LINE_POSES:
        return None
    # Distance of each stamp from the middle of the stamps around it, on an even clock.
    late_s = stamps_s - np.linspace(0.0, stamps_s[-1], len(stamps_s))
    windows = np.lib.stride_tricks.sliding_window_view(late_s, _LINE_POSES)
    half = _LINE_POSES // 2
    scatter_s = median(np.abs(late_s[half:-half] - np.median(windows, axis=1)))
    shift_m = scatter_s * usual_speed(trajectory.stamps_ns, se3.translation_of(trajectory.poses))
    return graded(
        "arrival", stream, shift_m, share=share, scatter_ms=1e3 * scatter_s, shift_m=shift_m
    )
