"""From streams to a result: solve, check, repair, and solve at most twice more.

1. Solve the streams with the options of the user. If the angular rates clearly prove that the
   clocks differ, try an estimated time offset first.
2. Check the streams with the result.
3. Choose between two readings of both streams (as poses, or as inverse poses) if both fit equally
   well.
4. If a check is certain of options that repair a stream (units, conventions), solve with them.
5. If a check is certain that clocks or scales differ, solve with an estimated time offset or scale.

Each solve is an :class:`~hand_eye_calib.core.engine.attempts.Attempt`; the best one is kept. The
command line, Python, the node, batches and rigs call :func:`run`, or :func:`review` if they have a
result already.
"""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from typing import TypeAlias

from hand_eye_calib.core.base.config import defaults_of
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.base.option import Options
from hand_eye_calib.core.base.text import with_sigma
from hand_eye_calib.core.checks import units
from hand_eye_calib.core.checks.check import CheckResult
from hand_eye_calib.core.checks.clock_and_scale import (
    check_offset,
    offset_values,
)
from hand_eye_calib.core.checks.findings import (
    Finding,
    Severity,
    gravest_first,
    repair_message,
)
from hand_eye_calib.core.checks.findings import finding as new_finding
from hand_eye_calib.core.engine import readings as choosing
from hand_eye_calib.core.engine.attempts import (
    STREAM_REPAIRS,
    Attempt,
    OptionMessage,
    check,
    checked,
    solved_with,
    with_options,
)
from hand_eye_calib.core.engine.clock_choice import (
    ESTIMATED_CLOCK,
    clock_is_off,
    on_another_clock,
)
from hand_eye_calib.core.engine.kinds import kind_of
from hand_eye_calib.core.engine.poses import INVERSIONS
from hand_eye_calib.core.engine.snapshot import UNASKED_S, Snapshot
from hand_eye_calib.core.engine.solved_values import (
    note_on_unit,
    with_given_factor,
    with_solved_offset,
    with_solved_scale,
)
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.core.results.calibration import Calibration

#: Function ``progress(share, step)`` that is called before each step: share of the work that is
#: finished, 0 to 1, and name of the step.
Progress: TypeAlias = Callable[[float, str], None]

# Share of the work that is finished before the checks. It is an estimate, for the display of
# progress.
_CHECKS_BEGIN = 0.8

# Reasons for estimating an option, without the value of the estimate.
_REASONS_TO_ESTIMATE = {
    "time_offset": "the clocks may differ",
    "scale": "the lengths may differ",
}

# Codes of findings that are certain enough for a second solve, in addition to those about
# conventions.
_CERTAIN_CODES = ("time_offset", "scale", "units", "unit_or_scale")

# Codes of findings whose option is estimated in the second solve. The result then contains the
# uncertainty of its value.
_ESTIMATED_CODES = ("time_offset", "scale", "unit_or_scale")


@dataclass(frozen=True)
class _Reading:
    """Chosen reading of both streams: poses, or inverse poses.

    Attributes
    ----------
    findings : tuple of Finding
        Findings of the check for this reading.
    doubts : tuple of Finding
        Findings about an uncertain choice.
    settled : frozenset of str
        Options that must stay unchanged after the choice.
    """

    findings: tuple[Finding, ...]
    doubts: tuple[Finding, ...] = ()
    settled: frozenset[str] = frozenset()


