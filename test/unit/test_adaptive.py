import itertools
import re
import sys

import numpy as np
import pytest
from motions import T_PARENT_CHILD, child_of, disturbed, planar_poses, wandering_poses

from hand_eye_calib.adaptive import estimator, lapack, noise
from hand_eye_calib.adaptive.block_tridiagonal import (
    Factor,
    blocks_below,
    diagonal_blocks,
    to_bands,
)
from hand_eye_calib.adaptive.increments import CENTRES, NUISANCES, Increments
from hand_eye_calib.assessment.covariance import assess_adaptive
from hand_eye_calib.calibration import DofVerdict
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.synchronise import PosePairs

PARAMETERS = {
    "none": np.zeros(0),
    "scale": np.array([0.03]),
    "bias": np.array([0.02, -0.01, 0.03]),
    "parent bias": np.array([-0.02, 0.03, 0.01]),
    "time": np.array([0.02]),
    "scale+time": np.array([0.03, 0.02]),
    "bias+time": np.array([0.02, -0.01, 0.03, 0.02]),
    "parent bias+time": np.array([-0.02, 0.03, 0.01, 0.02]),
}


def stamps(n_poses):
    return np.arange(n_poses, dtype=np.int64) * 10**8


def dense(bands):
    """Full symmetric matrix from bands (n, 6, 12)."""
    bands = bands.reshape(-1, 12)
    size = len(bands)
    matrix = np.zeros((size, size))
    for offset in range(12):
        index = np.arange(size - offset)
        matrix[index + offset, index] = matrix[index, index + offset] = bands[
            : size - offset, offset
        ]
    return matrix


def late(poses, seconds, interval_s=0.1):
    """Poses as a sensor reports them whose stamps are that early: those of earlier instants, at its
    velocity between its neighbours.
    """
    velocities = se3.log(se3.inverse(poses[:-2]) @ poses[2:]) / (2 * interval_s)
    return poses @ se3.exp(-seconds * np.concatenate([velocities[:1], velocities, velocities[-1:]]))


def biased(poses, bias):
    """Poses whose path is off by so much per metre, along their own axes."""
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    # the estimator takes the bias out per metre of the disturbed path
    disturbed_steps = true_steps = steps[:, :3, 3].copy()
    for _ in range(50):
        disturbed_steps = true_steps + bias * np.linalg.norm(disturbed_steps, axis=1, keepdims=True)
    steps[:, :3, 3] = disturbed_steps
    return np.array(list(itertools.accumulate(steps, np.matmul, initial=poses[0])))


def systematic(parent, nuisance, parameters):
    """Poses of parent and child with systematic errors built in."""
    child, (kind, _, time) = child_of(parent), nuisance.partition("+")
    if kind == "time" or time:
        child, parameters = late(child, parameters[-1]), parameters[:-1]
    if kind == "scale":
        child[:, :3, 3] /= 1 + parameters[0]
    elif kind == "bias":
        child = biased(child, parameters)
    elif kind == "parent bias":
        parent = biased(parent, parameters)
    return parent, child


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
    np.testing.assert_array_equal(diagonal_blocks(bands), diagonal)
    np.testing.assert_array_equal(blocks_below(bands), below)
    factor, right = Factor(bands), random.normal(size=(30, 3))
    np.testing.assert_allclose(
        factor.whiten(right), np.linalg.solve(np.linalg.cholesky(matrix), right), atol=1e-12
    )
    assert factor.log_determinant() == pytest.approx(np.linalg.slogdet(matrix)[1])
    with pytest.raises(np.linalg.LinAlgError):
        Factor(to_bands(-diagonal, below))


def test_lapack_is_that_of_scipy(monkeypatch):
    from scipy.linalg import lapack as public

    assert lapack.dpbtrf is public.dpbtrf
    monkeypatch.delitem(sys.modules, "scipy.linalg._flapack")
    monkeypatch.setattr(lapack.PathFinder, "find_spec", lambda *_: None)
    assert lapack._load_wrapper() is public  # where the wrapper is not where it used to be


def without_lag(nuisance):
    """Parameters with no lag: velocities are differences of poses, so that data with a lag is never
    quite free of residuals.
    """
    return PARAMETERS[nuisance] * (
        [1.0] * (len(PARAMETERS[nuisance]) - 1) + [0.0] if "time" in nuisance else 1.0
    )


