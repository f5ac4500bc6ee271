"""Check whether two streams can be of sensors on one rigid body, and name their fault if not.

1. Check each stream alone (:mod:`~hand_eye_calib.core.checks.streams`).
2. Correlate the angular rates (:mod:`~hand_eye_calib.core.alignment.time_offset`): do they agree at
   any clock offset? Reordered or inverted quaternions, units and axes do not change angular rates.
3. Fit the whole motion (:mod:`~hand_eye_calib.core.checks.hypotheses`): without which usual mistake
   do the streams agree?
4. Under the hypothesis that holds, check the clock offset, the scale, and the directions that the
   motion does not excite.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.alignment import similarity, time_offset
from hand_eye_calib.core.alignment.similarity import SimilarityFit
from hand_eye_calib.core.alignment.time_offset import Correlation, TimeOffset
from hand_eye_calib.core.assessment.covariance import hidden_axes, lever_arm_products
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.base.text import axes_in_words, with_sigma
from hand_eye_calib.core.checks import agreement, hypotheses, independence, misread
from hand_eye_calib.core.checks.agreement import Known
from hand_eye_calib.core.checks.findings import LIMITS, Finding, finding, graded, gravest_first
from hand_eye_calib.core.checks.hypotheses import Explanation, Readings, StreamPair
from hand_eye_calib.core.checks.streams import (
    check_flat,
    check_frozen,
    check_lengths,
    check_positions,
    check_stream,
    is_too_fast,
    is_too_slow,
)
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs, PosePairs, pairs_over

# Accuracy of the coarse clock offset of slow streams, in intervals between poses.
_COARSE = 0.5
# Longest gap to interpolate across if the clocks of slow streams differ by more, in intervals.
_SLOW_GAP = 1.5

_UNITS = {1e-3: "millimetres", 1e-2: "centimetres", 0.0254: "inches", 0.3048: "feet"}

# Distance of a scale from a unit that still is the unit, in standard deviations of the scale.
UNIT_SIGMAS = 3.0
# The same for a scale without noise, as a share.
_UNIT_ROUNDING = 1e-6
# Distance of a scale from a parent's unit that is still that unit (share). Noise of the child
# biases the scale: by 0.2 % for simulated arms, several standard deviations.
_PARENT_UNIT_SHARE = 0.005
# A scale this close to a unit may be that of a unit and an odometry with a scale error (share).
_UNIT_NEAR = 0.05

# Standard deviations to subtract from a lever arm for its least length.
_LEVER_ARM_SIGMAS = 3.0

# Code of rounded positions, whose severity depends on the unit of length.
_ROUNDED = "coarse_positions"

# Most motions for the checks of the response.
_MAX_MOTIONS = 1500

# Shortest duration of a live session before its streams are checked.
MIN_DURATION_S = 20.0
# Smallest rotation before that.
MIN_ROTATION_RAD = float(np.radians(30.0))


@dataclass(frozen=True)
class CheckResult:
    """Result of the stream checks.

    Attributes
    ----------
    findings : tuple of Finding
        The gravest first.
    fit : SimilarityFit or None
        The fit under the hypothesis that holds; None if no hypothesis holds.
    offset : TimeOffset or None
        Clock offset beyond the known one; None if no hypothesis holds.
    readings : Readings or None
        Two readings of the streams that fit alike, if the reading of the findings may be wrong. The
        other reading also inverts both streams.
    """

    findings: tuple[Finding, ...]
    fit: SimilarityFit | None = None
    offset: TimeOffset | None = None
    readings: Readings | None = None


def check_streams(
    parent: Trajectory,
    child: Trajectory,
    time_offset_s: float = 0.0,
    scale: float = 1.0,
    max_gap_s: float = CalibratorConfig.max_gap,
    correlate: Callable[[], Correlation] | None = None,
    known: Known | None = None,
    are_exact: bool = False,
) -> CheckResult:
    """Check two streams.

    Parameters
    ----------
    parent, child : Trajectory
    time_offset_s, scale : float
        Known seconds to add to the child's stamps, and known factor of its lengths.
    max_gap_s : float
        Longest time between two poses that interpolation may bridge, in seconds.
    correlate : callable, optional
        Correlates the angular rates of the streams as they are. Called only if needed.
    known : ((4, 4) array, (6,) array), optional
        An extrinsic of these streams, and its standard deviations.
    are_exact : bool
        Whether the user called both streams exact. Exact streams need not drift apart.
    """
    given = StreamPair(parent, child.scaled(scale), max_gap_s)
    findings = check_stream(given.parent, "parent", max_gap_s)
    findings += check_stream(given.child, "child", max_gap_s)
    # Rounded positions are judged later, when the unit of length is known.
    if any(found.makes_unusable for found in findings if found.code != _ROUNDED):
        return CheckResult(gravest_first(findings))
    streams = given.shifted(time_offset_s)
    explanation = None
    at = TimeOffset()
    if known and not streams.is_slow:
        explanation, at = _as_they_are(streams, known[0])
    if not explanation:
        correlation = (correlate or given.correlate)()
        times = correlation.ratio
        turns = graded("turns", "child", float(np.log(times)), times=times)
        if turns and 1.0 - correlation.correlation < hypotheses.HOLDS:
            return CheckResult(gravest_first([*findings, turns]))
        from_known = replace(correlation, offset_s=correlation.offset_s - time_offset_s)
        if streams.is_slow:
            streams, from_known = _of_slow(given, streams, time_offset_s, correlation)
        if not correlation.is_clear:
            # Short recordings may not show the offset, and yet the streams agree at the given one.
            from_known = replace(from_known, offset_s=0.0)
        at = TimeOffset(from_known.offset_s, correlation=from_known)
    aligned = streams.shifted(at.seconds)
    frozen = check_frozen(aligned.parent, aligned.child)
    findings += frozen
    of_parts = check_flat(aligned.parent, aligned.child)
    of_parts = of_parts or agreement.check_parts(aligned.synchronised)
    if of_parts:
        return CheckResult(gravest_first([*findings, *of_parts]))
    if not explanation:
        explanation, found = _explained_or_misread(streams, aligned, at, known, frozen)
        findings += found
    if not explanation:
        return CheckResult(gravest_first(findings))
    about = _Given(known, scale, time_offset_s, are_exact)
    return _check_explained(given, streams, explanation, at, findings, about)


class _Given(NamedTuple):
    """Arguments of :func:`check_streams` beside the streams."""

    known: Known | None
    scale: float
    time_offset_s: float
    are_exact: bool


def _check_explained(
    given: StreamPair,
    streams: StreamPair,
    explanation: Explanation,
    at: TimeOffset,
    findings: list[Finding],
    about: _Given,
) -> CheckResult:
    """Check streams that a hypothesis explains.

    ``streams`` have the known time offset; ``findings`` are those of the checks before.
    """
    right = explanation.hypothesis.undo(streams)
    offset = _fine_offset(right, at, explanation.fit)
    right = right.shifted(offset.seconds)
    sizes, fit = _check_sizes(right, explanation, offset.fit, about.scale)
    lengths = check_lengths(
        right.parent, right.child, least_lever_arm(fit.T_parent_child, fit.sigmas[:3])
    )
    # Both streams may be inverse, or neither: both readings fit, and the check cannot decide.
    of_reading = explanation.findings if explanation.may_be_upright else ()
    readings = explanation.readings
    if of_reading and lengths:
        # If both are inverse, the distance of the sensors is that of the worlds: judge the lengths
        # of the streams as they are.
        lengths = check_lengths(streams.parent, streams.child)
    if readings and lengths:
        # Noise and shape decide between the readings only if the unit of length is known.
        readings = None
        findings = [found for found in findings if found not in of_reading]
    findings = _in_metres(findings, [*lengths, *sizes], about.scale)
    is_sound = not any(found.makes_unusable for found in findings if found not in of_reading)
    findings += [*lengths, *check_offset(offset, about.time_offset_s), *sizes]
    if is_sound and not lengths:
        if about.known and explanation.may_be_upright and not explanation.hypothesis.is_upright:
            right = streams.shifted(offset.seconds)
            motions = _motions(right.synchronised, hypotheses.MAX_PAIRS)
            fit = similarity.fit_similarity(motions, start=about.known[0])
        offset_s = about.time_offset_s + offset.seconds
        is_one_axis = any(found.code == "one_axis" for found in sizes)
        findings += _check_agreeing(right, given, fit, about, offset_s, is_one_axis)
    return CheckResult(gravest_first(findings), explanation.fit, offset, readings)


def least_lever_arm(T_parent_child: FloatArray, sigmas: FloatArray) -> float:
    """Return the length (m) that a lever arm has at least, within its uncertainty.

    Parameters
    ----------
    T_parent_child : (4, 4) array
    sigmas : (3,) array
        Standard deviations of its translation, m.
    """
    sizes = np.abs(se3.translation_of(T_parent_child)) - _LEVER_ARM_SIGMAS * sigmas
    return float(np.linalg.norm(np.clip(np.nan_to_num(sizes, neginf=0.0), 0.0, None)))


def _in_metres(
    findings: Sequence[Finding], units: Sequence[Finding], scale: float
) -> list[Finding]:
    """Return the findings with steps of positions in metres.

    Parameters
    ----------
    findings : sequence of Finding
        The child's lengths were multiplied by ``scale``.
    units : sequence of Finding
        Findings about the unit of a stream's lengths.
    scale : float
        Known factor of the child's lengths.
    """
    options: dict[str, Any] = {}
    for unit in units:
        if unit.code in ("units", "lengths"):
            options.update(unit.options)
    factors = {
        "parent": float(options.get("parent_scale", 1.0)),
        "child": float(options.get("scale", scale)) / scale,
    }
    right: list[Finding] = []
    for found in findings:
        if found.code != _ROUNDED:
            right.append(found)
            continue
        step_m = found.evidence["step_m"] * factors[found.stream]
        if coarse := graded(_ROUNDED, found.stream, step_m, step_m=step_m):
            right.append(coarse)
    return right


def _as_they_are(streams: StreamPair, X: FloatArray) -> tuple[Explanation | None, TimeOffset]:
    """Return the fit from a known extrinsic X, and the clock offset with it.

    The explanation is None unless the streams clearly agree as they are, in one unit and on about
    one clock.
    """
    least_s = LIMITS["time_offset"].note
    grave_s = LIMITS["time_offset"].error
    lag_s = hypotheses.LAGS_S[1]
    # One step of refinement suffices if the offset is below half of the size that is reported.
    given = streams.parent, streams.child, TimeOffset(), streams.max_gap_s, 2.0 * least_s
    offset = time_offset.offset_over(lag_s, *given, X, hypotheses.HOLDS)
    fit = offset.fit
    left_s = offset.largest_s(streams.child.duration_s)
    explains = fit and fit.is_in_one_unit and fit.unexplained < similarity.EXPLAINED
    if fit and explains and left_s < grave_s:
        shifted = streams.shifted(offset.seconds)
        found = hypotheses.attributed(Explanation(hypotheses.PLAIN, fit), shifted, lag_s)
        if not found.findings:
            return found, offset
    return None, TimeOffset()


def _fine_offset(right: StreamPair, at: TimeOffset, fit: SimilarityFit) -> TimeOffset:
    """Return the remaining clock offset of streams that agree by a fit."""
    least_s = LIMITS["time_offset"].note
    if at.fit and at.largest_s(right.child.duration_s) < least_s:
        return at
    if right.is_slow:
        return TimeOffset(at.seconds, right.interval_s, at.correlation)
    at = replace(at, fit=at.fit or fit)
    return time_offset.refine_time_offset(right.parent, right.child, at, right.max_gap_s, least_s)


def _of_slow(
    streams: StreamPair, moved: StreamPair, known_s: float, correlation: Correlation
) -> tuple[StreamPair, Correlation]:
    """Return slow streams on one clock, and the correlation of their angular rates.

    Poses of slow streams are too far apart to interpolate. The streams as they are, or ``moved`` by
    the known offset, serve if they have common stamps and the coarse offset agrees with that.
    """
    for at_s, found in ((known_s, moved), (0.0, streams)):
        is_near = abs(correlation.offset_s - at_s) < _COARSE * streams.interval_s
        if len(found.synchronised) > hypotheses.MIN_PAIRS and (is_near or not correlation.is_clear):
            return found, replace(correlation, offset_s=0.0)
    from_known = replace(correlation, offset_s=correlation.offset_s - known_s)
    return replace(moved, max_gap_s=_SLOW_GAP * streams.interval_s), from_known


def _explained_or_misread(
    given: StreamPair,
    aligned: StreamPair,
    at: TimeOffset,
    known: Known | None,
    frozen: Sequence[Finding],
) -> tuple[Explanation | None, list[Finding]]:
    """Return the explanation that holds, or None, and the findings about misread streams.

    ``given`` has the known clock offset, ``aligned`` the whole one.
    """
    start = known[0] if known else None
    is_frozen = any(found.makes_unusable for found in frozen)
    if found := misread.earth_centred(aligned):
        return None, found
    explanation, found = _explained(aligned, at.correlation, start, is_frozen)
    if not explanation:
        found = misread.misreadings(given, aligned) or found
    return explanation, found


def _explained(
    streams: StreamPair,
    correlation: Correlation,
    start: FloatArray | None,
    is_frozen: bool,
) -> tuple[Explanation | None, list[Finding]]:
    """Return the explanation that holds, or None, and the findings about the streams."""
    try:
        explanation = hypotheses.explain(streams, correlation.is_clear, start)
    except NotEnoughDataError as error:
        if correlation.is_clear:
            return None, [finding("too_short", reason=str(error))]
    else:
        if explanation.holds:
            return explanation, [*explanation.findings]
        if correlation.is_clear:
            pairs = streams.synchronised
            found = agreement.check_coordinates(pairs, _motions(pairs, _MAX_MOTIONS))
            return None, found or [*explanation.findings]
    # The angular rates of a frozen stream are no evidence.
    if is_frozen:
        return None, []
    if correlation.variation < time_offset.MIN_VARIATION:
        return None, [finding("no_turning")]
    return None, [finding("unrelated", doubt=correlation.doubt())]


def _check_sizes(
    streams: StreamPair, explanation: Explanation, timed: SimilarityFit | None, known_scale: float
) -> tuple[list[Finding], SimilarityFit]:
    """Return findings about scale and hidden axes of streams that agree, and the fit with scale.

    ``timed`` is the fit with the time offset. The child's lengths in ``streams`` are those of its
    source times ``known_scale``.
    """
    pose_pairs = streams.synchronised
    motions = _motions(pose_pairs, hypotheses.MAX_PAIRS)
    fit = explanation.fit
    chords = se3.rotation_of(motions.Ts_parenti_parentj) - np.eye(3)
    hidden = hidden_axes(lever_arm_products(chords), fit.sigma_rotation**2 * np.eye(3))
    findings: list[Finding | None] = [unseen(hidden)] if hidden else []
    if not (explanation.same_unit or fit.is_in_one_unit):
        with suppress(NotEnoughDataError):
            fits_of_scale = [each for each in (fit, timed) if each and each.scale_sigma > 0.0]
            fit = similarity.estimate_scale(pose_pairs, fits_of_scale)
            if fit.has_own_unit:
                findings.append(_own_unit(streams, fit, known_scale))
    return [*filter(None, findings)], fit


def _own_unit(streams: StreamPair, fit: SimilarityFit, known_scale: float) -> Finding | None:
    """Return the finding about a child in another unit of length, or else of another scale."""
    child_as_given = streams.child.scaled(1.0 / known_scale)
    sigma_and_bias = float(np.hypot(fit.scale_sigma, fit.scale_bias))
    unit = in_other_units(fit.scale, sigma_and_bias, streams.parent, child_as_given, known_scale)
    if unit:
        return unit
    total_scale = known_scale * fit.scale
    return graded(
        "scale",
        "child",
        fit.scale - 1.0,
        scale=total_scale,
        sigma=known_scale * fit.scale_sigma,
        options={"scale": float(f"{total_scale:.4g}")},
    )


def _check_agreeing(
    right: StreamPair,
    given: StreamPair,
    fit: SimilarityFit,
    about: _Given,
    offset_s: float,
    is_one_axis: bool,
) -> list[Finding]:
    """Return the findings about streams that agree: copies, faults that bias X, and fusion.

    ``right`` are the corrected streams on one clock, ``given`` the streams as they were given.
    """
    of_fit = fit.T_parent_child, fit.sigmas[:6]
    best = min(filter(None, (of_fit, about.known)), key=lambda extrinsic: extrinsic[1][:3].max())
    if copied := independence.check_copies(given, right, about.are_exact):
        return [*copied, *agreement.check_same(*best)]
    pose_pairs = right.synchronised.child_scaled(fit.scale)
    motions = _motions(pose_pairs, _MAX_MOTIONS)
    findings = agreement.check_agreement(pose_pairs, motions, fit.T_parent_child, best, offset_s)
    if findings or about.are_exact:
        return findings
    return independence.check_fusion(pose_pairs, best[0], is_one_axis)


def check_parts(
    parent: Trajectory, child: Trajectory, max_gap_s: float, lever_arm_m: float = 0.0
) -> list[Finding]:
    """Check two streams on one clock of which at least one has no full poses.

    The findings need no solve. ``lever_arm_m`` is the smallest distance of the sensors (m) by a
    solve; 0 without one.
    """
    if not (parent.has_positions and child.has_positions):
        parent = parent.scaled(0.0)
        child = child.scaled(0.0)
    findings = check_positions(parent, "parent", max_gap_s)
    findings += check_positions(child, "child", max_gap_s)
    # Rounded positions stay the same while the sensor moves.
    if any(each.makes_unusable or each.code == _ROUNDED for each in findings):
        return findings
    lengths = check_lengths(parent, child, lever_arm_m)
    return [*findings, *lengths, *check_frozen(parent, child)]


def can_check(parent: Trajectory, child: Trajectory) -> bool:
    """Return whether two streams of a live session are long enough and rotate enough to check."""
    return min(stream.duration_s for stream in (parent, child)) >= MIN_DURATION_S and any(
        se3.rotation_angle(stream.poses[0, :3, :3].T @ se3.rotation_of(stream.poses)).max()
        >= MIN_ROTATION_RAD
        for stream in (parent, child)
    )


def check_offset(found: TimeOffset, known_s: float) -> list[Finding]:
    """Return the finding about a clock offset beyond ``known_s`` (added before), or none."""
    values = offset_values(found.seconds, known_s) | {"sigma_s": found.sigma_s}
    values["beyond"] = f" beyond the {known_s:.4f} s that were added" if known_s else ""
    values["options"] = {"time_offset": values["total_s"]}
    offset = graded("time_offset", "child", found.seconds, found.sigma_s, **values)
    return [offset] if offset else []


def offset_values(offset_s: float, known_s: float = 0.0) -> dict[str, Any]:
    """Return the values of a finding about the child's clock: ``offset_s`` beyond ``known_s``."""
    values: dict[str, Any] = {"offset_s": offset_s, "size_s": abs(offset_s)}
    values["direction"] = "behind" if offset_s > 0 else "ahead of"
    return values | {"total_s": round(known_s + offset_s, 4)}


