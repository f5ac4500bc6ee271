"""A result that later solves refute or cannot repeat: what each surface says of it."""

import dataclasses
import io
from types import SimpleNamespace

import numpy as np
import pytest
from result_making import calibration, seen, written_finding
from rich.console import Console

from hand_eye_calib.core.base.config import CalibratorConfig, NodeConfig
from hand_eye_calib.core.checks.check import CheckResult
from hand_eye_calib.core.checks.findings import Severity
from hand_eye_calib.core.results.calibration import (
    DofObservability,
    DofVerdict,
    SolveStatus,
    Verdict,
)
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.formats.results import load_result
from hand_eye_calib.online.live import cycle as module
from hand_eye_calib.online.live.cycle import SolveCycle
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.live.saving import Saver
from hand_eye_calib.online.live.session import LiveSession
from hand_eye_calib.online.live.solving import Answer, Failure
from hand_eye_calib.online.live.state import (
    Broadcast,
    Level,
    NodeState,
    Standing,
)
from hand_eye_calib.online.watch import terminal
from hand_eye_calib.online.watch.board import Board, Tone
from hand_eye_calib.online.watch.web import fragment

TARGETS = (0.02,) * 3 + (0.005,) * 3
INVERSE = written_finding(
    "inverse", Severity.ERROR, "inverse poses", "invert them"
)


def dofs(sigma_m=0.005, **verdicts):
    """What is known of six axes: translations to this standard deviation, rotations well."""
    sigmas = [sigma_m] * 3 + [0.001] * 3
    axes = zip(AXES, sigmas, strict=True)
    return tuple(
        DofObservability(axis, verdicts.get(axis, DofVerdict.OBSERVED), sigma)
        for axis, sigma in axes
    )


def result(sigma_m=0.005, **fields):
    """A result that is good on all axes, unless the fields say something else."""
    usual = {
        "status": SolveStatus.OK,
        "noise": None,
        "warnings": (),
        "findings": (),
    }
    usual["observability_measured"] = dofs(sigma_m)
    return dataclasses.replace(calibration(), **(usual | fields))


def contradicted():
    return result(status=SolveStatus.CONTRADICTED, contradictions={"z": 18.2})


@pytest.fixture
def session(monkeypatch):
    """The live session, its cycle and saver, with a prior on z, and without a solving process."""
    nothing = SimpleNamespace(
        submit=lambda job: None, stop=lambda s: None, answers=list
    )
    monkeypatch.setattr(module, "SolvingProcess", lambda wake: nothing)
    silent = dict.fromkeys(
        ("debug", "info", "warning", "error"), lambda text: None
    )
    log = NodeLog(SimpleNamespace(**silent))
    live = LiveSession(log, CalibratorConfig(prior_z="1.5m+/-0.02m"))
    cycle = SolveCycle(
        live, log, print, lambda calibration: calibration, print, TARGETS
    )
    cycle.ask(lambda good, text: None)
    return SimpleNamespace(
        cycle=cycle, saver=Saver(live, cycle, log), live=live
    )


def conclude(session, motion_s, newest=None, **fields):
    return session.cycle.conclude(
        Answer(0, 0.1, seen(motion_s), newest, **fields)
    )


def state_of(session):
    return NodeState(
        node="/calibrator",
        extrinsic=session.cycle.extrinsic_state(True, (Broadcast.OFF, "")),
        progress=session.cycle.progress_state(""),
        checks=session.cycle.checks.state(),
        saved=session.saver.state,
    )


def view_of(session):
    board = Board()
    board.take(state_of(session), 0.0)
    return board.view(0.5)


def drawn(view):
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(terminal.screen(view, 200))
    return console.export_text()


