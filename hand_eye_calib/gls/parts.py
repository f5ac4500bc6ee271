"""What each part of a recording adds to what is known from the parts before it."""

from __future__ import annotations

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.gls.block_tridiagonal import Factor
from hand_eye_calib.gls.normal import multiplied
from hand_eye_calib.gls.state_space import Posterior

# Parts of a recording.
_N_PARTS = 20


def part_products(posterior: Posterior) -> FloatArray:
    """What each part adds to the products of J and, last, e: (K, p + 1, p + 1), K at most 20.

    Leaving increments out as such would cut the trajectory there, and with white noise most is
    known across the gap: answers without a part would scatter more than the error does. What a part
    adds, its innovations, is independent of the other parts if the model is right.

    Each part is a quadratic form of the states at its two ends and of the columns: all states
    between are eliminated. The forms are added in order of time.
    """
    n, size = len(posterior.space), posterior.space.n_states
    ends = np.linspace(0, n, min(_N_PARTS, n) + 1).astype(int).tolist()
    of_start = posterior.precision.prior_block()
    n_columns = posterior.space.columns.shape[2]
    known = np.zeros((size + n_columns, size + n_columns))
    known[:size, :size] = of_start
    totals = [np.zeros((n_columns, n_columns))]
    for start, end in zip(ends[:-1], ends[1:], strict=True):
        form = _form_of_part(posterior, start, end)
        # States at the start, at the end, columns; what is known of the start so far is added.
        here = np.r_[np.arange(size), np.arange(2 * size, len(form))]
        form[np.ix_(here, here)] += known
        known = _eliminated(form, size)
        totals.append(_eliminated(known, size))
    return np.diff(np.array(totals), axis=0)


def _form_of_part(posterior: Posterior, start: int, end: int) -> FloatArray:
    """Quadratic form of the states (d) at pose ``start`` and at ``end`` and of k columns, (2 d + k,
    2 d + k), of the increments between; of the states before the start nothing is known in it.
    """
    diagonal, below, forces, products = posterior.part(start, end)
    size, n_columns = diagonal.shape[1], products.shape[0]
    form = np.zeros((2 * size + n_columns, 2 * size + n_columns))
    first, last, columns = slice(size), slice(size, 2 * size), slice(2 * size, None)
    form[first, first], form[last, last] = diagonal[0], diagonal[-1]
    form[first, columns], form[last, columns] = forces[0], forces[-1]
    form[columns, first], form[columns, last] = forces[0].T, forces[-1].T
    form[columns, columns] = products
    if len(diagonal) == 2:
        form[last, first], form[first, last] = below[0], below[0].T
        return form
    right = np.zeros((len(diagonal) - 2, size, len(form)))
    right[:, :, columns] = forces[1:-1]
    right[0, :, first] += below[0]
    right[-1, :, last] += below[-1].T
    whitened = Factor(diagonal[1:-1], below[1:-1]).whiten(right)
    return np.asarray(form - multiplied(whitened, whitened))


def _eliminated(form: FloatArray, size: int) -> FloatArray:
    """A quadratic form without its first variables, at their best values."""
    root = np.linalg.solve(np.linalg.cholesky(form[:size, :size]), form[:size, size:])
    return np.asarray(form[size:, size:] - root.T @ root)
