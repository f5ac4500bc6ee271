"""Symmetric matrices of d x d blocks on the diagonal and beside it, in LAPACK's band storage: time
and memory linear in their size.

``bands[k, c, r]`` is the element r rows below the diagonal in column c of block k: an (n, d, 2 d)
array.
"""

from __future__ import annotations

import numpy as np

from hand_eye_calib.adaptive import lapack
from hand_eye_calib.arrays import FloatArray


def empty_bands(n_blocks: int, size: int) -> FloatArray:
    """Bands (n, d, 2 d) of a matrix of zeros."""
    return np.zeros((n_blocks, size, 2 * size))


def add_diagonal(bands: FloatArray, blocks: FloatArray) -> None:
    """Add symmetric blocks (n, k, k), k <= d, to the upper left of the diagonal blocks."""
    size = blocks.shape[-1]
    for column in range(size):
        bands[:, column, : size - column] += blocks[..., column:, column]


def set_below(bands: FloatArray, blocks: FloatArray) -> None:
    """Set the blocks (n, d, d) below the diagonal ones; the last row of bands has none."""
    size = bands.shape[1]
    for column in range(size):
        bands[:, column, size - column : 2 * size - column] = blocks[:, :, column]


class Factor:
    """Cholesky factor L of a positive definite matrix, whose bands (n, d, 2 d) it overwrites.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is not positive definite.
    """

    def __init__(self, bands: FloatArray) -> None:
        self._n_blocks, self._size, _ = bands.shape
        self._bands, info = lapack.dpbtrf(
            bands.reshape(-1, 2 * self._size).T, lower=1, overwrite_ab=1
        )
        if info != 0:
            raise np.linalg.LinAlgError(f"not positive definite at row {info}")

    def log_determinant(self) -> float:
        """Logarithm of the matrix's determinant."""
        return 2.0 * float(np.log(self._bands[0]).sum())

    def solve(self, right: FloatArray) -> FloatArray:
        """Inverse of the matrix times columns (n, d, k)."""
        solved, _ = lapack.dpbtrs(self._bands, self._as_columns(right), lower=1, overwrite_b=1)
        return solved.reshape(right.shape)

    def whiten(self, right: FloatArray) -> FloatArray:
        """``L^-1`` times columns (n, d, k)."""
        solved, _ = lapack.dtbtrs(self._bands, self._as_columns(right), uplo="L", overwrite_b=1)
        return solved.reshape(right.shape)

    def _as_columns(self, right: FloatArray) -> FloatArray:
        return np.asfortranarray(right.reshape(self._n_blocks * self._size, -1))

    def below(self, block: int) -> FloatArray:
        """Block (d, d) of L below its diagonal block of this number."""
        size, rows = self._size, self._blocks()[block]
        return np.stack([rows[c, size - c : 2 * size - c] for c in range(size)], axis=1)

    def _blocks(self) -> FloatArray:
        return self._bands.T.reshape(self._n_blocks, self._size, 2 * self._size)

    def selected_inverse(self) -> tuple[FloatArray, FloatArray]:
        """Blocks of the inverse on the diagonal (n, d, d) and below it (n - 1, d, d).

        With ``G_i = L_ii^-T L_{i+1,i}'`` they are ``S_ii = L_ii^-T L_ii^-1 + G_i S_{i+1,i+1} G_i'``
        and ``S_{i+1,i} = -S_{i+1,i+1} G_i'`` (Takahashi, Fagan, Chen, 1973).
        """
        inverse = self._inverse_of_diagonal_blocks()
        upright = np.ascontiguousarray(inverse.transpose(0, 2, 1))
        diagonal = upright @ inverse
        gains = upright[:-1] @ self._all_below().transpose(0, 2, 1)
        gains_transposed = np.ascontiguousarray(gains.transpose(0, 2, 1))
        below = np.empty_like(gains)
        for i in range(self._n_blocks - 2, -1, -1):
            below[i] = diagonal[i + 1] @ gains_transposed[i]
            diagonal[i] += gains[i] @ below[i]
        np.negative(below, out=below)
        return diagonal, below

    def _all_below(self) -> FloatArray:
        size, blocks = self._size, self._blocks()
        below = np.empty((self._n_blocks - 1, size, size))
        for column in range(size):
            below[:, :, column] = blocks[:-1, column, size - column : 2 * size - column]
        return below

    def _inverse_of_diagonal_blocks(self) -> FloatArray:
        """``L_ii^-1`` (n, d, d), by one solve with the diagonal blocks alone."""
        n, size, blocks = self._n_blocks, self._size, self._blocks()
        alone = np.zeros((n, size, size))
        for column in range(size):
            alone[:, column, : size - column] = blocks[:, column, : size - column]
        identity = np.asfortranarray(np.tile(np.eye(size), (n, 1)))
        inverse, _ = lapack.dtbtrs(
            alone.reshape(n * size, size).T, identity, uplo="L", overwrite_b=1
        )
        return inverse.reshape(n, size, size)
