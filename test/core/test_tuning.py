"""Change each number of Tuning, and require that a solution changes."""

import ast
from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest
from motions import child_of, disturbed, planar_poses, walked, wandering_poses
from source_code import ROOT

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.noise import estimator
from hand_eye_calib.extras.partial import positions
from hand_eye_calib.extras.partial.position_tuning import (
    TUNING,
    PositionTuning,
)

N_POSES = 360


def stamps(n_poses):
    random = np.random.default_rng(1)
    gaps_s = np.full(n_poses, 0.1)
    gaps_s[n_poses // 2] = 30.0
    return np.cumsum(gaps_s * 1e9).astype(np.int64) + random.integers(
        0, 2_000_000, n_poses
    )


def lasting_errors(seed, n_poses, sigma, tau_poses):
    """Return Gauss-Markov errors (N, 6)."""
    random = np.random.default_rng(seed)
    phi = np.exp(-1.0 / tau_poses)
    innovation = np.sqrt(1.0 - phi**2)
    errors = sigma * random.normal(size=(n_poses, 6))
    for k in range(1, n_poses):
        errors[k] = phi * errors[k - 1] + innovation * errors[k]
    return errors


def drive():
    """Return poses with time-correlated errors, heavy tails, outliers, a jump, scale and delay."""
    random = np.random.default_rng(3)
    parent = wandering_poses(N_POSES, 3)
    lasting = lasting_errors(4, N_POSES, 0.01, 15)
    child = child_of(parent) @ se3.exp(lasting)
    child[:, :3, 3] /= 1.02
    child[200:, :3, 3] += [0.3, -0.2, 0.1]
    for pose in (40, 41, 90, 301):
        outlier = se3.exp(random.normal(0.0, 0.2, 6))
        child[pose] = child[pose] @ outlier
    tails = np.sqrt(3.0 / random.chisquare(3, (N_POSES, 1)))
    noise = tails * random.normal(0.0, 0.002, (N_POSES, 6))
    child = child @ se3.exp(noise)
    return disturbed(parent, 6, 1e-3, 1e-3), child


def bursts():
    """Return poses whose white noise is ten times as large during a part of the recording."""
    random = np.random.default_rng(5)
    parent = wandering_poses(N_POSES, 5)
    is_burst = np.arange(N_POSES) % 60 < 20
    sigmas = np.where(is_burst, 0.01, 0.001)[:, None]
    noise = sigmas * random.normal(size=(N_POSES, 6))
    child = child_of(parent) @ se3.exp(noise)
    return disturbed(parent, 7, 1e-3, 1e-3), child


def target():
    """Return poses of a camera at a target, whose rotation noise exceeds the rotation per pose."""
    parent = wandering_poses(N_POSES, 7, step_m=0.02, step_rad=0.01)
    T_cw_pw = se3.exp(np.array([1.0, -1.0, 0.5, 0.5, 0.2, -2.0]))
    child = child_of(parent, T_cw_pw=T_cw_pw)
    child = se3.inverse(disturbed(se3.inverse(child), 8, 0.002, 0.01))
    return parent, child


def sideways():
    """Return poses of a child that slips sideways on flat ground."""
    parent = planar_poses(N_POSES)
    child = child_of(parent)
    steps = se3.inverse(child[:-1]) @ child[1:]
    lengths_m = np.linalg.norm(steps[:, :3, 3], axis=1)
    steps[:, 1, 3] += 0.05 * lengths_m
    child = walked(steps, child[0])
    return disturbed(parent, 9, 1e-3, 1e-3), disturbed(child, 10, 1e-3, 1e-3)


def heavy_walk():
    """Return poses of an odometry whose steps have heavy tails."""
    random = np.random.default_rng(13)
    parent = wandering_poses(N_POSES, 13)
    child = child_of(parent)
    tails = np.sqrt(2.5 / random.chisquare(2.5, (N_POSES - 1, 1)))
    drift = se3.exp(tails * random.normal(0.0, 2e-3, (N_POSES - 1, 6)))
    steps = se3.inverse(child[:-1]) @ child[1:] @ drift
    return parent, walked(steps, child[0])


def antenna():
    """Return positions of an antenna with a jump, noisy periods and time-correlated errors."""
    random = np.random.default_rng(11)
    poses = wandering_poses(N_POSES, 11)
    drift = np.zeros((N_POSES - 1, 6))
    drift[:, 3:] = 2e-3 * random.normal(size=(N_POSES - 1, 3))
    steps = se3.inverse(poses[:-1]) @ poses[1:] @ se3.exp(drift)
    odometry = walked(steps)

    lever_arm = [0.8, -0.5, 1.2]
    positions = poses[:, :3, :3] @ lever_arm + poses[:, :3, 3]
    positions += 0.01 * random.normal(size=(N_POSES, 3))
    positions += lasting_errors(12, N_POSES, 0.02, 15)[:, :3]
    positions[150:180] += 0.3 * random.normal(size=(30, 3))
    positions[250:] += [0.5, 0.2, -0.3]
    return odometry, positions


POSES = {
    "drive": drive,
    "bursts": bursts,
    "target": target,
    "sideways": sideways,
    "heavy walk": heavy_walk,
}


@cache
def numbers_of(case, tuning):
    """Return the numbers of the solution of a case."""
    if case in POSES:
        parent, child = POSES[case]()
        solution = estimator.solve(
            stamps(N_POSES), parent, child, tuning=tuning
        )
        answer = solution.T_parent_child, solution.cov_parent_child_in_child
    else:
        odometry, measured = antenna()
        with_scale = case == "antenna of another scale"
        times_ns = stamps(N_POSES)
        solution = positions.solve(
            times_ns, odometry, measured, with_scale, tuning
        )
        answer = solution.lever_arm, solution.covariance
    return np.concatenate(
        [np.ravel(array) for array in (*answer, solution.levels)]
    ).tolist()


# Another value of each number, and a case that it changes.
CHANGES = {
    "start_reference": ("A", "drive"),
    "most_poses": (150, "drive"),
    "burst": ((0, 1, 2), "drive"),
    "jitter": (-12.0, "drive"),
    "tau_precision": (0.6, "drive"),
    "caution": (20.0, "drive"),
    "settled_loss": (0.1, "bursts"),
    "false_alarms": (0.3, "drive"),
    "heavy_jump_factor": (1.0, "heavy walk"),
    "heavy_kurtosis": (0.85, "drive"),
    "walk_kurtosis": (0.75, "bursts"),
    "first_jump_sigmas": (10.0, "bursts"),
    "max_outlier_share": (0.4, "bursts"),
    "centre_ratio": (0.02, "target"),
    "noisy_share": (0.4, "target"),
    "strides": ((5,), "target"),
    "least_gain": (120.0, "drive"),
    "min_information": (100.0, "drive"),
    "start_share": (0.2, "drive"),
    "start_tau_intervals": (20.0, "drive"),
    "start_tau_share": (0.12, "drive"),
    "undetected_share": (0.1, "drive"),
    "sizes": (tuple(2.0 * size for size in TUNING.sizes), "drive"),
    "first_sizes": (tuple(2.0 * size for size in TUNING.first_sizes), "drive"),
    "absent_sigma": (2e-6, "drive"),
    "bias_gain_share": (1.5, "sideways"),
    "max_sigma_growth": (0.1, "drive"),
    "max_rounds": (3, "sideways"),
    "settled_sigmas": (0.02, "drive"),
    "unknown_m": (0.007, "sideways"),
    "rounds": (5, "antenna"),
    "fits": ((1, 2, 4), "antenna"),
    "rotation_walk": ((-26.6, -12.8, -1.3), "antenna"),
    "of_positions": (
        tuple(2.0 * sigma for sigma in TUNING.of_positions),
        "antenna",
    ),
    "accelerating_s": (0.4, "antenna"),
    "longest_span_factor": (5.0, "antenna"),
    "jump_factor": (20.0, "antenna"),
    "neighbours": (5, "antenna"),
    "worst_error_factor": (32.0, "antenna"),
    "window": (100, "antenna"),
}


def test_every_number_is_in_the_table():
    assert list(CHANGES) == [field.name for field in fields(PositionTuning)]


@pytest.mark.parametrize("name", CHANGES)
def test_a_number_that_is_passed_changes_the_solution(name):
    value, case = CHANGES[name]
    assert value != getattr(TUNING, name)
    assert numbers_of(case, replace(TUNING, **{name: value})) != numbers_of(
        case, TUNING
    )


def test_the_same_numbers_give_the_same_solution():
    for case in ("drive", "antenna"):
        assert numbers_of.__wrapped__(case, replace(TUNING)) == numbers_of(
            case, TUNING
        )


def names_of_the_default(tree):
    """Return syntax nodes that read TUNING, except defaults of arguments and fields."""
    is_default = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.arguments):
            is_default |= {
                id(value) for value in (*node.defaults, *node.kw_defaults)
            }
        if isinstance(node, ast.AnnAssign):
            is_default.add(id(node.value))
    names = [node for node in ast.walk(tree) if isinstance(node, ast.Name)]
    return [
        node
        for node in names
        if node.id == "TUNING" and id(node) not in is_default
    ]


def test_no_search_reads_the_default_instead_of_what_was_passed():
    folder = ROOT / "hand_eye_calib"
    folders = (folder / "core" / "noise", folder / "extras" / "partial")
    searches = [path for place in folders for path in place.glob("*.py")]
    reading = {}
    for path in searches:
        names = names_of_the_default(
            ast.parse(path.read_text(encoding="utf-8"))
        )
        if "tuning.py" not in path.name and names:
            reading[path.name] = [node.lineno for node in names]
    assert len(searches) > 8
    assert reading == {}


def test_reading_the_default_is_detected():
    source = (
        "def f(tuning=TUNING):\n    x: int = TUNING\n    return TUNING.few\n"
    )
    assert [
        node.lineno for node in names_of_the_default(ast.parse(source))
    ] == [3]
