"""Batched rigid transforms.

Transforms are ``(..., 4, 4)`` arrays named ``T_target_source``: they map coordinates of ``source``
into ``target``. Tangent vectors are ``(..., 6)`` arrays ``(rho, phi)``, translation (m) before
rotation (rad), acting on the right: ``T_target_source @ exp(xi_in_source)``. Rotation conversions
are written out because SciPy's take a tenth of a second to import.
"""

import numpy as np
from numpy.typing import ArrayLike

from hand_eye_calib.core.base.arrays import FloatArray

# Below this angle the coefficients of exp and log come from their Taylor series. At 1e-2 rad the
# first term left out is of order angle^6, about 1e-16 relative; the closed forms lose digits to
# cancellation there.
_SERIES_ANGLE = 1e-2

# Cosine of the pitch below which roll and yaw are about the same axis, up to rounding.
_SINGULAR_COSINE = 1e-7


def skew(vectors: ArrayLike) -> FloatArray:
    """Matrices S (..., 3, 3) of vectors (..., 3), with ``S @ v == cross(vector, v)``."""
    vectors = np.asarray(vectors, dtype=float)
    matrices: FloatArray = np.zeros((*vectors.shape, 3))
    x = vectors[..., 0]
    y = vectors[..., 1]
    z = vectors[..., 2]
    matrices[..., 0, 1] = -z
    matrices[..., 0, 2] = y
    matrices[..., 1, 2] = -x
    matrices[..., 1, 0] = z
    matrices[..., 2, 0] = -y
    matrices[..., 2, 1] = x
    return matrices


def vee(matrices: FloatArray) -> FloatArray:
    """Vectors (..., 3) of twice the antisymmetric part of matrices (..., 3, 3): of a rotation, its
    axis times twice the sine of its angle.
    """
    apart = matrices - np.swapaxes(matrices, -1, -2)
    return np.stack([apart[..., 2, 1], apart[..., 0, 2], apart[..., 1, 0]], axis=-1)


def cross(left: FloatArray, right: FloatArray) -> FloatArray:
    """Cross products (..., 3) of two arrays of vectors of the same shape (..., 3).

    For a few hundred vectors it takes a fraction of the time of ``numpy.cross``.
    """
    (x, y, z), (u, v, w) = (vectors.T for vectors in (left, right))
    products = np.empty(left.shape)
    products.T[0] = y * w - z * v
    products.T[1] = z * u - x * w
    products.T[2] = x * v - y * u
    return products


def from_rotation_translation(rotation: ArrayLike, translation: ArrayLike) -> FloatArray:
    """Transforms (..., 4, 4) from rotation matrices (..., 3, 3) and translations (..., 3), m."""
    rotation = np.asarray(rotation, dtype=float)
    translation = np.asarray(translation, dtype=float)
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    transforms = np.zeros((*shape, 4, 4))
    transforms[..., :3, :3] = rotation
    transforms[..., :3, 3] = translation
    transforms[..., 3, 3] = 1.0
    return transforms


def from_quat_xyzw(translation: ArrayLike, quat_xyzw: ArrayLike) -> FloatArray:
    """Transforms (..., 4, 4) from translations (..., 3), m, and quaternions (..., 4), scalar last.

    Quaternions are normalised; the caller checks whether they were close enough to unit length.

    Raises
    ------
    ValueError
        If a quaternion has length zero.
    """
    quats = np.asarray(quat_xyzw, dtype=float)
    norms = np.linalg.norm(quats, axis=-1, keepdims=True)
    if not norms.all():
        raise ValueError("found a quaternion of length zero")
    return from_rotation_translation(_matrices(*np.moveaxis(quats / norms, -1, 0)), translation)


def to_quat_xyzw(transforms: ArrayLike) -> FloatArray:
    """Unit quaternions (..., 4), scalar last and not negative, of transforms (..., 4, 4) or
    rotations (..., 3, 3).
    """
    rotations = np.asarray(transforms, dtype=float)[..., :3, :3]
    quats = _scaled_quats(rotations.reshape(-1, 3, 3))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return quats.reshape((*rotations.shape[:-2], 4))


