"""Covariances of rigid transforms: rotated, inverted, and as standard deviations.

A covariance is that of xi = (rho, phi), m and rad, in ``T_target_source @ exp(xi)``.
"""

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry.se3 import (
    adjoint,
    block_diagonal,
    rotation_of,
    rotation_to_rpy,
)

# Largest standard deviation (rad) of an angle that counts as known. The linearisation is invalid
# above it.
_MAX_SIGMA_RAD = 0.3

# Roll and yaw are unknown (gimbal lock) if the cosine of the pitch is below this number times the
# standard deviation (rad) of the rotation. The standard deviations of roll and yaw would exceed
# 10 deg, and their errors would not be normal.
_LOCKED_SIGMAS = 5.0

# Smallest cosine of the pitch at which exact rotations have known roll and yaw.
_LOCKED_COSINE = 1e-4


def turned(rotation: FloatArray, covariance: FloatArray) -> FloatArray:
    """Rotate covariances (..., 6, 6) of xi = (rho, phi) by rotations R (..., 3, 3).

    If R is the rotation of ``T_parent_child``, the result is along and about the parent's axes, the
    convention of ROS messages (REP 103). To first order, an error xi in ``T_parent_child @
    exp(xi)`` moves the origin of the child by ``R rho``, and rotates the child by ``R phi`` about
    this origin. Therefore the lever arm between the sensors has no effect.
    """
    both = block_diagonal(rotation)
    return both @ covariance @ np.swapaxes(both, -1, -2)


def sigmas_in_parent(
    rotation_parent_child: FloatArray, covariance: FloatArray
) -> FloatArray:
    """Return standard deviations (6,), m and rad, along and about the parent's axes.

    If the covariance (6, 6) of xi in the child's frame is not finite, all values are infinite.
    """
    if not np.isfinite(covariance).all():
        return np.full(6, np.inf)
    variances = np.diag(turned(rotation_parent_child, covariance))
    return np.sqrt(np.maximum(variances, 0.0))


def sigmas_rpy(
    T_target_source: FloatArray, covariance: FloatArray
) -> FloatArray:
    """Return standard deviations (3,) of roll, pitch and yaw, rad, to first order.

    Parameters
    ----------
    T_target_source : (4, 4) array
    covariance : (6, 6) array
        Covariance of xi = (rho, phi) in ``T_target_source @ exp(xi)``, m and rad.

    Returns
    -------
    (3,) array
        Infinite for unknown angles, such as roll and yaw near gimbal lock.
    """
    rotation = rotation_of(np.asarray(T_target_source, dtype=float))
    covariance = np.asarray(covariance, dtype=float)[3:, 3:]
    if not np.isfinite(covariance).all():
        return np.full(3, np.inf)
    roll, pitch, _ = rotation_to_rpy(rotation)
    sine = np.sin(roll)
    cosine = np.cos(roll)
    tangent = np.tan(pitch)
    # Derivative of roll, pitch and yaw with respect to phi in R exp(phi).
    jacobian = np.array(
        [
            [1.0, sine * tangent, cosine * tangent],
            [0.0, cosine, -sine],
            [0.0, sine / np.cos(pitch), cosine / np.cos(pitch)],
        ]
    )
    sigmas = np.sqrt(
        np.maximum(np.diag(jacobian @ covariance @ jacobian.T), 0.0)
    )
    sigmas[sigmas > _MAX_SIGMA_RAD] = np.inf
    # Standard deviations about the principal axes. Unknown axes do not count.
    principal = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance), 0.0))
    largest = np.max(principal[principal <= _MAX_SIGMA_RAD], initial=0.0)
    cosine_of_pitch = np.hypot(rotation[0, 0], rotation[1, 0])
    if cosine_of_pitch < max(_LOCKED_SIGMAS * largest, _LOCKED_COSINE):
        sigmas[[0, 2]] = np.inf
    return sigmas


def inverse_covariance(
    T_target_source: FloatArray, covariance: FloatArray
) -> FloatArray:
    """Return the covariance (6, 6) of the inverse of a transform T with covariance C (6, 6) of xi.

    ``inverse(T exp(xi)) = inverse(T) exp(-Ad_T xi)``, so the covariance is ``Ad_T C Ad_T'``. If C
    is not finite, all elements are infinite.
    """
    covariance = np.asarray(covariance, dtype=float)
    if not np.isfinite(covariance).all():
        return np.full((6, 6), np.inf)
    moved = adjoint(np.asarray(T_target_source, dtype=float))
    return moved @ covariance @ moved.T
