"""Rules that lead to a verdict.

Each rule of :data:`RULES` examines a result and yields grounds, which are reasons not to use the
result. The gravest rule is first. The first rule with a ground decides the verdict. docs/verdict.md
has the same table, and a test compares both.
"""

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from typing import NamedTuple

from hand_eye_calib.core.base.config import METHODS
from hand_eye_calib.core.base.registry import EXTRA_RULES
from hand_eye_calib.core.base.spelling import PLACEHOLDER
from hand_eye_calib.core.base.text import (
    amount,
    axes_in_words,
    listing,
    two_digits,
)
from hand_eye_calib.core.results.axes import (
    ReachableAxis,
    amounts_in_words,
    axes_within_reach,
    cause_of_allowance,
    kinds_to_declare,
    targets_in_words,
)
from hand_eye_calib.core.results.reasons import Ground, Verdict
from hand_eye_calib.core.results.records import (
    ROTATIONS,
    TRANSLATIONS,
    AxisScatter,
    Severity,
    SolveStatus,
    has_error,
)
from hand_eye_calib.core.results.result import Result


class Rule(NamedTuple):
    """A row of the table of rules.

    ``when`` is the condition in words. ``find(result)`` yields a ground if the condition is true.
    """

    name: str
    verdict: Verdict
    when: str
    find: Callable[[Result], Iterator[Ground]]


# Other estimates contradict a result on an axis if their scatter about the result exceeds two
# limits. First limit: this number of joint standard deviations. A contradiction never leads to DO
# NOT USE, because the other methods do not model time-correlated errors.
CONTRADICTED_SIGMAS = 3.0
# Second limit of the scatter, as a share of the target of the axis.
CONTRADICTED_SHARE = 0.25

# Estimates that are about as certain as the result have another test. They contradict the result if
# their scatter exceeds CONTRADICTED_SIGMAS standard deviations of the result, and also this
# multiple of the target. The uncertainty of the estimates cannot explain such a scatter.
CONTRADICTED_TARGETS = 2.0

# Smallest share of inliers among the motion pairs. With less, the rule "outliers" yields a ground.
FEWEST_INLIERS = 0.7

# The same share for the adaptive method. It is larger, because the noise model rejects only
# outliers. If a tenth of all poses are outliers, a fifth of the pairs are wrong.
FEWEST_OF_MODEL = 0.8

# The same share for the windows of a vehicle. Their outliers are slips, which do not affect
# neighbouring windows.
FEWEST_OF_WINDOWS = 0.9

# Texts of the rules "halves" and "methods", in three parts: the estimates that disagree, the words
# before the standard deviations of the result, and the advice.
_CONTRADICTION_TEXTS = {
    "halves": (
        "the two halves of the recording disagree",
        "this result claims",
        "check that both mounts are tight and record again; use only axes on which the halves "
        "agree",
    ),
    "methods": (
        "robust least squares disagrees",
        "without this second opinion, the result claims",
        "compare with a drawing or a tape measure, or record longer with more varied motion",
    ),
}


def _not_converged(result: Result) -> Iterator[Ground]:
    # If an error finding already explains why there is no solution, this rule adds nothing.
    if result.status is SolveStatus.NOT_CONVERGED and not has_error(
        result.findings
    ):
        yield Ground("the solver did not converge", "record more varied motion")


def _contradicted(result: Result) -> Iterator[Ground]:
    if result.status is SolveStatus.CONTRADICTED:
        distances = result.contradictions
        which = "a prior contradicts"
        names = "the prior"
        if distances:
            texts = [
                f"on {axis} is {two_digits(distance)} standard deviations from"
                for axis, distance in distances.items()
            ]
            which = f"the prior {listing(texts)}"
            names = listing([f"prior.{axis}" for axis in distances])
        sentence = f"{which} the estimate from the motion"
        yield Ground(
            sentence, f"check value, unit and sign of {names}", tuple(distances)
        )


def _nothing_known(result: Result) -> Iterator[Ground]:
    if result.reference in ("stops", "windows") and has_error(result.findings):
        # If stops contradict each other, or a vehicle always drives the same curve, an error
        # finding names this cause.
        return
    if all(axis.is_hidden for axis in axes_within_reach(result)):
        yield Ground(
            "nothing about the mounting can be determined from this motion",
            "record motion with rotations about all axes",
        )
    elif result.reference == "stops" and result.hidden:
        # Rotations about one axis also hide mistakes in the conventions of stops: of 44 mistakes of
        # two simulated arms, 16 gave a wrong pose without another finding.
        has_one_axis = any(
            finding.code == "one_axis" for finding in result.findings
        )
        why = (
            "do not turn about two axes"
            if has_one_axis
            else "turn too little for their errors"
        )
        ground = _hidden_ground(result, f"these stops, which {why}")
        advice = f"turn the hand about at least two axes between stops, or {ground.advice}"
        yield ground._replace(advice=advice)


