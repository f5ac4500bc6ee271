"""Park, Taylor, Zhuang, Ali and the four metrics, against their definitions written out pair by
pair.
"""

import numpy as np
import pytest
from motions import child_of, disturbed, wandering_poses
from numpy.testing import assert_allclose
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import absolute_errors
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs, motion_pairs
from hand_eye_calib.core.solvers import all_pairs, zhuang
from reproduction import ali_as_published
from reproduction.metrics import relative_errors

TRUTH = se3.exp(np.array([0.4, -0.2, 0.7, 0.9, -0.5, 1.1]))


def pairs_of(Ts_parenti_parentj, Ts_childi_childj):
    index = np.arange(len(Ts_parenti_parentj))
    return MotionPairs(
        np.asarray(Ts_parenti_parentj),
        np.asarray(Ts_childi_childj),
        index,
        index + 1,
    )


def random_pairs(noise=0.0, n_poses=25):
    """Motions of about 1 m and 0.5 rad, with noise (m and rad) on both sensors' poses."""
    true_parent = wandering_poses(n_poses, step_m=0.6, step_rad=0.4)
    true_child = child_of(true_parent, TRUTH, np.eye(4))
    parent = disturbed(true_parent, 1, noise, noise)
    child = disturbed(true_child, 2, noise, noise)
    return motion_pairs(parent, child, "B1")


def split(T):
    rotation = T[:3, :3]
    translation = T[:3, 3]
    return rotation, translation


def squared_translation_residual(pairs, rotation, translation):
    total = 0.0
    for A, B in zip(
        pairs.Ts_parenti_parentj, pairs.Ts_childi_childj, strict=True
    ):
        R_A, t_A = split(A)
        _, t_B = split(B)
        residual = R_A @ translation + t_A - rotation @ t_B - translation
        total += np.sum(residual**2)
    return total


@pytest.fixture
def noisy():
    return random_pairs(noise=0.03)


def test_relative_errors_of_a_pair_worked_out_by_hand():
    # The parent turns a quarter about z and moves by (1, 0, 0); X only shifts by (2, 0, 0): R_A t +
    # t_A - R t_B - t = (-1, 2, 0) - t_B.
    quarter_rad = np.pi / 2
    parent_rotation = se3.rotation_exp(np.array([0, 0, quarter_rad]))
    child_rotation = se3.rotation_exp(np.array([0, 0, quarter_rad - 0.25]))
    A = se3.from_rotation_translation(parent_rotation, [1.0, 0.0, 0.0])
    B = se3.from_rotation_translation(child_rotation, [-1.0, 2.0, 3.0])
    X = se3.from_rotation_translation(np.eye(3), [2.0, 0.0, 0.0])
    pairs = pairs_of([A], [B])

    e_rt, e_rR = relative_errors(pairs, X)

    assert e_rt == pytest.approx(3.0, abs=1e-14)
    assert e_rR == pytest.approx(0.25, abs=1e-14)


@pytest.mark.parametrize("angle", [1e-12, 1e-7, 1e-3, 1.0, np.pi - 1e-7, np.pi])
def test_absolute_errors_keep_their_digits_at_any_angle(angle):
    axis = np.array([0.6, 0.0, 0.8])
    twist = np.concatenate([np.zeros(3), angle * axis])
    turned = TRUTH @ se3.exp(twist)
    turned[:3, 3] += [3e-9, 0.0, -4e-9]

    e_at, e_aR = absolute_errors(turned, TRUTH)

    assert e_at == pytest.approx(5e-9, rel=1e-6)
    assert e_aR == pytest.approx(angle, abs=1e-15, rel=1e-9)


def test_park_aligns_the_rotation_vectors(noisy):
    rotvecs = [
        se3.rotation_log(T[:, :3, :3])
        for T in (noisy.Ts_parenti_parentj, noisy.Ts_childi_childj)
    ]
    expected, _ = Rotation.align_vectors(*rotvecs)
    assert_allclose(
        all_pairs.solve_park(noisy).T_parent_child[:3, :3],
        expected.as_matrix(),
        atol=1e-12,
    )


