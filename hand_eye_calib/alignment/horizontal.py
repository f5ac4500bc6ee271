"""Factors of distances along x and along y: other than one where latitudes and longitudes were
swapped, or made metres of wrongly.
"""

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.stats import median

# Distances are compared between positions that are so many parts of the recording apart: far more
# than a lever arm is long.
_PARTS = (4, 8, 16, 32)

# Shorter ones than this share of the median are left out. Weights are found in so many rounds.
_SHORT, _ROUNDS = 0.3, 5


def horizontal_factors(path: FloatArray, positions: FloatArray) -> FloatArray | None:
    """Factors (2,) by which x and y of positions must be multiplied so that their distances become
    those of a path.

    The square of a distance along the direction (c, s) is multiplied by ``M11 c^2 + 2 M12 c s +
    M22 s^2``, whatever the worlds of both are, and however they drift against each other.

    Parameters
    ----------
    path : (N, 3) array
        Of the sensor with poses, m.
    positions : (N, 3) array
        Of another point of the same body, z up.

    Returns
    -------
    (2,) array or None
        None if the path does not show both.
    """
    lags = [lag for lag in (len(path) // part for part in _PARTS) if lag > 0]
    steps = np.concatenate([positions[lag:] - positions[:-lag] for lag in lags])
    chords = np.concatenate([path[lag:] - path[:-lag] for lag in lags])
    flat2 = (steps[:, :2] ** 2).sum(axis=1)
    used = flat2 > _SHORT**2 * median(flat2)
    if not used.any():
        return None
    across, along = (steps[used, :2] / np.sqrt(flat2[used])[:, None]).T
    gains = ((chords[used] ** 2).sum(axis=1) - steps[used, 2] ** 2) / flat2[used]
    columns = np.stack([across**2, 2 * across * along, along**2], axis=1)
    weights = np.ones(len(gains))
    for _ in range(_ROUNDS):
        normal = (columns * weights[:, None]).T @ columns
        if np.linalg.cond(normal) > 1e6:
            return None
        found = np.linalg.solve(normal, (columns * weights[:, None]).T @ gains)
        off = np.abs(gains - columns @ found)
        weights = 1.0 / (1.0 + (off / (median(off) + 1e-12)) ** 2)
    factors: FloatArray = np.sqrt(np.maximum(found[[0, 2]], 0.0))
    return factors
