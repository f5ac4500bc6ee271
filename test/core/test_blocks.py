"""Compare sums over blocks with plain loops, and solutions with least squares of the rows."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from hand_eye_calib.core.assessment.moved import SIGNIFICANT, find_change
from hand_eye_calib.core.base.blocks import (
    Blocks,
    answer_evidence,
    inverse,
    jackknife_covariance,
    shift_evidence,
    solve,
)
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import PosePairs

N_ROWS = 37
N_BLOCKS = 5


@pytest.fixture
def rows():
    """Return rows (37, 3, 5): four columns, and a linear combination of them with noise."""
    random = np.random.default_rng(3)
    scales = [1.0, 1e3, 1e-3, 1.0]
    factors = [0.5, -2e-3, 3e2, 0.0]
    columns = random.normal(size=(N_ROWS, 3, 4)) * scales
    noise = 0.1 * random.normal(size=(N_ROWS, 3))
    values = columns @ factors + noise
    return np.concatenate([columns, values[..., None]], axis=2)


def split(rows):
    return np.array_split(rows, N_BLOCKS)


def products(rows):
    return sum(row.T @ row for row in rows)


def least_squares(rows, columns, target=-1):
    flat = rows.reshape(-1, 5)
    chosen = flat[:, columns]
    values = flat[:, target]
    answer, *_ = np.linalg.lstsq(chosen, values, rcond=None)
    return answer


def without(rows, block):
    parts = split(rows)
    del parts[block]
    return np.concatenate(parts)


CUTS = np.array([1, 3, 4])
SUMS = {
    "total": (lambda blocks: blocks.total, products),
    "without": (
        lambda blocks: blocks.without(),
        lambda rows: [
            products(without(rows, block)) for block in range(N_BLOCKS)
        ],
    ),
    "before": (
        lambda blocks: blocks.before(CUTS),
        lambda rows: [
            products(np.concatenate(split(rows)[:cut])) for cut in CUTS
        ],
    ),
    "since": (
        lambda blocks: blocks.since(CUTS),
        lambda rows: [
            products(np.concatenate(split(rows)[cut:])) for cut in CUTS
        ],
    ),
    "merged": (
        lambda blocks: blocks.merged(2).sums,
        lambda rows: [
            products(np.concatenate(chunk))
            for chunk in (split(rows)[:2], split(rows)[2:])
        ],
    ),
}


@pytest.mark.parametrize("name", SUMS)
def test_sums_are_those_of_loops_over_rows(rows, name):
    of_blocks, of_rows = SUMS[name]
    blocks = Blocks.of_rows(rows, N_BLOCKS)
    actual = of_blocks(blocks)
    expected = of_rows(rows)
    assert_allclose(actual, expected, rtol=1e-12, atol=1e-12)


def test_values_are_gathered_by_the_block_of_each():
    values = np.array([[1.0], [2.0], [4.0], [8.0]])
    block_numbers = np.array([2, 0, 2, 2])
    blocks = Blocks.gathered(values, block_numbers, 4)
    assert blocks.sums.tolist() == [[2.0], [0.0], [13.0], [0.0]]


@pytest.mark.parametrize("columns", [[0, 1, 2, 3], [2], [3, 0]])
def test_answers_are_those_of_least_squares(rows, columns):
    blocks = Blocks.of_rows(rows, N_BLOCKS)
    assert blocks.solve(columns) == pytest.approx(
        least_squares(rows, columns), rel=1e-6, abs=1e-9
    )


def test_a_column_is_fitted_by_others(rows):
    sums = products(rows)
    answer = solve(sums, [0, 3], target=1)
    expected = least_squares(rows, [0, 3], target=1)
    assert answer == pytest.approx(expected, rel=1e-6)


def test_an_unknown_without_evidence_stays_zero(rows):
    rows[:, :, 1] = 0.0
    blocks = Blocks.of_rows(rows, N_BLOCKS)

    answer = blocks.solve([0, 1, 2])

    others = least_squares(rows, [0, 2])
    assert answer[1] == 0.0
    assert answer[[0, 2]] == pytest.approx(others, rel=1e-6)


def test_the_jackknife_is_the_scatter_of_the_answers_without_each_block(rows):
    answers = []
    for block in range(N_BLOCKS):
        remaining = without(rows, block)
        answers.append(least_squares(remaining, [0, 1, 2]))
    answers = np.array(answers)
    factor = (N_BLOCKS - 1) ** 2 / N_BLOCKS
    expected = factor * np.cov(answers.T)

    actual = Blocks.of_rows(rows, N_BLOCKS).jackknife([0, 1, 2])
    of_answers = jackknife_covariance(answers)

    assert_allclose(actual, expected, rtol=1e-5)
    assert_allclose(of_answers, expected, rtol=1e-12)


def test_the_jackknife_gives_the_variance_of_a_mean():
    random = np.random.default_rng(5)
    values = random.normal(size=(40, 1, 1))
    ones = np.ones_like(values)
    rows = np.concatenate([ones, values], axis=2)

    variance = Blocks.of_rows(rows, 40).jackknife([0])

    expected = np.var(values, ddof=1) / 40
    assert variance == pytest.approx(expected, rel=1e-6)


def test_probes_without_noise_take_the_bias_of_noisy_columns_away():
    random = np.random.default_rng(7)
    true = random.normal(size=(20_000, 1, 1))
    noise = random.normal(size=true.shape)
    target = 2.0 * true
    rows = np.concatenate([true + noise, target], axis=2)
    probes = np.concatenate([true, target], axis=2)

    biased = Blocks.of_rows(rows, 4).solve([0])
    unbiased = Blocks.of_rows(rows, 4, probes).solve([0])

    assert biased == pytest.approx(1.0, abs=0.05)
    assert unbiased == pytest.approx(2.0, abs=0.05)


def test_the_evidence_of_a_shift_is_that_of_the_difference_of_both_answers(
    rows,
):
    no_prior = np.zeros((4, 4))
    unknowns = [0, 1, 2, 3]
    blocks = Blocks.of_rows(rows, N_BLOCKS)
    shifts = blocks.shift_since(CUTS, no_prior)
    for cut, shift in zip(CUTS, shifts, strict=True):
        parts = split(rows)
        before = np.concatenate(parts[:cut])
        since = np.concatenate(parts[cut:])
        answer_before = least_squares(before, unknowns)
        answer_since = least_squares(since, unknowns)
        covariance_before = np.linalg.inv(products(before)[:4, :4])
        covariance_since = np.linalg.inv(products(since)[:4, :4])
        covariance = covariance_before + covariance_since
        difference = answer_since - answer_before
        expected = answer_evidence(difference, covariance)
        units = np.sqrt(np.diag(covariance))
        scale = units[:, None] * np.append(units, 1.0)
        actual = scale * shift
        assert_allclose(actual, scale * expected, rtol=1e-6, atol=1e-6)


def test_a_shift_from_values_known_exactly_is_the_answer_since():
    # 4 (x - 2) = 0; y is not determined.
    table = np.array([[4.0, 0.0, 8.0], [0.0, 0.0, 0.0]])
    answer_before = np.array([0.5, 7.0])
    covariance_before = np.zeros((2, 2))
    shift = shift_evidence(table, answer_before, covariance_before)
    assert shift.tolist() == [[4.0, 0.0, 6.0], [0.0, 0.0, 0.0]]


def test_a_shift_is_searched_for_on_an_exact_straight_line():
    n_poses = 300
    stamps_ns = np.arange(n_poses) * 100_000_000
    positions = np.zeros((n_poses, 3))
    positions[:, 1] = np.linspace(0.0, 5e5, n_poses)
    X = se3.exp([0.3, -0.1, 0.2, 0.3, -0.5, 1.2])
    parent = se3.from_rotation_translation(np.eye(3), positions)
    child = se3.inverse(X) @ parent @ X
    pairs = PosePairs(stamps_ns, parent, child)

    change = find_change(pairs, X)

    assert change.log_ratio < SIGNIFICANT


def test_inverses_of_regular_matrices_are_those_of_numpy(rows):
    transposed = np.swapaxes(rows, 1, 2)
    matrices = transposed @ rows + np.eye(5)
    expected = np.linalg.inv(matrices)
    actual = inverse(matrices)
    assert_array_equal(actual, expected)
