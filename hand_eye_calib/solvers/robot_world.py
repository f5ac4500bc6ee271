"""Stops: independent poses without an order, ``A_i X = Z B_i`` by robust maximum likelihood.

Where a robot stops, measures and moves on, the poses of neighbours tell no more than those of any
two stops. So each stop is measured against the pose Z of the child's world in the parent's world:
the base of a robot and a target, for instance (robot-world calibration; eye-to-hand if the arm
carries the target).
"""

from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.errors import NotEnoughDataError
from hand_eye_calib.geometry import se3

# A rotation about an axis needs two motions, that is three stops.
MIN_STOPS = 3

# Degrees of freedom of the errors' Student-t distribution. Between 4 and 30 the motions between
# stops that were left out close equally well, to 1 %, on two arms' recordings.
_TAILS = 12.0

# Outliers are left out: a stop this far off (squared distance of six values; 1 in 300,000 if errors
# are normal) under heavy tails of so many degrees of freedom, which few outliers do not widen.
_OUTLIER, _OUTLIER_TAILS = 36.0, 3.0

# Rounds of weights, levels and a Gauss-Newton step, of the fit that finds the outliers and of that
# without them; steps below this many standard deviations end them.
_ROUGH_ROUNDS, _ROUNDS, _SMALL_STEP = 8, 60, 1e-4

# Starts from so many stops each: two in three are clean with a tenth of outliers.
_STARTS, _START_STOPS = 12, 5

# Errors of copied poses are rounding (m^2, rad^2).
_SMALLEST_VARIANCE = 1e-24

# A direction is not determined unless the rotations between stops that show it are larger than this
# multiple of the squared error of a rotation, which looks like rotation itself.
_UNDETERMINED = 8.0

# Standard deviation that stands for "not determined" in the covariance (m, rad).
_UNKNOWN = 1e3

# Errors of stops that follow each other may last: the sums of the scores over so many parts of the
# recording show it.
_PARTS = 6


@dataclass(frozen=True)
class RobotWorld:
    """Solution of ``A_i X = Z B_i``.

    Attributes
    ----------
    T_parent_child, T_world_world : (4, 4) arrays
        X; and Z, the pose of the child's world in the parent's world.
    covariance : (12, 12) array
        Of the right perturbations (rho, phi) of X, then of Z, in the frames of the child and of its
        world. Directions that the stops do not determine have large variances.
    information : (12, 12) array
        Of the same, if the errors of each stop are independent and normal.
    weights : (N,) array
        Weight of each stop, 1 for the errors that the levels expect and less for larger ones.
    level_m, level_rad : float
        Standard deviations of the errors of a stop's position and rotation, per axis.
    objective : float
        Negative log likelihood.
    converged : bool
    """

    T_parent_child: FloatArray
    T_world_world: FloatArray
    covariance: FloatArray
    information: FloatArray
    weights: FloatArray
    level_m: float
    level_rad: float
    objective: float
    converged: bool

    def undetermined(self) -> FloatArray:
        """Directions (6, k) of X, as right perturbations, that the stops do not determine."""
        (own, to_other), (_, other) = self.information.reshape(2, 6, 2, 6).swapaxes(1, 2)
        levels = np.repeat([self.level_m, self.level_rad], 3)
        # In units of the errors of a stop: the squared rotations between stops (rad^2).
        alone = own - to_other @ np.linalg.pinv(other, hermitian=True) @ to_other.T
        alone = alone * np.outer(levels, levels) / max(int(np.sum(self.weights > 0.0)), 1)
        powers, directions = np.linalg.eigh(alone)
        return directions[:, powers < _UNDETERMINED * self.level_rad**2]