def to_rows(transforms: ArrayLike) -> FloatArray:
    """x y z qx qy qz qw (..., 7) of transforms (..., 4, 4), as files and messages have them."""
    Ts = np.asarray(transforms, dtype=float)
    return np.concatenate([Ts[..., :3, 3], to_quat_xyzw(Ts)], axis=-1)


def rotation_from_rpy(rpy: ArrayLike) -> FloatArray:
    """Rotation matrices (..., 3, 3) of roll, pitch and yaw (..., 3), rad, about the fixed axes x, y
    and z in this order (REP 103, URDF).
    """
    rpy = np.asarray(rpy, dtype=float)
    roll, pitch, yaw = (rotation_exp(rpy[..., axis, None] * np.eye(3)[axis]) for axis in range(3))
    return yaw @ pitch @ roll


def rotation_to_rpy(rotation: ArrayLike) -> FloatArray:
    """Roll, pitch and yaw (..., 3), rad, of rotation matrices (..., 3, 3): the inverse of
    :func:`rotation_from_rpy`.

    The pitch is from -pi/2 to pi/2. At both ends only the sum or difference of the other two is
    defined; the yaw is then 0.
    """
    R = np.asarray(rotation, dtype=float)
    cosine = np.hypot(R[..., 0, 0], R[..., 1, 0])
    singular = cosine < _SINGULAR_COSINE
    at_pole = np.arctan2(-R[..., 1, 2], R[..., 1, 1])
    roll = np.where(singular, at_pole, np.arctan2(R[..., 2, 1], R[..., 2, 2]))
    yaw = np.where(singular, 0.0, np.arctan2(R[..., 1, 0], R[..., 0, 0]))
    return np.stack([roll, np.arctan2(-R[..., 2, 0], cosine), yaw], axis=-1)


def in_other_order(rotations: FloatArray) -> FloatArray:
    """Rotations (N, 3, 3) whose roll, pitch and yaw were applied in this order about turning axes,
    but read as those about fixed axes.
    """
    angles = rotation_to_rpy(rotations)
    roll, pitch, yaw = (
        rotation_exp(angles[..., axis, None] * np.eye(3)[axis]) for axis in range(3)
    )
    return roll @ pitch @ yaw


def nearest_rotation(matrices: FloatArray) -> FloatArray:
    """Rotations (..., 3, 3) nearest to matrices in the Frobenius norm.

    The sign of the direction with the smallest singular value, which motion in a plane leaves open,
    makes them rotations.
    """
    left, _, right = np.linalg.svd(matrices)
    left[..., :, 2] *= np.sign(np.linalg.det(left @ right))[..., None]
    return np.asarray(left @ right)


def rotation_log(rotation: ArrayLike) -> FloatArray:
    """Rotation vectors (..., 3), rad, of length at most pi, of rotation matrices (..., 3, 3)."""
    rotation = np.asarray(rotation, dtype=float)
    return quat_log(_scaled_quats(rotation.reshape(-1, 3, 3))).reshape(rotation.shape[:-1])


def quat_log(quat_xyzw: FloatArray) -> FloatArray:
    """Rotation vectors (N, 3), rad, of quaternions (N, 4), scalar last, of any length and sign."""
    # Sine of half the angle, times the length of the quaternion.
    sine = np.sqrt(np.einsum("ni,ni->n", quat_xyzw[:, :3], quat_xyzw[:, :3]))
    angle = np.copysign(2.0, quat_xyzw[:, 3]) * np.arctan2(sine, np.abs(quat_xyzw[:, 3]))
    return quat_xyzw[:, :3] * (angle / np.where(sine > 0.0, sine, 1.0))[:, None]


def _scaled_quats(rotations: FloatArray) -> FloatArray:
    """Quaternions (N, 4) of any length, scalar last and not negative, of rotations (N, 3, 3).

    The coefficients come from the largest of them, so that no digits are lost: S. W. Shepperd,
    *Quaternion from rotation matrix*, 1978.
    """
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotations.reshape(-1, 9).T
    trace = r00 + r11 + r22
    quats = np.stack([r21 - r12, r02 - r20, r10 - r01, 1.0 + trace], axis=1)
    large = np.flatnonzero(trace < 0.0)
    if large.size:
        R = rotations[large]
        row = np.arange(len(large))
        i = np.argmax(np.diagonal(R, axis1=1, axis2=2), axis=1)
        j = (i + 1) % 3
        k = (i + 2) % 3
        far = np.empty((len(R), 4))
        far[row, i] = 1.0 - trace[large] + 2.0 * R[row, i, i]
        far[row, j], far[row, k] = R[row, j, i] + R[row, i, j], R[row, k, i] + R[row, i, k]
        far[:, 3] = R[row, k, j] - R[row, j, k]
        quats[large] = np.where(far[:, 3:] < 0.0, -far, far)
    return quats


