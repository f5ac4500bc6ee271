"""Fast robust fit of stops, which tests a hypothesis about their conventions.

A hypothesis is a mistake, such as a wrong order of quaternions, that is undone before the fit.
Stops obey ``A_i X = Z B_i``, see :mod:`hand_eye_calib.extras.stops.robot_world`. The rotations are
fitted first, by M. Shah's closed form with Cauchy weights. The translations of X and Z, and a scale
s of the child's lengths, follow from a robust linear regression of ``R_A t_X - t_Z - s R_Z t_B =
-t_A``. Right conventions leave residuals that are small relative to the spread of the poses, and as
small as the rotation errors predict.
"""

from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import (
    median,
    medians,
    robust_regression,
    robust_weights,
)
from hand_eye_calib.core.checks.findings import CONVENTIONS
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops.closed_form import Stops, closest_rotations

# Largest number of stops that are compared with each other. The time grows with its square.
MAX_COMPARED = 150

# Number of iterations for the robust weights of a fit.
_MAX_ROUNDS = 8

# Rotations between stops below this angle (rad; 3 deg) cannot reveal wrong conventions.
MIN_TURN_RAD = 0.05

# Smallest divisor. Lengths (m) or angles (rad) of noise-free poses may be zero.
_TINY = 1e-12

# A mistake is certain if undoing it increases the log likelihood by at least both limits: this
# constant, and log 2 per coordinate (three per stop), as if the errors were halved. Measured in 30
# stops of KinHEC with strong noise: to undo a mistake increases the log likelihood by 190 to 400.
# The larger limit is 62 for 30 stops.
_MIN_GAIN = 36.0
# Limit per coordinate.
_GAIN_PER_COORDINATE = float(np.log(2.0))


@dataclass(frozen=True)
class StopPoses:
    """Poses of both sensors at N stops, in the conventions of the user's files.

    Attributes
    ----------
    parent, child : (N, 4, 4) arrays
        Poses of the parent sensor in its world, and of the child sensor in its own world. For an
        arm: poses of the hand in the base, and of the camera in the target.
    is_arm : bool
        Whether the poses are from an arm: the camera may be on the hand or beside the robot.
    has_target : bool
        Whether the poses of the child are poses of the target in the camera.
    has_positions : bool
        Whether positions are known, in addition to rotations.
    """

    parent: FloatArray
    child: FloatArray
    is_arm: bool = False
    has_positions: bool = True
    has_target: bool = False

    def __len__(self) -> int:
        return len(self.parent)

    @property
    def possible_inversions(self) -> tuple[bool, ...]:
        """Values of ``Mistakes.is_inverse`` that can be right."""
        return (False, True) if self.is_arm else (False,)

    def sample(self) -> "StopPoses":
        """Return at most ``MAX_COMPARED`` of the stops, evenly spread."""
        n = len(self)
        rows = np.unique(
            np.linspace(0, n - 1, min(n, MAX_COMPARED)).astype(np.int64)
        )
        return replace(self, parent=self.parent[rows], child=self.child[rows])

    def with_side(self, stream: str, Ts: FloatArray) -> "StopPoses":
        """Return the stops with other poses (N, 4, 4) of the parent or the child."""
        return (
            replace(self, parent=Ts)
            if stream == "parent"
            else replace(self, child=Ts)
        )

    def without(self, mistakes: "Mistakes", scale: float = 1.0) -> Stops:
        """Return the stops of ``A X = Z B`` without mistakes, with scaled lengths of the child."""
        A = _in_usual_convention(self.parent, mistakes.parent)
        B = _in_usual_convention(scaled(self.child, scale), mistakes.child)
        if self.has_target:
            B = se3.inverse(B)
        if mistakes.is_inverse:
            A = se3.inverse(A)
        return Stops(A, B, has_target=self.is_arm)


@dataclass(frozen=True)
class Mistakes:
    """Hypothesis about mistakes in the conventions of stops.

    Attributes
    ----------
    parent, child : str
        Mistake of each side, a key of ``CONVENTIONS`` such as ``quaternion_order``; empty for none.
    is_inverse : bool
        Whether one side has inverse poses. For an arm: whether the camera is beside the robot.
    """

    parent: str = ""
    child: str = ""
    is_inverse: bool = False

    @property
    def complexity(self) -> int:
        """Number of different mistakes. The same mistake on both sides counts once."""
        return len({self.parent, self.child} - {""})


@dataclass(frozen=True)
class RoughFit:
    """Quality of a rough fit of ``A X = Z B`` under a hypothesis.

    Attributes
    ----------
    mistakes : Mistakes
        Hypothesis: mistakes that were undone before the fit.
    rotation_share, position_share : float
        Unexplained shares of rotations and positions: median residual divided by spread. It is 0
        for a perfect fit, and about 1 for sides that do not belong together.
    position_ratio : float
        Median residual of the positions, divided by the position error that the rotation errors
        cause at the distance of the target.
    scale : float or None
        Factor of the child's lengths; None if the stops do not determine it.
    log_likelihood : float
        Log likelihood of the median residuals, up to a constant.
    """

    mistakes: Mistakes
    rotation_share: float
    position_share: float
    position_ratio: float = 0.0
    scale: float | None = None
    log_likelihood: float = 0.0

    @property
    def unexplained_share(self) -> float:
        """Larger of the unexplained shares of rotations and positions."""
        return max(self.rotation_share, self.position_share)


def min_certain_gain(n_stops: int) -> float:
    """Return the smallest gain of log likelihood for which a mistake in n stops is certain."""
    return max(_MIN_GAIN, 3.0 * n_stops * _GAIN_PER_COORDINATE)


