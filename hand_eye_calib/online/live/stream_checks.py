"""Findings of the stream checks of a live session."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.checks.check import (
    MIN_DURATION_S,
    MIN_ROTATION_RAD,
    CheckResult,
)
from hand_eye_calib.core.checks.findings import (
    Finding,
    Severity,
    answered,
    gravest_first,
)
from hand_eye_calib.core.engine.attempts import with_open_errors
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.online.live.brief import step_after
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.live.state import ChecksState, Level

#: Codes of findings about the received poses of one stream. Pairing interpolates the poses, so a
#: check of the pairs cannot detect these faults.
RAW_POSE_CODES = frozenset(
    {"leap", "interleaved", "frozen", "coarse_positions"}
)


class StreamChecks:
    """Findings of the stream checks of a session.

    An error is reported at once. Any other finding is reported after two checks in a row, because
    odometry may be wrong by some per cent over a short recording. An error in the received poses is
    reported until the session ends, because the session keeps these poses.
    """

    def __init__(self, log: NodeLog) -> None:
        self._log = log
        self.restart()

    def restart(self) -> None:
        """Begin a new session without findings."""
        self._result: CheckResult | None = None
        self._checked_at_s = 0.0
        # Codes and streams of the findings of the last check, except notes.
        self._of_last_check: set[tuple[str, str]] = set()
        # Findings that the session reports, by code and stream.
        self._faults: dict[tuple[str, str], Finding] = {}
        # Reported errors in the received poses, by code and stream.
        self._pose_errors: dict[tuple[str, str], Finding] = {}

    def follow(self, config: CalibratorConfig) -> None:
        """Drop errors in the received poses that the new options repair."""
        errors = {}
        for key, finding in self._pose_errors.items():
            (graded,) = answered([finding], config)
            if graded.makes_unusable:
                errors[key] = finding
        self._pose_errors = errors

    def take(self, result: CheckResult) -> None:
        """Store the result of a check, and log findings that appear or disappear.

        The class documents when a finding is reported.
        """
        before = self._faults
        self._result = result
        self._checked_at_s = time.monotonic()
        of_this_check = {
            (finding.code, finding.stream): finding
            for finding in result.findings
            if finding.severity is not Severity.NOTE
        }
        self._faults = {
            key: finding
            for key, finding in of_this_check.items()
            if finding.makes_unusable or key in self._of_last_check
        }
        self._of_last_check = set(of_this_check)
        for key, finding in self._faults.items():
            if finding.makes_unusable and finding.code in RAW_POSE_CODES:
                self._pose_errors[key] = finding
        # Values of this check replace older values.
        self._faults = {**self._pose_errors, **self._faults}
        for key in self._faults.keys() - before.keys():
            self._log.warning(_in_parameters(self._faults[key]))
        for key in before.keys() - self._faults.keys():
            self._log.info(f"no longer found: {before[key].what}")

    def with_open_errors(self, calibration: Calibration) -> Calibration:
        """Return a calibration whose allowance includes the open covariance of the last check."""
        if self._result is None:
            return calibration
        return with_open_errors(calibration, self._result)

    def with_findings(self, calibration: Calibration) -> Calibration:
        """Return a calibration with the findings that the session reports.

        A calibration from positions, rotations or rates has findings of its own. Only findings
        about the received poses are added to these.
        """
        findings = self.findings
        if calibration.measured != "poses":
            raw = [
                finding
                for finding in findings
                if finding.code in RAW_POSE_CODES
            ]
            findings = merged(calibration.findings, raw)
        if calibration.findings == findings:
            return calibration
        return replace(calibration, findings=findings)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings that the session reports, the gravest first."""
        return tuple(self._faults.values())

    def faults(self) -> tuple[str, ...]:
        """Return a line for each reported finding, with the parameters to set."""
        return tuple(map(_in_parameters, self.findings))

    def state(self) -> ChecksState:
        """Return the diagnostics of the last check, with earlier errors in the received poses."""
        if self._result is None:
            text = (
                f"not checked yet: that takes {MIN_DURATION_S:g} s of motion with rotations of "
                f"{np.degrees(MIN_ROTATION_RAD):.0f} deg"
            )
            return ChecksState(level=Level.WARN, text=text)
        findings = merged(self._result.findings, self._pose_errors.values())
        return ChecksState(
            level=Level.WARN if self._faults else Level.OK,
            text="; ".join(self.faults())
            or "both streams can be of one rigid body",
            age_s=time.monotonic() - self._checked_at_s,
            findings=tuple(
                f"{finding.severity.value}: {_in_parameters(finding)}"
                for finding in findings
            ),
            **_gravest_of(self.findings),
        )


def merged(
    newest: Sequence[Finding], earlier: Iterable[Finding]
) -> tuple[Finding, ...]:
    """Return the newest findings and all other earlier findings, the gravest first.

    An earlier finding is dropped if a new finding has the same code and stream.
    """
    keys = {(finding.code, finding.stream) for finding in newest}
    kept = [
        finding
        for finding in earlier
        if (finding.code, finding.stream) not in keys
    ]
    return gravest_first([*newest, *kept])


def _gravest_of(findings: Sequence[Finding]) -> dict[str, Any]:
    """Return the fields of a state that describe the gravest of the reported findings."""
    if not findings:
        return {}
    gravest = findings[0]
    return {
        "gravest": gravest.what,
        "step": step_after(gravest),
        "needs_reset": gravest.makes_unusable and not gravest.options,
    }


def _in_parameters(finding: Finding) -> str:
    """Return the text of a finding in one line, with the parameters to set."""
    remedies = (
        f": set {name} to {value}" for name, value in finding.options.items()
    )
    return f"{finding}{''.join(remedies)}"
