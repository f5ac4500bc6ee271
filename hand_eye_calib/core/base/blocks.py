"""Least squares from sums over blocks of time.

The p unknowns x minimise the squares of ``W^(1/2) (J x - y)``. The table of a block of time is the
matrix of products ``[J y]' W [J y]`` (p + 1, p + 1). Its first p rows are ``[H S]``: the
information ``H = J' W J`` and the score ``S = J' W y``. The table of several blocks is the sum of
their tables. Therefore the solution for any set of blocks (all, all except one, before or since a
time) needs only sums of tables.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray

# Term on the diagonal of an information matrix that was scaled to a diagonal of 1. It is above
# rounding, and makes unknowns zero along directions without information.
_DAMPING = 1e-10

# An unknown has no information if the square root of its diagonal element is at most this.
_MIN_ROOT = 1e-30


@dataclass(frozen=True)
class Blocks:
    """Sums (B, ...) of B blocks in order of time: tables, or other arrays that can be added.

    Examples
    --------
    >>> rows = np.array([[[1.0, 2.0]], [[1.0, 4.0]]])  # 1 x = 2, then 1 x = 4
    >>> Blocks.of_rows(rows, 2).solve([0]).tolist()
    [3.0]
    """

    sums: FloatArray

    @classmethod
    def of_rows(
        cls, rows: FloatArray, n_blocks: int, probes: FloatArray | None = None
    ) -> "Blocks":
        """Return the tables of weighted rows ``W^(1/2) [J y]`` (K, d, p + 1) in equal blocks.

        ``probes`` (K, d, p + 1) are instrumental variables, if there are any. They replace the left
        factor of the products.
        """
        n_columns = rows.shape[-1]
        left_factors = np.array_split(
            rows if probes is None else probes, n_blocks
        )
        right_factors = np.array_split(rows, n_blocks)
        tables = []
        for left_rows, right_rows in zip(
            left_factors, right_factors, strict=True
        ):
            tables.append(
                left_rows.reshape(-1, n_columns).T
                @ right_rows.reshape(-1, n_columns)
            )
        return cls(np.stack(tables))

    @classmethod
    def gathered(
        cls, values: FloatArray, block_of: IntArray, n_blocks: int
    ) -> "Blocks":
        """Return the sums of values (K, ...) over blocks.

        ``block_of`` (K,) is the index of the block of each value.
        """
        sums = np.zeros((n_blocks, *values.shape[1:]))
        np.add.at(sums, block_of, values)
        return cls(sums)

    def merged(self, n_blocks: int) -> "Blocks":
        """Return ``n_blocks`` larger blocks, each the sum of neighbouring blocks."""
        starts = np.arange(n_blocks) * len(self.sums) // n_blocks
        return Blocks(np.add.reduceat(self.sums, starts))

    @property
    def total(self) -> FloatArray:
        """Sum (...) of all blocks."""
        return self.sums.sum(axis=0)

    def without(self) -> FloatArray:
        """Return the sums (B, ...) of all blocks except block b, for each b."""
        return self.total - self.sums

    def before(self, cuts: IntArray) -> FloatArray:
        """Return the sums (C, ...) of the blocks before each of the indices ``cuts`` (C,), >= 1."""
        sums_from_start = np.cumsum(self.sums, axis=0)
        return sums_from_start[cuts - 1]

    def since(self, cuts: IntArray) -> FloatArray:
        """Return the sums (C, ...) of the blocks from each of the indices ``cuts`` (C,) on."""
        sums_from_end = np.cumsum(self.sums[::-1], axis=0)
        return sums_from_end[::-1][cuts]

    def shift_since(self, cuts: IntArray, prior: FloatArray) -> FloatArray:
        """Return information and score ``[H S]`` (C, p, p + 1) of a shift at each of the cuts (C,).

        A shift is a change of the unknowns x at a cut. ``prior`` (p, p) is added to the information
        on x before the cut.
        """
        before = self.before(cuts)
        covariances = inverse(information(before) + prior)
        estimates = (covariances @ score(before)[..., None])[..., 0]
        return shift_evidence(self.since(cuts), estimates, covariances)

    def solve(self, columns: Sequence[int]) -> FloatArray:
        """Solve all blocks for k unknowns, given by index. The other unknowns are zero."""
        return solve(self.total, columns)

    def jackknife(self, columns: Sequence[int]) -> FloatArray:
        """Return the jackknife covariance (k, k) of :meth:`solve`; estimates omit one block."""
        return jackknife_covariance(solve(self.without(), columns))


def information(tables: FloatArray) -> FloatArray:
    """Return the information H (..., p, p) of tables (..., p, p + 1) or (..., p + 1, p + 1)."""
    n_unknowns = tables.shape[-1] - 1
    return tables[..., :n_unknowns, :n_unknowns]


def score(tables: FloatArray) -> FloatArray:
    """Return the score S (..., p) of tables (..., p, p + 1) or (..., p + 1, p + 1)."""
    n_unknowns = tables.shape[-1] - 1
    return tables[..., :n_unknowns, -1]


def inverse(matrices: FloatArray) -> FloatArray:
    """Return the inverses of matrices (..., p, p); if one of them is singular, pseudo-inverses."""
    try:
        inverses = np.linalg.inv(matrices)
    except np.linalg.LinAlgError:
        # Exact poses have so much information along some directions that it is only rounding along
        # others.
        inverses = np.linalg.pinv(matrices)
    return np.asarray(inverses, dtype=float)


def answer_evidence(answers: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return ``[H S]`` (..., p, p + 1) of estimates (..., p) with covariances (..., p, p)."""
    H = inverse(covariances)
    return np.concatenate([H, H @ answers[..., None]], axis=-1)


