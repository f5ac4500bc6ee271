"""Reasons for a verdict, and the verdict itself."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

from hand_eye_calib.core.base.spelling import Interface, with_options


class Verdict(str, Enum):
    """Verdict on whether a result may be used.

    Examples
    --------
    >>> result.verdict is hec.Verdict.USE
    True
    """

    USE = "USE"
    USE_WITH_CARE = "USE WITH CARE"
    DO_NOT_USE = "DO NOT USE"


# Value of ``options`` if no option repairs the problem.
NO_OPTIONS: Mapping[str, float | str] = {}


@dataclass(frozen=True)
class Reason:
    """A reason why a result should not be used without further steps.

    Attributes
    ----------
    rule : str
        Name of the rule in :data:`~hand_eye_calib.core.results.rules.RULES`. It does not change
        between versions.
    verdict : Verdict
        Verdict on the result if there were no other reason.
    sentence : str
        The problem, with its values.
    advice : str
        What the user should do, with options by their public names.
    axes : tuple of str
        x, y, z, roll, pitch, yaw; empty if the reason concerns the whole result.
    options : mapping
        Options that repair the problem, by their public names.
    kind : {"physics", "suspicion"}
        "physics" for a limit of the motion, the recording or the sensors; "suspicion" for a
        possible fault.

    Examples
    --------
    >>> strict = hec.calibrate(parent, child, target_translation=1e-5, checks=False)
    >>> [reason.rule for reason in strict.reasons]
    ['target']
    """

    rule: str
    verdict: Verdict
    sentence: str
    advice: str
    axes: tuple[str, ...] = ()
    options: Mapping[str, float | str] = field(default_factory=dict)
    kind: str = "suspicion"

    @property
    def what_to_do(self) -> str:
        """Advice with options in the spelling of Python."""
        return self.advice_on(Interface.PYTHON)

    def advice_on(self, interface: Interface) -> str:
        """Return the advice with its options, in the spelling of an interface."""
        return with_options(self.advice, self.options, interface)

    @property
    def is_finding(self) -> bool:
        """Whether the reason is a finding of a stream check."""
        return self.rule in ("error_finding", "warning_finding")


class Ground(NamedTuple):
    """Result of a rule: a :class:`Reason` without the name of the rule and its verdict."""

    sentence: str
    advice: str
    axes: tuple[str, ...] = ()
    options: Mapping[str, float | str] = NO_OPTIONS
