"""Least squares from sums over blocks of time.

The p unknowns x minimise the squares of ``W^(1/2) (J x - y)``. The evidence of a block is its table
of products ``[J y]' W [J y]`` (p + 1, p + 1). The first p rows ``[H S]`` are the information and
the score. Tables add over blocks, so any set of blocks (all, all but one, before or since a time)
is solved from the sum of its tables.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray

# Damping of directions without evidence, in units in which the diagonal is 1: above rounding.
_DAMPING = 1e-10

# Smallest root of a diagonal element that counts as evidence.
_LEAST_SIZE = 1e-30


@dataclass(frozen=True)
class Blocks:
    """Sums (B, ...) of B blocks in order of time: tables of products, or other evidence that adds.

    Examples
    --------
    >>> rows = np.array([[[1.0, 2.0]], [[1.0, 4.0]]])  # 1 x = 2, then 1 x = 4
    >>> Blocks.of_rows(rows, 2).solve([0]).tolist()
    [3.0]
    """

    sums: FloatArray

    @classmethod
    def of_rows(cls, rows: FloatArray, n_blocks: int, probes: FloatArray | None = None) -> "Blocks":
        """Tables of products of weighted rows (K, d, p + 1), in blocks of equally many rows.

        ``probes`` (K, d, p + 1) take the place of the rows on the left: instrumental variables.
        """
        n_columns = rows.shape[-1]
        on_left = np.array_split(rows if probes is None else probes, n_blocks)
        on_right = np.array_split(rows, n_blocks)
        tables = []
        for left, right in zip(on_left, on_right, strict=True):
            tables.append(left.reshape(-1, n_columns).T @ right.reshape(-1, n_columns))
        return cls(np.stack(tables))

    @classmethod
    def gathered(cls, values: FloatArray, block_of: IntArray, n_blocks: int) -> "Blocks":
        """Sums of values (K, ...) by the block (K,) of each."""
        sums = np.zeros((n_blocks, *values.shape[1:]))
        np.add.at(sums, block_of, values)
        return cls(sums)

    def merged(self, n_blocks: int) -> "Blocks":
        """Fewer blocks, each of neighbours."""
        starts = np.arange(n_blocks) * len(self.sums) // n_blocks
        return Blocks(np.add.reduceat(self.sums, starts))

    @property
    def total(self) -> FloatArray:
        """Sum (...) of all blocks."""
        return np.asarray(self.sums.sum(axis=0))

    def without(self) -> FloatArray:
        """Sums (B, ...) of all blocks but one."""
        return self.total - self.sums

    def before(self, cuts: IntArray) -> FloatArray:
        """Sums (C, ...) of the blocks before each cut (C,); a cut is at least 1."""
        return np.asarray(np.cumsum(self.sums, axis=0)[cuts - 1])

    def since(self, cuts: IntArray) -> FloatArray:
        """Sums (C, ...) of the blocks since each cut (C,); a cut is at most B - 1."""
        return np.asarray(np.cumsum(self.sums[::-1], axis=0)[::-1][cuts])

    def shift_since(self, cuts: IntArray, prior: FloatArray) -> FloatArray:
        """Evidence (C, p, p + 1) of a shift of the unknowns at each cut, whatever they were before.

        ``prior`` (p, p) is added to the information about the unknowns before the cut.
        """
        before = self.before(cuts)
        covariances = inverse(information(before) + prior)
        known = (covariances @ score(before)[..., None])[..., 0]
        return shift_evidence(self.since(cuts), known, covariances)

    def solve(self, columns: Sequence[int]) -> FloatArray:
        """Answer (k,) of all blocks for some of the unknowns, the others being zero."""
        return solve(self.total, columns)

    def jackknife(self, columns: Sequence[int]) -> FloatArray:
        """Jackknife covariance (k, k) of :meth:`solve`, from the answers without each block."""
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
        # Exact poses have so much evidence along some directions that the others are rounding.
        inverses = np.linalg.pinv(matrices)
    return np.asarray(inverses, dtype=float)


def answer_evidence(answers: FloatArray, covariances: FloatArray) -> FloatArray:
    """Evidence ``[H S]`` (..., p, p + 1) of answers (..., p) with covariances (..., p, p)."""
    H = inverse(covariances)
    return np.concatenate([H, H @ answers[..., None]], axis=-1)


def shift_evidence(tables: FloatArray, known: FloatArray, covariance: FloatArray) -> FloatArray:
    """Evidence ``[H S]`` (..., p, p + 1) of a shift of the unknowns from those that are known.

    Parameters
    ----------
    tables : (..., p, p + 1) or (..., p + 1, p + 1) array
        Evidence since the shift; H may be singular.
    known : (..., p) array
        The unknowns before the shift.
    covariance : (..., p, p) array
        Of the errors of ``known``.
    """
    H = information(tables)
    scores = score(tables)[..., None] - H @ known[..., None]
    from_known = np.concatenate([H, scores], axis=-1)
    spread = np.eye(H.shape[-1]) + H @ covariance
    return inverse(spread) @ from_known


def solve(tables: FloatArray, columns: Sequence[int], target: int = -1) -> FloatArray:
    """Least-squares solution (..., k) of a target column by k others.

    Parameters
    ----------
    tables : (..., p + 1, p + 1) array
        Products of the columns.
    columns : sequence of int
    target : int
        The column that the others are fitted to.

    Returns
    -------
    (..., k) array
        Zero along directions without evidence.
    """
    normal = tables[..., columns, :][..., columns]
    sizes = np.sqrt(np.abs(np.diagonal(normal, axis1=-2, axis2=-1)))
    units = np.divide(1.0, sizes, out=np.zeros_like(sizes), where=sizes > _LEAST_SIZE)
    balanced = normal * units[..., :, None] * units[..., None, :]
    damped = balanced + _DAMPING * np.eye(len(columns))
    scores = units * tables[..., columns, target]
    answers = np.linalg.solve(damped, scores[..., None])[..., 0]
    return np.asarray(units * answers)


def jackknife_covariance(answers: FloatArray) -> FloatArray:
    """Covariance (p, p) from the answers (B, p) without each of B blocks.

    B. Efron, R. J. Tibshirani, *An introduction to the bootstrap*, 1993, eq. 11.5:
    ``(B - 1) / B * sum (x_b - mean) (x_b - mean)'``.
    """
    n_blocks = len(answers)
    deviations = answers - answers.mean(axis=0)
    return np.asarray((n_blocks - 1) / n_blocks * deviations.T @ deviations)
