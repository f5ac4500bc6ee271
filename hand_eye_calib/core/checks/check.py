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
from hand_eye_calib.core.alignment.rate_correlation import MIN_VARIATION, Correlation
from hand_eye_calib.core.alignment.similarity import SimilarityFit
from hand_eye_calib.core.alignment.time_offset import TimeOffset
from hand_eye_calib.core.assessment.covariance import hidden_axes, lever_arm_products
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.base.text import axes_in_words, with_sigma
from hand_eye_calib.core.checks import agreement, hypotheses, independence, misread
from hand_eye_calib.core.checks.agreement import Known
from hand_eye_calib.core.checks.findings import LIMITS, Finding, finding, graded, gravest_first
from hand_eye_calib.core.checks.hypotheses import Explanation, Readings
from hand_eye_calib.core.checks.stream_pair import LAGS_S, MAX_PAIRS, MIN_PAIRS, StreamPair
from hand_eye_calib.core.checks.streams import (
    check_flat,
    check_frozen,
    check_lengths,
    check_positions,
    check_stream,
)
from hand_eye_calib.core.checks.units import in_other_units
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs, PosePairs, pairs_over

# Accuracy of the coarse clock offset of slow streams, in intervals between poses.
_COARSE = 0.5
# Longest gap to interpolate across if the clocks of slow streams differ by more, in intervals.
_SLOW_GAP = 1.5

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
    if _are_unusable([found for found in findings if found.code != _ROUNDED]):
        return CheckResult(gravest_first(findings))
    streams = given.shifted(time_offset_s)
    explanation = None
    offset = TimeOffset()
    if known and not streams.is_slow:
        explanation, offset = _as_they_are(streams, known[0])
    if not explanation:
        correlation = (correlate or given.correlate)()
        if factor := _factor_of_angles(correlation):
            return CheckResult(gravest_first([*findings, factor]))
        streams, offset = _coarse_offset(given, streams, time_offset_s, correlation)
    aligned = streams.shifted(offset.seconds)
    frozen = check_frozen(aligned.parent, aligned.child)
    findings += frozen
    incomplete = check_flat(aligned.parent, aligned.child)
    incomplete = incomplete or agreement.check_parts(aligned.synchronised)
    if incomplete:
        return CheckResult(gravest_first([*findings, *incomplete]))
    if not explanation:
        is_frozen = _are_unusable(frozen)
        explanation, mistakes = _explained_or_misread(streams, aligned, offset, known, is_frozen)
        findings += mistakes
    if not explanation:
        return CheckResult(gravest_first(findings))
    arguments = _Arguments(given, known, scale, time_offset_s, are_exact)
    return _check_explained(streams, explanation, offset, findings, arguments)


class _Arguments(NamedTuple):
    """Arguments of :func:`check_streams`: the streams in ``given``, the child with its scale."""

    given: StreamPair
    known: Known | None
    scale: float
    time_offset_s: float
    are_exact: bool


def _are_unusable(findings: Sequence[Finding]) -> bool:
    """Return whether a finding makes the result unusable."""
    return any(found.makes_unusable for found in findings)


def _factor_of_angles(correlation: Correlation) -> Finding | None:
    """Return the finding that all rotations of the child have another size, or None."""
    times = correlation.ratio
    factor = graded("turns", "child", float(np.log(times)), times=times)
    return factor if 1.0 - correlation.correlation < hypotheses.HOLDS else None


def _coarse_offset(
    given: StreamPair, streams: StreamPair, known_s: float, correlation: Correlation
) -> tuple[StreamPair, TimeOffset]:
    """Return streams to compare, and the clock offset between them by their angular rates.

    Parameters
    ----------
    given, streams : StreamPair
        The streams as they are, and with the known offset.
    known_s : float
        Known offset of the child's clock, s.
    correlation : Correlation
        Correlation of the angular rates of the streams as they are.
    """
    if streams.is_slow:
        streams, from_known = _of_slow(given, streams, known_s, correlation)
    else:
        from_known = replace(correlation, offset_s=correlation.offset_s - known_s)
    if not correlation.is_clear:
        # Short recordings may not show the offset, and yet the streams agree at the known one.
        from_known = replace(from_known, offset_s=0.0)
    return streams, TimeOffset(from_known.offset_s, correlation=from_known)


