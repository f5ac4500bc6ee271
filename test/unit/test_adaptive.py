import numpy as np
import pytest
from motions import T_PARENT_CHILD, child_of, disturbed, planar_poses, wandering_poses

from hand_eye_calib.adaptive import estimator, noise
from hand_eye_calib.adaptive.block_tridiagonal import Factor, to_bands
from hand_eye_calib.adaptive.increments import NUISANCES, Increments
from hand_eye_calib.assessment.covariance import assess_adaptive
from hand_eye_calib.calibration import DofVerdict
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.synchronise import PosePairs

PARAMETERS = {"none": np.zeros(0), "scale": np.array([0.03]), "bias": np.array([0.02, -0.01, 0.03])}


def stamps(n_poses):
    return np.arange(n_poses, dtype=np.int64) * 10**8


def dense(bands):
    """Full symmetric matrix from lower bands."""
    size = bands.shape[1]
    matrix = np.zeros((size, size))
    for offset in range(len(bands)):
        index = np.arange(size - offset)
        matrix[index + offset, index] = matrix[index, index + offset] = bands[offset, : size - offset]
    return matrix


def systematic(child, nuisance, parameters):
    """Child poses with a scale error or a bias per metre built in, integrated step by step."""
    steps = se3.inverse(child[:-1]) @ child[1:]
    metres = np.linalg.norm(steps[:, :3, 3], axis=1, keepdims=True)
    if nuisance == "scale":
        steps[:, :3, 3] /= 1 + parameters[0]
    elif nuisance == "bias":
        # the estimator takes the bias out per metre of the disturbed path
        disturbed_steps = steps[:, :3, 3] + parameters * metres
        for _ in range(50):
            disturbed_steps = steps[:, :3, 3] + parameters * np.linalg.norm(disturbed_steps, axis=1, keepdims=True)
        steps[:, :3, 3] = disturbed_steps
    poses = [child[0]]
    for step in steps:
        poses.append(poses[-1] @ step)
    return np.array(poses)


