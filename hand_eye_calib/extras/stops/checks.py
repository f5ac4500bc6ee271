"""Checks of stops before the solve: rows, rotations, conventions, axes and units.

Rotations alone reveal wrong rows and wrong kinds of angles
(:mod:`hand_eye_calib.extras.stops.rotation_checks`). They do not reveal a wrong order of
quaternions: if w x y z is read as x y z w, the result is inverse rotations in other axes, which
agree as well. Only the positions then contradict. Therefore each usual mistake is a hypothesis: the
mistake is undone, and a rough fit of ``A X = Z B`` measures how well rotations and positions agree.
The best hypotheses are solved in full and compared by their likelihoods.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import defaults_of
from hand_eye_calib.core.base.option import options_in_words
from hand_eye_calib.core.base.stats import median
from hand_eye_calib.core.checks.findings import (
    Finding,
    Severity,
    conventions,
    finding,
)
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.records import has_error
from hand_eye_calib.extras.stops.robot_world import inliers_of, objective_of
from hand_eye_calib.extras.stops.rotation_checks import (
    MAX_UNEXPLAINED,
    MIN_IMPROVEMENT,
    MIN_STOPS_TO_CHECK,
    SMALL_UNEXPLAINED,
    UNRELATED_UNEXPLAINED,
    check_angles,
    check_frozen,
    check_rows,
    check_turning,
)
from hand_eye_calib.extras.stops.rough_fit import (
    Mistakes,
    RoughFit,
    StopPoses,
    min_certain_gain,
    rough_fit,
    spread,
    turns_about_two_axes,
)

# Smallest unexplained share of rotations or positions that causes a warning.
_DOUBTFUL_SHARE = 0.12

# Limits of ``RoughFit.position_ratio``: the residuals of positions, divided by the position errors
# that errors of the rotations cause. Measured: 1 to 5 for three real arms, 1 to 4 for KinHEC with
# noise. First limit: noise does not explain larger residuals.
_MAX_POSITION_RATIO = 4.0
# Second limit: above it, positions contradict the hypothesis if ...
_CONTRADICTING_POSITION_RATIO = 12.0
# ... more than this share of their spread is unexplained.
_CONTRADICTING_SHARE = 0.08

# Two hypotheses are equally good if their log likelihoods differ by less than this (a factor of
# 1100). Measured on simulated arms: the two setups (camera on the hand, camera beside the arm)
# differ by at least 95 with four or more stops, and by 0.0 with three.
MIN_LEAD = 7.0

# Largest number of hypotheses that are solved in full: those with the best rough fits.
_MAX_RIVALS = 6

# Largest spread (m) of an arm's positions. If it is larger, the unit is not metres.
_MAX_SPREAD_M = 3.0

# Positions are in centimetres if their median distance from the origin is at most this number;
# otherwise they are in millimetres.
_MAX_DISTANCE_CM = 200.0

# Largest factor by which the assumed size of a target may be wrong. A larger factor between the
# lengths of both sides is a difference of units.
_MAX_SIZE_FACTOR = 3.0

# Units of length, as factors to metres.
_CENTIMETRE = 0.01
_MILLIMETRE = 0.001
_UNITS = {_CENTIMETRE: "centimetres", _MILLIMETRE: "millimetres"}

_UNEXPLAINED = attrgetter("unexplained_share")

# Mistakes that each side may have, as keys of ``CONVENTIONS``. The first entry is no mistake.
_CODES = ("", "quaternion_order", "quaternion_names", "inverse_orientation")


@dataclass(frozen=True)
class Examination:
    """Result of the checks before the solve.

    Attributes
    ----------
    findings : tuple of Finding
        Mistakes that are not repaired, because the repair is unknown or uncertain.
    repairs : tuple of Finding
        Mistakes that are certain; the options of each finding repair it.
    scale : float or None
        Rough factor of the child's lengths after the repairs; None if it is not determined.
    child_unit : float
        Factor from the child's unit of length to metres if the scale is estimated anyway. Another
        unit is then no finding.
    """

    findings: tuple[Finding, ...] = ()
    repairs: tuple[Finding, ...] = ()
    scale: float | None = None
    child_unit: float = 1.0


def examine(poses: StopPoses, is_scale_free: bool) -> Examination:
    """Detect usual mistakes in stops, and decide which ones are repaired.

    Parameters
    ----------
    poses : StopPoses
        Poses after the options of the user.
    is_scale_free : bool
        Whether the factor of the child's lengths is estimated anyway.
    """
    if len(poses) < MIN_STOPS_TO_CHECK:
        return Examination()
    findings = _check_rotations(poses)
    if findings:
        return Examination(tuple(findings))
    sample = poses.sample()
    if not turns_about_two_axes(poses.parent):
        # Rotations about a single axis do not determine the conventions of the positions. Check
        # only the unit.
        return _with_units(sample, Examination(), is_scale_free)
    chosen, rivals = _best_hypothesis(sample)
    if axes := _check_axes(sample, chosen):
        return Examination((axes,))
    repairs = tuple(
        finding(code, stream, options=conventions(code, stream))
        for code, stream in _codes_and_streams(chosen.mistakes)
    )
    findings = _check_conventions(sample, chosen.mistakes, rivals)
    if not (findings or repairs):
        findings = _check_agreement(chosen)
        if has_error(findings) and _do_inliers_agree(sample, chosen):
            findings = []
    examination = Examination(tuple(findings), repairs)
    if has_error(findings):
        return examination
    return _with_units(
        sample, replace(examination, scale=chosen.scale), is_scale_free
    )


def _check_rotations(poses: StopPoses) -> list[Finding]:
    """Return findings of the checks that use rotations only.

    Rows are not checked if one side is frozen throughout. Angles are checked only without other
    findings.
    """
    findings = [*check_frozen(poses)] or [*check_turning(poses)]
    if any(issue.code == "no_turning" for issue in findings):
        return findings
    if all(issue.evidence["share"] < 1.0 for issue in findings):
        findings += check_rows(poses)
    return findings or [*check_angles(poses)]


# ------------------------------------------------------------------ conventions


def _best_hypothesis(sample: StopPoses) -> tuple[RoughFit, list[Mistakes]]:
    """Return the rough fit of the best hypothesis, and its rivals with the same likelihood.

    The best hypothesis is the one without mistakes, unless mistakes are certain.
    """
    plain = [
        rough_fit(sample, Mistakes(is_inverse=is_inverse))
        for is_inverse in sample.possible_inversions
    ]
    as_given = _better_setup(plain)
    if (
        as_given.unexplained_share < SMALL_UNEXPLAINED
        or not sample.has_positions
    ):
        return as_given, []
    objectives = {rival: _objective(sample, rival) for rival in _rivals(sample)}
    smallest = min(objectives.values())
    # Gain of log likelihood if the mistakes of the best rival are undone.
    gain = min(_objective(sample, fit) for fit in plain) - smallest
    if gain < -MIN_LEAD:
        return as_given, []
    likely = [
        rival for rival in objectives if objectives[rival] < smallest + MIN_LEAD
    ]
    likely = _with_fewest_mistakes(likely)
    if gain < min_certain_gain(len(sample)):
        return as_given, [rival.mistakes for rival in likely]
    best = min(likely, key=_UNEXPLAINED)
    if best.unexplained_share > MAX_UNEXPLAINED:
        return as_given, []
    return best, [rival.mistakes for rival in likely if rival is not best]


def _better_setup(fits: Sequence[RoughFit]) -> RoughFit:
    """Return the better fit of both setups: camera on the hand, camera beside the robot.

    Rotations decide. If they fit both setups about equally, positions decide.
    """
    max_share = MIN_IMPROVEMENT * min(fit.rotation_share for fit in fits)
    possible = [fit for fit in fits if fit.rotation_share <= max_share]
    return min(possible, key=_UNEXPLAINED)


def _with_fewest_mistakes(fits: Sequence[RoughFit]) -> list[RoughFit]:
    """Return the fits whose hypotheses have the fewest different mistakes."""
    fewest = min(fit.mistakes.complexity for fit in fits)
    return [fit for fit in fits if fit.mistakes.complexity == fewest]


def _rivals(sample: StopPoses) -> list[RoughFit]:
    """Return the best rough fits of hypotheses with mistakes."""
    rivals = []
    for parent, child, is_inverse in itertools.product(
        _CODES, _CODES, (False, True)
    ):
        is_plain = (
            not (parent or child) and is_inverse in sample.possible_inversions
        )
        if not is_plain:
            rivals.append(
                rough_fit(sample, Mistakes(parent, child, is_inverse))
            )
    rivals.sort(key=lambda rival: -rival.log_likelihood)
    return rivals[:_MAX_RIVALS]


def _objective(sample: StopPoses, fit: RoughFit) -> float:
    """Return the negative log likelihood of stops solved under a rough fit's hypothesis."""
    return objective_of(sample.without(fit.mistakes, fit.scale or 1.0))


