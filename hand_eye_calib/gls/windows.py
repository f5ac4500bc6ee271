"""Lever arms by windows of the recording, each aligned by itself: a start that needs no noise
model, and how much of the path an answer explains.
"""

from __future__ import annotations

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.geometry import se3

# Poses of the windows that are aligned by themselves: for the first lever arm, and for the first
# orientations. The first lever arm is drawn to zero by so much where the motion does not tell it.
_START_WINDOWS, _ALIGNED_WINDOW = (480, 60), 100
_START_STEPS, _SETTLED_START, _DRAWN = 50, 1e-6, 1e-6

# Parts of a recording that are compared by themselves.
_PARTS = 10


def first_lever_arm(
    Ts_pw_p: FloatArray, positions: FloatArray, with_scale: bool
) -> tuple[FloatArray, float]:
    """The lever arm (3,) and the scale, if it is asked for, that fit windows best; bad ones count
    less.

    Short windows hardly know of the drift, but have local minima: long ones lead to the right one,
    and know the scale.
    """
    lever_arm, scale = np.zeros(3), 1.0
    of_all = Ts_pw_p[:, :3, :3], Ts_pw_p[:, :3, 3], positions
    for size in _START_WINDOWS:
        axes, path, measured = (_windows(values, min(size, len(positions))) for values in of_all)
        information = np.einsum("nkij,nkil->njl", axes, axes) + _DRAWN * axes.shape[1] * np.eye(3)
        for _ in range(_START_STEPS):
            predicted = axes @ lever_arm + path
            rotated = measured @ _rotations(measured, predicted)
            if with_scale:
                shares = (rotated * predicted).sum(axis=(1, 2)) / (rotated**2).sum(axis=(1, 2))
                scale = float(np.median(shares))
            residuals = scale * rotated - path
            errors = np.sqrt(((residuals - axes @ lever_arm) ** 2).sum(axis=2).mean(axis=1))
            weights = 1.0 / (1.0 + (errors / (np.median(errors) + 1e-12)) ** 2)
            pulled = np.einsum("n,nkij,nki->j", weights, axes, residuals)
            before = lever_arm
            lever_arm = np.linalg.solve(np.einsum("n,njl->jl", weights, information), pulled)
            if np.abs(lever_arm - before).max() < _SETTLED_START:
                break
        with_scale = False
    return lever_arm, scale


def unexplained_share(
    Ts_pw_p: FloatArray, positions: FloatArray, lever_arm: FloatArray, scale: float
) -> float:
    """Share of the path of positions (N, 3) that the poses (N, 4, 4) and a lever arm do not
    explain, in tenths of the recording, each aligned by itself; 1 if nothing moves.
    """
    predicted = Ts_pw_p[:, :3, :3] @ lever_arm + Ts_pw_p[:, :3, 3]
    size = max(len(positions) // _PARTS, min(_PARTS, len(positions)))
    expected, measured = (_windows(path, size) for path in (predicted, scale * positions))
    residuals = measured @ _rotations(measured, expected) - expected
    left, whole = ((path**2).sum(axis=(1, 2)) for path in (residuals, measured))
    return float(np.sqrt(np.median(left) / np.median(whole))) if np.median(whole) else 1.0


def _windows(values: FloatArray, size: int) -> FloatArray:
    """Values (N, ...) of windows of a size, (n, size, ...), each less its mean."""
    whole = len(values) // size * size
    windows = values[:whole].reshape(-1, size, *values.shape[1:])
    return windows - windows.mean(axis=1, keepdims=True)


def _rotations(measured: FloatArray, predicted: FloatArray) -> FloatArray:
    """Rotations (n, 3, 3) from predicted to measured positions (n, k, 3) of windows, centred."""
    return se3.nearest_rotation(np.einsum("nki,nkj->nij", measured, predicted))


def aligned(Ts_pw_p: FloatArray, positions: FloatArray, lever_arm: FloatArray) -> FloatArray:
    """Poses (N, 4, 4) of the positions, with the other sensor's orientations turned into their
    world, window by window.
    """
    predicted = Ts_pw_p[:, :3, :3] @ lever_arm + Ts_pw_p[:, :3, 3]
    count, size = len(positions), min(_ALIGNED_WINDOW, len(positions))
    rotations = np.empty((count, 3, 3))
    for start in range(0, count, size):
        first = max(min(start, count - size), 0)  # the last window is as long as the others
        window = slice(first, first + size)
        turn = _rotations(_windows(positions[window], size), _windows(predicted[window], size))[0]
        rotations[start : start + size] = turn @ Ts_pw_p[start : start + size, :3, :3]
    return se3.from_rotation_translation(rotations, positions)
