"""Ground of the simulated drives: MATLAB's ``peaks`` surface."""

import numpy as np

from hand_eye_calib.arrays import FloatArray


def peaks(x: FloatArray, y: FloatArray) -> FloatArray:
    """Height of three hills and three hollows around the origin, flat beyond about 3.5; arrays of
    one shape, no unit.
    """
    total: FloatArray = (
        3.0 * (1.0 - x) ** 2 * np.exp(-(x**2) - (y + 1.0) ** 2)
        - 10.0 * (x / 5.0 - x**3 - y**5) * np.exp(-(x**2) - y**2)
        - np.exp(-((x + 1.0) ** 2) - y**2) / 3.0
    )
    return total


def peaks_gradient(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives of :func:`peaks` with respect to x and y."""
    hill = 3.0 * np.exp(-(x**2) - (y + 1.0) ** 2)
    middle, polynomial = 10.0 * np.exp(-(x**2) - y**2), x / 5.0 - x**3 - y**5
    hollow = np.exp(-((x + 1.0) ** 2) - y**2) / 3.0
    along_x = -2.0 * (1.0 - x) * (1.0 + x * (1.0 - x)) * hill
    along_x += (2.0 * x * polynomial - 0.2 + 3.0 * x**2) * middle + 2.0 * (x + 1.0) * hollow
    along_y = -2.0 * (y + 1.0) * (1.0 - x) ** 2 * hill
    along_y += (2.0 * y * polynomial + 5.0 * y**4) * middle + 2.0 * y * hollow
    return along_x, along_y


def surface(
    x: FloatArray, y: FloatArray, height: float, scale: float, limit: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Height and slopes of the ground.

    Parameters
    ----------
    x, y : (N,) arrays
        m.
    height : float
        m per unit of ``peaks``.
    scale : float
        m per unit of the arguments of ``peaks``.
    limit : float
        Arguments of ``peaks`` beyond +/- limit are mirrored back, so that a long drive stays on the
        hills.

    Returns
    -------
    z, slope_x, slope_y : (N,) arrays
        Height in m and its derivatives along x and y.
    """
    (u, sign_u), (v, sign_v) = _mirrored(x / scale, limit), _mirrored(y / scale, limit)
    along_u, along_v = peaks_gradient(u, v)
    return (
        height * peaks(u, v),
        height / scale * sign_u * along_u,
        height / scale * sign_v * along_v,
    )


def _mirrored(values: FloatArray, limit: float) -> tuple[FloatArray, FloatArray]:
    """Triangle wave, equal to its argument within +/- limit, and its slope."""
    phase = np.mod(values + limit, 4.0 * limit)
    falling = phase > 2.0 * limit
    return np.where(falling, 3.0 * limit - phase, phase - limit), np.where(falling, -1.0, 1.0)
