"""Decide whether the clocks of both sensors differ so much that their offset is estimated."""

import math
from dataclasses import replace

from hand_eye_calib.core.alignment.time_offset import (
    TimeOffset,
    refine_time_offset,
)
from hand_eye_calib.core.base.config import METHODS
from hand_eye_calib.core.base.option import Options
from hand_eye_calib.core.checks.findings import LIMITS
from hand_eye_calib.core.checks.hypothesis import HOLDS
from hand_eye_calib.core.engine.attempts import Attempt, solved_with
from hand_eye_calib.core.engine.kinds import kind_of
from hand_eye_calib.core.engine.snapshot import (
    MOST_MOVED_S,
    UNASKED_S,
    Snapshot,
)

ESTIMATED_CLOCK: Options = {"time_offset": "estimate"}

# The time offset of the check, with its clock rate, is used if its spread (TimeOffset.spread_s) is
# below this share of the largest offset in the recording.
_CLEAR_SPREAD = 0.5


def on_another_clock(snapshot: Snapshot) -> Attempt | None:
    """Return the attempt with an estimated time offset if the clocks clearly differ, else None.

    If this attempt is good, no solve without a time offset is needed. The attempt is not made if
    options or kind of data exclude a time offset, or if other mistakes must be repaired first.
    """
    config = snapshot.config
    is_free = (
        config.method in ("auto", "adaptive") and config.reference == "auto"
    )
    is_settled = "time_offset" in config.given or len(snapshot.kept) > 0
    if is_settled or not is_free or not kind_of(config).has_conventions:
        return None
    if not snapshot.correlation.is_clear:
        return None
    coarse = TimeOffset(
        snapshot.correlation.offset_s, correlation=snapshot.correlation
    )
    # This precision suffices to decide whether the clocks differ.
    preliminary = refine_time_offset(
        *snapshot.streams, coarse, snapshot.max_gap_s, UNASKED_S
    )
    fit = preliminary.fit
    smallest_s = abs(preliminary.seconds) - 3.0 * preliminary.sigma_s
    if fit is None or smallest_s < MOST_MOVED_S:
        return None
    # With wrong conventions or units, the streams are first solved without a repair, because the
    # message of the repair contains the verdict of this solve. A small difference of lengths is not
    # a wrong unit: the noise model estimates it as a scale.
    scale_error = abs(math.log(fit.scale))
    is_other_unit = fit.has_own_unit and scale_error >= LIMITS["scale"].error
    if is_other_unit or fit.unexplained > HOLDS:
        return None
    offset = refine_time_offset(
        *snapshot.streams, preliminary, snapshot.max_gap_s
    )
    other = replace(
        snapshot, config=replace(config, **ESTIMATED_CLOCK), time_offset=offset
    )
    return solved_with(other, {})


def clock_is_off(first: Attempt) -> bool:
    """Return whether poses must be paired anew, because the time offset has changed too much."""
    snapshot = first.snapshot
    calibration = first.calibration
    paired_with_s = float(snapshot.resolved.config.time_offset)
    change_s = abs(calibration.time_offset_s - paired_with_s)
    by_check = first.check.offset
    uses_all_poses = not METHODS[snapshot.config.method].uses_reference
    if by_check and uses_all_poses and snapshot.config.reference == "auto":
        # Only the check estimates a clock rate. For DNLO, only the check estimates the offset.
        largest_s = by_check.largest_s(snapshot.unpaired[1].duration_s)
        if by_check.spread_s < _CLEAR_SPREAD * largest_s:
            certain_s = largest_s - _CLEAR_SPREAD * by_check.spread_s
            change_s = max(change_s, certain_s)
    return change_s >= kind_of(snapshot.config).least_clock_change_s
