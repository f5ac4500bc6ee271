"""Regression of measured positions on possible faults, with the poses of another sensor.

In a window of some seconds, the measured positions are

    q_i = A (R_i l + t_i) + a + sum_k f_k c_ki + noise

(R_i, t_i) are the poses of the odometry, l is the lever arm, and (A, a) is the pose of the
odometry's world in the world of the positions. Errors of (A, a) are projected out of each window.
The column c_k is the effect of a fault of size f_k = 1: the coordinate for a wrong scale of an
axis, minus the velocity for a delay d, the acceleration for smoothing c. The last two follow from
the frequency response of any low-pass filter at low angular frequencies w, ``1 - i w d - w^2 c``.

Accelerations are computed from the poses. Their instrument is the acceleration of the measured
positions. The noise of both is independent, so neither noise nor drift looks like smoothing.

Smoothing that is too weak for a finding still shifts the lever arm of a drone. Its prior has two
parts: usual streams and faulty streams. Bayes' rule yields its mean and its variance.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.differences import path_derivatives, stencil
from hand_eye_calib.extras.partial.columns import (
    Column,
    Fit,
    by_axis,
    fit_columns,
    split,
)
from hand_eye_calib.extras.partial.position_tuning import TUNING, PositionTuning

# Duration (s) of a window. It is long enough for a turn, and short enough for little drift of an
# odometry.
_WINDOW_S = 10.0

# Step (s) of the finite differences for velocities and accelerations. A longer interval between
# positions replaces it.
_STEP_S = 0.2

# Prior standard deviation of the smoothing (s^2) of faulty streams. Chosen on simulated machines
# with filters of 0.05 to 0.2 s. Usual streams have the prior of the noise model.
_FAULTY_S2 = 0.01
# Prior probability that a stream is faulty.
_FAULTY_SHARE = 0.2

# A coordinate with a smaller range (m) is constant, up to rounding.
_MAX_CONSTANT_M = 1e-6


class _Windows(NamedTuple):
    """W windows of K predicted and measured positions, in axes of the world of the positions.

    A predicted position is the end of the lever arm on the poses. The predicted positions of each
    window are rotated to fit the measured positions.

    Attributes
    ----------
    is_used : (W, K) bool array
        Positions that are not near a gap.
    rotations : (W, K, 3, 3) array
        Rotations of the sensor with poses.
    path : (W, K, 3) array
        Predicted positions minus their mean in the window, m.
    residuals : (W, K, 3) array
        Measured minus predicted positions, m.
    velocities, accelerations : (W, K, 3) array
        Derivatives of the predicted positions, m/s and m/s^2.
    measured_accelerations : (W, K, 3) array
        Second derivatives of the measured positions, m/s^2.
    """

    is_used: BoolArray
    rotations: FloatArray
    path: FloatArray
    residuals: FloatArray
    velocities: FloatArray
    accelerations: FloatArray
    measured_accelerations: FloatArray


# Columns by the name of the fault, with prior standard deviations. A comment states the unknowns.
_COLUMNS = {
    # Correction of the lever arm, m.
    "lever_arm": Column(100.0, lambda windows: windows.rotations),
    # Scale of each coordinate, minus 1.
    "scales": Column(1.0, lambda windows: by_axis(windows.path)),
    # Delay of each coordinate, s.
    "delays": Column(1.0, lambda windows: by_axis(-windows.velocities)),
    # Smoothing c, s^2.
    "smoothing": Column(
        0.1,
        lambda windows: windows.accelerations[..., None],
        lambda windows: windows.measured_accelerations[..., None],
    ),
}


@dataclass(frozen=True)
class PositionFit(Fit):
    """Result of the regression of positions on all faults.

    Attributes
    ----------
    is_constant : (3,) bool array
        Coordinates that are the same in all measured positions.
    path_m : float
        Root mean square distance of the predicted positions from the mean of their window.
    spreads_m : (3,) array
        Root mean square distance along each coordinate, after subtraction of what other columns
        explain.
    speeds_m_s : (3,) array
        Root mean square of the predicted velocity along each coordinate.
    acceleration_m_s2 : float
        Root mean square of the predicted acceleration.
    """

    is_constant: BoolArray
    path_m: float
    spreads_m: FloatArray
    speeds_m_s: FloatArray
    acceleration_m_s2: float

    @property
    def smoothing(self) -> "Smoothing":
        """Smoothing of the positions, from the data and the prior."""
        values, sigmas = self.estimate("smoothing")
        return posterior_smoothing(float(values[0]), float(sigmas[0]))

    @property
    def open_covariance(self) -> FloatArray:
        """Covariance (3, 3) that all possible faults except smoothing add to the lever arm."""
        of_smoothing = self.places["smoothing"]
        others = [
            place for place in self._every_column if place not in of_smoothing
        ]
        return self.open_to(others)


class Smoothing(NamedTuple):
    """Mean (s^2) and variance (s^4) of the smoothing of positions."""

    mean_s2: float
    variance_s4: float


def posterior_smoothing(
    smoothing_s2: float, sigma_s2: float, tuning: PositionTuning = TUNING
) -> Smoothing:
    """Return the smoothing, given its estimate and the prior.

    Parameters
    ----------
    smoothing_s2, sigma_s2 : float
        Estimate and its standard deviation.
    tuning : PositionTuning
        Constants. The last prior of positions is that of the smoothing of usual streams.
    """
    usual_s2 = tuning.of_positions[-1]
    prior_variances = np.array([usual_s2**2, _FAULTY_S2**2])
    variances = prior_variances + sigma_s2**2
    logs = np.log([1.0 - _FAULTY_SHARE, _FAULTY_SHARE])
    logs -= 0.5 * (np.log(variances) + smoothing_s2**2 / variances)
    shares = np.exp(logs - logs.max())
    shares /= shares.sum()
    shrinkages = prior_variances / variances
    means = shrinkages * smoothing_s2
    mean = float(shares @ means)
    squares = means**2 + shrinkages * sigma_s2**2
    return Smoothing(mean, float(shares @ squares) - mean**2)


def fit_positions(
    stamps_ns: IntArray,
    poses: FloatArray,
    positions: FloatArray,
    lever_arm: FloatArray,
) -> PositionFit | None:
    """Estimate a correction of the lever arm, and all faults, from measured positions.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    poses : (N, 4, 4) array
        Poses of the other sensor.
    positions : (N, 3) array
        Positions at the same stamps, in the same unit.
    lever_arm : (3,) array
        Best estimate, m. The regression estimates a correction of it.

    Returns
    -------
    PositionFit or None
        None if the recording is too short.
    """
    stamps_s = (stamps_ns - stamps_ns[0]) * 1e-9
    windows = _windows(stamps_s, poses, positions, lever_arm)
    if windows is None:
        return None
    is_used = windows.is_used
    # Columns for errors of the pose of the odometry's world: first its translation a, then its
    # rotation A.
    translation = np.broadcast_to(np.eye(3), windows.rotations.shape)
    world = np.concatenate([translation, se3.skew(windows.path)], axis=3)
    fitted = fit_columns(_COLUMNS, windows, is_used, windows.residuals, world)
    # Information that each column has alone, not shared with other columns.
    information = 1.0 / np.abs(
        np.diag(np.linalg.inv(fitted.blocks.total[:-1, :-1]))
    )
    weight = fitted.weights @ is_used.sum(axis=1)
    distances_m = _root_mean_square(windows.path, is_used)
    accelerations = _root_mean_square(windows.accelerations, is_used)
    return PositionFit(
        **vars(fitted),
        is_constant=np.ptp(positions, axis=0) < _MAX_CONSTANT_M,
        path_m=float(np.linalg.norm(distances_m)),
        spreads_m=np.sqrt(information[fitted.places["scales"]] / weight),
        speeds_m_s=_root_mean_square(windows.velocities, is_used),
        acceleration_m_s2=float(np.linalg.norm(accelerations)),
    )


def _root_mean_square(vectors: FloatArray, is_used: BoolArray) -> FloatArray:
    """Return the root mean square (3,) of each coordinate of the used vectors (W, K, 3)."""
    squares = vectors[is_used] ** 2
    return np.sqrt(squares.mean(axis=0))


def _windows(
    stamps_s: FloatArray,
    poses: FloatArray,
    positions: FloatArray,
    lever_arm: FloatArray,
) -> _Windows | None:
    """Return windows of predicted and measured positions, or None for a short recording."""
    step = max(round(_STEP_S / median(np.diff(stamps_s))), 1)
    rotations = se3.rotation_of(poses)
    predicted = se3.times(rotations, lever_arm) + se3.translation_of(poses)
    around = stencil(stamps_s, step)
    velocities, accelerations = path_derivatives(
        predicted, around, around.step_s
    )
    _, measured_accelerations = path_derivatives(
        positions, around, around.step_s
    )
    in_windows = split(stamps_s, around.spans_s, step, _WINDOW_S)
    if in_windows is None:
        return None
    is_used = in_windows.is_used
    path = _centred(in_windows(predicted), is_used)
    measured = _centred(in_windows(positions), is_used)
    # Rotation that fits the predicted to the measured positions of each window best (Kabsch).
    products = np.einsum("wki,wkj,wk->wij", measured, path, is_used)
    to_world = se3.nearest_rotation(products)[:, None]
    path = se3.times(to_world, path)
    return _Windows(
        is_used=is_used,
        rotations=to_world @ in_windows(rotations),
        path=path,
        residuals=measured - path,
        velocities=se3.times(to_world, in_windows(velocities)),
        accelerations=se3.times(to_world, in_windows(accelerations)),
        measured_accelerations=in_windows(measured_accelerations),
    )


def _centred(vectors: FloatArray, is_used: BoolArray) -> FloatArray:
    """Return vectors (W, K, 3) minus the mean of the used vectors in their window."""
    counts = is_used.sum(axis=1)[:, None]
    means = (vectors * is_used[..., None]).sum(axis=1) / counts
    return vectors - means[:, None]