def solve(Ts_world_parent: FloatArray, Ts_world_child: FloatArray) -> RobotWorld:
    """The most likely X and Z.

    Parameters
    ----------
    Ts_world_parent : (N, 4, 4) array
        A_i, in the parent's world, such as hand poses in the frame of a robot's base.
    Ts_world_child : (N, 4, 4) array
        B_i, in the child's world, such as poses of a camera in the frame of a target.

    Raises
    ------
    NotEnoughDataError
        If there are fewer than three stops.

    Notes
    -----
    Starts in closed form: rotations by M. Shah, *Solving the robot-world/hand-eye calibration
    problem using the Kronecker product*, Journal of Mechanisms and Robotics 5(3), 2013, eq. 18,
    then translations by linear least squares. Then the errors ``Log(B_i^-1 Z^-1 A_i X)``, moved
    into the frame in which they are likeliest, the child's or that of its world (a target whose
    pose a camera measured), follow a Student-t distribution with one level for positions and one
    for rotations.
    """
    A, B = Ts_world_parent, Ts_world_child
    if len(A) < MIN_STOPS:
        raise NotEnoughDataError(
            f"{len(A)} stops are too few: at least {MIN_STOPS}, with rotations about two axes, are "
            "necessary; 15 or more are better"
        )
    start, fits = _robust_start(A, B), []
    for in_world in (False, True):
        rough = _fit(A, B, *start, in_world, _OUTLIER_TAILS, _ROUGH_ROUNDS)
        kept, weights = rough.weights > 0.0, np.zeros(len(A))
        near = rough.T_parent_child, rough.T_world_world
        fit = _fit(A[kept], B[kept], *near, in_world, _TAILS, _ROUNDS)
        weights[kept] = fit.weights
        fits.append(replace(fit, weights=weights))
    return max(fits, key=_likelihood)


def _likelihood(fit: RobotWorld) -> float:
    """Of fits of one recording that left out different stops: those count as _OUTLIER."""
    left_out = float(np.sum(fit.weights == 0.0))
    levels = 6.0 * (np.log(fit.level_m) + np.log(fit.level_rad))
    return -fit.objective - 0.5 * left_out * (levels + _OUTLIER)


def _closed_form(A: FloatArray, B: FloatArray) -> tuple[FloatArray, FloatArray]:
    """X and Z (4, 4) without weights."""
    # The sum of tr(R_X' R_A' R_Z R_B), as a bilinear form of R_X and R_Z.
    form = np.einsum("nji,nka->iajk", A[:, :3, :3], B[:, :3, :3]).reshape(9, 9)
    left, _, right = np.linalg.svd(form)
    rotation_x, rotation_z = left[:, 0].reshape(3, 3), right[0].reshape(3, 3)
    if np.linalg.det(rotation_x) < 0:
        rotation_x, rotation_z = -rotation_x, -rotation_z
    rotation_x, rotation_z = se3.nearest_rotation(np.stack([rotation_x, rotation_z]))
    columns = np.concatenate([A[:, :3, :3], -np.broadcast_to(np.eye(3), (len(A), 3, 3))], axis=2)
    values = B[:, :3, 3] @ rotation_z.T - A[:, :3, 3]
    translations = np.linalg.lstsq(columns.reshape(-1, 6), values.ravel(), rcond=1e-9)[0]
    return (
        se3.from_rotation_translation(rotation_x, translations[:3]),
        se3.from_rotation_translation(rotation_z, translations[3:]),
    )


