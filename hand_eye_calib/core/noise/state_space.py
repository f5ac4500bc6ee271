"""Exact likelihood of increments under white errors, random walks and time-correlated errors.

The increments of the common error c obey, see :mod:`~hand_eye_calib.core.noise.increments`,

    e_i + J_i beta = H1_i x_{i+1} - H0_i x_i + w_i

with the latent state x of every pose: its white error, and the values of slow processes,
first-order Gauss-Markov each, ``g_{i+1} = phi_i g_i + q_i`` with ``phi_i = exp(-dt_i / tau)``. w is
the random walk. In information form the posterior precision of all states is block tridiagonal,

    P = Pi + U' W U,       log|V| = log|P| - log|Pi| - log|W|,       V^-1 Z = W (Z - U P^-1 U' W Z)

so that one factorisation P = L L' gives the likelihood and everything else, in time linear in the
poses. Products need only the forward half of the solution: ``Z' V^-1 Z = Z' W Z - Y' Y`` with the
whitened columns ``Y = L^-1 U' W Z``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.noise.normal import (
    Factor,
    NormalEquations,
    inverse_roots,
    multiplied,
    transposed,
)

# States of a pose's white error.
WHITE = 6

# Diagonals of precisions are raised by this share, so that rounding cannot make them indefinite.
_RAISED = 1e-13

# Precision (1/m^2, 1/rad^2) of poses that may be anywhere.
_FREE = 1.0

# Parts of a recording for the jackknife.
_N_PARTS = 20


@dataclass(frozen=True, kw_only=True)
class StateSpace:
    """A linear state space of N poses, n = N - 1 increments, d states and p parameters.

    Attributes
    ----------
    intervals_s : (n,) array
    relative : (n,) array
        Variance of the walk over each increment, in units of a typical one.
    columns : (n, 6, p + 1) array
        J and, last, e.
    ahead, behind : (n, 6, d - 6) and (n, 6, d) arrays
        H1 of the states behind the white error, for which it is the identity, and H0.
    white, walk : tuples of (1 or N, 6, 6) and (6, 6) arrays
        What log levels scale: the covariances are ``sum exp(level) basis``.
    twists : (N, 6) array
        v of one more basis v v' of each pose's white error.
    sizes : tuple of int
        Numbers of states behind the white error that are independent Gauss-Markov processes with
        one variance and one time constant, group by group.
    weights : (N,) array
        Factors of the precision of each pose's white error; zero for poses that may be anywhere.
    cut : (n,) bool array
        Increments that are no evidence.
    prior : (p + 1, p + 1) array
        Products that what is known of the parameters beforehand adds.
    """

    intervals_s: FloatArray
    relative: FloatArray
    columns: FloatArray
    ahead: FloatArray
    behind: FloatArray
    white: tuple[FloatArray, ...]
    walk: tuple[FloatArray, ...]
    twists: FloatArray
    sizes: tuple[int, ...]
    weights: FloatArray
    cut: BoolArray
    prior: FloatArray

    def white_precision(self, levels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Inverses (N, 6, 6) of the white errors' covariances at log levels, weights left out, and
        logarithms (N,) of their determinants.

        With ``S S' = (sum exp(level) basis)^-1``, ``z = S' v`` and the variance j along v the
        inverse is R'R, ``R = (I - a z z') S'``, ``a = (1 - (1 + j z'z)^-1/2) / z'z``: unlike a
        difference, never indefinite.
        """
        roots, log_determinants = inverse_roots(combined(levels, self.white))
        along = roots @ self.twists[:, :, None]
        squares = (along**2).sum(axis=1, keepdims=True)
        grown = np.log1p(np.exp(levels[len(self.white)]) * squares)
        share = -np.expm1(-0.5 * grown) / np.where(squares > 0.0, squares, 1.0)
        roots = roots - share * along @ (transposed(along) @ roots)
        return transposed(roots) @ roots, log_determinants + grown[:, 0, 0]

    def observed(self, states: FloatArray) -> FloatArray:
        """Contribution (n, 6, k) of states (N, d, k) to the increments."""
        observed = self.behind @ states[:-1]
        return np.subtract(self.ahead_times(states[1:]), observed, out=observed)

    def ahead_times(self, blocks: FloatArray) -> FloatArray:
        """H1 of the increments times blocks (n, d, k): (n, 6, k)."""
        white = blocks[:, :WHITE]
        return white + self.ahead @ blocks[:, WHITE:] if self.sizes else white

    def gathered(self, columns: FloatArray) -> FloatArray:
        """The transpose of :meth:`observed`: (N, d, k) of columns (n, 6, k)."""
        states = np.empty((len(columns) + 1, self.behind.shape[2], columns.shape[2]))
        np.matmul(-transposed(self.behind), columns, out=states[:-1])
        states[-1] = 0.0
        states[1:, :WHITE] += columns
        if self.sizes:
            states[1:, WHITE:] += transposed(self.ahead) @ columns
        return states


