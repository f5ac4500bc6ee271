"""Compare the likelihood of the noise model with its definition by dense matrices."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from hand_eye_calib.core.base.blocks import Blocks
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.noise import partwise, reml
from hand_eye_calib.core.noise.normal import Factor, NormalEquations
from hand_eye_calib.core.noise.outliers import (
    chi_squares,
    leave_one_out_chi_squares,
)
from hand_eye_calib.core.noise.partwise import PartwisePosterior
from hand_eye_calib.core.noise.state_space import Posterior, StateSpace

N_POSES = 15
N_STATES = 16
N_PARAMETERS = 7
N_LEVELS = 5 + 2 * 4
SIZES = (3, 3, 3, 1)


def space_of(seed=1, cut=(4,)):
    """Return a state space of random numbers: three groups of three processes, and a scale."""
    random = np.random.default_rng(seed)
    n = N_POSES - 1
    intervals_s = random.uniform(0.05, 0.3, n)
    adjoints = np.eye(6) + 0.2 * random.standard_normal((n, 6, 6))
    directions = random.standard_normal((N_POSES, 6, 9))
    directions[:, :, :3] = np.eye(6)[:, :3]
    h1_processes = np.zeros((n, 6, N_STATES - 6))
    h0 = np.zeros((n, 6, N_STATES))
    h0[:, :, :6] = adjoints
    h1_processes[:, :, :9] = directions[1:]
    h0[:, :, 6:15] = adjoints @ directions[:-1]
    h0[:, :, 15] = random.standard_normal((n, 6))
    lever = random.standard_normal((3, 6))
    twists = random.standard_normal((N_POSES, 6))
    bases = (
        np.diag([1.0, 1, 1, 0, 0, 0]),
        np.diag([0, 0, 0, 1.0, 1, 1]) + lever.T @ lever,
    )
    flags = np.zeros(n, dtype=bool)
    flags[list(cut)] = True
    residuals = random.standard_normal((n, 6, 1))
    columns = np.concatenate(
        [random.standard_normal((n, 6, N_PARAMETERS)), residuals], axis=2
    )
    return StateSpace(
        intervals_s=intervals_s,
        walk_factors=intervals_s / 0.1,
        columns=columns,
        h1_processes=h1_processes,
        h0=h0,
        white_bases=(
            bases[0][None],
            bases[1][None],
            twists[:, :, None] * twists[:, None],
        ),
        walk_bases=bases,
        group_sizes=SIZES,
        weights=random.uniform(0.3, 2.0, N_POSES),
        cut=flags,
        prior=np.zeros((N_PARAMETERS + 1, N_PARAMETERS + 1)),
    )


def parameters_and_residuals(space, rows=slice(None)):
    """Return J and e, of all rows or of some."""
    columns = space.columns.reshape(-1, N_PARAMETERS + 1)
    chosen = columns[rows]
    J = chosen[:, :-1]
    e = chosen[:, -1]
    return J, e


LEVELS = np.random.default_rng(2).uniform(-1.0, 1.0, N_LEVELS)


def dense_prior(space, variances):
    """Return the covariance (6 n, 6 n) of the states of all poses."""
    d = space.h0.shape[2]
    prior = np.zeros((N_POSES, d, N_POSES, d))
    for pose in range(N_POSES):
        white = np.zeros((6, 6))
        for variance, basis in zip(variances, space.white_bases, strict=False):
            of_pose = basis[pose] if len(basis) > 1 else basis[0]
            white = white + variance * of_pose
        prior[pose, :6, pose, :6] = white / space.weights[pose]

    times_s = np.r_[0.0, np.cumsum(space.intervals_s)]
    distances_s = np.abs(times_s[:, None] - times_s)
    groups = np.repeat(range(len(SIZES)), SIZES)
    for state, group in enumerate(groups, start=6):
        first = 5 + 2 * group
        variance = variances[first]
        tau_s = variances[first + 1]
        correlations = np.exp(-distances_s / tau_s)
        prior[:, state, :, state] = variance * correlations
    return prior.reshape(N_POSES * d, -1)


def dense_covariance(space, levels):
    """Return V (6 n, 6 n) by its definition, also for increments without information."""
    variances = np.exp(levels)
    n_steps, _, d = space.h0.shape
    prior = dense_prior(space, variances)

    entries = np.zeros((n_steps, 6, N_POSES, d))
    for step in range(n_steps):
        entries[step, :, step + 1, :6] = np.eye(6)
        entries[step, :, step + 1, 6:] = space.h1_processes[step]
        entries[step, :, step] = -space.h0[step]
    entries = entries.reshape(6 * n_steps, -1)
    of_states = entries @ prior @ entries.T

    first_basis, second_basis = space.walk_bases
    walk = variances[3] * first_basis + variances[4] * second_basis
    of_walk = np.kron(np.diag(space.walk_factors), walk)
    return of_states + of_walk


def dense_loss(space, levels):
    """Return the restricted loss, the step and the covariance by textbook formulas."""
    rows = np.repeat(~space.cut, 6)
    V = dense_covariance(space, levels)[np.ix_(rows, rows)]
    J, r = parameters_and_residuals(space, rows)
    weighted_J = np.linalg.solve(V, J)
    weighted_r = np.linalg.solve(V, r)
    information = J.T @ weighted_J
    gradient = J.T @ weighted_r
    step = -np.linalg.solve(information, gradient)
    rest = r + J @ step
    squares = rest @ np.linalg.solve(V, rest)
    _, log_det_V = np.linalg.slogdet(V)
    _, log_det_information = np.linalg.slogdet(information)
    loss = 0.5 * (log_det_V + log_det_information + squares)
    covariance = np.linalg.inv(information)
    return loss, step, covariance


def projection(V, J):
    """Return P = V^-1 - V^-1 J (J' V^-1 J)^-1 J' V^-1 of the restricted likelihood."""
    inverse = np.linalg.inv(V)
    information = J.T @ inverse @ J
    covariance = np.linalg.inv(information)
    return inverse - inverse @ J @ covariance @ J.T @ inverse


def test_the_likelihood_is_that_of_the_dense_covariance():
    space = space_of()
    loss, step, covariance = dense_loss(space, LEVELS)

    posterior = Posterior(space, LEVELS)

    normal = posterior.normal
    assert posterior.loss == pytest.approx(loss, rel=1e-11, abs=1e-9)
    assert_allclose(normal.step, step, atol=1e-9)
    assert_allclose(normal.covariance, covariance, atol=1e-9)


def test_the_likelihood_stays_exact_where_there_is_hardly_any_walk_or_white_noise():
    for level in (0, 1, 3, 4):
        levels = LEVELS.copy()
        levels[level] -= 13.0
        space = space_of()
        expected = dense_loss(space, levels)[0]
        assert Posterior(space, levels).loss == pytest.approx(
            expected, rel=1e-7
        )


def test_a_parameter_without_information_changes_no_derivative():
    """As z in planar motion: two columns of J that are proportional, and a column of zeros."""
    space = space_of()
    space.columns[:, :, 1] = 3.0 * space.columns[:, :, 0]
    space.columns[:, :, 2] = 0.0
    space.prior[:] = 0.0
    step = 1e-5
    gradient, _ = reml.derivatives(Posterior(space, LEVELS))
    numerical = [
        (
            Posterior(space, LEVELS + change).loss
            - Posterior(space, LEVELS - change).loss
        )
        / (2 * step)
        for change in step * np.eye(N_LEVELS)
    ]
    assert_allclose(gradient, numerical, atol=1e-6)


@pytest.mark.parametrize("units", [np.ones(3), np.array([1.0, 0.1, 10.0])])
def test_the_log_determinant_is_that_of_the_directions_with_information(units):
    turn = se3.rotation_exp(np.array([0.3, -0.2, 0.5]))
    information = turn @ np.diag([4.0, 9.0, 0.0]) @ turn.T
    scaled_information = information / np.outer(units, units)
    products = np.zeros((4, 4))
    products[:3, :3] = scaled_information

    result = NormalEquations(products)

    # Without one direction, the product of the eigenvalues that are not zero.
    _, *values = np.linalg.eigvalsh(scaled_information)
    log_determinant = np.log(values).sum()
    assert len(result.unseen.T) == 1
    assert result.log_determinant == pytest.approx(log_determinant, rel=1e-9)


def test_no_information_at_all_is_no_error():
    result = NormalEquations(np.zeros((4, 4)))
    assert result.log_determinant == 0.0
    assert result.unseen.shape == (3, 3)
    assert not result.covariance.any()


def test_derivatives_of_the_likelihood_are_the_numerical_ones():
    def slope(function, change):
        ahead = function(space, LEVELS + change)
        behind = function(space, LEVELS - change)
        return (ahead - behind) / (2 * step)

    def loss_alone(space, levels):
        loss, *_ = dense_loss(space, levels)
        return loss

    space = space_of()
    step = 1e-5
    changes = step * np.eye(N_LEVELS)
    gradient, information = reml.derivatives(Posterior(space, LEVELS))

    numerical = [slope(loss_alone, change) for change in changes]
    assert_allclose(gradient, numerical, atol=1e-7)

    rows = np.repeat(~space.cut, 6)
    of_rows = np.ix_(rows, rows)
    J, r = parameters_and_residuals(space, rows)
    V = dense_covariance(space, LEVELS)[of_rows]
    P = projection(V, J)
    forced = []
    for change in changes:
        V_slope = slope(dense_covariance, change)[of_rows]
        forced.append(V_slope @ P @ r)
    forced = np.array(forced)
    assert_allclose(information, 0.5 * forced @ P @ forced.T, atol=1e-7)


def test_chi_squares_are_those_of_leaving_one_increment_out():
    no_spikes = np.zeros(N_POSES, dtype=bool)
    space = space_of(cut=())
    V = dense_covariance(space, LEVELS)
    J, r = parameters_and_residuals(space)
    P = projection(V, J)
    forces = (P @ r).reshape(-1, 6)

    posterior = Posterior(space, LEVELS)
    of_walk, _ = leave_one_out_chi_squares(posterior, no_spikes)

    for i, chi_square in enumerate(of_walk):
        block = slice(6 * i, 6 * i + 6)
        own = P[block, block]
        force = forces[i]
        expected = force @ np.linalg.solve(own, force)
        assert chi_square == pytest.approx(expected, rel=1e-5)
    # An increment that is no evidence is judged by the same number.
    without = Posterior(space_of(cut=(6,)), LEVELS)
    again, _ = leave_one_out_chi_squares(without, no_spikes)
    assert again[6] == pytest.approx(of_walk[6], rel=1e-5)


def test_parts_add_what_a_recording_that_ends_there_would_know():
    space = space_of()
    posterior = Posterior(space, LEVELS)
    parts = posterior.part_products()
    assert_allclose(parts.sum(axis=0), posterior.products, atol=1e-8)

    n_known = 9  # of 14 parts, one increment each
    is_evidence = np.repeat(~space.cut, 6)
    is_known = np.arange(6 * len(space.columns)) < 6 * n_known
    rows = is_evidence & is_known
    V = dense_covariance(space, LEVELS)[np.ix_(rows, rows)]
    columns = space.columns.reshape(-1, N_PARAMETERS + 1)[rows]
    expected = columns.T @ np.linalg.solve(V, columns)
    of_known = parts[:n_known].sum(axis=0)
    assert_allclose(of_known, expected, atol=1e-8)

    halves = Blocks(parts).merged(2)
    without_half = NormalEquations(halves.without())
    first_half = NormalEquations(parts[:7].sum(axis=0))
    assert_allclose(without_half.step[1], first_half.step, atol=1e-9)


def test_information_of_rounding_errors_is_not_complete():
    random = np.random.default_rng(0)
    rounding = 1e-12 * random.normal(size=(7, 7))
    np.fill_diagonal(rounding, [0, 0, 5e-10, 5e-10, 5e-10, 5e10, 0.5])
    equations = NormalEquations(rounding + rounding.T)
    assert not equations.is_complete


@pytest.mark.parametrize("n", [1, 2, 5, 90])
def test_block_tridiagonal_algebra_is_that_of_the_dense_matrix(n):
    random = np.random.default_rng(0)
    d = 4
    root = random.normal(size=(n, d, d))
    diagonal = root @ np.swapaxes(root, 1, 2) + 20 * np.eye(d)
    below = random.normal(size=(n - 1, d, d))
    matrix = np.zeros((n, d, n, d))
    for k in range(n):
        matrix[k, :, k] = diagonal[k]
    for k in range(n - 1):
        matrix[k + 1, :, k] = below[k]
        matrix[k, :, k + 1] = below[k].T
    matrix = matrix.reshape(n * d, n * d)
    inverse = np.linalg.inv(matrix)
    right = random.normal(size=(n, d, 3))
    flat_right = right.reshape(n * d, 3)

    factor = Factor(diagonal, below)
    whitened = factor.whiten(right)
    solved = factor.restore(whitened).reshape(n * d, 3)
    on_diagonal, below_diagonal = factor.selected_inverse

    assert_allclose(solved, inverse @ flat_right, atol=1e-12)
    flat_whitened = whitened.reshape(n * d, 3)
    squares = flat_whitened.T @ flat_whitened
    expected = flat_right.T @ inverse @ flat_right
    assert_allclose(squares, expected, rtol=1e-12, atol=1e-12)
    _, log_determinant = np.linalg.slogdet(matrix)
    assert factor.log_determinant == pytest.approx(log_determinant)
    blocks = inverse.reshape(n, d, n, d)
    assert on_diagonal.shape == (n, d, d)
    assert below_diagonal.shape == (n - 1, d, d)
    for k in range(n):
        assert_allclose(on_diagonal[k], blocks[k, :, k], atol=1e-12)
    for k in range(n - 1):
        assert_allclose(below_diagonal[k], blocks[k + 1, :, k], atol=1e-12)
    with pytest.raises(np.linalg.LinAlgError):
        Factor(-diagonal, below)


def test_chi_squares_of_jitter_along_one_velocity_are_finite():
    of_velocity = np.ones((1, 6, 6))
    rounding = 1e-14 * np.eye(6)
    prior = 1.7e5 * of_velocity + rounding
    posterior = 0.004 * prior
    values = np.ones((1, 6))
    is_cut = np.array([False])
    (chi_square,) = chi_squares(values, prior, posterior, is_cut)
    assert 0.0 <= chi_square < 1e-3


def test_parts_have_the_posterior_of_a_trajectory_that_is_cut_between_them(
    monkeypatch,
):
    monkeypatch.setattr(partwise, "PART_POSES", 5)
    whole = replace(
        space_of(cut=(4, 9)), group_sizes=(), prior=np.eye(N_PARAMETERS + 1)
    )
    whole = replace(
        whole, h1_processes=whole.h1_processes[:, :, :0], h0=whole.h0[:, :, :6]
    )

    def space_of_part(poses):
        increments = poses[:-1]
        bases = tuple(
            basis if len(basis) == 1 else basis[poses]
            for basis in whole.white_bases
        )
        fields = {"white_bases": bases, "weights": whole.weights[poses]}
        for name in (
            "intervals_s",
            "walk_factors",
            "columns",
            "h1_processes",
            "h0",
            "cut",
        ):
            fields[name] = getattr(whole, name)[increments]
        return replace(whole, **fields)

    levels = LEVELS[:5]
    expected = Posterior(whole, levels)
    posterior = PartwisePosterior(space_of_part, N_POSES, whole.prior, levels)
    assert len([*posterior.parts()]) == 3
    assert posterior.loss == pytest.approx(expected.loss, rel=1e-11)
    assert_allclose(posterior.products, expected.products, atol=1e-9)
    step = posterior.normal.step
    assert_allclose(
        posterior.states_after(step), expected.states_after(step), atol=1e-9
    )
    assert_allclose(
        posterior.part_products().sum(axis=0), expected.products, atol=1e-9
    )
    no_spikes = np.zeros(N_POSES, dtype=bool)
    of_walk, of_white = leave_one_out_chi_squares(posterior, no_spikes)
    whole_walk, whole_white = leave_one_out_chi_squares(expected, no_spikes)
    assert_allclose(of_white, whole_white, rtol=1e-6)
    assert_allclose(of_walk[~whole.cut], whole_walk[~whole.cut], rtol=1e-6)
    assert_array_equal(of_walk[whole.cut], 0.0)
