"""The estimator with a noise model: levels, errors that last, systematic errors, outliers."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
import real_data
from motions import (
    T_PARENT_CHILD,
    child_of,
    disturbed,
    planar_poses,
    walked,
    wandering_poses,
)
from numpy.testing import assert_allclose, assert_array_equal
from sigmas import assert_nees, nees

import hand_eye_calib as hec
from hand_eye_calib.core.assessment.covariance import assess_adaptive
from hand_eye_calib.core.assessment.noise_words import noise_in_words
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import deviation
from hand_eye_calib.core.noise import estimator, fit, increments, partwise
from hand_eye_calib.core.noise.noise_model import CENTRES
from hand_eye_calib.core.noise.tuning import TUNING
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.core.results.calibration import DofVerdict
from hand_eye_calib.extras.simulation.drive import add_noise, simulate_drive
from hand_eye_calib.extras.simulation.options import MIXTURE, DriveConfig

VALUES = {
    "none": np.zeros(0),
    "scale": np.array([0.03]),
    "bias": np.array([0.0, -0.03, 0.0]),
    "time": np.array([0.02]),
    "scale+time": np.array([0.03, 0.02]),
    "bias+time": np.array([0.0, -0.03, 0.0, 0.02]),
}


def stamps(n_poses):
    return np.arange(n_poses, dtype=np.int64) * 10**8


def late(poses, seconds, interval_s=0.1):
    """Poses as a sensor reports them whose stamps are that early: those of earlier instants, at its
    velocity between its neighbours.
    """
    increments_of_two = se3.inverse(poses[:-2]) @ poses[2:]
    inner_velocities = se3.log(increments_of_two) / (2 * interval_s)
    first = inner_velocities[:1]
    last = inner_velocities[-1:]
    velocities = np.concatenate([first, inner_velocities, last])
    return poses @ se3.exp(-seconds * velocities)


def biased(poses, bias):
    """Poses whose path is off by so much per metre, along their own axes."""
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    true_steps = steps[:, :3, 3].copy()
    disturbed_steps = true_steps
    # the estimator takes the bias out per metre of the disturbed path
    for _ in range(50):
        lengths = np.linalg.norm(disturbed_steps, axis=1, keepdims=True)
        disturbed_steps = true_steps + bias * lengths
    steps[:, :3, 3] = disturbed_steps
    return walked(steps, poses[0])


def systematic(parent, nuisance, parameters):
    """Poses of parent and child with systematic errors built in."""
    child = child_of(parent)
    kind, _, time = nuisance.partition("+")
    if kind == "time" or time:
        child = late(child, parameters[-1])
        parameters = parameters[:-1]
    if kind == "scale":
        child[:, :3, 3] /= 1 + parameters[0]
    elif kind == "bias":
        child = biased(child, parameters)
    return parent, child


def with_noise(streams, seed):
    """Both streams with white noise of a millimetre and a milliradian."""
    parent, child = streams
    return disturbed(parent, seed + 100, 1e-3, 1e-3), disturbed(
        child, seed + 200, 1e-3, 1e-3
    )


def disturbed_about_origin(poses, seed, sigma_m, sigma_rad):
    """Poses of a camera that sees a target: the errors are of the target in the camera's frame."""
    target_poses = se3.inverse(poses)
    noisy_target_poses = disturbed(target_poses, seed, sigma_m, sigma_rad)
    return se3.inverse(noisy_target_poses)


def noisy_drive(seed, n_poses=150, white=(0.004, 0.006), drift=(0.0, 0.0)):
    """(white m, rad), (drift m, rad per step), per sensor; drift on the child."""
    random = np.random.default_rng(1000 + seed)
    parent = wandering_poses(n_poses, seed)
    child = child_of(parent)
    steps = se3.inverse(child[:-1]) @ child[1:]
    wander = random.normal(size=(n_poses - 1, 6)) * np.repeat(drift, 3)
    drifting_child = walked(steps @ se3.exp(wander), child[0])
    noisy_parent = disturbed(parent, 2 * seed + 5, *white)
    noisy_child = disturbed(drifting_child, 2 * seed + 6, *white)
    return noisy_parent, noisy_child


def drift_of(noise):
    return noise.translation_drift_m_per_pose, noise.rotation_drift_rad_per_pose


