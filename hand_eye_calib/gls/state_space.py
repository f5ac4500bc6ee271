"""Exact likelihood of increments under white errors, random walks and errors that last.

The increments of the common error c obey, see :mod:`~hand_eye_calib.gls.increments`,

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

import copy
import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray
from hand_eye_calib.gls import lapack
from hand_eye_calib.gls.block_tridiagonal import Factor, inverse_roots, squared, transposed
from hand_eye_calib.gls.chunks import chunks

WHITE = 6

# Precision (1/m^2, 1/rad^2) of poses that may be anywhere.
FREE = 1.0

# Diagonals are raised by this share, so that rounding cannot make them negative.
_ROUNDING = 1e-13


@dataclass(frozen=True)
class Group:
    """States that are independent Gauss-Markov processes with one variance and one time constant.

    Attributes
    ----------
    states : slice
        Of the latent state.
    variance, tau : int
        Where log variance and log time constant are among the levels.
    """

    states: slice
    variance: int
    tau: int

    @property
    def size(self) -> int:
        """Number of states."""
        return self.states.stop - self.states.start


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
    ahead, behind : (n, 6, d) arrays
        H1 and H0. H1 is the identity for the white error.
    white, walk : tuples of (1 or N, 6, 6) and (6, 6) arrays
        What log levels scale: the covariances are ``sum exp(level) basis``.
    twists : (N, 6) array
        v of one more basis v v' of each pose's white error.
    groups : tuple of Group
    weights : (N,) array
        Factors of the precision of each pose's white error; zero for poses that may be anywhere.
    cut : (n,) bool array
        Increments that are no evidence.
    """

    intervals_s: FloatArray
    relative: FloatArray
    columns: FloatArray
    ahead: FloatArray
    behind: FloatArray
    white: tuple[FloatArray, ...]
    walk: tuple[FloatArray, ...]
    twists: FloatArray
    groups: tuple[Group, ...]
    weights: FloatArray
    cut: BoolArray

    def __len__(self) -> int:
        return len(self.columns)

    @property
    def is_free(self) -> BoolArray:
        """(N,) whether each pose may be anywhere."""
        return self.weights == 0.0

    @property
    def n_states(self) -> int:
        """d."""
        return self.ahead.shape[2]

    @cached_property
    def slow_ahead(self) -> FloatArray | None:
        """H1 (n, 6, d - 6) of the states behind the white error; None if it is zero."""
        slow = self.ahead[:, :, WHITE:]
        return slow if slow.any() else None

    @property
    def n_white(self) -> int:
        """Number of levels of the white errors, the first ones."""
        return len(self.white) + 1

    def white_covariance(self, levels: FloatArray, part: slice = slice(None)) -> FloatArray:
        """Covariances (N, 6, 6) of the white errors, or of a part of them, at log levels, weights
        left out.
        """
        bases = tuple(basis if len(basis) == 1 else basis[part] for basis in self.white)
        twists = self.twists[part]
        along = np.exp(levels[len(bases)]) * twists
        return _combined(levels, bases) + along[:, :, None] * twists[:, None, :]

    def white_precision(self, levels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Inverses (N, 6, 6) of :meth:`white_covariance`, logarithms (N,) of its determinants.

        With ``S S' = (sum exp(level) basis)^-1``, ``z = S' v`` and the variance j along v the
        inverse is R'R, ``R = (I - a z z') S'``, ``a = (1 - (1 + j z'z)^-1/2) / z'z``: unlike a
        difference, never indefinite.
        """
        roots, log_determinants = inverse_roots(_combined(levels, self.white))
        along = roots @ self.twists[:, :, None]
        squares = (along**2).sum(axis=1, keepdims=True)
        grown = np.log1p(np.exp(levels[len(self.white)]) * squares)
        share = -np.expm1(-0.5 * grown) / np.where(squares > 0.0, squares, 1.0)
        roots = roots - share * along @ (transposed(along) @ roots)
        return squared(roots), log_determinants + grown[:, 0, 0]

    def walk_covariance(self, levels: FloatArray) -> FloatArray:
        """Covariance (6, 6) of the walk over a typical increment."""
        return _combined(levels[self.n_white :], self.walk)

    def observed(self, states: FloatArray, part: slice = slice(None)) -> FloatArray:
        """What states (N, d, k) contribute to the increments, or to a part of them, (n, 6, k)."""
        observed = self.behind[part] @ states[:-1][part]
        return np.subtract(self.ahead_times(states[1:][part], part), observed, out=observed)

    def ahead_times(self, blocks: FloatArray, part: slice = slice(None)) -> FloatArray:
        """H1 of the increments, or of a part of them, times blocks (n, d, k): (n, 6, k)."""
        if self.slow_ahead is None:
            return blocks[:, :WHITE]
        return blocks[:, :WHITE] + self.slow_ahead[part] @ blocks[:, WHITE:]

    def gathered(self, columns: FloatArray, start: int = 0) -> FloatArray:
        """The transpose of :meth:`observed`: (N, d, k) of columns (n, 6, k); or of those of n
        increments from one on.
        """
        states = np.empty((len(columns) + 1, self.n_states, columns.shape[2]))
        states[0] = 0.0
        for part in chunks(len(columns)):
            own = slice(start + part.start, start + part.stop)
            ahead = states[1:][part]
            ahead[:, :WHITE], ahead[:, WHITE:] = columns[part], 0.0
            if self.slow_ahead is not None:
                slow = transposed(self.slow_ahead[own])
                np.matmul(slow, columns[part], out=ahead[:, WHITE:])
            states[:-1][part] -= transposed(self.behind[own]) @ columns[part]
        return states


class Covariance:
    """V of all increments of a state space, at log levels."""

    def __init__(self, space: StateSpace, levels: FloatArray) -> None:
        self._space = space
        self._white = space.white_covariance(levels) / space.weights[:, None, None]
        self._walk = space.relative[:, None, None] * space.walk_covariance(levels)
        self._markov = [markov(group, levels, space.intervals_s) for group in space.groups]

    def products(self, columns: FloatArray) -> FloatArray:
        """(k, k) array: products of columns (n, 6, k), weighed with V."""
        forces = self._space.gathered(columns)
        white = np.ascontiguousarray(forces[:, :WHITE])
        products = multiplied(columns, self._walk @ columns)
        products += multiplied(white, self._white @ white)
        for process in self._markov:
            of_group = forces[:, process.group.states].reshape(len(forces), -1)
            moved = process.variance * process.covariance_times(of_group)
            shape = (len(forces), process.group.size, -1)
            products += multiplied(of_group.reshape(shape), moved.reshape(shape))
        return products


@dataclass(frozen=True)
class Markov:
    """A group at given levels: ``dt_i / tau``, phi_i and the innovations' relative variances
    ``1 - phi_i^2``.
    """

    group: Group
    variance: float
    ratio: FloatArray
    phi: FloatArray
    rest: FloatArray

    def tridiagonal(self) -> tuple[FloatArray, FloatArray]:
        """Diagonal (N,) and element beside it (n,) of the precision for unit variance."""
        inverse = 1.0 / self.rest
        diagonal = np.empty(len(inverse) + 1)
        diagonal[0] = 1.0
        diagonal[1:] = inverse
        diagonal[:-1] += self.phi**2 * inverse
        return diagonal, -self.phi * inverse

    def covariance_times(self, columns: FloatArray) -> FloatArray:
        """The covariance for unit variance times columns (N, k)."""
        pivots, multipliers, _ = lapack.dpttrf(*self.tridiagonal())
        return lapack.dpttrs(pivots, multipliers, columns)[0]


def markov(group: Group, levels: FloatArray, intervals_s: FloatArray) -> Markov:
    """A group's process at given log levels."""
    ratio = intervals_s / np.exp(levels[group.tau])
    variance = float(np.exp(levels[group.variance]))
    return Markov(group, variance, ratio, np.exp(-ratio), -np.expm1(-2.0 * ratio))


