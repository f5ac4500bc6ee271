"""When a session is told to stop, and what it is told until then."""

import dataclasses
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose
from result_making import calibration as made
from result_making import seen
from screen_rules import STEPS

import hand_eye_calib as hec
from hand_eye_calib.core.assessment.excitation import excitation, helpful_motion
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.core.results.calibration import (
    DofObservability,
    DofVerdict,
    SolveStatus,
)
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.offline.cli.present import as_lines
from hand_eye_calib.online.live.goal import Goal

TARGETS = (0.02,) * 3 + (0.005,) * 3


def result(sigmas_m=0.005, sigmas_rad=0.001, verdicts=(), **fields):
    sigmas = np.r_[np.broadcast_to(sigmas_m, 3), np.broadcast_to(sigmas_rad, 3)]
    named = dict(verdicts)
    dofs = tuple(
        DofObservability(
            axis, named.get(axis, DofVerdict.OBSERVED), float(sigma)
        )
        for axis, sigma in zip(AXES, sigmas, strict=True)
    )
    fields = {"status": SolveStatus.OK, "noise": None} | fields
    return dataclasses.replace(made(), observability_measured=dofs, **fields)


FLAT = (0.5, 1.0, 90.0)


def progress_after(goal, *results):
    """Return the progress after results from 40 s of motion on, 20 s apart."""
    for k, calibration in enumerate(results):
        progress = goal.add(calibration, seen(40.0 + 20.0 * k))
    return progress


def seconds_left(progress):
    return [row.seconds_left for row in progress.axes.values()]


def test_the_session_ends_once_more_motion_has_confirmed_the_targets():
    goal = Goal(TARGETS)
    goal.add(result(sigmas_m=0.0201), seen(30.0))
    within = goal.add(result(sigmas_m=0.0199), seen(40.0))
    assert (within.done, within.limiting_axis, max(seconds_left(within))) == (
        False,
        "",
        0.0,
    )
    assert (
        within.sentence
        == "Confirming, 40 s: every axis is within its target. Go on."
    )
    assert within.seconds_left == 40.0
    assert goal.add(result(), seen(50.0)).seconds_left == 30.0
    done = goal.add(result(), seen(80.0))
    assert (done.done, done.limiting_axis, done.seconds_left) == (True, "", 0.0)
    assert done.sentence.startswith(
        "Done: good to 5 mm along and 0.057 deg about each axis"
    )


def test_a_result_beyond_its_target_begins_the_confirmation_anew():
    goal = Goal(TARGETS)
    for motion_s, sigma_m in (
        (20.0, 0.01),
        (30.0, 0.03),
        (40.0, 0.01),
        (70.0, 0.01),
    ):
        assert not goal.add(result(sigmas_m=sigma_m), seen(motion_s)).done
    assert goal.add(result(), seen(80.0)).done


@pytest.mark.parametrize(
    ("since_s", "least_s"), [(10.0, 30.0), (60.0, 120.0), (400.0, 480.0)]
)
def test_the_confirmation_takes_as_long_as_the_motion_before_20_to_75_s(
    since_s, least_s
):
    goal = Goal(TARGETS)
    for motion_s in np.arange(since_s, least_s, 10.0):
        assert not goal.add(result(), seen(motion_s)).done
    assert goal.add(result(), seen(least_s)).done


def test_the_bar_the_target_and_the_end_have_one_scale():
    allowance = np.diag([0.019**2] * 3 + [1e-8] * 3)
    goal = Goal(TARGETS)
    beyond = result(sigmas_m=0.007, covariance_allowance=allowance)
    progress = goal.add(beyond, seen(40.0))
    assert progress.axes["x"].sigma == pytest.approx(np.hypot(0.007, 0.019))
    assert progress.limiting_axis in "xyz"
    within = result(sigmas_m=0.006, covariance_allowance=allowance)
    assert progress_after(Goal(TARGETS), *[within] * 3).done


def test_a_target_below_the_allowance_is_no_fault_of_the_motion():
    allowance = np.diag([0.03**2] * 3 + [1e-8] * 3)
    progress = Goal(TARGETS).add(
        result(covariance_allowance=allowance), seen(40.0)
    )
    assert progress.target_is_too_small
    assert progress.sentence == (
        "No motion makes x good to 2 cm. Constant errors alone may be 3 cm. "
        "Stop and save, or set a larger target."
    )