@pytest.mark.statistics
@pytest.mark.parametrize(
    ("white", "drift"),
    [((0.004, 0.006), (0.0, 0.0)), ((0.001, 0.001), (0.004, 0.003))],
)
def test_the_noise_levels_are_recovered(white, drift):
    levels = []
    for seed in range(5):
        parent, child = noisy_drive(seed, white=white, drift=drift)
        noise = estimator.solve(stamps(150), parent, child, systematic=()).noise
        white_levels = [noise.translation_white_m, noise.rotation_white_rad]
        levels.append([*white_levels, *drift_of(noise)])

    median = np.median(levels, axis=0)

    expected_white = np.sqrt(2) * np.array(white)
    expected = np.r_[expected_white, drift]
    half = 0.5 * expected.max()
    is_strong = expected > half
    assert_allclose(median[is_strong], expected[is_strong], rtol=0.2)
    assert (median[~is_strong] < half).all(), f"a level without noise: {median}"


def test_the_walk_of_a_long_recording_is_found_from_bursts_far_apart():
    drift = (0.001, 0.0005)
    white = (0.002, 0.001)
    parent, child = noisy_drive(1, 5_000, white=white, drift=drift)

    solution = estimator.solve(stamps(5_000), parent, child, systematic=())

    estimated_drift = drift_of(solution.noise)
    assert_allclose(estimated_drift, drift, rtol=0.3)


def lasting(seed, n_poses, sigmas, tau_poses):
    """Gauss-Markov errors (N, 6) of these standard deviations and correlation time."""
    random = np.random.default_rng(seed)
    errors = random.normal(size=(n_poses, 6)) * np.repeat(sigmas, 3)
    phi = np.exp(-1.0 / tau_poses)
    innovation = np.sqrt(1 - phi**2)
    for i in range(1, n_poses):
        previous = errors[i - 1]
        errors[i] = phi * previous + innovation * errors[i]
    return errors


def fixed_to_body(parent, child, errors):
    disturbed_child = child @ se3.exp(errors)
    return parent, disturbed_child


def fixed_to_world(parent, child, errors):
    to_body = np.swapaxes(parent[:, :3, :3], 1, 2)
    translations = se3.times(to_body, errors[:, :3])
    rotations = se3.times(to_body, errors[:, 3:])
    errors_in_body = np.concatenate([translations, rotations], axis=1)
    disturbed_parent = parent @ se3.exp(errors_in_body)
    return disturbed_parent, child


def of_direction(parent, child, errors):
    """Errors of the direction in which the child travels: its increments are turned."""
    steps = se3.inverse(child[:-1]) @ child[1:]
    twists = np.roll(errors[1:], 3, axis=1)
    turns = se3.exp(twists)[:, :3, :3]
    translations = steps[:, :3, 3]
    steps[:, :3, 3] = se3.times(turns, translations)
    disturbed_child = walked(steps, child[0])
    return parent, disturbed_child


@dataclass
class Lasting:
    """Errors that last, and what the estimator has to find of them."""

    disturb: Callable
    part: str
    sigma: float  # m, or rad of a direction
    tau_poses: int


LASTING = {
    "body": Lasting(fixed_to_body, "translation", 0.02, 20),
    "world": Lasting(fixed_to_world, "translation", 0.02, 20),
    "path": Lasting(of_direction, "direction", 0.1, 4),
}


def solved_with_lasting(kind, seed):
    """Return a solution whose streams have lasting errors, and the strongest process it found."""
    added = LASTING[kind]
    parent, child = noisy_drive(seed, n_poses=600, white=(0.001, 0.001))
    errors = lasting(100 + seed, 600, [added.sigma, 0.002], added.tau_poses)
    parent, child = added.disturb(parent, child, errors)

    solution = estimator.solve(stamps(600), parent, child)

    processes = [
        process
        for process in solution.noise.lasting
        if process.part == added.part
    ]
    strongest = max(processes, key=lambda process: process.sigma)
    # Rotations fixed to the body are no process: the scatter of the tenths has to state them.
    pairs = PosePairs(stamps(600), parent, child)
    assessment = assess_adaptive(pairs, solution)
    covariance = assessment.cov_parent_child_in_child
    assessed = replace(solution, cov_parent_child_in_child=covariance)
    return assessed, strongest


@pytest.mark.statistics
@pytest.mark.parametrize("kind", LASTING)
def test_errors_that_last_are_found_and_told_apart(kind):
    solutions = []
    processes = []
    for seed in range(4):
        solution, process = solved_with_lasting(kind, seed)
        solutions.append(solution)
        processes.append(process)

    expected = LASTING[kind]
    expected_tau_s = 0.1 * expected.tau_poses
    for process in processes:
        assert process.sigma == pytest.approx(expected.sigma, rel=0.5)
        assert process.tau_s == pytest.approx(expected_tau_s, rel=0.8)
    kinds = [process.kind for process in processes]
    assert kinds.count(kind) >= 3
    values = [nees_of(solution) for solution in solutions]
    assert_nees(values, 2.0, 12.0, np.median)


