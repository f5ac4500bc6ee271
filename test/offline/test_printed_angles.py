"""The standard deviations beside the printed angles are those of these angles."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from result_making import calibration as made
from result_making import dofs

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.covariances import (
    inverse_covariance,
    sigmas_in_parent,
    sigmas_rpy,
)
from hand_eye_calib.core.results.calibration import SolveStatus
from hand_eye_calib.core.results.document import (
    angles_in_words,
    printed_numbers,
    transforms_of,
)
from hand_eye_calib.offline.cli.present import as_lines

SAMPLES = 20_000
# A camera that looks ahead on a lidar: z of the camera is x of the lidar.
LIDAR_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def transform(rotation, translation=(0.3, -0.2, 0.1)):
    return se3.from_rotation_translation(rotation, np.array(translation))


def covariance_about_parent(rotation, sigmas_deg, sigmas_m=(0.01, 0.02, 0.03)):
    """Covariance in the child's frame of errors that are independent about the parent's axes."""
    to_child = np.kron(np.eye(2), rotation.T)
    return (
        to_child
        @ np.diag(np.square(np.r_[sigmas_m, np.radians(sigmas_deg)]))
        @ to_child.T
    )


@pytest.mark.parametrize(
    "rotation",
    [
        LIDAR_CAMERA,
        se3.rotation_from_rpy([0.4, -0.9, 2.5]),
        se3.rotation_from_rpy([2.0, 0.9, 0.0]),
    ],
    ids=["lidar-camera", "oblique", "steep"],
)
def test_sigmas_are_the_spread_of_the_numbers_in_both_directions(rotation):
    T = transform(rotation, (3.0, -2.0, 1.0))
    covariance = covariance_about_parent(rotation, (0.57, 0.028, 0.2))
    assert np.isfinite(sigmas_rpy(T, covariance)).all()
    xi = np.random.default_rng(3).multivariate_normal(
        np.zeros(6), covariance, SAMPLES
    )
    drawn = T @ se3.exp(xi)
    inverse = (
        se3.inverse(T),
        se3.inverse(drawn),
        inverse_covariance(T, covariance),
    )
    for of, samples, stated in ((T, drawn, covariance), inverse):
        along = samples[:, :3, 3].std(axis=0)
        assert_allclose(
            sigmas_in_parent(of[:3, :3], stated)[:3], along, rtol=0.03
        )
        sigmas = sigmas_rpy(of, stated)
        if np.isfinite(sigmas).all():  # the inverse of one is locked
            off = se3.rotation_to_rpy(samples[:, :3, :3]) - se3.rotation_to_rpy(
                of[:3, :3]
            )
            spread = np.std((off + np.pi) % (2 * np.pi) - np.pi, axis=0)
            assert_allclose(sigmas, spread, rtol=0.03)


def test_near_gimbal_lock_roll_and_yaw_are_printed_without_a_sigma():
    rotation = se3.rotation_from_rpy(np.radians([20.0, 89.5, 70.0]))
    T = transform(rotation)
    covariance = covariance_about_parent(rotation, (0.3, 0.2, 0.1))
    roll, pitch, yaw = sigmas_rpy(T, covariance)
    assert (roll, yaw) == (np.inf, np.inf)
    assert pitch < np.radians(0.4)
    result = calibration(rotation, (0.3, 0.2, 0.1))
    document = result.to_dict()["T_parent_child"]
    assert (
        document["sigma_rpy_deg"][0]
        is document["sigma_measured_rpy_deg"][2]
        is None
    )
    assert (
        printed_numbers(transforms_of(result)["T_parent_child"], ())["roll"]
        == "20.00 deg"
    )


def test_an_unknown_rotation_has_no_sigma():
    covariance = np.diag([1e-4, 1e-4, 1e-4, 1e-6, 1e-6, np.pi**2])
    assert sigmas_rpy(np.eye(4), covariance).tolist() == pytest.approx(
        [1e-3, 1e-3, np.inf]
    )
    assert np.isinf(sigmas_rpy(np.eye(4), np.full((6, 6), np.inf))).all()
    assert np.isinf(sigmas_in_parent(np.eye(3), np.full((6, 6), np.inf))).all()


def calibration(rotation, sigmas_deg):
    T = transform(rotation)
    covariance = covariance_about_parent(rotation, sigmas_deg)
    sigmas = np.r_[0.01, 0.02, 0.03, np.radians(sigmas_deg)]
    return made(
        T_parent_child=T,
        covariance_measured=covariance,
        status=SolveStatus.OK,
        observability_measured=dofs(sigmas),
    )


def test_with_an_unknown_yaw_the_sigmas_about_the_other_axes_are_printed():
    # The rotation by 90 deg exchanges the axes of roll and pitch with those of the parent.
    rotation = se3.rotation_from_rpy(np.radians([0.0, 0.0, 90.0]))
    sigmas_deg = (0.9, 0.5, 360.0)
    covariance = covariance_about_parent(rotation, sigmas_deg)
    sigmas = np.r_[0.01, 0.02, 0.03, np.radians(sigmas_deg)]
    sigmas[5] = np.inf
    result = made(
        T_parent_child=transform(rotation),
        covariance_measured=covariance,
        status=SolveStatus.UNOBSERVABLE,
        observability_measured=dofs(sigmas, ["yaw"]),
    )
    text = " ".join(" ".join(as_lines(result)).split())
    assert (
        "about the axes x and y the rotation is good to 0.9 deg and 0.5 deg"
        in text
    )


def test_a_result_has_the_sigmas_of_its_printed_numbers_in_both_directions():
    result = calibration(LIDAR_CAMERA, (0.57, 0.028, 0.1))
    document = result.to_dict()
    transform = document["T_parent_child"]
    back = document["T_child_parent"]
    assert_allclose(transform["sigma_rpy_deg"], np.degrees(result.sigmas_rpy))
    assert transform["sigma_rpy_deg"][1] == pytest.approx(0.57)
    assert_allclose(transform["sigma_translation"], [0.01, 0.02, 0.03])
    # An error of the rotation moves the parent, which is 0.37 m from the child.
    assert back["sigma_translation"][0] > 0.02


def test_one_sigma_is_stated_on_the_terminal_in_python_and_in_documents():
    measured_m = 0.0043
    allowance_m = 0.008
    T = transform(np.eye(3))
    covariance = np.diag(np.r_[np.full(3, measured_m**2), np.full(3, 1e-6)])
    allowance = np.diag(np.r_[np.full(3, allowance_m**2), np.full(3, 1e-6)])
    result = made(
        T_parent_child=T,
        covariance_measured=covariance,
        covariance_allowance=allowance,
        status=SolveStatus.OK,
        observability_measured=dofs([measured_m] * 3 + [1e-3] * 3),
    )
    whole_m = np.hypot(measured_m, allowance_m)
    document = result.to_dict()
    in_python = [
        result.sigmas[0],
        result.sigmas_printed[0],
        result.covariance[0, 0] ** 0.5,
    ]
    in_documents = [
        document["observability"][0]["sigma"],
        document["sigma"]["x"],
        document["T_parent_child"]["sigma_translation"][0],
        document["covariance"]["matrix"][0][0] ** 0.5,
        result.observability[0].sigma,
    ]
    assert [*in_python, *in_documents] == pytest.approx([whole_m] * 8)
    assert result.sigmas_measured[0] == pytest.approx(measured_m)
    assert result.allowance[0] == pytest.approx(allowance_m)
    assert "x 0.3000 +/- 0.0091 m" in repr(result)
    lines = as_lines(result)
    assert (
        "  x        0.3000 +/- 0.0091 m  (4.3 mm measured, 8 mm allowance)"
        in lines
    )
    assert any(
        "the allowance is for constant odometry errors" in line
        for line in lines
    )
    assert any(
        "--parent-kind exact or --child-kind exact" in line for line in lines
    )


def test_the_axis_of_a_sigma_with_only_a_measured_part_has_no_parts_printed():
    result = calibration(np.eye(3), (0.1, 0.1, 0.1))
    assert not any(
        "allowance" in line for line in as_lines(result, with_details=True)
    )


def test_an_axis_with_a_negligible_allowance_has_no_parts_printed():
    measured = np.diag(np.full(6, 0.02**2))
    allowance = np.diag([0.0, 0.0, 1e-14, 0.0, 0.0, 0.0])
    result = made(
        T_parent_child=transform(np.eye(3)),
        covariance_measured=measured,
        covariance_allowance=allowance,
        status=SolveStatus.OK,
        observability_measured=dofs([0.02] * 6),
    )
    assert "  z          0.100 +/- 0.020 m" in as_lines(result)


def test_with_an_unknown_pitch_no_angle_is_explained():
    rotation = se3.rotation_from_rpy(np.radians([20.0, 60.0, 70.0]))
    result = calibration(rotation, (0.3, 0.2, 0.1))
    known = transforms_of(result)["T_parent_child"]
    assert "roll and yaw vary together at pitch 60 deg" in angles_in_words(
        known, result
    )
    pitch_unknown = replace(known, rpy_deg=np.array([20.0, np.nan, 70.0]))
    assert printed_numbers(pitch_unknown, ())["pitch"] == "unknown"
    assert angles_in_words(pitch_unknown, result) == ""