def run(
    snapshot: Snapshot,
    *,
    checks: bool | None = None,
    progress: Progress | None = None,
) -> Attempt:
    """Calibrate: solve, check, repair, and return the best attempt.

    Parameters
    ----------
    snapshot : Snapshot
        Streams and options.
    checks : bool, optional
        False skips stream checks, cross-checks and further solves. True cross-checks the result
        even if the user set a reference. By default, a result with such a reference is not
        cross-checked.
    progress : callable, optional
        See :data:`Progress`.

    Returns
    -------
    Attempt
        Best attempt, with its result, its check, and the options that were set automatically.

    Raises
    ------
    NotEnoughDataError
        If too few poses can be paired.
    InputError
        If both streams have the same sensor frame.
    """
    report = progress or (lambda share, step: None)
    report(0.0, "solving")
    if checks is False:
        best = Attempt(snapshot.estimate(cross_check=False), snapshot)
    else:
        best = _solved_and_checked(snapshot, checks, report)
        if note := note_on_unit(snapshot):
            messages = [OptionMessage(note, note), *best.messages]
            best = best.with_messages(best.options, messages)
            factor = snapshot.config.parent_scale
            findings = tuple(
                with_given_factor(found, best.calibration, factor)
                for found in best.check.findings
            )
            if findings != best.check.findings:
                best = best.with_findings(findings)
    report(1.0, "done")
    return best


def review(
    calibration: Calibration, snapshot: Snapshot, settled: Collection[str] = ()
) -> Attempt:
    """Check the streams of a result, and solve again if a check is certain of other options.

    Parameters
    ----------
    calibration : Calibration
    snapshot : Snapshot
        Poses and options of the result.
    settled : collection of str
        Options that an earlier check has set. They are treated like options of the user, and not
        changed.
    """
    return _best(checked(calibration, snapshot), settled, None)


def _solved_and_checked(
    snapshot: Snapshot, checks: bool | None, report: Progress
) -> Attempt:
    """Return the best attempt at a snapshot. For ``checks`` see :func:`run`."""
    on_clock = on_another_clock(snapshot)
    if on_clock and on_clock.is_sound and not on_clock.check.readings:
        return _with_estimate_warnings(on_clock, ESTIMATED_CLOCK, ())
    try:
        calibration = snapshot.estimate(cross_check=checks)
    except NotEnoughDataError:
        # With some mistakes, poses cannot be paired, or the scale cannot be estimated.
        can_repair = kind_of(snapshot.config).has_conventions
        repaired = _repaired_unsolved(snapshot) if can_repair else None
        if not repaired:
            raise
        return repaired
    report(_CHECKS_BEGIN, "checking the streams")
    return _best(checked(calibration, snapshot), (), on_clock)


def _best(
    first: Attempt, settled: Collection[str], on_clock: Attempt | None
) -> Attempt:
    """Return the best attempt: the first one, or one solved again with options of its check.

    First a reading is chosen (poses or inverse poses). Then options that a check is certain of are
    set. If they repair a stream, the time offset and the scale are estimated after the repair, not
    here.

    ``settled`` are options that must not be changed. ``on_clock`` is the attempt with an estimated
    time offset, if it already exists.
    """
    reading = _reading_of(
        first.snapshot, first.check, settled, first.calibration.time_offset_s
    )
    first = first.with_findings(reading.findings)
    settled = reading.settled.union(settled)
    certain_options = _certain(
        first.check.findings, first.snapshot.config.given.union(settled)
    )
    if {*certain_options} & {*STREAM_REPAIRS}:
        verdict = first.calibration.verdict.value
        repaired = _repaired(
            first.snapshot,
            first.check.findings,
            certain_options,
            settled,
            verdict,
        )
        best = repaired or first
    else:
        best = _estimated(first, certain_options, settled, on_clock)
    return best.with_doubts(reading.doubts)


# ------------------------------------------------------------------ two readings


def _reading_of(
    snapshot: Snapshot,
    result: CheckResult,
    settled: Collection[str],
    applied_s: float,
) -> _Reading:
    """Choose between poses and inverse poses in both streams, if both fit equally well.

    ``settled`` are options that must not be changed. ``applied_s`` is the time offset (s) that was
    applied before the check. The check may have estimated a further offset.
    """
    if INVERSIONS & snapshot.config.given.union(settled):
        return _Reading(_without_readings(result))
    if not result.readings:
        return _Reading(result.findings)
    further_s = result.offset.seconds if result.offset else 0.0
    clock: Options = {"time_offset": applied_s + further_s}

    def pairs_of(options: Options) -> PosePairs:
        return with_options(snapshot, {**options, **clock}).pose_pairs

    def answer_with(options: Options) -> Calibration | None:
        attempt = solved_with(snapshot, {**options, **clock})
        return attempt.calibration if attempt else None

    choice = choosing.choose(result, pairs_of, answer_with)
    return _Reading(
        choice.findings,
        choice.doubts,
        frozenset() if choice.is_repair else INVERSIONS,
    )


