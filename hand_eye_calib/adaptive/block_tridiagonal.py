"""Symmetric matrices of 6 x 6 blocks on the diagonal and beside it, in LAPACK's band storage: everything linear in their size."""

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded, lapack

BLOCK = 6
_BANDS = 2 * BLOCK


def to_bands(diagonal, below):
    """Lower bands (12, 6 n) of a matrix with blocks ``diagonal`` (n, 6, 6) and, left of each but the first, ``below`` (n - 1, 6, 6)."""
    n_blocks = len(diagonal)
    bands = np.zeros((_BANDS, n_blocks, BLOCK))
    for column in range(BLOCK):
        bands[: BLOCK - column, :, column] = diagonal[:, column:, column].T
        bands[BLOCK - column : _BANDS - column, :-1, column] = below[:, :, column].T
    return bands.reshape(_BANDS, n_blocks * BLOCK)


class Factor:
    """Cholesky factor L of a positive definite block tridiagonal matrix V.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where V is not positive definite.
    """

    def __init__(self, bands):
        self._bands = cholesky_banded(bands, lower=True, check_finite=False)

    def log_determinant(self):
        """log |V|."""
        return 2.0 * float(np.log(self._bands[0]).sum())

    def solve(self, right):
        """``V^-1 right`` for (6 n, k)."""
        return cho_solve_banded((self._bands, True), right, check_finite=False)

    def whiten(self, right):
        """``L^-1 right`` for (6 n, k): what is left of each row once the rows before it are known, in units of its sigma."""
        whitened, info = lapack.dtbtrs(self._bands, right, uplo="L")
        if info != 0:
            raise np.linalg.LinAlgError(f"singular factor at row {info}")
        return whitened