class Posterior:
    """States and likelihood of a state space at given log levels.

    Parameters
    ----------
    space : StateSpace
    levels : (m,) array
        Logarithms: variances of the white bases, along v and of the walk bases, then variance and
        time constant (s) of every group.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the levels make a matrix that is not positive definite to rounding.
    """

    def __init__(self, space: StateSpace, levels: FloatArray) -> None:
        self.space, self.levels = space, levels
        self.white_precision, self._white_log_determinants = space.white_precision(levels)
        walk = space.walk_covariance(levels)
        self.walk_precision = np.linalg.inv(walk)
        self._walk_log_determinant = np.linalg.slogdet(walk)[1]
        self.evidence = np.where(space.cut, 0.0, 1.0 / space.relative)
        self._weights = self.evidence[:, None, None] * self.walk_precision
        self.markov = [markov(group, levels, space.intervals_s) for group in space.groups]
        self.factor = Factor(*self.precision())

    def precision(self) -> tuple[FloatArray, FloatArray]:
        """Blocks of P on the diagonal (N, d, d) and below it (n, d, d)."""
        space, size = self.space, self.space.n_states
        diagonal = np.zeros((len(space) + 1, size, size))
        below = np.zeros((len(space), size, size))
        diagonal[1:, :WHITE, :WHITE] = self._weights
        for part in chunks(len(space)):
            behind = space.behind[part]
            weighed = self._weights[part] @ behind
            np.negative(weighed, out=below[part, :WHITE])
            self._add_slow(diagonal[1:][part], below[part], weighed, part)
            diagonal[:-1][part] += transposed(behind) @ weighed
        white = space.weights[:, None, None] * self.white_precision
        white[space.is_free] = FREE * np.eye(WHITE)
        diagonal[:, :WHITE, :WHITE] += white
        for process in self.markov:
            own, beside = process.tridiagonal()
            states = range(process.group.states.start, process.group.states.stop)
            diagonal[:, states, states] += (own / process.variance)[:, None]
            below[:, states, states] += (beside / process.variance)[:, None]
        diagonal[:, range(size), range(size)] *= 1.0 + _ROUNDING
        return diagonal, below

    def _add_slow(
        self, diagonal: FloatArray, below: FloatArray, weighed: FloatArray, part: slice
    ) -> None:
        """Fill in the blocks of the slow states of the poses ahead; ``weighed`` is W H0."""
        if (slow := self.space.slow_ahead) is None:
            return
        beside = self._weights[part] @ slow[part]
        diagonal[:, :WHITE, WHITE:], diagonal[:, WHITE:, :WHITE] = beside, transposed(beside)
        diagonal[:, WHITE:, WHITE:] = transposed(slow[part]) @ beside
        below[:, WHITE:] = transposed(slow[part]) @ np.negative(weighed)

    def weighed(self, columns: FloatArray, part: slice = slice(None)) -> FloatArray:
        """W times columns (n, 6, k) of the increments, or of a part of them."""
        return self._weights[part] @ columns

    @cached_property
    def log_determinant(self) -> float:
        """log|V|, increments that are no evidence left out."""
        space = self.space
        n_poses, kept, given = len(space) + 1, ~space.cut, ~space.is_free
        white = WHITE * np.log(np.where(given, space.weights, 1.0)) - self._white_log_determinants
        prior = float(white[given].sum()) + WHITE * np.log(FREE) * int((~given).sum())
        for process in self.markov:
            of_one = n_poses * np.log(process.variance) + np.log(process.rest).sum()
            prior -= process.group.size * of_one
        walk = kept.sum() * self._walk_log_determinant + 6 * np.log(space.relative[kept]).sum()
        return float(walk + self.factor.log_determinant() - prior)

    def halves(self, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """W Z and Y, (n, 6, k) and (N, d, k), of columns Z (n, 6, k)."""
        weighed = self.weighed(columns)
        return weighed, self.factor.whiten(self.space.gathered(weighed))

    @cached_property
    def _halves(self) -> tuple[FloatArray, FloatArray]:
        """``Z' W Z`` (p + 1, p + 1) and Y of the space's columns."""
        weighed, whitened = self.halves(self.space.columns)
        return multiplied(self.space.columns, weighed), whitened

    @property
    def whitened(self) -> FloatArray:
        """Y (N, d, p + 1) of the space's columns."""
        return self._halves[1]

    @cached_property
    def products(self) -> FloatArray:
        """(p + 1, p + 1) array: products of J and, last, e, weighed with V^-1."""
        products = self._halves[0] - multiplied(self.whitened, self.whitened)
        return 0.5 * (products + products.T)

    @cached_property
    def normal(self) -> NormalEquations:
        """Solution for all parameters."""
        return NormalEquations(self.products)

    @cached_property
    def loss(self) -> float:
        """Negative restricted log likelihood, constants left out (Patterson, Thompson, Biometrika
        58, 1971).
        """
        return 0.5 * (self.log_determinant + self.normal.cost + self.normal.log_determinant)

    @cached_property
    def selected_inverse(self) -> tuple[FloatArray, FloatArray]:
        """Covariances of the states for known parameters: of each pose's (N, d, d), and between
        each pose's and the one's before (n, d, d).
        """
        return self.factor.selected_inverse()

    def with_columns(self, columns: FloatArray) -> Posterior:
        """The posterior of the same increments with other columns (n, 6, k)."""
        return self._with(dataclasses.replace(self.space, columns=columns))

    def with_weights(self, weights: FloatArray) -> Posterior:
        """The posterior at other weights (N,) of the white errors."""
        other = self._with(dataclasses.replace(self.space, weights=weights))
        other.__dict__.pop("log_determinant", None)
        other.factor = Factor(*other.precision())
        return other

    def _with(self, space: StateSpace) -> Posterior:
        """A copy for another space, without what depends on its columns or is large."""
        other = copy.copy(self)
        other.space = space
        for name in ("_halves", "products", "normal", "loss", "selected_inverse"):
            other.__dict__.pop(name, None)
        return other

    def states_after(self, step: FloatArray, columns: list[int] | None = None) -> FloatArray:
        """States (N, d) expected after a step of the parameters, or of some of them."""
        mixing = np.zeros((self.whitened.shape[2], 1))
        mixing[slice(-1) if columns is None else columns, 0] = step
        mixing[-1] = 1.0
        return self.factor.restore(_mixed(self.whitened, mixing))[:, :, 0]

    def restricted(self) -> FloatArray:
        """States (N, d, 1 + q): expected values and, behind them, what the parameters' uncertainty
        adds, as columns whose squares sum to it.
        """
        return self.factor.restore(_mixed(self.whitened, self.normal.mixing))

    def restricted_walk(self, states: FloatArray, part: slice = slice(None)) -> FloatArray:
        """The same of the walk, or of a part of it, (n, 6, 1 + q), from all states."""
        mixed = _mixed(self.space.columns[part], self.normal.mixing)
        mixed -= self.space.observed(states, part)
        return mixed


# Information below this share of what a parameter's own diagonal promises is rounding; no diagonal
# counts as smaller than the latter.
_RANK_TOLERANCE, _LEAST_INFORMATION = 1e-12, float(np.finfo(float).tiny)


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
        self._costs = products[..., -1, -1] + (gradient * self.step).sum(axis=-1)
        self._log_determinants = np.log(values).sum(axis=-1) - 2.0 * np.log(scale).sum(axis=-1)

    @property
    def cost(self) -> float:
        """Weighted squared residual of one system after the step."""
        return float(self._costs)

    @property
    def log_determinant(self) -> float:
        """Of the information of one system."""
        return float(self._log_determinants)

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


def _mixed(columns: FloatArray, mixing: FloatArray) -> FloatArray:
    """Combinations (n, d, l) of columns (n, d, k)."""
    n, size, _ = columns.shape
    return (columns.reshape(n * size, -1) @ mixing).reshape(n, size, -1)


def _combined(levels: FloatArray, bases: tuple[FloatArray, ...]) -> FloatArray:
    """Sum of bases, each times the exponential of its level."""
    total = np.exp(levels[0]) * bases[0]
    for level, basis in zip(levels[1:], bases[1:], strict=False):
        total = total + np.exp(level) * basis
    return total
