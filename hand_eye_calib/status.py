"""How a solve ended, and how well each degree of freedom is known."""

import math
from dataclasses import dataclass
from enum import Enum

TRANSLATIONS, ROTATIONS = ("x", "y", "z"), ("roll", "pitch", "yaw")

# Shorter lengths (m) are told in mm, longer ones in m.
_MM_BELOW, _M_FROM = 0.01, 1.0


class SolveStatus(str, Enum):
    """How a solve ended. Only an OK result may be used as it is.

    Of an UNOBSERVABLE one the other directions may be used. NOT_CONVERGED and CONTRADICTED (a prior
    contradicts the motion) are failures.
    """

    OK = "ok"
    UNOBSERVABLE = "unobservable"
    NOT_CONVERGED = "not_converged"
    CONTRADICTED = "contradicted"

    @property
    def failure(self) -> str:
        """Why nothing of a result may be used; empty unless the solve failed."""
        return _FAILURES.get(self, "")


_FAILURES = {
    SolveStatus.NOT_CONVERGED: "the solver did not converge",
    SolveStatus.CONTRADICTED: "a prior contradicts the motion",
}


class DofVerdict(str, Enum):
    """How well one degree of freedom is known; PRIOR if mostly or only from a prior."""

    OBSERVED = "observed"
    WEAK = "weak"
    UNOBSERVABLE = "unobservable"
    PRIOR = "prior"


@dataclass(frozen=True)
class DofObservability:
    """Observability of one degree of freedom of the child sensor's pose, along or about an axis of
    the parent sensor's frame.

    Attributes
    ----------
    name : str
        x, y, z (translation) or roll, pitch, yaw (rotation about x, y, z).
    verdict : DofVerdict
    sigma : float
        One standard deviation, in m or rad; ``inf`` if unobservable.
    """

    name: str
    verdict: DofVerdict
    sigma: float


def by_hand(axis: str) -> str:
    """What stands in files and commands for an axis that is not known; no parser takes it."""
    return f"MEASURE_{axis.upper()}_BY_HAND"


def amount(axis: str, value: float) -> str:
    """A length (m) or an angle (rad) in words with two digits; which of them, the axis says."""
    if axis in ROTATIONS:
        return f"{_two_digits(math.degrees(value))} deg"
    size = abs(value)
    if size < _MM_BELOW:
        return f"{_two_digits(1000 * value)} mm"
    return f"{_two_digits(value)} m" if size >= _M_FROM else f"{_two_digits(100 * value)} cm"


def _two_digits(value: float) -> str:
    if abs(value) < 1e-3:
        return "0" if value == 0 else "less than 0.001"
    return f"{value:.{max(1 - math.floor(math.log10(abs(value))), 0)}f}"


def listing(words: list[str] | tuple[str, ...]) -> str:
    """One, two and three."""
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))
