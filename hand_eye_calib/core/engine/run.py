"""The road from streams to a result: solve, check, repair, and solve at most twice more.

1. Solve the streams as given. If the angular rates clearly show that the clocks differ, try an
   estimated time offset first.
2. Check the streams with the result.
3. Choose between two readings of both streams, if they fit alike.
4. Solve with the options that repair a stream (units, conventions), if a check is certain of them.
5. Solve with an estimated time offset or scale, if a check is certain that they differ.

Each solve is an :class:`~hand_eye_calib.core.engine.attempts.Attempt`; the best one is kept. The
command line, Python, the node, batches and rigs call :func:`run`, or :func:`review` for a result
that they have already.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import TypeAlias

from hand_eye_calib.core.alignment.time_offset import TimeOffset, refine_time_offset
from hand_eye_calib.core.base.config import METHODS, defaults_of
from hand_eye_calib.core.base.errors import HandEyeCalibError, NotEnoughDataError
from hand_eye_calib.core.base.option import Options
from hand_eye_calib.core.checks import check as checking
from hand_eye_calib.core.checks import units
from hand_eye_calib.core.checks.check import CheckResult
from hand_eye_calib.core.checks.findings import Finding, Severity, finding, repair_message
from hand_eye_calib.core.checks.hypotheses import HOLDS
from hand_eye_calib.core.engine import readings as choosing
from hand_eye_calib.core.engine.attempts import STREAM_REPAIRS, Attempt, with_options
from hand_eye_calib.core.engine.kinds import kind_of
from hand_eye_calib.core.engine.poses import INVERSIONS
from hand_eye_calib.core.engine.snapshot import MOST_MOVED_S, UNASKED_S, Snapshot
from hand_eye_calib.core.pairing.motion_pairs import PosePairs
from hand_eye_calib.core.results.calibration import Calibration

#: Called with the share that is done, 0 to 1, and the step that begins.
Progress: TypeAlias = Callable[[float, str], None]

# Share of the time at which the checks begin; a guess, only shown.
_CHECKS_BEGIN = 0.8

_ESTIMATED_CLOCK: Options = {"time_offset": "estimate"}

# Findings whose options are certain.
_CERTAIN_CODES = ("time_offset", "scale", "units", "unit_or_scale")

# Findings whose options are estimated, so that their uncertainty counts.
_ESTIMATED_CODES = ("time_offset", "scale", "unit_or_scale")

# A clock rate counts as known if its spread is below this share of the largest time offset.
_CLEAR_SPREAD = 0.5


@dataclass(frozen=True)
class _Reading:
    """Chosen reading of both streams: its findings, doubts about the choice, and the options that
    are settled with it.
    """

    findings: tuple[Finding, ...]
    doubts: tuple[Finding, ...] = ()
    settled: frozenset[str] = frozenset()


def run(
    snapshot: Snapshot, *, checks: bool | None = None, progress: Progress | None = None
) -> Attempt:
    """Calibrate.

    Parameters
    ----------
    snapshot : Snapshot
        The streams, and the options.
    checks : bool, optional
        False: neither stream checks nor cross-checks, and no second solve. True: cross-checks also
        with a reference that the user set, which are left out otherwise.
    progress : callable, optional

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
    report(1.0, "done")
    return best


def review(calibration: Calibration, snapshot: Snapshot, settled: Collection[str] = ()) -> Attempt:
    """Check the streams of a result, and solve again if a check is certain of other options.

    Parameters
    ----------
    calibration : Calibration
    snapshot : Snapshot
        The poses and options that gave the result.
    settled : collection of str
        Options that an earlier check has settled; they stay, as those of the user do.
    """
    return _best(_checked(calibration, snapshot), settled, None)