def test_block_tridiagonal_algebra_is_that_of_the_dense_matrix():
    random = np.random.default_rng(0)
    diagonal = random.normal(size=(5, 6, 6))
    diagonal = diagonal @ np.swapaxes(diagonal, 1, 2) + 20 * np.eye(6)
    below = random.normal(size=(4, 6, 6))
    matrix = np.zeros((30, 30))
    for k in range(5):
        matrix[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = diagonal[k]
    for k in range(4):
        matrix[6 * k + 6 : 6 * k + 12, 6 * k : 6 * k + 6] = below[k]
        matrix[6 * k : 6 * k + 6, 6 * k + 6 : 6 * k + 12] = below[k].T
    bands = to_bands(diagonal, below)
    np.testing.assert_array_equal(dense(bands), matrix)
    factor, right = Factor(bands), random.normal(size=(30, 3))
    np.testing.assert_allclose(factor.solve(right), np.linalg.solve(matrix, right), atol=1e-12)
    np.testing.assert_allclose(factor.whiten(right), np.linalg.solve(np.linalg.cholesky(matrix), right), atol=1e-12)
    assert factor.log_determinant() == pytest.approx(np.linalg.slogdet(matrix)[1])


@pytest.mark.parametrize("nuisance", NUISANCES)
def test_derivatives_are_the_numerical_ones(nuisance):
    parent = wandering_poses(20)
    parameters = PARAMETERS[nuisance]
    increments = Increments(stamps(20), parent, systematic(child_of(parent), nuisance, parameters))
    jacobian = increments.jacobian(T_PARENT_CHILD, nuisance, parameters)
    step = 1e-6
    for column in range(jacobian.shape[2]):
        change = np.zeros(jacobian.shape[2])
        change[column] = step
        ahead, behind = (
            increments.residuals(T_PARENT_CHILD @ se3.exp(sign * change[:6]), nuisance, parameters + sign * change[6:])
            for sign in (1, -1)
        )
        np.testing.assert_allclose(jacobian[:, :, column], (ahead - behind) / (2 * step), atol=2e-8)


@pytest.mark.parametrize("nuisance", NUISANCES)
def test_perfect_data_leaves_no_residual(nuisance):
    parent = wandering_poses(30)
    child = systematic(child_of(parent), nuisance, PARAMETERS[nuisance])
    residuals = Increments(stamps(30), parent, child).residuals(T_PARENT_CHILD, nuisance, PARAMETERS[nuisance])
    np.testing.assert_allclose(residuals, 0, atol=1e-12)


def test_white_components_are_the_covariance_of_the_increments():
    parent = wandering_poses(6)
    child = child_of(parent)
    sigma_m, sigma_rad = 0.002, 0.001
    samples = np.array(
        [
            Increments(
                stamps(6), disturbed(parent, 2 * run, sigma_m, sigma_rad), disturbed(child, 2 * run + 1, sigma_m, sigma_rad)
            )
            .residuals(T_PARENT_CHILD)
            .ravel()
            for run in range(4000)
        ]
    )
    components = Increments(stamps(6), parent, child).components(T_PARENT_CHILD)
    # both sensors' noise together: twice the variance
    expected = dense(np.tensordot([2 * sigma_rad**2, 2 * sigma_m**2, 0, 0], components, axes=1))
    found = np.cov(samples.T)
    scale = np.sqrt(np.diag(expected))
    # the standard error of a correlation from 4000 samples is 0.016; 900 of them stay within 5 sigma
    np.testing.assert_allclose(found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.08)


def test_rows_of_separate_stretches_are_independent():
    parent = wandering_poses(40)
    increments = Increments(stamps(40), parent, child_of(parent))
    part = increments.rows(np.r_[5:10, 20:24])
    whole, some = dense(increments.components(T_PARENT_CHILD)[0]), dense(part.components(T_PARENT_CHILD)[0])
    first, second = np.arange(30, 60), np.arange(120, 144)
    np.testing.assert_allclose(some[:30, :30], whole[np.ix_(first, first)])
    np.testing.assert_allclose(some[30:, 30:], whole[np.ix_(second, second)])
    assert not some[:30, 30:].any()
    np.testing.assert_array_equal(part.residuals(T_PARENT_CHILD), increments.residuals(T_PARENT_CHILD)[np.r_[5:10, 20:24]])


def test_generalised_least_squares_is_the_textbook_formula():
    parent = wandering_poses(15)
    increments = Increments(stamps(15), disturbed(parent, 1, 0.01, 0.01), disturbed(child_of(parent), 2, 0.01, 0.01))
    linearisation = increments.linearise(T_PARENT_CHILD)
    variances = np.array([1e-4, 2e-4, 1e-6, 3e-6])
    jumps = np.zeros(14, dtype=bool)
    solve = noise.generalised_least_squares(linearisation, variances, jumps)
    V = dense(np.tensordot(variances, linearisation.components, axes=1))
    J, r = linearisation.jacobian.reshape(-1, 6), linearisation.residuals.ravel()
    information = J.T @ np.linalg.solve(V, J)
    step = -np.linalg.solve(information, J.T @ np.linalg.solve(V, r))
    np.testing.assert_allclose(solve.step, step, atol=1e-9)
    np.testing.assert_allclose(solve.covariance, np.linalg.inv(information), rtol=1e-6)
    rest = r + J @ step
    expected = 0.5 * (np.linalg.slogdet(V)[1] + rest @ np.linalg.solve(V, rest) + np.linalg.slogdet(information)[1])
    assert solve.restricted_loss() == pytest.approx(expected)


def noisy_drive(seed, n_poses=150, white=(0.004, 0.006), drift=(0.0, 0.0)):
    """(white m, rad), (drift m, rad per step), per sensor; drift on the child."""
    parent = wandering_poses(n_poses, seed)
    child = child_of(parent)
    steps = se3.inverse(child[:-1]) @ child[1:]
    wander = np.random.default_rng(1000 + seed).normal(size=(n_poses - 1, 6)) * np.repeat(drift, 3)
    poses = [child[0]]
    for step, error in zip(steps, se3.exp(wander), strict=True):
        poses.append(poses[-1] @ step @ error)
    return disturbed(parent, 2 * seed + 5, *white), disturbed(np.array(poses), 2 * seed + 6, *white)


@pytest.mark.parametrize(("white", "drift"), [((0.004, 0.006), (0.0, 0.0)), ((0.001, 0.001), (0.004, 0.003))])
def test_the_noise_levels_are_recovered(white, drift):
    found = []
    for seed in range(12):
        parent, child = noisy_drive(seed, white=white, drift=drift)
        levels = estimator.solve(stamps(150), parent, child, nuisances=("none",)).noise
        found.append([levels.translation_white, levels.rotation_white, levels.translation_drift, levels.rotation_drift])
    median = np.median(found, axis=0)
    expected = np.r_[np.sqrt(2) * np.array(white), drift]
    strong = expected > 0.1 * expected.max()
    np.testing.assert_allclose(median[strong], expected[strong], rtol=0.2)
    assert (median[~strong] < 0.15 * expected.max()).all()


def test_errors_are_as_large_as_stated():
    squared_distances = []
    for seed in range(40):
        parent, child = noisy_drive(seed)
        solution = estimator.solve(stamps(150), parent, child)
        xi = se3.log(se3.inverse(solution.T_parent_child) @ T_PARENT_CHILD)
        squared_distances.append(xi @ np.linalg.solve(solution.cov_parent_child_in_child, xi))
    # the median of chi-squared with 6 degrees of freedom is 5.35; its standard error over 40 draws is 0.7
    assert 3.2 < np.median(squared_distances) < 8.0


def test_it_beats_dnl_where_the_noise_is_white():
    from hand_eye_calib.pairing.motion_pairs import motion_pairs
    from hand_eye_calib.solvers import dnl

    errors = []
    for seed in range(15):
        parent, child = noisy_drive(seed)
        answers = [estimator.solve(stamps(150), parent, child).T_parent_child]
        answers += [dnl.solve(motion_pairs(parent, child, reference)).T_parent_child for reference in ("B1", "B5", "B20")]
        errors.append([np.linalg.norm(T[:3, 3] - T_PARENT_CHILD[:3, 3]) for T in answers])
    adaptive, *others = np.median(errors, axis=0)
    assert adaptive < 0.8 * min(others)


@pytest.mark.parametrize("nuisance", NUISANCES)
def test_the_right_systematic_error_is_chosen_and_measured(nuisance):
    chosen, parameters = [], []
    for seed in range(8):
        parent = wandering_poses(200, seed)
        child = systematic(child_of(parent), nuisance, PARAMETERS[nuisance])
        solution = estimator.solve(stamps(200), disturbed(parent, seed, 1e-3, 1e-3), disturbed(child, seed + 50, 1e-3, 1e-3))
        chosen.append(solution.nuisance)
        parameters.append(solution.parameters)
    # What is wrongly found in clean data must be too small to matter.
    assert chosen.count(nuisance) >= (5 if nuisance == "none" else 8)
    assert all(np.abs(values).max(initial=0.0) < 1e-3 for values in parameters) or nuisance != "none"
    right = [values for name, values in zip(chosen, parameters, strict=True) if name == nuisance]
    np.testing.assert_allclose(np.median(right, axis=0), PARAMETERS[nuisance], atol=4e-3)


def test_jumps_of_either_sensor_are_found_at_their_places():
    parent, child = noisy_drive(3, white=(0.002, 0.002))
    parent[60:, :3, 3] += [0.3, -0.2, 0.1]
    child[100:] = se3.exp(np.array([0.0, 0.1, 0.2, 0.0, 0.3, 0.0])) @ child[100:]
    solution = estimator.solve(stamps(150), parent, child)
    assert {59, 99} <= set(np.flatnonzero(solution.jumps).tolist())
    assert solution.jumps.sum() <= 4
    np.testing.assert_allclose(solution.T_parent_child, T_PARENT_CHILD, atol=0.02)


def test_a_long_drive_lends_stretches_for_the_noise():
    parent, child = noisy_drive(1, n_poses=1200)
    solution = estimator.solve(stamps(1200), parent, child)
    assert solution.converged
    np.testing.assert_allclose(solution.noise.translation_white, np.sqrt(2) * 0.004, rtol=0.2)
    np.testing.assert_allclose(solution.T_parent_child, T_PARENT_CHILD, atol=0.01)


@pytest.mark.parametrize("level", [0.0, 1e-3])
def test_flat_ground_hides_the_height_and_only_that(level):
    parent = planar_poses(200)
    parent, child = disturbed(parent, 1, level, level), disturbed(child_of(parent), 2, level, level)
    solution = estimator.solve(stamps(200), parent, child)
    assessment = assess_adaptive(PosePairs(stamps(200), parent, child), solution)
    hidden = [dof.name for dof in assessment.observability if dof.verdict is DofVerdict.UNOBSERVABLE]
    assert hidden == ["z"]
    np.testing.assert_allclose(solution.T_parent_child[:2, 3], T_PARENT_CHILD[:2, 3], atol=0.01)


def test_no_motion_at_all_is_no_number():
    still = np.repeat(np.eye(4)[None], 40, axis=0)
    parent, child = disturbed(still, 1, 1e-3, 1e-3), disturbed(child_of(still), 2, 1e-3, 1e-3)
    solution = estimator.solve(stamps(40), parent, child)
    assert np.isfinite(solution.T_parent_child).all()
    assessment = assess_adaptive(PosePairs(stamps(40), parent, child), solution)
    verdicts = {dof.name: dof.verdict for dof in assessment.observability}
    assert all(verdicts[axis] is DofVerdict.UNOBSERVABLE for axis in "xyz")
