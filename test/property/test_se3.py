"""The group axioms, with samples deliberately near zero and near half a turn."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from hand_eye_calib.core.geometry import se3

ANGLES = st.one_of(
    st.sampled_from(
        [0.0, 1e-12, 1e-8, 1e-4, 9.9e-3, 1.01e-2, np.pi - 1e-6, np.pi - 1e-3]
    ),
    st.floats(0.0, np.pi - 1e-3),
)
DIRECTIONS = st.tuples(*[st.floats(-1, 1)] * 3).filter(
    lambda v: np.linalg.norm(v) > 0.1
)
TRANSLATIONS = st.tuples(*[st.floats(-1000, 1000)] * 3)


@st.composite
def tangents(draw):
    direction = np.array(draw(DIRECTIONS))
    return np.r_[
        draw(TRANSLATIONS), draw(ANGLES) * direction / np.linalg.norm(direction)
    ]


@given(tangents())
def test_log_inverts_exp(xi):
    # Near half a turn the logarithm's condition grows with 1 / (pi - angle).
    largest_m = np.abs(xi[:3]).max()
    tolerance = 1e-9 * (1 + largest_m)
    back = se3.log(se3.exp(xi))
    assert_allclose(back, xi, atol=tolerance, rtol=0)


@given(tangents())
def test_exp_agrees_with_the_matrix_exponential(xi):
    from scipy.linalg import expm

    generator = np.zeros((4, 4))
    generator[:3, :3] = se3.skew(xi[3:])
    generator[:3, 3] = xi[:3]
    assert se3.exp(xi) == pytest.approx(
        expm(generator), abs=1e-11 * (1 + np.abs(xi).max())
    )


@given(tangents(), tangents())
def test_adjoint_moves_a_twist_across_a_transform(xi, pose_xi):
    T = se3.exp(pose_xi)
    small = 1e-3 * xi / (1 + np.linalg.norm(xi))
    assert_allclose(
        T @ se3.exp(small),
        se3.exp(se3.adjoint(T) @ small) @ T,
        atol=1e-9,
        rtol=1e-9,
    )


@given(tangents())
def test_inverse_and_quaternions_go_round(xi):
    T = se3.exp(xi)
    identity = se3.inverse(T) @ T
    quat_xyzw = se3.to_quat_xyzw(T)
    back = se3.from_quat_xyzw(T[:3, 3], quat_xyzw)
    assert_allclose(identity, np.eye(4), atol=1e-9)
    assert_allclose(back, T, atol=1e-9)


@given(tangents(), tangents(), st.floats(0, 1))
def test_interpolation_runs_at_constant_twist(start_xi, step_xi, fraction):
    start = se3.exp(start_xi)
    end = start @ se3.exp(step_xi)
    between = se3.interpolate(start, end, fraction)
    assert_allclose(
        se3.log(se3.inverse(start) @ between),
        fraction * step_xi,
        atol=1e-7 * (1 + np.abs(step_xi).max()),
    )


@given(DIRECTIONS, st.one_of(ANGLES, st.just(np.pi)))
def test_conversions_agree_with_scipy(direction, angle):
    from scipy.spatial.transform import Rotation

    along = np.array(direction) / np.linalg.norm(direction)
    quat = np.r_[np.sin(angle / 2) * along, np.cos(angle / 2)]
    rotation = Rotation.from_quat(quat)
    assert_allclose(
        se3.from_quat_xyzw(np.zeros(3), 3.0 * quat)[:3, :3],
        rotation.as_matrix(),
        atol=1e-14,
        rtol=0,
    )
    assert se3.rotation_exp(rotation.as_rotvec()) == pytest.approx(
        rotation.as_matrix(), abs=1e-14
    )
    quat_xyzw = se3.to_quat_xyzw(rotation.as_matrix())
    expected = Rotation.from_matrix(rotation.as_matrix()).as_quat()
    assert quat_xyzw[3] >= 0.0
    assert_allclose(
        quat_xyzw * np.sign(quat_xyzw @ expected), expected, atol=1e-14, rtol=0
    )


@given(
    st.floats(-np.pi, np.pi),
    st.one_of(st.floats(-1.5, 1.5), st.sampled_from([-np.pi / 2, np.pi / 2])),
    st.floats(-np.pi, np.pi),
)
def test_roll_pitch_yaw_agree_with_scipy_up_to_gimbal_lock(roll, pitch, yaw):
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    assert se3.rotation_from_rpy([roll, pitch, yaw]) == pytest.approx(
        rotation, abs=1e-14
    )
    rpy = se3.rotation_to_rpy(rotation)
    assert_allclose(se3.rotation_from_rpy(rpy), rotation, atol=1e-14, rtol=0)
    if abs(pitch) < 1.51:
        # Half a turn may come out with either sign; near gimbal lock the digits of roll and yaw go.
        assert_allclose(
            np.exp(1j * rpy),
            np.exp(1j * np.array([roll, pitch, yaw])),
            atol=1e-14 / np.cos(pitch),
            rtol=0,
        )
    else:
        assert rpy[2] == 0.0


def test_a_quaternion_of_length_zero_is_refused():
    positions = np.zeros((2, 3))
    quats_xyzw = [[0, 0, 0, 1], [0, 0, 0, 0]]
    with pytest.raises(ValueError, match="length zero"):
        se3.from_quat_xyzw(positions, quats_xyzw)
