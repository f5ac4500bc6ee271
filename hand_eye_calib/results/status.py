"""How a solve ended, and how well each degree of freedom is known."""

from dataclasses import dataclass
from enum import Enum

TRANSLATIONS, ROTATIONS = ("x", "y", "z"), ("roll", "pitch", "yaw")
AXES = (*TRANSLATIONS, *ROTATIONS)


class SolveStatus(str, Enum):
    """How a solve ended. Only an OK result may be used as it is.

    Of an UNOBSERVABLE one the other directions may be used. NOT_CONVERGED and CONTRADICTED (a prior
    contradicts the motion) are failures.

    Examples
    --------
    >>> result.status is hec.SolveStatus.OK
    True
    """

    OK = "ok"
    UNOBSERVABLE = "unobservable"
    NOT_CONVERGED = "not_converged"
    CONTRADICTED = "contradicted"

    @property
    def failure(self) -> str:
        """Why nothing of a result may be used; empty unless the solve failed."""
        if self is SolveStatus.NOT_CONVERGED:
            return "the solver did not converge"
        return "a prior contradicts the motion" if self is SolveStatus.CONTRADICTED else ""


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
