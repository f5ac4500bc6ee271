"""Cross-checks: the scatter of other answers about a result."""

import dataclasses
import json

import numpy as np
import pytest
from motions import as_trajectory, child_of, disturbed, walked, wandering_poses
from numpy.testing import assert_allclose
from result_making import good_calibration

import hand_eye_calib as hec
from hand_eye_calib import calibrate
from hand_eye_calib.core.assessment.covariance import Assessment
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.engine.cross_check import compare_answers
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.calibration import (
    Calibration,
    DofObservability,
    DofVerdict,
    SolveStatus,
    Verdict,
)
from hand_eye_calib.core.results.records import AXES, AxisScatter

KINDS = ("methods", "halves", "model")
TURNED_MOUNT = se3.from_rotation_translation(
    se3.rotation_exp(np.array([0, 0, 0.4])), [0.6, -0.3, 0.3]
)


@pytest.fixture(scope="module")
def answers():
    """A result, answers at other references, and answers of its halves."""
    parent = wandering_poses(300)
    child = disturbed(child_of(parent), 1, 0.003, 0.003)
    whole = as_trajectory(parent), as_trajectory(child)
    halves = [
        (as_trajectory(parent[half]), as_trajectory(child[half]))
        for half in (slice(150), slice(150, None))
    ]
    return (
        calibrate(*whole, reference="B5"),
        [
            assessed(calibrate(*whole, reference=name))
            for name in ("B3", "B10", "B20")
        ],
        [assessed(calibrate(*half, reference="B5")) for half in halves],
    )


def assessed(calibration):
    """Assessment of a result."""
    T = calibration.T_parent_child
    return Assessment(
        T, calibration.covariance_measured, calibration.observability_measured
    )


def column(cross_check, name):
    """Values (6,) of all axes."""
    rows = cross_check.values()
    values = [getattr(row, name) for row in rows]
    return np.array(values, dtype=float)


def contradictions(calibration, *answers):
    """Sentences of the reasons that other answers give."""
    cross_check = compare_answers(calibration, *answers)
    reasons = dataclasses.replace(calibration, cross_check=cross_check).reasons
    return [
        reason.sentence
        for reason in reasons
        if reason.rule.partition("_")[0] in KINDS
    ]


def moved(answer, metres):
    T = answer.T_parent_child.copy()
    T[0, 3] += metres
    return dataclasses.replace(answer, T_parent_child=T)


def test_answers_to_good_data_agree_and_few_or_odd_ones_do_not_count(answers):
    calibration, others, _halves = answers
    odd = moved(others[0], 5.0)

    cross_check = compare_answers(*answers)
    of_two_answers = compare_answers(calibration, others[:2])

    assert contradictions(*answers) == []
    sigmas = column(cross_check, "sigma")
    of_methods = column(cross_check, "of_methods")
    of_halves = column(cross_check, "of_halves")
    assert (of_methods < 4 * sigmas).all()
    assert (of_halves < 4 * sigmas).all()
    assert (of_methods > 0).all()
    assert np.isnan(column(of_two_answers, "of_methods")).all()
    assert contradictions(calibration, [*others, odd]) == []
    checked = dataclasses.replace(calibration, cross_check=cross_check)
    text = json.dumps(checked.to_dict())
    read_back = Calibration.from_dict(json.loads(text))
    assert read_back.cross_check == cross_check


def test_other_methods_that_lie_elsewhere_are_named_with_axis_and_distance(
    answers,
):
    calibration, others, _ = answers
    (sentence,) = contradictions(
        calibration, [moved(other, 0.3) for other in others]
    )
    # 0.3 m is the median: 0.44 m for a normal variable.
    assert sentence.startswith(
        "robust least squares disagrees about x by 44 cm; without this "
    )