def _check_conventions(
    poses: StopPoses, mistakes: Mistakes, rivals: Sequence[Mistakes]
) -> list[Finding]:
    """Return findings about inverse poses, and about rival hypotheses of equal likelihood."""
    findings = []
    if mistakes.is_inverse and not poses.is_arm:
        findings.append(
            finding("inverse_stops", "child", options={"child_invert": "poses"})
        )
    streams = _codes_and_streams(mistakes)
    others = [rival for rival in rivals if _codes_and_streams(rival) != streams]
    if others:
        findings.append(_ambiguous(mistakes, others[0]))
    return findings


def _ambiguous(mistakes: Mistakes, rival: Mistakes) -> Finding:
    """Return the finding that two explanations fit equally well, with the options for each."""
    options = _options_of(mistakes)
    rival_options = _options_of(rival)
    # Both lists have the options of both hypotheses, with default values where necessary. So a user
    # who sets a list selects one hypothesis.
    first = options | defaults_of(
        name for name in rival_options if name not in options
    )
    second = rival_options | defaults_of(
        name for name in options if name not in rival_options
    )
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
    """Return code and stream (parent, child or both) of each mistake."""
    if mistakes.parent == mistakes.child:
        return [(mistakes.parent, "both")] if mistakes.parent else []
    sides = ((mistakes.parent, "parent"), (mistakes.child, "child"))
    return [(code, stream) for code, stream in sides if code]


