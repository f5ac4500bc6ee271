"""An extrinsic that somebody states: what is installed, or what a calibration found; and how far
one is from another.
"""

from dataclasses import dataclass, field

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3

# Standard deviations above this (rad) count as unknown: the derivative does not hold that far.
_UNKNOWN_ANGLE = 0.3

# Roll and yaw cannot be separated if the cosine of the pitch is below this many standard deviations
# of the rotation: their own would be 10 deg and more, and far from normal.
_LOCKED_SIGMAS = 5.0
_LOCKED_COSINE = 1e-4


@dataclass(frozen=True)
class Extrinsic:
    """Pose of the child sensor in the parent sensor's frame, as stated by a source.

    Attributes
    ----------
    T_parent_child : (4, 4) array
    origin : str
        Where it comes from, for a person.
    covariance : (6, 6) array
        Of the error xi in ``T_parent_child @ exp(xi)``; zero if the source states none.
    is_calibration : bool
        Whether it was found from motion, with the same sensors.
    """

    T_parent_child: FloatArray
    origin: str
    covariance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    is_calibration: bool = False

    @property
    def values(self) -> FloatArray:
        """(6,) array: x, y, z (m) and roll, pitch, yaw (rad)."""
        rpy = se3.rotation_to_rpy(self.T_parent_child[:3, :3])
        return np.r_[self.T_parent_child[:3, 3], rpy]


def turned(rotation: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariances (..., 6, 6) along and about axes that rotations (..., 3, 3) turn theirs to.

    Of a pose they are as ROS messages carry them (REP-103): the engine's error xi = (rho, phi) in
    ``T_parent_child @ exp(xi)`` moves the child's origin by ``R rho``, to first order, and rotates
    the child by ``R phi`` about the parent's axes through that origin. There is no lever arm.
    """
    both = np.kron(np.eye(2), rotation)
    return np.asarray(both @ covariance @ np.swapaxes(both, -1, -2))


def sigmas_in_parent(rotation_parent_child: FloatArray, covariance: FloatArray) -> FloatArray:
    """Standard deviations (6,) along and about the parent's axes."""
    variances = np.diag(turned(rotation_parent_child, covariance))
    return np.asarray(np.sqrt(np.maximum(variances, 0.0)))


def sigmas_rpy(T_target_source: FloatArray, covariance: FloatArray) -> FloatArray:
    """Standard deviations (3,) of roll, pitch and yaw, rad, to first order.

    Parameters
    ----------
    T_target_source : (4, 4) array
    covariance : (6, 6) array
        Of xi = (rho, phi) in ``T_target_source @ exp(xi)``, m and rad.

    Returns
    -------
    (3,) array
        Infinite if an angle is unknown; near gimbal lock roll and yaw are.
    """
    rotation = np.asarray(T_target_source, dtype=float)[:3, :3]
    covariance = np.asarray(covariance, dtype=float)[3:, 3:]
    if not np.isfinite(covariance).all():
        return np.full(3, np.inf)
    roll, pitch, _ = se3.rotation_to_rpy(rotation)
    sine, cosine, tangent = np.sin(roll), np.cos(roll), np.tan(pitch)
    # Derivative of roll, pitch and yaw with respect to phi in R exp(phi).
    jacobian = np.array(
        [
            [1.0, sine * tangent, cosine * tangent],
            [0.0, cosine, -sine],
            [0.0, sine / np.cos(pitch), cosine / np.cos(pitch)],
        ]
    )
    sigmas = np.sqrt(np.maximum(np.diag(jacobian @ covariance @ jacobian.T), 0.0))
    sigmas[sigmas > _UNKNOWN_ANGLE] = np.inf
    of_rotation = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance), 0.0))
    largest = np.max(of_rotation[of_rotation <= _UNKNOWN_ANGLE], initial=0.0)
    if np.hypot(rotation[0, 0], rotation[1, 0]) < max(_LOCKED_SIGMAS * largest, _LOCKED_COSINE):
        sigmas[[0, 2]] = np.inf
    return sigmas


def sigmas_translation(T_target_source: FloatArray, covariance: FloatArray) -> FloatArray:
    """Standard deviations (3,) of the translation along the axes of the target frame, m, of a
    transform (4, 4) and a covariance (6, 6) as for :func:`sigmas_rpy`.
    """
    rotation = np.asarray(T_target_source, dtype=float)[:3, :3]
    covariance = np.asarray(covariance, dtype=float)[:3, :3]
    if not np.isfinite(covariance).all():
        return np.full(3, np.inf)
    return np.sqrt(np.maximum(np.diag(rotation @ covariance @ rotation.T), 0.0))


def inverse_covariance(T_target_source: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariance (6, 6) of the inverse transform, in the same convention.

    ``inverse(T exp(xi)) = inverse(T) exp(-Ad_T xi)``, so the covariance is ``Ad_T C Ad_T'``.
    """
    covariance = np.asarray(covariance, dtype=float)
    if not np.isfinite(covariance).all():
        return np.full((6, 6), np.inf)
    adjoint = se3.adjoint(np.asarray(T_target_source, dtype=float))
    return adjoint @ covariance @ adjoint.T


def absolute_errors(
    T_parent_child: FloatArray, truth_T_parent_child: FloatArray
) -> tuple[float, float]:
    """Absolute errors e_at (m) and e_aR (rad) of a transform (4, 4) against the true one: eqs 8 and
    9 of Välimäki et al. 2023.
    """
    translation = np.linalg.norm(truth_T_parent_child[:3, 3] - T_parent_child[:3, 3])
    rotation = se3.rotation_angle(T_parent_child[:3, :3].T @ truth_T_parent_child[:3, :3])
    return float(translation), float(rotation)


def deviation(T_parent_child: FloatArray, T_reference: FloatArray) -> FloatArray:
    """Deviations (..., 6) of transforms (..., 4, 4) from another (4, 4), along (m) and about (rad)
    the axes of the parent sensor's frame.
    """
    rotation = se3.rotation_log(T_parent_child[..., :3, :3] @ T_reference[:3, :3].T)
    translation = T_parent_child[..., :3, 3] - T_reference[:3, 3]
    return np.concatenate([translation, rotation], axis=-1)
