"""Fusion of the estimate from motion with a prior.

Both are measurements, weighted by their covariances: with the estimate X0 of covariance C and the
residuals r(X) of the prior in its standard deviations, the result minimises (Gauss-Newton)

    Log(X0^-1 X)' C^-1 Log(X0^-1 X) + r(X)' r(X),    X <- X exp(step).

Only the prior determines a direction that the motion does not reveal. Without a prior, the
translation along such a direction is set to zero, because the estimate is only noise, and the
direction stays unknown. Reference: T. Barfoot, *State estimation for robotics*, 2017.
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

# A direction is unknown from this share of the variance that represents "unknown" on.
_UNKNOWN_SHARE = 0.25

_MAX_STEPS = 20
# The iteration ends below this step (m, rad).
_STEP_TOLERANCE = 1e-12

# Step of numerical derivatives (m or rad), and smallest standard deviation of a prior. Smaller ones
# make the equations singular, and nobody measures better.
_SMALL = 1e-6

# A prior contradicts the estimate from motion above this many standard deviations.
_MAX_DISTANCE = 4.0

# Largest lever arm (m) of any machine: a prior above it is in another unit. It serves unobservable
# axes, where the motion cannot contradict a prior.
_MAX_LEVER_ARM = 50.0


def fuse(assessment: Assessment, prior: Prior) -> Assessment:
    """Fuse the estimate from motion with a prior, and set directions that neither determines.

    Parameters
    ----------
    assessment : Assessment
        The estimate from motion.
    prior : mapping
        Axis name (x, y, z, roll, pitch, yaw; of the child sensor's pose in the parent sensor's
        frame, angles about fixed axes) to (value, sigma), in m and rad. May be empty.
    """
    start = assessment.T_parent_child
    covariance = assessment.cov_parent_child_in_child
    shares, vectors = np.linalg.eigh(covariance / np.outer(UNKNOWN_SIGMAS, UNKNOWN_SIGMAS))
    unknown = np.linalg.qr(UNKNOWN_SIGMAS[:, None] * vectors[:, shares > _UNKNOWN_SHARE])[0]
    contradictions = _contradictions(assessment, prior) if prior else {}
    prior = {axis: prior[axis] for axis in prior if axis not in contradictions}
    without_prior = replace(assessment, contradictions=contradictions)
    if not prior and not unknown.shape[1]:
        return without_prior
    root, inverse_root, targets = _whitened(start, covariance, unknown)
    T = start
    back = se3.rotation_of(start).T
    for _ in range(_MAX_STEPS):
        residuals, jacobian = _prior_residuals(T, prior)
        jacobian = jacobian @ root
        normal = np.eye(6) + jacobian.T @ jacobian
        translation = back @ (se3.translation_of(T) - se3.translation_of(start))
        change = np.concatenate([translation, se3.rotation_log(back @ se3.rotation_of(T))])
        step = -root @ np.linalg.solve(
            normal, inverse_root @ change - targets + jacobian.T @ residuals
        )
        T = se3.retracted(T, step)
        if np.abs(step).max() < _STEP_TOLERANCE:
            break
    if not prior:
        return replace(without_prior, T_parent_child=T)
    posterior = root @ np.linalg.inv(normal) @ root.T
    sigmas = sigmas_in_parent(se3.rotation_of(T), posterior)
    motion_sigmas = sigmas_in_parent(se3.rotation_of(start), covariance)
    verdicts = []
    for axis, sigma, motion_sigma in zip(AXES, sigmas.tolist(), motion_sigmas, strict=True):
        verdict = judged(axis, sigma)
        is_observable = verdict.verdict is not DofVerdict.UNOBSERVABLE
        # An axis is mostly from the prior if the prior at least halves its variance.
        if is_observable and axis in prior and 2 * sigma**2 < motion_sigma**2:
            verdict = DofObservability(axis, DofVerdict.PRIOR, sigma)
        verdicts.append(verdict)
    from_motion = root @ np.linalg.inv(normal) @ inverse_root
    return Assessment(T, posterior, tuple(verdicts), contradictions, from_motion)


def widened(assessment: Assessment, spread: FloatArray) -> Assessment:
    """Return an assessment with an added covariance (6, 6) of (rho, phi), in the child's frame."""
    added_sigmas = sigmas_in_parent(se3.rotation_of(assessment.T_parent_child), spread)
    observability = []
    for dof, added in zip(assessment.observability, added_sigmas, strict=True):
        if dof.verdict is not DofVerdict.UNOBSERVABLE:
            dof = judged(dof.name, float(np.hypot(dof.sigma, added)))
        observability.append(dof)
    return replace(
        assessment,
        cov_parent_child_in_child=assessment.cov_parent_child_in_child + spread,
        observability=tuple(observability),
    )


