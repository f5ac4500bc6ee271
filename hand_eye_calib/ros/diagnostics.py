"""What the node says about itself on ``/diagnostics``, for a person next to the robot."""

import time
from collections import Counter, deque
from dataclasses import dataclass

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from hand_eye_calib.assessment.excitation import Excitation, what_is_missing
from hand_eye_calib.calibration import Calibration, DofVerdict, SolveStatus
from hand_eye_calib.checks.check import MIN_DURATION_S, MIN_ROTATION_RAD
from hand_eye_calib.checks.findings import Confidence, Severity

HARDWARE_ID = "hand_eye_calib"
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

# An input that has been silent for so long is stale, and bad input is spoken of for so long (s).
STALE_AFTER_S = 2.0
BAD_INPUT_FOR_S = 10.0

# Streams whose stamps differ by more than this (s) from what time_offset says are suspected of
# different clocks.
SUSPICIOUS_OFFSET_S = 2.0

# The streams are checked at most this often (s), which costs a second or two each time.
CHECK_PERIOD_S = 30.0

# Reports over which the rate is taken, and most delays looked at in one.
_RATE_REPORTS = 5
_MOST_DELAYS = 5000


class InputMonitor:
    """Keeps count of one input between two reports."""

    def __init__(self):
        self.arrived = 0
        self.ignored = 0
        self.refused = Counter()
        self.delay_s = None
        self.bad = ""
        self._bad_at_s = -np.inf
        self._arrived_at_s = None
        self._last_stamp_ns = None
        self._delays_ns = deque(maxlen=_MOST_DELAYS)
        self._longest_gap_ns = 0
        self._long_gaps = 0
        self._counts = deque([(time.monotonic(), 0)], maxlen=_RATE_REPORTS + 1)

    def note(self, stamp_ns, clock_ns, steady_s, max_gap_ns):
        """A message has come in; ``clock_ns`` is the node's clock, 0 where it does not run yet."""
        self.arrived += 1
        self._arrived_at_s = steady_s
        if clock_ns:
            self._delays_ns.append(clock_ns - stamp_ns)
        if self._last_stamp_ns is not None:
            gap_ns = stamp_ns - self._last_stamp_ns
            self._longest_gap_ns = max(self._longest_gap_ns, gap_ns)
            self._long_gaps += gap_ns > max_gap_ns
        self._last_stamp_ns = stamp_ns

    def note_bad(self, reason, text, steady_s):
        """A message could not be used."""
        self.refused[reason] += 1
        self.bad, self._bad_at_s = text, steady_s

    def restart(self):
        """A new session: gaps are counted anew."""
        self._last_stamp_ns = None
        self._longest_gap_ns = self._long_gaps = 0

    def report(self, topic, steady_s, statistics):
        """Level, message and values of this input; begins a new interval."""
        self._counts.append((steady_s, self.arrived))
        (start_s, start), (end_s, end) = self._counts[0], self._counts[-1]
        rate = (end - start) / (end_s - start_s) if end_s > start_s else 0.0
        silent_s = None if self._arrived_at_s is None else steady_s - self._arrived_at_s
        delays_s = np.array(self._delays_ns) * 1e-9
        self._delays_ns.clear()
        self.delay_s = float(np.median(delays_s)) if delays_s.size else None
        values = {
            "topic": topic,
            "rate (Hz)": f"{rate:.1f}",
            "messages": self.arrived,
            "poses taken": statistics.received,
            "refused: repeated stamp": statistics.refused_duplicate,
            "refused: too late": statistics.refused_late,
            **{f"refused: {reason}": count for reason, count in sorted(self.refused.items())},
            "let go, the other input had nothing at their time": statistics.dropped_unpaired,
            "ignored while disabled": self.ignored,
            "longest gap (s)": f"{self._longest_gap_ns * 1e-9:.3f}",
            "gaps above max_gap": self._long_gaps,
            "silent for (s)": "never heard" if silent_s is None else f"{silent_s:.1f}",
            "node clock minus stamps, median (s)": "-"
            if self.delay_s is None
            else f"{self.delay_s:.4f}",
            "node clock minus stamps, 99 % (s)": f"{np.percentile(delays_s, 99):.4f}"
            if delays_s.size
            else "-",
        }
        level, text = OK, f"{rate:.1f} Hz"
        if silent_s is None:
            level, text = WARN, f"no message on {topic} yet"
        elif steady_s - self._bad_at_s < BAD_INPUT_FOR_S:
            level, text = ERROR, f"{topic}: {self.bad}"
        elif silent_s > STALE_AFTER_S:
            level, text = WARN, f"{topic} has been silent for {silent_s:.0f} s"
        return level, text, values


