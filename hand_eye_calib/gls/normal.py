"""Generalised least squares from products of weighed columns."""

from __future__ import annotations

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.gls.block_tridiagonal import transposed

# Information below this share of what a parameter's own diagonal promises is rounding; no diagonal
# counts as smaller than the latter.
_RANK_TOLERANCE, _LEAST_INFORMATION = 1e-12, float(np.finfo(float).tiny)

# Blocks of a recording that a jackknife leaves out.
N_BLOCKS = 10


class NormalEquations:
    """Generalised least squares from products (..., p + 1, p + 1) of derivatives and, last,
    residuals: of one system, or of several at once.

    Attributes
    ----------
    step : (..., p) array
        Change of the parameters; zero along directions without any evidence.
    covariance : (..., p, p) array
        Zero along these directions, too.
    is_complete : (...) bool array
        Whether there are none.
    cost : (...) array
        Weighted squared residual after the step.
    log_determinant : (...) array
        Of the information.
    """

    def __init__(self, products: FloatArray) -> None:
        information, gradient = products[..., :-1, :-1], products[..., :-1, -1]
        diagonal = np.einsum("...ii->...i", information)
        scale = 1.0 / np.sqrt(np.maximum(diagonal, _LEAST_INFORMATION))
        values, vectors = np.linalg.eigh(scale[..., :, None] * information * scale[..., None, :])
        self._seen = values > _RANK_TOLERANCE
        values = np.where(self._seen, values, 1.0)
        self._axes = scale[..., :, None] * vectors
        self._root = self._axes * (self._seen / np.sqrt(values))[..., None, :]
        self.covariance = self._root @ transposed(self._root)
        self.is_complete = self._seen.all(axis=-1)
        self.step = -(self.covariance @ gradient[..., None])[..., 0]
        self.cost = products[..., -1, -1] + (gradient * self.step).sum(axis=-1)
        self.log_determinant = np.log(values).sum(axis=-1) - 2.0 * np.log(scale).sum(axis=-1)

    @property
    def unseen(self) -> FloatArray:
        """(p, U) array: the directions without evidence of one system, of unit length."""
        axes = self._axes[:, ~self._seen]
        return np.asarray(axes / np.linalg.norm(axes, axis=0))

    @property
    def mixing(self) -> FloatArray:
        """(p + 1, 1 + p) array of one system: residuals after the step, then the columns of a root
        of the covariance.
        """
        size = len(self.step)
        mixing = np.zeros((size + 1, size + 1))
        mixing[:-1, 0], mixing[-1, 0] = self.step, 1.0
        mixing[:-1, 1:] = self._root
        return mixing


def selected(products: FloatArray, columns: list[int]) -> FloatArray:
    """The products (..., p + 1, p + 1) of some parameters."""
    rows = [*columns, products.shape[-1] - 1]
    return products[..., rows, :][..., rows]


def multiplied(first: FloatArray, second: FloatArray) -> FloatArray:
    """Products (k, l) of columns (n, d, k) with columns (n, d, l)."""
    return first.reshape(-1, first.shape[2]).T @ second.reshape(-1, second.shape[2])


def answers_without(products: FloatArray, n_blocks: int = N_BLOCKS) -> FloatArray:
    """Steps (B, p) of xi and then the systematic errors, each without one of B blocks of parts.

    Parameters
    ----------
    products : (K, p + 1, p + 1) array
        Of :func:`~hand_eye_calib.gls.state_space.Posterior.part_products`.
    n_blocks : int
    """
    block_of_part = np.arange(len(products)) * n_blocks // len(products)
    total = products.sum(axis=0)
    blocks = [products[block_of_part == block].sum(axis=0) for block in range(n_blocks)]
    return NormalEquations(total - np.array(blocks)).step
