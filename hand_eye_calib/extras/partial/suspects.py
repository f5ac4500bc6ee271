"""Possible faults that a regression estimates. The most significant fault is reported."""

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
        Finding; None if the fault is not significant.
    """

    sigmas: float
    issue: Finding | None


def most_significant(suspects: Sequence[Suspect]) -> list[Finding]:
    """Return a list with the finding of the most significant fault; empty if there is none."""
    ranked = sorted(suspects, key=lambda suspect: suspect.sigmas, reverse=True)
    return [suspect.issue for suspect in ranked if suspect.issue][:1]
