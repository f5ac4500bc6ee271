"""Exact likelihood of increments under white errors, a random walk and time-correlated errors.

The state x_i of pose i holds its white error and the values of first-order Gauss-Markov processes
``g_{i+1} = phi_i g_i + q_i`` with ``phi_i = exp(-dt_i / tau)``. The residuals e of the increments,
see :mod:`~hand_eye_calib.core.noise.increments`, depend on parameters beta and on a random walk w:

    e_i + J_i beta = H1_i x_{i+1} - H0_i x_i + w_i          (in short: e + J beta = U x + w)

With the precision Pi of all states before the data and the precision W of the walk, the precision
after the data is block tridiagonal. The covariance V of the increments follows from it:

    P = Pi + U' W U,       log|V| = log|P| - log|Pi| - log|W|,       V^-1 Z = W (Z - U P^-1 U' W Z)

One factorisation P = L L' yields the likelihood in time linear in the number of poses. Products
need only the forward half of the solution: ``Z' V^-1 Z = Z' W Z - Y' Y`` with ``Y = L^-1 U' W Z``.
This is the information form of the Kalman smoother (Rauch, Tung, Striebel, AIAA J. 3, 1965).
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

# States of a pose's white error: translation and rotation.
WHITE = 6

# Share by which the diagonal of P is raised. Rounding must not make P indefinite.
_RAISED = 1e-13

# Change of a level for numerical derivatives: errors of the formula and of rounding are both about
# 1e-10.
LEVEL_CHANGE = 1e-5

# Number of parts of a recording for the jackknife.
_N_PARTS = 20


@dataclass(frozen=True, kw_only=True)
class StateSpace:
    """Linear state space of N poses, n = N - 1 increments, d states and p parameters.

    Attributes
    ----------
    intervals_s : (n,) array
    walk_factors : (n,) array
        Variance of the walk over each increment, in units of a typical increment.
    columns : (n, 6, p + 1) array
        ``[J e]``: derivatives with respect to the parameters; last, residuals.
    ahead : (n, 6, d - 6) array
        H1 without the columns of the white error, where H1 is the identity.
    behind : (n, 6, d) array
        H0.
    white_bases : tuple of (1 or N, 6, 6) arrays
        The covariance of a white error is ``sum exp(level) basis``.
    walk_bases : tuple of (6, 6) arrays
        The same of the walk.
    group_sizes : tuple of int
        Numbers of Gauss-Markov processes that share a variance and a time constant, by group. The
        states of the groups follow the white error.
    weights : (N,) array
        Factors of the precision of each pose's white error; zero for a pose that may be anywhere.
    cut : (n,) bool array
        Increments that are no evidence.
    prior : (p + 1, p + 1) array
        Products that the prior of the parameters adds.
    """

    intervals_s: FloatArray
    walk_factors: FloatArray
    columns: FloatArray
    ahead: FloatArray
    behind: FloatArray
    white_bases: tuple[FloatArray, ...]
    walk_bases: tuple[FloatArray, ...]
    group_sizes: tuple[int, ...]
    weights: FloatArray
    cut: BoolArray
    prior: FloatArray

    def white_precision(self, levels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Invert the covariances of the white errors for weight 1.

        Returns
        -------
        (N, 6, 6) array
            Precisions.
        (N,) array
            Logarithms of the determinants of the covariances.
        """
        roots, log_determinants = inverse_roots(total_covariance(levels, self.white_bases))
        return transposed(roots) @ roots, log_determinants

    def apply_u(self, states: FloatArray) -> FloatArray:
        """Return ``U x`` (n, 6, k) of states (N, d, k)."""
        product = self.behind @ states[:-1]
        return np.subtract(self.apply_h1(states[1:]), product, out=product)

    def apply_h1(self, blocks: FloatArray) -> FloatArray:
        """Return H1 of every increment times blocks (n, d, k): (n, 6, k)."""
        white = blocks[:, :WHITE]
        if not self.group_sizes:
            return white
        return white + self.ahead @ blocks[:, WHITE:]

    def apply_u_transposed(self, columns: FloatArray) -> FloatArray:
        """Return U' (N, d, k) times columns (n, 6, k)."""
        states = np.empty((len(columns) + 1, self.behind.shape[2], columns.shape[2]))
        np.matmul(-transposed(self.behind), columns, out=states[:-1])
        states[-1] = 0.0
        states[1:, :WHITE] += columns
        if self.group_sizes:
            states[1:, WHITE:] += transposed(self.ahead) @ columns
        return states


