"""Generalised least squares from products of weighed columns."""

from __future__ import annotations

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.gls.block_tridiagonal import transposed
from hand_eye_calib.gls.tuning import TUNING


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
        information, gradient = products[..., :-1, :-1], products[..., :-1, -1]
        diagonal = np.einsum("...ii->...i", information)
        scale = 1.0 / np.sqrt(np.maximum(diagonal, np.finfo(float).tiny))
        values, vectors = np.linalg.eigh(scale[..., :, None] * information * scale[..., None, :])
        self._seen = values > TUNING.least_information_share
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


def selected(products: FloatArray, columns: list[int]) -> FloatArray:
    """The products (..., p + 1, p + 1) of some parameters."""
    rows = [*columns, products.shape[-1] - 1]
    return products[..., rows, :][..., rows]


def multiplied(first: FloatArray, second: FloatArray) -> FloatArray:
    """Products (k, l) of columns (n, d, k) with columns (n, d, l)."""
    return first.reshape(-1, first.shape[2]).T @ second.reshape(-1, second.shape[2])


def answers_without(products: FloatArray, n_blocks: int) -> FloatArray:
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
