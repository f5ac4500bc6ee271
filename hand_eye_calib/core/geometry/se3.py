"""Batched rigid transforms.

Transforms are ``(..., 4, 4)`` arrays named ``T_target_source``: they map coordinates of ``source``
into ``target``. Tangent vectors are ``(..., 6)`` arrays ``(rho, phi)``: translation (m) before
rotation (rad). They act on the right: ``T_target_source @ exp(xi_in_source)``. This module has its
own conversions of rotations, because the import of SciPy's takes a tenth of a second.
"""

import numpy as np
from numpy.typing import ArrayLike

from hand_eye_calib.core.base.arrays import FloatArray

# Below this angle (rad), Taylor series replace the closed forms of exp and log, which lose digits
# by cancellation. At this angle, the first omitted term is about 1e-16 of the sum.
_SERIES_ANGLE = 1e-2

# If the cosine of the pitch is smaller than this, roll and yaw are about the same axis up to
# rounding.
_SINGULAR_COSINE = 1e-7


def skew(vectors: ArrayLike) -> FloatArray:
    """Return matrices S (..., 3, 3) of vectors (..., 3), with ``S @ v == cross(vector, v)``."""
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
    """Return vectors v (..., 3) with ``skew(v)`` = M - M', for matrices M (..., 3, 3).

    For a rotation matrix, v is the axis times twice the sine of the angle.
    """
    twice = matrices - np.swapaxes(matrices, -1, -2)
    x = twice[..., 2, 1]
    y = twice[..., 0, 2]
    z = twice[..., 1, 0]
    return np.stack([x, y, z], axis=-1)


