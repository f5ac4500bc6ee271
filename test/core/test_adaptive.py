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
from sigmas import assert_nees, nees

import hand_eye_calib as hec
from hand_eye_calib.core.assessment.covariance import assess_adaptive
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
    velocities = se3.log(se3.inverse(poses[:-2]) @ poses[2:]) / (2 * interval_s)
    return poses @ se3.exp(
        -seconds * np.concatenate([velocities[:1], velocities, velocities[-1:]])
    )


def biased(poses, bias):
    """Poses whose path is off by so much per metre, along their own axes."""
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    # the estimator takes the bias out per metre of the disturbed path
    disturbed_steps = true_steps = steps[:, :3, 3].copy()
    for _ in range(50):
        disturbed_steps = true_steps + bias * np.linalg.norm(
            disturbed_steps, axis=1, keepdims=True
        )
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


NO_SYSTEMATIC_ERROR = np.zeros(increments.N_SYSTEMATIC)


def linearised(streams, T_parent_child=T_PARENT_CHILD, parameters=NO_SYSTEMATIC_ERROR):
    course = increments.course_of(streams, T_PARENT_CHILD)
    return increments.linearise(
        streams,
        course,
        T_parent_child,
        parameters,
        list(range(increments.N_SYSTEMATIC)),
    )


def inner_residuals(streams, T_parent_child, parameters):
    """Residuals without those of the first and last three increments."""
    return linearised(streams, T_parent_child, parameters).columns[3:-3, :, -1]


SCALE_COLUMN = 6


def test_derivatives_are_the_numerical_ones():
    times_s = np.arange(60) * 0.1
    parent = smooth_poses(times_s)
    streams = increments.Streams(times_s, parent, child_of(parent))
    jacobian = linearised(streams).columns[3:-3, :, :-1]
    step = 1e-6
    for column in range(6 + increments.N_SYSTEMATIC):
        change = np.zeros(6 + increments.N_SYSTEMATIC)
        change[column] = step
        ahead = inner_residuals(
            streams, T_PARENT_CHILD @ se3.exp(change[:6]), change[6:]
        )
        behind = inner_residuals(
            streams, T_PARENT_CHILD @ se3.exp(-change[:6]), -change[6:]
        )
        numerical = (ahead - behind) / (2 * step)
        tolerance = 2e-8
        if column == SCALE_COLUMN:
            # The derivative uses the increments before and after, which are less noisy.
            tolerance = 0.15 * np.abs(numerical).max()
        np.testing.assert_allclose(jacobian[:, :, column], numerical, atol=tolerance)


def smooth_poses(times_s):
    phases = np.outer(times_s, [0.9, 1.1, 0.7, 0.8, 1.0, 1.2]) + np.arange(6)
    return se3.exp(np.sin(phases) * [1.0, 1.0, 0.5, 0.3, 0.4, 0.8])


def disturbed_about_origin(poses, seed, sigma_m, sigma_rad):
    """Poses of a camera that sees a target: the errors are of the target in the camera's frame."""
    return se3.inverse(disturbed(se3.inverse(poses), seed, sigma_m, sigma_rad))


def noisy_drive(seed, n_poses=150, white=(0.004, 0.006), drift=(0.0, 0.0)):
    """(white m, rad), (drift m, rad per step), per sensor; drift on the child."""
    parent = wandering_poses(n_poses, seed)
    child = child_of(parent)
    steps = se3.inverse(child[:-1]) @ child[1:]
    wander = np.random.default_rng(1000 + seed).normal(
        size=(n_poses - 1, 6)
    ) * np.repeat(drift, 3)
    poses = walked(steps @ se3.exp(wander), child[0])
    return disturbed(parent, 2 * seed + 5, *white), disturbed(
        poses, 2 * seed + 6, *white
    )


def drift_of(noise):
    return noise.translation_drift_m_per_pose, noise.rotation_drift_rad_per_pose


@pytest.mark.statistics
@pytest.mark.parametrize(
    ("white", "drift"), [((0.004, 0.006), (0.0, 0.0)), ((0.001, 0.001), (0.004, 0.003))]
)
def test_the_noise_levels_are_recovered(white, drift):
    levels = []
    for seed in range(5):
        parent, child = noisy_drive(seed, white=white, drift=drift)
        noise = estimator.solve(stamps(150), parent, child, systematic=()).noise
        levels.append(
            [noise.translation_white_m, noise.rotation_white_rad, *drift_of(noise)]
        )
    median = np.median(levels, axis=0)
    expected = np.r_[np.sqrt(2) * np.array(white), drift]
    strong = expected > 0.5 * expected.max()
    np.testing.assert_allclose(median[strong], expected[strong], rtol=0.2)
    assert (median[~strong] < 0.5 * expected.max()).all()


