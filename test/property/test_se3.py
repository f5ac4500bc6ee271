"""The group axioms, with samples deliberately near zero and near half a turn."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hand_eye_calib.geometry import se3

ANGLES = st.one_of(
    st.sampled_from([0.0, 1e-12, 1e-8, 1e-4, 9.9e-3, 1.01e-2, np.pi - 1e-6, np.pi - 1e-3]),
    st.floats(0.0, np.pi - 1e-3),
)
DIRECTIONS = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)
TRANSLATIONS = st.tuples(*[st.floats(-1000, 1000)] * 3)


@st.composite
def tangents(draw):
    direction = np.array(draw(DIRECTIONS))
    return np.r_[draw(TRANSLATIONS), draw(ANGLES) * direction / np.linalg.norm(direction)]


@given(tangents())
def test_log_inverts_exp(xi):
    # Near half a turn the logarithm's condition grows with 1 / (pi - angle).
    tolerance = 1e-9 * (1 + np.abs(xi[:3]).max())
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=tolerance, rtol=0)


@given(tangents())
def test_exp_agrees_with_the_matrix_exponential(xi):
    from scipy.linalg import expm

    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = se3.skew(xi[3:]), xi[:3]
    np.testing.assert_allclose(se3.exp(xi), expm(generator), atol=1e-11 * (1 + np.abs(xi).max()), rtol=0)


@given(tangents(), tangents())
def test_adjoint_moves_a_twist_across_a_transform(xi, pose_xi):
    T = se3.exp(pose_xi)
    small = 1e-3 * xi / (1 + np.linalg.norm(xi))
    np.testing.assert_allclose(T @ se3.exp(small), se3.exp(se3.adjoint(T) @ small) @ T, atol=1e-9, rtol=1e-9)


@given(tangents())
def test_inverse_and_quaternions_go_round(xi):
    T = se3.exp(xi)
    np.testing.assert_allclose(se3.inverse(T) @ T, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(se3.from_quat_xyzw(T[:3, 3], se3.to_quat_xyzw(T)), T, atol=1e-9)


@given(tangents())
def test_rotation_angle_is_the_length_of_the_rotation_vector(xi):
    np.testing.assert_allclose(se3.rotation_angle(se3.exp(xi)[:3, :3]), np.linalg.norm(xi[3:]), rtol=1e-7, atol=1e-15)


@given(tangents(), tangents(), st.floats(0, 1))
def test_interpolation_runs_at_constant_twist(start_xi, step_xi, fraction):
    start = se3.exp(start_xi)
    end = start @ se3.exp(step_xi)
    between = se3.interpolate(start, end, fraction)
    np.testing.assert_allclose(
        se3.log(se3.inverse(start) @ between), fraction * step_xi, atol=1e-7 * (1 + np.abs(step_xi).max())
    )


@given(DIRECTIONS, st.one_of(ANGLES, st.just(np.pi)))
def test_rotation_log_agrees_with_scipy_up_to_exact_half_turns(direction, angle):
    from scipy.spatial.transform import Rotation

    axis = np.array(direction) / np.linalg.norm(direction)
    half_turn = 2 * np.outer(axis, axis) - np.eye(3)
    rotation = half_turn if angle == np.pi else se3.rotation_exp(angle * axis)
    found, expected = se3.rotation_log(rotation), Rotation.from_matrix(rotation).as_rotvec()
    # At half a turn both signs are right.
    np.testing.assert_allclose(min(found, -found, key=lambda v: np.abs(v - expected).max()), expected, atol=1e-14)
    if angle < np.pi:
        assert found @ expected >= 0.0


def test_rotation_log_of_a_stack_is_that_of_each():
    rotations = se3.rotation_exp(np.random.default_rng(0).normal(size=(4, 5, 3)) * 2)
    one_by_one = [[se3.rotation_log(rotation) for rotation in row] for row in rotations]
    np.testing.assert_array_equal(se3.rotation_log(rotations), one_by_one)
    assert se3.rotation_log(np.empty((0, 3, 3))).shape == (0, 3)
