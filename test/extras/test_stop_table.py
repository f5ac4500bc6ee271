"""Residuals of single stops, and advice on the next stops."""

import numpy as np
import pytest

import hand_eye_calib as hec
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops.calibrate import calibrate_arm
from hand_eye_calib.offline.cli.main import main

CAMERA = se3.from_rotation_translation(
    se3.rotation_exp(np.array([0.1, -0.05, 1.5])), np.array([0.06, -0.03, 0.09])
)
TARGET = se3.from_rotation_translation(
    se3.rotation_exp(np.array([0.0, 0.0, 0.4])), np.array([0.5, 0.05, 0.02])
)
SETUPS = ("hand", "beside")


def arm(turns_rad, setup, n=20, seed=1):
    """Poses of a hand that turns about its x, y and z by these angles, and those of a target."""
    random = np.random.default_rng(seed)
    rotations = se3.rotation_exp(random.normal(size=(n, 3)) * turns_rad)
    positions = [0.4, 0.0, 0.5] + random.normal(size=(n, 3)) * 0.1
    robot = se3.from_rotation_translation(rotations, positions)
    return robot, measured(robot, setup, random)


def measured(robot, setup, random):
    """Poses of a target in a camera, with noise."""
    noise = se3.exp(random.normal(size=(len(robot), 6)) * 0.002)
    if setup == "hand":
        return se3.inverse(robot @ CAMERA) @ TARGET @ noise
    return se3.inverse(TARGET) @ robot @ CAMERA @ noise


@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize("axis", ["x", "z"])
def test_advice_for_turns_about_one_axis_is_to_turn_about_the_other_axes(
    setup, axis
):
    turns_rad = np.where(np.array([*"xyz"]) == axis, 0.3, 0.01)
    robot, tracking = arm(turns_rad, setup)

    table = calibrate_arm(robot, tracking, setup=setup).stops

    assert axis not in [stop.axis for stop in table.next[:2]]
    assert [(abs(stop.angle_deg), stop.frame) for stop in table.next] == [
        (30, "hand")
    ] * 3
    assert f"from stop {table.start}, " in table.advice
    for stop in table.next:
        assert (
            f"turn hand by {stop.angle_deg:+d} deg about its {stop.axis}"
            in table.advice
        )


@pytest.mark.parametrize("setup", SETUPS)
def test_advised_stops_reduce_sigma_more_than_other_stops(setup):
    robot, tracking = arm((0.3, 0.01, 0.3), setup)
    result = calibrate_arm(robot, tracking, setup=setup)
    start = robot[result.stops.start - 1]
    turns = []
    for stop in result.stops.next:
        vector_rad = (
            np.radians(stop.angle_deg) * np.eye(3)["xyz".index(stop.axis)]
        )
        turns.append(se3.exp(np.r_[0.0, 0.0, 0.0, vector_rad]))
    advised = start @ np.stack(turns)
    others, _ = arm((0.3, 0.01, 0.3), setup, n=3, seed=7)

    sigmas = []
    for added in (advised, others):
        of_added = measured(added, setup, np.random.default_rng(3))
        more = calibrate_arm(
            np.r_[robot, added], np.r_[tracking, of_added], setup=setup
        )
        sigmas.append(more.sigmas.max())

    assert sigmas[0] < 0.8 * sigmas[1]


def test_each_stop_has_its_residual_and_an_outlier_is_marked():
    robot, tracking = arm((0.3, 0.3, 0.3), "hand")
    tracking[4, :3, 3] += [0.3, 0.0, 0.0]

    rows = calibrate_arm(robot, tracking).stops.rows

    assert [row.number for row in rows] == list(range(1, 21))
    outlier = rows[4]
    assert not outlier.is_used
    assert outlier.residual_m == pytest.approx(0.3, abs=0.02)
    others = rows[:4] + rows[5:]
    for row in others:
        assert row.is_used
        assert row.residual_m < 0.02
        assert row.residual_deg < 1.0


def test_stops_that_contradict_have_residuals_and_no_advice():
    robot, tracking = arm((0.3, 0.3, 0.3), "hand")
    table = calibrate_arm(robot, tracking[::-1]).stops
    assert (len(table.rows), table.next, table.advice) == (20, (), "")


def test_a_document_has_the_stops_and_is_read_back():
    robot, tracking = arm((0.3, 0.3, 0.3), "hand")
    result = calibrate_arm(robot, tracking)
    document = result.to_dict()
    assert document["stops"]["next"][0]["frame"] == "hand"
    assert hec.Calibration.from_dict(document).stops == result.stops


def test_details_and_report_have_residuals_and_views(tmp_path, capsys):
    robot, tracking = arm((0.3, 0.01, 0.3), "hand")
    samples = tmp_path / "samples.npz"
    np.savez(samples, robot=robot, tracking=tracking)
    options = ["--out", str(tmp_path), "--target-translation", "1mm"]

    main(["calibrate", str(samples), *options, "--verbose"])

    out = " ".join(capsys.readouterr().out.split())
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "residuals of the stops; 0 of 20 left out (weight 0): 1: " in out
    assert "record 3 more stops from stop" in out
    assert "record 3 more stops from stop" in page
    assert 'href="#stops"' in page
    assert "Samples, findings, solution, covariance" in page
    assert "Pose of target in base" in page
    assert 'id="figure-stops"' in page
    assert page.count('<tr><th scope="row" class="number">') == 20
