"""Regression of one sensor's rotations on possible faults, with another sensor as reference.

The reference has the orientations G_i, rotated by the extrinsic into the axes of the measured
sensor. The measured sensor has the orientations Q_i. The errors of a window, in the world of the
reference, are

    e_i = Log(W^T Q_i G_i^T) = G_i phi + int G S w dt - G_i w_i d + c b_i + nuisances + noise

with

- the rotation W between the worlds,
- the error phi of the extrinsic rotation (right perturbation, axes of the measured sensor),
- the angular rates w about the axes of the measured sensor,
- the symmetric matrix S: relative errors of the gains of the axes on the diagonal, misalignment of
  the axes off the diagonal (D. Tedaldi, A. Pretto, E. Menegatti, *A robust and easy to implement
  method for IMU calibration without external equipments*, 2014),
- the delay d (s) and the smoothing c (s^2), which any low-pass filter has at low frequencies.

The smoothing c is multiplied by b_i. With the angular acceleration a = dw/dt,

    b_i = G_i a_i                            if the sensor measures orientations,
    b_i = G_i a_i - int G (w x a) dt         if the sensor measures rates.

The nuisances of a window are the error of W and a constant bias of rates, or a constant drift of
the world if the sensor measures orientations. So neither bias nor drift looks like a fault. The
rates of each stream are instrumental variables for the rates of the other stream, because their
noise is independent.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.checks.agreement import BIASES
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.differences import (
    Stencil,
    rotations_around,
    stencil,
)
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.extras.partial.columns import (
    Column,
    Fit,
    fit_columns,
    split,
)

# Duration (s) of a window. It is long enough for turns, and short enough for a constant bias.
_WINDOW_S = 20.0

# Step (s) of the finite differences for rates. A longer interval between stamps replaces it.
_STEP_S = 0.1

# Number of equal parts of a recording whose biases are compared.
_PARTS = 4

# Planes of two axes that may be misaligned. They are in the order of the third axis.
PLANES = ((1, 2), (0, 2), (0, 1))


class _Motion(NamedTuple):
    """Motion of a stream in W windows of K samples, as columns for the regression.

    Vectors are in the axes of the world of the reference stream.

    Attributes
    ----------
    rates : (W, K, 3) array
        Angular rates.
    bends : (W, K, 3) array
        Rotation vectors that a smoothing of 1 s^2 adds.
    gains, shears : (W, K, 3, 3) array
        Integrals of the rates: gains about each axis, shears with the two rates of a plane
        exchanged.
    """

    rates: FloatArray
    bends: FloatArray
    gains: FloatArray
    shears: FloatArray


class _Windows(NamedTuple):
    """Windows of both streams. The reference has the ``orientations`` (W, K, 3, 3)."""

    orientations: FloatArray
    reference: _Motion
    measured: _Motion


# Columns by the name of the fault, with prior standard deviations. A comment states the unknowns.
_COLUMNS = {
    # Correction of the extrinsic rotation, rad.
    "rotation": Column(1.0, lambda windows: windows.orientations),
    # Scale of the rate about each axis, minus 1.
    "gains": Column(
        0.03,
        lambda windows: windows.reference.gains,
        lambda windows: windows.measured.gains,
    ),
    # Half the error of the angle between two axes, rad.
    "shears": Column(
        float(np.radians(0.5)),
        lambda windows: windows.reference.shears,
        lambda windows: windows.measured.shears,
    ),
    # Delay, s.
    "delay": Column(
        1.0,
        lambda windows: -windows.reference.rates[..., None],
        lambda windows: -windows.measured.rates[..., None],
    ),
    # Smoothing, s^2.
    "smoothing": Column(
        0.1,
        lambda windows: windows.reference.bends[..., None],
        lambda windows: windows.measured.bends[..., None],
    ),
}


@dataclass(frozen=True)
class RotationFit(Fit):
    """Result of the regression of rotations on all faults.

    Attributes
    ----------
    main_axis : (3,) array
        Unit vector of the axis with most rotation, in the axes of the measured sensor.
    """

    main_axis: FloatArray

    @property
    def axes_covariance(self) -> FloatArray:
        """Covariance (3, 3), rad^2, that possible faults add to the extrinsic rotation.

        If two axes of a sensor are not perpendicular, its frame is uncertain by the same angle. The
        covariance is at most that of faults of usual size.
        """
        shears, sigmas = self.estimate("shears")
        estimated = self.open_covariance + np.diag(
            np.maximum(shears**2 - sigmas**2, 0.0)
        )
        return min(estimated, self._usual_covariance, key=np.trace)

    @property
    def _usual_covariance(self) -> FloatArray:
        """Covariance (3, 3) of the rotation, rad^2, for faults of usual size.

        About an axis without turns, the rates are noise and a weak instrument, so gains and shears
        can have any estimate. Therefore estimates that are not significant are replaced by prior
        standard deviations.
        """
        weak: list[int] = []
        prior_sigmas: list[float] = []
        for name in ("gains", "shears"):
            sizes = np.abs(self.estimate(name).values)
            is_weak = sizes <= BIASES * self.biases(name)
            places = np.array(self.places[name])[is_weak]
            weak += places.tolist()
            prior_sigmas += [_COLUMNS[name].sigma] * len(places)
        strong = [column for column in self._every_column if column not in weak]
        total = self.blocks.total
        among_strong = total[np.ix_(strong, strong)]
        with_weak = total[np.ix_(strong, weak)]
        effects = np.linalg.solve(among_strong, with_weak)[:3]
        of_weak = effects * np.array(prior_sigmas)
        return self.open_to(strong) + of_weak @ of_weak.T

    def main_gain(self) -> tuple[float, float, float]:
        """Estimate the gain about the main axis u, minus 1: u' S u.

        If a machine turns about one axis only, this gain is certain, while the gains about the
        sensor's axes are uncertain.

        Returns
        -------
        float, float, float
            The gain, its standard deviation, and its largest bias, see :meth:`biases`.
        """
        u = self.main_axis
        row = np.zeros(len(self._every_column))
        row[self.places["gains"]] = u**2
        row[self.places["shears"]] = [2.0 * u[k] * u[m] for k, m in PLANES]
        gain = float(row @ self.joint.values)
        jackknife = self.blocks.jackknife(self._every_column)
        sigma = float(np.sqrt(row @ jackknife @ row))
        information = self.blocks.total[:-1, :-1]
        spread = float(row @ np.linalg.solve(information, row))
        return gain, sigma, self.n_samples * abs(spread)

    @property
    def bias_drift(self) -> float:
        """Largest standard deviation (rad/s) of the bias of rates between parts of the recording.

        The bias of a part is the mean over its windows, because noise differs from window to
        window.
        """
        biases = self.nuisances[:, 3:]
        of_parts = [
            part.mean(axis=0) for part in np.array_split(biases, _PARTS)
        ]
        return float(np.std(of_parts, axis=0).max())


def fit_pairs(
    pairs: PosePairs, rotation: FloatArray, stream: str, has_rates: bool
) -> RotationFit | None:
    """Fit the rotations of pose pairs with the extrinsic rotation and all faults.

    Parameters
    ----------
    pairs : PosePairs
        Pose pairs on one clock. The positions are ignored.
    rotation : (3, 3) array
        Best estimate of the extrinsic rotation. The regression estimates a correction of it.
    stream : {"parent", "child"}
        The measured stream, to which faults are attributed.
    has_rates : bool
        Whether this stream has rates.
    """
    of_parent = se3.rotation_of(pairs.Ts_pw_p)
    of_child = se3.rotation_of(pairs.Ts_cw_c)
    if stream == "child":
        return fit_rotations(
            pairs.stamps_ns, of_parent @ rotation, of_child, has_rates
        )
    return fit_rotations(
        pairs.stamps_ns, of_child @ rotation.T, of_parent, has_rates
    )


def fit_rotations(
    stamps_ns: IntArray,
    reference: FloatArray,
    measured: FloatArray,
    has_rates: bool,
) -> RotationFit | None:
    """Fit rotations with the extrinsic rotation and all faults.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    reference : (N, 3, 3) array
        Orientations of the reference, rotated into the axes of the measured sensor.
    measured : (N, 3, 3) array
        Orientations or integrated rates of the measured sensor.
    has_rates : bool
        Whether the measured sensor has rates.

    Returns
    -------
    RotationFit or None
        None if the recording is too short.
    """
    stamps_s = (stamps_ns - stamps_ns[0]) * 1e-9
    interval_s = median(np.diff(stamps_s))
    step = max(round(_STEP_S / interval_s), 1)
    around = stencil(stamps_s, step)
    in_windows = split(stamps_s, around.spans_s, step, _WINDOW_S)
    if in_windows is None:
        return None
    is_used = in_windows.is_used
    # Errors in the world of the reference, relative to the mean of each window.
    between = in_windows(measured) @ np.swapaxes(in_windows(reference), 2, 3)
    worlds = se3.nearest_rotation(
        (between * is_used[..., None, None]).sum(axis=1)
    )
    errors = se3.rotation_log(np.swapaxes(worlds, 1, 2)[:, None] @ between)
    orientations = in_windows(reference)
    moving = np.broadcast_to(np.eye(3), orientations.shape)
    drifting = _integral(
        stamps_s, reference[:-1] if has_rates else moving[0, :1]
    )
    motions = []
    for stream in (reference, measured):
        whole = _motion(stamps_s, stream, reference, around, has_rates)
        motions.append(_Motion(*[in_windows(columns) for columns in whole]))
    windows = _Windows(orientations, *motions)
    nuisances = np.concatenate([moving, in_windows(drifting)], axis=3)
    fitted = fit_columns(_COLUMNS, windows, is_used, errors, nuisances)
    turns = se3.rotations_between(reference[:-1], reference[1:])
    # The last axis has the largest eigenvalue.
    _, axes = np.linalg.eigh(turns.T @ turns)
    return RotationFit(**vars(fitted), main_axis=axes[:, -1])


def _integral(stamps_s: FloatArray, values: FloatArray) -> FloatArray:
    """Return the integral (N, ...) over time of values (N - 1, ...) between the stamps (N,)."""
    n_axes = values.ndim - 1
    intervals_s = np.diff(stamps_s).reshape(-1, *[1] * n_axes)
    start = 0.0 * values[:1]
    return np.cumsum(np.concatenate([start, intervals_s * values]), axis=0)


def _motion(
    stamps_s: FloatArray,
    stream: FloatArray,
    orientations: FloatArray,
    around: Stencil,
    has_rates: bool,
) -> _Motion:
    """Return the columns of a stream from its rotations and the orientations of the reference.

    Parameters
    ----------
    stamps_s : (N,) array
    stream, orientations : (N, 3, 3) array
    around : Stencil
        Rows of the differences.
    has_rates : bool
        Whether the measured stream has rates.
    """
    turn, turn_before, turn_after = rotations_around(stream, around)
    rates = turn / (2.0 * around.step_s)
    accelerations = (turn_after - turn_before) / (3.0 * around.step_s**2)
    bends = se3.times(orientations, accelerations)
    turns = se3.rotations_between(stream[:-1], stream[1:])
    steps = turns / np.diff(stamps_s)[:, None]
    halfway = orientations[:-1] @ se3.rotation_exp(0.5 * turns)
    if has_rates:
        between = 0.5 * (accelerations[:-1] + accelerations[1:])
        bends = bends - _integral(
            stamps_s, se3.times(halfway, se3.cross(steps, between))
        )
    gains = halfway * steps[:, None, :]
    shears = np.zeros_like(halfway)
    for column, (k, m) in enumerate(PLANES):
        shears[..., column] = (
            halfway[..., k] * steps[:, m, None]
            + halfway[..., m] * steps[:, k, None]
        )
    return _Motion(
        rates=se3.times(orientations, rates),
        bends=bends,
        gains=_integral(stamps_s, gains),
        shears=_integral(stamps_s, shears),
    )
