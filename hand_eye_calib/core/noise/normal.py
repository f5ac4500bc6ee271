"""Normal equations, and Cholesky factorisation of block tridiagonal matrices.

A symmetric positive definite matrix has blocks D_k on its diagonal; the block E_k is in row k + 1
and column k. Cyclic reduction (Golub; Heller, SIAM J. Numer. Anal. 13, 1976) factorises the matrix
in rounds. A round eliminates every second row of blocks, k = 1, 3, 5, ...:

    D_k = L_k L_k',    before_k = L_k^-1 E_{k-1},    after_k = L_k^-1 E_k'
    D_{k-1} -= before_k' before_k,    D_{k+1} -= after_k' after_k
    new block of row k + 1 and column k - 1: -after_k' before_k

The remaining matrix is block tridiagonal again, and half as long. The result is a Cholesky
factorisation of the matrix with its rows and columns in another order. Time and memory are linear
in the number of blocks. A round is a few products of stacked matrices, so that the overhead of
numpy grows only with the logarithm of the number of blocks.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.solvers.all_pairs import RANK_TOLERANCE

# Cyclic reduction ends if at most this number of rows remains; they form one dense matrix. From
# this number of triangular matrices on, one joint inversion takes a quarter of the time of LAPACK.
_FEW = 64

# Number of triangular matrices that are inverted together. They fit into the cache.
_CACHED = 500


def transposed(blocks: FloatArray) -> FloatArray:
    """Return the transposes (..., k, d) of matrices (..., d, k)."""
    return blocks.swapaxes(-1, -2)


def gram(blocks: FloatArray) -> FloatArray:
    """Return the products ``B' B`` (n, k, k) of blocks B (n, d, k).

    numpy has a special routine for the product of an array with its own transpose, which is three
    times slower for small matrices. A copy of one factor avoids it.
    """
    return transposed(blocks) @ blocks.copy()


def multiplied(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the products (k, l) of columns (n, d, k) and (n, d, l), summed over n and d."""
    return first.reshape(-1, first.shape[2]).T @ second.reshape(
        -1, second.shape[2]
    )


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
    inverse = np.empty(lower.shape)
    for start in range(0, len(lower), _CACHED):
        part = slice(start, start + _CACHED)
        inverse[part] = _triangular_inverses(lower[part])
    return inverse, log_determinants


def _triangular_inverses(lower: NDArray[np.floating]) -> FloatArray:
    """Return the inverses of lower triangular matrices (n, d, d) by forward substitution.

    All matrices are eliminated together. Their index is the last one in memory.
    """
    rows = np.ascontiguousarray(lower.transpose(1, 2, 0))
    inverse = np.zeros_like(rows)
    for row in range(len(rows)):
        until_row = slice(row + 1)
        inverse[row, row] = 1.0
        inverse[row, until_row] /= rows[row, row]
        inverse[row + 1 :, until_row] -= (
            rows[row + 1 :, row, None] * inverse[row, until_row]
        )
    return inverse.transpose(2, 0, 1)


class _Round(NamedTuple):
    """Blocks of the Cholesky factor that one round of cyclic reduction eliminates.

    ``inverse`` (m, d, d) is L_k^-1. ``before`` (m, d, d) and ``after`` (m or m - 1, d, d) couple
    block k to its neighbours. The last eliminated block may have no neighbour after it.
    """

    inverse: FloatArray
    before: FloatArray
    after: FloatArray


