"""The findings of the stream checks: beside a calibration, and as a table."""

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from hand_eye_calib.calibration import Calibration, Verdict
from hand_eye_calib.checks.findings import Finding, Severity
from hand_eye_calib.cli.spelling import as_typed, flag
from hand_eye_calib.engine.checked import checked
from hand_eye_calib.errors import printable

if TYPE_CHECKING:
    from hand_eye_calib.engine.snapshot import Snapshot

_MARKS = {Severity.ERROR: "ERROR", Severity.WARNING: "WARNING", Severity.NOTE: "note"}
_WIDTH = 100


def with_findings(
    calibration: Calibration, snapshot: "Snapshot"
) -> tuple[Calibration, list[dict[str, Any]]]:
    """A calibration with what the stream checks found, which is also returned as plain values.

    Parameters
    ----------
    calibration : Calibration
    snapshot : Snapshot
        The poses it comes from.
    """
    calibration, _ = checked(calibration, snapshot)
    return calibration, [dict(finding) for finding in calibration.findings]


def verdict(findings: Sequence[Finding]) -> str:
    """What the findings mean for a calibration with these streams, in one sentence."""
    serious = [finding for finding in findings if finding.severity is not Severity.NOTE]
    if not serious:
        return f"{Verdict.USE.value}: nothing speaks against calibrating with these streams."
    errors = [finding for finding in serious if finding.makes_unusable]
    word = (Verdict.DO_NOT_USE if errors else Verdict.USE_WITH_CARE).value
    if all(finding.options for finding in serious):
        options = "".join(_typed_options(finding) for finding in serious).replace(":", "")
        return f"{word}: not as they are; calibrate with{options}."
    codes = ", ".join(finding.code for finding in errors or serious if not finding.options)
    if not errors:
        return f"{word}: look at the findings first ({codes})."
    return f"{word}: no result from these streams is right ({codes or errors[0].code})."


def table(findings: Sequence[Finding]) -> str:
    """Findings as text for a terminal, in their order."""
    if not findings:
        return "No findings."
    lines = []
    for finding in findings:
        head = f"{_MARKS[finding.severity]:<8} {finding.code:<17} {finding.stream:<7} "
        advice = f"-> {finding.advice}{_typed_options(finding)}"
        body = [*_wrapped(finding.what), *_wrapped(advice)]
        lines += [head + finding.confidence.value, *(f"    {line}" for line in body)]
    return "\n".join(lines)


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(printable(as_typed(text)), _WIDTH - 4, break_on_hyphens=False)


def _typed_options(finding: Finding) -> str:
    """The options that help, as they are typed."""
    typed = [f"--{flag(name)} {value}" for name, value in finding.options]
    return f": {' '.join(typed)}" if typed else ""