@pytest.mark.parametrize("nuisance", NUISANCES)
def test_derivatives_are_the_numerical_ones(nuisance):
    parameters = without_lag(nuisance)
    increments = Increments(stamps(20), *systematic(wandering_poses(20), nuisance, parameters))
    jacobian = increments.jacobian(T_PARENT_CHILD, nuisance, parameters)
    step = 1e-6
    for column in range(jacobian.shape[2]):
        change = np.zeros(jacobian.shape[2])
        change[column] = step
        ahead, behind = (
            increments.residuals(
                T_PARENT_CHILD @ se3.exp(sign * change[:6]),
                nuisance,
                parameters + sign * change[6:],
            )
            for sign in (1, -1)
        )
        np.testing.assert_allclose(jacobian[:, :, column], (ahead - behind) / (2 * step), atol=2e-8)


@pytest.mark.parametrize("nuisance", NUISANCES)
def test_perfect_data_leaves_no_residual(nuisance):
    poses = systematic(wandering_poses(30), nuisance, without_lag(nuisance))
    residuals = Increments(stamps(30), *poses).residuals(
        T_PARENT_CHILD, nuisance, without_lag(nuisance)
    )
    np.testing.assert_allclose(residuals, 0, atol=1e-12)


def test_the_derivative_by_time_is_what_a_lag_does():
    def poses_at(times_s):
        phases = np.outer(times_s, [0.9, 1.1, 0.7, 0.8, 1.0, 1.2]) + np.arange(6)
        return se3.exp(np.sin(phases) * [1.0, 1.0, 0.5, 0.3, 0.4, 0.8])

    times_s, lag_s = np.arange(200) * 0.1, 1e-3
    parent = poses_at(times_s)

    def increments(late_s):
        return Increments(stamps(200), parent, child_of(poses_at(times_s - late_s)))

    derivative = increments(0.0).jacobian(T_PARENT_CHILD, "time", [0.0])[2:-2, :, 6]
    # What is assumed of the stamps' lateness undoes it.
    undone = (
        increments(-lag_s).residuals(T_PARENT_CHILD) - increments(lag_s).residuals(T_PARENT_CHILD)
    )[2:-2] / (2 * lag_s)
    # The estimator's velocities are medians: they cut the peaks, and agree everywhere else.
    np.testing.assert_allclose(derivative, undone, atol=0.06 * np.abs(undone).max())
    assert np.median(np.abs(derivative - undone)) < 0.003 * np.abs(undone).max()


def disturbed_about_origin(poses, seed, sigma_m, sigma_rad):
    """Poses of a camera that sees a target: the errors are of the target in the camera's frame."""
    return se3.inverse(disturbed(se3.inverse(poses), seed, sigma_m, sigma_rad))


@pytest.mark.parametrize("centre", CENTRES)
def test_white_components_are_the_covariance_of_the_increments(centre):
    parent = wandering_poses(6)
    child = child_of(parent)
    sigma_m, sigma_rad = 0.002, 0.001

    def noisy(run):
        if centre == "child":
            return parent, disturbed_about_origin(child, run, sigma_m, sigma_rad)
        if centre == "parent":
            return disturbed_about_origin(parent, run, sigma_m, sigma_rad), child
        return disturbed(parent, 2 * run, sigma_m, sigma_rad), disturbed(
            child, 2 * run + 1, sigma_m, sigma_rad
        )

    samples = np.array(
        [
            Increments(stamps(6), *noisy(run)).residuals(T_PARENT_CHILD).ravel()
            for run in range(4000)
        ]
    )
    components = Increments(stamps(6), parent, child, centre).components(T_PARENT_CHILD)
    sources = 2 if centre == "sensors" else 1
    expected = dense(components.covariance([sources * sigma_rad**2, sources * sigma_m**2, 0, 0]))
    found = np.cov(samples.T)
    scale = np.sqrt(np.diag(expected))
    # the standard error of a correlation from 4000 samples is 0.016; 900 of them stay within 5
    # sigma
    np.testing.assert_allclose(
        found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.08
    )


def test_rows_of_separate_stretches_are_independent():
    parent = wandering_poses(40)
    linearisation = Increments(stamps(40), parent, child_of(parent)).linearise(T_PARENT_CHILD)
    part = linearisation.rows(np.r_[5:10, 20:24])
    whole, some = (
        dense(each.components.covariance([1.0, 2.0, 3.0, 4.0])) for each in (linearisation, part)
    )
    first, second = np.arange(30, 60), np.arange(120, 144)
    np.testing.assert_allclose(some[:30, :30], whole[np.ix_(first, first)])
    np.testing.assert_allclose(some[30:, 30:], whole[np.ix_(second, second)])
    assert not some[:30, 30:].any()
    np.testing.assert_array_equal(part.residuals, linearisation.residuals[np.r_[5:10, 20:24]])
    np.testing.assert_array_equal(part.jacobian, linearisation.jacobian[np.r_[5:10, 20:24]])