def _without_readings(result: CheckResult) -> tuple[Finding, ...]:
    """Return the findings without warnings that both streams are inverse.

    The user or an earlier choice has already decided about inversions.
    """
    return tuple(
        finding
        for finding in result.findings
        if finding.code != "inverse_both" or finding.severity is Severity.NOTE
    )


# ------------------------------------------------------------------ repairs


def _repaired_unsolved(snapshot: Snapshot) -> Attempt | None:
    """Repair streams that cannot be solved otherwise. Return None if no repair is certain."""
    result = check(snapshot)
    reading = _reading_of(
        snapshot, result, (), snapshot.config.given_time_offset_s
    )
    certain_options = _certain(reading.findings, snapshot.config.given)
    repaired = _repaired(
        snapshot, reading.findings, certain_options, (), "no result"
    )
    return repaired and repaired.with_doubts(reading.doubts)


def _repaired(
    snapshot: Snapshot,
    findings: Collection[Finding],
    certain_options: Options,
    settled: Collection[str],
    verdict_as_given: str,
) -> Attempt | None:
    """Return the attempt with repaired streams, or None if the repaired streams do not agree.

    A time offset or scale is estimated after the repair. If poses cannot be paired otherwise, it is
    estimated together with the repair.

    Parameters
    ----------
    snapshot : Snapshot
    findings : collection of Finding
        Findings of the check. They are used in the message.
    certain_options : mapping
        Options that certainly repair the streams; see :func:`_certain`.
    settled : collection of str
        Options that must not be changed.
    verdict_as_given : str
        Verdict of the streams without the repair. It is used in the message.
    """
    second, options = _solved_as_repaired(snapshot, certain_options)
    if not second:
        return None
    settled = {*settled, *options}
    offset_s = second.calibration.time_offset_s
    reading = _reading_of(second.snapshot, second.check, settled, offset_s)
    second = second.with_findings(reading.findings)
    settled |= reading.settled
    further = _certain(
        second.check.findings, second.snapshot.config.given.union(settled)
    )
    further = {
        name: value
        for name, value in further.items()
        if name not in STREAM_REPAIRS
    }
    second = _estimated(second, further, settled, None).with_doubts(
        reading.doubts
    )
    if any(map(_contradicts_repair, second.check.findings)):
        return None
    verdict = second.calibration.verdict.value
    verdicts = f": {verdict}; without the repair: {verdict_as_given}"
    faults = [
        finding for finding in findings if {*finding.options} & {*options}
    ]
    message = OptionMessage(
        repair_message(faults, options, verdicts),
        repair_message(faults, options),
    )
    second = second.with_messages(
        {**options, **second.options}, (message, *second.messages)
    )
    return _with_offset_doubt(second, _doubts_beside_a_repair(findings))


def _solved_as_repaired(
    snapshot: Snapshot, certain_options: Options
) -> tuple[Attempt | None, dict[str, float | str]]:
    """Return the attempt with the options of certain repairs, and the options among them it needs.

    The time offset is estimated only if otherwise the solve fails.
    """
    options = {
        name: value
        for name, value in certain_options.items()
        if value != "estimate"
    }
    second = solved_with(snapshot, options) if options else None
    if not second and "time_offset" in certain_options:
        options["time_offset"] = "estimate"
        second = solved_with(snapshot, options)
    return second, options


