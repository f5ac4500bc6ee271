"""A finding: something about the input that a person should know."""

from dataclasses import dataclass
from enum import Enum


class Severity(str, Enum):
    """How much a finding matters: good to know; will spoil the result; makes a result impossible."""

    NOTE = "note"
    WARNING = "warning"
    ERROR = "error"


class Confidence(str, Enum):
    """How sure a finding is."""

    CERTAIN = "certain"
    LIKELY = "likely"
    POSSIBLE = "possible"


@dataclass(frozen=True)
class Finding:
    """Something about the input that a person should know.

    Attributes
    ----------
    code : str
        Short name, stable over versions.
    stream : str
        "parent", "child" or "both".
    severity : Severity
    confidence : Confidence
    what : str
        What was found, with numbers.
    advice : str
        What to do.
    options : tuple of (str, value)
        Options that do it, by their public names; empty where none can.
    """

    code: str
    stream: str
    severity: Severity
    confidence: Confidence
    what: str
    advice: str
    options: tuple = ()

    def to_dict(self):
        """Everything as plain values."""
        return {
            "code": self.code,
            "stream": self.stream,
            "severity": self.severity.value,
            "confidence": self.confidence.value,
            "what": self.what,
            "advice": self.advice,
            "options": dict(self.options),
        }

    def __str__(self):
        return f"{self.what}; {self.advice}"
