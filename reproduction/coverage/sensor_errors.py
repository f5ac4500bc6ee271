"""Kinds of errors of a sensor's poses, and random draws of these errors.

Errors act on the right, in the sensor's own frame: ``T_measured = T_true Exp(error)``. A sensor has
white errors, Gauss-Markov errors fixed to its body or to its world, and errors of its increments
(random walk, jumps, a drifting scale).
"""

from dataclasses import dataclass, field

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.geometry import se3


def sigmas(
    metres: float | FloatArray, degrees: float | FloatArray
) -> FloatArray:
    """Return standard deviations (6,) of (rho, phi), in m and rad."""
    translation = np.full(3, 1.0) * metres
    rotation = np.radians(np.full(3, 1.0) * degrees)
    return np.concatenate([translation, rotation])


def _no_error() -> FloatArray:
    return np.zeros(6)


@dataclass(frozen=True)
class GaussMarkov:
    """A stationary first-order process: correlation time (s) and standard deviations (6,).

    The process is along and about the axes of the sensor, or of its world if ``in_world`` is set.
    """

    tau_s: float
    sigma: FloatArray
    in_world: bool = False


@dataclass(frozen=True)
class Tail:
    """Factors on the standard deviation of the white errors, drawn for each pose."""

    # ``student``: multivariate t with ``factor`` degrees of freedom. ``spikes``: a share of the
    # poses is worse by a factor. ``bursts``: the same in stretches of 1 s.
    kind: str
    share: float = 0.0
    factor: float = 1.0

    def draw(
        self, rng: np.random.Generator, count: int, dt: float
    ) -> FloatArray:
        """Draw factors (N,)."""
        if self.kind == "student":
            chi_squared = rng.chisquare(self.factor, count)
            return np.sqrt(self.factor / chi_squared)
        if self.kind == "spikes":
            is_worse = rng.random(count) < self.share
        else:
            is_worse = _bursts(rng, count, self.share, 1.0 / dt)
        return np.where(is_worse, self.factor, 1.0)

    def information(self) -> float:
        """Return the Fisher information of the location of a 6-dimensional error.

        The unit is the information of the Gaussian core. Bursts are long enough to be recognised,
        so the factor of each of their poses counts as known.
        """
        if self.kind == "student":
            return (self.factor + 6.0) / (self.factor + 8.0)
        if self.kind == "spikes":
            return mixture_information(self.share, self.factor)
        return 1.0


def _bursts(
    rng: np.random.Generator, count: int, share: float, length: float
) -> BoolArray:
    """Return whether each pose (N,) is in a burst; bursts last ``length`` poses on average."""
    is_inside = False
    flags = np.empty(count, dtype=bool)
    leave = 1.0 / length
    enter = share / (1.0 - share) / length
    for row, drawn in enumerate(rng.random(count)):
        stays = drawn >= leave
        enters = drawn < enter
        is_inside = bool(stays if is_inside else enters)
        flags[row] = is_inside
    return flags


def mixture_information(
    share: float, factor: float, dimensions: int = 6
) -> float:
    """Return the Fisher information per dimension of the location of a Gaussian mixture.

    The mixture is (1 - share) N(0, I) + share N(0, factor^2 I). The information is an integral over
    the radius.
    """
    radius = np.linspace(1e-6, 8.0 * factor + 8.0, 400_000)
    core = (1.0 - share) * np.exp(-0.5 * radius**2)
    height = share * factor**-dimensions
    wide = height * np.exp(-0.5 * (radius / factor) ** 2)
    density = core + wide
    slope = radius * (core + wide / factor**2)

    # A density that underflows cannot be a divisor.
    is_positive = density > 1e-300
    density = density[is_positive]
    slope = slope[is_positive]
    surface = radius[is_positive] ** (dimensions - 1)
    total = np.sum(surface * density)
    information = np.sum(surface * slope**2 / density)
    return float(information / total / dimensions)


@dataclass(frozen=True, kw_only=True)
class SensorErrors:
    """Sizes of all errors of a sensor."""

    # Standard deviations of each pose; (6,) array.
    white: FloatArray
    # Standard deviations of the summed increments after 1 s, and after 1 m; (6,) array.
    walk: FloatArray = field(default_factory=_no_error)
    walk_by_metre: FloatArray = field(default_factory=_no_error)
    slow: tuple[GaussMarkov, ...] = ()
    # Standard deviation and correlation time (s) of a drifting scale.
    scale: tuple[float, float] | None = None
    # Standard deviation of the stamps (s).
    jitter_s: float = 0.0
    # Outliers of the white errors, which are Gaussian without.
    tail: Tail | None = None
    jumps_per_s: float = 0.0
    # Standard deviations of a jump; (6,) array.
    jump: FloatArray = field(default_factory=lambda: sigmas(0.1, 0.5))


@dataclass(frozen=True)
class DrawnErrors:
    """Measured poses of a sensor with drawn errors, and covariances for the Cramer-Rao bound."""

    # Measured poses; (N, 4, 4) array.
    poses: FloatArray
    # Inverse Fisher information of the white errors: their covariance if they are Gaussian; (N, 6,
    # 6) array.
    white: FloatArray
    # Covariances of the increments' white errors, jumps included; (N-1, 6, 6) array.
    walk: FloatArray


