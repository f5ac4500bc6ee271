"""What a person knows beforehand, brought together with what the motion says.

An answer with its covariance is a measurement; a tape measure is another. Both are weighed by their
covariances, whatever method the answer comes from. Along a direction that the motion does not
reveal only the prior counts; where there is none, the child sensor is put level with the parent
along it (zero, not the value that noise would give), and the direction stays unknown.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.assessment.covariance import (
    UNKNOWN_ROTATION,
    UNKNOWN_SIGMAS,
    UNKNOWN_TRANSLATION,
    WEAK_ROTATION,
    WEAK_TRANSLATION,
    Assessment,
)
from hand_eye_calib.calibration import DofObservability, DofVerdict
from hand_eye_calib.geometry import se3

TRANSLATIONS, ROTATIONS = ("x", "y", "z"), ("roll", "pitch", "yaw")

# A direction is unknown where its variance is this share of that of what is unknown, and an axis
# known again below this share of the standard deviation.
_UNKNOWN_SHARE, _KNOWN_SHARE = 0.25, 0.1

# A prior says most of it where it at least halves the variance.
_PRIOR_SAYS_MOST = 0.5

_MAX_STEPS, _STEP_TOLERANCE = 20, 1e-12
_DIFFERENCE = 1e-6

# Perfect data has no variance at all; what is divided by is never below this (m^2 or rad^2).
_ROUNDING_VARIANCE = 1e-18

# A prior this many standard deviations from what the motion says contradicts it.
_CONTRADICTION = 4.0


@dataclass(frozen=True)
class Fused:
    """Motion and prior together.

    Attributes
    ----------
    T_parent_child : (4, 4) array
    assessment : Assessment
        Covariance and verdicts of both together.
    contradictions : dict
        Axis names to the number of standard deviations between prior and motion, where there are
        too many.
    """

    T_parent_child: np.ndarray
    assessment: Assessment
    contradictions: dict


def fuse(T_parent_child, assessment, prior):
    """Weigh an answer against a prior, and settle what neither of them knows.

    Parameters
    ----------
    T_parent_child : (4, 4) array
        The answer from motion.
    assessment : Assessment
        Of that answer.
    prior : dict
        Axis name (x, y, z, roll, pitch, yaw; of the child sensor's pose in the parent sensor's
        frame, angles about fixed axes) to (value, sigma), in m and rad. May be empty.

    Returns
    -------
    Fused
    """
    covariance = assessment.cov_parent_child_in_child
    unknown = _unknown_directions(covariance)
    if not prior and not unknown.shape[1]:
        return Fused(T_parent_child, assessment, {})
    root, inverse_root, targets = _whitened(T_parent_child, covariance, unknown)
    T = T_parent_child
    for _ in range(_MAX_STEPS):
        residuals, jacobian = _prior_residuals(T, prior)
        jacobian = jacobian @ root
        normal = np.eye(6) + jacobian.T @ jacobian
        deviations = inverse_root @ _difference(T_parent_child, T) - targets
        step = -root @ np.linalg.solve(normal, deviations + jacobian.T @ residuals)
        T = se3.from_rotation_translation(
            T[:3, :3] @ se3.rotation_exp(step[3:]), T[:3, 3] + T[:3, :3] @ step[:3]
        )
        if np.abs(step).max() < _STEP_TOLERANCE:
            break
    if not prior:
        return Fused(T, assessment, {})
    fused = Assessment(root @ np.linalg.inv(normal) @ root.T, ())
    fused = dataclasses.replace(
        fused, observability=_verdicts(T[:3, :3], fused, T_parent_child[:3, :3], assessment, prior)
    )
    return Fused(T, fused, _contradictions(T_parent_child, covariance, prior))


def widened(assessment, rotation, spread):
    """An assessment with more uncertainty, of something that the answer depends on.

    Parameters
    ----------
    assessment : Assessment
    rotation : (3, 3) array
        Of the answer, T_parent_child.
    spread : (6, 6) array
        Covariance to add, of (rho, phi) in the child sensor's frame.

    Returns
    -------
    Assessment
    """
    if not spread.any():
        return assessment
    wider = Assessment(assessment.cov_parent_child_in_child + spread, ())
    added = _sigmas_in_parent(rotation, Assessment(spread, ()))
    observability = [
        dof
        if dof.verdict is DofVerdict.UNOBSERVABLE
        else _known(dof.name, float(np.hypot(dof.sigma, more)))
        for dof, more in zip(assessment.observability, added, strict=True)
    ]
    return dataclasses.replace(wider, observability=tuple(observability))


def _known(axis, sigma):
    weak = sigma > (WEAK_ROTATION if axis in ROTATIONS else WEAK_TRANSLATION)
    return DofObservability(axis, DofVerdict.WEAK if weak else DofVerdict.OBSERVED, sigma)


def _unknown_directions(covariance):
    """Orthonormal basis (6, U) of the directions along which a covariance says "unknown"."""
    shares, vectors = np.linalg.eigh(covariance / np.outer(UNKNOWN_SIGMAS, UNKNOWN_SIGMAS))
    directions = UNKNOWN_SIGMAS[:, None] * vectors[:, shares > _UNKNOWN_SHARE]
    return np.linalg.qr(directions)[0]


def _whitened(T_parent_child, covariance, unknown):
    """What makes deviations from the answer numbers of unit variance: known and unknown directions
    differ by many powers of ten.

    Returns
    -------
    root, inverse_root : (6, 6) arrays
        Deviation from unit numbers, and back.
    targets : (6,) array
        Unit numbers of where the answer is put if nothing else is known: at the parent sensor's
        origin along unknown translations.
    """
    values, vectors = np.linalg.eigh(unknown @ unknown.T)
    known = vectors[:, values < 0.5]
    variances, axes = np.linalg.eigh(known.T @ covariance @ known)
    is_translation = (unknown[:3] ** 2).sum(axis=0) > 0.5
    unknown_sigmas = np.where(is_translation, UNKNOWN_TRANSLATION, UNKNOWN_ROTATION)
    directions = np.concatenate([known @ axes, unknown], axis=1)
    sigmas = np.concatenate([np.sqrt(np.maximum(variances, _ROUNDING_VARIANCE)), unknown_sigmas])
    in_child = T_parent_child[:3, :3].T @ T_parent_child[:3, 3]
    targets = np.where(is_translation, -(unknown[:3].T @ in_child), 0.0) / unknown_sigmas
    return (
        directions * sigmas,
        (directions / sigmas).T,
        np.concatenate([np.zeros(len(variances)), targets]),
    )


def _difference(T_from, T_to):
    rotation = T_from[:3, :3].T
    return np.r_[
        rotation @ (T_to[:3, 3] - T_from[:3, 3]), se3.rotation_log(rotation @ T_to[:3, :3])
    ]


def _prior_residuals(T, prior):
    """Weighted residuals (P,) of the prior and their derivatives (P, 6) by (rho, phi)."""
    residuals, jacobian = _weighted(T, prior), np.zeros((len(prior), 6))
    for column, step in enumerate(_DIFFERENCE * np.eye(6)):
        for sign in (-1, 1):
            moved = se3.from_rotation_translation(
                T[:3, :3] @ se3.rotation_exp(sign * step[3:]),
                T[:3, 3] + sign * T[:3, :3] @ step[:3],
            )
            jacobian[:, column] += sign * _weighted(moved, prior) / (2 * _DIFFERENCE)
    return residuals, jacobian


def _weighted(T, prior):
    errors = _errors(T, prior)
    return np.array([errors[axis] / sigma for axis, (_, sigma) in prior.items()])


def _errors(T, prior):
    """Axis name to the pose's value less the prior's."""
    errors = {
        axis: value - prior[axis][0]
        for axis, value in zip(TRANSLATIONS, T[:3, 3], strict=True)
        if axis in prior
    }
    angles = {axis: prior[axis][0] for axis in ROTATIONS if axis in prior}
    if len(angles) == 3:  # a whole rotation: no angle is singular
        nominal = se3.rotation_from_rpy(list(angles.values()))
        return errors | dict(zip(ROTATIONS, se3.rotation_log(T[:3, :3] @ nominal.T), strict=True))
    if angles:
        found = dict(zip(ROTATIONS, se3.rotation_to_rpy(T[:3, :3]), strict=True))
        errors |= {
            axis: np.angle(np.exp(1j * (found[axis] - value))) for axis, value in angles.items()
        }
    return errors


def _contradictions(T_parent_child, covariance, prior):
    if not prior:
        return {}
    _, jacobian = _prior_residuals(T_parent_child, prior)
    distances = np.abs(_weighted(T_parent_child, prior)) / np.sqrt(
        1.0 + np.einsum("pi,ij,pj->p", jacobian, covariance, jacobian)
    )
    return {axis: float(d) for axis, d in zip(prior, distances, strict=True) if d > _CONTRADICTION}


def _verdicts(rotation, fused, rotation_before, before, prior):
    """Verdicts for the axes of the parent sensor's frame, with the prior counted in."""
    sigmas, sigmas_before = (
        _sigmas_in_parent(rotation, fused),
        _sigmas_in_parent(rotation_before, before),
    )
    verdicts = []
    for dof, sigma, sigma_before in zip(before.observability, sigmas, sigmas_before, strict=True):
        turns = dof.name in ROTATIONS
        if sigma > _KNOWN_SHARE * (UNKNOWN_ROTATION if turns else UNKNOWN_TRANSLATION):
            verdicts.append(DofObservability(dof.name, DofVerdict.UNOBSERVABLE, float("inf")))
        elif dof.name in prior and sigma**2 < _PRIOR_SAYS_MOST * sigma_before**2:
            verdicts.append(DofObservability(dof.name, DofVerdict.PRIOR, float(sigma)))
        else:
            verdicts.append(_known(dof.name, float(sigma)))
    return tuple(verdicts)


def _sigmas_in_parent(rotation, assessment):
    to_parent = np.kron(np.eye(2), rotation)
    return np.sqrt(np.diag(to_parent @ assessment.cov_parent_child_in_child @ to_parent.T))
