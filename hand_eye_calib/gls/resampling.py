"""What each part of a recording adds to what is known from the parts before it.

Leaving increments out as such would cut the trajectory there, and with white noise most is known
across the gap: answers without a part would scatter more than the error does. What a part adds, its
innovations, is independent of the other parts if the model is right.
"""

from __future__ import annotations

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.gls.block_tridiagonal import InOrder
from hand_eye_calib.gls.state_space import (
    FREE,
    WHITE,
    NormalEquations,
    Posterior,
    multiplied,
)

# Parts of a recording, and blocks of them that a jackknife leaves out.
N_PARTS, N_BLOCKS = 20, 10


def part_products(posterior: Posterior) -> FloatArray:
    """What each part adds to the products of J and, last, e: (K, p + 1, p + 1), K at most 20."""
    space = posterior.space
    n, factor = len(space), InOrder(*posterior.precision())
    ends = np.linspace(0, n, min(N_PARTS, n) + 1).astype(int).tolist()
    whitened, total, totals = None, np.zeros((space.columns.shape[2],) * 2), []
    for start, end in zip(ends[:-1], ends[1:], strict=True):
        # The forces on a pose come from the increments on both sides of it.
        first = max(start - 1, 0)
        columns = space.columns[first:end]
        weighed = posterior.weighed(columns, slice(first, end))
        forces = space.gathered(weighed, first)[start - first : -1]
        whitened = factor.whiten(forces, start, None if whitened is None else whitened[-1])
        own = slice(start - first, None)
        total = total + multiplied(columns[own], weighed[own]) - multiplied(whitened, whitened)
        totals.append(total - _at_the_end(end, posterior, factor, weighed[-1], whitened[-1]))
    return np.diff(np.array(totals), axis=0, prepend=np.zeros_like(totals[:1]))


def _at_the_end(
    end: int, posterior: Posterior, factor: InOrder, weighed: FloatArray, whitened: FloatArray
) -> FloatArray:
    """Products of the last state's whitened columns if the recording ended at this pose.

    Parameters
    ----------
    end : int
    posterior : Posterior
    factor : InOrder
    weighed : (6, k) array
        W times the columns of the last increment.
    whitened : (d, k) array
        Those of the state before.
    """
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
    right = ahead.T @ weighed - before @ whitened
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
