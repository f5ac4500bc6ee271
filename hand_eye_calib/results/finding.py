"""Findings of the stream checks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum


class Severity(str, Enum):
    """How much a finding matters.

    With an error, a result from these streams as they are is unusable. With a warning it may be
    used with care. A note is good to know.
    """

    NOTE = "note"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Something about the streams that a person should know.

    Attributes
    ----------
    code : str
        Short name, stable over versions.
    stream : str
        "parent", "child" or "both".
    severity : Severity
    what : str
        What was found, with its values.
    advice : str
        What to do.
    cause : str
        Usual cause, if ``what`` does not name it.
    evidence : mapping of str to float
        The numbers in ``what``, by name.
    options : mapping
        Options that do it, by their names in :mod:`hand_eye_calib.config`; empty if none can.
    """

    code: str
    severity: Severity
    what: str
    advice: str
    stream: str = "both"
    cause: str = ""
    evidence: Mapping[str, float] = field(default_factory=dict)
    options: Mapping[str, float | str] = field(default_factory=dict)

    @property
    def makes_unusable(self) -> bool:
        """Whether a result from these streams as they are is unusable."""
        return self.severity is Severity.ERROR

    def __str__(self) -> str:
        cause = f" ({self.cause})" if self.cause else ""
        return f"{self.what.rstrip('.')}{cause}; {self.advice}"


def gravest_first(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """The findings by severity, errors first, otherwise in their order."""
    order = list(Severity)
    return tuple(sorted(findings, key=lambda finding: -order.index(finding.severity)))
