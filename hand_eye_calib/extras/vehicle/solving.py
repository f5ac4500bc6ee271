"""Estimate the pose of a sensor on a vehicle and the parameters of its wheels.

A motion of the sensor over about half a second has the logarithm xi = (rho, phi). The same motion
of the axle has the logarithm ``Ad(X) xi``, with the pose X of the sensor in the frame of the axle.
The wheels predict it as a motion in the plane:

    e_i = Log A_i(wheels, clock offset, side slip) - Ad(X) xi_i .

Without wheels, only the components that a vehicle cannot have are compared: it does not move
sideways or up, and does not roll or pitch. On curves the axle slips outwards by an angle that is
proportional to the lateral acceleration. Windows have weights of Student's t distribution, and none
beyond its tail, so that slip of the wheels counts little. The covariance is the sum of

- the jackknife over blocks of time, which contains correlated slip, times a factor: weights change
  with the residuals, which makes the answer less certain than the same weights of a table;
- what the priors leave open;
- two fifths of the difference to the answer over windows twice as long;
- three twentieths of the difference to the answer without weights, for slip that is not detected;
- what noise of the turns takes away from x and y.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.blocks import Blocks, inverse, jackknife_covariance, solve
from hand_eye_calib.core.base.stats import CHI2, STUDENT
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.vehicle.wheels import WheelModel, motions

# Unknowns: x, y (m) and rotations about x, y, z of the axle (rad) of the sensor; the clock offset
# (s); the slip angle per lateral acceleration (rad s^2/m); then the parameters of the wheels.
Y = 1
TILT = (2, 3)
YAW = 4
CLOCK = 5

# Prior standard deviations of these unknowns. They keep the iteration in bounds. That of the slip
# angle is real: the rear axles of cars have 0.003 to 0.007 (2 to 4 deg per g).
_PRIOR_SIGMAS = (3.0, 3.0, 1.0, 1.0, 1.0, 0.2, 0.005)
# Number of unknowns before the parameters of the wheels.
N_FIXED = len(_PRIOR_SIGMAS)
# Prior standard deviation of a parameter of the wheels: a share of its start, and an offset.
_PARAMETER_SHARE = 0.3
_PARAMETER_SIGMA = 0.03
# Prior standard deviation of an unknown that is not estimated.
_FIXED_SIGMA = 1e-6

# Number of blocks of the jackknife: blocks of some seconds, longer than a slip.
BLOCKS = 30

# Probability of a larger Mahalanobis distance, below which a window has no weight.
_TAIL = 0.01

# Shares of the differences to other answers that are added, measured on simulated drives.
_SHARE_OF_LONGER = 0.4
_SHARE_OF_UNWEIGHTED = 0.15

_MAX_ROUNDS = 20
_NOISE_ROUNDS = 5
# The iteration ends below this step, in standard deviations.
_STEP_SIGMAS = 0.01
# Step of numerical derivatives, in the unit of each unknown.
_STEP = 1e-6
# Smallest variance of a component (m^2 or rad^2), for data without noise.
_LEAST_VARIANCE = 1e-14


@dataclass(frozen=True)
class Drive:
    """Motions of a sensor and the data of wheels.

    Attributes
    ----------
    xi : (K, 6) array
        Logarithms (rho, phi) of the motions, in the frame of the sensor.
    ends_s : (2, K) array
        Times of both ends of the motions.
    stamps_s : (N + 1,) array
    steps : (3, N) array
        Steps of the unit vehicle between the stamps.
    model : WheelModel or None
        None without wheels.
    components : sequence of int
        Components of e that are compared, out of six.
    """

    xi: FloatArray
    ends_s: FloatArray
    stamps_s: FloatArray
    steps: FloatArray
    model: WheelModel | None
    components: Sequence[int]

    def measured(self, T: FloatArray) -> FloatArray:
        """Return the motions (K, 6) of the axle by the sensor at this pose (4, 4)."""
        return self.xi @ se3.adjoint(T).T

    def predicted(self, T: FloatArray, others: FloatArray) -> FloatArray:
        """Return the motions (K, 6) of the axle by the wheels; without wheels, only the slip."""
        clock_s, slip = others[:2]
        predicted = np.zeros(self.xi.shape)
        if self.model is None:
            axle = self.measured(T)
            speeds = axle[:, 0] / (self.ends_s[1] - self.ends_s[0])
            predicted[:, 1] = -slip * speeds**2 * axle[:, 5]
            return predicted
        forward, left, turns = self.model.steps_of(others[2:], *self.steps)
        speeds = forward / np.diff(self.stamps_s)
        steps = np.stack([forward, left - slip * speeds**2 * turns, turns])
        predicted[:, [0, 1, 5]] = motions(self.stamps_s, steps, self.ends_s + clock_s).T
        return predicted

    def rows(self, T: FloatArray, others: FloatArray) -> FloatArray:
        """Return the equations (K, C, U + 1) of a step of the unknowns: derivatives of e, and -e.

        Derivatives with respect to the pose do not need the wheels again.
        """
        predicted = self.predicted(T, others)
        residuals = predicted - self.measured(T)
        columns = []
        for number, step in enumerate(_STEP * np.eye(CLOCK + len(others))):
            ahead = moved(T, others, step)
            if self.model is None or number >= CLOCK:
                predicted = self.predicted(*ahead)
            columns.append((predicted - self.measured(ahead[0]) - residuals) / _STEP)
        return np.stack([*columns, -residuals], axis=-1)[:, self.components]


def moved(T: FloatArray, others: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a pose and the other unknowns after a step (U,) of all."""
    rotation = se3.rotation_exp(step[Y + 1 : CLOCK]) @ se3.rotation_of(T)
    translation = se3.translation_of(T) + np.append(step[: Y + 1], 0.0)
    return se3.from_rotation_translation(rotation, translation), others + step[CLOCK:]