def test_halves_that_lie_apart_are_named(answers):
    calibration, others, (first, second) = answers
    halves = (moved(first, -0.2), moved(second, 0.2))

    cross_check = compare_answers(calibration, others, halves)

    of_halves = column(cross_check, "of_halves")
    assert of_halves[0] == pytest.approx(0.2, abs=0.02)
    (sentence,) = contradictions(calibration, others, halves)
    assert sentence.startswith(
        "the two halves of the recording disagree about x by"
    )


@pytest.mark.parametrize("blind", [0, 1])
@pytest.mark.parametrize("axis", range(6))
def test_halves_are_not_compared_on_an_axis_that_one_of_them_hardly_sees(
    answers, axis, blind
):
    calibration, others, halves = answers
    other_sigma = halves[1 - blind].observability[axis].sigma
    differences = {}
    for times in (1.0, 20.0):
        dofs = list(halves[blind].observability)
        dofs[axis] = dataclasses.replace(dofs[axis], sigma=times * other_sigma)
        pair = list(halves)
        pair[blind] = dataclasses.replace(
            halves[blind], observability=tuple(dofs)
        )
        cross_check = compare_answers(calibration, others, pair)
        differences[times] = column(cross_check, "of_halves")

    assert np.isfinite(differences[1.0]).all()
    is_skipped = np.isnan(differences[20.0])
    assert np.flatnonzero(is_skipped).tolist() == [axis]


def drifting(poses, seed):
    """Poses of an odometry whose speed and rates are off by a slowly changing 3 cm/s, 0.3 deg/s."""
    random = np.random.default_rng(seed)
    keep = np.exp(-0.1 / 30.0)
    innovation = np.sqrt(1.0 - keep**2)
    error = random.normal(size=6)
    errors = [error]
    for _ in range(len(poses) - 2):
        error = keep * error + innovation * random.normal(size=6)
        errors.append(error)
    sigmas = np.repeat([0.03, 0.006], 3)
    errors = 0.1 * np.array(errors) * sigmas
    noisy = disturbed(poses, seed + 1, 0.002, 0.0007)
    steps = se3.inverse(noisy[:-1]) @ noisy[1:]
    drifting_steps = steps @ se3.exp(errors)
    noisy_steps = disturbed(drifting_steps, seed + 2, 5e-4, 1e-4)
    return walked(noisy_steps)


def straight_start(seed):
    """Streams of a vehicle that drives 40 s straight on, then 40 s of curves."""
    times_s = 0.1 * np.arange(800)
    after_s = np.maximum(times_s - 40.0, 0.0)
    rates = 0.35 * np.sin(0.25 * after_s)
    roll = 0.003 * np.sin(1.7 * times_s + 1.0)
    pitch = 0.003 * np.sin(1.3 * times_s)
    yaw = np.cumsum(0.1 * rates)
    rotation = se3.rotation_from_rpy(np.c_[roll, pitch, yaw])
    forward = rotation[:, :, 0]
    position = np.cumsum(0.1 * forward, axis=0)
    parent = se3.from_rotation_translation(rotation, position)
    mount_rotation = se3.rotation_exp(np.array([0.1, -0.2, 1.5]))
    mount = se3.from_rotation_translation(mount_rotation, [1, -0.5, 1])
    child = child_of(parent, mount)
    noisy_parent = as_trajectory(drifting(parent, seed))
    noisy_child = as_trajectory(drifting(child, seed + 50))
    return noisy_parent, noisy_child


@pytest.mark.parametrize("seed", [100, 700])
def test_a_straight_start_is_no_mount_that_turned_about_the_direction_of_travel(
    seed,
):
    result = calibrate(*straight_start(seed), checks=True)
    assert result.cross_check["yaw"].of_halves is not None
    assert result.cross_check["roll"].of_halves is None
    accused = {
        axis
        for reason in result.reasons
        if reason.rule == "halves"
        for axis in reason.axes
    }
    assert "roll" not in accused