def scaled(Ts: FloatArray, factor: float) -> FloatArray:
    """Return poses (N, 4, 4) with their translations multiplied by a factor."""
    return se3.from_rotation_translation(
        se3.rotation_of(Ts), factor * se3.translation_of(Ts)
    )


def angles_between(Ts: FloatArray) -> FloatArray:
    """Return the angles (N, N) of the rotations between all pairs of stops, rad."""
    quats = se3.to_quat_xyzw(Ts)
    return np.asarray(
        2.0 * np.arccos(np.clip(np.abs(quats @ quats.T), 0.0, 1.0))
    )


def above_diagonal(angles: FloatArray) -> FloatArray:
    """Return the N (N - 1) / 2 values of a matrix (N, N) above its diagonal."""
    return np.asarray(angles[np.triu_indices(len(angles), 1)])


def median_difference(first: FloatArray, second: FloatArray) -> float:
    """Return the median difference between two symmetric matrices (N, N) of angles, rad."""
    return median(np.abs(above_diagonal(first - second)))


def spread(positions: FloatArray) -> float:
    """Return the median distance (m) of positions (N, 3) from their median position."""
    return median(np.linalg.norm(positions - medians(positions.T), axis=1))


def turns_about_two_axes(Ts: FloatArray) -> bool:
    """Return whether the orientations (N, 4, 4) vary by more than 3 deg (rms) about two axes."""
    rotations = se3.rotation_of(Ts)
    central = rotations[int(np.argmin(medians(angles_between(Ts))))]
    vectors = se3.rotation_log(central.T @ rotations)
    sizes_rad = np.linalg.svd(vectors, compute_uv=False) / np.sqrt(len(vectors))
    return bool(sizes_rad[1] > MIN_TURN_RAD)


def rough_fit(poses: StopPoses, mistakes: Mistakes) -> RoughFit:
    """Fit stops with mistakes undone, and a scale of the child's lengths if it is determined."""
    stops = poses.without(mistakes)
    A = stops.Ts_world_parent
    B = stops.Ts_world_child
    error_rad, Z = _fit_rotations(se3.rotation_of(A), se3.rotation_of(B))
    turns_rad = [median(above_diagonal(angles_between(Ts))) for Ts in (A, B)]
    # Noise may be as large as rotations of a few degrees. Limit the divisor, so that their share is
    # small.
    rotation_share = error_rad / max(*turns_rad, MIN_TURN_RAD)
    if not poses.has_positions:
        return RoughFit(mistakes, rotation_share, 0.0)
    position_share, error_m, scale = _fit_positions(A, B, Z)
    distance_m = (scale or 1.0) * median(
        np.linalg.norm(se3.translation_of(B), axis=1)
    )
    logs = np.log(max(error_rad, _TINY)) + np.log(max(error_m, _TINY))
    return RoughFit(
        mistakes=mistakes,
        rotation_share=rotation_share,
        position_share=position_share,
        position_ratio=error_m / max(error_rad * distance_m, _TINY),
        scale=scale,
        log_likelihood=-3.0 * len(A) * float(logs),
    )


def _fit_rotations(
    R_A: FloatArray, R_B: FloatArray
) -> tuple[float, FloatArray]:
    """Return the median residual (rad) of ``R_A X = Z R_B``, and the rotation Z (3, 3)."""
    weights = np.ones(len(R_A))
    for _ in range(_MAX_ROUNDS):
        X, Z = closest_rotations(R_A, R_B, weights)
        residuals = se3.relative_rotations(Z @ R_B, R_A) @ X
        angles_rad = se3.rotation_angle(residuals)
        error_rad = median(angles_rad)
        weights = robust_weights(
            "cauchy", (angles_rad / max(error_rad, _TINY)) ** 2
        )
    return error_rad, Z


def _in_usual_convention(Ts: FloatArray, code: str) -> FloatArray:
    """Return poses with a mistake, a key of ``CONVENTIONS``, undone; unchanged if it is empty."""
    if not code:
        return Ts
    option, value = CONVENTIONS[code]
    return se3.put_right(Ts, **{option: value})


def _fit_positions(
    A: FloatArray, B: FloatArray, R_Z: FloatArray
) -> tuple[float, float, float | None]:
    """Return unexplained share and median residual (m) of the positions, and the child's scale.

    The scale is a factor of the child's lengths; None if the stops do not determine it.
    """
    of_parent = se3.translation_of(A)
    of_child = se3.translation_of(B) @ R_Z.T
    minus_one = np.broadcast_to(-np.eye(3), (len(A), 3, 3))
    levers = np.concatenate([se3.rotation_of(A), minus_one], axis=2)
    with_factor = np.concatenate([levers, -of_child[:, :, None]], axis=2)
    error_of_none, _ = _regression(levers, of_parent)
    error_of_free, values = _regression(with_factor, of_parent)
    scale = float(values[6])
    gain = min_certain_gain(len(A)) / (3.0 * len(A))
    if scale > 0.0 and error_of_none > error_of_free * np.exp(gain):
        smaller_spread = min(spread(of_parent), scale * spread(of_child))
        return error_of_free / max(smaller_spread, _TINY), error_of_free, scale
    # The scale is undetermined: the hand only rotates about one point, or there is a mistake. Both
    # sides must have the same unit of length in this case.
    error, _ = _regression(levers, of_parent - of_child)
    return error / max(spread(of_parent), spread(of_child), _TINY), error, None


def _regression(
    rows: FloatArray, positions: FloatArray
) -> tuple[float, FloatArray]:
    """Return the median residual (m) of ``rows @ values = -positions``, and the values (k,).

    The regression is robust (Cauchy weights). ``rows`` (N, 3, k), ``positions`` (N, 3).
    """
    values, lengths = robust_regression(
        "cauchy", rows, -positions, _MAX_ROUNDS, median
    )
    return median(lengths), values