def rotation_exp(rotation_vector: ArrayLike) -> FloatArray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in rad."""
    rotation_vector = np.asarray(rotation_vector, dtype=float)
    half = 0.5 * np.sqrt(np.einsum("...i,...i", rotation_vector, rotation_vector))
    shrunk = 0.5 * np.where(half > 0.0, np.sin(half) / np.where(half > 0.0, half, 1.0), 1.0)
    x, y, z = (shrunk * rotation_vector[..., axis] for axis in range(3))
    return _matrices(x, y, z, np.cos(half))


def _matrices(x: FloatArray, y: FloatArray, z: FloatArray, w: FloatArray) -> FloatArray:
    """Rotation matrices (..., 3, 3) of unit quaternions, given by coefficient, each (...)."""
    twice_x = 2.0 * x
    twice_y = 2.0 * y
    twice_z = 2.0 * z
    xx = twice_x * x
    yy = twice_y * y
    zz = twice_z * z
    xy = twice_x * y
    xz = twice_x * z
    yz = twice_y * z
    xw = twice_x * w
    yw = twice_y * w
    zw = twice_z * w
    entries = [1.0 - (yy + zz), xy - zw, xz + yw]
    entries += [xy + zw, 1.0 - (xx + zz), yz - xw]
    entries += [xz - yw, yz + xw, 1.0 - (xx + yy)]
    return np.stack(entries, axis=-1).reshape(*np.shape(w), 3, 3)


def inverse(transforms: ArrayLike) -> FloatArray:
    """Inverses of transforms (..., 4, 4): ``T_source_target`` of ``T_target_source``."""
    transforms = np.asarray(transforms, dtype=float)
    rotation_inverse = np.swapaxes(transforms[..., :3, :3], -1, -2)
    return from_rotation_translation(
        rotation_inverse, -(rotation_inverse @ transforms[..., :3, 3:])[..., 0]
    )


def retracted(transform: FloatArray, step: FloatArray) -> FloatArray:
    """A transform (4, 4) after a small step (rho, phi) in its own axes, each part by itself: to
    first order it is ``transform @ exp(step)``.
    """
    rotation = transform[:3, :3]
    return from_rotation_translation(
        rotation @ rotation_exp(step[3:]), transform[:3, 3] + rotation @ step[:3]
    )


def exp(xi: ArrayLike) -> FloatArray:
    """Exponential map of SE(3).

    Parameters
    ----------
    xi : (..., 6) array
        Tangent vectors (rho in m, phi in rad).

    Returns
    -------
    (..., 4, 4) array

    Notes
    -----
    ``t = V rho`` with ``V = I + (1 - cos a)/a^2 [phi] + (a - sin a)/a^3 [phi]^2`` and ``a =
    |phi|``; Sola, Deray, Atchuthan, *A micro Lie theory for state estimation in robotics*, 2018,
    eqs 172-174.
    """
    xi = np.asarray(xi, dtype=float)
    rho = xi[..., :3]
    phi = xi[..., 3:]
    angle = np.linalg.norm(phi, axis=-1)
    small = angle < _SERIES_ANGLE
    squared = angle**2
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5 - squared / 24 + squared**2 / 720, (1 - np.cos(safe)) / safe**2)
    series = 1 / 6 - squared / 120 + squared**2 / 5040
    second = np.where(small, series, (safe - np.sin(safe)) / safe**3)
    cross_once = cross(phi, rho)
    translation = rho + first[..., None] * cross_once + second[..., None] * cross(phi, cross_once)
    return from_rotation_translation(rotation_exp(phi), translation)


def log(transforms: ArrayLike) -> FloatArray:
    """Logarithm of SE(3), the inverse of :func:`exp`.

    Parameters
    ----------
    transforms : (..., 4, 4) array

    Returns
    -------
    (..., 6) array
        (rho in m, phi in rad), with ``|phi| <= pi``.

    Notes
    -----
    ``rho = V^-1 t`` with ``V^-1 = I - [phi]/2 + (1/a^2 - (1 + cos a) / (2 a sin a)) [phi]^2``;
    written with the half angle the last coefficient is ``(1 - (a/2) cot(a/2)) / a^2``, finite up to
    a = pi.
    """
    transforms = np.asarray(transforms, dtype=float)
    phi = rotation_log(transforms[..., :3, :3])
    translation = transforms[..., :3, 3]
    angle = np.linalg.norm(phi, axis=-1)
    small = angle < _SERIES_ANGLE
    squared = angle**2
    safe = np.where(small, 1.0, angle)
    series = 1 / 12 + squared / 720 + squared**2 / 30240
    coefficient = np.where(small, series, (1 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2)
    cross_once = cross(phi, translation)
    rho = translation - 0.5 * cross_once + coefficient[..., None] * cross(phi, cross_once)
    return np.concatenate([rho, phi], axis=-1)


def times(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """Matrices (..., k, m) times vectors (..., m)."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def adjoint(transforms: ArrayLike) -> FloatArray:
    """Adjoint matrices (..., 6, 6) of transforms (..., 4, 4).

    ``T @ exp(xi) == exp(adjoint(T) @ xi) @ T``: it maps a tangent vector (rho, phi) from the source
    frame to the target frame.
    """
    transforms = np.asarray(transforms, dtype=float)
    rotation = transforms[..., :3, :3]
    matrices = np.zeros((*transforms.shape[:-2], 6, 6))
    matrices[..., :3, :3] = rotation
    matrices[..., 3:, 3:] = rotation
    matrices[..., :3, 3:] = skew(transforms[..., :3, 3]) @ rotation
    return matrices