def gentle_ramps(degrees):
    """Streams of a vehicle that pitches, and rolls half as much, by so many degrees."""
    k = np.arange(500)
    roll = np.radians(degrees / 2) * np.sin(k / 31)
    pitch = np.radians(degrees) * np.sin(k / 40)
    yaw = 1.2 * np.sin(k / 25 + 1.0) + 0.01 * k
    rotation = se3.rotation_from_rpy(np.c_[roll, pitch, yaw])
    forward = rotation[:, :, 0]
    position = np.cumsum(0.5 * forward, axis=0)
    parent = se3.from_rotation_translation(rotation, position)
    child = child_of(parent, TURNED_MOUNT)
    noisy_parent = as_trajectory(disturbed(parent, 21, 0.005, 0.0005))
    noisy_child = as_trajectory(disturbed(child, 11, 0.005, 0.0005))
    return noisy_parent, noisy_child


def test_an_axis_that_no_other_reference_reveals_is_weak_and_used_with_care():
    alone = calibrate(*gentle_ramps(1.5))

    assert alone.method == "adaptive"
    assert alone.unobservable() == []
    assert alone.status is SolveStatus.OK
    assert alone.observability[2].verdict is DofVerdict.WEAK
    position = alone.T_parent_child[:3, 3]
    assert_allclose(position[:2], [0.6, -0.3], atol=0.02)
    assert abs(position[2] - 0.3) < 2.0 * alone.sigmas[2]
    assert alone.sigmas[2] < 0.1
    assert not alone.cross_check["z"].is_confirmed
    assert alone.verdict is Verdict.USE_WITH_CARE
    (reason,) = (
        reason for reason in alone.reasons if reason.rule == "unconfirmed"
    )
    assert reason.axes == ("z",)
    assert reason.sentence.startswith("only the noise model determines z to ")


def scattered(axis="z", **columns):
    """A good result whose cross-check has these values for an axis, and nothing for the others."""
    nothing = AxisScatter(sigma=0.003, of_methods=None, of_halves=None)
    rows = dict.fromkeys(AXES, nothing) | {
        axis: dataclasses.replace(nothing, **columns)
    }
    return good_calibration(cross_check=rows)


@pytest.mark.parametrize(
    ("excess_over_own", "rules"), [(18.0, ["methods"]), (2.5, []), (None, [])]
)
def test_two_answers_that_contradict_count_without_a_scatter_of_three(
    excess_over_own, rules
):
    result = scattered(excess_over_own=excess_over_own)
    assert [reason.rule for reason in result.reasons] == rules
    if rules:
        (reason,) = result.reasons
        assert reason.sentence == (
            "robust least squares disagrees about z by 5.4 cm; without this second opinion, the "
            "result claims +/- 3 mm"
        )


def test_steeper_ramps_confirm_the_height():
    shown = calibrate(*gentle_ramps(4.0))

    assert shown.method == "adaptive"
    assert shown.unobservable() == []
    assert shown.T_parent_child[2, 3] == pytest.approx(0.3, abs=0.03)
    for axis, row in shown.cross_check.items():
        assert row.is_confirmed, axis


def on_springs(seed, degrees_per_m_s2):
    """Streams of a car on a flat road, whose body rolls and pitches with its acceleration."""
    random = np.random.default_rng(seed)
    t = 0.1 * np.arange(900)
    phases = random.uniform(0.0, 6.0, 3)
    slow = 1.5 * np.sin(0.5 * t + phases[0])
    fast = np.sin(1.3 * t + phases[1])
    speed = 6.0 + slow + fast
    yaw_rate = 0.35 * np.sin(0.21 * t + phases[2])
    yaw = np.cumsum(0.1 * yaw_rate)
    acceleration = np.gradient(speed, 0.1)
    slope = np.radians(degrees_per_m_s2)
    roll = slope * speed * yaw_rate
    pitch = -slope * acceleration
    rotation = se3.rotation_from_rpy(np.c_[roll, pitch, yaw])
    direction = np.c_[np.cos(yaw), np.sin(yaw), np.zeros(900)]
    velocity = speed[:, None] * direction
    position = np.cumsum(0.1 * velocity, axis=0)
    parent = se3.from_rotation_translation(rotation, position)
    child = child_of(parent, TURNED_MOUNT)
    noisy_parent = as_trajectory(disturbed(parent, seed, 0.003, 0.0002))
    noisy_child = as_trajectory(disturbed(child, seed + 50, 0.003, 0.0002))
    return noisy_parent, noisy_child