def _solved_and_checked(snapshot: Snapshot, checks: bool | None, report: Progress) -> Attempt:
    """Return the best attempt at a snapshot."""
    on_clock = _on_another_clock(snapshot)
    if on_clock and on_clock.is_sound and not on_clock.check.readings:
        return _saying_estimates(on_clock, _ESTIMATED_CLOCK, ())
    try:
        calibration = snapshot.estimate(cross_check=checks)
    except NotEnoughDataError:
        # Some mistakes leave nothing to pair, or no scale to estimate.
        can_repair = kind_of(snapshot.config).has_conventions
        repaired = _repaired_unsolved(snapshot) if can_repair else None
        if not repaired:
            raise
        return repaired
    report(_CHECKS_BEGIN, "checking the streams")
    return _best(_checked(calibration, snapshot), (), on_clock)


def _best(first: Attempt, settled: Collection[str], on_clock: Attempt | None) -> Attempt:
    """Return the best of a first attempt and of those that its check asks for.

    ``on_clock`` is the attempt with an estimated time offset, if it was made before.
    """
    known_s = first.calibration.time_offset_s
    reading = _reading_of(first.snapshot, first.check, settled, known_s)
    first = first.with_findings(reading.findings)
    settled = reading.settled.union(settled)
    certain = _certain(first.check.findings, first.snapshot.config.given.union(settled))
    if {*certain} & {*STREAM_REPAIRS}:
        verdict = first.calibration.verdict.value
        repaired = _repaired(first.snapshot, first.check.findings, certain, settled, verdict)
        best = repaired or first
    else:
        best = _estimated(first, certain, settled, on_clock)
    return best.with_doubts(reading.doubts)


# ------------------------------------------------------------------ the clock


def _on_another_clock(snapshot: Snapshot) -> Attempt | None:
    """Return the attempt with an estimated time offset, if the angular rates show clearly that the
    clocks differ; None otherwise, or if no solve is saved by looking first.
    """
    config = snapshot.config
    is_free = config.method in ("auto", "adaptive") and config.reference == "auto"
    is_known = "time_offset" in config.given or len(snapshot.kept) > 0
    if is_known or not is_free or not kind_of(config).has_conventions:
        return None
    if not snapshot.correlation.is_clear:
        return None
    coarse = TimeOffset(snapshot.correlation.offset_s, correlation=snapshot.correlation)
    # Motions over one time suffice for a first look.
    look = refine_time_offset(*snapshot.streams, coarse, snapshot.max_gap_s, UNASKED_S)
    if look.fit is None or abs(look.seconds) - 3.0 * look.sigma_s < MOST_MOVED_S:
        return None
    # Streams with wrong conventions or units are solved as given first: the message of a repair
    # needs that verdict.
    if look.fit.has_own_unit or look.fit.unexplained > HOLDS:
        return None
    offset = refine_time_offset(*snapshot.streams, look, snapshot.max_gap_s)
    other = replace(snapshot, config=replace(config, **_ESTIMATED_CLOCK), time_offset=offset)
    return _solved_with(other, {})


def _clock_is_off(first: Attempt) -> bool:
    """Return whether the poses must be paired anew because of the time offset."""
    snapshot = first.snapshot
    calibration = first.calibration
    moved_s = abs(calibration.time_offset_s - float(snapshot.resolved.config.time_offset))
    clock = first.check.offset
    is_free = not METHODS[snapshot.config.method].uses_reference
    if clock and is_free and snapshot.config.reference == "auto":
        # The result has no clock rate, and that of DNLO no time offset: only the check has them.
        largest_s = clock.largest_s(snapshot.unpaired[1].duration_s)
        if clock.spread_s < _CLEAR_SPREAD * largest_s:
            moved_s = max(moved_s, largest_s - _CLEAR_SPREAD * clock.spread_s)
    return moved_s >= kind_of(snapshot.config).least_clock_change_s


# ------------------------------------------------------------------ two readings


def _reading_of(
    snapshot: Snapshot, result: CheckResult, settled: Collection[str], known_s: float
) -> _Reading:
    """Return the findings of the right reading of both streams, if two fit alike.

    ``known_s`` is the time offset (s) that the check was made with.
    """
    if INVERSIONS & snapshot.config.given.union(settled):
        return _Reading(_without_readings(result))
    if not result.readings:
        return _Reading(result.findings)
    left_s = result.offset.seconds if result.offset else 0.0
    clock: Options = {"time_offset": known_s + left_s}

    def pairs_of(options: Options) -> PosePairs:
        return with_options(snapshot, {**options, **clock}).pose_pairs

    def answer_with(options: Options) -> Calibration | None:
        attempt = _solved_with(snapshot, {**options, **clock})
        return attempt.calibration if attempt else None

    choice = choosing.choose(result, pairs_of, answer_with)
    return _Reading(choice.findings, choice.doubts, frozenset() if choice.is_repair else INVERSIONS)