def rotation_angle(rotation: ArrayLike) -> FloatArray:
    """Angles (...), rad, from 0 to pi, of rotation matrices (..., 3, 3).

    They come from sine and cosine together, so that neither small angles nor angles near pi lose
    digits.
    """
    rotation = np.asarray(rotation, dtype=float)
    x, y, z = np.moveaxis(vee(rotation), -1, 0)
    twice_sine = np.sqrt(x**2 + y**2 + z**2)
    twice_cosine = np.trace(rotation, axis1=-2, axis2=-1) - 1.0
    return np.arctan2(twice_sine, twice_cosine)


def interpolate(start: FloatArray, end: FloatArray, fraction: ArrayLike) -> FloatArray:
    """Poses along the geodesic of SE(3) from ``start`` to ``end`` (constant twist).

    Parameters
    ----------
    start, end : (..., 4, 4) arrays
        ``T_world_sensor`` at both ends.
    fraction : (...) array
        0 gives ``start``, 1 gives ``end``; values outside [0, 1] extrapolate the same twist.

    Returns
    -------
    (..., 4, 4) array
    """
    step = log(inverse(start) @ end)
    return start @ exp(np.asarray(fraction, dtype=float)[..., None] * step)


def chained(steps: FloatArray) -> FloatArray:
    """Orientations (N + 1, 3, 3) after each of the rotations (N, 3, 3), from the identity on; or
    poses.
    """
    rotations = np.concatenate([np.eye(steps.shape[-1])[None], steps])
    # Products of all up to each, in as many passes as their number has binary digits.
    span = 1
    while span < len(rotations):
        rotations[span:] = rotations[:-span] @ rotations[span:]
        span *= 2
    return rotations


def put_right(Ts: FloatArray, invert: str = "none", quaternion: str = "xyzw") -> FloatArray:
    """Poses (N, 4, 4) that were written in another convention than they were read in: ``invert``
    ("none", "poses" or "orientations") says what was of the world in the sensor, ``quaternion``
    ("xyzw", "wxyz" or "yzwx") the order of quaternions that were read as x y z w.
    """
    if quaternion != "xyzw":
        quats = np.roll(to_quat_xyzw(Ts), -quaternion.index("x"), axis=-1)
        Ts = from_quat_xyzw(Ts[..., :3, 3], quats)
    if invert == "poses":
        return inverse(Ts)
    if invert == "orientations":
        Ts = Ts.copy()
        Ts[..., :3, :3] = np.swapaxes(Ts[..., :3, :3], -1, -2)
    return Ts


