"""Exact likelihood of increments under white errors, a random walk and time-correlated errors.

The symbols are those of :mod:`hand_eye_calib.core.noise`. The state x_i of pose i consists of its
white error v_i and of all processes g_ik, with ``phi_ik = exp(-dt_i / tau_k)``. In terms of states,

    e_i + J_i beta = H1_i x_{i+1} - H0_i x_i + w_i,      for all increments: e + J beta = U x + w

    H1_i = [I, M_{i+1}],      H0_i = Ad(B_i^-1) [I, M_i]

In terms of a Kalman filter, w is the noise of the measurement ``e + J beta``: no state contains the
walk. The white error v and the noise q of the processes are the process noise.

A process that is an error of the path (a drifting scale or direction) acts on the increment itself.
Its columns are 0 in H1_i, and minus the derivative of e_i in H0_i.

Pi is the prior precision of all states, W the precision of w, and V the covariance of ``e + J
beta``. The posterior precision Lambda of the states is block tridiagonal. For any matrix Z with as
many rows as e,

    Lambda = Pi + U' W U
    log|V| = log|Lambda| - log|Pi| - log|W|
    V^-1 Z = W (Z - U Lambda^-1 U' W Z)

One factorisation ``Lambda = L L'`` yields the likelihood in time linear in the number of poses.
Products need only the first triangular solution: ``Z' V^-1 Z = Z' W Z - Y' Y`` with
``Y = L^-1 U' W Z``. The posterior is that of the Kalman smoother (Rauch, Tung, Striebel, AIAA J. 3,
1965).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.noise.normal import (
    Factor,
    NormalEquations,
    gram,
    inverse_roots,
    multiplied,
    transposed,
)

# Number of states for the white error of a pose: three of translation, three of rotation.
WHITE = 6

# Relative increase of the diagonal of Lambda. Rounding could otherwise make Lambda indefinite.
_DIAGONAL_INCREASE = 1e-13

# Largest number of blocks of time for the jackknife.
MAX_BLOCKS = 20


@dataclass(frozen=True, kw_only=True)
class StateSpace:
    """Linear state space: N poses, n = N - 1 increments, d states per pose, p parameters.

    Attributes
    ----------
    intervals_s : (n,) array
        Durations of the increments.
    walk_factors : (n,) array
        Variance of the walk over each increment, divided by its variance over a typical increment.
    columns : (n, 6, p + 1) array
        ``[J e]``: derivatives with respect to the parameters beta, then the residuals.
    h1_processes : (n, 6, d - 6) array
        Columns of H1 for the processes. The first six columns of H1 are the identity.
    h0 : (n, 6, d) array
        Matrices H0.
    white_bases : tuple of (1 or N, 6, 6) arrays
        The covariance of a white error is ``sum exp(level) basis``, with one level per basis.
    walk_bases : tuple of (6, 6) arrays
        The covariance of the walk over a typical increment is a sum of the same form.
    group_sizes : tuple of int
        Number of processes in each group. The processes of a group are independent, with a common
        variance and time constant. In a state, the groups follow the white error in this order.
    weights : (N,) array
        Factor of the precision of each white error. Outlier poses have the factor zero; their
        precision is the identity instead (a prior of 1 m and 1 rad, in effect none).
    cut : (n,) bool array
        Increments without information: jumps, and in a sample of the poses also increments over too
        many omitted poses.
    prior : (p + 1, p + 1) array
        Prior of the parameters, as products that are added to ``[J e]' V^-1 [J e]``.
    """

    intervals_s: FloatArray
    walk_factors: FloatArray
    columns: FloatArray
    h1_processes: FloatArray
    h0: FloatArray
    white_bases: tuple[FloatArray, ...]
    walk_bases: tuple[FloatArray, ...]
    group_sizes: tuple[int, ...]
    weights: FloatArray
    cut: BoolArray
    prior: FloatArray

    def white_precision(
        self, levels: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Invert the covariances of the white errors; the weights of the poses are left out.

        Returns
        -------
        (N, 6, 6) array
            Precisions.
        (N,) array
            Logarithms of the determinants of the covariances.
        """
        roots, log_determinants = inverse_roots(
            total_covariance(levels, self.white_bases)
        )
        return gram(roots), log_determinants

    def apply_u(self, states: FloatArray) -> FloatArray:
        """Return ``U x`` (n, 6, k) for k columns of states (N, d, k)."""
        product = self.h0 @ states[:-1]
        return np.subtract(self.apply_h1(states[1:]), product, out=product)

    def apply_h1(self, blocks: FloatArray) -> FloatArray:
        """Return the products (n, 6, k) of H1_i with blocks (n, d, k)."""
        white = blocks[:, :WHITE]
        if not self.group_sizes:
            return white
        return white + self.h1_processes @ blocks[:, WHITE:]

    def apply_u_transposed(self, columns: FloatArray) -> FloatArray:
        """Return the product (N, d, k) of U' with columns (n, 6, k)."""
        states = np.empty(
            (len(columns) + 1, self.h0.shape[2], columns.shape[2])
        )
        np.matmul(-transposed(self.h0), columns, out=states[:-1])
        states[-1] = 0.0
        states[1:, :WHITE] += columns
        if self.group_sizes:
            states[1:, WHITE:] += transposed(self.h1_processes) @ columns
        return states


