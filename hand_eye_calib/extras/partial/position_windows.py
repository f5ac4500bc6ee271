"""Lever arm of a sensor that measures only positions, from windows without a noise model."""

from __future__ import annotations

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.stats import robust_weights
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.partial.position_tuning import TUNING, PositionTuning

# Largest number of steps for the starting values.
_START_STEPS = 50
# The steps end if the lever arm changes by less than this (m).
_START_SETTLED_M = 1e-6
# Prior information for a lever arm of zero, as a share of the information on an axis. It is for
# motion that does not reveal the lever arm.
_PULL_TO_ZERO = 1e-6

# Number of parts of a recording whose paths are compared separately.
_PATH_PARTS = 10


def fit_windows(
    Ts_pw_p: FloatArray, positions: FloatArray, with_scale: bool, window: int
) -> tuple[FloatArray, float, FloatArray]:
    """Align each window of the recording on its own, with robust weights.

    The model in a window is ``scale A^T p = R lever_arm + t``: p is the position, A the alignment
    of the window, and (R, t) the pose. Positions are rows in the code: ``p^T A``.

    Returns
    -------
    lever_arm : (3,) array
    scale : float
        Scale; 1 unless it is estimated.
    orientations : (N, 3, 3) array
        Orientations of the other sensor in the world of the positions, window by window.
    """
    lever_arm = np.zeros(3)
    scale = 1.0
    size = min(window, len(positions))
    rotations = _windows(se3.rotation_of(Ts_pw_p), size)
    path = _windows(se3.translation_of(Ts_pw_p), size)
    measured = _windows(positions, size)
    of_windows = np.einsum("nkij,nkil->njl", rotations, rotations)
    information = of_windows + _PULL_TO_ZERO * size * np.eye(3)
    for _ in range(_START_STEPS):
        predicted = rotations @ lever_arm + path
        alignments = _rotations(measured, predicted)
        rotated = measured @ alignments
        if with_scale:
            products = (rotated * predicted).sum(axis=(1, 2))
            squares = (rotated**2).sum(axis=(1, 2))
            scales = np.divide(
                products, squares, np.zeros_like(products), where=squares > 0.0
            )
            # Paths without motion have no scale.
            scale = float(np.median(scales)) or 1.0
        residuals = scale * rotated - path
        errors = np.sqrt(
            ((residuals - rotations @ lever_arm) ** 2).sum(axis=2).mean(axis=1)
        )
        weights = robust_weights(
            "cauchy", (errors / (np.median(errors) + 1e-12)) ** 2
        )
        score = np.einsum("n,nkij,nki->j", weights, rotations, residuals)
        previous = lever_arm
        lever_arm = np.linalg.solve(
            np.einsum("n,njl->jl", weights, information), score
        )
        if np.abs(lever_arm - previous).max() < _START_SETTLED_M:
            break
    window_of_pose = np.minimum(
        np.arange(len(positions)) // size, len(alignments) - 1
    )
    return (
        lever_arm,
        scale,
        alignments[window_of_pose] @ se3.rotation_of(Ts_pw_p),
    )


def unexplained_at_start(
    Ts_pw_p: FloatArray, positions: FloatArray, tuning: PositionTuning = TUNING
) -> float:
    """Return the share of the path that the lever arm of the starting values does not explain.

    The starting values ignore the noise model, so they are fast to compute. Their scale is 1 here.
    The arguments are those of :func:`unexplained_share`.
    """
    lever_arm, scale, _ = fit_windows(Ts_pw_p, positions, False, tuning.window)
    return unexplained_share(Ts_pw_p, positions, lever_arm, scale)


def unexplained_share(
    Ts_pw_p: FloatArray,
    positions: FloatArray,
    lever_arm: FloatArray,
    scale: float,
) -> float:
    """Return the share of the positions' path that poses and a lever arm do not explain.

    The share is the median over tenths of the recording, each aligned on its own.

    Parameters
    ----------
    Ts_pw_p : (N, 4, 4) array
    positions : (N, 3) array
    lever_arm : (3,) array
    scale : float
        Scale of the positions.

    Returns
    -------
    float
        Share; 1 if nothing moves.
    """
    predicted = se3.rotation_of(Ts_pw_p) @ lever_arm + se3.translation_of(
        Ts_pw_p
    )
    size = max(len(positions) // _PATH_PARTS, min(_PATH_PARTS, len(positions)))
    expected = _windows(predicted, size)
    measured = _windows(scale * positions, size)
    residuals = measured @ _rotations(measured, expected) - expected
    usual_residual = np.median((residuals**2).sum(axis=(1, 2)))
    usual_path = np.median((measured**2).sum(axis=(1, 2)))
    return float(np.sqrt(usual_residual / usual_path)) if usual_path else 1.0


def _windows(values: FloatArray, size: int) -> FloatArray:
    """Return values (n, size, ...) of windows of (N, ...), minus the mean of each window."""
    whole = len(values) // size * size
    windows = values[:whole].reshape(-1, size, *values.shape[1:])
    return windows - windows.mean(axis=1, keepdims=True)


def _rotations(measured: FloatArray, predicted: FloatArray) -> FloatArray:
    """Return rotations (n, 3, 3) from predicted to measured positions (n, k, 3) in windows."""
    return se3.nearest_rotation(np.einsum("nki,nkj->nij", measured, predicted))