@dataclass(frozen=True)
class Fit:
    """Estimate of a drive.

    Attributes
    ----------
    T_base_sensor : (4, 4) array
        Pose of the sensor in the frame of the axle, with z = 0.
    others : (U - 5,) array
        Clock offset, side slip and parameters of the wheels.
    covariance : (U, U) array
    residuals : (K, C) array
    weights : (K,) array
    noise : (C, C) array
        Covariance of the residuals.
    information : (U,) array
        Information on each unknown that is left when all others are free.
    halves : (2, U) array
        Answers of both halves of the drive, less the estimate.
    objective : float
        Weighted squares of e, whitened.
    converged : bool
    """

    T_base_sensor: FloatArray
    others: FloatArray
    covariance: FloatArray
    residuals: FloatArray
    weights: FloatArray
    noise: FloatArray
    information: FloatArray
    halves: FloatArray
    objective: float
    converged: bool

    def signal_to_noise(self, components: Sequence[int]) -> dict[str, float]:
        """Return the information on x, y and yaw over that of motions which are only noise.

        Noise of the turns looks like turning, and makes x and y too small by the inverse.
        """
        variances = dict(zip(components, np.diag(self.noise).tolist(), strict=True))
        left = variances[1]
        forward = variances.get(0, left)
        # Without wheels, the noise of roll and pitch stands for that of the turns.
        turn = variances.get(5, variances.get(3, _STEP))
        of_noise = {"x": turn / left, "y": turn / forward, "yaw": 1.0}
        rows = zip(of_noise.items(), (0, Y, YAW), strict=True)
        n_windows = len(self.weights)
        return {name: self.information[row] / (size * n_windows) for (name, size), row in rows}


def fit_drive(drive: Drive, longer: Drive, fixed: Sequence[int]) -> Fit:
    """Estimate the unknowns of a drive.

    Parameters
    ----------
    drive, longer : Drive
        The drive in windows, and in windows twice as long.
    fixed : sequence of int
        Unknowns that stay at their start.
    """
    T, others = start_of(drive)
    of_wheels = _PARAMETER_SHARE * np.abs(others[2:]) + _PARAMETER_SIGMA
    sigmas = np.append(_PRIOR_SIGMAS, of_wheels)
    sigmas[list(fixed)] = _FIXED_SIGMA
    fit = _solve(drive, T, others, sigmas)
    covariance = fit.covariance
    alternatives = [
        (_solve(longer, T, others, sigmas), _SHARE_OF_LONGER),
        (_solve(drive, T, others, sigmas, is_weighted=False), _SHARE_OF_UNWEIGHTED),
    ]
    for other, share in alternatives:
        apart = share * _difference(
            other.T_base_sensor, other.others, fit.T_base_sensor, fit.others
        )
        covariance = covariance + np.outer(apart, apart)
    ratios = fit.signal_to_noise(drive.components)
    too_small = np.zeros(len(sigmas))
    too_small[:2] = fit.T_base_sensor[:2, 3] / [ratios["x"], ratios["y"]]
    return replace(fit, covariance=covariance + np.outer(too_small, too_small))


def _difference(
    T: FloatArray, others: FloatArray, from_T: FloatArray, from_others: FloatArray
) -> FloatArray:
    """Return the step (U,) of the unknowns between two estimates."""
    turn = se3.rotation_log(se3.rotation_of(T) @ se3.rotation_of(from_T).T)
    return np.concatenate([(T - from_T)[:2, 3], turn, others - from_others])


