"""Constants that decide the lever arm of an antenna."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hand_eye_calib.core.noise.tuning import Tuning


@dataclass(frozen=True)
class PositionTuning(Tuning):
    """Constants of the search for positions, with defaults, after those of the noise model."""

    # Largest number of rounds. A round estimates the lever arm and updates the orientations.
    rounds: int = 10
    # Rounds before which the noise levels are fitted.
    fits: tuple[int, ...] = (1, 3, 5)
    # Lower bound, start and upper bound of the log variance (rad^2) of the walk of the
    # orientations.
    rotation_walk: tuple[float, float, float] = (
        math.log(1e-12),
        math.log(1e-6),
        math.log(0.1),
    )
    # Prior standard deviations, in order: lever arm (m), scale of the odometry, direction of the
    # odometry (0.15 deg, in rad), time offset (s), response of positions to acceleration (s^2).
    of_positions: tuple[float, ...] = (
        *[10.0] * 3,
        0.01,
        *[math.radians(0.15)] * 3,
        1.0,
        0.002,
    )
    # Time (s) between the two positions from which a velocity is computed. An acceleration is the
    # difference of two velocities.
    accelerating_s: float = 0.2
    # An acceleration is not used if gaps make its time span longer than this multiple of the usual
    # span.
    longest_span_factor: float = 2.5
    # Variance of the walk at a jump, as a multiple of the variance that explains the step.
    jump_factor: float = 10.0
    # Number of neighbouring positions from which the quality of a position is measured.
    neighbours: int = 11
    # Positions are not used if their squared errors exceed this multiple of those in the best
    # quarter of the recording. Their weight would be small, and their errors are time-correlated.
    worst_error_factor: float = 16.0
    # Number of poses in a window. Each window is aligned on its own for the starting values.
    window: int = 200


TUNING = PositionTuning()
