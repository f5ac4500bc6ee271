"""Batched rigid transforms.

Transforms are ``(..., 4, 4)`` arrays named ``T_target_source``: they map coordinates of ``source``
into ``target``. Tangent vectors are ``(..., 6)`` arrays ``(rho, phi)``, translation (m) before
rotation (rad), acting on the right: ``T_target_source @ exp(xi_in_source)``. Rotation conversions
are written out: SciPy's, as good, take a tenth of a second to import.
"""

import numpy as np

# Below this angle the coefficients of exp and log come from their Taylor series. At 1e-2 rad the
# first term left out is of order angle^6, about 1e-16 relative, whereas the closed forms lose
# digits to cancellation.
_SERIES_ANGLE = 1e-2

# Cosine of the pitch below which roll and yaw turn about the same axis, but for rounding.
_SINGULAR_COSINE = 1e-7


def skew(vectors):
    """Cross-product matrices.

    Parameters
    ----------
    vectors : (..., 3) array

    Returns
    -------
    (..., 3, 3) array ``S`` with ``S @ v == cross(vector, v)``
    """
    vectors = np.asarray(vectors, dtype=float)
    matrices = np.zeros(vectors.shape + (3,))
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    matrices[..., 0, 1], matrices[..., 0, 2], matrices[..., 1, 2] = -z, y, -x
    matrices[..., 1, 0], matrices[..., 2, 0], matrices[..., 2, 1] = z, -y, x
    return matrices


def cross(left, right):
    """Cross products (..., 3) of vectors, two arrays of the same shape (..., 3): numpy.cross takes
    several times as long for a few hundred.
    """
    (x, y, z), (u, v, w) = (vectors.T for vectors in (left, right))
    products = np.empty(left.shape)
    products.T[0], products.T[1], products.T[2] = y * w - z * v, z * u - x * w, x * v - y * u
    return products


def from_rotation_translation(rotation, translation):
    """Transforms from rotation matrices (..., 3, 3) and translations (..., 3) in metres; returns
    (..., 4, 4).
    """
    rotation, translation = np.asarray(rotation, dtype=float), np.asarray(translation, dtype=float)
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    transforms = np.zeros(shape + (4, 4))
    transforms[..., :3, :3] = rotation
    transforms[..., :3, 3] = translation
    transforms[..., 3, 3] = 1.0
    return transforms


def from_quat_xyzw(translation, quat_xyzw):
    """Transforms from translations (..., 3) in metres and quaternions (..., 4), scalar last;
    returns (..., 4, 4).

    Quaternions are normalised; whether they were close enough to unit length is for the caller to
    judge.

    Raises
    ------
    ValueError
        For a quaternion of length zero.
    """
    quats = np.asarray(quat_xyzw, dtype=float)
    norms = np.linalg.norm(quats, axis=-1, keepdims=True)
    if not norms.all():
        raise ValueError("found a quaternion of length zero")
    return from_rotation_translation(_matrices(*np.moveaxis(quats / norms, -1, 0)), translation)


def to_quat_xyzw(transforms):
    """Quaternions (..., 4), scalar last and not negative, of the rotations of transforms (..., 4,
    4), or of rotations (..., 3, 3).
    """
    rotations = np.asarray(transforms, dtype=float)[..., :3, :3]
    quats = _scaled_quats(rotations.reshape(-1, 3, 3))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return quats.reshape(rotations.shape[:-2] + (4,))


def rotation_from_rpy(rpy):
    """Rotation matrices (..., 3, 3) of roll, pitch and yaw (..., 3), rad, about the fixed axes x, y
    and z in this order (REP 103, URDF).
    """
    rpy = np.asarray(rpy, dtype=float)
    roll, pitch, yaw = (rotation_exp(rpy[..., axis, None] * np.eye(3)[axis]) for axis in range(3))
    return yaw @ pitch @ roll


