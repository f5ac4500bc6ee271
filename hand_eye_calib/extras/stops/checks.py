"""Checks of stops before they are solved: rows, rotations, conventions, axes and units.

Rotations alone reveal wrong rows and angles that were read otherwise
(:mod:`hand_eye_calib.extras.stops.rotation_checks`). They do not reveal quaternions in another
order: w x y z read as x y z w turns a rotation into an inverse one, seen from other axes. Only the
positions contradict. So each usual mistake is undone in turn, and a robust fit of ``A X = Z B``
decides whether rotations and positions agree without it. The best of these hypotheses are solved,
and their likelihoods are compared.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import defaults_of
from hand_eye_calib.core.base.option import options_in_words
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.checks.findings import Finding, Severity, conventions, finding
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.records import has_error
from hand_eye_calib.extras.stops.robot_world import solve
from hand_eye_calib.extras.stops.rotation_checks import (
    CLEARLY_BETTER,
    EXPLAINED_SHARE,
    FEWEST_STOPS,
    LARGEST_SHARE,
    UNRELATED_SHARE,
    check_angles,
    check_frozen,
    check_rows,
)
from hand_eye_calib.extras.stops.rough_fit import (
    Mistakes,
    RoughFit,
    StopPoses,
    certain_gain,
    rough_fit,
    spread,
    turns_about_two_axes,
)

# Unexplained share of the rotations or the positions from which on there is a warning.
_DOUBTFUL_SHARE = 0.12

# Errors of the positions over those that the errors of the rotations cause. Measured: 1 to 5 for
# three real arms, 1 to 4 for KinHEC with noise. Above the first ratio the positions contradict if
# too large a share is unexplained; above the second ratio, if this share is.
_LARGEST_RATIO = 4.0
_CONTRADICTING_RATIO = 12.0
_CONTRADICTING_SHARE = 0.08

# Hypotheses whose log likelihoods differ by less than this are equally good: a factor of 1100
# between the likelihoods. Measured on simulated arms: the log likelihoods of the two setups (camera
# on the hand, camera beside the arm) differ by at least 95 with four or more stops, and by 0.0 with
# three.
LEAST_LEAD = 7.0

# Largest number of hypotheses (mistakes undone) that are solved in full: those with the best rough
# fits. The others are dropped.
_MOST_RIVALS = 6

# Positions that spread over more than this (m) are not those of an arm in metres.
_LARGEST_SPREAD_M = 3.0

# Lengths of such positions above this median distance from the origin are millimetres, otherwise
# centimetres.
_LARGEST_DISTANCE_CM = 200.0

# Largest factor between the lengths of both sides without another unit: the size of a target is
# not wrong by more.
_LARGEST_FACTOR = 3.0

# Units of lengths by their factors to metres.
_CENTIMETRE = 0.01
_MILLIMETRE = 0.001
_UNITS = {_CENTIMETRE: "centimetres", _MILLIMETRE: "millimetres"}

_UNEXPLAINED = attrgetter("unexplained")

# Codes of conventions that each side may have wrong.
_CODES = ("", "quaternion_order", "quaternion_names", "inverse_orientation")


@dataclass(frozen=True)
class Examination:
    """Result of the checks before the solve.

    Attributes
    ----------
    findings : tuple of Finding
        Errors that no option repairs for certain.
    repairs : tuple of Finding
        Mistakes that their options repair.
    scale : float or None
        Rough factor of the child's lengths after the repairs; None if it is not determined.
    child_unit : float
        Unit of the child's lengths if it is no finding, because the scale is estimated anyway.
    """

    findings: tuple[Finding, ...] = ()
    repairs: tuple[Finding, ...] = ()
    scale: float | None = None
    child_unit: float = 1.0


def examine(poses: StopPoses, is_scale_free: bool) -> Examination:
    """Detect usual mistakes in stops.

    Parameters
    ----------
    poses : StopPoses
        With the options of the user applied.
    is_scale_free : bool
        Whether the factor of the child's lengths is estimated anyway.
    """
    if len(poses) < FEWEST_STOPS:
        return Examination()
    findings = [*check_frozen(poses)]
    if all(issue.evidence["share"] < 1.0 for issue in findings):
        findings += check_rows(poses)
    findings = findings or [*check_angles(poses)]
    if findings:
        return Examination(tuple(findings))
    sample = poses.sample()
    if not turns_about_two_axes(poses.parent):
        # Rotations about one axis do not determine the conventions of the positions. Only their
        # unit is checked.
        return _with_units(sample, Examination(), is_scale_free)
    chosen, rivals = _explain(sample)
    if axes := _check_axes(sample, chosen):
        return Examination((axes,))
    repairs = tuple(
        finding(code, stream, options=conventions(code, stream))
        for code, stream in _codes_and_streams(chosen.mistakes)
    )
    findings = _check_conventions(sample, chosen.mistakes, rivals)
    if not (findings or repairs):
        findings = _check_agreement(chosen)
    examination = Examination(tuple(findings), repairs)
    if has_error(findings):
        return examination
    return _with_units(sample, replace(examination, scale=chosen.scale), is_scale_free)


# ------------------------------------------------------------------ conventions


def _explain(sample: StopPoses) -> tuple[RoughFit, list[Mistakes]]:
    """Return the fit that explains the stops, and mistakes that explain them equally well.

    The fit is that without mistakes unless some are certain.
    """
    plain = [rough_fit(sample, Mistakes(is_inverse=way)) for way in sample.ways]
    as_given = _best_without_mistakes(plain)
    if as_given.unexplained < EXPLAINED_SHARE or not sample.has_positions:
        return as_given, []
    objectives = {rival: _objective(sample, rival) for rival in _rivals(sample)}
    smallest = min(objectives.values())
    gain = min(_objective(sample, fit) for fit in plain) - smallest
    good = _simplest([rival for rival in objectives if objectives[rival] < smallest + LEAST_LEAD])
    if gain < -LEAST_LEAD:
        return as_given, []
    if gain < certain_gain(len(sample)):
        return as_given, [rival.mistakes for rival in good]
    best = min(good, key=_UNEXPLAINED)
    if best.unexplained > LARGEST_SHARE:
        return as_given, []
    return best, [rival.mistakes for rival in good if rival is not best]


def _best_without_mistakes(fits: Sequence[RoughFit]) -> RoughFit:
    """Return the better fit of both setups.

    Rotations decide whether the camera is on the hand; positions choose only where they do not.
    """
    largest_turning = CLEARLY_BETTER * min(fit.turning for fit in fits)
    possible = [fit for fit in fits if fit.turning <= largest_turning]
    return min(possible, key=_UNEXPLAINED)


def _simplest(fits: Sequence[RoughFit]) -> list[RoughFit]:
    """Return the fits with the fewest different mistakes."""
    fewest = min(fit.mistakes.complexity for fit in fits)
    return [fit for fit in fits if fit.mistakes.complexity == fewest]


def _rivals(sample: StopPoses) -> list[RoughFit]:
    """Return the best rough fits with mistakes undone."""
    rivals = []
    for parent, child, is_inverse in itertools.product(_CODES, _CODES, (False, True)):
        is_plain = not (parent or child) and is_inverse in sample.ways
        if not is_plain:
            rivals.append(rough_fit(sample, Mistakes(parent, child, is_inverse)))
    rivals.sort(key=lambda rival: -rival.log_likelihood)
    return rivals[:_MOST_RIVALS]


def _objective(sample: StopPoses, fit: RoughFit) -> float:
    """Return the negative log likelihood of the solved stops, in lengths of the parent."""
    return solve(sample.without(fit.mistakes, fit.scale or 1.0)).objective


def _check_conventions(
    poses: StopPoses, mistakes: Mistakes, rivals: Sequence[Mistakes]
) -> list[Finding]:
    """Return findings of mistakes that cannot be repaired with certainty."""
    findings = []
    if mistakes.is_inverse and not poses.is_arm:
        findings.append(finding("inverse_stops", "child", options={"child_invert": "poses"}))
    streams = _codes_and_streams(mistakes)
    others = [rival for rival in rivals if _codes_and_streams(rival) != streams]
    if others:
        findings.append(_ambiguous(mistakes, others[0]))
    return findings


def _ambiguous(mistakes: Mistakes, rival: Mistakes) -> Finding:
    """Return the finding that two explanations fit equally well, with the options of both."""
    options = _options_of(mistakes)
    rival_options = _options_of(rival)
    # Each lists every option that either sets, with its default if need be. So the listed options
    # select one explanation.
    first = options | defaults_of(name for name in rival_options if name not in options)
    second = rival_options | defaults_of(name for name in options if name not in rival_options)
    return finding(
        "ambiguous_stops",
        options=second,
        given=options_in_words(first),
        other=options_in_words(second),
    )


def _options_of(mistakes: Mistakes) -> dict[str, float | str]:
    """Return the options that undo mistakes."""
    options: dict[str, float | str] = {}
    for code, stream in _codes_and_streams(mistakes):
        options |= conventions(code, stream)
    return options


def _codes_and_streams(mistakes: Mistakes) -> list[tuple[str, str]]:
    """Return code and stream of each mistake."""
    if mistakes.parent == mistakes.child:
        return [(mistakes.parent, "both")] if mistakes.parent else []
    sides = ((mistakes.parent, "parent"), (mistakes.child, "child"))
    return [(code, stream) for code, stream in sides if code]


def _check_agreement(fit: RoughFit) -> list[Finding]:
    """Return a finding if no usual mistake explains the stops.

    Noise of the rotations explains errors of the positions up to a ratio.
    """
    are_too_large = fit.turning > LARGEST_SHARE or fit.placing > UNRELATED_SHARE
    are_beyond_noise = fit.placing > EXPLAINED_SHARE and fit.beyond > _LARGEST_RATIO
    if not (are_too_large or are_beyond_noise):
        return []
    contradict = fit.placing > _CONTRADICTING_SHARE and fit.beyond > _CONTRADICTING_RATIO
    if fit.unexplained > LARGEST_SHARE or contradict:
        severity = Severity.ERROR
    elif fit.unexplained >= _DOUBTFUL_SHARE:
        severity = Severity.WARNING
    else:
        return []
    part = "rotations" if fit.turning > fit.placing else "positions"
    share = min(fit.unexplained, 1.0)
    return [finding("disagreeing_stops", severity=severity, part=part, share=share)]


# ------------------------------------------------------------------ axes


def _check_axes(sample: StopPoses, fit: RoughFit) -> Finding | None:
    """Return a finding if the positions of one side are clearly in other axes.

    Other axes must explain more than the best of the other mistakes, whose fit is ``fit``.
    """
    if fit.unexplained < EXPLAINED_SHARE:
        return None
    best = None
    largest = fit.log_likelihood + certain_gain(len(sample))
    for way in sample.ways:
        mistakes = Mistakes(is_inverse=way)
        if rough_fit(sample, mistakes).turning > LARGEST_SHARE:
            continue
        for axes, stream in itertools.product(_other_axes(), ("child", "parent")):
            Ts = getattr(sample, stream)
            turned = se3.from_rotation_translation(
                se3.rotation_of(Ts), se3.translation_of(Ts) @ axes.T
            )
            other = rough_fit(sample.with_side(stream, turned), mistakes)
            if other.log_likelihood > largest and other.unexplained < LARGEST_SHARE:
                best = finding("axes", stream, detail=_axes_in_words(axes))
                largest = other.log_likelihood
    return best


def _other_axes() -> Iterator[FloatArray]:
    """Yield all matrices (3, 3) that permute and flip the axes, without the identity."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            axes = np.diag(signs) @ np.eye(3)[list(order)]
            if not np.array_equal(axes, np.eye(3)):
                yield axes


