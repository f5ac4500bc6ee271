"""The scale: factor from the child's unit of length to the parent's."""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.alignment.similarity import (
    MAX_UNEXPLAINED_TRANSLATION,
    SimilarityFit,
    fit_similarity,
)
from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.errors import NotEnoughDataError
from hand_eye_calib.pairing.motion_pairs import pairs_over
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.stats import median

# Motions over these times (s) are compared; the lag with the smallest relative standard deviation
# wins. Long motions show the scale best.
_LAGS_S = (3.0, 1.0, 8.0)
_MIN_PAIRS = 20

# A scale differs from 1 if it is off by more than _MIN_DIFFERENCE and by _MIN_SIGMAS standard
# deviations, and if the fit leaves less than _MAX_UNEXPLAINED_TO_DIFFER of the motion unexplained:
# jumps in most of the motions could imitate a scale.
_MIN_DIFFERENCE, _MIN_SIGMAS, _MAX_UNEXPLAINED_TO_DIFFER = 0.01, 5.0, 0.1

# Distances are compared between positions that are so many parts of the recording apart: far more
# than a lever arm is long.
_PARTS = (4, 8, 16, 32)

# Shorter ones than this share of the median are left out. Weights are found in so many rounds.
_SHORT, _ROUNDS = 0.3, 5


@dataclass(frozen=True)
class Scale:
    """An estimated scale.

    Attributes
    ----------
    value : float
        Factor from the child's lengths to the parent's.
    sigma : float
        Standard deviation.
    fit : SimilarityFit
        The fit it comes from.
    """

    value: float
    sigma: float
    fit: SimilarityFit

    @property
    def differs(self) -> bool:
        """Whether the lengths of the two streams differ significantly, and by enough to matter."""
        significant = abs(self.value - 1.0) > max(_MIN_DIFFERENCE, _MIN_SIGMAS * self.sigma)
        return significant and self.fit.unexplained_translation < _MAX_UNEXPLAINED_TO_DIFFER

    @property
    def relative_error(self) -> float:
        """Relative standard deviation, plus the unexplained share if the fit does not hold."""
        penalty = 0.0 if self.fit.explains_translation else self.fit.unexplained_translation
        return self.sigma / self.value + penalty


def estimate_scale(pose_pairs: PosePairs, start: SimilarityFit | None = None) -> Scale:
    """Estimate the factor from the child's unit of length to the parent's.

    Parameters
    ----------
    pose_pairs : PosePairs
    start : SimilarityFit, optional
        Fit of the same streams to start at; a start is searched for without one.

    Returns
    -------
    Scale

    Raises
    ------
    NotEnoughDataError
        If there are too few poses.
    """
    scales: list[Scale] = []
    fit = start
    for lag_s in _LAGS_S:
        pairs = pairs_over(pose_pairs, lag_s)
        if len(pairs) < _MIN_PAIRS:
            continue
        fit = fit_similarity(pairs, start=fit)
        scales.append(Scale(fit.scale, fit.scale_sigma, fit))
    if not scales:
        raise NotEnoughDataError(
            f"the scale cannot be estimated from {len(pose_pairs)} pose pairs: fewer than "
            f"{_MIN_PAIRS} of them are {min(_LAGS_S):g} s apart; record longer, or give scale"
        )
    return min(scales, key=lambda scale: scale.relative_error)


def child_scaled(pose_pairs: PosePairs, factor: float) -> PosePairs:
    """The same poses with the child's translations times ``factor``."""
    Ts_cw_c = pose_pairs.Ts_cw_c.copy()
    Ts_cw_c[:, :3, 3] *= factor
    return PosePairs(pose_pairs.stamps_ns, pose_pairs.Ts_pw_p, Ts_cw_c)


@dataclass(frozen=True)
class ScaleInUse:
    """Factor of the child's lengths, and the estimate it comes from if it was estimated."""

    value: float = 1.0
    estimate: Scale | None = None
    warnings: tuple[str, ...] = ()


def settle_scale(pose_pairs: PosePairs, option: str | float) -> ScaleInUse:
    """The scale to use: given, or estimated if the option ``scale`` asks for it.

    Raises
    ------
    NotEnoughDataError
        If it is to be estimated and cannot be.
    """
    if option == "none":
        return ScaleInUse()
    if not isinstance(option, str):
        return ScaleInUse(option)
    if option == "estimate":
        scale = estimate_scale(pose_pairs)
        if not scale.fit.explains_translation:
            raise NotEnoughDataError(
                "the scale cannot be estimated: even with a scale, "
                f"{scale.fit.unexplained_translation:.0%} of the motion stays unexplained "
                f"(at most {MAX_UNEXPLAINED_TRANSLATION:.0%} is allowed); "
                "check the streams, or give scale"
            )
        return ScaleInUse(scale.value, scale)
    try:
        scale = estimate_scale(pose_pairs)
    except NotEnoughDataError:
        return ScaleInUse()
    if not scale.differs:
        return ScaleInUse()
    warning = (
        f"the child's lengths are multiplied by {scale.value:.4f} +/- {scale.sigma:.4f}, "
        "as estimated from the motion"
    )
    return ScaleInUse(scale.value, scale, (warning,))


def horizontal_factors(path: FloatArray, positions: FloatArray) -> tuple[float, float]:
    """Factors by which x and y of positions must be multiplied so that their distances become those
    of a path; ones if the path does not show both.

    The square of a distance along the direction (c, s) is multiplied by ``M11 c^2 + 2 M12 c s +
    M22 s^2``, whatever the worlds of both are, and however they drift against each other.

    Parameters
    ----------
    path : (N, 3) array
        Of the sensor with poses, m.
    positions : (N, 3) array
        Of another point of the same body, z up.
    """
    lags = [lag for lag in (len(path) // part for part in _PARTS) if lag > 0]
    steps = np.concatenate([positions[lag:] - positions[:-lag] for lag in lags])
    chords = np.concatenate([path[lag:] - path[:-lag] for lag in lags])
    flat2 = (steps[:, :2] ** 2).sum(axis=1)
    used = flat2 > _SHORT**2 * median(flat2)
    if not used.any():
        return 1.0, 1.0
    across, along = (steps[used, :2] / np.sqrt(flat2[used])[:, None]).T
    gains = ((chords[used] ** 2).sum(axis=1) - steps[used, 2] ** 2) / flat2[used]
    columns = np.stack([across**2, 2 * across * along, along**2], axis=1)
    weights = np.ones(len(gains))
    for _ in range(_ROUNDS):
        normal = (columns * weights[:, None]).T @ columns
        if np.linalg.cond(normal) > 1e6:
            return 1.0, 1.0
        found = np.linalg.solve(normal, (columns * weights[:, None]).T @ gains)
        off = np.abs(gains - columns @ found)
        weights = 1.0 / (1.0 + (off / (median(off) + 1e-12)) ** 2)
    of_x, of_y = np.sqrt(np.maximum(found[[0, 2]], 0.0)).tolist()
    return of_x, of_y