class Markov:
    """Group of independent Gauss-Markov processes with a common variance and time constant.

    In this class, Pi is the prior precision (N, N) of one process at all poses. It is tridiagonal.

    Parameters
    ----------
    states : slice
        Indices of the processes of this group in the state of a pose.
    levels : (2,) array
        Logarithms of the stationary variance and of the time constant (s).
    intervals_s : (n,) array

    Attributes
    ----------
    first : float
        Precision of the value at the first pose: the inverse of the stationary variance.
    after, between, before : (n,) arrays
        Contributions of each increment to Pi: to the diagonal element of its last pose, to the
        element below the diagonal, and to the diagonal element of its first pose.
    diagonal : (N,) array
        Diagonal of Pi. The elements below the diagonal are ``between``.
    log_determinant : float
        Log determinant of the covariance of one process: -log|Pi|.
    """

    def __init__(
        self, states: slice, levels: FloatArray, intervals_s: FloatArray
    ) -> None:
        self.states = states
        self._ratios = intervals_s / np.exp(levels[1])
        self._phi = np.exp(-self._ratios)
        stationary = np.exp(levels[0])
        # Variances of the first value, and of each step q, relative to the stationary variance.
        self._q_shares = -np.expm1(-2.0 * self._ratios)
        self._variances = np.append(stationary, stationary * self._q_shares)
        self.first = float(1.0 / stationary)
        self.after = 1.0 / self._variances[1:]
        self.between = -self._phi * self.after
        self.before = self._phi**2 * self.after
        self.diagonal = np.append(self.first, self.after) + np.append(
            self.before, 0.0
        )
        self.log_determinant = float(np.log(self._variances).sum())

    def by_log_tau(self) -> tuple[FloatArray, FloatArray, float]:
        """Return derivatives with respect to the logarithm of the time constant.

        Returns
        -------
        (N,) array
            Derivative of ``diagonal``.
        (n,) array
            Derivative of ``between``.
        float
            Derivative of ``log_determinant``.
        """
        ratios = self._ratios
        # Derivative of the logarithm of the precision of q.
        relative = 2.0 * ratios * self._phi**2 / self._q_shares
        diagonal = np.append(0.0, relative * self.after)
        diagonal[:-1] += (2.0 * ratios + relative) * self.before
        between = (ratios + relative) * self.between
        return diagonal, between, -float(relative.sum())

    def covariance_by_log_tau(self, values: FloatArray) -> FloatArray:
        """Return ``(d Pi^-1 / d log tau) Pi values`` (N, k) for the values (N, k) of k processes.

        It equals ``-Pi^-1 (d Pi / d log tau) values``. Pi is ``L' Q^-1 L`` with the variances Q and
        ``(L g)_{i+1} = g_{i+1} - phi_i g_i``.
        """
        diagonal, between, _ = self.by_log_tau()
        forces = diagonal[:, None] * values
        forces[1:] += between[:, None] * values[:-1]
        forces[:-1] += between[:, None] * values[1:]
        backward = decaying_sum(forces[::-1], self._phi[::-1])[::-1]
        return decaying_sum(-self._variances[:, None] * backward, self._phi)