class Factor:
    """Cholesky factor L of a block tridiagonal matrix with permuted rows and columns.

    Parameters
    ----------
    diagonal : (n, d, d) array
        Blocks on the diagonal.
    below : (n - 1, d, d) array
        Blocks below the diagonal: block k is in row k + 1 and column k.

    Attributes
    ----------
    log_determinant : float
        Log determinant of the matrix.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is not positive definite.
    """

    def __init__(self, diagonal: FloatArray, below: FloatArray) -> None:
        self._rounds: list[_Round] = []
        self.log_determinant = 0.0
        while (
            len(diagonal) > 1 and diagonal.shape[0] * diagonal.shape[1] > _FEW
        ):
            inverse, log_determinants = inverse_roots(diagonal[1::2])
            n_after = (len(diagonal) - 1) // 2
            before = inverse @ below[::2]
            after = inverse[:n_after] @ transposed(below[1::2])
            self._rounds.append(_Round(inverse, before, after))
            self.log_determinant += float(log_determinants.sum())
            diagonal = diagonal[::2].copy()
            diagonal[: len(before)] -= gram(before)
            diagonal[1 : 1 + n_after] -= gram(after)
            below = -transposed(after) @ before[:n_after]
        # The remaining blocks become one dense matrix.
        self._n_last, self._size, _ = diagonal.shape
        dense = np.zeros((self._n_last, self._size) * 2)
        blocks = np.arange(self._n_last)
        dense[blocks, :, blocks] = diagonal
        dense[blocks[1:], :, blocks[:-1]] = below
        roots, log_determinants = inverse_roots(
            dense.reshape(1, self._n_last * self._size, -1)
        )
        self.log_determinant += float(log_determinants.sum())
        self._last = roots[0]

    def whiten(self, right: FloatArray) -> FloatArray:
        """Return ``L^-1`` times columns (n, d, k), with the blocks in order of elimination."""
        whitened = np.empty(right.shape)
        start = 0
        for inverse, before, after in self._rounds:
            eliminated = inverse @ right[1::2]
            right = right[::2].copy()
            right[: len(eliminated)] -= transposed(before) @ eliminated
            right[1 : 1 + len(after)] -= (
                transposed(after) @ eliminated[: len(after)]
            )
            whitened[start : start + len(eliminated)] = eliminated
            start += len(eliminated)
        last = right.reshape(len(self._last), -1)
        whitened[start:] = (self._last @ last).reshape(right.shape)
        return whitened

    def restore(self, whitened: FloatArray) -> FloatArray:
        """Return ``L^-T`` times columns (n, d, k) that :meth:`whiten` returned.

        The blocks of the result are in the order of the matrix, so ``restore(whiten(Z))`` is the
        inverse of the matrix times Z.
        """
        start = len(whitened) - self._n_last
        last = whitened[start:].reshape(len(self._last), -1)
        solved = (self._last.T @ last).reshape(whitened[start:].shape)
        for inverse, before, after in reversed(self._rounds):
            neighbours = solved
            end = start
            start -= len(inverse)
            eliminated = (
                whitened[start:end] - before @ neighbours[: len(inverse)]
            )
            eliminated[: len(after)] -= after @ neighbours[1 : 1 + len(after)]
            solved = np.empty(
                (len(inverse) + len(neighbours), *neighbours.shape[1:])
            )
            solved[::2] = neighbours
            np.matmul(transposed(inverse), eliminated, out=solved[1::2])
        return solved

    @cached_property
    def selected_inverse(self) -> tuple[FloatArray, FloatArray]:
        """Blocks of the inverse matrix on the diagonal (n, d, d) and below it (n - 1, d, d)."""
        shape = (self._n_last, self._size) * 2
        dense = (self._last.T @ self._last).reshape(shape).transpose(0, 2, 1, 3)
        blocks = np.arange(self._n_last)
        diagonal = dense[blocks, blocks]
        below = dense[blocks[1:], blocks[:-1]]
        for inverse, before, after in reversed(self._rounds):
            n_eliminated = len(inverse)
            n_after = len(after)
            root = transposed(inverse)
            # If the inverse is a covariance, an eliminated state is the sum of these matrices times
            # its neighbours and independent noise of covariance root root'.
            to_before = -root @ before
            to_after = -root[:n_after] @ after
            with_before = to_before @ diagonal[:n_eliminated]
            with_before[:n_after] += to_after @ below[:n_after]
            with_after = diagonal[1 : 1 + n_after] @ transposed(to_after)
            with_after += below[:n_after] @ transposed(to_before[:n_after])
            eliminated = gram(inverse)
            eliminated += with_before @ transposed(to_before)
            eliminated[:n_after] += transposed(to_after @ with_after)
            neighbours = diagonal
            diagonal = np.empty(
                (len(neighbours) + n_eliminated, *neighbours.shape[1:])
            )
            below = np.empty((len(diagonal) - 1, *neighbours.shape[1:]))
            diagonal[::2] = neighbours
            diagonal[1::2] = eliminated
            below[::2] = with_before
            below[1::2] = with_after
        return diagonal, below