def test_the_walk_of_a_long_recording_is_found_from_bursts_far_apart():
    drift = (0.001, 0.0005)
    parent, child = noisy_drive(1, 5_000, white=(0.002, 0.001), drift=drift)
    levels = estimator.solve(stamps(5_000), parent, child, systematic=()).noise
    np.testing.assert_allclose(drift_of(levels), drift, rtol=0.3)


def lasting(seed, n_poses, sigmas, tau_poses):
    """Gauss-Markov errors (N, 6) of these standard deviations and correlation time."""
    random = np.random.default_rng(seed)
    phi = np.exp(-1.0 / tau_poses)
    errors = random.normal(size=(n_poses, 6)) * np.repeat(sigmas, 3)
    for i in range(1, n_poses):
        errors[i] = phi * errors[i - 1] + np.sqrt(1 - phi**2) * errors[i]
    return errors


def fixed_to_body(parent, child, errors):
    return parent, child @ se3.exp(errors)


def fixed_to_world(parent, child, errors):
    to_body = np.swapaxes(parent[:, :3, :3], 1, 2)
    translations = se3.times(to_body, errors[:, :3])
    rotations = se3.times(to_body, errors[:, 3:])
    return parent @ se3.exp(np.concatenate([translations, rotations], axis=1)), child


def of_direction(parent, child, errors):
    """Errors of the direction in which the child travels: its increments are turned."""
    steps = se3.inverse(child[:-1]) @ child[1:]
    turns = np.roll(errors[1:], 3, axis=1)
    steps[:, :3, 3] = se3.times(se3.exp(turns)[:, :3, :3], steps[:, :3, 3])
    return parent, walked(steps, child[0])


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
        process for process in solution.noise.lasting if process.part == added.part
    ]
    strongest = max(processes, key=lambda process: process.sigma)
    # Rotations fixed to the body are no process: the scatter of the tenths has to state them.
    assessment = assess_adaptive(PosePairs(stamps(600), parent, child), solution)
    covariance = assessment.cov_parent_child_in_child
    return replace(solution, cov_parent_child_in_child=covariance), strongest


@pytest.mark.statistics
@pytest.mark.parametrize("kind", LASTING)
def test_errors_that_last_are_found_and_told_apart(kind):
    recordings = [solved_with_lasting(kind, seed) for seed in range(4)]
    for _, process in recordings:
        assert process.sigma == pytest.approx(LASTING[kind].sigma, rel=0.5)
        assert process.tau_s == pytest.approx(0.1 * LASTING[kind].tau_poses, rel=0.8)
    assert [process.kind for _, process in recordings].count(kind) >= 3
    assert_nees([nees_of(solution) for solution, _ in recordings], 2.0, 12.0, np.median)


def test_flicker_is_stated_beyond_what_was_found():
    """Errors that last on all scales: the longest cannot be found, and X takes their mean."""
    parent = wandering_poses(500)
    error = sum(
        lasting(seed, 500, [0.004, 0.004], tau) for seed, tau in enumerate((3, 30, 300))
    )
    child = child_of(parent) @ se3.exp(error)
    stated = estimator.solve(stamps(500), parent, child)
    without = replace(TUNING, undetected_share=0.0)
    measured = estimator.solve(stamps(500), parent, child, tuning=without)
    unseen = stated.cov_parent_child_in_child - measured.cov_parent_child_in_child
    unseen_m = np.sqrt(np.diag(unseen)[:3])
    assert (unseen_m > 0.2e-3).all()
    assert (unseen_m < 4e-3).all()


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
    error = se3.log(se3.inverse(solution.T_parent_child) @ truth)
    return nees(error, solution.cov_parent_child_in_child)


@pytest.mark.statistics
def test_errors_are_as_large_as_stated():
    drives = [noisy_drive(seed) for seed in range(24)]
    values = [nees_of(estimator.solve(stamps(150), *drive)) for drive in drives]
    # Chi-squared with 6 degrees of freedom has mean 6 and variance 12: the mean of 24 draws has a
    # standard error of 0.7, of which three are allowed.
    assert_nees(values, 3.9, 8.1)