def _check_explained(
    streams: StreamPair,
    explanation: Explanation,
    at: TimeOffset,
    findings: list[Finding],
    arguments: _Arguments,
) -> CheckResult:
    """Check streams that a hypothesis explains.

    Parameters
    ----------
    streams : StreamPair
        Streams with the known clock offset.
    explanation : Explanation
    at : TimeOffset
        Coarse clock offset beyond the known one.
    findings : list of Finding
        Findings of the checks before.
    arguments : _Arguments
    """
    right = explanation.hypothesis.undo(streams)
    offset = _fine_offset(right, at, explanation.fit)
    right = right.shifted(offset.seconds)
    sizes, fit = _check_sizes(right, explanation, offset.fit, arguments.scale)
    lengths = _lengths_of_explained(streams, right, fit, explanation)
    # Findings of an unclear reading: both streams may be inverse, or neither may be.
    of_reading = explanation.findings if explanation.may_be_uninverted else ()
    readings = explanation.readings
    if readings and lengths:
        # Noise and shape decide between the readings only if the unit of length is known.
        readings = None
        findings = [found for found in findings if found not in of_reading]
    findings = _in_metres(findings, [*lengths, *sizes], arguments.scale)
    is_sound = not _are_unusable([found for found in findings if found not in of_reading])
    findings += [*lengths, *check_offset(offset, arguments.time_offset_s), *sizes]
    if is_sound and not lengths:
        right, fit = _preferred_reading(streams, right, explanation, fit, offset, arguments.known)
        is_one_axis = any(found.code == "one_axis" for found in sizes)
        findings += _check_agreeing(right, fit, offset, is_one_axis, arguments)
    return CheckResult(gravest_first(findings), explanation.fit, offset, readings)


def _lengths_of_explained(
    streams: StreamPair, right: StreamPair, fit: SimilarityFit, explanation: Explanation
) -> list[Finding]:
    """Return the finding about lengths that no vehicle has, or none.

    ``right`` are the corrected streams, ``fit`` is their fit.
    """
    lever_arm_m = least_lever_arm(fit.T_parent_child, fit.sigmas[:3])
    lengths = check_lengths(right.parent, right.child, lever_arm_m)
    if lengths and explanation.may_be_uninverted and explanation.findings:
        # If both streams are inverse, the lever arm is the distance of the worlds. The streams as
        # they are are judged without it.
        return check_lengths(streams.parent, streams.child)
    return lengths


def _preferred_reading(
    streams: StreamPair,
    right: StreamPair,
    explanation: Explanation,
    fit: SimilarityFit,
    offset: TimeOffset,
    known: Known | None,
) -> tuple[StreamPair, SimilarityFit]:
    """Return the streams in the reading of a known extrinsic, and their fit.

    The streams ``right`` and ``fit`` are returned if only one reading is possible, or if the
    explanation has the reading of the known extrinsic: the streams as they are.
    """
    has_other_reading = explanation.may_be_uninverted and not explanation.hypothesis.is_uninverted
    if not known or not has_other_reading:
        return right, fit
    uninverted = streams.shifted(offset.seconds)
    motions = _motions(uninverted.synchronised, MAX_PAIRS)
    return uninverted, similarity.fit_similarity(motions, start=known[0])


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
        Findings about streams with the child's lengths multiplied by ``scale``.
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
    in_metres: list[Finding] = []
    for former in findings:
        if former.code != _ROUNDED:
            in_metres.append(former)
            continue
        step_m = former.evidence["step_m"] * factors[former.stream]
        if coarse := graded(_ROUNDED, former.stream, step_m, step_m=step_m):
            in_metres.append(coarse)
    return in_metres