# Failure of the newest solve: its answer, the standing of the result, the headline's word, and what
# every surface says.
FAILURES = {
    "contradicted prior": (
        {"newest": contradicted()},
        Standing.REFUTED,
        "CHECK THE VALUE",
        "the prior on z is 18 standard deviations from the estimate from the motion",
    ),
    "faulty streams": (
        {"newest": result(), "check": CheckResult((INVERSE,))},
        Standing.REFUTED,
        "CHECK THE STREAMS",
        "inverse poses",
    ),
    "not converged": (
        {"newest": result(status=SolveStatus.NOT_CONVERGED)},
        Standing.OUTDATED,
        "OLD RESULT",
        "the solver did not converge; the result shown is",
    ),
    "too few poses": (
        {
            "failure": Failure(
                "10 synchronised pose pairs are needed, found 3", is_early=True
            )
        },
        Standing.OUTDATED,
        "OLD RESULT",
        "10 synchronised pose pairs are needed, found 3; the result shown is",
    ),
    "unusable streams": (
        {"failure": Failure("both streams name 'imu' as their sensor frame")},
        Standing.OUTDATED,
        "OLD RESULT",
        "both streams name 'imu' as their sensor frame; the result shown is",
    ),
    "dead process": (
        {
            "failure": Failure(
                "the solving process was ended by SIGKILL",
                "it was started again",
            )
        },
        Standing.OUTDATED,
        "BROKEN",
        "the solving process was ended by SIGKILL",
    ),
}


@pytest.fixture(params=[False, True], ids=["before the goal", "after the goal"])
def with_result(session, request):
    """The session with a good result, with which it may have reached the goal."""
    for motion_s in (20.0, 32.0, 44.0) if request.param else (40.0,):
        conclude(session, motion_s, result())
    assert session.cycle.goal.progress.done == request.param
    assert session.cycle.standing is Standing.CURRENT
    return session


@pytest.mark.parametrize("failure", FAILURES)
def test_every_surface_says_that_the_newest_solve_has_failed(
    with_result, failure, tmp_path
):
    session = with_result
    answer, standing, word, sentence = FAILURES[failure]
    before = session.cycle.result
    good, _ = conclude(session, 50.0, **answer)
    state = state_of(session)
    view = view_of(session)
    saved, line = session.saver.save(
        NodeConfig(output_directory=str(tmp_path), report=False)
    )
    file = load_result(tmp_path)
    # topics
    assert session.cycle.standing is standing
    is_refuted = standing is Standing.REFUTED
    assert session.cycle.published is (None if is_refuted else before)
    # diagnostics and progress
    assert state.extrinsic.standing is standing
    assert state.extrinsic.level >= Level.WARN
    assert sentence.partition("; the result")[0] in state.extrinsic.text
    assert state.progress.level is Level.WARN
    assert sentence in state.progress.text
    assert not (is_refuted and state.progress.progress.done)
    # page and terminal
    assert view.word == word
    assert view.tone in (Tone.BAD, Tone.ACT)
    for shown in (drawn(view), fragment(view)):
        assert word in shown
    lines = (line.text for line in view.result + view.health)
    on_the_board = " ".join((view.sentence, *view.reasons, *lines))
    assert sentence.partition("; the result")[0][1:] in on_the_board
    assert (view.values == ()) == is_refuted
    # the file, and the answer of ~/save
    assert saved
    assert sentence in line
    assert sentence in " ".join((file.headline, *file.warnings))
    assert (file.verdict is Verdict.DO_NOT_USE) == is_refuted
    assert line.startswith(f"result saved to {tmp_path}: {file.verdict.value}")
    assert session.saver.state.verdict == file.verdict.value
    assert good == (failure == "faulty streams")


def test_an_outdated_result_says_how_long_solves_have_failed_and_how_old_it_is(
    session, monkeypatch
):
    start_s = module.time.monotonic()
    conclude(session, 40.0, result())
    for late_s in (10.0, 70.0):
        monkeypatch.setattr(
            module.time, "monotonic", lambda late_s=late_s: start_s + late_s
        )
        conclude(session, 40.0 + late_s, failure=Failure("no overlap"))
    text = state_of(session).progress.text
    assert text == (
        "every solve has failed for 60 s: no overlap; the result shown is 70 s old, of 448 poses"
    )
    assert "newer solves fail" in view_of(session).facts
    conclude(session, 120.0, result())
    assert session.cycle.standing is Standing.CURRENT
    assert "every solve" not in state_of(session).progress.text


