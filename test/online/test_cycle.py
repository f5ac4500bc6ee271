"""One result: what ~/solve answers, what is published and saved, and what the log says of it."""

import dataclasses
import textwrap
import types
import typing
from enum import Enum
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from result_making import calibration, seen, written_finding
from source_code import ROOT

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.plain import plain
from hand_eye_calib.core.checks.check import CheckResult
from hand_eye_calib.core.checks.findings import Severity
from hand_eye_calib.core.results.calibration import (
    DofObservability,
    DofVerdict,
    SolveStatus,
    Verdict,
)
from hand_eye_calib.core.results.records import AXES, AxisScatter
from hand_eye_calib.online.live import cycle as module
from hand_eye_calib.online.live.cycle import SolveCycle
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.live.session import LiveSession
from hand_eye_calib.online.live.solving import Answer, Failure
from hand_eye_calib.online.live.state import Broadcast, Level, NodeState

TARGETS = (0.02,) * 3 + (0.005,) * 3


def result(sigmas_m=0.005, **fields):
    sigmas = np.r_[np.broadcast_to(sigmas_m, 3), np.full(3, 0.001)].tolist()
    verdicts = [
        DofVerdict.OBSERVED if s < np.inf else DofVerdict.UNOBSERVABLE
        for s in sigmas
    ]
    dofs = tuple(map(DofObservability, AXES, verdicts, sigmas))
    fields = {
        "status": SolveStatus.OK,
        "noise": None,
        "warnings": (),
        "findings": (),
    } | fields
    return dataclasses.replace(
        calibration(), observability_measured=dofs, **fields
    )


@pytest.fixture
def lines():
    return []


@pytest.fixture
def cycle(lines, monkeypatch):
    """A cycle whose process answers nothing."""
    jobs = []
    nothing = SimpleNamespace(
        submit=jobs.append, stop=lambda s: None, answers=list
    )
    monkeypatch.setattr(module, "SolvingProcess", lambda wake: nothing)
    levels = ("debug", "info", "warning", "error")
    write = {
        level: lambda text, level=level: lines.append((level, text))
        for level in levels
    }
    log = NodeLog(SimpleNamespace(**write))
    session = LiveSession(log, CalibratorConfig())
    made = SolveCycle(
        session, log, print, lambda calibration: calibration, print, TARGETS
    )
    made.jobs = jobs
    made.ask(lambda good, text: None)
    return made


def answered(
    cycle, motion_s, sigmas_m=0.005, n_poses=100, check=None, **fields
):
    newest = result(sigmas_m=sigmas_m, n_poses=n_poses, **fields)
    return cycle.conclude(Answer(0, 0.1, seen(motion_s), newest, check=check))


def determined():
    """Motion of 25 s that hides no axis."""
    return dataclasses.replace(
        seen(25.0, (40.0, 40.0, 40.0)), lever_arms=np.eye(3)
    )


def reach_goal(cycle):
    for motion_s in (20.0, 32.0, 44.0):
        good, text = answered(cycle, motion_s)
    assert cycle.goal.progress.done
    return good, text


def test_what_is_kept_is_answered_and_says_why_it_is_not_the_newest(
    cycle, lines
):
    reach_goal(cycle)
    kept = cycle.result
    moved = result().T_parent_child + np.eye(4, k=3) * 0.1
    good, text = answered(
        cycle, 46.0, (0.005, 0.01, 0.005), 120, T_parent_child=moved
    )
    assert good
    assert f"{kept.n_poses} poses, {kept.n_pairs} pairs" in text
    (warning,) = cycle.result.warnings
    assert warning in text
    assert warning == (
        "the result of 100 poses is kept, because the newest result is worse"
    )
    # The log has the values; nobody has to do anything.
    (logged,) = [
        line
        for level, line in lines
        if level == "info" and line.startswith(warning)
    ]
    assert f"{moved[0, 3]:.4f}" in logged
    assert "(5.0, 10.0, 5.0) mm" in logged
    assert "120 poses" in logged
    assert_array_equal(cycle.result.T_parent_child, kept.T_parent_child)
    assert cycle.goal.progress.done
    # A better one takes its place, and the note is gone.
    _, text = answered(cycle, 48.0, 0.003, 130)
    assert "130 poses, " in text
    assert cycle.result.warnings == ()