def _whitened(
    T_parent_child: FloatArray, covariance: FloatArray, unknown: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Whiten deviations from the estimate.

    The variances of known and unknown directions differ by many powers of ten.

    Returns
    -------
    root : (6, 6) array
        From coordinates of unit variance to deviations (rho, phi).
    inverse_root : (6, 6) array
        From deviations to coordinates of unit variance.
    targets : (6,) array
        Deviation, in these coordinates, of the result without a prior. It is zero along known
        directions. Along unknown directions, it makes the translation of X zero.
    """
    values, vectors = np.linalg.eigh(unknown @ unknown.T)
    known = vectors[:, values < 0.5]
    variances, axes = np.linalg.eigh(known.T @ covariance @ known)
    is_translation = (unknown[:3] ** 2).sum(axis=0) > 0.5
    unknown_sigmas = np.where(is_translation, UNKNOWN_SIGMAS[0], UNKNOWN_SIGMAS[-1])
    directions = np.concatenate([known @ axes, unknown], axis=1)
    sigmas = np.concatenate([np.sqrt(np.maximum(variances, ROUNDING_VARIANCE)), unknown_sigmas])
    in_child = se3.rotation_of(T_parent_child).T @ se3.translation_of(T_parent_child)
    targets = np.where(is_translation, -(unknown[:3].T @ in_child), 0.0) / unknown_sigmas
    targets = np.concatenate([np.zeros(len(variances)), targets])
    return directions * sigmas, (directions / sigmas).T, targets


def _prior_residuals(T: FloatArray, prior: Prior) -> tuple[FloatArray, FloatArray]:
    """Return weighted residuals (P,) of the prior, and derivatives (P, 6).

    The derivatives are with respect to (rho, phi).
    """
    residuals = _weighted(T, prior)
    jacobian = np.zeros((len(prior), 6))
    for column, step in enumerate(_SMALL * np.eye(6)):
        for sign in (-1, 1):
            weighted = _weighted(se3.retracted(T, sign * step), prior)
            jacobian[:, column] += sign * weighted / (2 * _SMALL)
    return residuals, jacobian


def _weighted(T: FloatArray, prior: Prior) -> FloatArray:
    """Values (P,) of the transform less those of the prior, in its standard deviations."""
    errors = dict(zip(TRANSLATIONS, se3.translation_of(T), strict=True))
    errors = {axis: errors[axis] - prior[axis][0] for axis in TRANSLATIONS if axis in prior}
    angles = {axis: prior[axis][0] for axis in ROTATIONS if axis in prior}
    if len(angles) == 3:
        # A full rotation: no angle is singular.
        nominal = se3.rotation_from_rpy(list(angles.values()))
        errors |= dict(
            zip(ROTATIONS, se3.rotation_log(se3.rotation_of(T) @ nominal.T), strict=True)
        )
    elif angles:
        rpy = dict(zip(ROTATIONS, se3.rotation_to_rpy(se3.rotation_of(T)), strict=True))
        for axis, angle in angles.items():
            errors[axis] = np.angle(np.exp(1j * (rpy[axis] - angle)))
    return np.array([errors[axis] / max(sigma, _SMALL) for axis, (_, sigma) in prior.items()])


def _contradictions(assessment: Assessment, prior: Prior) -> dict[str, float]:
    """Axis name to the distance of the prior in standard deviations, if it is too large."""
    residuals, jacobian = _prior_residuals(assessment.T_parent_child, prior)
    covariance = assessment.cov_parent_child_in_child
    variances = 1.0 + np.einsum("pi,ij,pj->p", jacobian, covariance, jacobian)
    distances = np.abs(residuals) / np.sqrt(variances)
    verdicts = {dof.name: dof.verdict for dof in assessment.observability}
    contradictions = {}
    for axis, distance in zip(prior, distances.tolist(), strict=True):
        is_far = distance > _MAX_DISTANCE
        if verdicts[axis] is DofVerdict.UNOBSERVABLE:
            is_far = axis in TRANSLATIONS and abs(prior[axis][0]) > _MAX_LEVER_ARM
        if is_far:
            contradictions[axis] = distance
    return contradictions
