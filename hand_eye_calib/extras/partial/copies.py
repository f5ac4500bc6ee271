"""Findings about a stream that was computed from the other one."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from hand_eye_calib.core.checks.findings import Finding, Severity, finding

#: Residuals below this share of the median motion are those of a copy, in slow streams.
COPIED_SHARE = 0.01


def copied(evidence: str, **residual: Any) -> list[Finding]:
    """Return the finding that one stream was computed from the other.

    ``residual`` is the remaining difference of both streams, with its unit in its name.
    """
    return [
        finding(
            "not_independent",
            "both",
            Severity.ERROR,
            evidence=evidence,
            **residual,
        )
    ]


def as_errors(findings: Sequence[Finding]) -> list[Finding]:
    """Return the same findings as errors."""
    return [replace(item, severity=Severity.ERROR) for item in findings]
