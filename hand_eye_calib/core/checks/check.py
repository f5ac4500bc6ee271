"""Check whether both sensors can be on one rigid body; name the fault if they cannot.

1. Check each stream alone (:mod:`~hand_eye_calib.core.checks.streams`).
2. Correlate the angular rates (:mod:`~hand_eye_calib.core.alignment.time_offset`): do they agree at
   any clock offset? Reordered or inverted quaternions, units and axes do not change angular rates.
3. Fit the whole motion (:mod:`~hand_eye_calib.core.checks.hypotheses`): which hypothesis about
   usual mistakes makes the streams agree, once the mistakes are undone?
4. With these mistakes undone, check the clock offset, the scale, and the directions that the motion
   does not excite.
5. Search for copied streams and for small faults that bias the extrinsic
   (:mod:`~hand_eye_calib.core.checks.independence`, :mod:`~hand_eye_calib.core.checks.agreement`).

The poses of a stream are those of the sensor in its world, or the inverse poses. A *reading* is an
assumption about both streams: poses or inverse poses.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.alignment import similarity, time_offset
from hand_eye_calib.core.alignment.rate_correlation import (
    MIN_VARIATION,
    Correlation,
)
from hand_eye_calib.core.alignment.scale import estimate_scale
from hand_eye_calib.core.alignment.similarity import SimilarityFit
from hand_eye_calib.core.alignment.time_offset import TimeOffset
from hand_eye_calib.core.assessment.covariance import (
    hidden_axes,
    lever_arm_products,
)
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.checks import (
    agreement,
    fusion,
    hypotheses,
    independence,
    misread,
    parts,
)
from hand_eye_calib.core.checks.agreement import Agreement, ExtrinsicEstimate
from hand_eye_calib.core.checks.clock_and_scale import (
    ROUNDED,
    check_offset,
    in_metres,
    own_unit,
)
from hand_eye_calib.core.checks.common_clock import coarse_offset, fine_offset
from hand_eye_calib.core.checks.findings import (
    LIMITS,
    Finding,
    finding,
    graded,
    gravest_first,
    unobservable_axes,
)
from hand_eye_calib.core.checks.hypothesis import (
    HOLDS,
    PLAIN,
    Explanation,
    Readings,
)
from hand_eye_calib.core.checks.open_delay import NO_DELAY
from hand_eye_calib.core.checks.stream_pair import (
    LAGS_S,
    MAX_PAIRS,
    MIN_PAIRS,
    StreamPair,
)
from hand_eye_calib.core.checks.streams import (
    check_flat,
    check_frozen,
    check_lengths,
    check_positions,
    check_stream,
)
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import (
    MotionPairs,
    PosePairs,
    pairs_over,
)

# The smallest possible lever arm is its estimate minus this number of standard deviations.
_LEVER_ARM_SIGMAS = 3.0

# Largest number of motions over some seconds in the regression on small faults.
MAX_MOTIONS = 1500

# Shortest duration of both streams of a live session before they are checked.
MIN_DURATION_S = 20.0
# Smallest rotation of a sensor from its first pose before a live session is checked.
MIN_ROTATION_RAD = float(np.radians(30.0))


@dataclass(frozen=True)
class CheckResult:
    """Result of the stream checks.

    Attributes
    ----------
    findings : tuple of Finding
        The gravest first.
    fit : SimilarityFit or None
        The fit with the mistakes of both streams undone; None if no hypothesis about mistakes
        explains the streams.
    offset : TimeOffset or None
        Clock offset in addition to the ``time_offset_s`` of the check; None without a fit.
    readings : Readings or None
        Two readings that fit about equally well, if the chosen reading may be wrong; otherwise
        None. The second reading also inverts both streams.
    open_covariance : (6, 6) array
        Covariance of xi = (rho, phi) in ``T_parent_child @ exp(xi)``, in m and rad. It covers
        faults that the streams neither prove nor exclude, and is part of the allowance of a checked
        result.
    """

    findings: tuple[Finding, ...]
    fit: SimilarityFit | None = None
    offset: TimeOffset | None = None
    readings: Readings | None = None
    open_covariance: FloatArray = field(
        default_factory=lambda: NO_DELAY.covariance, compare=False
    )


def check_streams(
    parent: Trajectory,
    child: Trajectory,
    time_offset_s: float = 0.0,
    scale: float = 1.0,
    max_gap_s: float = CalibratorConfig.max_gap,
    correlate: Callable[[], Correlation] | None = None,
    earlier: ExtrinsicEstimate | None = None,
    are_exact: bool = False,
) -> CheckResult:
    """Check two streams of poses.

    Parameters
    ----------
    parent, child : Trajectory
    time_offset_s, scale : float
        Seconds to add to the child's stamps, and factor of its lengths, before the check.
    max_gap_s : float
        Longest time between two poses that interpolation may bridge, in seconds.
    correlate : callable, optional
        Correlate the angular rates of the original streams. Called only if needed.
    earlier : ExtrinsicEstimate, optional
        Extrinsic from an earlier solve of these streams.
    are_exact : bool
        Whether the user declared both streams as exact. Exact streams need not drift apart.
    """
    original = StreamPair(parent, child.scaled(scale), max_gap_s)
    findings = check_stream(original.parent, "parent", max_gap_s)
    findings += check_stream(original.child, "child", max_gap_s)
    # Rounded positions are judged later, because the limit is in metres and the unit of length is
    # not yet determined.
    if _are_unusable([found for found in findings if found.code != ROUNDED]):
        return CheckResult(gravest_first(findings))
    streams = original.shifted(time_offset_s)
    explanation = None
    offset = TimeOffset()
    if earlier and not streams.is_slow:
        explanation, offset = _explain_by_extrinsic(streams, earlier)
    if not explanation:
        correlation = (correlate or original.correlate)()
        if factor := _factor_of_angles(correlation):
            return CheckResult(gravest_first([*findings, factor]))
        streams, offset = coarse_offset(
            original, streams, time_offset_s, correlation
        )
    aligned = streams.shifted(offset.seconds)
    frozen = check_frozen(aligned.parent, aligned.child)
    findings += frozen
    if incomplete := _check_complete(aligned):
        return CheckResult(gravest_first([*findings, *incomplete]))
    if not explanation:
        is_frozen = _are_unusable(frozen)
        explanation, mistakes = _explain_or_misread(
            streams, aligned, offset, earlier, is_frozen
        )
        findings += mistakes
    if not explanation:
        return CheckResult(gravest_first(findings))
    arguments = _Arguments(original, earlier, scale, time_offset_s, are_exact)
    return _check_explained(streams, explanation, offset, findings, arguments)


class _Arguments(NamedTuple):
    """Arguments of :func:`check_streams`.

    ``original`` has both streams without the time offset, and the child's lengths times ``scale``.
    """

    original: StreamPair
    earlier: ExtrinsicEstimate | None
    scale: float
    time_offset_s: float
    are_exact: bool


def _are_unusable(findings: Sequence[Finding]) -> bool:
    """Return whether a finding makes the result unusable."""
    return any(found.makes_unusable for found in findings)


def _check_complete(aligned: StreamPair) -> list[Finding]:
    """Return findings about streams that are flat, or whose parts were turned."""
    flat = check_flat(aligned.parent, aligned.child)
    return flat or parts.check_turned_parts(aligned.synchronised)


def _factor_of_angles(correlation: Correlation) -> Finding | None:
    """Return the finding that all rotation angles of the child are wrong by one factor, or None."""
    if 1.0 - correlation.correlation >= HOLDS:
        return None
    ratio = correlation.ratio
    return graded("turns", "child", float(np.log(ratio)), times=ratio)


def _check_explained(
    streams: StreamPair,
    explanation: Explanation,
    coarse_offset: TimeOffset,
    findings: list[Finding],
    arguments: _Arguments,
) -> CheckResult:
    """Check streams that agree under a hypothesis for further faults.

    Parameters
    ----------
    streams : StreamPair
        Streams with the time offset of the arguments.
    explanation : Explanation
    coarse_offset : TimeOffset
        Clock offset that remains in ``streams``.
    findings : list of Finding
        Findings of earlier checks.
    arguments : _Arguments
    """
    corrected = explanation.hypothesis.undo(streams)
    offset = fine_offset(corrected, coarse_offset, explanation.fit)
    corrected = corrected.shifted(offset.seconds)
    sizes, fit = _check_sizes(
        corrected, explanation, offset.fit, arguments.scale
    )
    lengths = _lengths_of_explained(streams, corrected, fit, explanation)
    # If the reading is unclear, both streams may contain poses after all. The findings about
    # inverse poses must then neither end the checks nor judge streams in an unknown unit.
    of_reading = explanation.findings if explanation.may_be_uninverted else ()
    readings = explanation.readings
    if readings and lengths:
        # The noise and the shape of the motion can compare the readings only in a known unit of
        # length.
        readings = None
        findings = [found for found in findings if found not in of_reading]
    findings = in_metres(findings, [*lengths, *sizes], arguments.scale)
    is_sound = not _are_unusable(
        [found for found in findings if found not in of_reading]
    )
    findings += [
        *lengths,
        *check_offset(offset, arguments.time_offset_s),
        *sizes,
    ]
    delay = NO_DELAY
    if is_sound and not lengths:
        earlier = arguments.earlier
        corrected, fit = _preferred_reading(
            streams, corrected, explanation, fit, offset, earlier
        )
        agreeing, delay = _check_agreeing(corrected, fit, offset, arguments)
        findings += agreeing
        if delay.found and not agreeing:
            findings.append(delay.found)
    sorted_findings = gravest_first(findings)
    return CheckResult(
        sorted_findings, explanation.fit, offset, readings, delay.covariance
    )


def _lengths_of_explained(
    streams: StreamPair,
    corrected: StreamPair,
    fit: SimilarityFit,
    explanation: Explanation,
) -> list[Finding]:
    """Return the findings about lengths or speeds that no vehicle has.

    ``fit`` is that of the corrected streams.
    """
    lever_arm_m = least_lever_arm(fit.T_parent_child, fit.sigmas[:3])
    lengths = check_lengths(corrected.parent, corrected.child, lever_arm_m)
    if lengths and explanation.may_be_uninverted and explanation.findings:
        # If both streams contain inverse poses, the fitted lever arm is the distance between the
        # worlds. Judge the uncorrected streams without a lever arm in this case.
        return check_lengths(streams.parent, streams.child)
    return lengths


def _preferred_reading(
    streams: StreamPair,
    corrected: StreamPair,
    explanation: Explanation,
    fit: SimilarityFit,
    offset: TimeOffset,
    earlier: ExtrinsicEstimate | None,
) -> tuple[StreamPair, SimilarityFit]:
    """Return the streams in the reading that an earlier solve used, and their fit.

    The earlier solve did not invert the streams. If the explanation inverts both streams, but the
    streams may also be right without inversion, fit the uninverted streams. Otherwise return
    ``corrected`` and ``fit``.
    """
    has_other_reading = (
        explanation.may_be_uninverted
        and not explanation.hypothesis.is_uninverted
    )
    if not earlier or not has_other_reading:
        return corrected, fit
    uninverted = streams.shifted(offset.seconds)
    motions = _motions(uninverted.synchronised, MAX_PAIRS)
    return uninverted, similarity.fit_similarity(
        motions, start=earlier.T_parent_child
    )


def least_lever_arm(T_parent_child: FloatArray, sigmas: FloatArray) -> float:
    """Return the smallest plausible length (m) of a lever arm: 0 if its sigmas are large.

    Parameters
    ----------
    T_parent_child : (4, 4) array
    sigmas : (3,) array
        Standard deviations of the translation, m.
    """
    sizes = (
        np.abs(se3.translation_of(T_parent_child)) - _LEVER_ARM_SIGMAS * sigmas
    )
    # An axis with an infinite standard deviation contributes no length.
    finite_sizes = np.nan_to_num(sizes, neginf=0.0)
    return float(np.linalg.norm(np.clip(finite_sizes, 0.0, None)))


def _explain_by_extrinsic(
    streams: StreamPair, earlier: ExtrinsicEstimate
) -> tuple[Explanation | None, TimeOffset]:
    """Return the explanation without mistakes if it holds, or None, and the clock offset.

    The fit starts at the extrinsic of an earlier solve. The streams must clearly agree, in
    one unit of length and on about one clock; otherwise the explanation is None.
    """
    note_s = LIMITS["time_offset"].note
    error_s = LIMITS["time_offset"].error
    lag_s = time_offset.LAGS_S[0]
    offset = time_offset.offset_over(
        lag_s,
        streams.parent,
        streams.child,
        TimeOffset(),
        streams.max_gap_s,
        # One refinement suffices if the offset is below half of the smallest reported size.
        2.0 * note_s,
        earlier.T_parent_child,
        HOLDS,
    )
    fit = offset.fit
    if (
        fit is None
        or not fit.is_in_one_unit
        or fit.unexplained >= similarity.EXPLAINED
    ):
        return None, TimeOffset()
    if offset.largest_s(streams.child.duration_s) >= error_s:
        return None, TimeOffset()
    shifted = streams.shifted(offset.seconds)
    explanation = hypotheses.choose_reading(
        Explanation(PLAIN, fit), shifted, lag_s
    )
    if explanation.findings:
        return None, TimeOffset()
    return explanation, offset


def _explain_or_misread(
    streams: StreamPair,
    aligned: StreamPair,
    coarse_offset: TimeOffset,
    earlier: ExtrinsicEstimate | None,
    is_frozen: bool,
) -> tuple[Explanation | None, list[Finding]]:
    """Return the explanation of both streams or None, and the findings about misread streams.

    ``aligned`` are ``streams``, shifted by the coarse offset.
    """
    start = earlier.T_parent_child if earlier else None
    misread_positions = misread.check_earth_centred(aligned)
    if misread_positions:
        return None, misread_positions
    explanation, findings = _explain(
        aligned, coarse_offset.correlation, start, is_frozen
    )
    if not explanation:
        findings = misread.check_misread(streams, aligned) or findings
    return explanation, findings


def _explain(
    streams: StreamPair,
    correlation: Correlation,
    start: FloatArray | None,
    is_frozen: bool,
) -> tuple[Explanation | None, list[Finding]]:
    """Return the explanation of both streams or None, and the findings about both streams.

    The fits start at ``start`` (4, 4), an earlier extrinsic, if there is one.
    """
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
            coordinates = agreement.check_coordinates(
                pairs, _motions(pairs, MAX_MOTIONS)
            )
            return None, coordinates or [*explanation.findings]
    # Angular rates of a frozen stream contain no evidence about the offset.
    if is_frozen:
        return None, []
    if correlation.variation < MIN_VARIATION:
        return None, [_missing_rotation(streams)]
    return None, [finding("unrelated", doubt=correlation.doubt())]


def _missing_rotation(streams: StreamPair) -> Finding:
    """Return the finding that both streams hardly rotate, or that only one of them rotates."""
    largest_rad = {
        "parent": _largest_rotation(streams.parent),
        "child": _largest_rotation(streams.child),
    }
    constant = min(largest_rad, key=largest_rad.__getitem__)
    other = "child" if constant == "parent" else "parent"
    if (
        largest_rad[constant] > agreement.SAME_RAD
        or largest_rad[other] < MIN_ROTATION_RAD
    ):
        return finding("no_turning")
    return finding(
        "only_one_turns",
        stream=constant,
        other=other,
        degrees=math.degrees(largest_rad[other]),
    )


def _check_sizes(
    streams: StreamPair,
    explanation: Explanation,
    timed: SimilarityFit | None,
    used_scale: float,
) -> tuple[list[Finding], SimilarityFit]:
    """Return the findings about scale and unobservable axes of streams that agree, and the fit.

    The scale is fitted if the unit of length is unclear. ``timed`` is the fit at the refined time
    offset, if there is one. ``used_scale`` is the factor that the child's lengths already contain.
    """
    pose_pairs = streams.synchronised
    motions = _motions(pose_pairs, MAX_PAIRS)
    fit = explanation.fit
    chords = se3.rotation_of(motions.Ts_parenti_parentj) - np.eye(3)
    hidden = hidden_axes(
        lever_arm_products(chords), fit.sigma_rotation**2 * np.eye(3)
    )
    findings = [unobservable_axes(hidden)] if hidden else []
    if explanation.same_unit or fit.is_in_one_unit:
        return findings, fit
    fits_of_scale = [fit]
    if timed:
        fits_of_scale.append(timed)
    fits_of_scale = [
        candidate for candidate in fits_of_scale if candidate.scale_sigma > 0.0
    ]
    with suppress(NotEnoughDataError):
        fit = estimate_scale(pose_pairs, fits_of_scale)
        other_unit = (
            own_unit(streams, fit, used_scale) if fit.has_own_unit else None
        )
        if other_unit:
            findings.append(other_unit)
    return findings, fit


def _check_agreeing(
    corrected: StreamPair,
    fit: SimilarityFit,
    offset: TimeOffset,
    arguments: _Arguments,
) -> Agreement:
    """Check agreeing streams for copies, for faults that bias X, and for fusion.

    ``corrected`` are the streams on one clock, with all mistakes undone.
    """
    best = ExtrinsicEstimate(fit.T_parent_child, fit.sigmas[:6])
    earlier = arguments.earlier
    if earlier and earlier.sigmas[:3].max() < best.sigmas[:3].max():
        best = earlier
    copied = independence.check_copies(
        arguments.original, corrected, arguments.are_exact
    )
    if copied:
        return Agreement([*copied, *agreement.check_same(best)])
    pose_pairs = corrected.synchronised.child_scaled(fit.scale)
    if other := parts.check_other_extrinsic(pose_pairs, best.T_parent_child):
        return Agreement(other)
    motions = _motions(pose_pairs, MAX_MOTIONS)
    offset_s = arguments.time_offset_s + offset.seconds
    agreeing = agreement.check_agreement(
        pose_pairs, motions, fit.T_parent_child, best, offset_s
    )
    if arguments.are_exact:
        return agreeing
    correction = fusion.check_correction(pose_pairs, best.T_parent_child)
    if correction and (correction.makes_unusable or not agreeing.findings):
        return agreeing._replace(findings=[correction])
    if not agreeing.findings:
        drift = independence.check_drift(pose_pairs, best.T_parent_child)
        agreeing = agreeing._replace(findings=drift)
    return agreeing


def check_parts(
    parent: Trajectory,
    child: Trajectory,
    max_gap_s: float,
    lever_arm_m: float = 0.0,
) -> list[Finding]:
    """Check two streams on one clock, if at least one stream has no full poses.

    Nothing is solved here: rounding, lengths and frozen poses are checked. ``lever_arm_m`` is a
    lower limit of the distance between the sensors (m) from an earlier solve; 0 without a solve.
    """
    if not (parent.has_positions and child.has_positions):
        parent = parent.scaled(0.0)
        child = child.scaled(0.0)
    findings = check_positions(parent, "parent", max_gap_s)
    findings += check_positions(child, "child", max_gap_s)
    # Rounded positions repeat although the sensor moves, so they would count as frozen.
    is_rounded = any(found.code == ROUNDED for found in findings)
    if is_rounded or _are_unusable(findings):
        return findings
    lengths = check_lengths(parent, child, lever_arm_m)
    return [*findings, *lengths, *check_frozen(parent, child)]


def can_check(parent: Trajectory, child: Trajectory) -> bool:
    """Return whether two streams of a live session are long enough to be checked.

    At least one stream must have rotated enough.
    """
    if min(parent.duration_s, child.duration_s) < MIN_DURATION_S:
        return False
    return any(
        _largest_rotation(stream) >= MIN_ROTATION_RAD
        for stream in (parent, child)
    )


def _largest_rotation(trajectory: Trajectory) -> float:
    """Return the largest rotation (rad) from the first pose to another pose."""
    rotations = se3.rotation_of(trajectory.poses)
    return float(se3.rotation_angle(rotations[0].T @ rotations).max())


def _motions(pose_pairs: PosePairs, max_motions: int) -> MotionPairs:
    """Return motions over the first lag of ``LAGS_S`` with enough motions."""
    motions = (pairs_over(pose_pairs, lag_s, max_motions) for lag_s in LAGS_S)
    # The streams were fitted over the first lag with enough motions, so this lag exists.
    return next(pairs for pairs in motions if len(pairs) >= MIN_PAIRS)
