"""The check of two streams of which one has only positions, rotations or angular rates.

What such streams have in common shows in a solve, which is quick: whether they are of one body, in
one unit of length, and on one clock.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from hand_eye_calib.alignment.angular_rates import MIN_VARIATION, Correlation
from hand_eye_calib.alignment.time_offset import TimeOffset
from hand_eye_calib.checks import findings as wording
from hand_eye_calib.checks.check import CheckResult, check_offset, unrelated_rates
from hand_eye_calib.checks.findings import Finding, Severity, gravest_first
from hand_eye_calib.engine.snapshot import FOUND_BY_SOLVE_S, Snapshot
from hand_eye_calib.errors import InputError, NotEnoughDataError
from hand_eye_calib.results.calibration import Calibration, SolveStatus
from hand_eye_calib.text import axes_in_words


def check_partial(snapshot: Snapshot) -> CheckResult:
    """Check the streams of a snapshot of which one at least gives only a part of its poses.

    A time offset in the options is known; otherwise the streams are compared at the offset at which
    their angular rates, or the speeds beside positions, agree.

    Parameters
    ----------
    snapshot : Snapshot
        Of whole trajectories.

    Returns
    -------
    CheckResult
    """
    config = snapshot.config
    known_s = 0.0 if isinstance(config.time_offset, str) else config.time_offset
    before = replace(snapshot, config=replace(config, time_offset=known_s)).check()
    if any(finding.makes_unusable for finding in before.findings):
        return before
    correlation = snapshot.correlated(known_s)
    offset_s = known_s
    if correlation.is_clear and abs(correlation.offset_s) > FOUND_BY_SOLVE_S / 2:
        offset_s += correlation.offset_s
    try:
        found = _of_solve(snapshot, correlation, known_s, {"time_offset": offset_s})
    except NotEnoughDataError as error:
        found = [*before.findings, _of_no_solve(config.measured, correlation, error)]
    except InputError as error:
        found = [*before.findings, _unsolved(str(error))]
    return CheckResult(gravest_first(found), correlation)


def _of_no_solve(measured: str, correlation: Correlation, error: NotEnoughDataError) -> Finding:
    """What is wrong with streams that have nothing in common to be solved."""
    if correlation.is_clear or not correlation.overlap_s:
        return wording.finding("too_short", text=str(error))
    quantity = "speeds" if measured == "positions" else "angular rates"
    return unrelated_rates(correlation, quantity)


def _of_solve(
    snapshot: Snapshot, correlation: Correlation, known_s: float, options: Mapping[str, Any]
) -> list[Finding]:
    """Findings of a solve with other options; with lengths in another unit, of one in metres."""
    solved = replace(snapshot, config=replace(snapshot.config, **options))
    result = solved.estimate()
    found = [*solved.check(result).findings]
    if in_units := [each for each in found if each.code == "units" and "scale" not in options]:
        more = {**options, **in_units[0].options}
        return [*in_units, *_of_solve(snapshot, correlation, known_s, more)]
    if any(each.makes_unusable for each in found):
        is_still = correlation.overlap_s > 0 and correlation.variation < MIN_VARIATION
        is_in_unit = all(each.code != "rate_unit" for each in found)
        if is_still and is_in_unit and result.measured == "rotations":
            return [wording.finding("no_turning")]
        return found
    return [*found, *_of_result(result, correlation, known_s)]


def _of_result(result: Calibration, correlation: Correlation, known_s: float) -> list[Finding]:
    """Findings about motion and clock of streams that agree."""
    within_reach = [dof.name for dof in result.observability if dof.name not in result.out_of_reach]
    hidden = [axis for axis in within_reach if axis in result.unobservable()]
    if result.status is SolveStatus.NOT_CONVERGED:
        return [_unsolved("the solve of these streams does not converge")]
    if hidden == within_reach:
        return [wording.finding("no_turning")]
    offset_s, sigma_s = result.time_offset_s - known_s, result.time_offset_sigma_s
    clocks = check_offset(TimeOffset(offset_s, sigma_s, correlation, None), known_s)
    if abs(offset_s) < FOUND_BY_SOLVE_S:
        clocks = [replace(finding, severity=Severity.NOTE) for finding in clocks]
    return [
        *clocks,
        *([_unseen(hidden)] if hidden else []),
    ]


def _unsolved(text: str) -> Finding:
    return wording.finding("unsolved", text=text, units="the units")


def _unseen(axes: Sequence[str]) -> Finding:
    options = {f"prior.{axis}": "VALUE+/-SIGMA" for axis in axes}
    it = "it" if len(axes) == 1 else "them"
    return wording.finding("unseen_axes", options=options, axes=axes_in_words(axes), it=it)