def test_every_axis_has_its_own_target():
    config = CalibratorConfig(target_axes="z=10cm, yaw=0.5deg")
    assert config.targets == pytest.approx(
        (0.02, 0.02, 0.1, 0.00524, 0.00524, np.radians(0.5))
    )
    goal = Goal(config.targets)
    rough_height = result(sigmas_m=(0.004, 0.004, 0.06))
    progress = progress_after(goal, *[rough_height] * 3)
    assert progress.done
    assert progress.axes["z"].target == pytest.approx(0.1)
    strict = Goal(CalibratorConfig(target_axes="x=1mm").targets)
    assert strict.add(result(), seen(40.0)).limiting_axis == "x"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "height=10cm",
            "takes AXIS=TARGET of x, y, z, roll, pitch, yaw.*got 'height=10cm'",
        ),
        ("z", "z must be numbers in m or cm or mm"),
        ("z=1 z=2", "once each.*got 'z=2'"),
        ("z=0", "above 0"),
        ("yaw=1cm", "numbers in rad or deg"),
        ("yaw=5", "write yaw=5deg"),
    ],
)
def test_targets_that_say_something_else_are_refused(text, message):
    with pytest.raises(ConfigError, match=message):
        CalibratorConfig(target_axes=text)


def test_time_left_follows_from_the_variance_that_falls_with_time():
    progress = Goal(TARGETS).add(
        result(sigmas_m=(0.004, 0.04, 0.004)), seen(40.0, FLAT)
    )
    assert progress.limiting_axis == "y"
    assert_allclose(seconds_left(progress), [0, 120, 0, 0, 0, 0])
    assert progress.sentence == (
        "Go on for about 4 min, y takes longest. Drive tighter curves to both sides."
    )


def test_the_motion_of_the_last_minute_counts_if_it_is_better():
    goal = Goal(TARGETS)
    poor = result(sigmas_m=(0.004, 0.004, 1.0))
    for motion_s in np.arange(200.0, 300.0, 10.0):
        goal.add(poor, seen(motion_s, FLAT))
    # Half of the information of z within the last 30 s.
    better = result(sigmas_m=(0.004, 0.004, 0.02 * np.sqrt(2.0)))
    progress = goal.add(
        better, seen(320.0), newest_motion=seen(60.0, (0.5, 9.0, 90.0))
    )
    assert progress.axes["z"].seconds_left == pytest.approx(30.0)
    assert progress.sentence == (
        "Go on for about 2 min, z takes longest. This motion is right: continue it."
    )


def test_there_is_no_time_left_before_20_s_of_motion():
    goal = Goal(TARGETS)
    early = goal.add(result(sigmas_m=(0.004, 0.04, 0.004)), seen(19.0))
    assert early.seconds_left == np.inf
    assert "y is not determined well enough yet" in early.sentence
    assert np.isfinite(goal.add(result(sigmas_m=0.04), seen(21.0)).seconds_left)


def test_a_motion_that_does_not_observe_an_axis_has_no_time_left():
    hidden = result(sigmas_m=(0.004, 0.004, 0.05))
    flat = Goal(TARGETS).add(hidden, seen(60.0, FLAT))
    assert flat.seconds_left == flat.axes["z"].seconds_left == np.inf
    assert flat.sentence.startswith(
        "z is not determined well enough yet. Drive "
    )
    assert not flat.will_not_get_there
    ramps = seen(60.0, (0.5, 9.0, 90.0))
    on_ramps = Goal(TARGETS).add(hidden, seen(60.0, FLAT), newest_motion=ramps)
    assert np.isfinite(on_ramps.seconds_left)


def test_the_motion_is_not_to_be_changed_while_the_motion_asked_for_is_driven():
    goal = Goal(TARGETS)
    hidden = result(
        sigmas_m=(0.004, 0.004, np.inf), status=SolveStatus.UNOBSERVABLE
    )
    assert goal.add(
        hidden, seen(60.0, FLAT), newest_motion=seen(60.0, FLAT)
    ).will_not_get_there
    ramp = seen(60.0, (0.5, 7.0, 90.0))
    on_ramp = goal.add(hidden, seen(64.0, FLAT), newest_motion=ramp)
    assert not on_ramp.will_not_get_there
    assert on_ramp.sentence == (
        "z is not determined well enough yet. This motion is right: continue it."
    )


