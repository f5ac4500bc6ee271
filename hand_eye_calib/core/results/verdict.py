"""The verdict on a result, and the rules that lead to it.

Each rule of :data:`RULES` looks at what is known of a result and gives reasons why it may not be
used as it is. The gravest reason decides. docs/verdict.md has the same table; a test compares them.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property, partial
from typing import NamedTuple, TypeAlias

from hand_eye_calib.core.base.config import METHODS
from hand_eye_calib.core.base.registry import EXTRA_RULES
from hand_eye_calib.core.base.text import amount, amount_beside, axes_in_words, listing
from hand_eye_calib.core.results.parts import part
from hand_eye_calib.core.results.records import (
    ROTATIONS,
    TRANSLATIONS,
    AxisScatter,
    DofVerdict,
    Finding,
    Severity,
    SolveStatus,
    has_error,
)
from hand_eye_calib.core.results.result import Result


class Verdict(str, Enum):
    """Whether a result may be used.

    Examples
    --------
    >>> result.verdict is hec.Verdict.USE
    True
    """

    USE = "USE"
    USE_WITH_CARE = "USE WITH CARE"
    DO_NOT_USE = "DO NOT USE"


@dataclass(frozen=True)
class Reason:
    """Why a result may not be used as it is.

    Attributes
    ----------
    rule : str
        Name of the rule in :data:`RULES`, stable over versions.
    verdict : Verdict
        What this reason alone leads to.
    sentence : str
        What was found, with its values.
    what_to_do : str
    axes : tuple of str
        x, y, z, roll, pitch, yaw; empty if it is about the whole result.
    options : mapping
        Options that repair it, by their public names.
    kind : {"physics", "suspicion"}
        A limit of the motion, the recording or the sensors; or a sign that something is wrong.

    Examples
    --------
    >>> strict = hec.calibrate(parent, child, target_translation=1e-5, checks=False)
    >>> [reason.rule for reason in strict.reasons]
    ['target']
    """

    rule: str
    verdict: Verdict
    sentence: str
    what_to_do: str
    axes: tuple[str, ...] = ()
    options: Mapping[str, float | str] = field(default_factory=dict)
    kind: str = "suspicion"

    @property
    def is_finding(self) -> bool:
        """Whether a stream check found it."""
        return self.rule in ("error_finding", "warning_finding")


_Found: TypeAlias = tuple[str, str, tuple[str, ...], Mapping[str, float | str]]


class Rule(NamedTuple):
    """A row of the table of rules: what its reasons lead to, the condition in words, and
    ``find(result)``, which gives sentence, what to do, axes and options of each reason.
    """

    name: str
    verdict: Verdict
    when: str
    find: "Callable[[Result], Iterator[_Found]]"


# Other answers contradict a result if they lie farther away than so many joint standard deviations
# and than this share of the target; other references that are about as certain also if they scatter
# by so many of its own standard deviations and so many targets: that they are uncertain themselves
# does not excuse a large scatter. However far, they never forbid a result: they know less of the
# noise than the method that gave it, and state no time-correlated errors.
CONTRADICTED_SIGMAS = 3.0
CONTRADICTED_SHARE = 0.25
CONTRADICTED_TARGETS = 2.0

# Smallest share of the motion pairs that are inliers in a recording whose noise is understood; of
# the poses, for a method that models the noise and need not reject what is merely noisy.
FEWEST_INLIERS = 0.7
FEWEST_OF_MODEL = 0.9

# Rules that state a limit of the recording; the others are signs that something is wrong.
_KINDS = dict.fromkeys(
    ("nothing_known", "unobservable", "unconfirmed", "target", "floor", "part_of_poses"),
    "physics",
)
_NO_FAULT = " (a limit of the recording; no fault was found)"

# Other answers, and what to do if they disagree.
_OTHERS = {
    "halves": (
        "the two halves of the recording",
        "check that both mounts are tight and record again; what the halves agree on holds",
    ),
    "methods": (
        "other methods and references",
        "use their scatter as the standard deviation, or record longer with more varied motion",
    ),
}


class Judged(Result):
    """A result that knows its verdict."""

    @cached_property
    def reasons(self) -> tuple[Reason, ...]:
        """Why the result may not be used as it is, the gravest first; empty if it may. The rules
        are :data:`hand_eye_calib.core.results.verdict.RULES`.
        """
        return tuple(
            Reason(rule.name, rule.verdict, *found, _KINDS.get(rule.name, "suspicion"))
            for rule in RULES
            for found in rule.find(self)
        )

    @property
    def verdict(self) -> Verdict:
        """Whether the result may be used: ``Verdict.USE``, ``USE_WITH_CARE`` or ``DO_NOT_USE``."""
        return self.reasons[0].verdict if self.reasons else Verdict.USE

    @property
    def has_failed(self) -> bool:
        """Whether the solve failed, and no finding about the poses explains that."""
        return bool(self.reasons) and self.reasons[0].rule in ("prior", "not_converged")

    @property
    def headline(self) -> str:
        """The verdict with its gravest reason, or with what is known, in one line."""
        decided = self.verdict.value
        gravest = shown(self.reasons)
        notes = [part(name).headline(value) for name, value in self.parts.items()]
        notes += [finding.what for finding in self.findings if _is_notable(finding)]
        notable = "".join(f"; {note}" for note in notes if note)
        if not gravest:
            return f"{decided}: {what_is_known(self)}{notable}"
        if gravest[0].rule == "unobservable":
            hidden = listing(gravest[0].axes)
            it = hidden if len(gravest[0].axes) == 1 else "them"
            also = "".join(f"; {each.sentence}" for each in gravest[1:2])
            return f"{decided}: all but {hidden}; measure {it} by hand{also}{notable}"
        if [reason.rule for reason in gravest] == ["part_of_poses"]:
            return f"{decided}: {what_is_known(self)}; {gravest[0].sentence}{notable}"
        note = "" if any(reason.kind == "suspicion" for reason in self.reasons) else _NO_FAULT
        more = len(gravest) - 1
        rest = f" (and {more} more reason{'s' * (more > 1)})" if more else ""
        if self.verdict is Verdict.DO_NOT_USE:
            notable = ""
        return f"{decided}: {gravest[0].sentence}{rest}{note}{notable}"


def _is_notable(finding: Finding) -> bool:
    """Whether a headline names a finding that is no reason: it changes what the numbers mean."""
    return finding.code in ("model_scale", "outliers") and finding.severity is Severity.NOTE


def shown(found: Sequence[Reason]) -> tuple[Reason, ...]:
    """The reasons that a person has to read: under DO NOT USE those that lead to it, because the
    others may be its consequences; otherwise all.
    """
    return tuple(each for each in found if each.verdict is found[0].verdict)


def what_is_known(result: Result) -> str:
    """Axes, and the largest standard deviations of a translation and of a rotation, with the floor,
    in words.
    """
    axes = _axes(result)
    texts = []
    for names in (TRANSLATIONS, ROTATIONS):
        if known := [axis for axis in axes if axis.name in names]:
            worst = max(known, key=lambda axis: axis.total)
            texts.append(amount(worst.name, worst.total))
    if not result.out_of_reach:
        known_to = " along and ".join(texts)
        return f"all six axes are known to {known_to} about them or better, one standard deviation"
    return (
        f"{listing([axis.name for axis in axes])} are known to {listing(texts)} or better, one "
        f"standard deviation; {listing(result.out_of_reach)} are out of reach of these streams"
    )


def target_of(axis: str, result: Result) -> float:
    """The standard deviation (m or rad) that is good enough for an axis."""
    of_kind = result.target_rotation if axis in ROTATIONS else result.target_translation
    return float(result.target_axes.get(axis, of_kind))


# ---------------------------------------------------------------- the rules


def _not_converged(result: Result) -> Iterator[_Found]:
    # Poses that contradict each other have no solution; an error finding names the cause.
    if result.status is SolveStatus.NOT_CONVERGED and not has_error(result.findings):
        yield "the solver did not converge", "record more varied motion", (), {}


def _contradicted(result: Result) -> Iterator[_Found]:
    if result.status is SolveStatus.CONTRADICTED:
        far = result.contradictions
        apart = [f"on {axis} is {far[axis]:.1f} standard deviations from" for axis in far]
        which = f"the prior {listing(apart)}" if apart else "a prior contradicts"
        names = listing([f"prior.{axis}" for axis in far]) or "the prior"
        advice = f"check value, unit and sign of {names}"
        yield f"{which} the estimate from the motion", advice, tuple(far), {}


def _nothing_known(result: Result) -> Iterator[_Found]:
    if result.reference == "stops" and has_error(result.findings):
        # Stops that contradict each other determine nothing; an error finding names the cause.
        return
    if all(axis.is_hidden for axis in _axes(result)):
        text = "nothing about the mounting can be determined from this motion"
        yield text, "record motion with rotations about all axes", (), {}
    elif result.reference == "stops" and result.hidden:
        text, advice, axes, _ = next(_hidden(result))
        is_flat = any(finding.code == "one_axis" for finding in result.findings)
        why = "do not turn about two axes" if is_flat else "turn too little for their errors"
        text = text.replace("this motion", f"these stops, which {why}")
        yield text, f"turn the hand about at least two axes between them, or {advice}", axes, {}


def _findings_of(severity: Severity, result: Result) -> Iterator[_Found]:
    for finding in result.findings:
        if finding.severity is severity:
            yield finding.what, finding.advice, (), finding.options


def _contradiction(kind: str, result: Result) -> Iterator[_Found]:
    """Other answers (``kind``: halves or methods) that lie farther away than they may."""
    told = {}
    sigmas = []
    for axis in _axes(result):
        row = (result.cross_check or {}).get(axis.name)
        if row is None or not math.isfinite(axis.sigma):
            continue
        scatter, is_far = _scatter_of(kind, row, axis)
        if is_far:
            told[axis.name] = f"about {axes_in_words([axis.name])} by {amount(axis.name, scatter)}"
            sigmas.append(f"+/- {amount(axis.name, axis.total)}")
    if told:
        who, advice = _OTHERS[kind]
        differ = f"{who} disagree {listing([*told.values()])}"
        yield f"{differ}; this result claims {listing(sigmas)}", advice, tuple(told), {}


def _scatter_of(kind: str, row: AxisScatter, axis: "_Axis") -> tuple[float, bool]:
    """Scatter of other answers (``kind``: halves or methods) on an axis, and if it is too large."""
    if kind == "halves":
        scatter = row.of_halves
        excess = row.excess_of_halves
        over_own = None
    else:
        scatter = row.of_methods
        excess = row.excess_of_methods
        over_own = row.excess_over_own
    if scatter is None and over_own is not None:
        # Too few answers determine the axis for a scatter, but those that do are about as certain.
        scatter = over_own * axis.total
    if scatter is None:
        return 0.0, False
    of_target = scatter / axis.target
    is_far = (excess or 0.0) > CONTRADICTED_SIGMAS and of_target > CONTRADICTED_SHARE
    if (over_own or 0.0) > CONTRADICTED_SIGMAS:
        is_far |= of_target > CONTRADICTED_TARGETS
    return scatter, is_far


def _unconfirmed(result: Result) -> Iterator[_Found]:
    rows = result.cross_check or {}
    axes = [
        (axis.name, axis.total)
        for axis in _axes(result)
        if axis.name in rows and not rows[axis.name].is_confirmed and not axis.is_known_by_hand
    ]
    if axes:
        names = tuple(name for name, _ in axes)
        text = f"only the noise model determines {_amounts(axes, ' to ')}; no other method does"
        yield text, f"compare {axes_in_words(names)} with a drawing or a tape measure", names, {}


def _hidden(result: Result) -> Iterator[_Found]:
    axes = tuple(axis.name for axis in _axes(result) if axis.is_hidden)
    if 0 < len(axes) < len(_axes(result)):
        priors = listing([f"prior.{axis} VALUE+/-SIGMA" for axis in axes])
        it = "it" if len(axes) == 1 else "them"
        text = f"{axes_in_words(axes)} cannot be determined from this motion"
        yield text, f"measure {it} by hand and give {priors}", axes, {}


def _few_inliers(result: Result) -> Iterator[_Found]:
    if result.reference == "stops":
        # A finding has the numbers of the stops that were left out.
        return
    share = result.n_inliers / max(result.n_pairs, 1)
    uses_reference = METHODS[result.method].uses_reference
    if share < (FEWEST_INLIERS if uses_reference else FEWEST_OF_MODEL):
        text = f"{1 - share:.0%} of the motion pairs were rejected as outliers"
        yield text, "find out why the odometry jumps, and record again", (), {}


_OF_FLOOR = (
    "set the target that you need; if a stream has no such errors, such as motion capture, give "
    "parent_kind or child_kind exact"
)


def _amounts(axes: Iterable[tuple[str, float]], of: str = " ") -> str:
    """Axes and their sizes, rotations as such: the table has angles about other axes."""
    return listing([f"{axes_in_words([name])}{of}{amount(name, size)}" for name, size in axes])


def _worse_than_target(result: Result) -> Iterator[_Found]:
    rough = [axis for axis in _axes(result) if axis.target < axis.sigma < math.inf]
    if rough:
        names = tuple(axis.name for axis in rough)
        sizes = [amount_beside(axis.name, axis.total, axis.target) for axis in rough]
        told = listing(
            [
                f"{axes_in_words([axis.name])} {size}"
                for axis, size in zip(rough, sizes, strict=True)
            ]
        )
        targets = listing([*dict.fromkeys(amount(axis.name, axis.target) for axis in rough)])
        more = "more rotation about other axes" if {*names} & {*TRANSLATIONS} else "more rotation"
        text = f"standard deviations above the target of {targets}: {told}"
        floors = [(axis, math.sqrt(axis.total**2 - axis.sigma**2)) for axis in rough]
        left = [(each.name, of) for each, of in floors if of > each.target]
        advice = [f"record longer, with {more}"] if len(left) < len(rough) else []
        if left:
            advice.append(f"constant odometry errors alone leave {_amounts(left)}: {_OF_FLOOR}")
        yield text, "; ".join(advice), names, {}


def _floor(result: Result) -> Iterator[_Found]:
    rough = [axis for axis in _axes(result) if axis.sigma <= axis.target < axis.total]
    if rough:
        names = tuple(axis.name for axis in rough)
        sizes = [amount_beside(axis.name, axis.total, axis.target) for axis in rough]
        others = [
            f"{axes_in_words([axis.name])} to {size}"
            for axis, size in zip(rough[1:], sizes[1:], strict=True)
        ]
        good_to = listing([f"{axes_in_words(names[:1])} is good to {sizes[0]}", *others])
        targets = [*dict.fromkeys(amount(axis.name, axis.target) for axis in rough)]
        target_is = "the target is" if len(targets) == 1 else "the targets are"
        share = "Most" if all(axis.total**2 > 2.0 * axis.sigma**2 for axis in rough) else "Part"
        kind = "" if result.measured == "positions" else "odometry "
        text = (
            f"{good_to}; {target_is} {listing(targets)}. "
            f"{share} of it is an allowance for constant {kind}errors"
        )
        yield text, _OF_FLOOR, names, {}


# What the checks of streams that are no poses cannot see, and what to do.
_UNSEEN = {
    "positions": (
        "delays and smoothing of positions cannot be seen",
        "compare with a tape measure, or with a recording at another speed",
    ),
    "rotations": (
        "smoothing and slow drift of rotations alone cannot be seen",
        "compare with another recording",
    ),
}


def _part_of_poses(result: Result) -> Iterator[_Found]:
    """Streams that are no poses, which have few checks."""
    if result.measured in _UNSEEN:
        sentence, advice = _UNSEEN[result.measured]
        yield sentence, advice, (), {}


class _Axis(NamedTuple):
    """An axis within reach of the streams, its standard deviation without and with the floor."""

    name: str
    sigma: float
    total: float
    target: float
    is_hidden: bool
    is_known_by_hand: bool


def _axes(result: Result) -> list[_Axis]:
    hidden = result.unobservable()
    totals = result.sigmas.tolist()
    return [
        _Axis(
            name=dof.name,
            sigma=dof.sigma,
            total=total,
            target=target_of(dof.name, result),
            is_hidden=dof.name in hidden,
            is_known_by_hand=dof.verdict is DofVerdict.PRIOR,
        )
        for dof, total in zip(result.observability_measured, totals, strict=True)
        if dof.name not in result.out_of_reach
    ]


_NEVER = Verdict.DO_NOT_USE
_CARE = Verdict.USE_WITH_CARE
_APART = (
    f"differ by more than {CONTRADICTED_SIGMAS:g} joint standard deviations and "
    f"{CONTRADICTED_SHARE:g} of the target"
)

_OWN_RULES = (
    Rule(
        "prior",
        _NEVER,
        "a prior is more than 4 joint standard deviations from the estimate from the motion, or a "
        "lever arm of more than 50 m",
        _contradicted,
    ),
    Rule(
        "error_finding",
        _NEVER,
        "a stream check found an error",
        partial(_findings_of, Severity.ERROR),
    ),
    # Behind the faults of the streams, which are often its cause.
    Rule(
        "not_converged",
        _NEVER,
        "the solver did not converge, and no stream check found an error",
        _not_converged,
    ),
    Rule("nothing_known", _NEVER, "all six axes are unobservable; of stops, any", _nothing_known),
    Rule("unobservable", _CARE, "an axis cannot be determined from the motion", _hidden),
    Rule(
        "warning_finding",
        _CARE,
        "a stream check gave a warning",
        partial(_findings_of, Severity.WARNING),
    ),
    Rule(
        "halves",
        _CARE,
        f"the two halves of the recording {_APART}",
        partial(_contradiction, "halves"),
    ),
    Rule(
        "methods",
        _CARE,
        f"other methods and references {_APART}; or those about as certain by "
        f"{CONTRADICTED_SIGMAS:g} of the result's own and {CONTRADICTED_TARGETS:g} targets",
        partial(_contradiction, "methods"),
    ),
    Rule(
        "unconfirmed",
        _CARE,
        "the noise model determines an axis that no other method or reference determines",
        _unconfirmed,
    ),
    Rule(
        "outliers",
        _CARE,
        f"more than {1 - FEWEST_INLIERS:.0%} of the motion pairs are outliers; "
        f"more than {1 - FEWEST_OF_MODEL:.0%} with method adaptive",
        _few_inliers,
    ),
    Rule(
        "target",
        _CARE,
        "the standard deviation of an axis is above its target",
        _worse_than_target,
    ),
    Rule(
        "floor",
        _CARE,
        "an axis is worse than its target only together with the allowance for constant errors",
        _floor,
    ),
    Rule(
        "part_of_poses",
        _CARE,
        "a stream has only positions, rotations or rates, which have few checks",
        _part_of_poses,
    ),
)


def _with_extra_rules() -> tuple[Rule, ...]:
    """Return the rules with those of the extras at their places."""
    rules = [*_OWN_RULES]
    for name, extra in EXTRA_RULES.items():
        names = [rule.name for rule in rules]
        verdict = _NEVER if extra.forbids else _CARE
        place = names.index(extra.after) + 1
        rules.insert(place, Rule(name, verdict, extra.when, extra.find))
    return tuple(rules)


#: Rules of the verdict, the gravest first.
RULES = _with_extra_rules()
