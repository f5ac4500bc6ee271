"""Detect streams whose poses, or whose stamps, are not those of measurements.

- Interpolated positions lie on straight lines between a few measured positions.
- Propagated poses follow a prediction (by an IMU, for example), and jump back at each measurement.
- Stamps of arrival scatter: poses that waited in a queue have nearly equal stamps.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.assessment.common_mode import usual_speed
from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.checks.findings import Finding, finding, graded
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory

# Positions are interpolated if more than this share of them lies on the line through both
# neighbours. Measured: at most 0.22 in 33 real recordings without this fault.
_STRAIGHT_SHARE = 0.5
# Largest distance (m) of a position from this line. Measured positions scatter more, even for a car
# on a motorway.
_MAX_STRAIGHT_M = 1e-5
# A shorter step (m) has no reliable direction; positions beside such a step are skipped.
_MIN_STEP_M = 1e-3
# Fewest positions with motion, below which a stream is not checked.
_MIN_MOVING = 12
# An angular velocity is constant if its change from step to step is below the sum of the next two
# terms. Change by rounding of the poses, rad/s.
_ROUNDING_RAD_S = 1e-6
# Change as a share of the angular velocity.
_STEADY_SHARE = 1e-3

# A step is a correction if its excess exceeds one of these multiples of the median excess. With
# strong motion between corrections the excess is larger, and only a larger multiple separates the
# corrections.
_CORRECTIONS = (6.0, 12.0, 24.0)
# Fewest corrections, below which a stream is not checked.
_MIN_CORRECTIONS = 20
# Smallest interval between corrections, as a multiple of the interval between poses.
_MIN_INTERVAL = 2.5
# Corrections are regular if more than this share of their intervals equals the median interval.
# Measured: at most 0.33 in 33 real recordings without this fault.
_REGULAR_SHARE = 0.6
# Two intervals are equal if their difference is below this multiple of the interval between poses.
_REGULAR_POSES = 1.2
# The corrections must extend over more than this share of the recording. Measured: in a real
# recording, jumps that are regular by chance extend over a share of 0.06.
_MIN_DURATION_SHARE = 0.5

# A pose waited in a queue if its interval is below this share of the median interval.
_QUEUED_INTERVAL = 0.25
# Smallest share of queued poses. Real recordings with stamps of measurement have no queued poses.
_QUEUED_SHARE = 0.03
# The error of a stamp is its deviation from the median of this number of neighbouring stamps.
_WINDOW_POSES = 21


class StepVelocities(NamedTuple):
    """Velocities of the steps from pose to pose, linear (m/s) or angular (rad/s).

    Attributes
    ----------
    values : (N - 1, 3) array
        Mean velocity of each step, in the axes of the sensor at the first pose of the step.
    excess : (N - 1,) array
        Distance (m/s or rad/s) of each velocity from the median of five velocities: its own, two
        before and two after. It is large at jumps.
    """

    values: FloatArray
    excess: FloatArray

    @property
    def speeds(self) -> FloatArray:
        """Magnitudes (N - 1,) of the velocities."""
        return np.linalg.norm(self.values, axis=1)


def step_velocities(
    trajectory: Trajectory,
) -> tuple[StepVelocities, StepVelocities]:
    """Compute the linear (m/s) and the angular (rad/s) velocities of the steps of a stream."""
    seconds = np.diff(trajectory.stamps_ns)[:, None] * 1e-9
    rotations = se3.rotation_of(trajectory.poses)
    displacements = np.diff(se3.translation_of(trajectory.poses), axis=0)
    # R' d for each step: its displacement d in the axes of the sensor, whose orientation is R.
    linear = np.einsum("kji,kj->ki", rotations[:-1], displacements) / seconds
    angular = se3.rotations_between(rotations[:-1], rotations[1:]) / seconds
    return StepVelocities(linear, _excess(linear)), StepVelocities(
        angular, _excess(angular)
    )


def _excess(velocities: FloatArray) -> FloatArray:
    """Return the distance (N,) of each velocity (N, 3) from the median of the five around it."""
    # Extend both ends by their mirror image.
    padded = np.concatenate(
        [velocities[2:0:-1], velocities, velocities[-2:-4:-1]]
    )
    shifted = [padded[shift : shift + len(velocities)] for shift in range(5)]
    medians = np.partition(shifted, 2, axis=0)[2]
    excesses = np.linalg.norm(velocities - medians, axis=1)
    return excesses


def check_sampling(
    trajectory: Trajectory, velocities: Sequence[StepVelocities], stream: str
) -> list[Finding]:
    """Return the findings about interpolated or propagated poses, and about stamps of arrival.

    Parameters
    ----------
    trajectory : Trajectory
        A stream of poses.
    velocities : two StepVelocities
        Linear and angular velocities of the stream, see :func:`step_velocities`.
    stream : str
        "parent" or "child".
    """
    _, angular = velocities
    findings = (
        _find_interpolation(trajectory, angular.values, stream),
        _find_propagation(trajectory, velocities, stream),
        _find_arrival(trajectory, stream),
    )
    return [found for found in findings if found]


def check_interpolated(positions: FloatArray, stream: str) -> list[Finding]:
    """Detect positions (N, 3) in metres that were interpolated between measured positions."""
    no_positions = np.zeros(len(positions) - 2, dtype=bool)
    share, _ = _straight_share(positions, no_positions)
    if share <= _STRAIGHT_SHARE:
        return []
    return [finding("interpolated", stream, share=share)]


def _straight_share(
    positions: FloatArray, is_steady: BoolArray
) -> tuple[float, BoolArray]:
    """Return the share of positions on straight lines, and a mask (N - 2,) of measured positions.

    Only inner positions (N - 2,) with motion are considered. A measured position is not on the line
    through both neighbours. Positions with ``is_steady`` (N - 2,) do not count in the share.
    """
    steps = np.diff(positions, axis=0)
    lengths_m = np.linalg.norm(steps, axis=1)
    is_moving = np.minimum(lengths_m[1:], lengths_m[:-1]) > _MIN_STEP_M
    if is_moving.sum() < _MIN_MOVING:
        return 0.0, np.zeros(len(is_moving), dtype=bool)
    # Distance of each position from the line through both neighbours: the height of a triangle,
    # which is twice its area divided by its base.
    chords = steps[1:] + steps[:-1]
    areas = np.linalg.norm(se3.cross(steps[:-1], chords), axis=1)
    distances_m = areas / np.maximum(np.linalg.norm(chords, axis=1), 1e-12)
    is_straight = distances_m < _MAX_STRAIGHT_M
    share = float((is_straight & ~is_steady)[is_moving].mean())
    return share, is_moving & ~is_straight


def _find_interpolation(
    trajectory: Trajectory, rates_rad_s: FloatArray, stream: str
) -> Finding | None:
    """Return the finding about interpolated positions with measured orientations, or None.

    If orientations were interpolated as well, the rates (N - 1, 3) between measured poses are
    constant. Such poses are consistent, and not a fault.
    """
    changes_rad_s = np.linalg.norm(np.diff(rates_rad_s, axis=0), axis=1)
    limits_rad_s = _ROUNDING_RAD_S + _STEADY_SHARE * np.linalg.norm(
        rates_rad_s[1:], axis=1
    )
    positions = se3.translation_of(trajectory.poses)
    share, are_measured = _straight_share(
        positions, changes_rad_s < limits_rad_s
    )
    if share <= _STRAIGHT_SHARE or not are_measured.any():
        return None
    # The velocity changes at measured positions. Between two of them the true path is an arc. Its
    # largest distance from the straight line is (change of velocity) * interval / 8.
    seconds = np.diff(trajectory.stamps_ns)[:, None] * 1e-9
    changes = np.linalg.norm(
        np.diff(np.diff(positions, axis=0) / seconds, axis=0), axis=1
    )
    interval_s = trajectory.interval_s / (1.0 - share)
    displaced_m = median(changes[are_measured]) * interval_s / 8.0
    return graded(
        "interpolated",
        stream,
        displaced_m,
        share=share,
        displaced_m=displaced_m,
    )


def _find_propagation(
    trajectory: Trajectory, velocities: Sequence[StepVelocities], stream: str
) -> Finding | None:
    """Return the finding about predicted poses that jump at regular corrections, or None."""
    elapsed_ns = trajectory.stamps_ns[1:] - trajectory.stamps_ns[0]
    stamps_s: FloatArray = elapsed_ns * 1e-9
    steps_s = np.diff(trajectory.stamps_ns) * 1e-9
    for _, excess in velocities:
        for factor in _CORRECTIONS:
            is_correction = excess > factor * median(excess) + 1e-9
            interval_s = _regular_interval(stamps_s[is_correction], trajectory)
            if not interval_s:
                continue
            # Sizes are in m or rad. A rotation by 1 rad moves a point 1 m from the sensor by 1 m,
            # so both have equal limits.
            size = median(excess[is_correction] * steps_s[is_correction])
            propagated = graded(
                "propagated", stream, size, size_m=size, interval_s=interval_s
            )
            if propagated:
                return propagated
    return None


def _regular_interval(stamps_s: FloatArray, trajectory: Trajectory) -> float:
    """Return the median interval (s) of corrections at stamps (N,), or 0 if irregular."""
    if len(stamps_s) < _MIN_CORRECTIONS:
        return 0.0
    step_s = trajectory.interval_s
    intervals_s = np.diff(stamps_s)
    usual_s = median(intervals_s)
    are_usual = np.abs(intervals_s - usual_s) < _REGULAR_POSES * step_s
    # An estimator corrects its poses during the whole recording. Regular jumps within a few seconds
    # are noise.
    is_long = (
        len(stamps_s) * usual_s > _MIN_DURATION_SHARE * trajectory.duration_s
    )
    is_regular = (
        usual_s > _MIN_INTERVAL * step_s and are_usual.mean() > _REGULAR_SHARE
    )
    return usual_s if is_long and is_regular else 0.0


def _find_arrival(trajectory: Trajectory, stream: str) -> Finding | None:
    """Return the finding about stamps that are times of arrival, or None."""
    stamps_s = (trajectory.stamps_ns - trajectory.stamps_ns[0]) * 1e-9
    intervals_s = np.diff(stamps_s)
    share = float((intervals_s < _QUEUED_INTERVAL * median(intervals_s)).mean())
    if share < _QUEUED_SHARE or len(stamps_s) < 2 * _WINDOW_POSES:
        return None
    # Delay of each stamp against a clock with equal intervals. Its scatter is relative to the
    # median delay of the neighbouring stamps.
    late_s = stamps_s - np.linspace(0.0, stamps_s[-1], len(stamps_s))
    windows = np.lib.stride_tricks.sliding_window_view(late_s, _WINDOW_POSES)
    half = _WINDOW_POSES // 2
    scatter_s = median(np.abs(late_s[half:-half] - np.median(windows, axis=1)))
    shift_m = scatter_s * usual_speed(
        trajectory.stamps_ns, se3.translation_of(trajectory.poses)
    )
    return graded(
        "arrival",
        stream,
        shift_m,
        share=share,
        scatter_ms=1e3 * scatter_s,
        shift_m=shift_m,
    )
