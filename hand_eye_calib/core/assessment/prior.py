"""Fusion of the estimate from motion with a prior.

The estimate and the prior are two measurements, weighted by their covariances, whatever the method.
Along a direction that the motion does not reveal only the prior counts. Without a prior, the
translation along it is set to zero instead of the value that noise would give, and the direction
stays unknown.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from hand_eye_calib.core.assessment.covariance import (
    ROUNDING_VARIANCE,
    UNKNOWN_SIGMAS,
    Assessment,
    judged,
)
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import sigmas_in_parent
from hand_eye_calib.core.results.calibration import DofObservability, DofVerdict
from hand_eye_calib.core.results.records import AXES, ROTATIONS, TRANSLATIONS

# Axis name to (value, standard deviation), in m and rad.
Prior: TypeAlias = Mapping[str, tuple[float, float]]

# A direction is unknown if its variance is at least this share of the variance that stands for
# unknown.
_UNKNOWN_SHARE = 0.25

_MAX_STEPS = 20
_STEP_TOLERANCE = 1e-12

# Step of differences, and smallest standard deviation of a prior (m or rad): nobody measures
# better, and smaller ones make the equations singular.
_SMALL = 1e-6

# A prior more than this many standard deviations from the estimate from motion contradicts it.
_MAX_DISTANCE = 4.0

# Along an unobservable axis the motion says nothing that a prior could contradict. No machine has
# sensors farther apart than this (m): such a prior is in another unit.
_MAX_LEVER_ARM = 50.0


def fuse(assessment: Assessment, prior: Prior) -> Assessment:
    """Fuse the estimate from motion with a prior, and set what neither of them knows.

    Parameters
    ----------
    assessment : Assessment
        The estimate from motion.
    prior : mapping
        Axis name (x, y, z, roll, pitch, yaw; of the child sensor's pose in the parent sensor's
        frame, angles about fixed axes) to (value, sigma), in m and rad. May be empty.
    """
    T_parent_child = assessment.T_parent_child
    covariance = assessment.cov_parent_child_in_child
    shares, vectors = np.linalg.eigh(covariance / np.outer(UNKNOWN_SIGMAS, UNKNOWN_SIGMAS))
    unknown = np.linalg.qr(UNKNOWN_SIGMAS[:, None] * vectors[:, shares > _UNKNOWN_SHARE])[0]
    contradictions = _contradictions(assessment, prior) if prior else {}
    prior = {axis: known for axis, known in prior.items() if axis not in contradictions}
    found = replace(assessment, contradictions=contradictions)
    if not prior and not unknown.shape[1]:
        return found
    root, inverse_root, targets = _whitened(T_parent_child, covariance, unknown)
    T = T_parent_child
    back = T_parent_child[:3, :3].T
    none = np.zeros(0), np.zeros((0, 6))
    for _ in range(_MAX_STEPS):
        residuals, jacobian = _prior_residuals(T, prior) if prior else none
        jacobian = jacobian @ root
        normal = np.eye(6) + jacobian.T @ jacobian
        apart = back @ (T[:3, 3] - T_parent_child[:3, 3]), se3.rotation_log(back @ T[:3, :3])
        deviations = inverse_root @ np.concatenate(apart) - targets
        step = -root @ np.linalg.solve(normal, deviations + jacobian.T @ residuals)
        T = se3.retracted(T, step)
        if np.abs(step).max() < _STEP_TOLERANCE:
            break
    if not prior:
        return replace(found, T_parent_child=T)
    posterior = root @ np.linalg.inv(normal) @ root.T
    sigmas = sigmas_in_parent(T[:3, :3], posterior).tolist()
    before = sigmas_in_parent(T_parent_child[:3, :3], covariance)
    verdicts = [judged(axis, sigma) for axis, sigma in zip(AXES, sigmas, strict=True)]
    for k, (axis, sigma) in enumerate(zip(AXES, sigmas, strict=True)):
        is_known = verdicts[k].verdict is not DofVerdict.UNOBSERVABLE
        # An axis is mostly from the prior if that at least halves its variance.
        if is_known and axis in prior and 2 * sigma**2 < before[k] ** 2:
            verdicts[k] = DofObservability(axis, DofVerdict.PRIOR, sigma)
    from_motion = root @ np.linalg.inv(normal) @ inverse_root
    return Assessment(T, posterior, tuple(verdicts), contradictions, from_motion)


def widened(assessment: Assessment, spread: FloatArray) -> Assessment:
    """An assessment with the covariance (6, 6) of (rho, phi), in the child sensor's frame, of
    something added that the estimate depends on.
    """
    added = sigmas_in_parent(assessment.T_parent_child[:3, :3], spread)
    observability = tuple(
        dof
        if dof.verdict is DofVerdict.UNOBSERVABLE
        else judged(dof.name, float(np.hypot(dof.sigma, more)))
        for dof, more in zip(assessment.observability, added, strict=True)
    )
    covariance = assessment.cov_parent_child_in_child + spread
    return replace(assessment, cov_parent_child_in_child=covariance, observability=observability)


def _whitened(
    T_parent_child: FloatArray, covariance: FloatArray, unknown: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Matrices (6, 6) from coordinates of unit variance to deviations (rho, phi) from the estimate,
    and back: the variances of known and unknown directions differ by many powers of ten; and where
    (6,) the estimate is set without a prior, in these coordinates: zero translation along unknown
    directions.
    """
    values, vectors = np.linalg.eigh(unknown @ unknown.T)
    known = vectors[:, values < 0.5]
    variances, axes = np.linalg.eigh(known.T @ covariance @ known)
    is_translation = (unknown[:3] ** 2).sum(axis=0) > 0.5
    unknown_sigmas = np.where(is_translation, UNKNOWN_SIGMAS[0], UNKNOWN_SIGMAS[-1])
    directions = np.concatenate([known @ axes, unknown], axis=1)
    sigmas = np.concatenate([np.sqrt(np.maximum(variances, ROUNDING_VARIANCE)), unknown_sigmas])
    in_child = T_parent_child[:3, :3].T @ T_parent_child[:3, 3]
    targets = np.where(is_translation, -(unknown[:3].T @ in_child), 0.0) / unknown_sigmas
    targets = np.concatenate([np.zeros(len(variances)), targets])
    return directions * sigmas, (directions / sigmas).T, targets


