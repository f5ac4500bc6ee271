"""Combination of the estimate from motion with a prior.

The estimate from motion X0 has the covariance C. The residuals r(X) of the prior are divided by its
standard deviations. The result X minimises, by Gauss-Newton steps ``X <- X exp(step)``,

    d(X)' C^-1 d(X) + r(X)' r(X).

Here d(X) is the deviation (rho, phi) of X from X0 in the child's frame. A direction that the motion
does not reveal is determined by the prior only. Without a prior the direction is unknown; the
translation along it is set to zero, because its estimate is noise. Reference: T. Barfoot, *State
estimation for robotics*, 2017.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import numpy as np

from hand_eye_calib.core.assessment.covariance import (
    ROUNDING_VARIANCE,
    UNKNOWN_SIGMAS,
    Assessment,
    judged,
)
from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.covariances import sigmas_in_parent
from hand_eye_calib.core.results.calibration import DofObservability, DofVerdict
from hand_eye_calib.core.results.records import AXES, ROTATIONS, TRANSLATIONS

# Axis name to (value, standard deviation), in m and rad.
Prior: TypeAlias = Mapping[str, tuple[float, float]]

# A direction is unknown if its variance exceeds this share of the variance in UNKNOWN_SIGMAS.
_UNKNOWN_SHARE = 0.25

# Largest number of Gauss-Newton steps.
_MAX_STEPS = 20
# The iteration ends if the step (m, rad) is shorter than this.
_STEP_TOLERANCE = 1e-12

# Step (m or rad) of numerical derivatives. Also the smallest standard deviation of a prior: a
# smaller value would make the equations singular.
_SMALL = 1e-6

# Prior and estimate from motion contradict each other if they differ by more than this number of
# standard deviations.
_MAX_DISTANCE = 4.0

# Longest lever arm (m) of any machine: a longer prior has another unit. On unobservable axes the
# motion cannot contradict a prior, so this limit is used there.
_MAX_LEVER_ARM = 50.0


def fuse(assessment: Assessment, prior: Prior) -> Assessment:
    """Combine the estimate from motion with a prior, and set directions that neither determines.

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
    unknown = _unknown_directions(covariance)
    contradictions = _contradictions(assessment, prior) if prior else {}
    prior = {axis: prior[axis] for axis in prior if axis not in contradictions}
    without_prior = replace(assessment, contradictions=contradictions)
    if not prior and not unknown.shape[1]:
        return without_prior
    whitening = _whitened(start, covariance, unknown)
    T, normal = _minimum(start, whitening, prior)
    if not prior:
        return replace(without_prior, T_parent_child=T)
    whitened_covariance = np.linalg.inv(normal)
    posterior = whitening.root @ whitened_covariance @ whitening.root.T
    sigmas = sigmas_in_parent(se3.rotation_of(T), posterior)
    motion_sigmas = sigmas_in_parent(se3.rotation_of(start), covariance)
    are_halved = halves_variance(sigmas, motion_sigmas)
    verdicts = []
    for axis, sigma, is_halved in zip(
        AXES, sigmas.tolist(), are_halved, strict=True
    ):
        # An axis gets its value from the prior if the prior at least halves its variance.
        is_from_prior = axis in prior and bool(is_halved)
        verdicts.append(_verdict_on(axis, sigma, is_from_prior))
    from_motion = whitening.root @ whitened_covariance @ whitening.inverse_root
    return Assessment(
        T, posterior, tuple(verdicts), contradictions, from_motion
    )


def _unknown_directions(covariance: FloatArray) -> FloatArray:
    """Return an orthonormal basis (6, U) of the unknown directions of a covariance (6, 6)."""
    relative = covariance / np.outer(UNKNOWN_SIGMAS, UNKNOWN_SIGMAS)
    shares, vectors = np.linalg.eigh(relative)
    directions = UNKNOWN_SIGMAS[:, None] * vectors[:, shares > _UNKNOWN_SHARE]
    orthonormal, _ = np.linalg.qr(directions)
    return orthonormal


class _Whitening(NamedTuple):
    """Coordinates in which deviations from the estimate have unit variance.

    Attributes
    ----------
    root : (6, 6) array
        Matrix from coordinates of unit variance to deviations (rho, phi).
    inverse_root : (6, 6) array
        Matrix from deviations to coordinates of unit variance.
    targets : (6,) array
        Deviation of the result without a prior, in these coordinates. It is zero along known
        directions. Along unknown directions it makes the translation of X zero.
    """

    root: FloatArray
    inverse_root: FloatArray
    targets: FloatArray


def _minimum(
    start: FloatArray, whitening: _Whitening, prior: Prior
) -> tuple[FloatArray, FloatArray]:
    """Return the transform (4, 4) with the smallest cost, and the normal matrix (6, 6) there.

    The normal matrix is in the coordinates of unit variance.
    """
    root = whitening.root
    back = se3.rotation_of(start).T
    T = start
    for _ in range(_MAX_STEPS):
        residuals, jacobian = _prior_residuals(T, prior)
        jacobian = jacobian @ root
        normal = np.eye(6) + jacobian.T @ jacobian
        translation = back @ (se3.translation_of(T) - se3.translation_of(start))
        rotation = se3.rotation_log(back @ se3.rotation_of(T))
        deviation = np.concatenate([translation, rotation])
        from_targets = whitening.inverse_root @ deviation - whitening.targets
        gradient = from_targets + jacobian.T @ residuals
        step = -root @ np.linalg.solve(normal, gradient)
        T = se3.retracted(T, step)
        if np.abs(step).max() < _STEP_TOLERANCE:
            break
    return T, normal