def rotation_to_rpy(rotation):
    """Roll, pitch and yaw (..., 3), rad, of rotation matrices (..., 3, 3): the inverse of
    :func:`rotation_from_rpy`.

    The pitch is from -pi/2 to pi/2. Where it is one of these, only the sum or difference of the
    others is defined, and the yaw is 0.
    """
    R = np.asarray(rotation, dtype=float)
    cosine = np.hypot(R[..., 0, 0], R[..., 1, 0])
    singular = cosine < _SINGULAR_COSINE
    roll = np.where(
        singular, np.arctan2(-R[..., 1, 2], R[..., 1, 1]), np.arctan2(R[..., 2, 1], R[..., 2, 2])
    )
    yaw = np.where(singular, 0.0, np.arctan2(R[..., 1, 0], R[..., 0, 0]))
    return np.stack([roll, np.arctan2(-R[..., 2, 0], cosine), yaw], axis=-1)


def rotation_log(rotation):
    """Rotation vectors (..., 3), in rad and of length at most pi, of rotation matrices (..., 3, 3)."""
    rotation = np.asarray(rotation, dtype=float)
    return quat_log(_scaled_quats(rotation.reshape(-1, 3, 3))).reshape(rotation.shape[:-1])


def quat_log(quat_xyzw):
    """Rotation vectors (N, 3), rad, of quaternions (N, 4), scalar last, of any length and sign."""
    sine = np.sqrt(
        np.einsum("ni,ni->n", quat_xyzw[:, :3], quat_xyzw[:, :3])
    )  # of half the angle, times the quaternion's length
    angle = np.copysign(2.0, quat_xyzw[:, 3]) * np.arctan2(sine, np.abs(quat_xyzw[:, 3]))
    return quat_xyzw[:, :3] * (angle / np.where(sine > 0.0, sine, 1.0))[:, None]


def _scaled_quats(rotations):
    """Quaternions (N, 4), scalar last and not negative, of rotations (N, 3, 3), but of any length.

    From the largest of their numbers, so that no digits are lost: S. W. Shepperd, *Quaternion from
    rotation matrix*, 1978.
    """
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotations.reshape(-1, 9).T
    trace = r00 + r11 + r22
    quats = np.stack([r21 - r12, r02 - r20, r10 - r01, 1.0 + trace], axis=1)
    turned_far = np.flatnonzero(trace < 0.0)
    if turned_far.size:
        R, row = rotations[turned_far], np.arange(len(turned_far))
        i = np.argmax(np.diagonal(R, axis1=1, axis2=2), axis=1)
        j, k = (i + 1) % 3, (i + 2) % 3
        far = np.empty((len(R), 4))
        far[row, i] = 1.0 - trace[turned_far] + 2.0 * R[row, i, i]
        far[row, j], far[row, k] = R[row, j, i] + R[row, i, j], R[row, k, i] + R[row, i, k]
        far[:, 3] = R[row, k, j] - R[row, j, k]
        quats[turned_far] = np.where(far[:, 3:] < 0.0, -far, far)
    return quats


