"""Faults of the poses as they came in: found also once poses are paired, and never taken back."""

from types import SimpleNamespace

import numpy as np
import pytest
from findings import codes_of
from motions import as_trajectory, disturbed, feed, smooth_poses
from result_making import good_calibration, seen, written_finding

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.checks.check import CheckResult
from hand_eye_calib.core.checks.findings import Severity, finding
from hand_eye_calib.core.engine.calibrator import BufferLimits, Calibrator
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.calibration import Verdict
from hand_eye_calib.online.live import cycle as module
from hand_eye_calib.online.live.cycle import SolveCycle
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.live.session import LiveSession
from hand_eye_calib.online.live.solving import Answer, Job, answer
from hand_eye_calib.online.live.stream_checks import StreamChecks

T_PARENT_CHILD = se3.exp(np.array([0.4, -0.3, 0.2, 1.1, -0.7, 0.5]))
QUICK = BufferLimits(pairing_starts=400, batch=100, batch_every=10)


def streams(seconds, levels_from_s=np.inf):
    """Parent at 10 Hz and child at 20 Hz; from some time on, a second source 3 cm beside the child
    publishes every other pose.
    """
    times_s = np.arange(0.0, seconds, 0.05)
    poses = smooth_poses(times_s)
    parent = as_trajectory(disturbed(poses[::2], 1, 1e-3, 5e-4), 10.0)
    child = disturbed(poses @ T_PARENT_CHILD, 2, 1e-3, 5e-4)
    is_other = (times_s >= levels_from_s) & (np.arange(len(times_s)) % 2 == 1)
    child[is_other, 0, 3] += 0.03
    return parent, as_trajectory(child, 20.0)


def checked(parent, child, limits=QUICK):
    calibrator = Calibrator(CalibratorConfig(), limits)
    split = [trajectory.stamps_ns for trajectory in (parent, child)]
    for second in range(int(parent.duration_s) + 1):
        for stream, trajectory, stamps_ns in zip(
            ("parent", "child"), (parent, child), split, strict=True
        ):
            is_now = (stamps_ns - stamps_ns[0]) // 10**9 == second
            feed(calibrator, stream, trajectory[is_now])
    result = answer(Job(0, calibrator, check=True))
    return calibrator, {
        finding.code
        for finding in result.check.findings
        if finding.makes_unusable
    }


@pytest.mark.parametrize(
    ("levels_from_s", "codes"),
    [(np.inf, set()), (0.0, {"interleaved"}), (40.0, {"interleaved"})],
)
def test_two_sources_are_found_after_poses_were_paired_also_if_one_came_later(
    levels_from_s, codes
):
    calibrator, errors = checked(*streams(60.0, levels_from_s))
    assert len(calibrator.snapshot().kept) > 200
    assert errors == codes


def raw(code="interleaved", **fields):
    return written_finding(
        code,
        Severity.ERROR,
        "it alternates",
        "part it",
        stream="child",
        **fields,
    )


@pytest.fixture
def checks():
    silent = dict.fromkeys(
        ("debug", "info", "warning", "error"), lambda text: None
    )
    return StreamChecks(NodeLog(SimpleNamespace(**silent)))


@pytest.mark.parametrize(
    ("fault", "stays"),
    [
        (raw("interleaved"), True),
        (raw("leap"), True),
        (raw("frozen"), True),
        (raw("coarse_positions"), True),
        (finding("units", "child", scale=0.001, sigma=0.0, unit="mm", other="parent"), False),
        (finding("unrelated", doubt="at no clock offset"), False),
    ],
)  # fmt: skip
def test_what_only_raw_poses_show_stays_until_a_reset(checks, fault, stays):
    checks.take(CheckResult((fault,)))
    for _ in range(3):
        checks.take(CheckResult(()))
    assert codes_of(checks.findings) == [fault.code] * stays
    assert [
        fault.code in text or fault.what in text
        for text in checks.state().findings
    ] == ([True] * stays)
    checks.restart()
    assert (checks.findings, checks.state().findings) == ((), ())


def test_a_fault_that_an_option_answers_does_not_stay(checks):
    checks.take(CheckResult((raw(options={"method": "dnlo"}),)))
    checks.follow(CalibratorConfig())
    checks.take(CheckResult(()))
    assert len(checks.findings) == 1
    checks.follow(CalibratorConfig(method="dnlo"))
    checks.take(CheckResult(()))
    assert checks.findings == ()


@pytest.mark.parametrize("measured", ["poses", "positions", "rotations"])
def test_a_lasting_fault_forbids_results_of_every_kind_of_streams(
    monkeypatch, measured
):
    nothing = SimpleNamespace(
        submit=lambda job: None, stop=lambda s: None, answers=list
    )
    monkeypatch.setattr(module, "SolvingProcess", lambda wake: nothing)
    silent = dict.fromkeys(
        ("debug", "info", "warning", "error"), lambda text: None
    )
    log = NodeLog(SimpleNamespace(**silent))
    session = LiveSession(log, CalibratorConfig())
    targets = CalibratorConfig().targets
    cycle = SolveCycle(
        session, log, print, lambda calibration: calibration, print, targets
    )
    cycle.ask(lambda good, text: None)
    good = good_calibration(measured=measured, warnings=())
    cycle.conclude(
        Answer(0, 0.1, seen(40.0), good, check=CheckResult((raw(),)))
    )
    cycle.conclude(Answer(0, 0.1, seen(42.0), good, check=CheckResult(())))
    assert cycle.result.verdict is Verdict.DO_NOT_USE
    assert cycle.published is None
    assert cycle.progress_state("").text.startswith(
        "Stop: the streams are faulty: it alternates"
    )
