"""Normal equations, and Cholesky factorisation of block tridiagonal matrices.

A symmetric positive definite matrix with blocks D_k on the diagonal and C_k below it is factorised
by cyclic reduction (Golub; Heller, SIAM J. Numer. Anal. 13, 1976). A level eliminates every other
block, from the second on:

    D_k = L_k L_k',    before_k = L_k^-1 C_{k-1},    behind_k = L_k^-1 C_k'
    D_{k-1} -= before_k' before_k,    D_{k+1} -= behind_k' behind_k,    C = -behind_k' before_k

The rest is block tridiagonal again, and half as long. The result is a Cholesky factorisation of the
matrix with its rows and columns in another order. Time and memory are linear in the number of
blocks. Each level is a few products of stacked matrices, so numpy's overhead grows with the
logarithm of the number of blocks only.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray

# Number of rows up to which the remaining blocks become one dense matrix. It is also the number of
# triangular matrices from which on a row-wise inversion takes half the time of LAPACK.
_FEW = 64

# Smallest eigenvalue that counts as information, of normal equations with ones on the diagonal.
# Smaller ones are rounding.
_SMALLEST_INFORMATION = 1e-12


def transposed(blocks: FloatArray) -> FloatArray:
    """Return the transposes (..., k, d) of matrices (..., d, k)."""
    return blocks.swapaxes(-1, -2)


def multiplied(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the products (k, l) of columns (n, d, k) with columns (n, d, l)."""
    return first.reshape(-1, first.shape[2]).T @ second.reshape(-1, second.shape[2])