def test_flicker_is_stated_beyond_what_was_found():
    """Errors that last on all scales: the longest cannot be found, and X takes their mean."""
    parent = wandering_poses(500)
    errors = np.zeros((500, 6))
    for seed, tau_poses in enumerate((3, 30, 300)):
        errors += lasting(seed, 500, [0.004, 0.004], tau_poses)
    child = child_of(parent) @ se3.exp(errors)
    without = replace(TUNING, undetected_share=0.0)

    stated = estimator.solve(stamps(500), parent, child)
    measured = estimator.solve(stamps(500), parent, child, tuning=without)

    unseen = (
        stated.cov_parent_child_in_child - measured.cov_parent_child_in_child
    )
    unseen_variances = np.diag(unseen)[:3]
    unseen_m = np.sqrt(unseen_variances)
    assert (unseen_m > 0.2e-3).all(), (
        f"undetected errors of {unseen_m} m: too small"
    )
    assert (unseen_m < 4e-3).all(), (
        f"undetected errors of {unseen_m} m: too large"
    )


@pytest.mark.statistics
def test_noise_as_large_as_the_motion_does_not_draw_the_answer():
    values = []
    for seed in range(8):
        parent = wandering_poses(800, seed, step_m=0.02, step_rad=0.01)
        child = disturbed(child_of(parent), 300 + seed, 0.002, 0.015)
        solution = estimator.solve(
            stamps(800), disturbed(parent, seed, 0.002, 0.015), child
        )
        values.append(nees_of(solution))
    assert_nees(values, 0.0, 25.0, np.median)


def nees_of(solution, truth=T_PARENT_CHILD):
    error_pose = se3.inverse(solution.T_parent_child) @ truth
    error = se3.log(error_pose)
    return nees(error, solution.cov_parent_child_in_child)


@pytest.mark.statistics
def test_errors_are_as_large_as_stated():
    values = []
    for seed in range(24):
        parent, child = noisy_drive(seed)
        solution = estimator.solve(stamps(150), parent, child)
        values.append(nees_of(solution))
    # Chi-squared with 6 degrees of freedom has mean 6 and variance 12: the mean of 24 draws has a
    # standard error of 0.7, of which three are allowed.
    assert_nees(values, 3.9, 8.1)


@cache
def noisy_and_solved(nuisance, seed):
    """Both streams with a systematic error and noise, and their solution."""
    parent = wandering_poses(300, seed)
    streams = systematic(parent, nuisance, VALUES[nuisance])
    noisy = with_noise(streams, seed)
    solution = estimator.solve(stamps(300), *noisy)
    return noisy, solution


def parameters_of(nuisance):
    """Indices of the parameters of systematic errors such as ``scale+time``."""
    indices = []
    for name in nuisance.split("+"):
        indices.extend(increments.PARAMETERS.get(name, ()))
    return indices


@pytest.mark.statistics
@pytest.mark.parametrize("nuisance", VALUES)
def test_the_right_systematic_error_is_chosen_and_measured(nuisance):
    solutions = [noisy_and_solved(nuisance, seed)[1] for seed in range(4)]
    chosen = [solution.systematic for solution in solutions]
    parameters = [
        solution.parameters[parameters_of(nuisance)] for solution in solutions
    ]
    assert chosen.count(nuisance) >= 3
    assert_allclose(np.median(parameters, axis=0), VALUES[nuisance], atol=3e-3)


@pytest.mark.parametrize("seed", range(4))
def test_a_lag_is_measured_and_stated(seed):
    _, solution = noisy_and_solved("time", seed)
    assert solution.time_offset_s == pytest.approx(-0.02, abs=1e-3)
    words = " ".join(noise_in_words(solution, stamps(300)).in_words)
    assert re.search(
        r"the child's stamps are (19|20|21)\.\d \+/- 0\.\d+ ms late", words
    )


@pytest.mark.statistics
def test_a_lag_is_not_taken_for_a_lever():
    def lever_error_m(solution):
        error = solution.T_parent_child - T_PARENT_CHILD
        return np.linalg.norm(error[:3, 3])

    errors_m = []
    errors_without_m = []
    for seed in range(4):
        streams, solution = noisy_and_solved("time", seed)
        without = estimator.solve(stamps(300), *streams, systematic=())
        errors_m.append(lever_error_m(solution))
        errors_without_m.append(lever_error_m(without))

    error_m = np.median(errors_m)
    error_without_m = np.median(errors_without_m)
    assert error_m < 0.3 * error_without_m, (
        "the lag still disturbs the lever arm"
    )