def shift_evidence(
    tables: FloatArray, before: FloatArray, covariance: FloatArray
) -> FloatArray:
    """Return information and score ``[H S]`` (..., p, p + 1) of a shift of the unknowns.

    Parameters
    ----------
    tables : (..., p, p + 1) or (..., p + 1, p + 1) array
        Information and score since the shift. The information may be singular.
    before : (..., p) array
        Estimates of the unknowns before the shift.
    covariance : (..., p, p) array
        Covariance of these estimates.
    """
    H = information(tables)
    # Score of the difference from the estimates, as if the estimates were exact.
    scores = score(tables)[..., None] - H @ before[..., None]
    if_exact = np.concatenate([H, scores], axis=-1)
    # The uncertainty C of the estimates reduces the information to inverse(inverse(H) + C), which
    # is inverse(I + H C) H. The score gets the same factor.
    growth = np.eye(H.shape[-1]) + H @ covariance
    return inverse(growth) @ if_exact


def solve(
    tables: FloatArray, columns: Sequence[int], target: int = -1
) -> FloatArray:
    """Fit a target column by k other columns, by least squares.

    Parameters
    ----------
    tables : (..., p + 1, p + 1) array
        Products of all columns with each other.
    columns : sequence of int
        Indices of the k columns that are combined.
    target : int
        Index of the column that is fitted.

    Returns
    -------
    (..., k) array
        Coefficients of the columns; zero along directions without information.
    """
    normal = tables[..., columns, :][..., columns]
    diagonal = np.diagonal(normal, axis1=-2, axis2=-1)
    roots = np.sqrt(np.abs(diagonal))
    # Factors that scale the diagonal to 1.
    factors = np.divide(
        1.0, roots, out=np.zeros_like(roots), where=roots > _MIN_ROOT
    )
    balanced = normal * factors[..., :, None] * factors[..., None, :]
    damped = balanced + _DAMPING * np.eye(len(columns))
    scores = factors * tables[..., columns, target]
    scaled = np.linalg.solve(damped, scores[..., None])[..., 0]
    return factors * scaled


def jackknife_covariance(answers: FloatArray) -> FloatArray:
    """Return the covariance (p, p) from B estimates (B, p), each without one of B blocks.

    B. Efron, R. J. Tibshirani, *An introduction to the bootstrap*, 1993, eq. 11.5:
    ``(B - 1) / B * sum (x_b - mean) (x_b - mean)'``.
    """
    n_blocks = len(answers)
    deviations = answers - answers.mean(axis=0)
    return (n_blocks - 1) / n_blocks * deviations.T @ deviations