def draw(
    errors: SensorErrors,
    Ts: FloatArray,
    twists: FloatArray,
    dt: float,
    rng: np.random.Generator,
) -> DrawnErrors:
    """Measure the poses of a sensor once.

    Parameters
    ----------
    errors : SensorErrors
    Ts : (N, 4, 4) array
        True poses.
    twists : (N, 6) array
        True twists in the sensor's frame, m/s and rad/s.
    dt : float
        Time between poses, s.
    rng : numpy.random.Generator
    """
    generators = rng.spawn(6)
    jump_rng, walk_rng, scale_rng, tail_rng, white_rng, slow_rng = generators
    steps = se3.inverse(Ts[:-1]) @ Ts[1:]
    variances = _walk_variances(errors, steps, dt, jump_rng)
    standard = walk_rng.standard_normal((len(steps), 6))
    increments = np.sqrt(variances) * standard
    increments += _scale_errors(errors, steps, dt, scale_rng)
    white, covariances = _white(errors, twists, dt, tail_rng, white_rng)
    for process in errors.slow:
        white = white + _slow(process, Ts, dt, slow_rng)
    measured_steps = steps @ se3.exp(increments)
    drifting = _integrated(Ts[0], measured_steps)
    poses = drifting @ se3.exp(white)
    walk = variances[:, :, None] * np.eye(6)
    return DrawnErrors(poses, covariances, walk)


def _white(
    errors: SensorErrors,
    twists: FloatArray,
    dt: float,
    tail_rng: np.random.Generator,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Draw white errors (N, 6); return them and their inverse Fisher information (N, 6, 6)."""
    count = len(twists)
    factors = np.ones(count)
    variance_factors = np.ones(count)
    tail = errors.tail
    if tail is not None:
        factors = tail.draw(tail_rng, count, dt)
        if tail.kind == "bursts":
            variance_factors = factors**2
        else:
            variance_factors = variance_factors / tail.information()

    standard = rng.standard_normal((count, 6))
    drawn = factors[:, None] * errors.white * standard
    drawn += errors.jitter_s * twists * rng.standard_normal((count, 1))
    covariances = variance_factors[:, None, None] * np.diag(errors.white**2)
    products = errors.jitter_s**2 * twists[:, :, None] * twists[:, None, :]
    return drawn, covariances + products


def _walk_variances(
    errors: SensorErrors, steps: FloatArray, dt: float, rng: np.random.Generator
) -> FloatArray:
    """Return the variances (N-1, 6) of the increments' white errors; draw the instants of jumps."""
    lengths_m = np.linalg.norm(steps[:, :3, 3], axis=1)
    is_jump = rng.random(len(steps)) < errors.jumps_per_s * dt
    by_time = errors.walk**2 * dt
    by_metre = errors.walk_by_metre**2 * lengths_m[:, None]
    by_jump = is_jump[:, None] * errors.jump**2
    return by_time + by_metre + by_jump


def _scale_errors(
    errors: SensorErrors, steps: FloatArray, dt: float, rng: np.random.Generator
) -> FloatArray:
    """Draw the errors (N-1, 6) of the increments from a drifting scale."""
    n_steps = len(steps)
    if errors.scale is None:
        return np.zeros((n_steps, 6))
    sigma, tau_s = errors.scale
    phi = np.exp(-dt / tau_s)
    scales = sigma * _markov(n_steps, 1, phi, rng)
    return scale_columns(steps) * scales


def scale_columns(steps: FloatArray) -> FloatArray:
    """Return the errors (N-1, 6) of increments (N-1, 4, 4) per unit of relative scale."""
    rotations = steps[:, :3, :3]
    translations = steps[:, :3, 3]
    rho = np.einsum("nji,nj->ni", rotations, translations)
    return np.concatenate([rho, np.zeros_like(rho)], axis=1)


def _integrated(start: FloatArray, steps: FloatArray) -> FloatArray:
    poses = np.empty((len(steps) + 1, 4, 4))
    poses[0] = start
    for row, step in enumerate(steps):
        poses[row + 1] = poses[row] @ step
    return poses


def _markov(
    count: int, columns: int, phi: float, rng: np.random.Generator
) -> FloatArray:
    """Draw stationary first-order processes (N, columns) of variance 1."""
    values = rng.standard_normal((count, columns))
    innovation_sigma = np.sqrt(1.0 - phi**2)
    values[1:] *= innovation_sigma
    for row in range(1, count):
        values[row] += phi * values[row - 1]
    return values


def _slow(
    process: GaussMarkov, Ts: FloatArray, dt: float, rng: np.random.Generator
) -> FloatArray:
    phi = np.exp(-dt / process.tau_s)
    standard = _markov(len(Ts), 6, phi, rng)
    values = process.sigma * standard
    matrices = directions(process, Ts)
    return np.einsum("nij,nj->ni", matrices, values)


def directions(process: GaussMarkov, Ts: FloatArray) -> FloatArray:
    """Return matrices (N, 6, 6) that map a process to errors in the sensor's frame."""
    matrices = np.tile(np.eye(6), (len(Ts), 1, 1))
    if process.in_world:
        to_body = np.swapaxes(Ts[:, :3, :3], 1, 2)
        matrices[:, :3, :3] = to_body
        matrices[:, 3:, 3:] = to_body
    return matrices
