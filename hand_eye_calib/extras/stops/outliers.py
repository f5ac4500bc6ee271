"""Report stops that are clearly outliers of the fit."""

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.text import listing
from hand_eye_calib.core.checks.findings import Finding, Severity, finding
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops.closed_form import Stops
from hand_eye_calib.extras.stops.flat_target import sines_of_views, usual_sine
from hand_eye_calib.extras.stops.robot_world import RobotWorld

# An outlier is clear if its squared Mahalanobis distance (six values) exceeds this limit. Without a
# clear outlier there is no finding: the errors of a target's pose differ between views by a factor
# of several. Measured on simulated images of three targets.
_MIN_REPORTED_SQUARED = 225.0

# The verdict is USE WITH CARE if the share of reported outliers exceeds this limit.
_MAX_LEFT_OUT = 0.1

# Largest number of outliers that a message names.
_MAX_LISTED = 8


def check_left_out(fit: RobotWorld, stops: Stops) -> list[Finding]:
    """Return a finding that lists all stops with weight 0 (numbers from 1).

    It requires at least one clear outlier among them. Only the clear outliers decide about the
    severity.
    """
    is_left_out = fit.weights == 0.0
    is_clear = _squared_distances(fit, stops) > _MIN_REPORTED_SQUARED
    n_clear = int(np.sum(is_left_out & is_clear))
    if n_clear == 0:
        return []
    numbers = [str(row + 1) for row in np.flatnonzero(is_left_out)]
    count = len(numbers)
    if count > _MAX_LISTED:
        numbers = [*numbers[:_MAX_LISTED], f"{count - _MAX_LISTED} more"]
    is_large = n_clear > _MAX_LEFT_OUT * len(stops)
    return [
        finding(
            "outlier_stops",
            severity=Severity.WARNING if is_large else Severity.NOTE,
            count=count,
            n_stops=len(stops),
            numbers=f"{'stop' if count == 1 else 'stops'} {listing(numbers)}",
            do="does" if count == 1 else "do",
            were="was" if count == 1 else "were",
        )
    ]


def _squared_distances(fit: RobotWorld, stops: Stops) -> FloatArray:
    """Return the squared Mahalanobis distance (N,) of each stop from its prediction.

    The errors are in the frame of the child, or in the frame of its world if they are smaller
    there.
    """
    predicted = (
        se3.inverse(fit.T_world_world)
        @ stops.Ts_world_parent
        @ fit.T_parent_child
    )
    measured = se3.inverse(stops.Ts_world_child)
    errors = se3.log(np.stack([measured @ predicted, predicted @ measured]))
    squared = np.sum(errors.reshape(2, len(stops), 2, 3) ** 2, axis=3)
    positions, rotations = np.moveaxis(squared, 2, 0)
    if stops.has_target:
        # The angle of a view is the larger of the predicted and the measured angle. A view from the
        # front does not explain a rotation error above this angle.
        sines = np.maximum(
            sines_of_views(predicted), sines_of_views(stops.Ts_world_child)
        )
        rotations = rotations * np.minimum(sines / usual_sine(stops), 1.0) ** 2
    distances = positions / fit.level_m**2 + rotations / fit.level_rad**2
    return np.asarray(distances.min(axis=0))