@pytest.mark.parametrize("method", ["auto", "dnlo"])
def test_a_body_that_rocks_on_its_springs_reveals_no_height(method):
    for seed in (3, 4):
        rocking = calibrate(*on_springs(seed, 0.2), method=method)
        assert "z" in rocking.unobservable()
        assert np.isinf(rocking.sigmas[2])
        assert_allclose(rocking.T_parent_child[:2, 3], [0.6, -0.3], atol=0.05)


def test_ramps_reveal_the_height_of_a_body_on_springs():
    parent, child = gentle_ramps(4.0)
    result = calibrate(parent, child)
    assert result.unobservable() == []


def test_a_prior_holds_for_an_axis_that_no_other_reference_reveals():
    parent, child = gentle_ramps(1.5)

    result = calibrate(parent, child, prior={"z": (0.9, 0.02)})

    assert result.observability[2].verdict is DofVerdict.PRIOR
    assert result.T_parent_child[2, 3] == pytest.approx(0.9, abs=0.005)


def test_an_axis_known_by_a_prior_alone_counts_with_its_sigma(answers):
    calibration, others, _ = answers
    with_prior = dataclasses.replace(
        calibration,
        observability_measured=(
            DofObservability("x", DofVerdict.PRIOR, 1.0),
            *calibration.observability_measured[1:],
        ),
    )
    assert (
        contradictions(with_prior, [moved(other, 0.3) for other in others])
        == []
    )


@pytest.fixture(scope="module")
def mounts():
    """Streams of the parent, of a child, and of one whose mount came loose half-way."""
    parent = wandering_poses(300)
    child = disturbed(child_of(parent), 1, 0.003, 0.003)
    change = se3.exp(np.array([0.2, 0, 0, 0, 0, 0.1]))
    loosened = child.copy()
    loosened[150:] = loosened[150:] @ change
    return as_trajectory(parent), as_trajectory(child), as_trajectory(loosened)


def test_a_sound_mount_is_checked_in_every_solve_and_from_python(mounts):
    parent, child, _ = mounts

    result = calibrate(parent, child)
    fast = calibrate(parent, child, reference="B5")
    cross_check = hec.cross_check(fast, parent, child)

    assert "halves" not in [reason.rule for reason in result.reasons]
    assert (column(result.cross_check, "of_halves") > 0).all()
    assert list(cross_check) == ["x", "y", "z", "roll", "pitch", "yaw"]
    assert (column(cross_check, "of_methods") > 0).all()
    assert column(cross_check, "excess_of_halves").max() <= 3


def test_a_loose_mount_is_reported_in_every_solve_and_from_python(mounts):
    parent, _, loosened = mounts

    result = calibrate(parent, loosened, method="dnlo")
    fast = calibrate(parent, loosened, reference="B5")
    cross_check = hec.cross_check(fast, parent, loosened)

    assert "halves" in [reason.rule for reason in result.reasons]
    assert list(cross_check) == ["x", "y", "z", "roll", "pitch", "yaw"]
    assert column(cross_check, "excess_of_halves").max() > 3


def test_streams_that_do_not_overlap_are_named_in_a_cross_check(mounts):
    parent, child, _ = mounts
    result = calibrate(parent, child, reference="B5")
    later_child = child.shifted(1e6)
    with pytest.raises(NotEnoughDataError, match="do not overlap in time"):
        hec.cross_check(result, parent, later_child)