def test_what_somebody_asks_for_is_checked_and_other_solves_are_every_half_minute(
    cycle,
):
    for is_asked in (False, False, True):
        cycle._session.calibrator.add_pose(
            "parent", len(cycle.jobs), [0, 0, 0], [0, 0, 0, 1]
        )
        cycle.is_solving = False
        cycle._waiting = {}
        cycle.ask(lambda good, text: None) if is_asked else cycle.start_if_due()
    assert [job.check for job in cycle.jobs] == [False, True, False, True]


def test_who_waits_for_long_is_told_once_that_the_solve_goes_on(
    cycle, monkeypatch
):
    answers = []
    start_s = module.time.monotonic()
    cycle.ask(lambda *answer: answers.append(answer))
    cycle.answer_overdue()
    assert not answers
    monkeypatch.setattr(module.time, "monotonic", lambda: start_s + 30.0)
    cycle.answer_overdue()
    assert answers == [(False, answers[0][1])]
    assert answers[0][1].startswith("still solving after 20 s")
    cycle._process.answers = lambda: [Answer(0, 0.1, seen(40.0), result())]
    cycle.take_answers()
    assert len(answers) == 1


def test_the_rotation_that_was_seen_does_not_fall_while_driving(cycle):
    for degrees in (179.0, 175.0, 174.0):
        cycle.conclude(
            Answer(0, 0.1, seen(40.0, (0.0, 9.0, degrees)), result())
        )
        rotation_deg = cycle.extrinsic_state(
            True, (Broadcast.OFF, "")
        ).rotation_deg
        assert rotation_deg == pytest.approx({"x": 0.0, "y": 9.0, "z": 179.0})


@pytest.mark.parametrize(
    ("motion_s", "rotation_deg", "has_result"),
    [(19.0, 29.0, False), (20.0, 1.0, True), (3.0, 30.0, True)],
)
def test_a_first_result_takes_20_s_of_motion_or_a_rotation_of_30_deg(
    cycle, motion_s, rotation_deg, has_result
):
    motion = seen(motion_s, (0.0, 0.0, rotation_deg))
    good, text = cycle.conclude(Answer(0, 0.1, motion, result()))
    assert good == has_result
    assert (cycle.published is not None) == has_result
    if not has_result:
        assert text == (
            "Move the sensors for 20 s, or turn them by 30 deg. So far: 19 s and 29 deg."
        )
        assert cycle.goal.progress.sentence == text


@pytest.mark.parametrize(
    ("answer", "sentence"),
    [
        (
            Answer(0, 0.1, seen(25.0, (0.5, 0.5, 90.0)), failure=Failure("no")),
            "x, y and z cannot be determined from the motion so far. "
            "Drive tighter curves to both sides. Drive over a ramp",
        ),
        (
            Answer(
                0,
                0.1,
                determined(),
                failure=Failure("3 pairs: 9 poses; record longer"),
            ),
            "3 pairs. 9 poses. Record longer.",
        ),
        (
            Answer(0, 0.1, failure=Failure("3 pairs: 9 poses; record longer")),
            "Move the sensors for 20 s, or turn them by 30 deg. So far: 0 s and 0 deg.",
        ),
        (
            Answer(0, 0.1, seen(3.0, (0.5, 0.5, 90.0)), failure=Failure("no")),
            "No result yet after 3 s of motion: keep moving.",
        ),
    ],
)
def test_what_a_failed_solve_lacks_is_said_in_short_sentences(
    cycle, answer, sentence
):
    cycle.conclude(answer)
    assert cycle.goal.progress.sentence.startswith(sentence)