def _without_readings(result: CheckResult) -> tuple[Finding, ...]:
    """Return the findings without those about both streams being inverse, which is settled."""
    return tuple(
        found
        for found in result.findings
        if found.code != "inverse_both" or found.severity is Severity.NOTE
    )


# ------------------------------------------------------------------ repairs


def _repaired_unsolved(snapshot: Snapshot) -> Attempt | None:
    """Return the attempt with repaired streams from which nothing could be solved as given; None if
    no repair is certain.
    """
    result = check(snapshot)
    reading = _reading_of(snapshot, result, (), snapshot.config.given_time_offset_s)
    certain = _certain(reading.findings, snapshot.config.given)
    repaired = _repaired(snapshot, reading.findings, certain, (), "no result")
    return repaired and repaired.with_doubts(reading.doubts)


def _repaired(
    snapshot: Snapshot,
    findings: Collection[Finding],
    certain: Options,
    settled: Collection[str],
    verdict_as_given: str,
) -> Attempt | None:
    """Return the attempt with repaired streams; None if the streams do not agree then.

    Time offset and scale are estimated after the repair, unless nothing can be paired before.
    """
    options = {name: value for name, value in certain.items() if value != "estimate"}
    second = _solved_with(snapshot, options) if options else None
    if not second and "time_offset" in certain:
        options["time_offset"] = "estimate"
        second = _solved_with(snapshot, options)
    if not second:
        return None
    settled = {*settled, *options}
    known_s = second.calibration.time_offset_s
    reading = _reading_of(second.snapshot, second.check, settled, known_s)
    second = second.with_findings(reading.findings)
    settled |= reading.settled
    left = _certain(second.check.findings, second.snapshot.config.given.union(settled))
    left = {name: value for name, value in left.items() if name not in STREAM_REPAIRS}
    second = _estimated(second, left, settled, None).with_doubts(reading.doubts)
    if any(map(_speaks_against_repair, second.check.findings)):
        return None
    verdict = second.calibration.verdict.value
    message = repair_message(
        [found for found in findings if {*found.options} & {*options}],
        options,
        f": {verdict}; as the streams are: {verdict_as_given}",
    )
    second = second.with_messages({**options, **second.options}, (message, *second.messages))
    # A ratio of lengths does not exclude that the child has its own scale.
    doubts = [
        replace(found, severity=Severity.WARNING, options={})
        for found in findings
        if (found.code, found.stream) == ("units", "parent")
    ]
    doubts += [found for found in findings if found.code == "ambiguous"]
    return _with_offset_doubt(second, doubts)


def _speaks_against_repair(found: Finding) -> bool:
    """Return whether the streams do not agree after a repair. Lengths that may be read in two ways
    do not show that.
    """
    return found.makes_unusable and found.code != "unit_or_scale"


# ------------------------------------------------------------------ estimates


def _estimated(
    first: Attempt, certain: Options, settled: Collection[str], on_clock: Attempt | None
) -> Attempt:
    """Return the attempt with an estimated time offset or scale, if a check asks for it and the
    result is better; otherwise the first attempt.
    """
    given = first.snapshot.config.given.union(settled)
    options = dict(certain)
    if "time_offset" not in given and _clock_is_off(first):
        options = {**_ESTIMATED_CLOCK, **options}
    if not options:
        return first
    second = on_clock if options == _ESTIMATED_CLOCK else None
    second = second or _solved_with(first.snapshot, options)
    if not second:
        return first
    if INVERSIONS & given:
        second = second.with_findings(_without_readings(second.check))
    n_fewer = 1 if certain else 0
    if not (second.is_better_than(first, n_fewer) or second.is_sound):
        return first
    findings = first.check.findings
    doubts = []
    if "parent_scale" not in given:
        doubtful = [found for found in findings if found.code == "unit_or_scale"]
        doubts = [_as_doubt(found, second.calibration) for found in doubtful]
    return _saying_estimates(second, options, findings).with_doubts(doubts)