def _prior_residuals(T: FloatArray, prior: Prior) -> tuple[FloatArray, FloatArray]:
    """Weighted residuals (P,) of the prior and their derivatives (P, 6) by (rho, phi)."""
    residuals = _weighted(T, prior)
    jacobian = np.zeros((len(prior), 6))
    for column, step in enumerate(_SMALL * np.eye(6)):
        for sign in (-1, 1):
            weighted = _weighted(se3.retracted(T, sign * step), prior)
            jacobian[:, column] += sign * weighted / (2 * _SMALL)
    return residuals, jacobian


def _weighted(T: FloatArray, prior: Prior) -> FloatArray:
    """Values (P,) of the transform less those of the prior, in its standard deviations."""
    errors = {
        axis: value - prior[axis][0]
        for axis, value in zip(TRANSLATIONS, T[:3, 3], strict=True)
        if axis in prior
    }
    angles = {axis: prior[axis][0] for axis in ROTATIONS if axis in prior}
    if len(angles) == 3:  # a whole rotation: no angle is singular
        nominal = se3.rotation_from_rpy(list(angles.values()))
        errors |= dict(zip(ROTATIONS, se3.rotation_log(T[:3, :3] @ nominal.T), strict=True))
    elif angles:
        found = dict(zip(ROTATIONS, se3.rotation_to_rpy(T[:3, :3]), strict=True))
        errors |= {
            axis: np.angle(np.exp(1j * (found[axis] - value))) for axis, value in angles.items()
        }
    return np.array([errors[axis] / max(sigma, _SMALL) for axis, (_, sigma) in prior.items()])


def _contradictions(assessment: Assessment, prior: Prior) -> dict[str, float]:
    """Axis name to the distance of the prior in standard deviations, if it is too large."""
    T = assessment.T_parent_child
    covariance = assessment.cov_parent_child_in_child
    _, jacobian = _prior_residuals(T, prior)
    distances = np.abs(_weighted(T, prior)) / np.sqrt(
        1.0 + np.einsum("pi,ij,pj->p", jacobian, covariance, jacobian)
    )
    verdicts = {dof.name: dof.verdict for dof in assessment.observability}
    return {
        axis: distance
        for (axis, (value, _)), distance in zip(prior.items(), distances.tolist(), strict=True)
        if (
            distance > _MAX_DISTANCE
            if verdicts[axis] is not DofVerdict.UNOBSERVABLE
            else axis in TRANSLATIONS and abs(value) > _MAX_LEVER_ARM
        )
    }
