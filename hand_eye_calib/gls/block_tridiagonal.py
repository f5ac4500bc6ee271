"""Symmetric positive definite matrices of d x d blocks on the diagonal and beside it: time and
memory linear in their size.

Cyclic reduction (Golub; Heller, SIAM J. Numer. Anal. 13, 1976): every other block is eliminated,
all of them at once, and what is left is block tridiagonal again, half as long. It is a Cholesky
factorisation in another order. Each level is a few products of stacked matrices, so that numpy's
overhead grows with the logarithm of the number of blocks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import FloatArray

# The blocks that are left when they have so few rows together are one dense matrix.
_DENSE = 64


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
    inverse: FloatArray = np.linalg.inv(lower)
    return inverse, np.asarray(2.0 * np.log(pivots).sum(axis=1))


@dataclass(frozen=True)
class _Level:
    """What eliminating every other block, the second first, needs: the inverse root of its own
    block, and that times its coupling to the block before and, if there is one, behind.
    """

    inverse: FloatArray
    before: FloatArray
    behind: FloatArray

    def whiten(self, right: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Whitened columns of the eliminated blocks, and the columns of the blocks that stay."""
        whitened, rest = self.inverse @ right[1::2], right[::2].copy()
        rest[: len(whitened)] -= transposed(self.before) @ whitened
        n_behind = len(self.behind)
        rest[1 : 1 + n_behind] -= transposed(self.behind) @ whitened[:n_behind]
        return whitened, rest

    def restore(self, whitened: FloatArray, rest: FloatArray) -> FloatArray:
        """Solution of all blocks from that of those that stay."""
        n_behind = len(self.behind)
        own = whitened - self.before @ rest[: len(whitened)]
        own[:n_behind] -= self.behind @ rest[1 : 1 + n_behind]
        solved = np.empty((len(whitened) + len(rest), *rest.shape[1:]))
        solved[::2] = rest
        np.matmul(transposed(self.inverse), own, out=solved[1::2])
        return solved

    def extend(self, diagonal: FloatArray, below: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Blocks of the inverse on the diagonal and below it from those of the blocks that stay."""
        n_own, n_behind = len(self.inverse), len(self.behind)
        root = transposed(self.inverse)
        to_before, to_behind = -root @ self.before, -root[:n_behind] @ self.behind
        with_before = to_before @ diagonal[:n_own]
        with_before[:n_behind] += to_behind @ below[:n_behind]
        with_behind = diagonal[1 : 1 + n_behind] @ transposed(to_behind)
        with_behind += below[:n_behind] @ transposed(to_before[:n_behind])
        own = transposed(self.inverse) @ self.inverse
        own += with_before @ transposed(to_before)
        own[:n_behind] += transposed(to_behind @ with_behind)
        all_diagonal = np.empty((len(diagonal) + n_own, *diagonal.shape[1:]))
        all_below = np.empty((len(all_diagonal) - 1, *diagonal.shape[1:]))
        all_diagonal[::2], all_diagonal[1::2] = diagonal, own
        all_below[::2], all_below[1::2] = with_before, with_behind
        return all_diagonal, all_below


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
        self._levels: list[_Level] = []
        self.log_determinant = 0.0
        while len(diagonal) > 1 and diagonal.shape[0] * diagonal.shape[1] > _DENSE:
            inverse, n_behind = self._inverse_root(diagonal[1::2]), (len(diagonal) - 1) // 2
            before = inverse @ below[::2]
            behind = inverse[:n_behind] @ transposed(below[1::2])
            self._levels.append(_Level(inverse, before, behind))
            diagonal = diagonal[::2].copy()
            diagonal[: len(before)] -= transposed(before) @ before
            diagonal[1 : 1 + n_behind] -= transposed(behind) @ behind
            below = -transposed(behind) @ before[:n_behind]
        self._n_last, self._size, _ = diagonal.shape
        whole, blocks = np.zeros((self._n_last, self._size) * 2), np.arange(self._n_last)
        whole[blocks, :, blocks] = diagonal
        whole[blocks[1:], :, blocks[:-1]] = below
        self._last = self._inverse_root(whole.reshape(1, self._n_last * self._size, -1))[0]

    def _inverse_root(self, blocks: FloatArray) -> FloatArray:
        inverse, log_determinants = inverse_roots(blocks)
        self.log_determinant += float(log_determinants.sum())
        return inverse

    def whiten(self, right: FloatArray) -> FloatArray:
        """``L^-1`` times columns (n, d, k), in the order of the elimination."""
        whitened, start = np.empty(right.shape), 0
        for level in self._levels:
            part = slice(start, start + len(level.inverse))
            whitened[part], right = level.whiten(right)
            start = part.stop
        last = right.reshape(len(self._last), -1)
        whitened[start:] = (self._last @ last).reshape(right.shape)
        return whitened

    def restore(self, whitened: FloatArray) -> FloatArray:
        """``L^-T`` times columns of :meth:`whiten`, or combinations of them."""
        start = len(whitened) - self._n_last
        last = whitened[start:].reshape(len(self._last), -1)
        solved = (self._last.T @ last).reshape(whitened[start:].shape)
        for level in reversed(self._levels):
            part = slice(start - len(level.inverse), start)
            solved = level.restore(whitened[part], solved)
            start = part.start
        return solved

    def selected_inverse(self) -> tuple[FloatArray, FloatArray]:
        """Blocks of the inverse on the diagonal (n, d, d) and below it (n - 1, d, d)."""
        shape = (self._n_last, self._size) * 2
        whole = (self._last.T @ self._last).reshape(shape).transpose(0, 2, 1, 3)
        blocks = np.arange(self._n_last)
        diagonal, below = whole[blocks, blocks], whole[blocks[1:], blocks[:-1]]
        for level in reversed(self._levels):
            diagonal, below = level.extend(diagonal, below)
        return diagonal, below