def _findings_of(severity: Severity, result: Result) -> Iterator[Ground]:
    for finding in result.findings:
        if finding.severity is severity:
            yield Ground(finding.what, finding.advice, options=finding.options)


def _contradiction(kind: str, result: Result) -> Iterator[Ground]:
    """Yield a ground if other estimates contradict the result on some axes.

    ``kind`` is "halves" or "methods", the source of the other estimates.
    """
    distances = {}
    sigmas = []
    for axis in axes_within_reach(result):
        row = (result.cross_check or {}).get(axis.name)
        if row is None or not math.isfinite(axis.sigma):
            continue
        scatter, is_far = _scatter_of(kind, row, axis)
        if is_far:
            distances[axis.name] = (
                f"about {axes_in_words([axis.name])} by {amount(axis.name, scatter)}"
            )
            claimed = axis.total
            if kind == "methods" and row.sigma:
                claimed = row.sigma
            sigmas.append(f"+/- {amount(axis.name, claimed)}")
    if distances:
        who, claims, advice = _CONTRADICTION_TEXTS[kind]
        disagree = f"{who} {listing([*distances.values()])}"
        yield Ground(
            f"{disagree}; {claims} {listing(sigmas)}", advice, tuple(distances)
        )


def _scatter_of(
    kind: str, row: AxisScatter, axis: ReachableAxis
) -> tuple[float, bool]:
    """Return the scatter of other estimates on an axis, and whether it is too large."""
    if kind == "halves":
        scatter = row.of_halves
        excess = row.excess_of_halves
        over_own = None
    else:
        scatter = row.of_methods
        excess = row.excess_of_methods
        over_own = row.excess_over_own
    if scatter is None and over_own is not None:
        # The estimates are too few for `of_methods`, but about as certain as the result.
        scatter = over_own * (row.sigma or axis.total)
    if scatter is None:
        return 0.0, False
    of_target = scatter / axis.target
    is_significant = (excess or 0.0) > CONTRADICTED_SIGMAS
    is_far = is_significant and of_target > CONTRADICTED_SHARE
    if (over_own or 0.0) > CONTRADICTED_SIGMAS:
        is_far |= of_target > CONTRADICTED_TARGETS
    return scatter, is_far


def _unconfirmed(result: Result) -> Iterator[Ground]:
    rows = result.cross_check or {}
    axes = [
        (axis.name, axis.total)
        for axis in axes_within_reach(result)
        if axis.name in rows
        and not rows[axis.name].is_confirmed
        and not axis.is_known_by_hand
    ]
    if axes:
        names = tuple(name for name, _ in axes)
        sizes = amounts_in_words(axes, " to ")
        text = f"only the noise model determines {sizes}; no other method does"
        advice = (
            f"compare {axes_in_words(names)} with a drawing or a tape measure"
        )
        yield Ground(text, advice, names)


def _hidden(result: Result) -> Iterator[Ground]:
    axes = axes_within_reach(result)
    if 0 < sum(axis.is_hidden for axis in axes) < len(axes):
        yield _hidden_ground(result, "this motion")


def _hidden_ground(result: Result, source: str) -> Ground:
    """Return the ground that some axes are unobservable.

    ``source`` is the cause, such as "this motion".
    """
    axes = tuple(
        axis.name for axis in axes_within_reach(result) if axis.is_hidden
    )
    advice = "measure it by hand and give a prior"
    if len(axes) > 1:
        advice = "measure them by hand and give priors"
    sentence = f"{axes_in_words(axes)} cannot be determined from {source}"
    return Ground(
        sentence, advice, axes, {f"prior.{axis}": PLACEHOLDER for axis in axes}
    )


def _few_inliers(result: Result) -> Iterator[Ground]:
    if result.reference == "stops":
        # A finding names the stops that were rejected.
        return
    share = result.n_inliers / max(result.n_pairs, 1)
    if share < _fewest_inliers(result):
        text = f"{1 - share:.0%} of the motion pairs were rejected as outliers"
        advice = (
            "look in the report for jumps of an odometry; without jumps, a clock is too fast or "
            "too slow, or a stream has too few poses per second"
        )
        if result.reference == "windows":
            # The outliers of a vehicle are slips.
            text = f"the wheels or the vehicle slip {1 - share:.0%} of the time"
            advice = "drive more slowly in curves, on a floor with grip, and record again"
        yield Ground(text, advice)


def _fewest_inliers(result: Result) -> float:
    """Return the smallest share of inliers that is no reason for care."""
    if result.reference == "windows":
        return FEWEST_OF_WINDOWS
    uses_reference = METHODS[result.method].uses_reference
    return FEWEST_INLIERS if uses_reference else FEWEST_OF_MODEL


def _floor_advice(result: Result, axes: Collection[str]) -> str:
    """Return the advice if the allowance of some axes exceeds their targets."""
    targets = []
    if not {*TRANSLATIONS}.isdisjoint(axes):
        targets.append("target.translation")
    if not {*ROTATIONS}.isdisjoint(axes):
        targets.append("target.rotation")
    advice = f"set the target that you need with {listing(targets)}"
    if options := kinds_to_declare(result):
        advice += (
            "; if a stream has no such errors, such as motion capture, give "
            f"{' or '.join(options)}"
        )
    return advice


