"""Findings about a stream that was computed from the other stream."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from hand_eye_calib.core.checks.findings import Finding, Severity, finding

#: A slow stream is a copy if its residuals are below this share of the median motion.
COPIED_SHARE = 0.01


def copied(evidence: str, **residual: Any) -> list[Finding]:
    """Return the finding that one stream was computed from the other.

    ``residual`` is the difference that remains between both streams. Its unit is in its name.
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
