"""Robust closed-form fit of stops under an assumed mistake of their conventions.

Stops obey ``A_i X = Z B_i``, see :mod:`hand_eye_calib.extras.stops.robot_world`. Rotations are
fitted first, by M. Shah's closed form with Cauchy weights. Then the translations of X and Z, and a
factor s of the child's lengths, follow from a robust linear regression of
``R_A t_X - t_Z - s R_Z t_B = -t_A``. The residuals are compared with the spread of the poses, and
with the errors of positions that the errors of the rotations cause.
"""

from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import median, medians, robust_regression, robust_weights
from hand_eye_calib.core.checks.findings import CONVENTIONS
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops.closed_form import Stops, closest_rotations

# Largest number of stops that are compared with each other: the time grows with its square.
MOST_COMPARED = 150

# Rounds of reweighting of a fit.
_ROUNDS = 8

# A hand or a target that rotates less than this between stops (rad) hardly rotates: 3 deg.
LEAST_TURN_RAD = 0.05

# Division by a length (m) or an angle (rad) of exact poses.
_TINY = 1e-12

# A mistake, or a factor of lengths, is certain if the log likelihood gains this much, and the
# logarithm of 2 for each of the three coordinates of each stop. Measured: mistakes in 30 stops of
# KinHEC with strong noise gain 190 to 400, where 62 are asked for.
_LEAST_GAIN = 36.0
_GAIN_PER_COORDINATE = float(np.log(2.0))


@dataclass(frozen=True)
class StopPoses:
    """Poses of both sensors at N stops, in the conventions of their source.

    Attributes
    ----------
    parent, child : (N, 4, 4) arrays
        Poses of the parent sensor in its world, and of the child sensor in its own world. For an
        arm: poses of the hand in the base, and of the target in the camera.
    is_arm : bool
        True for an arm: both setups are tried, a camera on the hand and beside the robot.
    has_positions : bool
        False if only the rotations are known.
    """

    parent: FloatArray
    child: FloatArray
    is_arm: bool = False
    has_positions: bool = True

    def __len__(self) -> int:
        return len(self.parent)

    @property
    def ways(self) -> tuple[bool, ...]:
        """Values of ``Mistakes.is_inverse`` that are no mistake."""
        return (False, True) if self.is_arm else (False,)

    def sample(self) -> "StopPoses":
        """Return at most 150 of the stops, evenly spread."""
        n = len(self)
        rows = np.unique(np.linspace(0, n - 1, min(n, MOST_COMPARED)).astype(np.int64))
        return replace(self, parent=self.parent[rows], child=self.child[rows])

    def with_side(self, stream: str, Ts: FloatArray) -> "StopPoses":
        """Return the stops with other poses (N, 4, 4) of the parent or the child."""
        return replace(self, parent=Ts) if stream == "parent" else replace(self, child=Ts)

    def without(self, mistakes: "Mistakes", scale: float = 1.0) -> Stops:
        """Return A and B of ``A X = Z B`` with mistakes undone and the child's lengths scaled."""
        A = _in_usual_convention(self.parent, mistakes.parent)
        B = _in_usual_convention(scaled(self.child, scale), mistakes.child)
        if self.is_arm:
            B = se3.inverse(B)
        if mistakes.is_inverse:
            A = se3.inverse(A)
        return Stops(A, B)


@dataclass(frozen=True)
class Mistakes:
    """Assumed mistakes of the conventions of stops.

    Attributes
    ----------
    parent, child : str
        Codes of the conventions that are wrong, keys of ``CONVENTIONS``; empty for none.
    is_inverse : bool
        Whether one side has inverse poses. For an arm: whether the camera is beside the robot.
    """

    parent: str = ""
    child: str = ""
    is_inverse: bool = False

    @property
    def complexity(self) -> int:
        """Number of different mistakes: one exporter often makes the same mistake on both sides."""
        return len({self.parent, self.child} - {""})


@dataclass(frozen=True)
class RoughFit:
    """Quality of a robust closed-form fit of ``A X = Z B``.

    Attributes
    ----------
    mistakes : Mistakes
        Undone before the fit.
    turning, placing : float
        Unexplained shares of the rotations and of the positions: median residual over spread.
    beyond : float
        Median residual of the positions over the error that the rotation residuals cause.
    scale : float or None
        Factor of the child's lengths; None if the stops do not determine it.
    log_likelihood : float
        Of the median residuals, up to a constant.
    """

    mistakes: Mistakes
    turning: float
    placing: float
    beyond: float = 0.0
    scale: float | None = None
    log_likelihood: float = 0.0

    @property
    def unexplained(self) -> float:
        """The larger one of both shares."""
        return max(self.turning, self.placing)


def certain_gain(n_stops: int) -> float:
    """Return the gain of log likelihood from which on a mistake in so many stops is certain."""
    return max(_LEAST_GAIN, 3.0 * n_stops * _GAIN_PER_COORDINATE)


