"""Short sentences for a person at the machine, who can read one aloud in a breath.

Longer texts, with values and parameters, are in the log and on the page below the headline.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from hand_eye_calib.core.base.spelling import Interface
from hand_eye_calib.core.base.text import axes_in_words, capital, listing
from hand_eye_calib.core.checks.findings import Finding
from hand_eye_calib.core.results.records import AXES
from hand_eye_calib.core.results.verdict import Reason

# Most words of a sentence that a person reads aloud in one breath.
MAX_WORDS = 15

START_SOURCE = "Start the source of the poses, or correct the topic's name."
START_SOURCE_AGAIN = "Start the source of the poses again."
CHECK_SOURCE = "Check that the source of the topic sends poses."
RESET_AFTER_REPAIR = "Correct the source, then reset."
_TAPE = "Compare with a tape measure."


class Brief(NamedTuple):
    """A problem in a few words, without a full stop, and the next step as a sentence."""

    problem: str
    step: str


# Problem and next step of each rule of the verdict. ``{axes}`` are the axes of the reason.
_OF_RULES: Mapping[str, Brief] = {
    "prior": Brief(
        "the value typed in for {axes} contradicts the motion",
        "Correct or remove the value, then reset.",
    ),
    "error_finding": Brief("a stream has a fault", "Read the reasons below."),
    "not_converged": Brief(
        "the solver did not converge", "Record again, with more turns."
    ),
    "nothing_known": Brief(
        "this motion determines no axis", "Record again, with more turns."
    ),
    "recordings_differ": Brief(
        "the recordings differ", "Read the reasons below."
    ),
    "unobservable": Brief("{axes} not determined", "Measure what is missing."),
    "warning_finding": Brief(
        "a stream may have a fault", "Read the reasons below."
    ),
    "ground": Brief("the ground contradicts {axes}", _TAPE),
    "recordings": Brief("the recordings scatter", "Read the reasons below."),
    "halves": Brief(
        "both halves of the session disagree on {axes}",
        "Check that both mounts are tight.",
    ),
    "methods": Brief("a second method disagrees on {axes}", _TAPE),
    "unconfirmed": Brief("only one method determines {axes}", _TAPE),
    "undetectable": Brief("an error of {axes} might have stayed hidden", _TAPE),
    "outliers": Brief("many poses do not fit", "Check both sources."),
    "target": Brief("{axes} not within the target", "Drive longer."),
    "floor": Brief("constant errors may exceed the target of {axes}", _TAPE),
}

# Next steps after errors in the streams, by the codes of the findings.
_OF_FINDINGS = {
    "mount_moved": "Tighten the mount, then reset.",
    "interleaved": "Stop one of the two sources, then reset.",
}


def in_one_breath(text: str, otherwise: str) -> str:
    """Return a text that a person can read aloud in a breath; otherwise the other text."""
    return text if len(text.split()) <= MAX_WORDS else otherwise


def of_reason(reason: Reason) -> Brief:
    """Return problem and next step of a reason for a verdict."""
    brief = _OF_RULES[reason.rule]
    if reason.is_finding:
        step = capital(
            in_one_breath(reason.advice_on(Interface.NODE), brief.step)
        )
        return Brief(
            in_one_breath(reason.sentence, brief.problem),
            f"{step.rstrip('.')}.",
        )
    has_all = len(reason.axes) in (0, len(AXES))
    axes = "the axes" if has_all else axes_in_words(reason.axes)
    problem = brief.problem.format(axes=axes)
    return Brief(
        in_one_breath(problem, brief.problem.format(axes="some axes")),
        brief.step,
    )


def step_after(finding: Finding) -> str:
    """Return the next step after a finding in the streams of a session.

    The session keeps the faulty poses. Therefore a repair of the source also needs a reset.
    """
    if finding.options:
        settings = [
            f"{name} to {value}" for name, value in finding.options.items()
        ]
        return in_one_breath(
            f"Set {', '.join(settings)}.", "Set the parameters listed below."
        )
    if finding.makes_unusable:
        return _OF_FINDINGS.get(finding.code, RESET_AFTER_REPAIR)
    advice = in_one_breath(
        finding.advice_on(Interface.NODE), "read the advice below"
    )
    return f"{capital(advice).rstrip('.')}."


def publishers_in_words(names: Iterable[str]) -> str:
    """Return number and nodes of a topic's publishers. Each node is named once."""
    counts = Counter(names)
    number = counts.total()
    if len(counts) == 1:
        return f"{number} publishers, all named {next(iter(counts))}"
    return f"{number} publishers: {listing(sorted(counts))}"