def _check_agreement(fit: RoughFit) -> list[Finding]:
    """Return a finding if noise cannot explain the residuals of the best hypothesis."""
    rotation_share = fit.rotation_share
    position_share = fit.position_share
    ratio = fit.position_ratio
    are_too_large = (
        rotation_share > MAX_UNEXPLAINED
        or position_share > UNRELATED_UNEXPLAINED
    )
    are_beyond_noise = (
        position_share > SMALL_UNEXPLAINED and ratio > _MAX_POSITION_RATIO
    )
    if not (are_too_large or are_beyond_noise):
        return []
    contradict = (
        position_share > _CONTRADICTING_SHARE
        and ratio > _CONTRADICTING_POSITION_RATIO
    )
    if contradict or fit.unexplained_share > MAX_UNEXPLAINED:
        severity = Severity.ERROR
    elif fit.unexplained_share >= _DOUBTFUL_SHARE:
        severity = Severity.WARNING
    else:
        return []
    part = "rotations" if rotation_share > position_share else "positions"
    share = min(fit.unexplained_share, 1.0)
    return [
        finding("disagreeing_stops", severity=severity, part=part, share=share)
    ]


def _do_inliers_agree(sample: StopPoses, fit: RoughFit) -> bool:
    """Return whether the stops agree after the outliers are removed.

    ``fit`` is the rough fit of all stops. At least half of the stops must be inliers.
    """
    is_inlier = inliers_of(sample.without(fit.mistakes, fit.scale or 1.0))
    if 2 * is_inlier.sum() < len(sample):
        return False
    inliers = replace(
        sample, parent=sample.parent[is_inlier], child=sample.child[is_inlier]
    )
    return not _check_agreement(rough_fit(inliers, fit.mistakes))


# ------------------------------------------------------------------ axes


def _check_axes(sample: StopPoses, fit: RoughFit) -> Finding | None:
    """Return a finding if the positions of one side have permuted or flipped axes.

    Such axes must be clearly likelier than ``fit``, the best other hypothesis: in the rough fits,
    or after full solves. Strong noise can hide the difference in the rough fits.
    """
    if fit.unexplained_share < SMALL_UNEXPLAINED:
        return None
    likelier = [
        other
        for other in _fits_with_other_axes(sample)
        if other.fit.log_likelihood > fit.log_likelihood + MIN_LEAD
    ]
    if not likelier:
        return None
    best = max(likelier, key=lambda other: other.fit.log_likelihood)
    enough = min_certain_gain(len(sample))
    gain = best.fit.log_likelihood - fit.log_likelihood
    if gain <= enough:
        gain = _objective(sample, fit) - _objective(best.poses, best.fit)
    if gain <= enough:
        return None
    return finding("axes", best.stream, detail=_axes_in_words(best.axes))