def test_on_flat_ground_no_sideways_slip_is_assumed():
    # It could not be told from a child that is mounted askew; forwards and upwards it can.
    sideways_bias = [0.0, 0.05, 0.0]
    streams = systematic(planar_poses(400), "bias", sideways_bias)
    parent, child = with_noise(streams, 1)

    solution = estimator.solve(stamps(400), parent, child)

    sideways = increments.PARAMETERS["bias"][1]
    assert abs(solution.parameters[sideways]) < 1e-3


def test_poses_wrong_by_themselves_are_bridged():
    white = (0.002, 0.002)
    random = np.random.default_rng(5)
    parent, child = noisy_drive(4, white=white)
    undisturbed = estimator.solve(stamps(150), *noisy_drive(4, white=white))
    spikes = np.array([20, 41, 42, 80, 120])
    errors = random.normal(0, 0.2, (5, 6))
    child[spikes] = child[spikes] @ se3.exp(errors)
    child[100:, :3, 3] += [0.3, -0.2, 0.1]

    solution = estimator.solve(stamps(150), parent, child)

    steps = [19, 20, 40, 41, 42, 79, 80, 99, 119, 120]
    assert_array_equal(np.flatnonzero(solution.spikes), spikes)
    assert_array_equal(np.flatnonzero(solution.jumps), [99])
    assert_array_equal(np.flatnonzero(solution.left_out), steps)
    assert_allclose(
        solution.T_parent_child, undisturbed.T_parent_child, atol=2e-3
    )
    description = noise_in_words(solution, stamps(150))
    words = " ".join(description.in_words)
    assert (
        "5 outlier poses, left out, at 2.000, 4.100, 4.200, 8.000, 12.000 s"
        in words
    )
    assert "1 jump of a trajectory, just before 10.000 s" in words


@pytest.mark.statistics
def test_heavy_tails_leave_the_answer_near():
    random = np.random.default_rng(3)
    sigmas = np.repeat([0.003, 0.004], 3)
    values = []
    for seed in range(6):
        parent = wandering_poses(200, seed)
        # Student errors with three degrees of freedom, of both sensors.
        tails = np.sqrt(3 / random.chisquare(3, (2, 200, 1)))
        normal = random.normal(size=(2, 200, 6))
        parent_noise, child_noise = se3.exp(normal * tails * sigmas)
        noisy_parent = parent @ parent_noise
        noisy_child = child_of(parent) @ child_noise
        solution = estimator.solve(stamps(200), noisy_parent, noisy_child)
        values.append(nees_of(solution))
    assert_nees(values, 0.0, 10.0, np.median)


def test_a_long_recording_is_solved_in_parts(monkeypatch):
    errors = lasting(7, 900, [0.02, 0.0], 20)
    parent, child = fixed_to_body(*noisy_drive(6, 900), errors)
    child[300:, :3, 3] += [0.5, -0.3, 0.2]
    whole = estimator.solve(stamps(900), parent, child)
    monkeypatch.setattr(partwise, "PART_POSES", 200)
    monkeypatch.setattr(fit, "MAX_POSES", 200)

    in_parts = estimator.solve(stamps(900), parent, child)

    sigmas = np.sqrt(np.diag(whole.cov_parent_child_in_child))
    sigmas_in_parts = np.sqrt(np.diag(in_parts.cov_parent_child_in_child))
    difference = deviation(in_parts.T_parent_child, whole.T_parent_child)
    largest = np.max(np.abs(difference) / sigmas)
    assert 0.0 < largest < 0.5, f"the answers are {largest:.2f} sigma apart"
    ratios = sigmas_in_parts / sigmas
    assert np.all(ratios > 0.95), f"sigmas are too small by {ratios}"
    assert np.all(ratios < 1.1), f"sigmas are too large by {ratios}"
    assert np.flatnonzero(in_parts.jumps).tolist() == [299]
    assert np.flatnonzero(whole.jumps).tolist() == [299]
    assert ("body", "translation") in whole.model.processes
    assert in_parts.model.processes == whole.model.processes
    assert in_parts.converged


def target_seen_by(camera, seed):
    """Poses of parent and child, one of which is a camera that sees a target."""
    poses = wandering_poses(200, seed)
    T_cw_pw = se3.exp(np.array([1.0, -1.0, 0.5, 0.5, 0.2, -2.0]))
    T_world = se3.exp(np.array([-1.0, 0.4, 0.8, 0.1, 0.7, -0.4]))
    child = child_of(poses, T_cw_pw=T_cw_pw)
    parent = T_world @ poses
    if camera == "child":
        child = disturbed_about_origin(child, 300 + seed, 0.003, 0.004)
    else:
        parent = disturbed_about_origin(parent, 300 + seed, 0.003, 0.004)
    return parent, child