def _doubts_beside_a_repair(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings of the original streams that a repair does not settle, as warnings."""
    # A difference of lengths may be a scale of the child instead of a unit of the parent.
    doubts = [
        replace(finding, severity=Severity.WARNING, options={})
        for finding in findings
        if (finding.code, finding.stream) == ("units", "parent")
    ]
    return doubts + [
        finding for finding in findings if finding.code == "ambiguous"
    ]


def _contradicts_repair(finding: Finding) -> bool:
    """Return whether a finding after a repair proves that the streams still disagree.

    A difference of lengths is no proof if it may be a unit or a scale.
    """
    return finding.makes_unusable and finding.code != "unit_or_scale"


# ------------------------------------------------------------------ estimates


def _estimated(
    first: Attempt,
    certain_options: Options,
    settled: Collection[str],
    on_clock: Attempt | None,
) -> Attempt:
    """Return the attempt with an estimated time offset or scale, or the first attempt.

    There is a second solve if a check is certain of such options, or if the clock is off. Its
    attempt is returned if it is better or sound.
    """
    fixed = first.snapshot.config.given.union(settled)
    options = dict(certain_options)
    if "time_offset" not in fixed and clock_is_off(first):
        options = {**ESTIMATED_CLOCK, **options}
    if not options:
        return first
    second = on_clock if options == ESTIMATED_CLOCK else None
    second = second or solved_with(first.snapshot, options)
    if not second:
        return first
    if INVERSIONS & fixed:
        second = second.with_findings(_without_readings(second.check))
    n_fewer = 1 if certain_options else 0
    if not (second.is_better_than(first, n_fewer) or second.is_sound):
        return first
    findings = first.check.findings
    second = _with_estimate_warnings(second, options, findings)
    if "parent_scale" in fixed:
        return second
    return second.with_doubts(_unit_doubts(findings, second.calibration))


def _unit_doubts(
    findings: Collection[Finding], calibration: Calibration
) -> tuple[Finding, ...]:
    """Return findings that warn that an estimated scale may be a wrong unit of length.

    A finding is an error if the scale equals the scale of the unit within its uncertainty, in the
    check or in the result. Otherwise it is a warning.
    """
    doubts = []
    for finding in findings:
        if finding.code == "unit_or_scale":
            difference = abs(
                calibration.scale - 1.0 / finding.evidence["factor"]
            )
            is_near = difference <= units.UNIT_SIGMAS * calibration.scale_sigma
            is_exact = finding.evidence["is_exact"] or is_near
            severity = Severity.ERROR if is_exact else Severity.WARNING
            doubt = replace(finding, severity=severity, options={})
            doubts.append(with_solved_scale(doubt, calibration))
    return tuple(doubts)


def _with_estimate_warnings(
    attempt: Attempt, options: Options, findings: Collection[Finding]
) -> Attempt:
    """Return the attempt with a warning about each option that was set because of findings."""
    calibration = attempt.calibration
    reasons = {
        name: with_solved_scale(finding, calibration).what
        for finding in findings
        for name in finding.options
    }
    offset_s = calibration.time_offset_s
    reasons["time_offset"] = (
        f"the child's clock is {with_sigma(abs(offset_s), calibration.time_offset_sigma_s, 4)} s "
        f"{offset_values(offset_s)['direction']} the parent's"
    )
    rate = calibration.clock_rate
    if rate and rate.is_used:
        reasons["time_offset"] += f" and {rate}"
    messages = []
    for name, value in options.items():
        solved = (
            f"solved with {name} {value}; to keep the stream unchanged, set {name} "
            f"{defaults_of([name])[name]}"
        )
        is_estimate = value == "estimate"
        lasting = _REASONS_TO_ESTIMATE[name] if is_estimate else reasons[name]
        messages.append(
            OptionMessage(f"{reasons[name]}: {solved}", f"{lasting}: {solved}")
        )
    return _with_offset_doubt(attempt.with_messages(options, messages), [])


def _with_offset_doubt(
    attempt: Attempt, doubts: Collection[Finding]
) -> Attempt:
    """Return the attempt with doubts, and a further doubt if the estimated time offset is large."""
    offset_s = attempt.calibration.time_offset_s
    doubts = [*doubts]
    if "time_offset" in attempt.options and abs(offset_s) > UNASKED_S:
        large = new_finding(
            "large_time_offset",
            "child",
            options=ESTIMATED_CLOCK,
            **offset_values(offset_s),
        )
        if large not in attempt.calibration.findings:
            doubts.append(large)
    return attempt.with_doubts(doubts)


# ------------------------------------------------------------------ options from findings


def examine(snapshot: Snapshot) -> tuple[Finding, ...]:
    """Return the findings about the streams without repairs, the gravest first.

    Like :func:`run`, the check starts from a solve, and one of two readings is chosen. Clock offset
    and scale in the findings are those that :func:`run` would estimate.

    Raises
    ------
    NotEnoughDataError
        If too few poses can be paired, and this kind of data cannot be checked without a result.
    """
    try:
        calibration = snapshot.estimate(cross_check=False)
    except NotEnoughDataError:
        if not kind_of(snapshot.config).has_conventions:
            raise
        calibration = None
    result = check(snapshot, calibration)
    applied_s = snapshot.config.given_time_offset_s
    if calibration:
        if "time_offset" not in snapshot.config.given:
            result = _with_whole_offset(result, calibration)
        applied_s = calibration.time_offset_s
    reading = _reading_of(snapshot, result, (), applied_s)
    findings = gravest_first((*reading.findings, *reading.doubts))
    estimates = {"time_offset", "scale"} & {
        *_certain(findings, snapshot.config.given)
    }
    if not calibration or not estimates:
        return findings
    best = _best(Attempt(calibration, snapshot, result), (), None)
    if estimates <= {*best.options}:
        findings = tuple(
            with_solved_offset(
                with_solved_scale(issue, best.calibration), best.calibration
            )
            for issue in findings
        )
    return findings


def _with_whole_offset(
    result: CheckResult, calibration: Calibration
) -> CheckResult:
    """Return the check with a finding about the whole clock offset, if only the whole is clear.

    The noise model may estimate a part of the offset. The check then measures only the rest, which
    may be too small for a finding.
    """
    rest = result.offset
    if rest is None or any(
        item.code == "time_offset" for item in result.findings
    ):
        return result
    whole = replace(rest, seconds=rest.seconds + calibration.time_offset_s)
    return replace(
        result, findings=(*result.findings, *check_offset(whole, 0.0))
    )


def _certain(
    findings: Collection[Finding], fixed: Collection[str]
) -> dict[str, float | str]:
    """Return the options that certainly repair a stream, except those in ``fixed``.

    Values of units and conventions come from the findings. Time offset and scale get the value
    "estimate", so that the result contains their uncertainty. A difference of lengths of a few per
    cent is only a warning: odometry with a drifting scale has the same effect.
    """
    certain_options: dict[str, float | str] = {}
    for finding in findings:
        for name, value in finding.options.items():
            is_clock_warning = (
                name == "time_offset" and finding.severity is Severity.WARNING
            )
            is_convention = name.endswith(("invert", "quaternion"))
            is_certain = finding.code in _CERTAIN_CODES or is_convention
            if not is_certain or name in fixed:
                continue
            if finding.makes_unusable or is_clock_warning:
                certain_options |= options_to_solve(
                    replace(finding, options={name: value})
                )
    return certain_options


def options_to_solve(finding: Finding) -> Options:
    """Return the options of a finding for a solve, which estimates offset and scale."""
    # A clock offset of 0 needs no estimation.
    is_zero = finding.options == {"time_offset": 0.0}
    if finding.code in _ESTIMATED_CODES and not is_zero:
        return dict.fromkeys(finding.options, "estimate")
    return finding.options
