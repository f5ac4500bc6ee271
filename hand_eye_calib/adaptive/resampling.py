"""What each part of a recording adds to what is known from the parts before it.

Leaving increments out as such would cut the trajectory there, and with white noise most is known
across the gap: answers without a part would scatter more than the error does. What a part adds, its
innovations, is independent of the other parts if the model is right.
"""

from __future__ import annotations

import numpy as np

from hand_eye_calib.adaptive.block_tridiagonal import InOrder
from hand_eye_calib.adaptive.state_space import (
    FREE,
    WHITE,
    NormalEquations,
    Posterior,
    multiplied,
)
from hand_eye_calib.arrays import FloatArray

N_PARTS = 20


def part_products(posterior: Posterior) -> FloatArray:
    """What each part adds to the products of J and, last, e: (K, p + 1, p + 1), K at most 20."""
    space = posterior.space
    n, columns = len(space), space.columns
    factor = InOrder(*posterior.precision())
    ends = np.linspace(0, n, min(N_PARTS, n) + 1).astype(int)[1:]
    weighed = posterior.weighed(columns)
    whitened = factor.whiten(space.gathered(weighed))
    totals = np.array([_up_to(end, posterior, factor, weighed, whitened) for end in ends])
    parts = [slice(*part) for part in zip([0, *ends[:-1]], ends, strict=True)]
    own = [
        multiplied(columns[part], weighed[part]) - multiplied(whitened[part], whitened[part])
        for part in parts
    ]
    sums = np.cumsum(own, axis=0) - totals
    return np.diff(sums, axis=0, prepend=0.0 * sums[:1])


def _up_to(
    end: int,
    posterior: Posterior,
    factor: InOrder,
    weighed: FloatArray,
    whitened: FloatArray,
) -> FloatArray:
    """Products of the last state's whitened columns if the recording ended at this pose."""
    space = posterior.space
    before = factor.below(end - 1)
    ahead = space.ahead[end - 1]
    precision = ahead.T @ (posterior.walk_precision * posterior.evidence[end - 1]) @ ahead
    precision -= before @ before.T
    of_pose = space.weights[end] * posterior.white_precision[end]
    precision[:WHITE, :WHITE] += FREE * np.eye(WHITE) if space.is_free[end] else of_pose
    for process in posterior.markov:
        states = np.arange(process.group.states.start, process.group.states.stop)
        precision[states, states] += 1.0 / (process.variance * process.rest[end - 1])
    right = ahead.T @ weighed[end - 1] - before @ whitened[end - 1]
    last = np.linalg.solve(np.linalg.cholesky(precision), right)
    return last.T @ last


def answers_without(products: FloatArray, n_blocks: int) -> FloatArray:
    """Steps (B, p) of xi and then the systematic errors, each without one of B blocks of parts.

    Parameters
    ----------
    products : (K, p + 1, p + 1) array
        Of :func:`part_products`.
    n_blocks : int
    """
    block_of_part = np.arange(len(products)) * n_blocks // len(products)
    total = products.sum(axis=0)
    blocks = [products[block_of_part == block].sum(axis=0) for block in range(n_blocks)]
    return NormalEquations(total - np.array(blocks)).step