class StreamChecks:
    """When to check the streams, and what the last check found.

    Errors count at once; warnings, and what is merely possible, where two checks in a row have
    them: over a short drive, odometry may well be off by some per cent.

    Attributes
    ----------
    has_new_poses : bool
        Poses have come in since the last check was asked for.
    """

    def __init__(self):
        self.restart()

    def restart(self):
        """A new session: nothing is known yet."""
        self.has_new_poses = False
        self._agreement = self._checked_at_s = None
        self._suspected = set()
        self._faults = {}
        self._due_at_s = -np.inf

    def hasten(self):
        """Other options: what they change is to be seen at once."""
        self.has_new_poses, self._due_at_s = True, -np.inf

    def is_due(self, steady_s):
        """Whether it is time for a check."""
        return self.has_new_poses and steady_s >= self._due_at_s

    def begin(self, steady_s):
        """A check has been asked for."""
        self.has_new_poses, self._due_at_s = False, steady_s + CHECK_PERIOD_S

    def take(self, agreement, steady_s):
        """What a check found, None where the poses did not suffice; lines for the log: new
        findings, and those that are gone.
        """
        if agreement is None:
            self._due_at_s = -np.inf
            return [], []
        before, self._agreement, self._checked_at_s = self._faults, agreement, steady_s
        found = {
            (f.code, f.stream): f for f in agreement.findings if f.severity is not Severity.NOTE
        }
        self._faults = {key: f for key, f in found.items() if _is_sure(f) or key in self._suspected}
        self._suspected = set(found)
        new = [in_parameters(finding) for key, finding in self._faults.items() if key not in before]
        return new, [
            f"no longer so: {finding.what}"
            for key, finding in before.items()
            if key not in self._faults
        ]

    def grave(self):
        """What speaks against calibrating with these streams, the gravest first, each in one line."""
        return tuple(in_parameters(finding) for finding in self._faults.values())

    def report(self, steady_s):
        """Level, message and values."""
        if self._agreement is None:
            turned = f"{np.degrees(MIN_ROTATION_RAD):.0f} deg"
            return (
                WARN,
                f"not checked yet: that takes {MIN_DURATION_S:g} s of driving with turns of {turned}",
                {"checked": "not yet"},
            )
        correlation, grave = self._agreement.correlation, self.grave()
        values = {
            "checked": f"{steady_s - self._checked_at_s:.0f} s ago, again after {CHECK_PERIOD_S:g} s at the earliest",
            "turning of both streams correlates by": f"{correlation.correlation:.3f}",
            **{
                f"{finding.severity.value} {finding.code} ({finding.stream})": in_parameters(
                    finding
                )
                for finding in self._agreement.findings
            },
        }
        return (
            (WARN, "; ".join(grave), values)
            if grave
            else (OK, "both streams can be of one rigid body", values)
        )


def _is_sure(finding):
    return finding.severity is Severity.ERROR and finding.confidence is not Confidence.POSSIBLE


def in_parameters(finding):
    """A finding in one line, with what helps as parameters."""
    return f"{finding}" + "".join(f": set {name} to {value}" for name, value in finding.options)


def offset_between(parent, child):
    """Clock offset seen between two inputs, in s to be added to the child's stamps; None where one
    is silent.
    """
    if parent.delay_s is None or child.delay_s is None:
        return None
    return child.delay_s - parent.delay_s


def with_clock_offset(level, text, values, seen_s, used_s):
    """An input's report with the clock offset seen, and a warning where it is far from the one in
    use.
    """
    values = values | {
        "clock offset to the other input seen (s)": "-" if seen_s is None else f"{seen_s:.4f}",
        "time offset used (s)": used_s if isinstance(used_s, str) else f"{used_s:.6f}",
    }
    if (
        level == OK
        and seen_s is not None
        and not isinstance(used_s, str)
        and abs(seen_s - used_s) > SUSPICIOUS_OFFSET_S
    ):
        seen = f"the stamps of the two inputs are {seen_s:.3f} s apart where time_offset is {used_s:.3f}"
        level, text = WARN, f"{text}; {seen}: if their clocks differ, set time_offset"
    return level, text, values


@dataclass(frozen=True)
class SolverState:
    """What the node knows about its solves; times in s of the steady clock."""

    enabled: bool
    solving: bool
    solves: int
    seconds: float
    failure: str
    failed_unexpectedly: bool
    seen: Excitation | None
    calibration: Calibration | None
    solved_at_s: float | None
    stale_after_s: float
    faults: tuple = ()