def cross(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return cross products (..., 3) of two arrays of vectors of the same shape (..., 3).

    For a few hundred vectors, this function takes a fraction of the time of ``numpy.cross``.
    """
    x, y, z = first.T
    u, v, w = second.T
    products = np.empty(first.shape)
    products.T[0] = y * w - z * v
    products.T[1] = z * u - x * w
    products.T[2] = x * v - y * u
    return products


def rotation_of(transforms: FloatArray) -> FloatArray:
    """Return the rotations (..., 3, 3), a view of transforms (..., 4, 4)."""
    return transforms[..., :3, :3]


def translation_of(transforms: FloatArray) -> FloatArray:
    """Return the translations (..., 3), m, a view of transforms (..., 4, 4)."""
    return transforms[..., :3, 3]


def from_rotation_translation(
    rotation: ArrayLike, translation: ArrayLike
) -> FloatArray:
    """Return transforms (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3), m."""
    rotation = np.asarray(rotation, dtype=float)
    translation = np.asarray(translation, dtype=float)
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    transforms = np.zeros((*shape, 4, 4))
    transforms[..., :3, :3] = rotation
    transforms[..., :3, 3] = translation
    transforms[..., 3, 3] = 1.0
    return transforms


def from_quat_xyzw(translation: ArrayLike, quat_xyzw: ArrayLike) -> FloatArray:
    """Return transforms (..., 4, 4) of translations (..., 3), m, and quaternions (..., 4).

    Quaternions have the scalar last. They are normalised here; callers check their length.

    Raises
    ------
    ValueError
        If a quaternion has length zero.
    """
    quats = np.asarray(quat_xyzw, dtype=float)
    norms = np.linalg.norm(quats, axis=-1, keepdims=True)
    if not norms.all():
        raise ValueError("found a quaternion of length zero")
    return from_rotation_translation(
        _matrices(*np.moveaxis(quats / norms, -1, 0)), translation
    )


def to_quat_xyzw(transforms: ArrayLike) -> FloatArray:
    """Return unit quaternions (..., 4) of transforms (..., 4, 4) or rotations (..., 3, 3).

    The scalar is last and not negative.
    """
    rotations = rotation_of(np.asarray(transforms, dtype=float))
    quats = _scaled_quats(rotations.reshape(-1, 3, 3))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return quats.reshape((*rotations.shape[:-2], 4))


def to_rows(transforms: ArrayLike) -> FloatArray:
    """Return rows x y z qx qy qz qw (..., 7) of transforms (..., 4, 4)."""
    Ts = np.asarray(transforms, dtype=float)
    return np.concatenate([translation_of(Ts), to_quat_xyzw(Ts)], axis=-1)


def rotation_from_rpy(rpy: ArrayLike) -> FloatArray:
    """Return rotations (..., 3, 3) of roll, pitch and yaw (..., 3), rad.

    The angles are about the fixed axes x, y and z in this order (REP 103, URDF).
    """
    roll, pitch, yaw = _about_axes(np.asarray(rpy, dtype=float))
    return yaw @ pitch @ roll


def _about_axes(angles: FloatArray) -> list[FloatArray]:
    """Return rotations (..., 3, 3) about x, about y and about z by angles (..., 3), rad."""
    units = np.eye(3)
    return [
        rotation_exp(angles[..., axis, None] * units[axis]) for axis in range(3)
    ]


def rotation_to_rpy(rotation: ArrayLike) -> FloatArray:
    """Return roll, pitch and yaw (..., 3), rad: the inverse of :func:`rotation_from_rpy`.

    The pitch is between -pi/2 and pi/2. At both ends, only the sum or the difference of roll and
    yaw is defined, and yaw is set to 0.
    """
    R = np.asarray(rotation, dtype=float)
    cosine = np.hypot(R[..., 0, 0], R[..., 1, 0])
    is_singular = cosine < _SINGULAR_COSINE
    singular_roll = np.arctan2(-R[..., 1, 2], R[..., 1, 1])
    regular_roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    regular_yaw = np.arctan2(R[..., 1, 0], R[..., 0, 0])
    roll = np.where(is_singular, singular_roll, regular_roll)
    pitch = np.arctan2(-R[..., 2, 0], cosine)
    yaw = np.where(is_singular, 0.0, regular_yaw)
    return np.stack([roll, pitch, yaw], axis=-1)


def in_other_order(rotations: FloatArray) -> FloatArray:
    """Correct rotations (N, 3, 3) whose Euler angles were read in the wrong convention.

    The angles were read as roll, pitch and yaw about fixed axes. In their source, they are
    rotations about the moving axes x, y and z (intrinsic), in this order.
    """
    roll, pitch, yaw = _about_axes(rotation_to_rpy(rotations))
    return roll @ pitch @ yaw


def nearest_rotation(matrices: FloatArray) -> FloatArray:
    """Return the rotations (..., 3, 3) nearest to matrices in the Frobenius norm.

    The sign of the smallest singular vector is chosen so that the determinant is 1. Motion in a
    plane does not determine this sign (S. Umeyama, *Least-squares estimation of transformation
    parameters between two point patterns*, 1991).
    """
    U, _, V_transposed = np.linalg.svd(matrices)
    U[..., :, 2] *= np.sign(np.linalg.det(U @ V_transposed))[..., None]
    return U @ V_transposed


def rotation_log(rotation: ArrayLike) -> FloatArray:
    """Return rotation vectors (..., 3), rad, of length at most pi, of rotations (..., 3, 3)."""
    rotation = np.asarray(rotation, dtype=float)
    quats = _scaled_quats(rotation.reshape(-1, 3, 3))
    return quat_log(quats).reshape(rotation.shape[:-1])


def rotations_between(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return rotation vectors (N, 3), rad, from ``start`` to ``end`` (N, 3, 3), in axes of both.

    A rotation vector has the same coordinates in the axes of its start and of its end.
    """
    return rotation_log(relative_rotations(start, end))


def relative_rotations(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the rotations ``start' end`` (N, 3, 3), in the axes of ``start`` (N, 3, 3)."""
    return np.swapaxes(start, 1, 2) @ end


def quat_log(quat_xyzw: FloatArray) -> FloatArray:
    """Return rotation vectors (N, 3), rad, of quaternions (N, 4) of any length and sign."""
    vector = quat_xyzw[:, :3]
    scalar = quat_xyzw[:, 3]
    # Sine of half the angle, times the length of the quaternion.
    sine = np.sqrt(np.einsum("ni,ni->n", vector, vector))
    angle = np.copysign(2.0, scalar) * np.arctan2(sine, np.abs(scalar))
    divisors = np.where(sine > 0.0, sine, 1.0)
    ratios = angle / divisors
    return vector * ratios[:, None]


def _scaled_quats(rotations: FloatArray) -> FloatArray:
    """Return quaternions (N, 4), not normalised, of rotation matrices (N, 3, 3).

    The scalar is last and not negative. All coefficients are computed from the largest one, so that
    no digits are lost (S. W. Shepperd, *Quaternion from rotation matrix*, 1978).
    """
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotations.reshape(-1, 9).T
    trace = r00 + r11 + r22
    quats = np.stack([r21 - r12, r02 - r20, r10 - r01, 1.0 + trace], axis=1)
    # If the trace is negative, the scalar is too small to start from. Start from the largest
    # coefficient i of the vector part.
    negative = np.flatnonzero(trace < 0.0)
    if negative.size:
        R = rotations[negative]
        row = np.arange(len(negative))
        i = np.argmax(np.diagonal(R, axis1=1, axis2=2), axis=1)
        j = (i + 1) % 3
        k = (i + 2) % 3
        by_vector = np.empty((len(R), 4))
        by_vector[row, i] = 1.0 - trace[negative] + 2.0 * R[row, i, i]
        by_vector[row, j] = R[row, j, i] + R[row, i, j]
        by_vector[row, k] = R[row, k, i] + R[row, i, k]
        by_vector[:, 3] = R[row, k, j] - R[row, j, k]
        quats[negative] = np.where(
            by_vector[:, 3:] < 0.0, -by_vector, by_vector
        )
    return quats


def rotation_exp(rotation_vector: ArrayLike) -> FloatArray:
    """Return rotation matrices (..., 3, 3) of rotation vectors (..., 3), rad."""
    rotation_vector = np.asarray(rotation_vector, dtype=float)
    squared_angles = np.einsum("...i,...i", rotation_vector, rotation_vector)
    half = 0.5 * np.sqrt(squared_angles)
    is_turned = half > 0.0
    divisors = np.where(is_turned, half, 1.0)
    sine_ratio = np.where(is_turned, np.sin(half) / divisors, 1.0)
    vector = (0.5 * sine_ratio)[..., None] * rotation_vector
    return _matrices(
        vector[..., 0], vector[..., 1], vector[..., 2], np.cos(half)
    )


def _matrices(
    x: FloatArray, y: FloatArray, z: FloatArray, w: FloatArray
) -> FloatArray:
    """Return rotation matrices (..., 3, 3) of the coefficients (...) of unit quaternions."""
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
    """Return the inverses ``T_source_target`` of transforms ``T_target_source`` (..., 4, 4)."""
    transforms = np.asarray(transforms, dtype=float)
    back = np.swapaxes(rotation_of(transforms), -1, -2)
    return from_rotation_translation(
        back, -times(back, translation_of(transforms))
    )


def retracted(transform: FloatArray, step: FloatArray) -> FloatArray:
    """Return a transform (4, 4) after a small step (rho, phi) in its source frame.

    The result is ``(R Exp(phi), t + R rho)``, which equals ``transform @ exp(step)`` to first
    order.
    """
    rotation = rotation_of(transform)
    return from_rotation_translation(
        rotation @ rotation_exp(step[3:]),
        translation_of(transform) + rotation @ step[:3],
    )


def exp(xi: ArrayLike) -> FloatArray:
    """Return the exponential map of SE(3).

    Parameters
    ----------
    xi : (..., 6) array
        Tangent vectors (rho in m, phi in rad).

    Returns
    -------
    (..., 4, 4) array

    Notes
    -----
    The translation is ``t = V rho`` with ``V = I + (1 - cos a)/a^2 [phi] + (a - sin a)/a^3
    [phi]^2`` and ``a = |phi|``: Sola, Deray, Atchuthan, *A micro Lie theory for state estimation in
    robotics*, 2018, eqs 172-174.
    """
    xi = np.asarray(xi, dtype=float)
    rho = xi[..., :3]
    phi = xi[..., 3:]
    angle = np.linalg.norm(phi, axis=-1)
    is_small = angle < _SERIES_ANGLE
    squared = angle**2
    safe = np.where(is_small, 1.0, angle)
    first_series = 0.5 - squared / 24 + squared**2 / 720
    first = np.where(is_small, first_series, (1 - np.cos(safe)) / safe**2)
    second_series = 1 / 6 - squared / 120 + squared**2 / 5040
    second = np.where(is_small, second_series, (safe - np.sin(safe)) / safe**3)
    cross_once = cross(phi, rho)
    translation = (
        rho
        + first[..., None] * cross_once
        + second[..., None] * cross(phi, cross_once)
    )
    return from_rotation_translation(rotation_exp(phi), translation)


def log(transforms: ArrayLike) -> FloatArray:
    """Return the logarithm of SE(3), the inverse of :func:`exp`.

    Parameters
    ----------
    transforms : (..., 4, 4) array

    Returns
    -------
    (..., 6) array
        (rho in m, phi in rad), with ``|phi| <= pi``.

    Notes
    -----
    ``rho = V^-1 t`` with ``V^-1 = I - [phi]/2 + (1/a^2 - (1 + cos a) / (2 a sin a)) [phi]^2``. With
    the half angle the last coefficient is ``(1 - (a/2) cot(a/2)) / a^2``, which is finite up to a =
    pi.
    """
    transforms = np.asarray(transforms, dtype=float)
    phi = rotation_log(rotation_of(transforms))
    translation = translation_of(transforms)
    angle = np.linalg.norm(phi, axis=-1)
    is_small = angle < _SERIES_ANGLE
    squared = angle**2
    safe = np.where(is_small, 1.0, angle)
    series = 1 / 12 + squared / 720 + squared**2 / 30240
    closed = (1 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2
    coefficient = np.where(is_small, series, closed)
    cross_once = cross(phi, translation)
    rho = (
        translation
        - 0.5 * cross_once
        + coefficient[..., None] * cross(phi, cross_once)
    )
    return np.concatenate([rho, phi], axis=-1)


def times(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return the products (..., k) of matrices (..., k, m) and vectors (..., m)."""
    return (matrices @ vectors[..., None])[..., 0]


def adjoint(transforms: ArrayLike) -> FloatArray:
    """Return the adjoint matrices (..., 6, 6) of transforms (..., 4, 4).

    An adjoint maps a tangent vector (rho, phi) from the source frame to the target frame: ``T @
    exp(xi) == exp(adjoint(T) @ xi) @ T``.
    """
    transforms = np.asarray(transforms, dtype=float)
    rotation = rotation_of(transforms)
    matrices = block_diagonal(rotation)
    matrices[..., :3, 3:] = skew(translation_of(transforms)) @ rotation
    return matrices


def rotation_angle(rotation: ArrayLike) -> FloatArray:
    """Return the angles (...), rad, from 0 to pi, of rotation matrices (..., 3, 3).

    Sine and cosine together are exact both for small angles and for angles near pi.
    """
    rotation = np.asarray(rotation, dtype=float)
    x, y, z = np.moveaxis(vee(rotation), -1, 0)
    twice_sine = np.sqrt(x**2 + y**2 + z**2)
    twice_cosine = np.trace(rotation, axis1=-2, axis2=-1) - 1.0
    return np.arctan2(twice_sine, twice_cosine)


def interpolate(
    start: FloatArray, end: FloatArray, fraction: ArrayLike
) -> FloatArray:
    """Interpolate poses along the geodesic of SE(3), which is a motion with constant twist.

    Parameters
    ----------
    start, end : (..., 4, 4) arrays
        ``T_world_sensor`` at both ends.
    fraction : (...) array
        0 is ``start``, 1 is ``end``. Other values outside of [0, 1] extrapolate with the same
        twist.

    Returns
    -------
    (..., 4, 4) array
    """
    fractions = np.asarray(fraction, dtype=float)
    step = log(inverse(start) @ end)
    return start @ exp(fractions[..., None] * step)


def chained(steps: FloatArray) -> FloatArray:
    """Return the cumulative products (N + 1, k, k) of steps (N, k, k). The first is the identity.

    The steps are rotations or transforms.
    """
    products = np.concatenate([np.eye(steps.shape[-1])[None], steps])
    # Each pass doubles the number of steps in a product, until all products are complete.
    span = 1
    while span < len(products):
        products[span:] = products[:-span] @ products[span:]
        span *= 2
    return products


def put_right(
    Ts: FloatArray, invert: str = "none", quaternion: str = "xyzw"
) -> FloatArray:
    """Correct poses (N, 4, 4) that were read in the wrong convention.

    Parameters
    ----------
    Ts : (N, 4, 4) array
    invert : {"none", "poses", "orientations"}
        Part that is inverted, because the source contains the pose of the world in the sensor's
        frame.
    quaternion : {"xyzw", "wxyz", "yzwx"}
        True order of the four numbers that were read as x y z w.

    Returns
    -------
    (N, 4, 4) array
    """
    if quaternion != "xyzw":
        # Move the true x, which was read at another place, to the first place.
        quats = np.roll(to_quat_xyzw(Ts), -quaternion.index("x"), axis=-1)
        Ts = from_quat_xyzw(translation_of(Ts), quats)
    if invert == "poses":
        return inverse(Ts)
    if invert == "orientations":
        Ts = Ts.copy()
        Ts[..., :3, :3] = np.swapaxes(rotation_of(Ts), -1, -2)
    return Ts


def xyz_rpy(T_target_source: FloatArray) -> FloatArray:
    """Return x, y, z (m), roll, pitch and yaw (rad) of a transform (4, 4)."""
    rpy = rotation_to_rpy(rotation_of(T_target_source))
    return np.r_[translation_of(T_target_source), rpy]


def block_diagonal(rotation: FloatArray) -> FloatArray:
    """Return matrices (..., 6, 6) that rotate both rho and phi by rotations (..., 3, 3)."""
    both = np.zeros((*np.shape(rotation)[:-2], 6, 6))
    both[..., :3, :3] = both[..., 3:, 3:] = rotation
    return both


def absolute_errors(
    T_parent_child: FloatArray, truth_T_parent_child: FloatArray
) -> tuple[float, float]:
    """Return the absolute errors e_at (m) and e_aR (rad) of a transform (4, 4).

    Välimäki et al. 2023, eqs 8 and 9.
    """
    translation = np.linalg.norm(
        translation_of(truth_T_parent_child) - translation_of(T_parent_child)
    )
    rotation = rotation_angle(
        rotation_of(T_parent_child).T @ rotation_of(truth_T_parent_child)
    )
    return float(translation), float(rotation)


def deviation(
    T_parent_child: FloatArray, T_reference: FloatArray
) -> FloatArray:
    """Return deviations (..., 6) of transforms (..., 4, 4) from a reference (4, 4).

    The deviations are along (m) and about (rad) the axes of the parent sensor's frame.
    """
    rotation = rotation_log(
        rotation_of(T_parent_child) @ rotation_of(T_reference).T
    )
    translation = translation_of(T_parent_child) - translation_of(T_reference)
    return np.concatenate([translation, rotation], axis=-1)
