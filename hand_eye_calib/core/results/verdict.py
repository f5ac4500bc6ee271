"""Verdict on a result: reasons from the rules, and headline."""

from collections.abc import Sequence
from functools import cached_property

from hand_eye_calib.core.base.text import (
    counted,
    listing,
)
from hand_eye_calib.core.results.axes import (
    axes_within_reach,
    what_is_known,
)
from hand_eye_calib.core.results.parts import part
from hand_eye_calib.core.results.reasons import Reason, Verdict
from hand_eye_calib.core.results.records import (
    Finding,
    Severity,
)
from hand_eye_calib.core.results.result import Result
from hand_eye_calib.core.results.rules import RULES

# Rules that report a limit of the recording. All other rules report a suspicion.
_KINDS = dict.fromkeys(
    ("nothing_known", "unobservable", "unconfirmed", "target", "floor"),
    "physics",
)
_NO_FAULT = "a limit of the recording, no fault was found"


class Judged(Result):
    """A result with its verdict."""

    @cached_property
    def reasons(self) -> tuple[Reason, ...]:
        """Reasons against using the result without further steps, the gravest first.

        The tuple is empty if the result may be used. The rules are
        :data:`hand_eye_calib.core.results.rules.RULES`.
        """
        reasons = []
        for rule in RULES:
            kind = _KINDS.get(rule.name, "suspicion")
            for ground in rule.find(self):
                reasons.append(Reason(rule.name, rule.verdict, *ground, kind))
        return tuple(reasons)

    @property
    def verdict(self) -> Verdict:
        """Whether the result may be used: ``Verdict.USE``, ``USE_WITH_CARE`` or ``DO_NOT_USE``."""
        return self.reasons[0].verdict if self.reasons else Verdict.USE

    @property
    def has_failed(self) -> bool:
        """Whether the solve failed without a finding that explains the failure."""
        return bool(self.reasons) and self.reasons[0].rule in (
            "prior",
            "not_converged",
        )

    @property
    def headline(self) -> str:
        """Verdict with its gravest reason, or with the accuracy, in one line."""
        return f"{self.verdict.value}: {self.sentence}"

    @property
    def sentence(self) -> str:
        """The headline without the verdict."""
        notes = self._notes()
        gravest = shown(self.reasons)
        if not gravest:
            text = what_is_known(self)
        elif gravest[0].rule == "unobservable":
            text = self._usable_axes(gravest)
        else:
            text = self._gravest_reason(gravest)
            if self.verdict is Verdict.DO_NOT_USE:
                notes = []
        return "; ".join([text, *notes])

    def _usable_axes(self, gravest: Sequence[Reason]) -> str:
        """Return the axes that may be used, if the gravest reason is that some axes are hidden."""
        first, *others = gravest
        hidden = listing(first.axes)
        them = hidden if len(first.axes) == 1 else "them"
        text = f"all but {hidden}; measure {them} by hand"
        if self.out_of_reach:
            # Axes out of reach are not hidden, but they are not known either.
            axes = axes_within_reach(self)
            known = listing([axis.name for axis in axes if not axis.is_hidden])
            text = f"{known} only; measure {them} by hand"
        if others:
            text += f"; {others[0].sentence}"
        return text

    def _gravest_reason(self, gravest: Sequence[Reason]) -> str:
        """Return the first reason, the number of others, and whether a fault was found."""
        first, *others = gravest
        text = first.sentence
        if others:
            text += f" (and {counted(len(others), 'more reason')})"
        is_limit = all(reason.kind == "physics" for reason in self.reasons)
        # A warning may be about a fault that was repaired, or about a possible fault.
        if is_limit and not self.warnings:
            text += f"; {_NO_FAULT}"
        return text

    @property
    def reasons_in_headline(self) -> tuple[Reason, ...]:
        """Reasons whose sentences are in the headline."""
        gravest = shown(self.reasons)
        if gravest and gravest[0].rule == "unobservable":
            # The headline already has the first reason, in other words.
            return gravest[1:2]
        return gravest[:1]

    def _notes(self) -> list[str]:
        """Notes for the headline, from parts and from findings that do not lower the verdict."""
        notes = [
            part(name).headline(value) for name, value in self.parts.items()
        ]
        notes += [
            finding.what for finding in self.findings if _is_notable(finding)
        ]
        return [note for note in notes if note]


def _is_notable(finding: Finding) -> bool:
    """Return whether a note belongs in the headline, although it does not lower the verdict.

    Such notes change the meaning of the numbers.
    """
    return (
        finding.code in ("model_scale", "outliers")
        and finding.severity is Severity.NOTE
    )


def shown(reasons: Sequence[Reason]) -> tuple[Reason, ...]:
    """Return the reasons that are printed: those with the gravest verdict.

    Other reasons may be consequences of the printed reasons.
    """
    return tuple(
        reason for reason in reasons if reason.verdict is reasons[0].verdict
    )