def _robust_start(A: FloatArray, B: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The best of the closed forms of all stops and of a few, by the median distance times the
    median angle of the errors.
    """
    random, choices = np.random.default_rng(0), [np.arange(len(A))]
    if len(A) > 2 * _START_STOPS:
        choices += [random.choice(len(A), _START_STOPS, replace=False) for _ in range(_STARTS)]
    candidates = [_closed_form(A[choice], B[choice]) for choice in choices]
    X, Z = (np.stack(each)[:, None] for each in zip(*candidates, strict=True))
    errors = se3.inverse(B) @ se3.inverse(Z) @ A @ X
    tiny = np.finfo(float).tiny
    distance_m = np.median(np.linalg.norm(errors[..., :3, 3], axis=-1), axis=1)
    angle_rad = np.median(se3.rotation_angle(errors[..., :3, :3]), axis=1)
    return candidates[int(np.argmin(np.log(distance_m + tiny) + np.log(angle_rad + tiny)))]


def _linearise(
    A: FloatArray, B: FloatArray, X: FloatArray, Z: FloatArray, in_world: bool
) -> tuple[FloatArray, FloatArray]:
    """Errors (N, 6), in the frame of the child or of its world, and their derivatives (N, 6, 12) by
    X and Z.
    """
    predicted = se3.inverse(Z) @ A @ X
    errors = se3.log(se3.inverse(B) @ predicted)
    by_X = np.broadcast_to(np.eye(6), (len(A), 6, 6))
    jacobian = np.concatenate([by_X, -se3.adjoint(se3.inverse(predicted))], axis=2)
    if in_world:
        moved = se3.adjoint(B)
        errors, jacobian = (moved @ errors[..., None])[..., 0], moved @ jacobian
    return errors, jacobian


def _lasting(gradients: FloatArray, information: FloatArray) -> float:
    """Factor on the covariance, at least 1, for errors that last from stop to stop."""
    parts = np.array_split(gradients, min(_PARTS, len(gradients)))
    sums = np.array([part.sum(axis=0) for part in parts])
    inverse = np.linalg.pinv(information, hermitian=True)
    spread = float(np.einsum("ki,ij,kj->", sums, inverse, sums))
    return max(1.0, spread / (len(information) * (1.0 - 1.0 / len(parts))))


def _fit(
    A: FloatArray,
    B: FloatArray,
    X: FloatArray,
    Z: FloatArray,
    in_world: bool,
    tails: float,
    rounds: int,
) -> RobotWorld:
    """Weights, levels and Gauss-Newton steps in turn."""
    n = len(A)
    # Values that the errors are fitted with make them smaller.
    n_free = max(3.0 * n - 6.0, 0.5)
    weights, converged = np.ones(n), False
    for _ in range(rounds):
        errors, jacobian = _linearise(A, B, X, Z, in_world)
        squared = np.sum(errors.reshape(n, 2, 3) ** 2, axis=2)
        variances = np.maximum(weights @ squared / n_free, _SMALLEST_VARIANCE)
        distance = squared @ (1.0 / variances)
        weights = (tails + 6.0) / (tails + distance)
        scale = np.sqrt(weights[:, None] * np.repeat(1.0 / variances, 3))
        rows = scale[..., None] * jacobian
        information = (np.swapaxes(rows, 1, 2) @ rows).sum(axis=0)
        gradients = np.einsum("nki,nk->ni", rows, scale * errors)
        gradient = gradients.sum(axis=0)
        step = -np.linalg.lstsq(information, gradient, rcond=1e-13)[0]
        X, Z = X @ se3.exp(step[:6]), Z @ se3.exp(step[6:])
        converged = bool(-step @ gradient < _SMALL_STEP**2)
        if converged:
            break
    # Of normal errors under a Student-t likelihood: Lange, Little, Taylor, *Robust statistical
    # modeling using the t distribution*, JASA 84, 1989, section 4.
    share = (tails + 6.0) / (tails + 8.0)
    rows = np.sqrt(share * np.repeat(1.0 / variances, 3))[:, None] * jacobian
    fisher = (np.swapaxes(rows, 1, 2) @ rows).sum(axis=0)
    weak = np.diag(np.tile(np.repeat(1.0 / variances, 3), 2) / _UNKNOWN**2)
    log_likelihood = (
        -1.5 * n * np.log(variances).sum() - 0.5 * (tails + 6.0) * np.log1p(distance / tails).sum()
    )
    return RobotWorld(
        T_parent_child=X,
        T_world_world=Z,
        covariance=np.linalg.inv(fisher + weak) * _lasting(gradients, information),
        information=fisher,
        weights=np.where(distance < _OUTLIER, np.minimum(weights, 1.0), 0.0),
        level_m=float(np.sqrt(variances[0])),
        level_rad=float(np.sqrt(variances[1])),
        objective=-float(log_likelihood),
        converged=converged,
    )