def check_model_scale(scale: float, sigma: float) -> list[Finding]:
    """Return a finding about a scale that nobody asked for and the noise model estimated.

    Parameters
    ----------
    scale, sigma : float
        Factor of the child's lengths, and its standard deviation; 0 if it was not estimated.
    """
    if sigma <= 0.0:
        return []
    longer = 1.0 / scale - 1.0
    of_longer = sigma / scale**2
    found = graded(
        "model_scale",
        "child",
        longer,
        of_longer,
        scale=scale,
        sigma=sigma,
        size=with_sigma(100.0 * abs(longer), 100.0 * of_longer, 1),
        than="longer" if longer > 0.0 else "shorter",
    )
    return [found] if found else []


def in_other_units(
    scale: float, sigma: float, parent: Trajectory, child: Trajectory, known: float = 1.0
) -> Finding | None:
    """Return the finding that a stream's lengths are in another unit, or None.

    Below 1, a scale within three standard deviations of a unit says that the child is in that unit;
    any other is a scale of the child. Above 1 the ratio has two explanations: the parent is in that
    unit, or the child has a scale of its own, as that of a single camera. A ratio alone never
    changes the parent. The motion decides: a parent that would be too fast in metres is in that
    unit, a child that would hardly move in metres has a scale of its own. Where both are plausible
    in metres, the finding names both explanations. The result is not to be used within three
    standard deviations or 0.5 % of a unit, and with care within 5 %. Two streams in one wrong unit
    have no ratio; :func:`~hand_eye_calib.core.checks.streams.check_lengths` asks about them.

    Parameters
    ----------
    scale, sigma : float
        Factor of the child's lengths beside the known one, and its standard deviation.
    parent, child : Trajectory
        As they are given, without the known scale.
    known : float
        The known factor. The solve may have found a known factor near 1 itself.
    """
    # Of a factor that the solve found, the total is what the streams have.
    totals = (scale * known, scale) if 0.5 < known < 2.0 else (scale,)
    for total in totals:
        values: dict[str, Any] = {"scale": total, "sigma": sigma * total / scale}
        unit, is_exact = _unit_of(total, values["sigma"])
        if unit and total > 1.0:
            return _parent_or_child(unit, is_exact, values, parent, child)
        if unit and is_exact:
            options = {"scale": round(unit * known * scale / total, 9)}
            values |= {"other": "parent", "unit": _UNITS[unit]}
            return finding("units", "child", options=options, **values)
    return None