def test_streams_that_do_not_pair_are_named_once_they_have_many_poses(cycle):
    failure = Answer(0, 0.1, failure=Failure("no overlap", is_early=True))
    cycle.conclude(failure)
    assert "do not pair" not in cycle.goal.progress.sentence
    for k in range(100):
        for stream, hour_s in (("parent", 0), ("child", 3600)):
            stamp_ns = (hour_s * 10 + k) * 100_000_000
            cycle._session.calibrator.add_pose(
                stream, stamp_ns, [0, 0, 0], [0, 0, 0, 1]
            )
    cycle.conclude(failure)
    assert cycle.goal.progress.sentence.startswith(
        "The poses of both sensors do not pair."
    )


def test_a_solve_that_fails_says_so_and_changes_nothing(cycle):
    reach_goal(cycle)
    before = cycle.result
    good, text = answered(cycle, 46.0, status=SolveStatus.NOT_CONVERGED)
    assert (
        good,
        text.startswith("DO NOT USE: the solver did not converge"),
    ) == (
        False,
        True,
    )
    assert cycle.result is before


def test_streams_that_turn_out_faulty_end_done_and_the_verdict_says_the_same(
    cycle,
):
    reach_goal(cycle)
    finding = written_finding(
        "inverse", Severity.ERROR, "inverse poses", "invert"
    )
    result_of_check = CheckResult(findings=(finding,))
    _good, text = answered(cycle, 46.0, check=result_of_check)
    assert cycle.result.verdict is Verdict.DO_NOT_USE
    assert text.startswith("DO NOT USE: ")
    assert not cycle.goal.progress.done
    assert cycle.goal.progress.sentence.startswith(
        "Stop: the streams are faulty"
    )


def test_the_log_of_a_good_session_of_seven_minutes_is_short_and_asks_for_nothing(
    cycle, lines, monkeypatch
):
    """One solve every two seconds; each axis in turn is the one that lacks, then one is kept."""
    for k in range(210):
        now_s = 1e4 + 2.0 * k
        monkeypatch.setattr(module.time, "monotonic", lambda now_s=now_s: now_s)
        sigmas_m = 0.2 / np.sqrt(1.0 + k) * np.roll([1.0, 0.95, 0.9], k)
        answered(
            cycle,
            2.0 * k,
            tuple(np.where(k > 90, 0.005 * (1 + k % 2), sigmas_m)),
            100 + k,
        )
    assert cycle.goal.progress.done
    assert {level for level, _ in lines} <= {"info", "debug"}, lines
    shown = [text for level, text in lines if level != "debug"]
    assert (
        sum(len(text) + 60 for text in shown) < 5000
    )  # 60: what ROS writes before it
    assert cycle.goal.progress.sentence.startswith("Done: ")


def test_a_reason_is_a_warning_once_and_again_in_a_new_session(cycle, lines):
    flat = 0.0, 1.0, 90.0
    hidden = result((0.005, 0.005, np.inf), status=SolveStatus.UNOBSERVABLE)
    for session in range(2):
        for motion_s in (20.0, 40.0, 42.0):
            cycle.conclude(Answer(0, 0.1, seen(motion_s, flat), hidden))
        warned = [
            text
            for level, text in lines
            if (level, "CARE: z" in text) == ("warning", True)
        ]
        assert len(warned) == 1 + session, warned
        cycle.restart()
        cycle._log.restart()


def shape(hint):
    """What JSON has for a value of this type, in words; ? where it may be null."""
    words = {
        str: "text",
        bool: "true/false",
        int: "integer",
        float: "number",
        Level: "0/1/2",
    }
    inner = typing.get_args(hint)
    if types.NoneType in inner:
        return (
            f"{shape(inner[0])}?" if len(inner) == 2 else shape(hint.__origin__)
        )
    if inner and Ellipsis in inner:
        return f"[{shape(inner[0])}, ...]"
    if inner:
        return f"{{KEY: {shape(inner[1])}, ...}}"
    if dataclasses.is_dataclass(hint):
        hints = typing.get_type_hints(hint)
        return f"{{{', '.join(f'{name}: {shape(item)}' for name, item in hints.items())}}}"
    if hint not in words and issubclass(hint, Enum):
        return "/".join(map(plain, hint))
    return words[hint]


