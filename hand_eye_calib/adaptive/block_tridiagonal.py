"""Symmetric matrices of 6 x 6 blocks on the diagonal and beside it, in LAPACK's band storage:
everything linear in their size.

``bands[k, c, d]`` is what stands d rows below the diagonal in column c of block k: an (n, 6, 12)
array.
"""

import numpy as np

from hand_eye_calib.adaptive import lapack

BLOCK = 6


def to_bands(diagonal, below):
    """Bands (n, 6, 12) of a matrix with blocks ``diagonal`` (n, 6, 6) and, left of each but the
    first, ``below`` (n - 1, 6, 6).
    """
    bands = np.zeros((len(diagonal), BLOCK, 2 * BLOCK))
    for column in range(BLOCK):
        bands[:, column, : BLOCK - column] = diagonal[:, column:, column]
        bands[:-1, column, BLOCK - column : 2 * BLOCK - column] = below[:, :, column]
    return bands


def diagonal_blocks(bands):
    """The blocks (n, 6, 6) on the diagonal."""
    blocks = np.empty((len(bands), BLOCK, BLOCK))
    for column in range(BLOCK):
        blocks[:, column:, column] = blocks[:, column, column:] = bands[:, column, : BLOCK - column]
    return blocks


def blocks_below(bands):
    """The blocks (n - 1, 6, 6) below those on the diagonal."""
    return np.stack(
        [bands[:-1, column, BLOCK - column : 2 * BLOCK - column] for column in range(BLOCK)], axis=2
    )


def cut_below(bands, at):
    """Take away, in place, what joins each of the blocks ``at`` with the next one."""
    for column in range(BLOCK):
        bands[at, column, BLOCK - column :] = 0.0


class Factor:
    """Cholesky factor L of a positive definite block tridiagonal matrix V, whose bands it
    overwrites.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where V is not positive definite.
    """

    def __init__(self, bands):
        self._bands, info = lapack.dpbtrf(bands.reshape(-1, 2 * BLOCK).T, lower=1, overwrite_ab=1)
        if info != 0:
            raise np.linalg.LinAlgError(f"not positive definite at row {info}")

    def log_determinant(self):
        """log |V|."""
        return 2.0 * float(np.log(self._bands[0]).sum())

    def whiten(self, right):
        """``L^-1 right`` for (6 n, k): what is left of each row once the rows before it are known,
        in units of its sigma.
        """
        whitened, info = lapack.dtbtrs(self._bands, right, uplo="L")
        if info != 0:
            raise np.linalg.LinAlgError(f"singular factor at row {info}")
        return whitened