def decaying_sum(values: FloatArray, phi: FloatArray) -> FloatArray:
    """Return x (N, k) with ``x_{i+1} = values_{i+1} + phi_i x_i`` and ``x_0 = values_0``.

    The sum over a window doubles its length in each round, so that numpy needs few operations.
    """
    sums = values.copy()
    factors = np.append(0.0, phi)[:, None]
    length = 1
    while length < len(sums):
        sums[length:] += factors[length:] * sums[:-length]
        factors[length:] *= factors[:-length]
        length *= 2
    return sums


class Posterior:
    """Posterior of states and parameters at given levels, and the likelihood of these levels.

    Parameters
    ----------
    space : StateSpace
    levels : (m,) array
        Log variances of the white bases and of the walk bases; then log variance and log time
        constant (s) of each group.

    Attributes
    ----------
    white_precision : (N, 6, 6) array
        Precisions of the white errors, without the weights of poses.
    walk_covariance, walk_precision : (6, 6) arrays
        Covariance of the walk over a typical increment, and its inverse.
    walk_weights : (n,) array
        The precision W of increment i is ``walk_weights[i] walk_precision``; zero for increments
        without information.
    groups : list of Markov

    Raises
    ------
    numpy.linalg.LinAlgError
        If a matrix at these levels is not positive definite up to rounding.
    """

    def __init__(self, space: StateSpace, levels: FloatArray) -> None:
        self.space = space
        self.levels = levels
        n_white = len(space.white_bases)
        is_outlier = space.weights == 0.0
        self.white_precision, self._white_log_determinants = (
            space.white_precision(levels)
        )
        self._white_precisions = (
            space.weights[:, None, None] * self.white_precision
        )
        # The identity instead of zeros keeps Pi invertible. Its log determinant is zero.
        self._white_precisions[is_outlier] = np.eye(WHITE)
        self.walk_covariance = total_covariance(
            levels[n_white:], space.walk_bases
        )
        self.walk_precision = np.linalg.inv(self.walk_covariance)
        self.walk_weights = np.where(space.cut, 0.0, 1.0 / space.walk_factors)
        self._walk_precisions = (
            self.walk_weights[:, None, None] * self.walk_precision
        )
        self.groups = self._groups(n_white + len(space.walk_bases))

    def _groups(self, first_level: int) -> list[Markov]:
        """Return all groups of processes. ``first_level`` is the index of their first level."""
        groups = []
        state = WHITE
        level = first_level
        for size in self.space.group_sizes:
            states = slice(state, state + size)
            groups.append(
                Markov(
                    states,
                    self.levels[level : level + 2],
                    self.space.intervals_s,
                )
            )
            state += size
            level += 2
        return groups

    @cached_property
    def factor(self) -> Factor:
        """Cholesky factor L of Lambda."""
        # The blocks of Lambda are as large as the factor. They are local and so are released.
        diagonal, below = self._precision_blocks(0, len(self.space.cut))
        np.einsum("nii->ni", diagonal)[:] *= 1.0 + _DIAGONAL_INCREASE
        return Factor(diagonal, below)

    @cached_property
    def log_determinant(self) -> float:
        """log|V|, from the log determinants of Lambda, Pi and W."""
        space = self.space
        is_weighted = space.weights != 0.0
        weights = space.weights[is_weighted]
        of_pi = (
            WHITE * np.log(weights) - self._white_log_determinants[is_weighted]
        )
        log_pi = float(of_pi.sum())
        for group, size in zip(self.groups, space.group_sizes, strict=True):
            log_pi -= size * group.log_determinant
        walk_factors = space.walk_factors[~space.cut]
        of_walk = WHITE * np.log(walk_factors).sum()
        of_walk += (
            len(walk_factors) * np.linalg.slogdet(self.walk_covariance)[1]
        )
        return float(of_walk + self.factor.log_determinant - log_pi)

    @cached_property
    def _whitened_and_products(self) -> tuple[FloatArray, FloatArray]:
        """``whitened`` and ``products``."""
        columns = self.space.columns
        weighted, whitened = self.forward_half(columns)
        products = multiplied(columns, weighted) - multiplied(
            whitened, whitened
        )
        return whitened, 0.5 * (products + products.T) + self.space.prior

    @property
    def whitened(self) -> FloatArray:
        """Y (N, d, p + 1) of Z = [J e]. Its blocks are in order of elimination, not of poses."""
        return self._whitened_and_products[0]

    @property
    def products(self) -> FloatArray:
        """``[J e]' V^-1 [J e]`` (p + 1, p + 1), plus the prior of the parameters."""
        return self._whitened_and_products[1]

    @cached_property
    def normal(self) -> NormalEquations:
        """Generalised least squares solution for the parameters beta."""
        return NormalEquations(self.products)

    @property
    def loss(self) -> float:
        """Negative restricted log likelihood without constants.

        Patterson, Thompson, Biometrika 58, 1971.
        """
        determinants = self.log_determinant + self.normal.log_determinant
        return 0.5 * float(determinants + self.normal.cost)

    def _precision_blocks(
        self, start: int, end: int
    ) -> tuple[FloatArray, FloatArray]:
        """Return the contribution to Lambda of m increments, from pose ``start`` to pose ``end``.

        The blocks on the diagonal are (m + 1, d, d), the blocks below it (m, d, d). The prior
        precision of a pose belongs to the increment before the pose; that of the very first pose
        belongs to the first increment.
        """
        space = self.space
        increments = slice(start, end)
        later = slice(1, None)
        h1_processes = space.h1_processes[increments]
        h0 = space.h0[increments]
        W = self._walk_precisions[increments]
        n, _, size = h0.shape
        diagonal = np.zeros((n + 1, size, size))
        below = np.zeros((n, size, size))
        diagonal[later, :WHITE, :WHITE] = W
        W_H0 = np.matmul(W, h0, out=below[:, :WHITE])
        if self.groups:
            W_H1 = W @ h1_processes
            diagonal[later, :WHITE, WHITE:] = W_H1
            diagonal[later, WHITE:, :WHITE] = transposed(W_H1)
            diagonal[later, WHITE:, WHITE:] = transposed(h1_processes) @ W_H1
            below[:, WHITE:] = -(transposed(h1_processes) @ W_H0)
        diagonal[:-1] += transposed(h0) @ W_H0
        np.negative(W_H0, out=W_H0)
        precisions = self._white_precisions[start + 1 : end + 1]
        diagonal[later, :WHITE, :WHITE] += precisions
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

    def forward_half(
        self, columns: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return W Z (n, 6, k) and Y = L^-1 U' W Z (N, d, k) for columns Z (n, 6, k).

        The blocks of Y are in order of elimination, see :class:`Factor`. They do not belong to
        poses.
        """
        weighted = self._walk_precisions @ columns
        return weighted, self.factor.whiten(
            self.space.apply_u_transposed(weighted)
        )

    def parts(self) -> Iterator[Posterior]:
        """Return the parts of a long recording. Here the whole recording is a single part."""
        yield self

    def states_after(self, step: FloatArray) -> FloatArray:
        """Return the posterior mean (N, d) of the states after a step (p,) of the parameters."""
        mixing = np.r_[step, 1.0][:, None]
        return self.factor.restore(combined(self.whitened, mixing))[:, :, 0]

    def smoothed(self) -> tuple[FloatArray, FloatArray]:
        """Return the smoothed states (N, d, 1 + p) and walk (n, 6, 1 + p).

        The first column is the posterior mean. The sum of the outer products of the other columns
        is the covariance that the uncertainty of the parameters adds.
        """
        normal = self.normal
        size = len(normal.step)
        mixing = np.zeros((size + 1, size + 1))
        mixing[:-1, 0] = normal.step
        mixing[-1, 0] = 1.0
        mixing[:-1, 1:] = normal.root
        states = self.factor.restore(combined(self.whitened, mixing))
        walk = combined(self.space.columns, mixing) - self.space.apply_u(states)
        return states, walk

    def walk_covariances(self) -> FloatArray:
        """Return the covariances (n, 6, 6) of the smoothed walk for known parameters."""
        space = self.space
        covariances, below = self.factor.selected_inverse
        h0 = space.h0
        half = space.apply_h1(covariances[1:])
        at_start = h0 @ covariances[:-1] @ transposed(h0)
        total = space.apply_h1(transposed(half)) + at_start
        mixed = space.apply_h1(below) @ transposed(h0)
        total -= mixed
        total -= transposed(mixed)
        return total

    def part_products(self, n_blocks: int = MAX_BLOCKS) -> FloatArray:
        """Return the contribution of each block of time to ``products``, for the jackknife.

        A contribution consists of the innovations of a block, predicted from all earlier blocks. If
        the model is right, the contributions are independent. A jackknife that only drops the
        increments of a block would overestimate the error: it would cut the trajectory, although
        the white noise of the poses transports most information across the gap.

        The sum of the contributions of all blocks until an instant is ``[J e]' V^-1 [J e]`` of the
        data until this instant. A contribution is the increase of this sum during a block. The sum
        needs only the data as a quadratic form of the present state and of the columns [J e]: its
        minimum over the state is the sum. Each block extends this form by its own form between the
        states at both of its ends. Each contribution contains an equal share of the prior of the
        parameters.

        Returns
        -------
        (K, p + 1, p + 1) array
            There are K <= ``n_blocks`` contributions. Their sum is ``products``.
        """
        n, _, n_columns = self.space.columns.shape
        n_states = self.space.h0.shape[2]
        ends = np.linspace(0, n, min(n_blocks, n) + 1).astype(int).tolist()
        # All data until the end of the last block, as a quadratic form of the state at this end and
        # of the columns.
        history = np.zeros((n_states + n_columns, n_states + n_columns))
        # Sums until the end of each block.
        totals = [np.zeros((n_columns, n_columns))]
        for start, end in pairwise(ends):
            form = self._form_between(start, end)
            start_and_columns = np.r_[
                np.arange(n_states), np.arange(2 * n_states, len(form))
            ]
            form[np.ix_(start_and_columns, start_and_columns)] += history
            history = _eliminate(form, n_states)
            totals.append(_eliminate(history, n_states))
        return np.diff(np.array(totals), axis=0) + self.space.prior / (
            len(ends) - 1
        )

    def _form_between(self, start: int, end: int) -> FloatArray:
        """Return the quadratic form of the increments from pose ``start`` to pose ``end``.

        The form is a symmetric matrix (2 d + p + 1, 2 d + p + 1). Its rows belong to the state at
        ``start``, the state at ``end``, and the columns [J e]. The states between were eliminated.
        Increments before ``start`` are not included.
        """
        space = self.space
        increments = slice(start, end)
        columns = space.columns[increments]
        size = space.h0.shape[2]
        diagonal, below = self._precision_blocks(start, end)
        weighted = self._walk_precisions[increments] @ columns
        block = replace(
            space,
            h1_processes=space.h1_processes[increments],
            h0=space.h0[increments],
        )
        forces = block.apply_u_transposed(weighted)
        coupling = below[0] if len(diagonal) == 2 else np.zeros((size, size))
        products = multiplied(columns, weighted)
        form = np.block(
            [
                [diagonal[0], coupling.T, forces[0]],
                [coupling, diagonal[-1], forces[-1]],
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
        return form - multiplied(whitened, whitened)


def combined(columns: FloatArray, mixing: FloatArray) -> FloatArray:
    """Return the linear combinations (n, d, l) of columns (n, d, k) with factors (k, l)."""
    n, size, _ = columns.shape
    return (columns.reshape(n * size, -1) @ mixing).reshape(n, size, -1)


def total_covariance(
    levels: FloatArray, bases: tuple[FloatArray, ...]
) -> FloatArray:
    """Return the sum of ``exp(level) basis`` over all bases. Surplus levels are ignored."""
    total = np.exp(levels[0]) * bases[0]
    for level, basis in zip(levels[1:], bases[1:], strict=False):
        total = total + np.exp(level) * basis
    return total


def _eliminate(form: FloatArray, size: int) -> FloatArray:
    """Minimise a quadratic form over its first ``size`` variables; return the rest of the form."""
    root = np.linalg.solve(
        np.linalg.cholesky(form[:size, :size]), form[:size, size:]
    )
    return form[size:, size:] - root.T @ root