def test_generalised_least_squares_is_the_textbook_formula():
    parent = wandering_poses(15)
    increments = Increments(
        stamps(15), disturbed(parent, 1, 0.01, 0.01), disturbed(child_of(parent), 2, 0.01, 0.01)
    )
    linearisation = increments.linearise(T_PARENT_CHILD)
    variances = np.array([1e-4, 2e-4, 1e-6, 3e-6])
    jumps = np.zeros(14, dtype=bool)
    solve = noise.generalised_least_squares(linearisation, variances, jumps)
    V = dense(linearisation.components.covariance(variances))
    J, r = linearisation.jacobian.reshape(-1, 6), linearisation.residuals.ravel()
    information = J.T @ np.linalg.solve(V, J)
    step = -np.linalg.solve(information, J.T @ np.linalg.solve(V, r))
    np.testing.assert_allclose(solve.step, step, atol=1e-9)
    np.testing.assert_allclose(solve.covariance, np.linalg.inv(information), rtol=1e-6)
    rest = r + J @ step
    expected = 0.5 * (
        np.linalg.slogdet(V)[1]
        + rest @ np.linalg.solve(V, rest)
        + np.linalg.slogdet(information)[1]
    )
    whitened = solve.factor.whiten(
        noise.joined_columns(linearisation.residuals, linearisation.jacobian)
    )
    losses = noise.restricted_losses(
        np.array([solve.factor.log_determinant(), np.inf]), np.array([whitened.T @ whitened] * 2)
    )
    assert losses == pytest.approx([expected, np.inf])


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


def test_the_search_for_noise_does_not_depend_on_its_start():
    parent, child = noisy_drive(4, n_poses=400, drift=(0.002, 0.003))
    linearisation, jumps = (
        Increments(stamps(400), parent, child).linearise(T_PARENT_CHILD),
        np.zeros(399, dtype=bool),
    )

    def found(rotation, translation):
        rotation = noise.fit_rotation_variances(linearisation, jumps, np.array(rotation))
        return [
            *rotation,
            *noise.fit_translation_variances(linearisation, jumps, rotation, np.array(translation)),
        ]

    usual = found([1e-4, 1e-5], [1e-4, 1e-5])
    # Noise that was once thought to have vanished, at which the loss is flat, comes back.
    np.testing.assert_allclose(found([1e-4, 1e-14], [1e-14, 1e-5]), usual, rtol=0.02)
    np.testing.assert_allclose(found([1e-14, 1e-4], [1e-4, 1e-14]), usual, rtol=0.02)


def test_noise_that_is_not_there_vanishes():
    parent, child = noisy_drive(5, n_poses=400)
    linearisation, jumps = (
        Increments(stamps(400), parent, child).linearise(T_PARENT_CHILD),
        np.zeros(399, dtype=bool),
    )
    white, drift = noise.fit_rotation_variances(linearisation, jumps, np.array([1e-4, 1e-5]))
    assert white == pytest.approx(2 * 0.006**2, rel=0.1)
    assert drift < 0.01 * white


@pytest.mark.parametrize(
    ("white", "drift"), [((0.004, 0.006), (0.0, 0.0)), ((0.001, 0.001), (0.004, 0.003))]
)
def test_the_noise_levels_are_recovered(white, drift):
    found = []
    for seed in range(12):
        parent, child = noisy_drive(seed, white=white, drift=drift)
        levels = estimator.solve(stamps(150), parent, child, nuisances=("none",)).noise
        found.append(
            [
                levels.translation_white,
                levels.rotation_white,
                levels.translation_drift,
                levels.rotation_drift,
            ]
        )
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
    # the median of chi-squared with 6 degrees of freedom is 5.35; its standard error over 40 draws
    # is 0.7
    assert 3.2 < np.median(squared_distances) < 8.0


def test_it_beats_dnl_where_the_noise_is_white():
    from hand_eye_calib.pairing.motion_pairs import motion_pairs
    from hand_eye_calib.solvers import dnl

    errors = []
    for seed in range(15):
        parent, child = noisy_drive(seed)
        answers = [estimator.solve(stamps(150), parent, child).T_parent_child]
        answers += [
            dnl.solve(motion_pairs(parent, child, reference)).T_parent_child
            for reference in ("B1", "B5", "B20")
        ]
        errors.append([np.linalg.norm(T[:3, 3] - T_PARENT_CHILD[:3, 3]) for T in answers])
    adaptive, *others = np.median(errors, axis=0)
    assert adaptive < 0.8 * min(others)