def _unit_of(total: float, sigma: float) -> tuple[float, bool]:
    """Return the unit (m) whose factor, or whose inverse if it is above 1, is near this scale, or
    0; and whether the scale is that of the unit within its standard deviation.
    """
    for unit in _UNITS:
        factor = unit if total < 1.0 else 1.0 / unit
        off = abs(total - factor)
        share = _UNIT_ROUNDING if total < 1.0 else _PARENT_UNIT_SHARE
        is_exact = off <= max(UNIT_SIGMAS * sigma, share * factor)
        if is_exact or off <= _UNIT_NEAR * factor:
            return unit, is_exact
    return 0.0, False


def _parent_or_child(
    unit: float, is_exact: bool, values: dict[str, Any], parent: Trajectory, child: Trajectory
) -> Finding | None:
    """The finding about a child whose lengths are shorter than the parent's by a unit (m); None if
    it has a scale of its own.
    """
    if is_too_fast(parent) and not is_too_fast(child):
        options = {"parent_scale": unit}
        values |= {"other": "child", "unit": _UNITS[unit]}
        return finding("units", "parent", options=options, **values)
    if is_too_slow(child) and not is_too_slow(parent):
        return None
    options = {"scale": float(f"{values['scale']:.4g}")}
    values |= {"unit": _UNITS[unit], "factor": unit, "is_exact": is_exact}
    return finding("unit_or_scale", "parent", options=options, **values)


def _motions(pose_pairs: PosePairs, most: int) -> MotionPairs:
    """Return motions over the first lag with enough motions."""
    motions = (pairs_over(pose_pairs, lag_s, most) for lag_s in hypotheses.LAGS_S)
    # There is such a lag: streams that agree were fitted over it.
    return next(pairs for pairs in motions if len(pairs) >= hypotheses.MIN_PAIRS)


def unseen(axes: Sequence[str]) -> Finding:
    """Return the note that a motion does not determine these axes."""
    options = {f"prior.{axis}": "VALUE+/-SIGMA" for axis in axes}
    it = "it" if len(axes) == 1 else "them"
    return finding("one_axis", options=options, axes=axes_in_words(axes), it=it)