def test_the_time_left_only_shrinks_by_two_steps_at_a_result():
    goal = Goal(TARGETS)
    times_s = []
    for motion_s, sigma_m in enumerate(
        (0.043, 0.0205, 0.04, 0.04, 0.03, 0.004, 0.021, 0.03), 40
    ):
        progress = goal.add(
            result(sigmas_m=(0.004, sigma_m, 0.004)), seen(motion_s)
        )
        times_s.append(seconds_left(progress)[1])
    assert times_s == [180.0, 90.0, 90.0, 90.0, 60.0, 0.0, 15.0, 15.0]


def test_the_time_of_a_confirmation_does_not_follow_a_longer_estimate():
    goal = Goal(TARGETS)
    goal.add(result(sigmas_m=0.06), seen(70.0))
    assert goal.progress.seconds_left > 240.0
    within = goal.add(result(sigmas_m=0.01), seen(80.0))
    assert within.sentence.startswith("Confirming, 75 s: ")


def test_the_end_of_a_confirmation_is_reported_to_a_few_seconds():
    goal = Goal(TARGETS)
    sentences = [
        goal.add(result(), seen(motion_s)).sentence
        for motion_s in (40.0, 73.0, 77.0)
    ]
    times = [sentence.partition(":")[0] for sentence in sentences]
    assert times == ["Confirming, 40 s", "Confirming, 8 s", "Confirming, 4 s"]


def test_a_much_longer_time_left_is_a_new_estimate():
    goal = Goal(TARGETS)
    goal.add(result(sigmas_m=0.0205), seen(40.0))
    assert max(seconds_left(goal.progress)) == 15.0
    goal.add(result(sigmas_m=0.05), seen(41.0))
    assert max(seconds_left(goal.progress)) == 240.0


def test_faults_of_the_streams_and_failed_solves_are_no_success():
    goal = Goal(TARGETS)
    for motion_s in (40.0, 42.0):
        assert not goal.add(
            result(), seen(motion_s), ["the clocks differ"]
        ).done
    assert (
        goal.progress.sentence
        == "Stop: the streams are faulty: the clocks differ."
    )
    for motion_s in (44.0, 46.0):
        goal.add(result(status=SolveStatus.CONTRADICTED), seen(motion_s))
    assert (
        goal.progress.sentence
        == "No usable result: a prior contradicts the motion."
    )
    assert goal.best is None


def test_what_was_measured_by_hand_need_not_be_shown_by_motion():
    by_hand = result(
        sigmas_m=(0.004, 0.004, 0.05), verdicts={"z": DofVerdict.PRIOR}
    )
    assert progress_after(Goal(TARGETS), *[by_hand] * 3).done


def test_a_good_result_stays_when_the_robot_is_parked_or_later_ones_are_clearly_worse():
    goal = Goal(TARGETS)
    progress_after(goal, result(), result(), result())
    best = result(sigmas_m=0.004)
    goal.add(best, seen(90.0))
    for _ in range(5):
        parked = goal.add(result(sigmas_m=0.03), seen(90.0))
    assert parked.done
    assert goal.best is best
    goal.restart()
    assert (goal.best, goal.progress.done) == (None, False)


def test_the_newest_of_equally_good_results_is_kept():
    goal = Goal(TARGETS)
    progress_after(goal, *[result(sigmas_m=0.004)] * 3)
    for motion_s, sigma_m in ((84.0, 0.0045), (86.0, 0.0049)):
        newest = result(sigmas_m=sigma_m)
        goal.add(newest, seen(motion_s))
        assert goal.best is newest
    # A quarter worse than the best result so far.
    goal.add(result(sigmas_m=0.0055), seen(88.0))
    assert goal.best is newest


def test_a_saved_result_tells_how_far_the_session_was(tmp_path):
    progress = Goal(TARGETS).add(
        result(sigmas_m=(0.004, 0.028, np.inf)), seen(40.0)
    )
    hec.save(made().with_part("goal", progress), tmp_path)
    loaded = hec.load(tmp_path).goal
    assert loaded == progress
    assert loaded.sentence == progress.sentence
    assert (loaded.axes["z"].sigma, loaded.axes["z"].target) == (np.inf, 0.02)
    text = " ".join(" ".join(as_lines(hec.load(tmp_path))).split())
    assert f"the session: {progress.sentence}" in text