@pytest.mark.parametrize("nuisance", NUISANCES)
def test_the_right_systematic_error_is_chosen_and_measured(nuisance):
    chosen, parameters = [], []
    for seed in range(6):
        parent, child = systematic(wandering_poses(300, seed), nuisance, PARAMETERS[nuisance])
        solution = estimator.solve(
            stamps(300),
            disturbed(parent, 100 + seed, 1e-3, 1e-3),
            disturbed(child, 200 + seed, 1e-3, 1e-3),
        )
        chosen.append(solution.nuisance)
        parameters.append(solution.parameters)
    assert chosen.count(nuisance) >= 5
    right = [values for name, values in zip(chosen, parameters, strict=True) if name == nuisance]
    np.testing.assert_allclose(np.median(right, axis=0), PARAMETERS[nuisance], atol=3e-3)


def test_a_lag_is_not_taken_for_a_lever():
    errors = []
    for seed in range(6):
        parent = wandering_poses(300, seed)
        child = late(child_of(parent), 0.02)
        noisy = disturbed(parent, 100 + seed, 1e-3, 1e-3), disturbed(child, 200 + seed, 1e-3, 1e-3)
        answers = [
            estimator.solve(stamps(300), *noisy, nuisances=models)
            for models in (("none",), NUISANCES)
        ]
        assert answers[1].time_offset_s == pytest.approx(-0.02, abs=1e-3)
        said = " ".join(answers[1].describe(stamps(300))["in_words"])
        assert re.search(r"the child's stamps are (19|20|21)\.\d ms late", said)
        errors.append(
            [
                np.linalg.norm(answer.T_parent_child[:3, 3] - T_PARENT_CHILD[:3, 3])
                for answer in answers
            ]
        )
    without, with_lag = np.median(errors, axis=0)
    assert with_lag < 0.3 * without


@pytest.mark.parametrize("slipping", ["bias", "parent bias"])
def test_on_flat_ground_no_sideways_slip_is_assumed(slipping):
    # It could not be told from a child that is mounted askew.
    parent, child = systematic(planar_poses(400), slipping, [0.0, 0.05, 0.0])
    solution = estimator.solve(
        stamps(400), disturbed(parent, 1, 1e-3, 1e-3), disturbed(child, 2, 1e-3, 1e-3)
    )
    assert "bias" not in solution.nuisance


def test_the_sensor_whose_path_is_off_is_named():
    for nuisance, sensor in (("bias", "child"), ("parent bias", "parent")):
        parent, child = systematic(wandering_poses(300), nuisance, PARAMETERS[nuisance])
        solution = estimator.solve(
            stamps(300), disturbed(parent, 1, 1e-3, 1e-3), disturbed(child, 2, 1e-3, 1e-3)
        )
        said = [
            line for line in solution.describe(stamps(300))["in_words"] if "mm per metre" in line
        ]
        assert len(said) == 1
        assert said[0].startswith(f"the {sensor}'s path is off by x {'-' * (sensor == 'parent')}")


def test_poses_wrong_by_themselves_are_bridged():
    parent, child = noisy_drive(4, white=(0.002, 0.002))
    spikes = np.array([20, 41, 42, 80, 120])
    child[spikes] = child[spikes] @ se3.exp(np.random.default_rng(5).normal(0, 0.2, (5, 6)))
    child[100:, :3, 3] += [0.3, -0.2, 0.1]
    solution = estimator.solve(stamps(150), parent, child)
    np.testing.assert_array_equal(np.flatnonzero(solution.spikes), spikes)
    np.testing.assert_array_equal(np.flatnonzero(solution.jumps), [99])
    undisturbed = estimator.solve(stamps(150), *noisy_drive(4, white=(0.002, 0.002)))
    np.testing.assert_allclose(solution.T_parent_child, undisturbed.T_parent_child, atol=2e-3)
    said = " ".join(solution.describe(stamps(150))["in_words"])
    assert (
        "5 poses wrong by themselves and left out, at 2.000, 4.100, 4.200, 8.000, 12.000 s" in said
    )
    assert "1 jump of a trajectory, just before 10.000 s" in said


def test_heavy_tails_leave_the_answer_near():
    random, errors = np.random.default_rng(3), []
    for seed in range(10):
        parent = wandering_poses(200, seed)
        tails = np.sqrt(3 / random.chisquare(3, (2, 200, 1)))
        noise = se3.exp(random.normal(size=(2, 200, 6)) * tails * np.repeat([0.003, 0.004], 3))
        solution = estimator.solve(stamps(200), parent @ noise[0], child_of(parent) @ noise[1])
        xi = se3.log(se3.inverse(solution.T_parent_child) @ T_PARENT_CHILD)
        errors.append(xi @ np.linalg.solve(solution.cov_parent_child_in_child, xi))
    assert np.median(errors) < 10.0