def _verdict_on(
    axis: str, sigma: float, is_from_prior: bool
) -> DofObservability:
    """Return the verdict on an axis by its standard deviation and the source of its value."""
    verdict = judged(axis, sigma)
    is_observable = verdict.verdict is not DofVerdict.UNOBSERVABLE
    if is_observable and is_from_prior:
        return DofObservability(axis, DofVerdict.PRIOR, sigma)
    return verdict


def halves_variance(sigmas: FloatArray, motion_sigmas: FloatArray) -> BoolArray:
    """Return a mask (6,) of the axes whose variance is at most half of that by motion alone."""
    return 2 * sigmas**2 < motion_sigmas**2


def widened(assessment: Assessment, spread: FloatArray) -> Assessment:
    """Return an assessment with an added covariance (6, 6) of (rho, phi), in the child's frame."""
    added_sigmas = sigmas_in_parent(
        se3.rotation_of(assessment.T_parent_child), spread
    )
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
) -> _Whitening:
    """Return coordinates in which deviations from the estimate have unit variance.

    The variances of known and unknown directions differ by many powers of ten. Therefore both are
    whitened separately.
    """
    values, vectors = np.linalg.eigh(unknown @ unknown.T)
    known_directions = vectors[:, values < 0.5]
    variances, axes = np.linalg.eigh(
        known_directions.T @ covariance @ known_directions
    )
    known_sigmas = np.sqrt(np.maximum(variances, ROUNDING_VARIANCE))
    is_translation = (unknown[:3] ** 2).sum(axis=0) > 0.5
    unknown_sigmas = np.where(
        is_translation, UNKNOWN_SIGMAS[0], UNKNOWN_SIGMAS[-1]
    )
    directions = np.concatenate([known_directions @ axes, unknown], axis=1)
    sigmas = np.concatenate([known_sigmas, unknown_sigmas])
    in_child = se3.rotation_of(T_parent_child).T @ se3.translation_of(
        T_parent_child
    )
    to_zero = -(unknown[:3].T @ in_child)
    unknown_targets = np.where(is_translation, to_zero, 0.0) / unknown_sigmas
    return _Whitening(
        root=directions * sigmas,
        inverse_root=(directions / sigmas).T,
        targets=np.concatenate([np.zeros(len(variances)), unknown_targets]),
    )


def _prior_residuals(
    T: FloatArray, prior: Prior
) -> tuple[FloatArray, FloatArray]:
    """Return weighted residuals (P,) of the prior, and their derivatives (P, 6) by (rho, phi)."""
    residuals = _weighted(T, prior)
    jacobian = np.zeros((len(prior), 6))
    for column, step in enumerate(_SMALL * np.eye(6)):
        for sign in (-1, 1):
            weighted = _weighted(se3.retracted(T, sign * step), prior)
            jacobian[:, column] += sign * weighted / (2 * _SMALL)
    return residuals, jacobian


def _weighted(T: FloatArray, prior: Prior) -> FloatArray:
    """Return the errors (P,) of a transform from the prior, in the prior's standard deviations."""
    errors = {}
    for axis, value in zip(TRANSLATIONS, se3.translation_of(T), strict=True):
        if axis in prior:
            errors[axis] = value - prior[axis][0]
    angles = {axis: prior[axis][0] for axis in ROTATIONS if axis in prior}
    rotation = se3.rotation_of(T)
    if len(angles) == 3:
        # The rotation vector from the prior to T is defined in gimbal lock, too.
        nominal = se3.rotation_from_rpy(list(angles.values()))
        rotation_vector = se3.rotation_log(rotation @ nominal.T)
        errors |= dict(zip(ROTATIONS, rotation_vector, strict=True))
    elif angles:
        rpy = dict(zip(ROTATIONS, se3.rotation_to_rpy(rotation), strict=True))
        for axis, angle in angles.items():
            # np.angle returns a value between -pi and pi.
            errors[axis] = np.angle(np.exp(1j * (rpy[axis] - angle)))
    return np.array(
        [
            errors[axis] / max(sigma, _SMALL)
            for axis, (_, sigma) in prior.items()
        ]
    )


def _contradictions(assessment: Assessment, prior: Prior) -> dict[str, float]:
    """Return the axes whose prior contradicts the motion.

    The values are the distances between prior and motion, divided by their joint standard
    deviation.
    """
    residuals, jacobian = _prior_residuals(assessment.T_parent_child, prior)
    covariance = assessment.cov_parent_child_in_child
    variances = 1.0 + np.einsum("pi,ij,pj->p", jacobian, covariance, jacobian)
    distances = np.abs(residuals) / np.sqrt(variances)
    verdicts = {dof.name: dof.verdict for dof in assessment.observability}
    contradictions = {}
    for axis, distance in zip(prior, distances.tolist(), strict=True):
        is_far = distance > _MAX_DISTANCE
        if verdicts[axis] is DofVerdict.UNOBSERVABLE:
            is_far = (
                axis in TRANSLATIONS and abs(prior[axis][0]) > _MAX_LEVER_ARM
            )
        if is_far:
            contradictions[axis] = distance
    return contradictions