def _as_they_are(streams: StreamPair, X: FloatArray) -> tuple[Explanation | None, TimeOffset]:
    """Return the fit from a known extrinsic X, and the clock offset with it.

    The explanation is None unless the streams clearly agree as they are, in one unit and on about
    one clock.
    """
    least_s = LIMITS["time_offset"].note
    grave_s = LIMITS["time_offset"].error
    lag_s = LAGS_S[1]
    offset = time_offset.offset_over(
        lag_s,
        streams.parent,
        streams.child,
        TimeOffset(),
        streams.max_gap_s,
        # One step of refinement suffices if the offset is below half of the size that is reported.
        2.0 * least_s,
        X,
        hypotheses.HOLDS,
    )
    fit = offset.fit
    if fit is None or not fit.is_in_one_unit or fit.unexplained >= similarity.EXPLAINED:
        return None, TimeOffset()
    if offset.largest_s(streams.child.duration_s) >= grave_s:
        return None, TimeOffset()
    shifted = streams.shifted(offset.seconds)
    explanation = hypotheses.attributed(Explanation(hypotheses.PLAIN, fit), shifted, lag_s)
    if explanation.findings:
        return None, TimeOffset()
    return explanation, offset


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
    the known offset, are used if they have common stamps and the coarse offset agrees with that.
    """
    for offset_s, candidate in ((known_s, moved), (0.0, streams)):
        if len(candidate.synchronised) <= MIN_PAIRS:
            continue
        is_near = abs(correlation.offset_s - offset_s) < _COARSE * streams.interval_s
        if is_near or not correlation.is_clear:
            return candidate, replace(correlation, offset_s=0.0)
    from_known = replace(correlation, offset_s=correlation.offset_s - known_s)
    return replace(moved, max_gap_s=_SLOW_GAP * streams.interval_s), from_known


def _explained_or_misread(
    streams: StreamPair,
    aligned: StreamPair,
    at: TimeOffset,
    known: Known | None,
    is_frozen: bool,
) -> tuple[Explanation | None, list[Finding]]:
    """Return the explanation that holds, or None, and the findings about misread streams.

    ``streams`` have the known clock offset, ``aligned`` the whole one.
    """
    start = known[0] if known else None
    misread_positions = misread.earth_centred(aligned)
    if misread_positions:
        return None, misread_positions
    explanation, findings = _explained(aligned, at.correlation, start, is_frozen)
    if not explanation:
        findings = misread.misreadings(streams, aligned) or findings
    return explanation, findings


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
            coordinates = agreement.check_coordinates(pairs, _motions(pairs, _MAX_MOTIONS))
            return None, coordinates or [*explanation.findings]
    # The angular rates of a frozen stream are no evidence.
    if is_frozen:
        return None, []
    if correlation.variation < MIN_VARIATION:
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
    motions = _motions(pose_pairs, MAX_PAIRS)
    fit = explanation.fit
    chords = se3.rotation_of(motions.Ts_parenti_parentj) - np.eye(3)
    hidden = hidden_axes(lever_arm_products(chords), fit.sigma_rotation**2 * np.eye(3))
    findings = [unseen(hidden)] if hidden else []
    if explanation.same_unit or fit.is_in_one_unit:
        return findings, fit
    fits_of_scale = [fit]
    if timed:
        fits_of_scale.append(timed)
    fits_of_scale = [candidate for candidate in fits_of_scale if candidate.scale_sigma > 0.0]
    with suppress(NotEnoughDataError):
        fit = similarity.estimate_scale(pose_pairs, fits_of_scale)
        own_unit = _own_unit(streams, fit, known_scale) if fit.has_own_unit else None
        if own_unit:
            findings.append(own_unit)
    return findings, fit


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
    fit: SimilarityFit,
    offset: TimeOffset,
    is_one_axis: bool,
    arguments: _Arguments,
) -> list[Finding]:
    """Return the findings about streams that agree: copies, faults that bias X, and fusion.

    ``right`` are the corrected streams on one clock. ``is_one_axis`` says that all rotation is
    about one axis.
    """
    fitted = fit.T_parent_child, fit.sigmas[:6]
    extrinsics = [fitted, arguments.known] if arguments.known else [fitted]
    best = min(extrinsics, key=lambda extrinsic: extrinsic[1][:3].max())
    copied = independence.check_copies(arguments.given, right, arguments.are_exact)
    if copied:
        return [*copied, *agreement.check_same(*best)]
    pose_pairs = right.synchronised.child_scaled(fit.scale)
    motions = _motions(pose_pairs, _MAX_MOTIONS)
    offset_s = arguments.time_offset_s + offset.seconds
    findings = agreement.check_agreement(pose_pairs, motions, fit.T_parent_child, best, offset_s)
    if findings or arguments.are_exact:
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
    is_rounded = any(found.code == _ROUNDED for found in findings)
    if is_rounded or _are_unusable(findings):
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


def check_offset(offset: TimeOffset, known_s: float) -> list[Finding]:
    """Return the finding about a clock offset beyond ``known_s`` (added before), or none."""
    values = offset_values(offset.seconds, known_s) | {"sigma_s": offset.sigma_s}
    values["beyond"] = f" beyond the {known_s:.4f} s that were added" if known_s else ""
    values["options"] = {"time_offset": values["total_s"]}
    clocks_differ = graded("time_offset", "child", offset.seconds, offset.sigma_s, **values)
    return [clocks_differ] if clocks_differ else []


def offset_values(offset_s: float, known_s: float = 0.0) -> dict[str, Any]:
    """Return the values of the finding about a clock offset ``offset_s`` beyond ``known_s``."""
    values: dict[str, Any] = {"offset_s": offset_s, "size_s": abs(offset_s)}
    values["direction"] = "behind" if offset_s > 0 else "ahead of"
    return values | {"total_s": round(known_s + offset_s, 4)}


def check_model_scale(scale: float, sigma: float) -> list[Finding]:
    """Return the finding about a scale that the noise model added to the solution, or none.

    Parameters
    ----------
    scale, sigma : float
        Factor of the child's lengths, and its standard deviation. A standard deviation of 0 means
        that the scale was not estimated.
    """
    if sigma <= 0.0:
        return []
    excess = 1.0 / scale - 1.0
    sigma_excess = sigma / scale**2
    other_scale = graded(
        "model_scale",
        "child",
        excess,
        sigma_excess,
        scale=scale,
        sigma=sigma,
        size=with_sigma(100.0 * abs(excess), 100.0 * sigma_excess, 1),
        than="longer" if excess > 0.0 else "shorter",
    )
    return [other_scale] if other_scale else []


def _motions(pose_pairs: PosePairs, most: int) -> MotionPairs:
    """Return at most ``most`` motions over the first lag with enough motions."""
    motions = (pairs_over(pose_pairs, lag_s, most) for lag_s in LAGS_S)
    # Streams that agree were fitted over the first lag with enough motions, so it exists.
    return next(pairs for pairs in motions if len(pairs) >= MIN_PAIRS)


def unseen(axes: Sequence[str]) -> Finding:
    """Return the note that a motion does not determine some axes."""
    options = {f"prior.{axis}": "VALUE+/-SIGMA" for axis in axes}
    pronoun = "it" if len(axes) == 1 else "them"
    return finding("one_axis", options=options, axes=axes_in_words(axes), it=pronoun)
