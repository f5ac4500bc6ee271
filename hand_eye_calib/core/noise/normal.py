"""Normal equations, and Cholesky factorisation of block tridiagonal matrices.

The factorisation takes time and memory linear in the number of blocks, by cyclic reduction (Golub;
Heller, SIAM J. Numer. Anal. 13, 1976). Each level eliminates every other block, all of them at
once; the rest is block tridiagonal again, half as long. This is a Cholesky factorisation in another
order. Each level is a few products of stacked matrices, so that numpy's overhead grows with the
logarithm of the number of blocks.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray

# Number of rows up to which the remaining blocks become one dense matrix; and number of triangular
# matrices from which on a row-wise inversion of the whole stack takes half the time of LAPACK.
_FEW = 64

# Least share of what a parameter's own diagonal promises that counts as information: rounding.
_LEAST_INFORMATION_SHARE = 1e-12


def transposed(blocks: FloatArray) -> FloatArray:
    """The transposes (..., k, d) of matrices (..., d, k)."""
    return blocks.swapaxes(-1, -2)


def inverse_roots(matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverses (n, d, d) of the lower Cholesky factors of positive definite matrices (n, d, d), and
    the logarithms (n,) of the matrices' determinants.

    Raises
    ------
    numpy.linalg.LinAlgError
        If a matrix is not positive definite.
    """
    lower = np.linalg.cholesky(matrices)
    pivots = np.diagonal(lower, axis1=1, axis2=2)
    if len(lower) < _FEW:
        inverse: FloatArray = np.linalg.inv(lower)
    else:
        inverse = np.zeros_like(lower)
        for row in range(lower.shape[1]):
            inverse[:, row, row] = 1.0
            inverse[:, row, :row] = -(lower[:, row, None, :row] @ inverse[:, :row, :row])[:, 0]
            inverse[:, row] /= pivots[:, row, None]
    return inverse, np.asarray(2.0 * np.log(pivots).sum(axis=1))