class Markov:
    """Group of independent Gauss-Markov processes with one variance and one time constant.

    The precision Pi (N, N) of the values of one process at all poses is tridiagonal.

    Parameters
    ----------
    states : slice
        Of the state of a pose.
    levels : (2,) array
        Logarithms of the stationary variance and of the time constant (s).
    intervals_s : (n,) array

    Attributes
    ----------
    first : float
        Contribution to Pi of the stationary variance of the first state.
    after, between, before : (n,) arrays
        Contributions of an increment to Pi: to the state after the increment, between both states,
        and to the state before the increment.
    diagonal : (N,) array
        Diagonal of Pi; ``between`` is beside the diagonal.
    log_determinant : float
        -log|Pi|.
    """

    def __init__(self, states: slice, levels: FloatArray, intervals_s: FloatArray) -> None:
        self.states = states
        self._levels = levels
        self._intervals_s = intervals_s
        ratios = intervals_s / np.exp(levels[1])
        phi = np.exp(-ratios)
        variances_of_q = -np.exp(levels[0]) * np.expm1(-2.0 * ratios)
        self.first = float(np.exp(-levels[0]))
        self.after = 1.0 / variances_of_q
        self.between = -phi * self.after
        self.before = phi**2 * self.after
        self.diagonal = np.r_[self.first, self.after] + np.r_[self.before, 0.0]
        self.log_determinant = float(levels[0] + np.log(variances_of_q).sum())

    def changed(self, change: FloatArray) -> Markov:
        """Return the group after a change (2,) of the levels."""
        return Markov(self.states, self._levels + change, self._intervals_s)

    def forces(self, values: FloatArray) -> FloatArray:
        """Return ``Pi values`` (N, k) of states (N, k)."""
        forces = self.diagonal[:, None] * values
        forces[1:] += self.between[:, None] * values[:-1]
        forces[:-1] += self.between[:, None] * values[1:]
        return forces

    def derivative_by_log_tau(self, values: FloatArray) -> FloatArray:
        """Derivative of states (N, k) with respect to log tau: ``dC f`` with C f = values.

        With C = Pi^-1, ``dC f = -C (dPi) values``. The numerical derivative of the precision is
        dPi.
        """
        change = np.array([0.0, LEVEL_CHANGE])
        forces = self.changed(change).forces(values) - self.changed(-change).forces(values)
        factor = Factor(self.diagonal[:, None, None], self.between[:, None, None])
        moved = factor.restore(factor.whiten(forces[:, None]))[:, 0]
        return np.asarray(moved / (-2.0 * LEVEL_CHANGE))


