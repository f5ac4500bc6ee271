"""When the streams are checked, and what the last check found."""

import numpy as np

from hand_eye_calib.checks.check import MIN_DURATION_S, MIN_ROTATION_RAD, CheckResult
from hand_eye_calib.checks.findings import Finding, Severity
from hand_eye_calib.live.state import ChecksState, Level

# The streams are checked at most this often (s), which costs a second or two each time.
CHECK_PERIOD_S = 30.0


class StreamChecks:
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
        self._suspected: set[tuple[str, str]] = set()
        self._faults: dict[tuple[str, str], Finding] = {}
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
        """Take what a check found (None: the poses did not suffice).

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
        self._faults = {
            key: f for key, f in found.items() if f.makes_unusable or key in self._suspected
        }
        self._suspected = set(found)
        new = [in_parameters(finding) for key, finding in self._faults.items() if key not in before]
        ended = [finding for key, finding in before.items() if key not in self._faults]
        return new, [f"no longer found: {finding.what}" for finding in ended]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What speaks against calibrating with these streams, the gravest first."""
        return tuple(self._faults.values())

    def faults(self) -> tuple[str, ...]:
        """The same in a line each."""
        return tuple(map(in_parameters, self.findings))

    def state(self, steady_s: float) -> ChecksState:
        """Findings of the last check."""
        result, faults = self._result, self.faults()
        if result is None:
            text = (
                f"not checked yet: that takes {MIN_DURATION_S:g} s of motion with rotations of "
                f"{np.degrees(MIN_ROTATION_RAD):.0f} deg"
            )
            return ChecksState(level=Level.WARN, text=text)
        return ChecksState(
            level=Level.WARN if faults else Level.OK,
            text="; ".join(faults) or "both streams can be of one rigid body",
            age_s=steady_s - self._checked_at_s,
            findings=tuple(
                f"{each.severity.value}: {in_parameters(each)}" for each in result.findings
            ),
        )


def in_parameters(finding: Finding) -> str:
    """A finding in one line, with what helps as parameters."""
    return f"{finding}" + "".join(
        f": set {name} to {value}" for name, value in finding.options.items()
    )
