"""What the node reports on ``/diagnostics``, for a person next to the robot.

A level asks for something: WARN if a person should act, ERROR if something is broken.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray

from hand_eye_calib.assessment.excitation import Excitation, what_is_missing
from hand_eye_calib.config import NodeConfig
from hand_eye_calib.results.calibration import Calibration, Verdict
from hand_eye_calib.ros.check_monitor import CheckMonitor
from hand_eye_calib.ros.conversions import to_time
from hand_eye_calib.ros.input_monitor import InputMonitor
from hand_eye_calib.ros.inputs import PoseInput
from hand_eye_calib.ros.live_session import LiveSession
from hand_eye_calib.ros.mount import MountWatch
from hand_eye_calib.ros.parameters import Parameters
from hand_eye_calib.ros.progress import progress_report
from hand_eye_calib.ros.robot import Robot
from hand_eye_calib.ros.solve_cycle import SolveCycle
from hand_eye_calib.ros.solving import FailureKind
from hand_eye_calib.ros.status import ERROR, OK, WARN, Report, to_status
from hand_eye_calib.ros.tf import TfBroadcaster

# If poses wait that no result contains, the result is stale when it is older than this many solve
# periods, and than so many seconds.
_STALE_PERIODS, _STALE_S = 5, 10.0

# Inputs whose stamps differ by more than this (s) from what time_offset says are suspected of
# different clocks.
_SUSPICIOUS_OFFSET_S = 2.0


@dataclass(frozen=True)
class NodeParts:
    """The parts of the node that are reported."""

    name: str
    options: Parameters
    session: LiveSession
    inputs: tuple[PoseInput, PoseInput]
    cycle: SolveCycle
    checks: CheckMonitor
    tf: TfBroadcaster
    robot: Robot
    mount: MountWatch | None = None
    others: tuple[PoseInput, ...] = ()


def diagnostics(parts: NodeParts, steady_s: float, clock_ns: int) -> DiagnosticArray:
    """The message for ``/diagnostics``.

    Parameters
    ----------
    parts : NodeParts
    steady_s : float
        Steady time.
    clock_ns : int
        The node's clock; 0 if it does not run yet.
    """
    if parts.mount is not None:
        reports = {"mount": parts.mount.report(), **_input_reports(parts, steady_s)}
        return _message(parts.name, reports, clock_ns)
    reports = {
        "extrinsic": extrinsic_report(parts, steady_s, clock_ns),
        "progress": progress_report(
            parts.cycle.goal.progress, parts.cycle.result, parts.robot.why_not_compared
        ),
        **_input_reports(parts, steady_s),
        "stream checks": parts.checks.report(steady_s),
        "journal": journal_report(parts.session, parts.options.node),
    }
    return _message(parts.name, reports, clock_ns)


def _message(name: str, reports: Mapping[str, Report], clock_ns: int) -> DiagnosticArray:
    message = DiagnosticArray(
        status=[to_status(name, part, report) for part, report in reports.items()]
    )
    message.header.stamp = to_time(clock_ns)
    return message


# ------------------------------------------------------------------- extrinsic


def extrinsic_report(parts: NodeParts, steady_s: float, clock_ns: int) -> Report:
    """The result: what is missing, how good it is, how it was found."""
    cycle = parts.cycle
    age_s = None if cycle.solved_at_s is None else steady_s - cycle.solved_at_s
    missing = ""
    if cycle.seen is not None and cycle.seen.n_poses:
        missing = what_is_missing(cycle.seen, cycle.result)
    values = {
        "accepting poses": "yes" if parts.inputs[0].is_enabled else "no",
        "solver": "solving" if cycle.is_solving else "waiting",
        "solves": cycle.solves,
        "last solve took (s)": f"{cycle.seconds:.3f}",
        "last failure": cycle.failure.what if cycle.failure else "none",
        **(_motion_values(cycle.seen) if cycle.seen is not None else {}),
        "broadcast on /tf_static": parts.tf.state,
        "missing": missing or ("nothing" if cycle.result else "-"),
    }
    if cycle.result is not None and age_s is not None:
        values |= _result_values(cycle.result, age_s, clock_ns)
    return Report(*_judge(parts, age_s, missing), values)


def _motion_values(seen: Excitation) -> dict[str, object]:
    rotations = zip("xyz", np.degrees(seen.rotation), strict=True)
    gains = zip("xyz", seen.gain, strict=True)
    return {
        "synchronised poses": seen.n_poses,
        "path length (m)": f"{seen.distance:.1f}",
        **{f"rotation about {axis} (deg)": f"{angle:.1f}" for axis, angle in rotations},
        **{
            f"displacement per metre of offset in {axis} (m)": f"{gain:.3f}" for axis, gain in gains
        },
    }


def _result_values(calibration: Calibration, age_s: float, clock_ns: int) -> dict[str, object]:
    frames = f"{calibration.child_frame} in {calibration.parent_frame}"
    x, y, z = calibration.T_parent_child[:3, 3]
    time_offset = f"{calibration.time_offset_s:.6f} +/- {calibration.time_offset_sigma_s:.6f}"
    scale = f"{calibration.scale:.6f} +/- {calibration.scale_sigma:.6f}"
    inliers = 100 * calibration.n_inliers / max(calibration.n_pairs, 1)
    return {
        "verdict": calibration.headline,
        "reasons": "; ".join(f"{each.sentence}: {each.what_to_do}" for each in calibration.reasons)
        or "none",
        "status": calibration.status.value,
        "extrinsic": f"{frames}: ({x:.4f}, {y:.4f}, {z:.4f}) m",
        "method": f"{calibration.method} {calibration.reference} {calibration.backend}",
        "pairs": calibration.n_pairs,
        "inliers (%)": f"{inliers:.1f}",
        "age of the result (s)": f"{age_s:.1f}",
        "age of its newest pose (s)": _age_of_newest(calibration.stamp_ns, clock_ns),
        "time offset used (s)": time_offset,
        "scale used": scale,
        **_sigmas(calibration),
        **{f"verdict {dof.name}": dof.verdict.value for dof in calibration.observability},
        "warnings": "; ".join(calibration.warnings) or "none",
    }


def _age_of_newest(stamp_ns: int, clock_ns: int) -> str:
    if not clock_ns:
        return "the clock does not run: nothing on /clock"
    return f"{(clock_ns - stamp_ns) * 1e-9:.1f}"


def _judge(parts: NodeParts, age_s: float | None, missing: str) -> tuple[bytes, str]:
    """Level and message: the gravest that applies."""
    result, failure = parts.cycle.result, parts.cycle.failure
    if failure is not None and failure.kind is FailureKind.UNEXPECTED:
        return ERROR, f"the solve failed unexpectedly, see the log: {failure.what}"
    if not parts.inputs[0].is_enabled:
        return WARN, "not accepting poses: call ~/set_enabled to go on"
    said = failure.what if failure else ""
    if result is None or age_s is None:
        faults = [f"{Verdict.DO_NOT_USE.value}: {fault}" for fault in parts.checks.faults()[:1]]
        return WARN, "; ".join(filter(None, (*faults, said, missing))) or "no result yet"
    if result.verdict is Verdict.DO_NOT_USE:
        return WARN, result.headline
    if parts.tf.refused:
        return WARN, f"publish_tf is refused: {parts.tf.refused}"
    if _is_stale(parts, age_s):
        return WARN, ": ".join(filter(None, (f"the result is {age_s:.0f} s old", said)))
    level = OK if result.verdict is Verdict.USE else WARN
    return level, "; ".join(filter(None, (result.headline, missing)))


def _is_stale(parts: NodeParts, age_s: float) -> bool:
    """Whether poses wait too long for a solve; on a parked robot, none do."""
    limit_s = max(_STALE_S, _STALE_PERIODS * parts.options.node.solve_period)
    return parts.session.has_new_poses and age_s > limit_s


def _sigmas(calibration: Calibration) -> dict[str, str]:
    """Standard deviations of the translation and of the angles as they are printed."""
    translations = zip("xyz", calibration.sigmas[:3], strict=True)
    angles = zip(("roll", "pitch", "yaw"), calibration.sigmas_rpy, strict=True)
    values = {f"sigma {name} (mm)": _known(1000 * sigma, 2) for name, sigma in translations}
    return values | {f"sigma {name} (deg)": _known(np.degrees(sigma), 4) for name, sigma in angles}


def _known(sigma: float, decimals: int) -> str:
    return f"{sigma:.{decimals}f}" if np.isfinite(sigma) else "unknown"


# ---------------------------------------------------------------------- inputs


def _input_reports(parts: NodeParts, steady_s: float) -> dict[str, Report]:
    all_silent = all(each.monitor.is_silent(steady_s) for each in parts.inputs)
    may_rest = all_silent and parts.cycle.has_valid_result
    reports = {
        each.name: each.monitor.report(
            each.topic, steady_s, each.statistics, may_rest, each.what_is_missing()
        )
        for each in (*parts.inputs, *parts.others)
    }
    others = {f"{each.name} input": reports.pop(each.name) for each in parts.others}
    seen_s = _clock_offset(*(each.monitor for each in parts.inputs))
    result = parts.cycle.result
    used_s = result.time_offset_s if result else parts.options.calibrator.time_offset
    return {
        f"{name} input": with_clock_offset(report, seen_s, used_s)
        for name, report in reports.items()
    } | others


def _clock_offset(parent: InputMonitor, child: InputMonitor) -> float | None:
    """Offset seen between the inputs' clocks, in s to be added to the child's stamps; None until
    both have delivered.
    """
    if parent.delay_s is None or child.delay_s is None:
        return None
    return child.delay_s - parent.delay_s


def with_clock_offset(report: Report, seen_s: float | None, used_s: float | str) -> Report:
    """An input's report with the clock offset seen; a warning if it is far from the one used."""
    values = {
        **report.values,
        "clock offset to the other input seen (s)": "-" if seen_s is None else f"{seen_s:.4f}",
        "time offset used (s)": used_s if isinstance(used_s, str) else f"{used_s:.6f}",
    }
    level, text = report.level, report.text
    if level != OK or seen_s is None or isinstance(used_s, str):
        return Report(level, text, values)
    if abs(seen_s - used_s) > _SUSPICIOUS_OFFSET_S:
        level = WARN
        text += (
            f"; the stamps of the two inputs are {seen_s:.3f} s apart but time_offset is "
            f"{used_s:.3f}: if their clocks differ, set time_offset"
        )
    return Report(level, text, values)


# --------------------------------------------------------------------- journal


def journal_report(session: LiveSession, options: NodeConfig) -> Report:
    """Whether a crash would lose the session."""
    values = {"directory": session.journal_directory or "none"}
    if session.journal_error:
        text = f"cannot write: {session.journal_error}; a crash would lose the session"
        return Report(ERROR, text, values)
    if session.journal_directory is not None:
        return Report(OK, "the session is being written", values)
    if options.journal == "off":
        return Report(OK, "off", values)
    text = "off: output_directory is not set, a crash would lose the session"
    return Report(WARN, text, values)
