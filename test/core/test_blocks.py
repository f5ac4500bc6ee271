"""Compare sums over blocks with plain loops, and solutions with least squares of the rows."""

import numpy as np
import pytest

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
    columns = random.normal(size=(N_ROWS, 3, 4)) * [1.0, 1e3, 1e-3, 1.0]
    values = columns @ [0.5, -2e-3, 3e2, 0.0] + 0.1 * random.normal(size=(N_ROWS, 3))
    return np.concatenate([columns, values[..., None]], axis=2)


def split(rows):
    return np.array_split(rows, N_BLOCKS)


def products(rows):
    return sum(row.T @ row for row in rows)


def least_squares(rows, columns, target=-1):
    flat = rows.reshape(-1, 5)
    return np.linalg.lstsq(flat[:, columns], flat[:, target], rcond=None)[0]


def without(rows, block):
    parts = split(rows)
    return np.concatenate(parts[:block] + parts[block + 1 :])


CUTS = np.array([1, 3, 4])
SUMS = {
    "total": (lambda blocks: blocks.total, products),
    "without": (
        lambda blocks: blocks.without(),
        lambda rows: [products(without(rows, block)) for block in range(N_BLOCKS)],
    ),
    "before": (
        lambda blocks: blocks.before(CUTS),
        lambda rows: [products(np.concatenate(split(rows)[:cut])) for cut in CUTS],
    ),
    "since": (
        lambda blocks: blocks.since(CUTS),
        lambda rows: [products(np.concatenate(split(rows)[cut:])) for cut in CUTS],
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
    actual = of_blocks(Blocks.of_rows(rows, N_BLOCKS))
    np.testing.assert_allclose(actual, of_rows(rows), rtol=1e-12, atol=1e-12)


def test_values_are_gathered_by_the_block_of_each():
    blocks = Blocks.gathered(
        np.array([[1.0], [2.0], [4.0], [8.0]]), np.array([2, 0, 2, 2]), 4
    )
    assert blocks.sums.tolist() == [[2.0], [0.0], [13.0], [0.0]]


@pytest.mark.parametrize("columns", [[0, 1, 2, 3], [2], [3, 0]])
def test_answers_are_those_of_least_squares(rows, columns):
    blocks = Blocks.of_rows(rows, N_BLOCKS)
    assert blocks.solve(columns) == pytest.approx(
        least_squares(rows, columns), rel=1e-6, abs=1e-9
    )


def test_a_column_is_fitted_by_others(rows):
    answer = solve(products(rows), [0, 3], target=1)
    assert answer == pytest.approx(least_squares(rows, [0, 3], target=1), rel=1e-6)


def test_an_unknown_without_evidence_stays_zero(rows):
    rows[:, :, 1] = 0.0
    answer = Blocks.of_rows(rows, N_BLOCKS).solve([0, 1, 2])
    assert answer[1] == 0.0
    assert answer[[0, 2]] == pytest.approx(least_squares(rows, [0, 2]), rel=1e-6)


def test_the_jackknife_is_the_scatter_of_the_answers_without_each_block(rows):
    answers = [
        least_squares(without(rows, block), [0, 1, 2]) for block in range(N_BLOCKS)
    ]
    expected = (N_BLOCKS - 1) ** 2 / N_BLOCKS * np.cov(np.transpose(answers))
    actual = Blocks.of_rows(rows, N_BLOCKS).jackknife([0, 1, 2])
    np.testing.assert_allclose(actual, expected, rtol=1e-5)
    np.testing.assert_allclose(
        jackknife_covariance(np.array(answers)), expected, rtol=1e-12
    )


def test_the_jackknife_gives_the_variance_of_a_mean():
    values = np.random.default_rng(5).normal(size=(40, 1, 1))
    rows = np.concatenate([np.ones_like(values), values], axis=2)
    variance = Blocks.of_rows(rows, 40).jackknife([0])
    assert variance == pytest.approx(np.var(values, ddof=1) / 40, rel=1e-6)


def test_probes_without_noise_take_the_bias_of_noisy_columns_away():
    random = np.random.default_rng(7)
    true = random.normal(size=(20_000, 1, 1))
    noisy = true + random.normal(size=true.shape)
    rows = np.concatenate([noisy, 2.0 * true], axis=2)
    probes = np.concatenate([true, 2.0 * true], axis=2)
    assert Blocks.of_rows(rows, 4).solve([0]) == pytest.approx(1.0, abs=0.05)
    assert Blocks.of_rows(rows, 4, probes).solve([0]) == pytest.approx(2.0, abs=0.05)


def test_the_evidence_of_a_shift_is_that_of_the_difference_of_both_answers(rows):
    blocks = Blocks.of_rows(rows, N_BLOCKS)
    shifts = blocks.shift_since(CUTS, np.zeros((4, 4)))
    for cut, shift in zip(CUTS, shifts, strict=True):
        parts = [
            np.concatenate(chunk) for chunk in (split(rows)[:cut], split(rows)[cut:])
        ]
        answers = [least_squares(chunk, [0, 1, 2, 3]) for chunk in parts]
        covariance = sum(np.linalg.inv(products(chunk)[:4, :4]) for chunk in parts)
        units = np.sqrt(np.diag(covariance))
        expected = answer_evidence(answers[1] - answers[0], covariance)
        scale = units[:, None] * np.append(units, 1.0)
        np.testing.assert_allclose(
            scale * shift, scale * expected, rtol=1e-6, atol=1e-6
        )


def test_a_shift_from_values_known_exactly_is_the_answer_since():
    # 4 (x - 2) = 0; y is not determined.
    table = np.array([[4.0, 0.0, 8.0], [0.0, 0.0, 0.0]])
    shift = shift_evidence(table, np.array([0.5, 7.0]), np.zeros((2, 2)))
    assert shift.tolist() == [[4.0, 0.0, 6.0], [0.0, 0.0, 0.0]]


def test_a_shift_is_searched_for_on_an_exact_straight_line():
    n_poses = 300
    stamps_ns = np.arange(n_poses) * 100_000_000
    positions = np.zeros((n_poses, 3))
    positions[:, 1] = np.linspace(0.0, 5e5, n_poses)
    X = se3.exp([0.3, -0.1, 0.2, 0.3, -0.5, 1.2])
    parent = se3.from_rotation_translation(np.eye(3), positions)
    child = se3.inverse(X) @ parent @ X

    change = find_change(PosePairs(stamps_ns, parent, child), X)

    assert change.log_ratio < SIGNIFICANT


def test_inverses_of_regular_matrices_are_those_of_numpy(rows):
    matrices = np.swapaxes(rows, 1, 2) @ rows + np.eye(5)
    np.testing.assert_array_equal(inverse(matrices), np.linalg.inv(matrices))