def scaled(Ts: FloatArray, factor: float) -> FloatArray:
    """Return poses (N, 4, 4) with their lengths multiplied by a factor."""
    return se3.from_rotation_translation(se3.rotation_of(Ts), factor * se3.translation_of(Ts))


def angles_between(Ts: FloatArray) -> FloatArray:
    """Return the angles (N, N), rad, of the rotations between stops."""
    quats = se3.to_quat_xyzw(Ts)
    return np.asarray(2.0 * np.arccos(np.clip(np.abs(quats @ quats.T), 0.0, 1.0)))


def above_diagonal(angles: FloatArray) -> FloatArray:
    """Return the values of a symmetric matrix (N, N) above its diagonal."""
    return np.asarray(angles[np.triu_indices(len(angles), 1)])


def median_difference(first: FloatArray, second: FloatArray) -> float:
    """Return the median difference between two symmetric matrices (N, N) of angles, rad."""
    return median(np.abs(above_diagonal(first - second)))


def spread(positions: FloatArray) -> float:
    """Return the median distance (m) of positions (N, 3) from their median."""
    return median(np.linalg.norm(positions - medians(positions.T), axis=1))


def turns_about_two_axes(Ts: FloatArray) -> bool:
    """Return whether poses (N, 4, 4) differ by 3 deg or more about at least two axes."""
    rotations = se3.rotation_of(Ts)
    central = rotations[int(np.argmin(medians(angles_between(Ts))))]
    vectors = se3.rotation_log(central.T @ rotations)
    sizes_rad = np.linalg.svd(vectors, compute_uv=False) / np.sqrt(len(vectors))
    return bool(sizes_rad[1] > LEAST_TURN_RAD)


def rough_fit(poses: StopPoses, mistakes: Mistakes) -> RoughFit:
    """Fit stops with mistakes undone, with a factor of the child's lengths if it is determined."""
    stops = poses.without(mistakes)
    A = stops.Ts_world_parent
    B = stops.Ts_world_child
    weights = np.ones(len(A))
    for _ in range(_ROUNDS):
        X, Z = closest_rotations(se3.rotation_of(A), se3.rotation_of(B), weights)
        angles_rad = se3.rotation_angle(
            np.swapaxes(Z @ se3.rotation_of(B), 1, 2) @ se3.rotation_of(A) @ X
        )
        weights = robust_weights("cauchy", (angles_rad / max(median(angles_rad), _TINY)) ** 2)
    error_rad = median(angles_rad)
    turns_rad = [median(above_diagonal(angles_between(Ts))) for Ts in (A, B)]
    # Rotations of few degrees are not judged: noise may be as large.
    turning = error_rad / max(*turns_rad, LEAST_TURN_RAD)
    if not poses.has_positions:
        return RoughFit(mistakes, turning, 0.0)
    placing, error_m, scale = _fit_positions(A, B, Z)
    distance_m = (scale or 1.0) * median(np.linalg.norm(se3.translation_of(B), axis=1))
    logs = np.log(max(error_rad, _TINY)) + np.log(max(error_m, _TINY))
    return RoughFit(
        mistakes=mistakes,
        turning=turning,
        placing=placing,
        beyond=error_m / max(error_rad * distance_m, _TINY),
        scale=scale,
        log_likelihood=-3.0 * len(A) * float(logs),
    )


def _in_usual_convention(Ts: FloatArray, code: str) -> FloatArray:
    """Return poses with the mistake of a code undone."""
    if not code:
        return Ts
    option, value = CONVENTIONS[code]
    return se3.put_right(Ts, **{option: value})


def _fit_positions(
    A: FloatArray, B: FloatArray, R_Z: FloatArray
) -> tuple[float, float, float | None]:
    """Return the unexplained share of the positions, their median residual (m), and the factor of
    the child's lengths; None if the stops do not determine the factor.
    """
    of_parent = se3.translation_of(A)
    of_child = se3.translation_of(B) @ R_Z.T
    minus_one = np.broadcast_to(-np.eye(3), (len(A), 3, 3))
    levers = np.concatenate([se3.rotation_of(A), minus_one], axis=2)
    with_factor = np.concatenate([levers, -of_child[:, :, None]], axis=2)
    error_of_none, _ = _regression(levers, of_parent)
    error_of_free, values = _regression(with_factor, of_parent)
    scale = float(values[6])
    gain = certain_gain(len(A)) / (3.0 * len(A))
    if scale > 0.0 and error_of_none > error_of_free * np.exp(gain):
        smaller_spread = min(spread(of_parent), scale * spread(of_child))
        return error_of_free / max(smaller_spread, _TINY), error_of_free, scale
    # A hand that moves about one point, or a fault: one unit of length.
    error, _ = _regression(levers, of_parent - of_child)
    return error / max(spread(of_parent), spread(of_child), _TINY), error, None


def _regression(rows: FloatArray, positions: FloatArray) -> tuple[float, FloatArray]:
    """Return the median length of ``rows @ values + positions``, and the robust values (k,)."""
    values, lengths = robust_regression("cauchy", rows, -positions, _ROUNDS, median)
    return median(lengths), values