@pytest.mark.statistics
@pytest.mark.parametrize("camera", CENTRES[1:])
def test_a_camera_that_sees_a_target_swings_about_it(camera):
    values = []
    for seed in range(6):
        parent, child = target_seen_by(camera, seed)
        solution = estimator.solve(stamps(200), parent, child)
        assert solution.model.centre == camera
        values.append(nees_of(solution))
    assert_nees(values, 2.0, 11.0, np.median)


def test_jumps_of_either_sensor_are_found_at_their_places():
    parent, child = noisy_drive(3, white=(0.002, 0.002))
    jump = se3.exp(np.array([0.0, 0.1, 0.2, 0.0, 0.3, 0.0]))
    parent[60:, :3, 3] += [0.3, -0.2, 0.1]
    child[100:] = jump @ child[100:]

    solution = estimator.solve(stamps(150), parent, child)

    jumps = np.flatnonzero(solution.jumps).tolist()
    assert {59, 99} <= set(jumps)
    assert len(jumps) <= 4
    assert_allclose(solution.T_parent_child, T_PARENT_CHILD, atol=0.02)


@pytest.mark.parametrize("level", [0.0, 1e-3])
def test_flat_ground_hides_the_height_and_only_that(level):
    parent = planar_poses(200)
    parent, child = (
        disturbed(parent, 1, level, level),
        disturbed(child_of(parent), 2, level, level),
    )
    solution = estimator.solve(stamps(200), parent, child)
    assessment = assess_adaptive(
        PosePairs(stamps(200), parent, child), solution
    )
    verdicts = {dof.name: dof.verdict for dof in assessment.observability}
    assert [
        axis for axis in verdicts if verdicts[axis] is DofVerdict.UNOBSERVABLE
    ] == ["z"]
    assert_allclose(
        solution.T_parent_child[:2, 3], T_PARENT_CHILD[:2, 3], atol=0.01
    )


def test_no_motion_at_all_is_no_number():
    still = np.repeat(np.eye(4)[None], 40, axis=0)
    parent, child = with_noise((still, child_of(still)), 1)
    pairs = PosePairs(stamps(40), parent, child)

    solution = estimator.solve(stamps(40), parent, child)
    assessment = assess_adaptive(pairs, solution)

    assert np.isfinite(solution.T_parent_child).all()
    verdicts = {dof.name: dof.verdict for dof in assessment.observability}
    for axis in "xyz":
        assert verdicts[axis] is DofVerdict.UNOBSERVABLE


def mixture(number):
    """Poses of a drive with the paper's mixture of errors, and the true extrinsic."""
    config = DriveConfig(poses=200)
    drive = simulate_drive((0, number), config)
    random = np.random.default_rng((0, number, 0))
    parent, child = add_noise(
        drive.parent.poses, drive.child.poses, MIXTURE, random
    )
    pairs = PosePairs(drive.parent.stamps_ns, parent, child)
    return pairs, drive.T_parent_child


@pytest.mark.statistics
def test_a_drift_that_a_mount_askew_nearly_explains_is_found():
    # With a drift along all axes the standard deviations of X would grow to 5.8 and 3.3 times those
    # without.
    n_biased = 0
    for number in range(6):
        poses, truth = mixture(number)
        solution = estimator.solve(
            poses.stamps_ns, poses.Ts_pw_p, poses.Ts_cw_c
        )
        n_biased += "bias" in solution.systematic
        covariance = assess_adaptive(poses, solution).cov_parent_child_in_child
        stated = replace(solution, cov_parent_child_in_child=covariance)
        # Chi-squared with 6 degrees of freedom exceeds 16.8 once in a hundred recordings.
        assert_nees([nees_of(stated, truth)], 0.0, 16.8)
    assert n_biased >= 5


def test_on_a_road_no_bias_is_assumed_that_a_mount_askew_looks_like():
    """With one along all axes this drive came out 130 mm and 0.69 deg off."""
    drive = real_data.simple_kitti("06")

    result = hec.calibrate(drive.parent, drive.child)

    error = deviation(result.T_parent_child, real_data.SIMPLE_KITTI_TRUTH)
    # y points down: the plane is x, z
    plane_error_m = np.hypot(error[0], error[2])
    assert plane_error_m < 0.09
    # The other drives are 0.23 and 0.26 deg off.
    rotation_error = np.linalg.norm(error[3:])
    assert np.degrees(rotation_error) < 0.3
