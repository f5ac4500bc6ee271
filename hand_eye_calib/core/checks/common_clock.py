"""Clock offset between two streams in the stream checks: coarse, then refined."""

from dataclasses import replace

from hand_eye_calib.core.alignment import time_offset
from hand_eye_calib.core.alignment.rate_correlation import Correlation
from hand_eye_calib.core.alignment.similarity import SimilarityFit
from hand_eye_calib.core.alignment.time_offset import TimeOffset
from hand_eye_calib.core.checks.findings import LIMITS
from hand_eye_calib.core.checks.stream_pair import MIN_PAIRS, StreamPair

# Accuracy of the coarse clock offset of slow streams, in intervals between poses.
_COARSE_INTERVALS = 0.5

# Longest gap that is interpolated, in intervals between poses, if the clocks of slow streams differ
# by more than the coarse accuracy.
_SLOW_GAP_INTERVALS = 1.5


def coarse_offset(
    original: StreamPair,
    streams: StreamPair,
    added_s: float,
    correlation: Correlation,
) -> tuple[StreamPair, TimeOffset]:
    """Return the streams to compare, and the clock offset that their angular rates still have.

    Parameters
    ----------
    original, streams : StreamPair
        The streams before and after ``added_s`` was added to the child's stamps.
    added_s : float
        Time offset, s.
    correlation : Correlation
        Correlation of the angular rates of the original streams.
    """
    if streams.is_slow:
        streams, remaining = _align_slow(
            original, streams, added_s, correlation
        )
    else:
        remaining = replace(
            correlation, offset_s=correlation.offset_s - added_s
        )
    if not correlation.is_clear:
        # A short recording may not determine the offset. The streams may still agree with
        # ``added_s``.
        remaining = replace(remaining, offset_s=0.0)
    return streams, TimeOffset(remaining.offset_s, correlation=remaining)


def fine_offset(
    corrected: StreamPair, coarse_offset: TimeOffset, fit: SimilarityFit
) -> TimeOffset:
    """Return the refined clock offset of corrected streams.

    A coarse offset with a fit is from motions of the first duration of time_offset.LAGS_S. It is
    not refined if it is clearly below the smallest reported size. ``fit`` is used if the coarse
    offset has no fit of its own. Slow streams cannot be interpolated: their offset is accurate to
    one interval between poses.
    """
    note_s = LIMITS["time_offset"].note
    if (
        coarse_offset.fit
        and coarse_offset.largest_s(corrected.child.duration_s) < note_s
    ):
        return coarse_offset
    if corrected.is_slow:
        return TimeOffset(
            coarse_offset.seconds,
            corrected.interval_s,
            coarse_offset.correlation,
        )
    return time_offset.refine_time_offset(
        corrected.parent,
        corrected.child,
        replace(coarse_offset, fit=coarse_offset.fit or fit),
        corrected.max_gap_s,
        note_s,
        first=coarse_offset if coarse_offset.fit else None,
    )


def _align_slow(
    original: StreamPair,
    shifted: StreamPair,
    added_s: float,
    correlation: Correlation,
) -> tuple[StreamPair, Correlation]:
    """Return slow streams on one clock, with the correlation at the clock offset that remains.

    The poses of slow streams are too far apart to interpolate. Therefore only two pairs of streams
    are possible: those shifted by ``added_s``, or the original streams. A pair is used if it has
    common stamps and the coarse offset agrees.
    """
    for offset_s, candidate in ((added_s, shifted), (0.0, original)):
        if len(candidate.synchronised) <= MIN_PAIRS:
            continue
        error_s = abs(correlation.offset_s - offset_s)
        if (
            error_s < _COARSE_INTERVALS * original.interval_s
            or not correlation.is_clear
        ):
            return candidate, replace(correlation, offset_s=0.0)
    remaining = replace(correlation, offset_s=correlation.offset_s - added_s)
    max_gap_s = _SLOW_GAP_INTERVALS * original.interval_s
    return replace(shifted, max_gap_s=max_gap_s), remaining