def test_rotation_is_never_a_reflection():
    # Rotation vectors in a plane leave the sign of the third axis to the determinant.
    # Rotation vectors in a plane leave the sign of the third axis to the determinant.
    twists = np.array(
        [
            [0.3, 0.1, 0.2, 0.5, 0.0, 0.0],
            [0.1, -0.3, 0.4, 0.0, 0.4, 0.0],
            [0.2, 0.2, 0.1, 0.3, 0.3, 0.0],
        ]
    )
    motions = se3.exp(twists)
    pairs = pairs_of(motions, se3.inverse(TRUTH) @ motions @ TRUTH)

    solution = all_pairs.solve_park(pairs)

    assert_allclose(solution.T_parent_child, TRUTH, atol=1e-12)


def unit_axes(Ts):
    """Unit rotation axes (K, 3) of motions (K, 4, 4)."""
    rotations = Ts[:, :3, :3]
    rotvecs = se3.rotation_log(rotations)
    angles = np.linalg.norm(rotvecs, axis=1, keepdims=True)
    return rotvecs / angles


def test_zhuang_ends_where_the_written_out_cost_is_lowest(noisy):
    """Eqs 14-16, with z the rotation's axis times the tangent of half its angle."""
    parent = noisy.Ts_parenti_parentj
    child = noisy.Ts_childi_childj
    parent_axes = unit_axes(parent)
    child_axes = unit_axes(child)
    parent_translations = parent[:, :3, 3]
    child_translations = child[:, :3, 3]
    turns = parent[:, :3, :3] - np.eye(3)

    def cost(parameters):
        z = parameters[:3]
        t = parameters[3:]
        minus = np.eye(3) - se3.skew(z)
        plus = np.eye(3) + se3.skew(z)
        f = parent_axes @ minus.T - child_axes @ plus.T
        ahead = turns @ t + parent_translations
        g = ahead @ minus.T - child_translations @ plus.T
        return np.sum(f**2) + np.sum(g**2)

    rotation, translation = split(zhuang.solve(noisy).T_parent_child)
    rotvec = se3.rotation_log(rotation)
    angle = np.linalg.norm(rotvec)
    z = np.tan(angle / 2) * rotvec / angle
    parameters = np.concatenate([z, translation])

    lowest = minimize(cost, parameters, tol=1e-10)

    assert_allclose(lowest.x, parameters, atol=1e-5)


def test_ali_minimises_the_translation_residual_over_rotations(noisy):
    def cost(parameters):
        return squared_translation_residual(
            noisy, se3.rotation_exp(parameters[:3]), parameters[3:]
        )

    solution = all_pairs.solve_ali(noisy)
    rotation, translation = split(solution.T_parent_child)
    assert solution.converged
    assert solution.objective == pytest.approx(
        squared_translation_residual(noisy, rotation, translation), rel=1e-12
    )
    assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    random = np.random.default_rng(1)
    minima = [
        minimize(cost, random.uniform(-1.5, 1.5, 6), tol=1e-12).fun
        for _ in range(5)
    ]
    assert solution.objective <= min(minima) * (1 + 1e-9)
    assert solution.objective == pytest.approx(min(minima), rel=1e-6)


def test_ali_is_blind_to_the_rotation_of_the_child(noisy):
    turned = noisy.Ts_childi_childj.copy()
    turned[:, :3, :3] = np.eye(3)
    without_rotation = pairs_of(noisy.Ts_parenti_parentj, turned)

    ali = all_pairs.solve_ali(noisy)
    same = all_pairs.solve_ali(without_rotation)
    park = all_pairs.solve_park(noisy)

    assert same.objective == pytest.approx(ali.objective, rel=1e-9)
    assert park.objective > same.objective


def test_ali_as_published_fits_a_matrix_that_is_no_rotation(noisy):
    assert (
        ali_as_published.solve(noisy).objective
        > all_pairs.solve_ali(noisy).objective
    )
