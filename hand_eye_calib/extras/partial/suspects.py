"""Possible faults that a regression estimates, of which the most significant is reported."""

from collections.abc import Sequence
from typing import NamedTuple

from hand_eye_calib.core.checks.findings import Finding


class Suspect(NamedTuple):
    """A possible fault.

    Attributes
    ----------
    sigmas : float
        Size of the fault in standard deviations.
    issue : Finding or None
        The finding if the fault is significant.
    """

    sigmas: float
    issue: Finding | None


def most_significant(suspects: Sequence[Suspect]) -> list[Finding]:
    """Return the finding of the most significant fault, as a list that may be empty."""
    ranked = sorted(suspects, key=lambda suspect: suspect.sigmas, reverse=True)
    return [suspect.issue for suspect in ranked if suspect.issue][:1]