class Factor:
    """Cholesky factor L of a positive definite matrix with permuted rows and columns;
    ``log_determinant`` is that of the matrix.

    Parameters
    ----------
    diagonal : (n, d, d) array
    below : (n - 1, d, d) array
        Block k stands in row k + 1 and column k.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is not positive definite.
    """

    def __init__(self, diagonal: FloatArray, below: FloatArray) -> None:
        # Each level eliminates every other block, from the second on. It stores the inverse root of
        # each eliminated block, and that root times the couplings to the blocks before and behind;
        # the last block may have none behind.
        self._levels: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        self.log_determinant = 0.0
        while len(diagonal) > 1 and diagonal.shape[0] * diagonal.shape[1] > _FEW:
            inverse, logarithms = inverse_roots(diagonal[1::2])
            n_behind = (len(diagonal) - 1) // 2
            before = inverse @ below[::2]
            behind = inverse[:n_behind] @ transposed(below[1::2])
            self._levels.append((inverse, before, behind))
            self.log_determinant += float(logarithms.sum())
            diagonal = diagonal[::2].copy()
            diagonal[: len(before)] -= transposed(before) @ before
            diagonal[1 : 1 + n_behind] -= transposed(behind) @ behind
            below = -transposed(behind) @ before[:n_behind]
        self._n_last, self._size, _ = diagonal.shape
        whole = np.zeros((self._n_last, self._size) * 2)
        blocks = np.arange(self._n_last)
        whole[blocks, :, blocks] = diagonal
        whole[blocks[1:], :, blocks[:-1]] = below
        roots, logarithms = inverse_roots(whole.reshape(1, self._n_last * self._size, -1))
        self.log_determinant += float(logarithms.sum())
        self._last = roots[0]

    def whiten(self, right: FloatArray) -> FloatArray:
        """``L^-1`` times columns (n, d, k), in the order of the elimination."""
        whitened = np.empty(right.shape)
        start = 0
        for inverse, before, behind in self._levels:
            own = inverse @ right[1::2]
            right = right[::2].copy()
            right[: len(own)] -= transposed(before) @ own
            right[1 : 1 + len(behind)] -= transposed(behind) @ own[: len(behind)]
            whitened[start : start + len(own)] = own
            start += len(own)
        last = right.reshape(len(self._last), -1)
        whitened[start:] = (self._last @ last).reshape(right.shape)
        return whitened

    def restore(self, whitened: FloatArray) -> FloatArray:
        """``L^-T`` times columns of :meth:`whiten`, or combinations of them."""
        start = len(whitened) - self._n_last
        last = whitened[start:].reshape(len(self._last), -1)
        solved = (self._last.T @ last).reshape(whitened[start:].shape)
        for inverse, before, behind in reversed(self._levels):
            rest = solved
            end = start
            start -= len(inverse)
            own = whitened[start:end] - before @ rest[: len(inverse)]
            own[: len(behind)] -= behind @ rest[1 : 1 + len(behind)]
            solved = np.empty((len(inverse) + len(rest), *rest.shape[1:]))
            solved[::2] = rest
            np.matmul(transposed(inverse), own, out=solved[1::2])
        return solved

    @cached_property
    def selected_inverse(self) -> tuple[FloatArray, FloatArray]:
        """Blocks of the inverse on the diagonal (n, d, d) and below it (n - 1, d, d)."""
        shape = (self._n_last, self._size) * 2
        whole = (self._last.T @ self._last).reshape(shape).transpose(0, 2, 1, 3)
        blocks = np.arange(self._n_last)
        diagonal = whole[blocks, blocks]
        below = whole[blocks[1:], blocks[:-1]]
        for inverse, before, behind in reversed(self._levels):
            n_own = len(inverse)
            n_behind = len(behind)
            root = transposed(inverse)
            to_before = -root @ before
            to_behind = -root[:n_behind] @ behind
            with_before = to_before @ diagonal[:n_own]
            with_before[:n_behind] += to_behind @ below[:n_behind]
            with_behind = diagonal[1 : 1 + n_behind] @ transposed(to_behind)
            with_behind += below[:n_behind] @ transposed(to_before[:n_behind])
            own = root @ inverse
            own += with_before @ transposed(to_before)
            own[:n_behind] += transposed(to_behind @ with_behind)
            rest = diagonal
            diagonal = np.empty((len(rest) + n_own, *rest.shape[1:]))
            below = np.empty((len(diagonal) - 1, *rest.shape[1:]))
            diagonal[::2] = rest
            diagonal[1::2] = own
            below[::2] = with_before
            below[1::2] = with_behind
        return diagonal, below


class NormalEquations:
    """Generalised least squares from products (..., p + 1, p + 1) of derivatives and, last,
    residuals: of one system, or of several at once.

    Attributes
    ----------
    step : (..., p) array
        Change of the parameters; zero along directions without any evidence.
    covariance, root : (..., p, p) arrays
        Zero along these directions, too; root R with covariance R R'.
    is_complete : (...) bool array
        Whether there are none.
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
        self._seen = values > _LEAST_INFORMATION_SHARE
        values = np.where(self._seen, values, 1.0)
        self._axes = scale[..., :, None] * vectors
        self.root = self._axes * (self._seen / np.sqrt(values))[..., None, :]
        self.covariance = self.root @ transposed(self.root)
        self.is_complete = self._seen.all(axis=-1)
        self.step = -(self.covariance @ gradient[..., None])[..., 0]
        self.cost = products[..., -1, -1] + (gradient * self.step).sum(axis=-1)
        self.log_determinant = np.log(values).sum(axis=-1) - 2.0 * np.log(scale).sum(axis=-1)

    @property
    def unseen(self) -> FloatArray:
        """(p, U) array: the directions without evidence of one system, of unit length."""
        axes = self._axes[:, ~self._seen]
        return np.asarray(axes / np.linalg.norm(axes, axis=0))


def multiplied(first: FloatArray, second: FloatArray) -> FloatArray:
    """Products (k, l) of columns (n, d, k) with columns (n, d, l)."""
    return first.reshape(-1, first.shape[2]).T @ second.reshape(-1, second.shape[2])