ON_A_FLAT_FLOOR = "Drive over a ramp or a kerb, or measure it by hand"


def test_an_axis_that_stays_unobservable():
    goal = Goal(TARGETS)
    hidden = result(
        sigmas_m=(0.004, 0.004, np.inf), status=SolveStatus.UNOBSERVABLE
    )
    assert not goal.add(hidden, seen(20.0, FLAT)).will_not_get_there
    stuck = goal.add(hidden, seen(40.0, FLAT))
    assert (stuck.will_not_get_there, stuck.limiting_axis) == (True, "z")
    assert (
        stuck.sentence
        == f"This motion will not determine z well enough. {ON_A_FLAT_FLOOR}."
    )


@pytest.mark.parametrize(
    ("axis", "rotation_deg", "words"),
    [
        ("y", (1, 1, 2), "move in curves, to both sides"),
        ("z", (1, 2, 90), ON_A_FLAT_FLOOR.lower()),
        ("y", (1, 90, 2), ON_A_FLAT_FLOOR.lower()),
        ("x", (1, 2, 90), "drive tighter curves to both sides"),
        ("roll", (1, 2, 90), "drive tighter curves to both sides"),
        ("yaw", (1, 2, 90), "move farther, straight on and in curves"),
        ("z", (20, 10, 90), "rotate the sensors more about y"),
        ("roll", (20, 40, 30), "rotate the sensors more about z"),
    ],
)
def test_motion_that_helps_is_about_another_axis(axis, rotation_deg, words):
    assert helpful_motion([axis], seen(40.0, rotation_deg)) == words


@pytest.mark.parametrize(
    ("axes", "rotation_deg", "words"),
    [
        (["x", "y"], (20, 10, 90), "rotate the sensors more about x and y"),
        (["x", "z"], (20, 10, 90), "rotate the sensors more about y"),
        (
            ["x", "z"],
            (1, 2, 90),
            "drive tighter curves to both sides; " + ON_A_FLAT_FLOOR.lower(),
        ),
    ],
)
def test_advice_for_several_axes_is_joined(axes, rotation_deg, words):
    assert helpful_motion(axes, seen(40.0, rotation_deg)) == words


def test_advice_for_a_vehicle_names_the_manoeuvre_of_each_rotation():
    motion = dataclasses.replace(
        seen(40.0, (20, 10, 90)), forward=np.array([1.0, 0.0, 0.0])
    )
    assert motion.has_vehicle_axes
    assert helpful_motion(["x", "y"], motion) == (
        "drive one wheel over a kerb and drive over a ramp or a bump"
    )
    assert helpful_motion(["z"], motion) == "drive over a ramp or a bump"


@pytest.mark.parametrize("axis", AXES)
def test_every_advice_begins_with_what_to_do(axis):
    for rotation_deg in ((1, 1, 2), (1, 2, 90), (20, 10, 90), (90, 90, 90)):
        for drives in (True, False):
            motion = dataclasses.replace(
                seen(40.0, rotation_deg), drives=drives
            )
            verb = helpful_motion([axis], motion).partition(" ")[0]
            assert re.fullmatch(STEPS, verb)


def test_only_motion_counts_as_time():
    s = np.arange(0.0, 60.0, 0.1)
    moved = np.clip(s - 10.0, 0.0, 20.0)  # parked, 20 s at 1 m/s, parked
    jitter = np.random.default_rng(0).normal(size=(len(s), 3)) * 0.005
    places = np.stack([moved, 0 * s, 0 * s], axis=1) + jitter
    poses = se3.from_rotation_translation(
        np.tile(np.eye(3), (len(s), 1, 1)), places
    )
    pairs = PosePairs((s * 1e9).astype(np.int64), poses, poses)
    assert excitation(pairs).motion_s == pytest.approx(20.0, abs=1.5)
    assert excitation(pairs[:50]).motion_s == 0.0


def test_positions_alone_are_done_without_a_word_of_the_rotation():
    hidden = dict.fromkeys(AXES[3:], DofVerdict.UNOBSERVABLE)
    of_positions = result(
        sigmas_rad=np.inf, verdicts=hidden, measured="positions"
    )
    progress = progress_after(Goal(TARGETS), *[of_positions] * 3)
    assert progress.done
    assert progress.sentence.startswith("Done: x, y and z are good to 5 mm")