def _worse_than_target(result: Result) -> Iterator[Ground]:
    rough = [
        axis
        for axis in axes_within_reach(result)
        if axis.target < axis.sigma < math.inf
    ]
    if not rough:
        return
    names = tuple(axis.name for axis in rough)
    sizes = [
        f"{axes_in_words([axis.name])} {axis.sigma_beside_target()}"
        for axis in rough
    ]
    targets = targets_in_words(rough)
    sentence = (
        f"standard deviations above the target of {targets}: {listing(sizes)}"
    )
    yield Ground(sentence, _advice_for_target(result, rough), names)


def _advice_for_target(result: Result, rough: Sequence[ReachableAxis]) -> str:
    """Return the advice for axes whose measured standard deviation exceeds the target."""
    # Axes whose allowance alone exceeds the target. No recording reaches their target.
    hopeless = []
    does_recording_help = False
    for axis in rough:
        allowance = math.sqrt(axis.total**2 - axis.sigma**2)
        if allowance > axis.target:
            hopeless.append((axis.name, allowance))
        # A longer recording reduces only the measured part, so this part must dominate.
        if allowance <= axis.target or 2.0 * allowance < axis.sigma:
            does_recording_help = True
    advice = []
    if does_recording_help and result.reference == "stops":
        advice.append("record more stops, with larger rotations")
    elif does_recording_help:
        advice.append("record longer, with more motion")
    if hopeless:
        alone = f"{cause_of_allowance(result)} alone leave {amounts_in_words(hopeless)}"
        to_do = _floor_advice(result, [name for name, _ in hopeless])
        advice.append(f"{alone}: {to_do}")
    return "; ".join(advice)


def _floor(result: Result) -> Iterator[Ground]:
    """Yield the ground that the allowance alone exceeds the target of some axes."""
    above = [
        axis
        for axis in axes_within_reach(result)
        if axis.sigma <= axis.target < axis.total
    ]
    if not above:
        return
    names = tuple(axis.name for axis in above)
    sizes = [
        f"{axes_in_words(names[:1])} is good to {above[0].sigma_beside_target()}"
    ]
    sizes += [
        f"{axes_in_words([axis.name])} to {axis.sigma_beside_target()}"
        for axis in above[1:]
    ]
    is_one = len({amount(axis.name, axis.target) for axis in above}) == 1
    target_is = "the target is" if is_one else "the targets are"
    # The allowance is most of a standard deviation if it is more than half of the variance.
    is_most = all(axis.total**2 > 2.0 * axis.sigma**2 for axis in above)
    share = "Most" if is_most else "Part"
    deviations = (
        "the standard deviation" if len(above) == 1 else "each deviation"
    )
    sentence = (
        f"{listing(sizes)}; {target_is} {targets_in_words(above)}. "
        f"{share} of {deviations} is an allowance for {cause_of_allowance(result)}"
    )
    yield Ground(sentence, _floor_advice(result, names), names)


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
    # This rule is after the error findings, because faults of the streams are often the cause.
    Rule(
        "not_converged",
        _NEVER,
        "the solver did not converge, and no stream check found an error",
        _not_converged,
    ),
    Rule(
        "nothing_known",
        _NEVER,
        "all six axes are unobservable; with stops, any axis",
        _nothing_known,
    ),
    Rule(
        "unobservable",
        _CARE,
        "an axis cannot be determined from the motion",
        _hidden,
    ),
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
        f"estimates of robust least squares {_APART}; or estimates about as certain as the result "
        f"differ by {CONTRADICTED_SIGMAS:g} of its standard deviations and "
        f"{CONTRADICTED_TARGETS:g} targets",
        partial(_contradiction, "methods"),
    ),
    Rule(
        "unconfirmed",
        _CARE,
        "only the noise model determines an axis; no other method does",
        _unconfirmed,
    ),
    Rule(
        "outliers",
        _CARE,
        f"more than {1 - FEWEST_INLIERS:.0%} of the motion pairs are outliers; "
        f"more than {1 - FEWEST_OF_MODEL:.0%} with method adaptive; a vehicle slips for more than "
        f"{1 - FEWEST_OF_WINDOWS:.0%} of the time",
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
)


def _with_extra_rules() -> tuple[Rule, ...]:
    """Return the rules of this module with those of the extras inserted at their places."""
    rules = [*_OWN_RULES]
    for name, extra in EXTRA_RULES.items():
        names = [rule.name for rule in rules]
        verdict = _NEVER if extra.forbids else _CARE
        place = names.index(extra.after) + 1
        rules.insert(place, Rule(name, verdict, extra.when, extra.find))
    return tuple(rules)


#: Rules of the verdict, the gravest first.
RULES = _with_extra_rules()