def _axes_in_words(axes: FloatArray) -> str:
    """Return permuted and flipped axes as text, such as ``x -y z``."""
    names = []
    for row in axes:
        name = "xyz"[int(np.argmax(np.abs(row)))]
        names.append(name if row.sum() > 0 else f"-{name}")
    return " ".join(names)


# ------------------------------------------------------------------ lengths


def _with_units(sample: StopPoses, examination: Examination, is_scale_free: bool) -> Examination:
    """Return the examination with findings or repairs of lengths in other units, and with the scale
    that remains.
    """
    if not sample.has_positions:
        return examination
    scale = examination.scale
    of_parent = _unit_of_size(se3.translation_of(sample.parent))
    of_child = _unit_of_size(se3.translation_of(sample.child))
    if scale is not None:
        to_metres = scale * of_parent
        nearest = min((1.0, *_UNITS), key=lambda unit: abs(np.log(to_metres / unit)))
        is_unit = abs(np.log(to_metres / nearest)) < np.log(_LARGEST_FACTOR)
        of_child = nearest if is_unit else 1.0
        scale = to_metres / of_child
    units = []
    if of_parent != 1.0:
        units.append(_unit_finding("parent", "parent_scale", of_parent))
    if of_child != 1.0:
        units.append(_unit_finding("child", "scale", of_child))
    # Stops of two vehicles may be far apart; an arm is not that large.
    is_certain = sample.is_arm or (len(units) == 1 and scale is not None)
    examination = replace(examination, scale=scale)
    if is_scale_free and of_child != 1.0:
        units.pop()
        examination = replace(examination, child_unit=of_child)
    if is_certain:
        return replace(examination, repairs=(*examination.repairs, *units))
    return replace(examination, findings=(*examination.findings, *units))


def _unit_finding(stream: str, option: str, unit: float) -> Finding:
    return finding("stop_units", stream, options={option: unit}, unit=_UNITS[unit])


def _unit_of_size(positions: FloatArray) -> float:
    """Return the factor to metres of positions (N, 3), by their size."""
    if spread(positions) <= _LARGEST_SPREAD_M:
        return 1.0
    distance = median(np.linalg.norm(positions, axis=1))
    return _CENTIMETRE if distance < _LARGEST_DISTANCE_CM else _MILLIMETRE