def test_the_keys_of_the_progress_topic_are_on_the_page_of_the_node():
    lines = [
        f"{name}: {shape(item)}"
        for name, item in typing.get_type_hints(NodeState).items()
    ]
    wrapped = [
        textwrap.fill(line, 98, subsequent_indent="  ") for line in lines
    ]
    text = "\n".join(["```text", *wrapped, "```"])
    page = (ROOT / "docs" / "node.md").read_text()
    assert text in page, f"docs/node.md must have this text:\n{text}"


def scatter(of_halves):
    """A cross-check in which both halves differ about the rotation about x."""
    row = AxisScatter(
        sigma=0.001, of_methods=0.0, of_halves=0.0, excess_of_halves=0.0
    )
    apart = dataclasses.replace(
        row, of_halves=of_halves, excess_of_halves=1000.0 * of_halves
    )
    return dict.fromkeys(AXES, row) | {"roll": apart}


def test_what_the_halves_of_the_whole_drive_no_longer_say_is_taken_back(
    cycle, lines
):
    for motion_s in (20.0, 32.0, 44.0):
        answered(cycle, motion_s, cross_check=scatter(0.7))
    assert [reason.rule for reason in cycle.result.reasons] == ["halves"]
    sentence = (
        "the two halves of the recording disagree about the rotation about x"
    )
    assert "warning" in {level for level, text in lines if sentence in text}
    # The newest result is worse, and the one before is kept.
    _, text = answered(
        cycle, 60.0, (0.005, 0.01, 0.005), 200, cross_check=scatter(0.0)
    )
    assert "the result of 100 poses is kept" in text
    assert cycle.result.verdict is Verdict.USE
    taken_back = [
        (level, text)
        for level, text in lines
        if text.startswith("no longer found")
    ]
    assert [level for level, _ in taken_back] == ["info"]
    assert sentence in taken_back[0][1]


def test_a_solve_on_a_busy_computer_is_named_and_its_pause_is_short(
    cycle, lines, monkeypatch
):
    now_s = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now_s[0])
    cycle.start_if_due()
    answer = Answer(0, 60.0, seen(30.0), result(), processor_s=0.5)
    cycle.conclude(answer)
    state = cycle.extrinsic_state(True, (Broadcast.OFF, ""))
    assert state.slow == "The computer is busy: a result takes 60 s."
    assert ("warning", state.slow) in lines
    assert cycle._rest_until_s == 100.5
    cycle.conclude(dataclasses.replace(answer, seconds=15.0, processor_s=14.0))
    slow = cycle.extrinsic_state(True, (Broadcast.OFF, "")).slow
    assert slow == "The computer is slow: a result takes 10 s."
    cycle.conclude(dataclasses.replace(answer, seconds=1.0, processor_s=0.5))
    assert cycle.extrinsic_state(True, (Broadcast.OFF, "")).slow == ""


def test_the_next_solve_has_hurry_if_other_programs_have_held_up_the_last_one(
    cycle,
):
    hurries = [cycle.jobs[-1].has_hurry]
    for seconds, processor_s in (
        (60.0, 0.5),
        (1.0, 0.1),
        (15.0, 14.0),
        (15.0, 0.4),
    ):
        cycle.conclude(
            Answer(0, seconds, seen(30.0), result(), processor_s=processor_s)
        )
        cycle._start()
        hurries.append(cycle.jobs[-1].has_hurry)
    assert hurries == [False, True, False, False, True]


def test_a_running_solve_that_takes_long_is_named_before_it_ends(
    cycle, monkeypatch
):
    now_s = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now_s[0])
    cycle._start()
    assert cycle.extrinsic_state(True, (Broadcast.OFF, "")).slow == ""
    now_s[0] = 130.0
    slow = cycle.extrinsic_state(True, (Broadcast.OFF, "")).slow
    assert slow == "The computer is busy: a result takes 30 s."


def test_checks_are_rare_if_a_solve_takes_long(cycle, monkeypatch):
    now_s = [1000.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now_s[0])
    cycle.conclude(Answer(0, 60.0, seen(30.0), result(), processor_s=0.5))
    cycle._is_unchecked = True
    cycle._start()
    assert cycle.jobs[-1].check
    assert cycle._check_due_s == 1000.0 + 4 * 60.0