def test_the_form_of_a_contradicted_prior_stays_until_it_is_removed(session):
    conclude(session, 40.0, result())
    conclude(session, 42.0, contradicted())
    view = view_of(session)
    assert (view.by_hand, view.priors) == (("z",), (("z", "1.5m+/-0.02m"),))
    assert "forget" in view.buttons
    prior = next(line for line in view.result if line.name == "typed in")
    assert (prior.tone, prior.text) == (
        Tone.BAD,
        "z = 1.5m ± 0.02m: contradicts the motion",
    )
    assert {bar.word for bar in view.bars} == {"no usable result"}
    before = session.live.calibrator.config
    session.live.reconfigure(dataclasses.replace(before, prior_z=""))
    session.cycle.follow(session.live.calibrator.config, before)
    conclude(session, 42.0, result())
    view = view_of(session)
    assert (view.by_hand, view.priors, "forget" in view.buttons) == (
        (),
        (),
        False,
    )
    assert session.cycle.published is session.cycle.result
    assert len(view.values) == 6


def test_the_end_of_a_node_with_a_refuted_result_is_no_success(
    session, tmp_path
):
    conclude(session, 40.0, contradicted())
    session.saver.save(NodeConfig(output_directory=str(tmp_path), report=False))
    board = Board()
    board.take(dataclasses.replace(state_of(session), has_ended=True), 0.0)
    view = board.view(0.5)
    assert (view.word, view.tone) == ("ENDED", Tone.BAD)
    cause = "DO NOT USE: the value typed in for z contradicts the motion."
    assert view.sentence.startswith(f"{cause} The result was saved at ")
    assert (view.advice, view.by_hand) == (
        "Mend the fault, and record again.",
        (),
    )


class TestOptions:
    """A parked robot: no solve brings more motion."""

    @staticmethod
    def follow(session, **options):
        before = session.live.calibrator.config
        session.live.reconfigure(dataclasses.replace(before, **options))
        session.cycle.follow(session.live.calibrator.config, before)

    def test_a_looser_target_judges_the_present_result_without_a_solve(
        self, session
    ):
        for motion_s in (20.0, 42.0):
            conclude(session, motion_s, result(0.05))
        assert not session.cycle.goal.progress.done
        assert session.cycle.result.verdict is Verdict.USE_WITH_CARE
        self.follow(session, target_translation=0.1)
        state = state_of(session)
        view = view_of(session)
        assert state.progress.progress.done
        assert state.progress.progress.axes["x"].target == pytest.approx(0.1)
        assert (state.extrinsic.result.verdict, view.word) == ("USE", "DONE")
        # And a solve of the same poses changes nothing of that.
        conclude(session, 42.0, result(0.05, target_translation=0.1))
        assert state_of(session).progress.progress.done

    def test_a_stricter_target_takes_done_back(self, session):
        for motion_s in (20.0, 32.0, 44.0):
            conclude(session, motion_s, result())
        assert session.cycle.goal.progress.done
        self.follow(session, target_axes="x=1mm")
        state = state_of(session)
        assert not state.progress.progress.done
        assert state.progress.progress.limiting_axis == "x"
        assert state.extrinsic.result.verdict == "USE WITH CARE"

    @pytest.mark.parametrize(
        ("option", "poor", "good"),
        [
            (
                {"prior_z": "0.3+/-0.01"},
                result(
                    observability_measured=(
                        *dofs()[:2],
                        DofObservability("z", DofVerdict.UNOBSERVABLE, np.inf),
                        *dofs()[3:],
                    )
                ),
                result(observability_measured=dofs(z=DofVerdict.PRIOR)),
            ),
            (
                {"child_kind": "exact"},
                result(
                    0.008,
                    covariance_allowance=np.diag([0.05**2] * 3 + [1e-8] * 3),
                ),
                result(0.008),
            ),
        ],
        ids=["a prior", "a sensor without constant errors"],
    )
    def test_another_option_that_makes_the_result_good_ends_the_session(
        self, session, option, poor, good
    ):
        for motion_s in (20.0, 42.0):
            conclude(session, motion_s, poor)
        assert not session.cycle.goal.progress.done
        self.follow(session, **option)
        assert (
            session.cycle.goal.progress.sentence
            == "Solving with the new options."
        )
        conclude(session, 42.0, good)
        assert session.cycle.goal.progress.done

    def test_one_result_of_a_parked_robot_does_not_confirm_itself(
        self, session
    ):
        conclude(session, 42.0, result(0.05))
        self.follow(session, target_translation=0.1)
        for _ in range(3):
            conclude(session, 42.0, result(0.05, target_translation=0.1))
        assert not session.cycle.goal.progress.done
