"""The stream checks beside a calibration, and as a table."""

import dataclasses
import textwrap

from hand_eye_calib.checks.findings import Severity
from hand_eye_calib.cli.options import flag

_MARKS = {Severity.ERROR: "ERROR", Severity.WARNING: "WARNING", Severity.NOTE: "note"}
_WIDTH = 100


def with_findings(calibration, snapshot):
    """A calibration whose warnings hold what is wrong with its streams, and all findings as plain
    values.

    Parameters
    ----------
    calibration : Calibration
    snapshot : Snapshot
        The poses it comes from.
    """
    findings = snapshot.check(calibration).findings
    grave = [str(finding) for finding in findings if finding.severity is not Severity.NOTE]
    calibration = dataclasses.replace(calibration, warnings=(*calibration.warnings, *grave))
    return calibration, [finding.to_dict() for finding in findings]


def table(findings):
    """Findings as text for a terminal, the gravest first."""
    if not findings:
        return "No findings: nothing speaks against calibrating with these streams."
    lines = []
    for finding in findings:
        head = f"{_MARKS[finding.severity]:<8} {finding.code:<17} {finding.stream:<7} {finding.confidence.value:<9} "
        body = textwrap.wrap(finding.what, _WIDTH - 4) + textwrap.wrap(
            f"-> {finding.advice}{_typed(finding)}", _WIDTH - 4
        )
        lines += [head.rstrip(), *(f"    {line}" for line in body)]
    return "\n".join(lines)


def _typed(finding):
    """The options as they are typed."""
    typed = [f"--{flag(name)} {value}" for name, value in finding.options]
    return f": {' '.join(typed)}" if typed else ""