def _solve(
    drive: Drive,
    start: FloatArray,
    others: FloatArray,
    sigmas: FloatArray,
    is_weighted: bool = True,
) -> Fit:
    """Minimise the squares of e and of the priors about the start."""
    everything = range(len(sigmas))
    prior = np.zeros((len(sigmas) + 1, len(sigmas) + 1))
    prior[:-1, :-1] = np.diag(sigmas**-2.0)
    T = start
    first_others = others
    noise = np.zeros((0, 0))
    for _ in range(_MAX_ROUNDS):
        rows = drive.rows(T, others)
        weights, noise = _weights(rows[..., -1], noise, is_weighted)
        whitening = np.linalg.cholesky(inverse(noise)).T
        blocks = Blocks.of_rows(np.sqrt(weights)[:, None, None] * (whitening @ rows), BLOCKS)
        prior[:-1, -1] = -_difference(T, others, start, first_others) / sigmas**2
        table = blocks.total + prior
        step = solve(table, everything)
        T, others = moved(T, others, step)
        model = inverse(table[:-1, :-1])
        sigmas_of_step = np.sqrt(np.diag(model))
        converged = bool((np.abs(step) < _STEP_SIGMAS * sigmas_of_step + _STEP).all())
        if converged:
            break
    spread = jackknife_covariance(solve(blocks.without() + prior, everything))
    if is_weighted:
        n_components = len(drive.components)
        spread *= ((STUDENT + n_components + 2.0) / (STUDENT + n_components)) ** 2
    return Fit(
        T_base_sensor=T,
        others=others,
        covariance=spread + model @ prior[:-1, :-1] @ model,
        residuals=-rows[..., -1],
        weights=np.minimum(weights, 1.0),
        noise=noise,
        information=1.0 / np.diag(model),
        halves=solve(blocks.merged(2).sums + prior, everything),
        objective=float(blocks.total[-1, -1]),
        converged=converged,
    )


def _weights(
    residuals: FloatArray, noise: FloatArray, is_weighted: bool
) -> tuple[FloatArray, FloatArray]:
    """Return weights (K,) of residuals (K, C), and their covariance (C, C).

    K. L. Lange, R. J. A. Little, J. M. G. Taylor, *Robust statistical modeling using the t
    distribution*, JASA 84, 1989.
    """
    n_windows, n_components = residuals.shape
    least = _LEAST_VARIANCE * np.eye(n_components)
    if not noise.size:
        noise = np.diag(np.median(residuals**2, axis=0) / CHI2[0.5][1]) + least
    weights = np.ones(n_windows)
    for _ in range(_NOISE_ROUNDS):
        squared = np.einsum("kc,cd,kd->k", residuals, inverse(noise), residuals)
        if is_weighted:
            weights = (STUDENT + n_components) / (STUDENT + squared)
        noise = (weights[:, None] * residuals).T @ residuals / n_windows + least
    if is_weighted:
        weights[squared > CHI2[_TAIL][n_components]] = 0.0
    return weights, noise


def start_of(drive: Drive) -> tuple[FloatArray, FloatArray]:
    """Return a first pose of the sensor, and the other unknowns.

    The axis of the sensor's turning is up. In level axes, with complex numbers, the displacement of
    the sensor is ``exp(-i yaw) (length m + i turn p)``: m is the displacement of the unit vehicle,
    and p the place of the sensor. It is linear in ``length exp(-i yaw)`` and ``exp(-i yaw) p``.
    Without wheels, m is the length of the displacement; the sensor's axis z is up, or -y of a
    camera.
    """
    rotations = drive.xi[:, 3:]
    up = np.linalg.eigh(rotations.T @ rotations)[1][:, -1]
    turns = rotations @ up
    if drive.model is None:
        main = int(np.argmax(np.abs(up)))
        ratio = -up[main] if main == 1 else up[main]
        lengths = np.linalg.norm(drive.xi[:, :3], axis=1)
    else:
        totals = np.insert(np.cumsum(drive.steps, axis=1), 0, 0.0, axis=1)
        before, after = np.swapaxes(
            [np.interp(drive.ends_s, drive.stamps_s, total) for total in totals], 0, 1
        )
        forward, left, unit_turns = after - before
        lengths = forward + 1j * left
        ratio = turns @ unit_turns / (unit_turns @ unit_turns + _LEAST_VARIANCE)
    up, turns = np.sign(ratio) * up, np.sign(ratio) * turns
    ahead = np.linalg.svd(up[None])[2][1]
    level = np.stack([ahead, np.cross(up, ahead), up])
    x, y, _ = level @ drive.xi[:, :3].T
    columns = np.column_stack([lengths, 1j * turns])
    factor, place = np.linalg.lstsq(columns, x + 1j * y, rcond=None)[0]
    unit = factor / abs(factor)
    yaw = se3.rotation_exp([0.0, 0.0, -np.angle(unit)])
    place = place / unit
    T = se3.from_rotation_translation(yaw @ level, [place.real, place.imag, 0.0])
    parameters: tuple[float, ...] = ()
    if drive.model is not None:
        parameters = drive.model.parameters_of(abs(factor), abs(ratio))
    return T, np.array([0.0, 0.0, *parameters])
