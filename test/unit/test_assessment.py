from itertools import accumulate

import numpy as np
import pytest
from motions import T_PARENT_CHILD, child_of, disturbed, wandering_poses

from hand_eye_calib.assessment.covariance import assess, judged
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls import estimator
from hand_eye_calib.gls.normal import answers_without
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.results.calibration import DofVerdict
from hand_eye_calib.solvers.registry import Method

DNL = Method("dnl")


def solve_and_assess(parent, child, reference="B1", method=DNL):
    pairs = motion_pairs(parent, child, reference)
    solution = method.solve(pairs)
    return solution, assess(
        pairs, solution, lambda left_out: method.solve_without(pairs, solution, left_out)
    )


def errors_and_covariances(n_runs, estimate):
    """Errors xi against the truth (R, 6) and covariances (R, 6, 6) over independent noise."""
    parent = wandering_poses(120)
    child = child_of(parent)
    errors, covariances = [], []
    for run in range(n_runs):
        solution, covariance = estimate(
            disturbed(parent, 2 * run, 0.005, 0.005), disturbed(child, 2 * run + 1, 0.005, 0.005)
        )
        errors.append(se3.log(se3.inverse(solution.T_parent_child) @ T_PARENT_CHILD))
        covariances.append(covariance)
    return np.array(errors), np.array(covariances)


def test_the_stated_sigma_is_the_scatter_that_is_found():
    def estimate(parent, child):
        solution, assessment = solve_and_assess(parent, child, "B10")
        return solution, assessment.cov_parent_child_in_child

    errors, covariances = errors_and_covariances(60, estimate)
    found = np.sqrt((errors**2).mean(axis=0))
    stated = np.sqrt(np.median(np.diagonal(covariances, axis1=1, axis2=2), axis=0))
    assert (stated > 0.7 * found).all()
    assert (stated < 2.5 * found).all()


@pytest.mark.parametrize("kind", ["white", "drift"])
def test_the_jackknife_of_the_adaptive_estimator_is_the_size_of_a_model_that_is_right(kind):
    ratios = []
    for run in range(12):
        parent = wandering_poses(150, seed=run)
        child = (
            disturbed(child_of(parent), run, 0.005, 0.005)
            if kind == "white"
            else drifting(child_of(parent), run)
        )
        stamps_ns = np.arange(len(parent)) * 100_000_000
        solution = estimator.solve(stamps_ns, parent, child, systematic=())
        model = solution.cov_parent_child_in_child / solution.misfit
        deviations = answers_without(solution.part_products, 10)[:, :6]
        deviations -= deviations.mean(axis=0)
        resampled = 0.9 * deviations.T @ deviations
        ratios.append(np.trace(np.linalg.solve(model, resampled)) / 6)
    # Cutting the trajectory around what is left out would give 2 and more under white noise.
    assert 0.7 < np.mean(ratios) < 1.4


def drifting(poses, seed):
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    steps = steps @ se3.exp(np.random.default_rng(seed).normal(0.0, 0.003, (len(steps), 6)))
    return np.array(list(accumulate([poses[0], *steps], np.matmul)))


@pytest.mark.parametrize(
    ("axis", "sigma", "verdict"),
    [
        ("z", 0.04, DofVerdict.OBSERVED),
        ("z", 0.06, DofVerdict.WEAK),
        ("z", 1.19, DofVerdict.UNOBSERVABLE),
        ("yaw", 0.01, DofVerdict.OBSERVED),
        ("yaw", 0.02, DofVerdict.WEAK),
        ("yaw", 0.31, DofVerdict.UNOBSERVABLE),
    ],
)
def test_an_axis_is_judged_by_its_standard_deviation(axis, sigma, verdict):
    judgement = judged(axis, sigma)
    assert (judgement.name, judgement.verdict) == (axis, verdict)
    assert judgement.sigma == (np.inf if verdict is DofVerdict.UNOBSERVABLE else sigma)