def rotation_exp(rotation_vector):
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in rad."""
    rotation_vector = np.asarray(rotation_vector, dtype=float)
    half = 0.5 * np.sqrt(np.einsum("...i,...i", rotation_vector, rotation_vector))
    shrunk = 0.5 * np.where(half > 0.0, np.sin(half) / np.where(half > 0.0, half, 1.0), 1.0)
    return _matrices(*(shrunk * rotation_vector[..., axis] for axis in range(3)), np.cos(half))


def _matrices(x, y, z, w):
    """Rotation matrices (..., 3, 3) of quaternions of length 1, each number of them (...)."""
    matrices = np.empty((*np.shape(w), 3, 3))
    twice_x, twice_y, twice_z = 2.0 * x, 2.0 * y, 2.0 * z
    xx, yy, zz = twice_x * x, twice_y * y, twice_z * z
    matrices[..., 0, 0], matrices[..., 1, 1], matrices[..., 2, 2] = (
        1.0 - (yy + zz),
        1.0 - (xx + zz),
        1.0 - (xx + yy),
    )
    for row, column, product, other in (
        (1, 0, twice_x * y, twice_z * w),
        (0, 2, twice_x * z, twice_y * w),
        (2, 1, twice_y * z, twice_x * w),
    ):
        matrices[..., row, column], matrices[..., column, row] = product + other, product - other
    return matrices


def inverse(transforms):
    """Inverses of transforms (..., 4, 4): ``T_source_target`` of ``T_target_source``."""
    transforms = np.asarray(transforms, dtype=float)
    rotation_inverse = np.swapaxes(transforms[..., :3, :3], -1, -2)
    return from_rotation_translation(
        rotation_inverse, -(rotation_inverse @ transforms[..., :3, 3:])[..., 0]
    )


def exp(xi):
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
    rho, phi = xi[..., :3], xi[..., 3:]
    angle = np.linalg.norm(phi, axis=-1)
    safe = np.where(angle < _SERIES_ANGLE, 1.0, angle)
    squared = angle**2
    first = np.where(
        angle < _SERIES_ANGLE, 0.5 - squared / 24 + squared**2 / 720, (1 - np.cos(safe)) / safe**2
    )
    second = np.where(
        angle < _SERIES_ANGLE,
        1 / 6 - squared / 120 + squared**2 / 5040,
        (safe - np.sin(safe)) / safe**3,
    )
    cross_once = cross(phi, rho)
    translation = rho + first[..., None] * cross_once + second[..., None] * cross(phi, cross_once)
    return from_rotation_translation(rotation_exp(phi), translation)


def log(transforms):
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
    safe = np.where(angle < _SERIES_ANGLE, 1.0, angle)
    squared = angle**2
    coefficient = np.where(
        angle < _SERIES_ANGLE,
        1 / 12 + squared / 720 + squared**2 / 30240,
        (1 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2,
    )
    cross_once = cross(phi, translation)
    rho = translation - 0.5 * cross_once + coefficient[..., None] * cross(phi, cross_once)
    return np.concatenate([rho, phi], axis=-1)


def adjoint(transforms):
    """Adjoint matrices (..., 6, 6) of transforms (..., 4, 4).

    ``T @ exp(xi) == exp(adjoint(T) @ xi) @ T``: moves a tangent vector (rho, phi) from the source
    frame to the target frame.
    """
    transforms = np.asarray(transforms, dtype=float)
    rotation = transforms[..., :3, :3]
    matrices = np.zeros(transforms.shape[:-2] + (6, 6))
    matrices[..., :3, :3] = rotation
    matrices[..., 3:, 3:] = rotation
    matrices[..., :3, 3:] = skew(transforms[..., :3, 3]) @ rotation
    return matrices


def rotation_angle(rotation):
    """Angles (...) in rad, from 0 to pi, of rotation matrices (..., 3, 3).

    Taken from sine and cosine together, so that neither small angles nor angles near pi lose
    digits.
    """
    rotation = np.asarray(rotation, dtype=float)
    twice_sine = np.sqrt(
        (rotation[..., 2, 1] - rotation[..., 1, 2]) ** 2
        + (rotation[..., 0, 2] - rotation[..., 2, 0]) ** 2
        + (rotation[..., 1, 0] - rotation[..., 0, 1]) ** 2
    )
    twice_cosine = np.trace(rotation, axis1=-2, axis2=-1) - 1.0
    return np.arctan2(twice_sine, twice_cosine)


def interpolate(start, end, fraction):
    """Poses along the geodesic of SE(3) from ``start`` to ``end`` (constant twist).

    Parameters
    ----------
    start, end : (..., 4, 4) arrays
        ``T_world_sensor`` at both ends.
    fraction : (...) array
        0 gives ``start``, 1 gives ``end``; values outside [0, 1] extend the same twist.

    Returns
    -------
    (..., 4, 4) array
    """
    step = log(inverse(start) @ end)
    return start @ exp(np.asarray(fraction, dtype=float)[..., None] * step)