def prior_products(
    values: FloatArray, sigmas: FloatArray, size: int
) -> FloatArray:
    """Return a prior with mean zero as products, to be added to ``[J e]' V^-1 [J e]``.

    Parameters
    ----------
    values : (k,) array
        Current values of the last k parameters. The other parameters have no prior.
    sigmas : (k,) array
        Prior standard deviations of the last k parameters.
    size : int
        Number of rows of the products: the number of all parameters, plus 1 for the residuals.

    Returns
    -------
    (size, size) array
    """
    products = np.zeros((size, size))
    indices = np.arange(size - 1 - len(values), size - 1)
    weights = sigmas**-2.0
    products[indices, indices] = weights
    products[indices, -1] = weights * values
    products[-1, indices] = weights * values
    products[-1, -1] = weights @ values**2
    return products


class NormalEquations:
    """Generalised least squares solution of one system, or of a stack of systems.

    Parameters
    ----------
    products : (..., p + 1, p + 1) array
        ``[J e]' V^-1 [J e]`` of derivatives J, residuals e and their covariance V.

    Attributes
    ----------
    step : (..., p) array
        Change of the parameters that minimises the cost; zero along directions without information.
    covariance : (..., p, p) array
        Covariance of the parameters; zero along directions without information.
    root : (..., p, p) array
        Matrix R with ``R R' = covariance``.
    is_complete : (...) bool array
        Whether all directions have information.
    cost : (...) array
        Weighted squared residual after the step.
    log_determinant : (...) array
        Logarithm of the product of all nonzero eigenvalues of the information ``J' V^-1 J``.
    """

    def __init__(self, products: FloatArray) -> None:
        information = products[..., :-1, :-1]
        gradient = products[..., :-1, -1]
        diagonal = np.einsum("...ii->...i", information)
        # Scale the information to ones on the diagonal, because parameters have different units. A
        # parameter whose information is rounding counts as unobserved; its scale is arbitrary.
        largest = diagonal.max(axis=-1, keepdims=True)
        has_information = diagonal > np.finfo(float).eps * largest
        any_square = np.where(largest > 0.0, largest, 1.0)
        scale = 1.0 / np.sqrt(np.where(has_information, diagonal, any_square))
        both_have = (
            has_information[..., :, None] & has_information[..., None, :]
        )
        kept = np.where(both_have, information, 0.0)
        scaled = scale[..., :, None] * kept * scale[..., None, :]
        values, vectors = np.linalg.eigh(scaled)
        # The diagonal is 1, so a smaller eigenvalue is rounding. Replace such eigenvalues by 1:
        # they add log 1 = 0 to the log determinant, and the mask excludes them from the root.
        self._is_observed = values > RANK_TOLERANCE
        values = np.where(self._is_observed, values, 1.0)
        self._axes = scale[..., :, None] * vectors
        inverse_roots = self._is_observed / np.sqrt(values)
        self.root = self._axes * inverse_roots[..., None, :]
        self.covariance = self.root @ transposed(self.root)
        self.is_complete = self._is_observed.all(axis=-1)
        self.step = -(self.covariance @ gradient[..., None])[..., 0]
        self.cost = products[..., -1, -1] + (gradient * self.step).sum(axis=-1)
        log_scales = 2.0 * np.log(scale).sum(axis=-1)
        self.log_determinant = np.log(values).sum(axis=-1) - log_scales
        self.log_determinant += self._log_unseen_scale()

    def _log_unseen_scale(self) -> FloatArray:
        """Return (...) log det(N' N), the effect of the scale on directions without information.

        The pseudo-determinant pdet is the product of all nonzero eigenvalues. It is computed for
        the scaled information S I S, with the diagonal matrix S of the scales, and needed for I.
        Let Q be an orthonormal basis of the null space of S I S. Then the columns of N = S Q are a
        basis of the null space of I, and ``pdet(I) = pdet(S I S) det(N' N) / det(S)^2``. The last
        factors depend on the noise levels, because S makes the diagonal of S I S equal to 1.
        """
        is_unseen = ~self._is_observed
        both_unseen = is_unseen[..., :, None] & is_unseen[..., None, :]
        products = np.where(
            both_unseen,
            transposed(self._axes) @ self._axes,
            np.eye(is_unseen.shape[-1]),
        )
        return np.asarray(np.linalg.slogdet(products)[1])

    @property
    def unseen(self) -> FloatArray:
        """Unit vectors (p, U) along the U directions without information, for a single system."""
        axes = self._axes[:, ~self._is_observed]
        return axes / np.linalg.norm(axes, axis=0)