def _as_doubt(found: Finding, calibration: Calibration) -> Finding:
    """Return the finding about lengths that may be read in two ways, once one way is taken: an
    error if the scale of the check, or that of the result, is a unit's within its uncertainty.
    """
    off = abs(calibration.scale - 1.0 / found.evidence["factor"])
    is_near = off <= units.UNIT_SIGMAS * calibration.scale_sigma
    is_exact = bool(found.evidence["is_exact"]) or is_near
    severity = Severity.ERROR if is_exact else Severity.WARNING
    return replace(found, severity=severity, options={})


def _saying_estimates(attempt: Attempt, options: Options, findings: Collection[Finding]) -> Attempt:
    """Return the attempt with warnings about the options that were set because of findings."""
    what = {name: found.what for found in findings for name in found.options}
    calibration = attempt.calibration
    offset_s = calibration.time_offset_s
    what["time_offset"] = (
        f"the child's clock is {abs(offset_s):.4f} +/- {calibration.time_offset_sigma_s:.4f} "
        f"s {checking.offset_values(offset_s)['direction']} the parent's"
    )
    rate = calibration.clock_rate
    if rate and rate.is_used:
        what["time_offset"] += f" and {rate}"
    usual = defaults_of(options)
    messages = [
        f"{what[name]}: solved with {name} {value}; to take the stream as it is, give {name} "
        f"{usual[name]}"
        for name, value in options.items()
    ]
    return _with_offset_doubt(attempt.with_messages(options, messages), [])


def _with_offset_doubt(attempt: Attempt, doubts: Collection[Finding]) -> Attempt:
    """Return the attempt with doubts, and with one about a large time offset that nobody gave."""
    offset_s = attempt.calibration.time_offset_s
    doubts = [*doubts]
    if "time_offset" in attempt.options and abs(offset_s) > UNASKED_S:
        large = finding("large_time_offset", "child", **checking.offset_values(offset_s))
        if large not in attempt.calibration.findings:
            doubts.append(large)
    return attempt.with_doubts(doubts)


# ------------------------------------------------------------------ one solve


def check(snapshot: Snapshot, calibration: Calibration | None = None) -> CheckResult:
    """Check the streams of a snapshot, with a result from them if there is one."""
    return kind_of(snapshot.config).check(snapshot, calibration)


def _checked(calibration: Calibration, snapshot: Snapshot) -> Attempt:
    """Return an attempt: a result, and the check of the streams with this result."""
    result = check(snapshot, calibration)
    return Attempt(replace(calibration, findings=result.findings), snapshot, result)


def _solved_with(snapshot: Snapshot, options: Options) -> Attempt | None:
    """Return the attempt with other options; None if nothing can be solved with them."""
    try:
        other = with_options(snapshot, options)
        return _checked(other.estimate(), other)
    except HandEyeCalibError:
        return None


def _certain(findings: Collection[Finding], given: Collection[str]) -> dict[str, float | str]:
    """Return the options, by name, that repair a stream for certain and that the user did not set.

    Units and conventions get their values. Time offset and scale are estimated, so that the result
    contains their uncertainty. A difference of lengths of a few per cent gives only a warning,
    because odometry with a drifting scale has the same effect.
    """
    certain: dict[str, float | str] = {}
    for found in findings:
        for name, value in found.options.items():
            is_clock_warning = name == "time_offset" and found.severity is Severity.WARNING
            is_convention = name.endswith(("invert", "quaternion"))
            is_known = found.code in _CERTAIN_CODES or is_convention
            if not is_known or name in given:
                continue
            if found.makes_unusable or is_clock_warning:
                certain[name] = "estimate" if found.code in _ESTIMATED_CODES else value
    return certain