@pytest.mark.parametrize("centre", CENTRES[1:])
def test_a_camera_that_sees_a_target_swings_about_it(centre):
    distances = []
    for seed in range(10):
        parent = wandering_poses(200, seed)
        child = child_of(parent, T_cw_pw=se3.exp(np.array([1.0, -1.0, 0.5, 0.5, 0.2, -2.0])))
        parent = se3.exp(np.array([-1.0, 0.4, 0.8, 0.1, 0.7, -0.4])) @ parent
        if centre == "child":
            child = disturbed_about_origin(child, 300 + seed, 0.003, 0.004)
        else:
            parent = disturbed_about_origin(parent, 300 + seed, 0.003, 0.004)
        solution = estimator.solve(stamps(200), parent, child)
        assert solution.centre == centre
        xi = se3.log(se3.inverse(solution.T_parent_child) @ T_PARENT_CHILD)
        distances.append(xi @ np.linalg.solve(solution.cov_parent_child_in_child, xi))
    assert 2.0 < np.median(distances) < 11.0


def test_where_noise_drowns_the_motion_longer_steps_are_taken():
    errors = []
    for seed in range(4):
        parent = wandering_poses(1500, seed, step_m=0.01, step_rad=0.008)
        # Noise that lasts over some ten poses, five times larger than the motion between two.
        random = np.random.default_rng(400 + seed)
        lasting = np.apply_along_axis(
            np.convolve, 0, random.normal(size=(1509, 6)), np.ones(10) / np.sqrt(10), mode="valid"
        )
        child = child_of(parent) @ se3.exp(
            lasting * np.repeat([0.01, 0.02], 3) + random.normal(size=(1500, 6)) * 0.02
        )
        solution = estimator.solve(stamps(1500), parent, child)
        assert solution.used.mean() < 0.4
        xi = se3.log(se3.inverse(solution.T_parent_child) @ T_PARENT_CHILD)
        errors.append(xi @ np.linalg.solve(solution.cov_parent_child_in_child, xi))
    assert np.median(errors) < 25.0


def test_errors_that_outlast_the_model_widen_the_covariance():
    random = np.random.default_rng(6)
    parent = wandering_poses(1000)
    # A velocity error that wanders: neither white noise nor a random walk.
    velocity = np.cumsum(random.normal(0, 1e-4, (1000, 3)), axis=0)
    child = child_of(parent)
    child[:, :3, 3] += np.cumsum(velocity, axis=0)
    solution = estimator.solve(
        stamps(1000), disturbed(parent, 7, 1e-4, 1e-4), child, nuisances=("none",)
    )
    assert solution.misfit > 2.0
    assert "errors last longer" in solution.describe(stamps(1000))["in_words"][-1]
    plain = estimator.solve(
        stamps(1000), disturbed(parent, 7, 1e-3, 1e-3), disturbed(child_of(parent), 8, 1e-3, 1e-3)
    )
    assert plain.misfit == 1.0


def test_resampling_leaves_out_what_it_is_told_to():
    parent, child = noisy_drive(2)
    child[70] = child[70] @ se3.exp(np.full(6, 0.3))
    solution = estimator.solve(stamps(150), parent, child)
    nothing, half = np.zeros((2, 149), dtype=bool)
    half[75:] = True
    without = estimator.solve_without(
        stamps(150), parent, child, solution, np.array([nothing, half])
    )
    np.testing.assert_allclose(without[0], solution.T_parent_child, atol=1e-6)
    first_half = noise.generalised_least_squares(
        Increments(
            stamps(150)[np.r_[:70, 71:76]], parent[np.r_[:70, 71:76]], child[np.r_[:70, 71:76]]
        ).linearise(solution.T_parent_child),
        solution.noise.variances(),
        np.zeros(74, dtype=bool),
    )
    np.testing.assert_allclose(
        without[1], solution.T_parent_child @ se3.exp(first_half.step), atol=1e-6
    )


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
    hidden = [
        dof.name for dof in assessment.observability if dof.verdict is DofVerdict.UNOBSERVABLE
    ]
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


@pytest.mark.parametrize("tail", [0.99, 0.5, 0.01, 1e-5, 1e-12, 1e-30])
def test_quantile_of_chi_square_is_scipys(tail):
    from scipy.stats import chi2

    assert estimator._chi2_quantile(tail) == pytest.approx(chi2.isf(tail, 6), rel=1e-12)