def inverse_roots(matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Invert the lower Cholesky factors of positive definite matrices (n, d, d).

    Returns
    -------
    (n, d, d) array
        Inverse factors.
    (n,) array
        Logarithms of the determinants of the matrices.

    Raises
    ------
    numpy.linalg.LinAlgError
        If a matrix is not positive definite.
    """
    lower = np.linalg.cholesky(matrices)
    pivots = np.diagonal(lower, axis1=1, axis2=2)
    log_determinants = np.asarray(2.0 * np.log(pivots).sum(axis=1))
    if len(lower) < _FEW:
        return np.linalg.inv(lower), log_determinants
    inverse = np.zeros_like(lower)
    for row in range(lower.shape[1]):
        inverse[:, row, row] = 1.0
        inverse[:, row, :row] = -(lower[:, row, None, :row] @ inverse[:, :row, :row])[:, 0]
        inverse[:, row] /= pivots[:, row, None]
    return inverse, log_determinants


class _Level(NamedTuple):
    """Blocks of L of the poses that one level eliminates.

    The block ``inverse`` is L_k^-1. The last eliminated block may have none behind it.
    """

    inverse: FloatArray
    before: FloatArray
    behind: FloatArray


class Factor:
    """Cholesky factor L of a positive definite matrix with permuted rows and columns.

    Parameters
    ----------
    diagonal : (n, d, d) array
        Blocks on the diagonal.
    below : (n - 1, d, d) array
        Blocks below the diagonal: block k is in row k + 1 and column k.

    Attributes
    ----------
    log_determinant : float
        Of the matrix.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is not positive definite.
    """

    def __init__(self, diagonal: FloatArray, below: FloatArray) -> None:
        self._levels: list[_Level] = []
        self.log_determinant = 0.0
        while len(diagonal) > 1 and diagonal.shape[0] * diagonal.shape[1] > _FEW:
            inverse, log_determinants = inverse_roots(diagonal[1::2])
            n_behind = (len(diagonal) - 1) // 2
            before = inverse @ below[::2]
            behind = inverse[:n_behind] @ transposed(below[1::2])
            self._levels.append(_Level(inverse, before, behind))
            self.log_determinant += float(log_determinants.sum())
            diagonal = diagonal[::2].copy()
            diagonal[: len(before)] -= transposed(before) @ before
            diagonal[1 : 1 + n_behind] -= transposed(behind) @ behind
            below = -transposed(behind) @ before[:n_behind]
        self._n_last, self._size, _ = diagonal.shape
        dense = np.zeros((self._n_last, self._size) * 2)
        blocks = np.arange(self._n_last)
        dense[blocks, :, blocks] = diagonal
        dense[blocks[1:], :, blocks[:-1]] = below
        roots, log_determinants = inverse_roots(dense.reshape(1, self._n_last * self._size, -1))
        self.log_determinant += float(log_determinants.sum())
        self._last = roots[0]

    def whiten(self, right: FloatArray) -> FloatArray:
        """Return ``L^-1`` times columns (n, d, k), in the order of the elimination."""
        whitened = np.empty(right.shape)
        start = 0
        for inverse, before, behind in self._levels:
            eliminated = inverse @ right[1::2]
            right = right[::2].copy()
            right[: len(eliminated)] -= transposed(before) @ eliminated
            right[1 : 1 + len(behind)] -= transposed(behind) @ eliminated[: len(behind)]
            whitened[start : start + len(eliminated)] = eliminated
            start += len(eliminated)
        last = right.reshape(len(self._last), -1)
        whitened[start:] = (self._last @ last).reshape(right.shape)
        return whitened

    def restore(self, whitened: FloatArray) -> FloatArray:
        """Return ``L^-T`` times columns (n, d, k) that :meth:`whiten` returned."""
        start = len(whitened) - self._n_last
        last = whitened[start:].reshape(len(self._last), -1)
        solved = (self._last.T @ last).reshape(whitened[start:].shape)
        for inverse, before, behind in reversed(self._levels):
            neighbours = solved
            end = start
            start -= len(inverse)
            eliminated = whitened[start:end] - before @ neighbours[: len(inverse)]
            eliminated[: len(behind)] -= behind @ neighbours[1 : 1 + len(behind)]
            solved = np.empty((len(inverse) + len(neighbours), *neighbours.shape[1:]))
            solved[::2] = neighbours
            np.matmul(transposed(inverse), eliminated, out=solved[1::2])
        return solved

    @cached_property
    def selected_inverse(self) -> tuple[FloatArray, FloatArray]:
        """Blocks of the inverse on the diagonal (n, d, d) and below it (n - 1, d, d)."""
        shape = (self._n_last, self._size) * 2
        dense = (self._last.T @ self._last).reshape(shape).transpose(0, 2, 1, 3)
        blocks = np.arange(self._n_last)
        diagonal = dense[blocks, blocks]
        below = dense[blocks[1:], blocks[:-1]]
        for inverse, before, behind in reversed(self._levels):
            n_eliminated = len(inverse)
            n_behind = len(behind)
            root = transposed(inverse)
            # An eliminated block is these matrices times its neighbours, plus noise of its own.
            to_before = -root @ before
            to_behind = -root[:n_behind] @ behind
            with_before = to_before @ diagonal[:n_eliminated]
            with_before[:n_behind] += to_behind @ below[:n_behind]
            with_behind = diagonal[1 : 1 + n_behind] @ transposed(to_behind)
            with_behind += below[:n_behind] @ transposed(to_before[:n_behind])
            eliminated = root @ inverse
            eliminated += with_before @ transposed(to_before)
            eliminated[:n_behind] += transposed(to_behind @ with_behind)
            neighbours = diagonal
            diagonal = np.empty((len(neighbours) + n_eliminated, *neighbours.shape[1:]))
            below = np.empty((len(diagonal) - 1, *neighbours.shape[1:]))
            diagonal[::2] = neighbours
            diagonal[1::2] = eliminated
            below[::2] = with_before
            below[1::2] = with_behind
        return diagonal, below


class NormalEquations:
    """Generalised least squares of one system or of several.

    Parameters
    ----------
    products : (..., p + 1, p + 1) array
        ``[J e]' V^-1 [J e]`` of derivatives J and residuals e.

    Attributes
    ----------
    step : (..., p) array
        Change of the parameters; zero along directions without information.
    covariance : (..., p, p) array
        Zero along the same directions.
    root : (..., p, p) array
        R with covariance R R'.
    is_complete : (...) bool array
        Whether all directions have information.
    cost : (...) array
        Weighted squared residual after the step.
    log_determinant : (...) array
        Of the information.
    """

    def __init__(self, products: FloatArray) -> None:
        information = products[..., :-1, :-1]
        gradient = products[..., :-1, -1]
        diagonal = np.einsum("...ii->...i", information)
        rounding = np.finfo(float).eps * diagonal.max(axis=-1, keepdims=True)
        scale = 1.0 / np.sqrt(np.maximum(diagonal, rounding + np.finfo(float).tiny))
        values, vectors = np.linalg.eigh(scale[..., :, None] * information * scale[..., None, :])
        self._is_observed = values > _SMALLEST_INFORMATION
        values = np.where(self._is_observed, values, 1.0)
        self._axes = scale[..., :, None] * vectors
        self.root = self._axes * (self._is_observed / np.sqrt(values))[..., None, :]
        self.covariance = self.root @ transposed(self.root)
        self.is_complete = self._is_observed.all(axis=-1)
        self.step = -(self.covariance @ gradient[..., None])[..., 0]
        self.cost = products[..., -1, -1] + (gradient * self.step).sum(axis=-1)
        self.log_determinant = np.log(values).sum(axis=-1) - 2.0 * np.log(scale).sum(axis=-1)

    @property
    def unseen(self) -> FloatArray:
        """Directions (p, U) without information, of unit length; only for one system."""
        axes = self._axes[:, ~self._is_observed]
        return np.asarray(axes / np.linalg.norm(axes, axis=0))
