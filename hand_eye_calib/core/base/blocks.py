"""Least squares from sums over blocks of time.

The p unknowns x minimise the squares of ``W^(1/2) (J x - y)``. The table of a block is its matrix
of products ``[J y]' W [J y]`` (p + 1, p + 1). The first p rows of a table are ``[H S]``: the
information ``J' W J`` and the score ``J' W y``. Tables of blocks add. So the solution for any set
of blocks (all, all but one, before or since a time) follows from the sum of their tables.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray

# Damping of directions without evidence, if the diagonal is scaled to 1; above rounding.
_DAMPING = 1e-10

# Smallest root of a diagonal element of an unknown with evidence.
_SMALLEST_ROOT = 1e-30


@dataclass(frozen=True)
class Blocks:
    """Sums (B, ...) of B blocks in order of time: tables, or other arrays that add over blocks.

    Examples
    --------
    >>> rows = np.array([[[1.0, 2.0]], [[1.0, 4.0]]])  # 1 x = 2, then 1 x = 4
    >>> Blocks.of_rows(rows, 2).solve([0]).tolist()
    [3.0]
    """

    sums: FloatArray

    @classmethod
    def of_rows(cls, rows: FloatArray, n_blocks: int, probes: FloatArray | None = None) -> "Blocks":
        """Make tables from weighted rows ``W^(1/2) [J y]`` (K, d, p + 1), in equally long blocks.

        ``probes`` (K, d, p + 1), if any, replace the left factor of the products. They are
        instrumental variables.
        """
        n_columns = rows.shape[-1]
        left_factors = np.array_split(rows if probes is None else probes, n_blocks)
        right_factors = np.array_split(rows, n_blocks)
        tables = []
        for left_rows, right_rows in zip(left_factors, right_factors, strict=True):
            tables.append(left_rows.reshape(-1, n_columns).T @ right_rows.reshape(-1, n_columns))
        return cls(np.stack(tables))

    @classmethod
    def gathered(cls, values: FloatArray, block_of: IntArray, n_blocks: int) -> "Blocks":
        """Sum values (K, ...) over blocks; ``block_of`` (K,) is the index of a value's block."""
        sums = np.zeros((n_blocks, *values.shape[1:]))
        np.add.at(sums, block_of, values)
        return cls(sums)

    def merged(self, n_blocks: int) -> "Blocks":
        """Merge neighbouring blocks, so that ``n_blocks`` remain."""
        starts = np.arange(n_blocks) * len(self.sums) // n_blocks
        return Blocks(np.add.reduceat(self.sums, starts))

    @property
    def total(self) -> FloatArray:
        """Sum (...) of all blocks."""
        return np.asarray(self.sums.sum(axis=0))

    def without(self) -> FloatArray:
        """Sums (B, ...) of all blocks except one, for each block."""
        return self.total - self.sums

    def before(self, cuts: IntArray) -> FloatArray:
        """Sums (C, ...) of the blocks before each cut (C,); a cut is at least 1."""
        return np.asarray(np.cumsum(self.sums, axis=0)[cuts - 1])

    def since(self, cuts: IntArray) -> FloatArray:
        """Sums (C, ...) of the blocks since each cut (C,); a cut is at most B - 1."""
        return np.asarray(np.cumsum(self.sums[::-1], axis=0)[::-1][cuts])

    def shift_since(self, cuts: IntArray, prior: FloatArray) -> FloatArray:
        """Evidence ``[H S]`` (C, p, p + 1) of a shift of the unknowns at each cut (C,).

        The unknowns before the cut are estimated from the blocks before it. ``prior`` (p, p) is
        added to their information.
        """
        before = self.before(cuts)
        covariances = inverse(information(before) + prior)
        estimates = (covariances @ score(before)[..., None])[..., 0]
        return shift_evidence(self.since(cuts), estimates, covariances)

    def solve(self, columns: Sequence[int]) -> FloatArray:
        """Solve all blocks for some unknowns (k,); the other unknowns are zero."""
        return solve(self.total, columns)

    def jackknife(self, columns: Sequence[int]) -> FloatArray:
        """Jackknife covariance (k, k) of :meth:`solve`, from solutions without one block each."""
        return jackknife_covariance(solve(self.without(), columns))


def information(tables: FloatArray) -> FloatArray:
    """Information H (..., p, p) of tables (..., p, p + 1) or (..., p + 1, p + 1)."""
    n_unknowns = tables.shape[-1] - 1
    return tables[..., :n_unknowns, :n_unknowns]


def score(tables: FloatArray) -> FloatArray:
    """Score S (..., p) of tables (..., p, p + 1) or (..., p + 1, p + 1)."""
    return tables[..., : tables.shape[-1] - 1, -1]


def inverse(matrices: FloatArray) -> FloatArray:
    """Return inverses (..., p, p) of matrices (..., p, p); pseudo-inverses if one is singular."""
    try:
        inverses = np.linalg.inv(matrices)
    except np.linalg.LinAlgError:
        # With exact poses, the information along some directions is so large that the information
        # along the other directions is rounding.
        inverses = np.linalg.pinv(matrices)
    return np.asarray(inverses, dtype=float)


def answer_evidence(answers: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return evidence ``[H S]`` (..., p, p + 1) of estimates (..., p) with their covariances."""
    H = inverse(covariances)
    return np.concatenate([H, H @ answers[..., None]], axis=-1)


def shift_evidence(tables: FloatArray, before: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return evidence ``[H S]`` (..., p, p + 1) of a shift of the unknowns from earlier estimates.

    Parameters
    ----------
    tables : (..., p, p + 1) or (..., p + 1, p + 1) array
        Evidence since the shift; H may be singular.
    before : (..., p) array
        Estimates of the unknowns before the shift.
    covariance : (..., p, p) array
        Covariance of these estimates.
    """
    H = information(tables)
    scores = score(tables)[..., None] - H @ before[..., None]
    relative = np.concatenate([H, scores], axis=-1)
    spread = np.eye(H.shape[-1]) + H @ covariance
    return inverse(spread) @ relative


def solve(tables: FloatArray, columns: Sequence[int], target: int = -1) -> FloatArray:
    """Fit a target column by k other columns, by least squares.

    Parameters
    ----------
    tables : (..., p + 1, p + 1) array
        Products of the columns.
    columns : sequence of int
        The k other columns.
    target : int
        The column that is fitted.

    Returns
    -------
    (..., k) array
        Coefficients of the columns; zero along directions without evidence.
    """
    normal = tables[..., columns, :][..., columns]
    roots = np.sqrt(np.abs(np.diagonal(normal, axis1=-2, axis2=-1)))
    units = np.divide(1.0, roots, out=np.zeros_like(roots), where=roots > _SMALLEST_ROOT)
    balanced = normal * units[..., :, None] * units[..., None, :]
    damped = balanced + _DAMPING * np.eye(len(columns))
    scores = units * tables[..., columns, target]
    answers = np.linalg.solve(damped, scores[..., None])[..., 0]
    return np.asarray(units * answers)


def jackknife_covariance(answers: FloatArray) -> FloatArray:
    """Covariance (p, p) from B estimates (B, p), each made without one of B blocks.

    B. Efron, R. J. Tibshirani, *An introduction to the bootstrap*, 1993, eq. 11.5:
    ``(B - 1) / B * sum (x_b - mean) (x_b - mean)'``.
    """
    n_blocks = len(answers)
    deviations = answers - answers.mean(axis=0)
    return np.asarray((n_blocks - 1) / n_blocks * deviations.T @ deviations)