class Markov:
    """A group of independent Gauss-Markov processes with one variance and one time constant.

    Attributes
    ----------
    states : slice
        Of the latent state.
    variance : float
    phi, slope, rest : (n,) arrays
        phi_i, its derivative by log tau, and the innovations' relative variances ``1 - phi_i^2``.
    beside, before, after : (n,) arrays
        What each increment adds to the precision for unit variance: beside the diagonal, to the
        state before and to that behind. The first state has 1 of its own.
    """

    def __init__(self, states: slice, levels: FloatArray, intervals_s: FloatArray) -> None:
        ratio = intervals_s / np.exp(levels[1])
        self.states = states
        self.variance = float(np.exp(levels[0]))
        self.phi = np.exp(-ratio)
        self.slope = self.phi * ratio
        self.rest = -np.expm1(-2.0 * ratio)
        self.after = 1.0 / self.rest
        self.beside = -self.phi * self.after
        self.before = self.phi**2 * self.after

    def by_tau(self, values: FloatArray) -> FloatArray:
        """Derivative by log tau of the states (N, k) that the covariance makes of fixed forces."""
        phi = self.phi
        rest = self.rest
        slope = self.slope
        by_rest = 2.0 * phi * slope / rest**2
        beside = (slope / rest + phi * by_rest)[:, None]
        first = (2.0 * phi * slope / rest + phi**2 * by_rest)[:, None]
        forces = np.zeros_like(values)
        forces[1:] += by_rest[:, None] * values[1:] - beside * values[:-1]
        forces[:-1] += first * values[:-1] - beside * values[1:]
        diagonal = np.r_[1.0, self.after] + np.r_[self.before, 0.0]
        factor = Factor(diagonal[:, None, None], self.beside[:, None, None])
        return -factor.restore(factor.whiten(forces[:, None]))[:, 0]