class _OtherAxes(NamedTuple):
    """Stops after a change of the axes of one side's positions, with their rough fit.

    ``axes`` (3, 3) permutes and flips the axes of the positions of ``stream``.
    """

    stream: str
    axes: FloatArray
    poses: StopPoses
    fit: RoughFit


def _fits_with_other_axes(sample: StopPoses) -> Iterator[_OtherAxes]:
    """Yield the stops with changed axes of either side, if a rough fit explains most of them."""
    for is_inverse in sample.possible_inversions:
        mistakes = Mistakes(is_inverse=is_inverse)
        if rough_fit(sample, mistakes).rotation_share > MAX_UNEXPLAINED:
            continue
        for axes, stream in itertools.product(
            _other_axes(), ("child", "parent")
        ):
            Ts = getattr(sample, stream)
            turned = se3.from_rotation_translation(
                se3.rotation_of(Ts), se3.translation_of(Ts) @ axes.T
            )
            poses = sample.with_side(stream, turned)
            fit = rough_fit(poses, mistakes)
            if fit.unexplained_share < MAX_UNEXPLAINED:
                yield _OtherAxes(stream, axes, poses, fit)


def _other_axes() -> Iterator[FloatArray]:
    """Yield the 47 matrices (3, 3) that permute and flip axes; the identity is omitted."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            axes = np.diag(signs) @ np.eye(3)[list(order)]
            if not np.array_equal(axes, np.eye(3)):
                yield axes


def _axes_in_words(axes: FloatArray) -> str:
    """Return permuted and flipped axes in words, such as ``x -y z``."""
    names = []
    for row in axes:
        name = "xyz"[int(np.argmax(np.abs(row)))]
        names.append(name if row.sum() > 0 else f"-{name}")
    return " ".join(names)


# ------------------------------------------------------------------ lengths


def _with_units(
    sample: StopPoses, examination: Examination, is_scale_free: bool
) -> Examination:
    """Return the examination with findings or repairs of units, and with the remaining scale.

    The remaining scale is the rough factor of the child's lengths after both sides were converted
    to metres.
    """
    if not sample.has_positions:
        return examination
    scale = examination.scale
    of_parent = _unit_of_size(se3.translation_of(sample.parent))
    of_child = _unit_of_size(se3.translation_of(sample.child))
    if scale is not None:
        to_metres = scale * of_parent
        nearest = min(
            (1.0, *_UNITS), key=lambda unit: abs(np.log(to_metres / unit))
        )
        is_unit = abs(np.log(to_metres / nearest)) < np.log(_MAX_SIZE_FACTOR)
        of_child = nearest if is_unit else 1.0
        scale = to_metres / of_child
    units = []
    if of_parent != 1.0:
        units.append(_unit_finding("parent", "parent_scale", of_parent))
    if of_child != 1.0:
        units.append(_unit_finding("child", "scale", of_child))
    # Two vehicles may really be far apart, so large positions alone do not prove another unit.
    is_certain = sample.has_target or (len(units) == 1 and scale is not None)
    examination = replace(examination, scale=scale)
    if is_scale_free and of_child != 1.0:
        units.pop()
        examination = replace(examination, child_unit=of_child)
    if is_certain:
        return replace(examination, repairs=(*examination.repairs, *units))
    return replace(examination, findings=(*examination.findings, *units))


def _unit_finding(stream: str, option: str, unit: float) -> Finding:
    return finding(
        "stop_units", stream, options={option: unit}, unit=_UNITS[unit]
    )


def _unit_of_size(positions: FloatArray) -> float:
    """Return the factor from positions (N, 3) to metres. It is assumed from their spread."""
    if spread(positions) <= _MAX_SPREAD_M:
        return 1.0
    distance = median(np.linalg.norm(positions, axis=1))
    return _CENTIMETRE if distance < _MAX_DISTANCE_CM else _MILLIMETRE
