"""Estimate the pose of a sensor on a vehicle and the parameters of its wheels.

The drive is divided into windows of about half a second. The motion of the sensor in window i has
the logarithm xi_i = (rho, phi). The motion of the axle has the logarithm ``Ad(X) xi_i``, where X is
the pose of the sensor in the frame of the axle. The wheels predict the motion A_i of the axle in
the plane. The residual is

    e_i = Log A_i(wheels, clock offset, side slip) - Ad(X) xi_i .

Without wheels, the residual has only the components that are zero for a vehicle: sideways and
upward motion, roll and pitch. In curves the axle slips outwards by an angle in proportion to the
lateral acceleration (side slip). Windows have weights by Student's t distribution. Windows in the
tail of this distribution, where wheels slip, have weight 0. The covariance is the sum of

- the tapered jackknife over blocks of time, which contains time-correlated slip. A factor enlarges
  it: the weights depend on the residuals, so the estimate is less certain than with fixed weights;
- the uncertainty of the priors;
- the square of half of the difference to the estimate over windows twice as long;
- the square of a share of the difference to the estimate without weights, for slip that is not
  detected: 3/20, 1/2 for x, pitch and yaw, and for parameters of the wheels the share that follows
  from signal and noise;
- the square of the bias of x and y that noise of the turns may cause;
- the square of the bias of roll and y of a body that leans outwards, if most curves have the same
  direction;
- the variance of roll and y from ramps in the rhythm of the curves.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.blocks import Blocks, inverse, solve
from hand_eye_calib.core.base.stats import CHI2, STUDENT, share_of_step
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.vehicle.drive import (
    CLOCK,
    STEP,
    TILT,
    YAW,
    Drive,
    Y,
    apply_step,
)

# Prior standard deviations of the unknowns before the parameters of the wheels, in their units.
# They keep the iteration in bounds. Only the last one, of the slip angle, is real prior knowledge.
_PRIOR_SIGMAS = (3.0, 3.0, 1.0, 1.0, 1.0, 0.2, 0.004)
# Prior mean of the slip angle (rad s^2/m). An axle slips outwards, never inwards: by 0.003 to 0.007
# rad per m/s^2 for cars (2 to 4 deg per g), and by less for slow robots with hard tyres. So 0
# and 0.007 are about one standard deviation away from the mean.
_PRIOR_SLIP = 0.003
# Number of unknowns before the parameters of the wheels.
N_FIXED = len(_PRIOR_SIGMAS)
# Prior standard deviation of a wheel parameter: this share of its starting value ...
_PARAMETER_SHARE = 0.3
# ... plus this value, in the unit of the parameter.
_PARAMETER_SIGMA = 0.03
# Prior standard deviation of an unknown that keeps its starting value, in its unit.
_FIXED_SIGMA = 1e-6

# Standard deviation of the angle (rad) by which a body leans outwards, per lateral acceleration
# (m/s^2). The roll gradient of cars is 3 to 7 deg per g.
_LEAN = 0.01

# Assumed height (m) of the sensor above the axle. A body that leans or pitches moves the sensor by
# the height times the angle. The height cannot be estimated.
_HEIGHT = 1.0

# Index of pitch in the residual e.
_PITCH = 4

# Number of blocks of a drive. A block lasts for some seconds, which is longer than a slip.
BLOCKS = 30
# Number of blocks of the jackknife; a block of a drive of three minutes lasts 9 s. The omitted part
# lasts two blocks, which is longer than a left and a right curve together. Then errors that change
# sign with the curve, such as those of a leaning body, cancel as in the whole drive. In 76
# simulated drives, the standard deviation of roll was 2.0 times the error with 30 blocks, and 1.4
# times with 20.
_JACKKNIFE_BLOCKS = 20

# Number of parts of a drive. Two neighbouring parts must not contain most of the information.
_PARTS = 10

# A window gets weight 0 if its Mahalanobis distance occurs by noise with less than this
# probability.
_TAIL = 0.01

# A second estimate uses longer windows. This share of the difference between both estimates is an
# additional standard deviation. The share is the slope of the regression of the errors on this
# difference, in 470 simulated drives.
_SHARE_OF_LONGER = 0.5
# The same share for the difference from the estimate without weights.
_SHARE_OF_UNWEIGHTED = 0.15
# The same share for x, pitch and yaw. Neighbouring windows share a pose, so their errors cancel
# under equal weights: in 500 simulated drives, the errors are -0.75 to -1 times this difference.
# Roll and y have the usual share, because lean already enlarges their jackknife.
_SHARE_OF_EQUAL_WEIGHTS = 0.5

# Sizes of slips, as shares of the speed of a wheel. Tyres and rollers slip by 5 to 20 % in curves,
# and on average a slip covers three quarters of a window.
_SLIPS = np.array([0.03, 0.075, 0.15])
# Largest share of the slip that may be undetected. Near a share of 1, the bias of the wheel
# parameters has no limit.
_MAX_UNDETECTED = 0.75
# Factor of the argument of a logistic function that is close to the normal distribution.
_LOGISTIC = 1.702

# Largest number of Gauss-Newton steps.
_MAX_ROUNDS = 20
# Number of updates of weights and noise per step.
_NOISE_ROUNDS = 5
# The iteration ends if the step is below this number of standard deviations.
_STEP_SIGMAS = 0.01
# Assumed variance of turns (rad^2), if the poses have neither turns nor tilt to compare.
_TURN_VARIANCE = 1e-6
# Smallest variance of a component of the residual (m^2 or rad^2). It is for data without noise.
_MIN_VARIANCE = 1e-14


@dataclass(frozen=True)
class Fit:
    """Estimate of a drive.

    Attributes
    ----------
    T_base_sensor : (4, 4) array
        Pose of the sensor in the frame of the axle, with z = 0.
    others : (U - 5,) array
        All unknowns except the pose: clock offset, side slip and wheel parameters.
    covariance : (U, U) array
        Covariance of all unknowns.
    residuals : (K, C) array
    weights : (K,) array
        Weights of the windows, 0 to 1.
    noise : (C, C) array
        Covariance of the residuals.
    information : (U,) array
        Information on each unknown (inverse variance) if all other unknowns are free.
    concentration : (U,) array
        Largest factor by which the variance of each unknown grows if a fifth of the drive is
        omitted.
    halves : (2, U) array
        Estimate from each half of the drive, minus the estimate from the whole drive.
    objective : float
        Weighted sum of squares of the whitened residuals.
    converged : bool
    """

    T_base_sensor: FloatArray
    others: FloatArray
    covariance: FloatArray
    residuals: FloatArray
    weights: FloatArray
    noise: FloatArray
    information: FloatArray
    concentration: FloatArray
    halves: FloatArray
    objective: float
    converged: bool

    def signal_to_noise(self, components: Sequence[int]) -> dict[str, float]:
        """Return the information on x, y and yaw as a multiple of the information in noise.

        Noise of the turns looks like turns of the vehicle. This noise makes x and y too small, by
        the inverse of the multiple. ``components`` are those of the drive.
        """
        variances = dict(
            zip(components, np.diag(self.noise).tolist(), strict=True)
        )
        left = variances[1]
        forward = variances.get(0, left)
        # Without wheels, the noise of the turns is unknown: use the noise of roll.
        turn = variances.get(5, variances.get(3, _TURN_VARIANCE))
        n_windows = len(self.weights)
        return {
            "x": self.information[0] / (turn / left * n_windows),
            "y": self.information[Y] / (turn / forward * n_windows),
            "yaw": self.information[YAW] / n_windows,
        }


def fit_drive(drive: Drive, longer: Drive, fixed: Sequence[int]) -> Fit:
    """Estimate the unknowns of a drive.

    Parameters
    ----------
    drive, longer : Drive
        The drive in its windows, and in windows twice as long.
    fixed : sequence of int
        Indices of the unknowns that keep their starting value.
    """
    T, others = start_of(drive)
    # Prior standard deviations of all unknowns.
    wheel_sigmas = _PARAMETER_SHARE * np.abs(others[2:]) + _PARAMETER_SIGMA
    sigmas = np.append(_PRIOR_SIGMAS, wheel_sigmas)
    sigmas[list(fixed)] = _FIXED_SIGMA
    fit = _solve(drive, T, others, sigmas)
    covariance = fit.covariance
    alternatives = [
        (
            _solve(longer, T, others, sigmas),
            np.full(len(sigmas), _SHARE_OF_LONGER),
        ),
        (
            _solve(drive, T, others, sigmas, is_weighted=False),
            _shares_of_unweighted(drive, fit),
        ),
    ]
    for alternative, shares in alternatives:
        difference = shares * _difference(
            alternative.T_base_sensor,
            alternative.others,
            fit.T_base_sensor,
            fit.others,
        )
        covariance = covariance + np.outer(difference, difference)
    ratios = fit.signal_to_noise(drive.components)
    # Bias of x and y towards zero by noise of the turns.
    bias = np.zeros(len(sigmas))
    bias[:2] = fit.T_base_sensor[:2, 3] / [ratios["x"], ratios["y"]]
    if drive.model is not None:
        # The fit combines the turns of sensor and wheels, which have variances a and b. The
        # combination has the variance ab / (a + b), at most a quarter of the variance a + b of
        # their difference.
        bias /= 4.0
    covariance = covariance + np.outer(bias, bias)
    lean = _LEAN * _lateral_acceleration(drive, fit.T_base_sensor)
    covariance[TILT[0], TILT[0]] += lean**2
    if Y not in fixed:
        covariance[Y, Y] += (_HEIGHT * lean) ** 2
    if TILT[0] not in fixed:
        ramps = _variance_of_ramps(drive, fit)
        covariance[TILT[0], TILT[0]] += ramps
        if Y not in fixed:
            covariance[Y, Y] += _HEIGHT**2 * ramps
    return replace(fit, covariance=covariance)


def _variance_of_ramps(drive: Drive, fit: Fit) -> float:
    """Return the variance of roll (rad^2) from ramps that resemble a tilted mount.

    If the mount rolls, each turn contains a share of pitch. A vehicle that pitches on ramps in the
    rhythm of its curves looks the same. The ramps could also be earlier or later in the drive.
    Therefore the regression of the pitch on the turns is computed for all shifts in time. The mean
    square over all shifts is a sum over frequencies (A. V. Oppenheim, R. W. Schafer, *Discrete-time
    signal processing*, 2009, section 8.6). The jackknife already contains white noise, so the mean
    square for white noise is subtracted.
    """
    turns = drive.measured(fit.T_base_sensor)[:, 5]
    pitches = fit.residuals[:, list(drive.components).index(_PITCH)]
    powers = np.abs(np.fft.fft([turns, pitches])) ** 2
    of_turns = turns @ turns + _MIN_VARIANCE
    of_all_shifts = powers[0] @ powers[1] / len(turns) ** 2
    of_white_noise = of_turns * (pitches @ pitches) / len(turns)
    excess = max(float(of_all_shifts - of_white_noise), 0.0)
    return float(excess / of_turns**2)


def _shares_of_unweighted(drive: Drive, fit: Fit) -> FloatArray:
    """Return the bias (U,) from undetected slip, in units of the difference between two estimates.

    The two estimates are with and without weights. The slip of a wheel has the same effect as
    another size of this wheel. If a share p of the slip is not detected, the bias is p times the
    bias without weights. That is p / (1 - p) times the difference between both estimates.
    """
    shares = np.full(CLOCK + len(fit.others), _SHARE_OF_UNWEIGHTED)
    shares[[0, TILT[1], YAW]] = _SHARE_OF_EQUAL_WEIGHTS
    if drive.model is None:
        return shares
    n_components = len(drive.components)
    threshold = CHI2[_TAIL][n_components]
    columns = drive.rows(fit.T_base_sensor, fit.others)
    for index in range(N_FIXED, N_FIXED + drive.model.n_wheels):
        # Squared effect (K,) of a slip of 100 %, in standard deviations of the noise.
        effect = fit.others[index - CLOCK] * columns[..., index]
        squared = (
            np.einsum("kc,cd,kd->k", effect, inverse(fit.noise), effect)
            + _MIN_VARIANCE
        )
        # Mean and standard deviation of a non-central chi-squared distribution (3, K).
        excess = _SLIPS[:, None] ** 2 * squared
        mean = n_components + excess
        sigma = np.sqrt(2.0 * (n_components + 2.0 * excess))
        # The hyperbolic tangent is a logistic function that does not overflow.
        is_kept = 0.5 - 0.5 * np.tanh(
            _LOGISTIC * (mean - threshold) / sigma / 2.0
        )
        weights = is_kept * (STUDENT + n_components) / (STUDENT + mean)
        undetected = (
            np.average(weights, axis=1, weights=squared) @ _SLIPS / _SLIPS.sum()
        )
        undetected = min(float(undetected), _MAX_UNDETECTED)
        shares[index] = undetected / (1.0 - undetected)
    # These slips also bias the other wheel parameters.
    first_other = N_FIXED + drive.model.n_wheels
    of_wheels = shares[N_FIXED:first_other]
    shares[first_other:] = min(_SHARE_OF_UNWEIGHTED, float(of_wheels.min()))
    return shares


def _lateral_acceleration(drive: Drive, T: FloatArray) -> float:
    """Return the mean lateral acceleration (m/s^2) to the left. Curves to both sides cancel.

    Windows are weighted by their squared turns, because the turns determine roll. ``T`` is the pose
    of the sensor.
    """
    axle = drive.measured(T)
    durations_s = drive.ends_s[1] - drive.ends_s[0]
    forward = axle[:, 0]
    turns = axle[:, 5]
    if drive.model is None:
        # Without wheels, y is unknown. Its error times the turns is a part of the forward motion,
        # so the part that varies with the turns is removed.
        deviations = turns - turns.mean()
        variation = deviations @ deviations + _MIN_VARIANCE
        forward = forward - (deviations @ forward) / variation * deviations
    accelerations = forward * turns / durations_s**2
    return float(np.average(accelerations, weights=turns**2 + _MIN_VARIANCE))


def _difference(
    T: FloatArray,
    others: FloatArray,
    from_T: FloatArray,
    from_others: FloatArray,
) -> FloatArray:
    """Return the step (U,) from the estimate ``from_...`` to the other estimate."""
    turn = se3.rotation_log(se3.rotation_of(T) @ se3.rotation_of(from_T).T)
    return np.concatenate([(T - from_T)[:2, 3], turn, others - from_others])


def _solve(
    drive: Drive,
    start: FloatArray,
    others: FloatArray,
    sigmas: FloatArray,
    is_weighted: bool = True,
) -> Fit:
    """Minimise the weighted squares of e and of the prior deviations by Gauss-Newton steps.

    Parameters
    ----------
    drive : Drive
    start : (4, 4) array
        Pose at which the iteration starts, and mean of its prior. Five of its six components are
        unknowns; z is not estimated.
    others : (U - 5,) array
        Starting values of the other unknowns, and means of their priors.
    sigmas : (U,) array
        Prior standard deviations of all unknowns.
    is_weighted : bool
        Whether windows have weights by Student's t distribution.
    """
    everything = range(len(sigmas))
    # Products of the prior equations: the information, and its product with the step to the prior
    # mean.
    prior = np.diag(np.append(sigmas**-2.0, 0.0))
    T = start
    first_others = others
    noise = np.zeros((0, 0))
    for _ in range(_MAX_ROUNDS):
        rows = drive.rows(T, others)
        weights, noise = _weights(rows[..., -1], noise, is_weighted)
        weighted = _whitened(rows, weights, noise)
        blocks = Blocks.of_rows(weighted, BLOCKS)
        deviation = _difference(T, others, start, first_others)
        prior[:-1, -1] = -deviation / sigmas**2
        table = blocks.total + prior
        step = solve(table, everything)
        T, others = apply_step(T, others, step)
        # Covariance (U, U) if windows are independent.
        model = inverse(table[:-1, :-1])
        converged = _is_small(step, np.sqrt(np.diag(model)))
        if converged:
            break
    spread = _tapered_jackknife(Blocks.of_rows(weighted, len(weighted)), prior)
    if is_weighted:
        spread /= share_of_step(len(drive.components)) ** 2
    return Fit(
        T_base_sensor=T,
        others=others,
        covariance=spread + model @ prior[:-1, :-1] @ model,
        residuals=-rows[..., -1],
        weights=np.minimum(weights, 1.0),
        noise=noise,
        information=1.0 / np.diag(model),
        concentration=_concentration(blocks, prior, model),
        halves=solve(blocks.merged(2).sums + prior, everything),
        objective=float(blocks.total[-1, -1]),
        converged=converged,
    )


def _whitened(
    rows: FloatArray, weights: FloatArray, noise: FloatArray
) -> FloatArray:
    """Return equations (K, C, U + 1), multiplied by roots of their weights and of 1 / noise."""
    whitening = np.linalg.cholesky(inverse(noise)).T
    return np.sqrt(weights)[:, None, None] * (whitening @ rows)


def _is_small(step: FloatArray, sigmas: FloatArray) -> bool:
    """Whether a step (U,) is far below the standard deviations of the unknowns."""
    return bool((np.abs(step) < _STEP_SIGMAS * sigmas + STEP).all())


def _tapered_jackknife(windows: Blocks, prior: FloatArray) -> FloatArray:
    """Return the covariance (U, U) of a fit by the tapered jackknife over blocks of time.

    Neighbouring windows share a pose, so their errors are opposite. They cancel in the fit, except
    at the ends of an omitted block. Therefore the omitted share of the windows is a half wave of
    the cosine, which is zero at both ends. Neighbouring half waves overlap by half, so that the
    squares of all shares of a window add up to 1. Reference: H. Kuensch, *The jackknife and the
    bootstrap for general stationary observations*, Annals of Statistics 17, 1989.

    Parameters
    ----------
    windows : Blocks
        Table for each window.
    prior : (U + 1, U + 1) array
        Products of the prior equations.
    """
    everything = range(len(prior) - 1)
    n_windows = len(windows.sums)
    # Middle of each window, in blocks since the start.
    middles = (np.arange(n_windows) + 0.5) * _JACKKNIFE_BLOCKS / n_windows
    distances = np.abs(middles - np.arange(_JACKKNIFE_BLOCKS + 1)[:, None])
    shares = np.cos(np.pi / 2.0 * np.minimum(distances, 1.0))
    left_out = np.tensordot(shares, windows.sums, axes=1)
    total = windows.total + prior
    deviations = solve(total - left_out, everything) - solve(total, everything)
    return np.asarray(deviations.T @ deviations)


def _concentration(
    blocks: Blocks, prior: FloatArray, model: FloatArray
) -> FloatArray:
    """Return the concentration (U,) of a fit, see :class:`Fit`.

    ``prior`` are the products of the prior equations, and ``model`` is the covariance (U, U).
    """
    parts = blocks.merged(_PARTS).sums
    fifths = parts[:-1] + parts[1:]
    remaining = (blocks.total - fifths + prior)[:, :-1, :-1]
    variances = np.diagonal(inverse(remaining), axis1=1, axis2=2)
    return np.asarray(variances.max(axis=0) / np.diag(model))


def _weights(
    residuals: FloatArray, noise: FloatArray, is_weighted: bool
) -> tuple[FloatArray, FloatArray]:
    """Return the weights (K,) of residuals (K, C), and the covariance (C, C) of the residuals.

    ``noise`` is the covariance from the previous step, and empty at the first step. If
    ``is_weighted`` is false, all weights are 1.

    K. L. Lange, R. J. A. Little, J. M. G. Taylor, *Robust statistical modeling using the t
    distribution*, JASA 84, 1989.
    """
    n_windows, n_components = residuals.shape
    minimum = _MIN_VARIANCE * np.eye(n_components)
    if not noise.size:
        noise = (
            np.diag(np.median(residuals**2, axis=0) / CHI2[0.5][1]) + minimum
        )
    weights = np.ones(n_windows)
    for _ in range(_NOISE_ROUNDS):
        squared = np.einsum("kc,cd,kd->k", residuals, inverse(noise), residuals)
        if is_weighted:
            weights = (STUDENT + n_components) / (STUDENT + squared)
        weighted = weights[:, None] * residuals
        noise = weighted.T @ residuals / n_windows + minimum
    if is_weighted:
        weights[squared > CHI2[_TAIL][n_components]] = 0.0
    return weights, noise


def start_of(drive: Drive) -> tuple[FloatArray, FloatArray]:
    """Return a starting pose (4, 4) of the sensor, and starting values of the other unknowns.

    The vehicle turns about the vertical, so the main axis of the rotations is up or down. In level
    axes of the sensor, with complex numbers for vectors in the plane, its displacement in a window
    is ``d = exp(-i yaw) (s m + i a p)``: m is the displacement of the unit vehicle, s the ratio of
    lengths, a the turn, and p the position of the sensor. Least squares yields the factors
    ``s exp(-i yaw)`` of m and ``exp(-i yaw) p`` of ``i a``.

    The wheels reveal whether the axis points up. Without wheels, z of the sensor (or -y of a
    camera) points up, and m is the length of d: the vehicle drives forward.
    """
    rotations = drive.xi[:, 3:]
    axis = np.linalg.eigh(rotations.T @ rotations)[1][:, -1]
    turns = rotations @ axis
    if drive.model is None:
        main = int(np.argmax(np.abs(axis)))
        turn_ratio = -axis[main] if main == 1 else axis[main]
        displacements = np.linalg.norm(drive.xi[:, :3], axis=1)
    else:
        forward, left, unit_turns = drive.motions_of_unit_vehicle()
        displacements = forward + 1j * left
        turn_ratio = (
            turns @ unit_turns / (unit_turns @ unit_turns + _MIN_VARIANCE)
        )
    up = np.sign(turn_ratio) * axis
    turns = np.sign(turn_ratio) * turns
    # The first level axis of the sensor can be any direction perpendicular to up.
    ahead = np.linalg.svd(up[None])[2][1]
    level = np.stack([ahead, np.cross(up, ahead), up])
    x, y, _ = level @ drive.xi[:, :3].T
    columns = np.column_stack([displacements, 1j * turns])
    factors, *_ = np.linalg.lstsq(columns, x + 1j * y, rcond=None)
    factor, rotated_position = factors
    length_ratio = abs(factor)
    direction = factor / length_ratio  # exp(-i yaw)
    yaw = se3.rotation_exp([0.0, 0.0, -np.angle(direction)])
    position = rotated_position / direction
    T = se3.from_rotation_translation(
        yaw @ level, [position.real, position.imag, 0.0]
    )
    parameters: tuple[float, ...] = ()
    if drive.model is not None:
        parameters = drive.model.parameters_of(length_ratio, abs(turn_ratio))
    return T, np.array([0.0, _PRIOR_SLIP, *parameters])