def xyz_rpy(T_target_source: FloatArray) -> FloatArray:
    """x, y, z (m), roll, pitch and yaw (rad) of a transform (4, 4)."""
    return np.r_[T_target_source[:3, 3], rotation_to_rpy(T_target_source[:3, :3])]


# ------------------------------------------------------------------- their uncertainty

# Standard deviations above this (rad) count as unknown: the derivative does not hold that far.
_UNKNOWN_ANGLE = 0.3

# Roll and yaw cannot be separated if the cosine of the pitch is below this many standard deviations
# of the rotation: their own would be 10 deg and more, and far from normal.
_LOCKED_SIGMAS = 5.0
_LOCKED_COSINE = 1e-4


def turned(rotation: FloatArray, covariance: FloatArray) -> FloatArray:
    """Rotate covariances (..., 6, 6) of (rho, phi) by rotations (..., 3, 3).

    The result is along and about the parent's axes, as ROS messages carry covariances (REP 103):
    an error xi = (rho, phi) in ``T_parent_child @ exp(xi)`` moves the child's origin by ``R rho``,
    to first order, and rotates the child by ``R phi`` about the parent's axes through this origin.
    There is no lever arm.
    """
    both = on_both(rotation)
    return np.asarray(both @ covariance @ np.swapaxes(both, -1, -2))


def on_both(rotation: FloatArray) -> FloatArray:
    """Matrices (..., 6, 6) that rotate rho and phi by the same rotations (..., 3, 3)."""
    both = np.zeros((*np.shape(rotation)[:-2], 6, 6))
    both[..., :3, :3] = both[..., 3:, 3:] = rotation
    return both


def sigmas_in_parent(rotation_parent_child: FloatArray, covariance: FloatArray) -> FloatArray:
    """Standard deviations (6,) along and about the parent's axes; infinite if the covariance is."""
    if not np.isfinite(covariance).all():
        return np.full(6, np.inf)
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
    sigmas = np.sqrt(np.maximum(np.diag(jacobian @ covariance @ jacobian.T), 0.0))
    sigmas[sigmas > _UNKNOWN_ANGLE] = np.inf
    of_rotation = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance), 0.0))
    largest = np.max(of_rotation[of_rotation <= _UNKNOWN_ANGLE], initial=0.0)
    if np.hypot(rotation[0, 0], rotation[1, 0]) < max(_LOCKED_SIGMAS * largest, _LOCKED_COSINE):
        sigmas[[0, 2]] = np.inf
    return sigmas


def inverse_covariance(T_target_source: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariance (6, 6) of the inverse transform, in the same convention.

    ``inverse(T exp(xi)) = inverse(T) exp(-Ad_T xi)``, so the covariance is ``Ad_T C Ad_T'``.
    """
    covariance = np.asarray(covariance, dtype=float)
    if not np.isfinite(covariance).all():
        return np.full((6, 6), np.inf)
    moved = adjoint(np.asarray(T_target_source, dtype=float))
    return moved @ covariance @ moved.T


def absolute_errors(
    T_parent_child: FloatArray, truth_T_parent_child: FloatArray
) -> tuple[float, float]:
    """Absolute errors e_at (m) and e_aR (rad) of a transform (4, 4) against the true one: eqs 8 and
    9 of Välimäki et al. 2023.
    """
    translation = np.linalg.norm(truth_T_parent_child[:3, 3] - T_parent_child[:3, 3])
    rotation = rotation_angle(T_parent_child[:3, :3].T @ truth_T_parent_child[:3, :3])
    return float(translation), float(rotation)


def deviation(T_parent_child: FloatArray, T_reference: FloatArray) -> FloatArray:
    """Deviations (..., 6) of transforms (..., 4, 4) from another (4, 4), along (m) and about (rad)
    the axes of the parent sensor's frame.
    """
    rotation = rotation_log(T_parent_child[..., :3, :3] @ T_reference[:3, :3].T)
    translation = T_parent_child[..., :3, 3] - T_reference[:3, 3]
    return np.concatenate([translation, rotation], axis=-1)