@cache
def noisy_and_solved(nuisance, seed):
    """Both streams with a systematic error and noise, and their solution."""
    streams = systematic(wandering_poses(300, seed), nuisance, VALUES[nuisance])
    noisy = with_noise(streams, seed)
    return noisy, estimator.solve(stamps(300), *noisy)


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
    np.testing.assert_allclose(
        np.median(parameters, axis=0), VALUES[nuisance], atol=3e-3
    )


@pytest.mark.parametrize("seed", range(4))
def test_a_lag_is_measured_and_stated(seed):
    _, solution = noisy_and_solved("time", seed)
    assert solution.time_offset_s == pytest.approx(-0.02, abs=1e-3)
    words = " ".join(solution.describe(stamps(300)).in_words)
    assert re.search(
        r"the child's stamps are (19|20|21)\.\d \+/- 0\.\d+ ms late", words
    )


@pytest.mark.statistics
def test_a_lag_is_not_taken_for_a_lever():
    def lever_error_m(solution):
        return np.linalg.norm(solution.T_parent_child[:3, 3] - T_PARENT_CHILD[:3, 3])

    errors_m = []
    errors_without_m = []
    for seed in range(4):
        streams, solution = noisy_and_solved("time", seed)
        without = estimator.solve(stamps(300), *streams, systematic=())
        errors_m.append(lever_error_m(solution))
        errors_without_m.append(lever_error_m(without))
    assert np.median(errors_m) < 0.3 * np.median(errors_without_m)


def test_on_flat_ground_no_sideways_slip_is_assumed():
    # It could not be told from a child that is mounted askew; forwards and upwards it can.
    streams = systematic(planar_poses(400), "bias", [0.0, 0.05, 0.0])
    solution = estimator.solve(stamps(400), *with_noise(streams, 1))
    assert abs(solution.parameters[increments.PARAMETERS["bias"][1]]) < 1e-3


def test_poses_wrong_by_themselves_are_bridged():
    parent, child = noisy_drive(4, white=(0.002, 0.002))
    spikes = np.array([20, 41, 42, 80, 120])
    child[spikes] = child[spikes] @ se3.exp(
        np.random.default_rng(5).normal(0, 0.2, (5, 6))
    )
    child[100:, :3, 3] += [0.3, -0.2, 0.1]
    solution = estimator.solve(stamps(150), parent, child)
    np.testing.assert_array_equal(np.flatnonzero(solution.spikes), spikes)
    np.testing.assert_array_equal(np.flatnonzero(solution.jumps), [99])
    steps = [19, 20, 40, 41, 42, 79, 80, 99, 119, 120]
    np.testing.assert_array_equal(np.flatnonzero(solution.left_out), steps)
    undisturbed = estimator.solve(stamps(150), *noisy_drive(4, white=(0.002, 0.002)))
    np.testing.assert_allclose(
        solution.T_parent_child, undisturbed.T_parent_child, atol=2e-3
    )
    words = " ".join(solution.describe(stamps(150)).in_words)
    assert "5 outlier poses, left out, at 2.000, 4.100, 4.200, 8.000, 12.000 s" in words
    assert "1 jump of a trajectory, just before 10.000 s" in words


@pytest.mark.statistics
def test_heavy_tails_leave_the_answer_near():
    random = np.random.default_rng(3)
    values = []
    for seed in range(6):
        parent = wandering_poses(200, seed)
        tails = np.sqrt(3 / random.chisquare(3, (2, 200, 1)))
        noise = se3.exp(
            random.normal(size=(2, 200, 6)) * tails * np.repeat([0.003, 0.004], 3)
        )
        solution = estimator.solve(
            stamps(200), parent @ noise[0], child_of(parent) @ noise[1]
        )
        values.append(nees_of(solution))
    assert_nees(values, 0.0, 10.0, np.median)


def test_a_long_recording_is_solved_in_parts(monkeypatch):
    parent, child = fixed_to_body(
        *noisy_drive(6, 900), lasting(7, 900, [0.02, 0.0], 20)
    )
    child[300:, :3, 3] += [0.5, -0.3, 0.2]
    whole = estimator.solve(stamps(900), parent, child)
    for module in (partwise, fit):
        monkeypatch.setattr(module, "MAX_POSES", 200)
    in_parts = estimator.solve(stamps(900), parent, child)
    sigmas = np.sqrt(np.diag(whole.cov_parent_child_in_child))
    difference = deviation(in_parts.T_parent_child, whole.T_parent_child)
    assert 0.0 < np.max(np.abs(difference) / sigmas) < 0.5
    ratios = np.sqrt(np.diag(in_parts.cov_parent_child_in_child)) / sigmas
    assert np.all((ratios > 0.95) & (ratios < 1.1))
    assert (
        np.flatnonzero(in_parts.jumps).tolist()
        == np.flatnonzero(whole.jumps).tolist()
        == [299]
    )
    assert ("body", "translation") in whole.model.processes
    assert in_parts.model.processes == whole.model.processes
    assert in_parts.converged


