"""When the node checks the streams, and what the last check found."""

import numpy as np

from hand_eye_calib.checks.check import MIN_DURATION_S, MIN_ROTATION_RAD, CheckResult
from hand_eye_calib.checks.findings import Confidence, Finding, Severity
from hand_eye_calib.ros.status import OK, WARN, Report

# The streams are checked at most this often (s), which costs a second or two each time.
CHECK_PERIOD_S = 30.0

_Key = tuple[str, str]


class CheckMonitor:
    """Schedules stream checks and keeps their findings.

    Errors count at once; warnings, and what is merely possible, only if two checks in a row have
    them: over a short recording, odometry may well be off by some per cent.

    Attributes
    ----------
    has_new_poses : bool
        Poses have come in since the last check was asked for.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Begin a new session: nothing is known yet."""
        self.has_new_poses = False
        self._result: CheckResult | None = None
        self._checked_at_s = 0.0
        self._suspected: set[_Key] = set()
        self._faults: dict[_Key, Finding] = {}
        self._due_at_s = -np.inf

    def hasten(self) -> None:
        """Make a check due at once: the options have changed."""
        self.has_new_poses, self._due_at_s = True, -np.inf

    def is_due(self, steady_s: float) -> bool:
        """Whether it is time for a check."""
        return self.has_new_poses and steady_s >= self._due_at_s

    def begin(self, steady_s: float) -> None:
        """Note that a check has been asked for."""
        self.has_new_poses, self._due_at_s = False, steady_s + CHECK_PERIOD_S

    def take(self, result: CheckResult | None, steady_s: float) -> tuple[list[str], list[str]]:
        """Take what a check found.

        Parameters
        ----------
        result : CheckResult or None
            None if the poses did not suffice.
        steady_s : float

        Returns
        -------
        new, gone : list of str
            Lines for the log: new findings, and those that no longer hold.
        """
        if result is None:
            self._due_at_s = -np.inf
            return [], []
        before, self._result, self._checked_at_s = self._faults, result, steady_s
        found = {(f.code, f.stream): f for f in result.findings if f.severity is not Severity.NOTE}
        self._faults = {key: f for key, f in found.items() if _is_sure(f) or key in self._suspected}
        self._suspected = set(found)
        new = [in_parameters(finding) for key, finding in self._faults.items() if key not in before]
        gone = [
            f"no longer found: {finding.what}"
            for key, finding in before.items()
            if key not in self._faults
        ]
        return new, gone

    def faults(self) -> tuple[str, ...]:
        """What speaks against calibrating with these streams, the gravest first, a line each."""
        return tuple(in_parameters(finding) for finding in self._faults.values())

    def findings(self) -> tuple[Finding, ...]:
        """The same findings: for a result and its verdict."""
        return tuple(self._faults.values())

    def report(self, steady_s: float) -> Report:
        """Findings of the last check."""
        if self._result is None:
            rotation = f"{np.degrees(MIN_ROTATION_RAD):.0f} deg"
            text = f"not checked yet: that takes {MIN_DURATION_S:g} s of motion"
            text += f" with rotations of {rotation}"
            return Report(WARN, text, {"checked": "not yet"})
        faults = self.faults()
        values = {
            "checked": f"{steady_s - self._checked_at_s:.0f} s ago",
            "checked again after (s)": f"{CHECK_PERIOD_S:g}",
            "correlation of the angular rates": f"{self._result.correlation.correlation:.3f}",
            **{
                f"{each.severity.value} {each.code} ({each.stream})": in_parameters(each)
                for each in self._result.findings
            },
        }
        if faults:
            return Report(WARN, "; ".join(faults), values)
        return Report(OK, "both streams can be of one rigid body", values)


def _is_sure(finding: Finding) -> bool:
    return finding.severity is Severity.ERROR and finding.confidence is not Confidence.POSSIBLE


def in_parameters(finding: Finding) -> str:
    """A finding in one line, with what helps as parameters."""
    return f"{finding}" + "".join(
        f": set {name} to {value}" for name, value in finding.options.items()
    )
