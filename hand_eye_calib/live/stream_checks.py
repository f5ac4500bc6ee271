"""What the last check of the streams found."""

import time

import numpy as np

from hand_eye_calib.checks.check import MIN_DURATION_S, MIN_ROTATION_RAD, CheckResult
from hand_eye_calib.checks.findings import Finding, Severity
from hand_eye_calib.live.log import NodeLog
from hand_eye_calib.live.state import ChecksState, Level


class StreamChecks:
    """Keeps the findings of stream checks.

    Errors count at once; warnings, and what is merely possible, only if two checks in a row have
    them: over a short recording, odometry may well be off by some per cent.
    """

    def __init__(self, log: NodeLog) -> None:
        self._log = log
        self.restart()

    def restart(self) -> None:
        """Begin a new session: nothing is known yet."""
        self._result: CheckResult | None = None
        self._checked_at_s = 0.0
        self._suspected: set[tuple[str, str]] = set()
        self._faults: dict[tuple[str, str], Finding] = {}

    def take(self, result: CheckResult) -> None:
        """Take what a check found; what is new, and what no longer holds, is logged."""
        before, self._result, self._checked_at_s = self._faults, result, time.monotonic()
        found = {(f.code, f.stream): f for f in result.findings if f.severity is not Severity.NOTE}
        self._faults = {
            key: f for key, f in found.items() if f.makes_unusable or key in self._suspected
        }
        self._suspected = set(found)
        for key in self._faults.keys() - before.keys():
            self._log.warning(_in_parameters(self._faults[key]))
        for key in before.keys() - self._faults.keys():
            self._log.info(f"no longer found: {before[key].what}")

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What speaks against calibrating with these streams, the gravest first."""
        return tuple(self._faults.values())

    def faults(self) -> tuple[str, ...]:
        """The same in a line each."""
        return tuple(map(_in_parameters, self.findings))

    def state(self) -> ChecksState:
        """Findings of the last check."""
        if self._result is None:
            text = (
                f"not checked yet: that takes {MIN_DURATION_S:g} s of motion with rotations of "
                f"{np.degrees(MIN_ROTATION_RAD):.0f} deg"
            )
            return ChecksState(level=Level.WARN, text=text)
        found = self._result.findings
        return ChecksState(
            level=Level.WARN if self._faults else Level.OK,
            text="; ".join(self.faults()) or "both streams can be of one rigid body",
            age_s=time.monotonic() - self._checked_at_s,
            findings=tuple(f"{each.severity.value}: {_in_parameters(each)}" for each in found),
        )


def _in_parameters(finding: Finding) -> str:
    """A finding in one line, with what helps as parameters."""
    helps = (f": set {name} to {value}" for name, value in finding.options.items())
    return f"{finding}{''.join(helps)}"
