"""Whether other answers to the same question agree with a result."""

import dataclasses
import json

import numpy as np
import pytest
from motions import as_trajectory, child_of, disturbed, planar_poses, wandering_poses

from hand_eye_calib import calibrate
from hand_eye_calib.calibration import Calibration, DofObservability, DofVerdict
from hand_eye_calib.engine.cross_check import consistency


@pytest.fixture(scope="module")
def answers():
    """A result, other references' answers, and its halves'."""
    parent = wandering_poses(300)
    child = disturbed(child_of(parent), 1, 0.003, 0.003)
    whole = as_trajectory(parent), as_trajectory(child)
    halves = [
        (as_trajectory(parent[part]), as_trajectory(child[part]))
        for part in (slice(150), slice(150, None))
    ]
    return (
        calibrate(*whole, reference="B5"),
        [calibrate(*whole, reference=reference) for reference in ("B3", "B10", "B20")],
        [calibrate(*half, reference="B5") for half in halves],
    )


def moved(calibration, metres):
    T = calibration.T_parent_child.copy()
    T[0, 3] += metres
    return dataclasses.replace(calibration, T_parent_child=T)


def test_answers_to_good_data_agree(answers):
    found = consistency(*answers)
    assert found.warnings() == ()
    assert (found.of_methods < 4 * found.sigma).all()
    assert (found.of_halves < 4 * found.sigma).all()
    assert (found.of_methods > 0).all()


def test_other_methods_that_lie_elsewhere_are_told_with_the_axis_and_by_how_much(answers):
    calibration, others, _ = answers
    said = consistency(calibration, [moved(other, 0.3) for other in others]).warnings()
    assert len(said) == 1
    assert "methods and references disagree" in said[0]
    assert "in x (0.4" in said[0]  # 0.3 m is the median: 0.44 m for a normal variable
    assert " y " not in said[0]


def test_halves_that_lie_apart_are_told(answers):
    calibration, others, (first, second) = answers
    found = consistency(calibration, others, (moved(first, -0.2), moved(second, 0.2)))
    assert found.of_halves[0] == pytest.approx(0.2, abs=0.02)
    assert "the two halves of the drive disagree" in found.warnings()[0]


def test_one_odd_answer_among_several_is_not_a_disagreement(answers):
    calibration, others, _ = answers
    assert consistency(calibration, [*others, moved(others[0], 5.0)]).warnings() == ()


def test_axes_that_an_answer_does_not_know_are_not_compared():
    parent = planar_poses(200)
    child = disturbed(child_of(parent), 1, 1e-3, 1e-3)
    answers = [
        calibrate(as_trajectory(parent), as_trajectory(child), reference=reference)
        for reference in ("B10", "B5", "B15", "B20")
    ]
    found = consistency(answers[0], answers[1:], answers[1:3])
    assert np.isnan(found.of_methods[2])
    assert np.isnan(found.of_halves[2])
    assert np.isinf(found.sigma[2])
    assert np.isfinite(found.of_methods[:2]).all()
    assert found.to_dict()["z"] == {"sigma": None, "of_methods": None, "of_halves": None}


def test_two_other_answers_are_too_few(answers):
    calibration, others, _ = answers
    assert np.isnan(consistency(calibration, others[:2]).of_methods).all()


def test_an_axis_known_by_a_prior_alone_counts_with_its_sigma(answers):
    calibration, others, _ = answers
    known = dataclasses.replace(
        calibration,
        observability=(
            DofObservability("x", DofVerdict.PRIOR, 1.0),
            *calibration.observability[1:],
        ),
    )
    assert consistency(known, [moved(other, 0.3) for other in others]).warnings() == ()


def test_the_result_keeps_it_when_written_and_read(answers):
    calibration, others, halves = answers
    found = consistency(calibration, others, halves).to_dict()
    kept = dataclasses.replace(calibration, consistency=found)
    assert Calibration.from_dict(json.loads(json.dumps(kept.to_dict()))).consistency == found
    assert Calibration.from_dict(calibration.to_dict()).consistency is None