class Posterior:
    """States, parameters and likelihood of a state space at log levels.

    Parameters
    ----------
    space : StateSpace
    levels : (m,) array
        Logarithms of the variances of the white bases and of the walk bases; then of the variance
        and the time constant (s) of every group.

    Attributes
    ----------
    white_precision : (N, 6, 6) array
        Precisions of the white errors for weight 1.
    walk_covariance, walk_precision : (6, 6) arrays
        Of the walk over a typical increment.
    evidence : (n,) array
        Factors of ``walk_precision``; zero for increments that are no evidence.
    groups : list of Markov
    factor : Factor
        Of P. Its ``selected_inverse`` holds the covariances of the states for known parameters: of
        each pose (N, d, d), and between each pose and the pose before (n, d, d).
    log_determinant : float
        log|V| without the increments that are no evidence.
    whitened : (N, d, p + 1) array
        Y of the space's columns.
    products : (p + 1, p + 1) array
        ``[J e]' V^-1 [J e]`` and the prior.
    normal : NormalEquations
        Solution for all parameters.
    loss : float
        Negative restricted log likelihood without constants (Patterson, Thompson, Biometrika 58,
        1971).

    Raises
    ------
    numpy.linalg.LinAlgError
        If a matrix at these levels is not positive definite to rounding.
    """

    def __init__(self, space: StateSpace, levels: FloatArray) -> None:
        self.space = space
        self.levels = levels
        n_white = len(space.white_bases)
        is_free = space.weights == 0.0
        self.white_precision, white_log_determinants = space.white_precision(levels)
        self._white_precisions = space.weights[:, None, None] * self.white_precision
        # The logarithm of this determinant is zero.
        self._white_precisions[is_free] = np.eye(WHITE)
        self.walk_covariance = total_covariance(levels[n_white:], space.walk_bases)
        self.walk_precision = np.linalg.inv(self.walk_covariance)
        self.evidence = np.where(space.cut, 0.0, 1.0 / space.walk_factors)
        self._walk_precisions = self.evidence[:, None, None] * self.walk_precision
        self.groups = self._groups(n_white + len(space.walk_bases))
        self.factor = self._factorised()
        self.log_determinant = self._log_determinant(white_log_determinants[~is_free])
        weighted, self.whitened = self.forward_half(space.columns)
        products = multiplied(space.columns, weighted) - multiplied(self.whitened, self.whitened)
        self.products = 0.5 * (products + products.T) + space.prior
        self.normal = NormalEquations(self.products)
        determinants = self.log_determinant + self.normal.log_determinant
        self.loss = 0.5 * float(determinants + self.normal.cost)

    def _groups(self, first_level: int) -> list[Markov]:
        """Return the processes of each group, whose two levels begin at ``first_level``."""
        groups = []
        state = WHITE
        level = first_level
        for size in self.space.group_sizes:
            states = slice(state, state + size)
            groups.append(Markov(states, self.levels[level : level + 2], self.space.intervals_s))
            state += size
            level += 2
        return groups

    def _factorised(self) -> Factor:
        """Return the factor of P. The blocks of P, as large as the factor, are not stored."""
        diagonal, below = self._precision_blocks(0, len(self.space.cut))
        np.einsum("nii->ni", diagonal)[:] *= 1.0 + _RAISED
        return Factor(diagonal, below)

    def _log_determinant(self, white_log_determinants: FloatArray) -> float:
        """Return log|V| from the log determinants of P, Pi and W."""
        space = self.space
        weights = space.weights[space.weights != 0.0]
        of_pi = float((WHITE * np.log(weights) - white_log_determinants).sum())
        for group, size in zip(self.groups, space.group_sizes, strict=True):
            of_pi -= size * group.log_determinant
        evidence = space.walk_factors[~space.cut]
        of_walk = WHITE * np.log(evidence).sum()
        of_walk += len(evidence) * np.linalg.slogdet(self.walk_covariance)[1]
        return float(of_walk + self.factor.log_determinant - of_pi)

    def _precision_blocks(self, start: int, end: int) -> tuple[FloatArray, FloatArray]:
        """Blocks of P on the diagonal (m + 1, d, d) and below it (m, d, d).

        They belong to the m increments from pose ``start`` to pose ``end``. The precision of each
        pose's white error belongs to the increment before the pose, except that of the first pose,
        which belongs to the first increment.
        """
        space = self.space
        increments = slice(start, end)
        later = slice(1, None)
        ahead = space.ahead[increments]
        behind = space.behind[increments]
        W = self._walk_precisions[increments]
        n, _, size = behind.shape
        diagonal = np.zeros((n + 1, size, size))
        below = np.zeros((n, size, size))
        diagonal[later, :WHITE, :WHITE] = W
        W_H0 = np.matmul(W, behind, out=below[:, :WHITE])
        if self.groups:
            W_H1 = W @ ahead
            diagonal[later, :WHITE, WHITE:] = W_H1
            diagonal[later, WHITE:, :WHITE] = transposed(W_H1)
            diagonal[later, WHITE:, WHITE:] = transposed(ahead) @ W_H1
            below[:, WHITE:] = -(transposed(ahead) @ W_H0)
        diagonal[:-1] += transposed(behind) @ W_H0
        np.negative(W_H0, out=W_H0)
        diagonal[later, :WHITE, :WHITE] += self._white_precisions[start + 1 : end + 1]
        if start == 0:
            diagonal[0, :WHITE, :WHITE] += self._white_precisions[0]
        for group in self.groups:
            states = range(size)[group.states]
            below[:, states, states] += group.between[increments, None]
            diagonal[:-1, states, states] += group.before[increments, None]
            diagonal[later, states, states] += group.after[increments, None]
            if start == 0:
                diagonal[0, states, states] += group.first
        return diagonal, below

    def forward_half(self, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return W Z (n, 6, k) and Y (N, d, k) of columns Z (n, 6, k)."""
        weighted = self._walk_precisions @ columns
        return weighted, self.factor.whiten(self.space.apply_u_transposed(weighted))

    def states_after(self, step: FloatArray) -> FloatArray:
        """Return the expected states (N, d) after a step (p,) of the parameters."""
        mixing = np.r_[step, 1.0][:, None]
        return self.factor.restore(_mixed(self.whitened, mixing))[:, :, 0]

    def smoothed(self) -> tuple[FloatArray, FloatArray]:
        """Return states (N, d, 1 + p) and walk (n, 6, 1 + p), smoothed, for unknown parameters.

        The first column is the expected value. The squares of the other columns sum to the variance
        that the uncertainty of the parameters adds.
        """
        normal = self.normal
        size = len(normal.step)
        mixing = np.zeros((size + 1, size + 1))
        mixing[:-1, 0] = normal.step
        mixing[-1, 0] = 1.0
        mixing[:-1, 1:] = normal.root
        states = self.factor.restore(_mixed(self.whitened, mixing))
        walk = _mixed(self.space.columns, mixing) - self.space.apply_u(states)
        return states, walk

    def walk_covariances(self) -> FloatArray:
        """Return the covariances (n, 6, 6) of the smoothed walk for known parameters."""
        space = self.space
        covariances, below = self.factor.selected_inverse
        behind = space.behind
        half = space.apply_h1(covariances[1:])
        total = space.apply_h1(transposed(half)) + behind @ covariances[:-1] @ transposed(behind)
        mixed = space.apply_h1(below) @ transposed(behind)
        total -= mixed
        total -= transposed(mixed)
        return total

    def part_products(self) -> FloatArray:
        """Return the contribution of each part of the recording to the products.

        Solutions without a part would scatter more than the error does: without its increments the
        trajectory would be cut, although white noise keeps most knowledge across the gap. So
        each contribution is that of the innovations of a part after all parts before. Contributions
        are independent of each other if the model is right.

        Each part is a quadratic form of the states at its two ends and of the columns; all states
        between are eliminated. The forms are added in order of time. The prior of the parameters
        counts in equal shares.

        Returns
        -------
        (K, p + 1, p + 1) array
            K is at most 20.
        """
        n, _, n_columns = self.space.columns.shape
        size = self.space.behind.shape[2]
        ends = np.linspace(0, n, min(_N_PARTS, n) + 1).astype(int).tolist()
        history = np.zeros((size + n_columns, size + n_columns))
        totals = [np.zeros((n_columns, n_columns))]
        for start, end in pairwise(ends):
            form = self._form_between(start, end)
            start_and_columns = np.r_[np.arange(size), np.arange(2 * size, len(form))]
            form[np.ix_(start_and_columns, start_and_columns)] += history
            history = _eliminated(form, size)
            totals.append(_eliminated(history, size))
        return np.diff(np.array(totals), axis=0) + self.space.prior / (len(ends) - 1)

    def _form_between(self, start: int, end: int) -> FloatArray:
        """Quadratic form (2 d + k, 2 d + k) of the increments from pose ``start`` to pose ``end``.

        Its variables are the states at ``start``, the states at ``end`` and k columns. The states
        at ``start`` have no other evidence.
        """
        space = self.space
        increments = slice(start, end)
        columns_of_part = space.columns[increments]
        size = space.behind.shape[2]
        diagonal, below = self._precision_blocks(start, end)
        weighted = self._walk_precisions[increments] @ columns_of_part
        part_space = replace(space, ahead=space.ahead[increments], behind=space.behind[increments])
        forces = part_space.apply_u_transposed(weighted)
        corner = below[0] if len(diagonal) == 2 else np.zeros((size, size))
        products = multiplied(columns_of_part, weighted)
        form = np.block(
            [
                [diagonal[0], corner.T, forces[0]],
                [corner, diagonal[-1], forces[-1]],
                [forces[0].T, forces[-1].T, products],
            ]
        )
        if len(diagonal) == 2:
            return form
        couplings = np.zeros((len(diagonal) - 2, size, len(form)))
        couplings[:, :, 2 * size :] = forces[1:-1]
        couplings[0, :, :size] += below[0]
        couplings[-1, :, size : 2 * size] += below[-1].T
        whitened = Factor(diagonal[1:-1], below[1:-1]).whiten(couplings)
        return np.asarray(form - multiplied(whitened, whitened))


def _mixed(columns: FloatArray, mixing: FloatArray) -> FloatArray:
    """Combinations (n, d, l) of columns (n, d, k) by factors (k, l)."""
    n, size, _ = columns.shape
    return (columns.reshape(n * size, -1) @ mixing).reshape(n, size, -1)


def total_covariance(levels: FloatArray, bases: tuple[FloatArray, ...]) -> FloatArray:
    """Sum of ``exp(level) basis``; levels beyond the bases are ignored."""
    total = np.exp(levels[0]) * bases[0]
    for level, basis in zip(levels[1:], bases[1:], strict=False):
        total = total + np.exp(level) * basis
    return total


def _eliminated(form: FloatArray, size: int) -> FloatArray:
    """Quadratic form without its first variables, which take their best values."""
    root = np.linalg.solve(np.linalg.cholesky(form[:size, :size]), form[:size, size:])
    return np.asarray(form[size:, size:] - root.T @ root)