class Posterior:
    """States, parameters and likelihood of a state space at given log levels.

    Parameters
    ----------
    space : StateSpace
    levels : (m,) array
        Logarithms: variances of the white bases, along v and of the walk bases, then variance and
        time constant (s) of every group.

    Attributes
    ----------
    white : (1 or N, 6, 6) array
        Precisions of the white errors for weight 1.
    walk_covariance, walk : (6, 6) arrays
        Covariance of the walk over a typical increment, and its inverse.
    evidence : (n,) array
        Factors of the latter: zero for increments that are no evidence.
    markov : list of Markov
    factor : Factor
        Of the precision P of all states. Its ``selected_inverse`` are their covariances for known
        parameters: of each pose's (N, d, d), and between each pose's and the one's before.
    log_determinant : float
        log|V|, increments that are no evidence left out.
    whitened : (N, d, p + 1) array
        Y of the space's columns.
    products : (p + 1, p + 1) array
        Products of J and, last, e, weighed with V^-1.
    normal : NormalEquations
        Solution for all parameters.
    loss : float
        Negative restricted log likelihood, constants left out (Patterson, Thompson, Biometrika 58,
        1971).

    Raises
    ------
    numpy.linalg.LinAlgError
        If the levels make a matrix that is not positive definite to rounding.
    """

    def __init__(self, space: StateSpace, levels: FloatArray) -> None:
        self.space = space
        self.levels = levels
        n_poses = len(space.weights)
        n_white = len(space.white) + 1
        kept = ~space.cut
        given = space.weights != 0.0
        self.white, of_white = space.white_precision(levels)
        weights = space.weights[:, None, None]
        self._of_poses = weights * self.white
        self._of_poses[~(space.weights > 0.0)] = _FREE * np.eye(WHITE)
        self.walk_covariance = combined(levels[n_white:], space.walk)
        self.walk = np.linalg.inv(self.walk_covariance)
        self.evidence = np.where(space.cut, 0.0, 1.0 / space.relative)
        self._weights = self.evidence[:, None, None] * self.walk
        self.markov = []
        start = WHITE
        at = n_white + len(space.walk)
        for size in space.sizes:
            of_group = slice(start, start + size), levels[at : at + 2]
            self.markov.append(Markov(*of_group, space.intervals_s))
            start += size
            at += 2
        diagonal, below = self._blocks(0, n_poses - 1)
        np.einsum("nii->ni", diagonal)[:] *= 1.0 + _RAISED
        self.factor = Factor(diagonal, below)
        white = WHITE * np.log(np.where(given, space.weights, 1.0)) - of_white
        prior = float(white[given].sum()) + WHITE * np.log(_FREE) * int((~given).sum())
        for process, size in zip(self.markov, space.sizes, strict=True):
            of_one = n_poses * np.log(process.variance) + np.log(process.rest).sum()
            prior -= size * of_one
        of_walk = 6 * np.log(space.relative[kept]).sum()
        of_walk += kept.sum() * np.linalg.slogdet(self.walk_covariance)[1]
        self.log_determinant = float(of_walk + self.factor.log_determinant - prior)
        weighed, self.whitened = self.halves(space.columns)
        products = multiplied(space.columns, weighed) - multiplied(self.whitened, self.whitened)
        self.products = 0.5 * (products + products.T) + space.prior
        self.normal = NormalEquations(self.products)
        determinants = self.log_determinant + self.normal.log_determinant
        self.loss = 0.5 * float(determinants + self.normal.cost)

    def _blocks(self, start: int, end: int) -> tuple[FloatArray, FloatArray]:
        """Blocks of P on the diagonal (m + 1, d, d) and below it (m, d, d), of the m increments
        from pose to pose. What is known of a pose by itself is in the block of the increment
        before, or of the first one.
        """
        space = self.space
        part = slice(start, end)
        here = slice(1, None)
        ahead = space.ahead[part]
        behind = space.behind[part]
        weights = self._weights[part]
        n, _, size = behind.shape
        diagonal = np.zeros((n + 1, size, size))
        below = np.zeros((n, size, size))
        diagonal[here, :WHITE, :WHITE] = weights
        weighed = np.matmul(weights, behind, out=below[:, :WHITE])
        if self.markov:
            beside = weights @ ahead
            diagonal[here, :WHITE, WHITE:] = beside
            diagonal[here, WHITE:, :WHITE] = transposed(beside)
            diagonal[here, WHITE:, WHITE:] = transposed(ahead) @ beside
            below[:, WHITE:] = -(transposed(ahead) @ weighed)
        diagonal[:-1] += transposed(behind) @ weighed
        np.negative(weighed, out=weighed)
        diagonal[here, :WHITE, :WHITE] += self._of_poses[start + 1 : end + 1]
        for process in self.markov:
            states = range(size)[process.states]
            variance = process.variance
            below[:, states, states] += process.beside[part, None] / variance
            diagonal[:-1, states, states] += process.before[part, None] / variance
            diagonal[1:, states, states] += process.after[part, None] / variance
        if start == 0:
            diagonal[0, :WHITE, :WHITE] += self._of_poses[0]
            for process in self.markov:
                states = range(size)[process.states]
                diagonal[0, states, states] += 1.0 / process.variance
        return diagonal, below

    def halves(self, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """W Z and Y, (n, 6, k) and (N, d, k), of columns Z (n, 6, k)."""
        weighed = self._weights @ columns
        return weighed, self.factor.whiten(self.space.gathered(weighed))

    def states_after(self, step: FloatArray) -> FloatArray:
        """Expected states (N, d) after a step of the parameters."""
        mixing = np.r_[step, 1.0][:, None]
        return self.factor.restore(_mixed(self.whitened, mixing))[:, :, 0]

    def restricted(self) -> tuple[FloatArray, FloatArray]:
        """States (N, d, 1 + q) and walk (n, 6, 1 + q) for unknown parameters.

        The first column is the expected value. The squares of the other columns sum to the variance
        that the uncertainty of the parameters adds.
        """
        size = len(self.normal.step)
        normal = self.normal
        mixing = np.zeros((size + 1, size + 1))
        mixing[:-1, 0] = normal.step
        mixing[-1, 0] = 1.0
        mixing[:-1, 1:] = normal.root
        states = self.factor.restore(_mixed(self.whitened, mixing))
        return states, _mixed(self.space.columns, mixing) - self.space.observed(states)

    def part_products(self) -> FloatArray:
        """Contributions (K, p + 1, p + 1) of parts of the recording to the products; K at most 20.

        Without the increments of a part the trajectory would be cut, although white noise leaves
        most known across the gap: solutions without a part would scatter more than the error does.
        The contribution of a part, its innovations, is independent of the other parts if the model
        is right.

        Each part is a quadratic form of the states at its two ends and of the columns; all states
        between are eliminated. The forms are added in order of time.
        """
        n, _, n_columns = self.space.columns.shape
        size = self.space.behind.shape[2]
        ends = np.linspace(0, n, min(_N_PARTS, n) + 1).astype(int).tolist()
        known = np.zeros((size + n_columns, size + n_columns))
        totals = [np.zeros((n_columns, n_columns))]
        for start, end in pairwise(ends):
            form = self._form_of_part(start, end)
            # States at the start, at the end, columns; what is known of the start so far is added.
            here = np.r_[np.arange(size), np.arange(2 * size, len(form))]
            form[np.ix_(here, here)] += known
            known = _eliminated(form, size)
            totals.append(_eliminated(known, size))
        # The prior counts in equal shares.
        return np.diff(np.array(totals), axis=0) + self.space.prior / (len(ends) - 1)

    def _form_of_part(self, start: int, end: int) -> FloatArray:
        """Quadratic form (2 d + k, 2 d + k) of the states at pose ``start`` and at ``end`` and of k
        columns, of the increments between; of the states before the start nothing is known.
        """
        space = self.space
        part = slice(start, end)
        size = self.space.behind.shape[2]
        diagonal, below = self._blocks(start, end)
        weighed = self._weights[part] @ space.columns[part]
        here = replace(space, ahead=space.ahead[part], behind=space.behind[part])
        forces = here.gathered(weighed)
        form = np.zeros((2 * size + forces.shape[2],) * 2)
        first = slice(size)
        last = slice(size, 2 * size)
        columns = slice(2 * size, None)
        form[first, first] = diagonal[0]
        form[last, last] = diagonal[-1]
        form[first, columns] = forces[0]
        form[last, columns] = forces[-1]
        form[columns, first] = forces[0].T
        form[columns, last] = forces[-1].T
        form[columns, columns] = multiplied(space.columns[part], weighed)
        if len(diagonal) == 2:
            form[last, first] = below[0]
            form[first, last] = below[0].T
            return form
        right = np.zeros((len(diagonal) - 2, size, len(form)))
        right[:, :, columns] = forces[1:-1]
        right[0, :, first] += below[0]
        right[-1, :, last] += below[-1].T
        whitened = Factor(diagonal[1:-1], below[1:-1]).whiten(right)
        return np.asarray(form - multiplied(whitened, whitened))


def _mixed(columns: FloatArray, mixing: FloatArray) -> FloatArray:
    """Combinations (n, d, l) of columns (n, d, k)."""
    n, size, _ = columns.shape
    return (columns.reshape(n * size, -1) @ mixing).reshape(n, size, -1)


def combined(levels: FloatArray, bases: tuple[FloatArray, ...]) -> FloatArray:
    """Sum of bases, each times the exponential of its level."""
    total = np.exp(levels[0]) * bases[0]
    for level, basis in zip(levels[1:], bases[1:], strict=False):
        total = total + np.exp(level) * basis
    return total


def _eliminated(form: FloatArray, size: int) -> FloatArray:
    """A quadratic form without its first variables, at their best values."""
    root = np.linalg.solve(np.linalg.cholesky(form[:size, :size]), form[:size, size:])
    return np.asarray(form[size:, size:] - root.T @ root)