def target_seen_by(camera, seed):
    """Poses of parent and child, one of which is a camera that sees a target."""
    parent = wandering_poses(200, seed)
    child = child_of(
        parent, T_cw_pw=se3.exp(np.array([1.0, -1.0, 0.5, 0.5, 0.2, -2.0]))
    )
    parent = se3.exp(np.array([-1.0, 0.4, 0.8, 0.1, 0.7, -0.4])) @ parent
    if camera == "child":
        return parent, disturbed_about_origin(child, 300 + seed, 0.003, 0.004)
    return disturbed_about_origin(parent, 300 + seed, 0.003, 0.004), child


@pytest.mark.statistics
@pytest.mark.parametrize("camera", CENTRES[1:])
def test_a_camera_that_sees_a_target_swings_about_it(camera):
    drives = [target_seen_by(camera, seed) for seed in range(6)]
    solutions = [estimator.solve(stamps(200), *drive) for drive in drives]
    assert [solution.model.centre for solution in solutions] == [camera] * 6
    assert_nees([nees_of(solution) for solution in solutions], 2.0, 11.0, np.median)


def test_jumps_of_either_sensor_are_found_at_their_places():
    parent, child = noisy_drive(3, white=(0.002, 0.002))
    parent[60:, :3, 3] += [0.3, -0.2, 0.1]
    child[100:] = se3.exp(np.array([0.0, 0.1, 0.2, 0.0, 0.3, 0.0])) @ child[100:]
    solution = estimator.solve(stamps(150), parent, child)
    assert {59, 99} <= set(np.flatnonzero(solution.jumps).tolist())
    assert solution.jumps.sum() <= 4
    np.testing.assert_allclose(solution.T_parent_child, T_PARENT_CHILD, atol=0.02)


@pytest.mark.parametrize("level", [0.0, 1e-3])
def test_flat_ground_hides_the_height_and_only_that(level):
    parent = planar_poses(200)
    parent, child = (
        disturbed(parent, 1, level, level),
        disturbed(child_of(parent), 2, level, level),
    )
    solution = estimator.solve(stamps(200), parent, child)
    assessment = assess_adaptive(PosePairs(stamps(200), parent, child), solution)
    verdicts = {dof.name: dof.verdict for dof in assessment.observability}
    assert [axis for axis in verdicts if verdicts[axis] is DofVerdict.UNOBSERVABLE] == [
        "z"
    ]
    np.testing.assert_allclose(
        solution.T_parent_child[:2, 3], T_PARENT_CHILD[:2, 3], atol=0.01
    )


def test_no_motion_at_all_is_no_number():
    still = np.repeat(np.eye(4)[None], 40, axis=0)
    parent, child = with_noise((still, child_of(still)), 1)
    solution = estimator.solve(stamps(40), parent, child)
    assert np.isfinite(solution.T_parent_child).all()
    assessment = assess_adaptive(PosePairs(stamps(40), parent, child), solution)
    verdicts = {dof.name: dof.verdict for dof in assessment.observability}
    assert all(verdicts[axis] is DofVerdict.UNOBSERVABLE for axis in "xyz")


def mixture(number):
    """Poses of a drive with the paper's mixture of errors, and the true extrinsic."""
    drive = simulate_drive((0, number), DriveConfig(poses=200))
    rng = np.random.default_rng((0, number, 0))
    streams = add_noise(drive.parent.poses, drive.child.poses, MIXTURE, rng)
    return PosePairs(drive.parent.stamps_ns, *streams), drive.T_parent_child


@pytest.mark.statistics
def test_a_drift_that_a_mount_askew_nearly_explains_is_found():
    # With a drift along all axes the standard deviations of X would grow to 5.8 and 3.3 times those
    # without.
    n_biased = 0
    for number in range(6):
        poses, truth = mixture(number)
        solution = estimator.solve(poses.stamps_ns, poses.Ts_pw_p, poses.Ts_cw_c)
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
    off = deviation(result.T_parent_child, real_data.SIMPLE_KITTI_TRUTH)
    assert np.hypot(off[0], off[2]) < 0.09  # y points down: the plane is x, z
    # The other drives are 0.23 and 0.26 deg off.
    assert np.degrees(np.linalg.norm(off[3:])) < 0.3