def calibration_report(state, steady_s, clock_ns):
    """Level, message and values of the calibration itself."""
    calibration, seen = state.calibration, state.seen
    age_s = None if state.solved_at_s is None else steady_s - state.solved_at_s
    values = {
        "accepting poses": _yes(state.enabled),
        "solver": "solving" if state.solving else "waiting",
        "solves": state.solves,
        "last solve took (s)": f"{state.seconds:.3f}",
        "last failure": state.failure or "none",
    }
    missing = ""
    if seen is not None:
        missing = what_is_missing(seen, calibration) if seen.n_poses else ""
        values |= {
            "synchronised poses": seen.n_poses,
            "distance (m)": f"{seen.distance:.1f}",
            **{
                f"turned about {axis} (deg)": f"{angle:.1f}"
                for axis, angle in zip("xyz", np.degrees(seen.rotation), strict=True)
            },
            **{
                f"an offset of 1 m in {axis} shows as (m)": f"{gain:.3f}"
                for axis, gain in zip("xyz", seen.gain, strict=True)
            },
        }
    values["missing"] = missing or ("nothing" if calibration else "-")
    if calibration is not None:
        values |= _result_values(calibration, age_s, clock_ns)
    return *_judge(state, age_s, missing), values


def _result_values(calibration, age_s, clock_ns):
    newest_s = (clock_ns - calibration.stamp_ns) * 1e-9
    x, y, z = calibration.T_parent_child[:3, 3]
    return {
        "status": calibration.status.value,
        "extrinsic": f"{calibration.child_frame} in {calibration.parent_frame}: ({x:.4f}, {y:.4f}, {z:.4f}) m",
        "method": f"{calibration.method} {calibration.reference} {calibration.backend}",
        "pairs": calibration.n_pairs,
        "inliers (%)": f"{100 * calibration.n_inliers / max(calibration.n_pairs, 1):.1f}",
        "age of the result (s)": f"{age_s:.1f}",
        "age of its newest pose (s)": f"{newest_s:.1f}"
        if clock_ns
        else "the clock does not run: nothing on /clock",
        "time offset used (s)": f"{calibration.time_offset_s:.6f} +/- {calibration.time_offset_sigma_s:.6f}",
        "scale used": f"{calibration.scale:.6f} +/- {calibration.scale_sigma:.6f}",
        **{f"sigma {dof.name} {_unit(dof)}": _sigma(dof) for dof in calibration.observability},
        **{f"verdict {dof.name}": dof.verdict.value for dof in calibration.observability},
        "warnings": "; ".join(calibration.warnings) or "none",
    }


def _judge(state, age_s, missing):
    calibration = state.calibration
    if state.failed_unexpectedly:
        return ERROR, state.failure
    if not state.enabled:
        return WARN, "not accepting poses: call ~/set_enabled to go on"
    if state.faults:
        return WARN, f"do not use the result: {state.faults[0]}"
    if calibration is None:
        return WARN, "; ".join(filter(None, (state.failure, missing))) or "no result yet"
    if calibration.status is SolveStatus.NOT_CONVERGED:
        return WARN, "the solver did not converge"
    if calibration.status is not SolveStatus.OK:
        return WARN, missing or "; ".join(calibration.warnings) or calibration.status.value
    if age_s > state.stale_after_s:
        return WARN, f"the result is {age_s:.0f} s old" + (
            f": {state.failure}" if state.failure else ""
        )
    if missing:
        return WARN, missing
    weakest = max(
        (dof.sigma for dof in calibration.observability if dof.name in "xyz"), default=0.0
    )
    return (
        OK,
        f"all is observable; translation known to {weakest * 1000:.1f} mm or better (one sigma)",
    )


def status(name, level, text, values):
    """A DiagnosticStatus."""
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return DiagnosticStatus(
        level=level, name=f"calibrator: {name}", message=text, hardware_id=HARDWARE_ID, values=pairs
    )


def _unit(dof):
    return "(mm)" if dof.name in "xyz" else "(deg)"


def _sigma(dof):
    if dof.verdict is DofVerdict.UNOBSERVABLE or not np.isfinite(dof.sigma):
        return "unknown"
    return f"{dof.sigma * 1000:.2f}" if dof.name in "xyz" else f"{np.degrees(dof.sigma):.4f}"


def _yes(condition):
    return "yes" if condition else "no"
