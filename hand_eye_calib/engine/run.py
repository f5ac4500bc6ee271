"""From two streams to a result: clock, pairs, solve, check, at most one second solve.

The only place that says so. The command line, Python, the node, batches and rigs call :func:`run`,
or :func:`review` for a result that they have already.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from hand_eye_calib.alignment.time_offset import TimeOffset, correlate_rates, refine_time_offset
from hand_eye_calib.checks import check as checking
from hand_eye_calib.checks import parts
from hand_eye_calib.checks.findings import Finding, Severity, answered, finding, gravest_first
from hand_eye_calib.config import METHODS, CalibratorConfig
from hand_eye_calib.engine import readings as choosing
from hand_eye_calib.engine.snapshot import MOST_MOVED_S, STREAMS, UNASKED_S, Snapshot
from hand_eye_calib.errors import HandEyeCalibError, NotEnoughDataError
from hand_eye_calib.option import Options
from hand_eye_calib.pairing.motion_pairs import PosePairs
from hand_eye_calib.results.calibration import Calibration, DofVerdict

#: Called with the share that is done, 0 to 1, and the step that begins.
Progress: TypeAlias = Callable[[float, str], None]

# What a clock that differs asks for.
_ESTIMATED: Options = {"time_offset": "estimate"}

# Findings whose options are certain; and options that repair a stream: the second solve proves it.
_MENDED = ("time_offset", "scale", "units", "unit_or_scale")
# Those whose values are estimated, so that their uncertainty counts.
_ESTIMATES = ("time_offset", "scale", "unit_or_scale")
_REPAIRS = ("parent_scale", *(f"{s}_{o}" for s in STREAMS for o in ("invert", "quaternion")))

# Options that settle which reading of the streams is right.
_INVERSIONS = frozenset({"parent_invert", "child_invert"})

# Positions alone are paired anew from this offset (s) on: their model knows it better than speeds
# do.
_MOST_MOVED_POSITIONS_S = 0.05

# Weighted squared residual per degree of freedom up to which a noise model fits: it is 1 if the
# model holds, and less if there is no noise.
_MAX_MISFIT = 2.0

# Share of the squared residuals of positions that belong to another path which a fault must explain
# to be named.
_NAMES_UNRELATED = 0.6

# Smaller time offsets (s) of streams that are no poses are found by every solve.
_FOUND_BY_SOLVE_S = 0.25


@dataclass(frozen=True)
class Run:
    """A result after the stream checks: with its findings, the snapshot with the options that gave
    it, and the check of its streams; ``options`` that were set because a check is certain of them,
    and the warnings about these, which the calibration has as well.
    """

    calibration: Calibration
    snapshot: Snapshot
    check: checking.CheckResult = field(default_factory=lambda: checking.CheckResult(()))
    options: Options = field(default_factory=dict)
    told: tuple[str, ...] = ()


def run(snapshot: Snapshot, *, checks: bool | None = None, progress: Progress | None = None) -> Run:
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
    tell = progress or (lambda share, step: None)
    tell(0.0, "solving")
    other = _on_another_clock(snapshot, checks)
    if other and _is_sound(other) and not other.check.readings:
        tell(1.0, "done")
        return _telling(other, _ESTIMATED, ())
    try:
        found = Run(snapshot.estimate(cross_check=checks), snapshot)
    except NotEnoughDataError:
        # With some mistakes the scale cannot be estimated, or poses not be paired.
        is_asked = checks is not False and snapshot.config.measured == "poses"
        repaired = _repaired_unsolved(snapshot) if is_asked else None
        if not repaired:
            raise
        found = repaired
    else:
        if checks is not False:
            tell(0.8, "checking the streams")
            found = _reviewed(_checked(found.calibration, snapshot), (), other)
    tell(1.0, "done")
    return found


def _on_another_clock(snapshot: Snapshot, checks: bool | None) -> Run | None:
    """The run with an estimated time offset, if the angular rates show clearly that the clocks
    differ; None otherwise, or if no solve is saved by looking first.
    """
    config = snapshot.config
    is_free = config.method in ("auto", "adaptive") and config.reference == "auto"
    is_known = "time_offset" in config.given or len(snapshot.kept) > 0 or checks is False
    if is_known or not is_free or config.measured != "poses" or not snapshot.correlation.is_clear:
        return None
    coarse = TimeOffset(snapshot.correlation.offset_s, correlation=snapshot.correlation)
    # Of motions over one time, in one step.
    look = refine_time_offset(*snapshot.streams, coarse, snapshot.max_gap_s, UNASKED_S)
    if look.fit is None or abs(look.seconds) - 3.0 * look.sigma_s < MOST_MOVED_S:
        return None
    offset = refine_time_offset(*snapshot.streams, look, snapshot.max_gap_s)
    other = replace(snapshot, config=replace(config, **_ESTIMATED), time_offset=offset)
    return _solved_with(other, {})


def review(calibration: Calibration, snapshot: Snapshot, settled: Collection[str] = ()) -> Run:
    """Check the streams of a result, from the poses and options that gave it. If a check is certain
    of the time offset or of the scale, and neither the user nor an earlier check has ``settled``
    it, solve once more with it, and keep that if there is less to say against it.
    """
    return _reviewed(_checked(calibration, snapshot), settled)


def _reviewed(first: Run, settled: Collection[str] = (), known: Run | None = None) -> Run:
    """Solve once more with what the checks of a run are certain of, and return the better of both.
    ``known`` is the run with an estimated time offset, if that was tried before.

    If two readings of the streams fit alike, inverse poses or not, one is chosen first.
    """
    given = first.snapshot.config.given.union(settled)
    if _INVERSIONS & given:
        return _bettered(_without_readings(first), settled, known)
    if not first.check.readings:
        return _bettered(first, settled, known)
    choice = _chosen(first.snapshot, first.check, first.calibration.time_offset_s)
    first = _with_findings(first, choice.findings)
    if not choice.is_repair:
        settled = _INVERSIONS.union(settled)
        known = known and _without_readings(known)
    return _doubting(_bettered(first, settled, known), choice.doubts)


def _chosen(snapshot: Snapshot, result: checking.CheckResult, known_s: float) -> choosing.Choice:
    """Choose between the two readings of a check. ``known_s`` is the time offset that the check was
    made with.
    """
    left_s = result.offset.seconds if result.offset else 0.0
    clock: Options = {"time_offset": known_s + left_s}

    def pairs_of(options: Options) -> PosePairs:
        return with_options(snapshot, {**options, **clock}).pose_pairs

    def answer_with(options: Options) -> Calibration | None:
        solved = _solved_with(snapshot, {**options, **clock})
        return solved.calibration if solved else None

    return choosing.choose(result, pairs_of, answer_with)


def _with_findings(found: Run, findings: tuple[Finding, ...]) -> Run:
    """The run with other findings, and no reading left to choose."""
    return replace(
        found,
        calibration=replace(found.calibration, findings=findings),
        check=replace(found.check, findings=findings, readings=None),
    )


def _without_readings(found: Run) -> Run:
    """The run without the findings about both streams being inverse, which is settled."""
    kept = [
        each
        for each in found.check.findings
        if each.code != "inverse_both" or each.severity is Severity.NOTE
    ]
    return _with_findings(found, tuple(kept))


def _repaired_unsolved(snapshot: Snapshot) -> Run | None:
    """The run with the options that repair streams from which nothing could be solved; None if
    there are none.
    """
    result = check(snapshot)
    findings = result.findings
    doubts: tuple[Finding, ...] = ()
    if result.readings and not _INVERSIONS & snapshot.config.given:
        offset_s = snapshot.config.time_offset
        known_s = 0.0 if isinstance(offset_s, str) else offset_s
        choice = _chosen(snapshot, result, known_s)
        findings, doubts = choice.findings, choice.doubts
    repaired = _repaired(snapshot, findings)
    return _doubting(repaired, doubts) if repaired else None


def _bettered(first: Run, settled: Collection[str], known: Run | None) -> Run:
    """:func:`_reviewed` once it is settled which poses are inverse."""
    calibration, snapshot, found = first.calibration, first.snapshot, first.check.findings
    given = snapshot.config.given.union(settled)
    options = _certain(found, given)
    if {*options} & {*_REPAIRS}:
        return _repaired(snapshot, found, settled, calibration.verdict.value) or first
    least = int(bool(options))
    moved_s = calibration.time_offset_s - float(snapshot.resolved.config.time_offset)
    is_free = not METHODS[snapshot.config.method].uses_reference
    if (clock := first.check.offset) and is_free and snapshot.config.reference == "auto":
        # Of a rate, and of DNLO, which has no offset of its own, only the check knows.
        left_s = clock.largest_s(snapshot.unpaired[1].duration_s)
        if clock.spread_s < 0.5 * left_s:
            moved_s = max(abs(moved_s), left_s - 0.5 * clock.spread_s)
    most_s = _MOST_MOVED_POSITIONS_S if calibration.measured == "positions" else MOST_MOVED_S
    if "time_offset" not in given and abs(moved_s) >= most_s:
        options = {**_ESTIMATED, **options}
    second = known if options == _ESTIMATED else None
    second = second or (_solved_with(first.snapshot, options) if options else None)
    if not second:
        return first
    if _INVERSIONS & given:
        second = _without_readings(second)
    (bad, n_first, fit_first), (is_bad, n_second, fit_second) = map(_against, (first, second))
    is_better = is_bad < bad or (n_second <= n_first - least and fit_second >= fit_first)
    if not (is_better or _is_sound(second)):
        return first
    doubts = []
    if "parent_scale" not in given:
        doubtful = [each for each in found if each.code == "unit_or_scale"]
        doubts = [_as_doubt(each, second.calibration) for each in doubtful]
    return _doubting(_telling(second, options, found), doubts)


def _as_doubt(found: Finding, calibration: Calibration) -> Finding:
    """Return the finding about lengths that may be read in two ways, once one way is taken: an
    error if the scale of the check, or that of the result, is a unit's within its uncertainty.
    """
    off = abs(calibration.scale - 1.0 / found.evidence["factor"])
    is_near = off <= checking.UNIT_SIGMAS * calibration.scale_sigma
    is_exact = bool(found.evidence["is_exact"]) or is_near
    severity = Severity.ERROR if is_exact else Severity.WARNING
    return replace(found, severity=severity, options={})


def _against(found: Run) -> tuple[bool, int, bool]:
    """If a run is unusable, how many findings speak against it, and if its noise model fits."""
    noise, findings = found.calibration.noise, found.check.findings
    serious = sum(one.severity is not Severity.NOTE for one in findings)
    fits = noise is not None and (noise.misfit or 0.0) <= _MAX_MISFIT
    return any(one.makes_unusable for one in findings), serious, fits


def _is_sound(found: Run) -> bool:
    return _against(found) == (False, 0, True)


def _repaired(
    snapshot: Snapshot,
    findings: Collection[Finding],
    settled: Collection[str] = (),
    as_they_are: str = "no result",
) -> Run | None:
    """The run with the options of the findings that repair the streams, saying so; None if there
    are none, or the streams do not agree then. ``as_they_are`` is the verdict without them.

    Clock and scale are compared again after the repair, unless nothing can be solved without the
    clock.
    """
    certain = _certain(findings, snapshot.config.given.union(settled))
    options = {name: value for name, value in certain.items() if value != "estimate"}
    second = _solved_with(snapshot, options) if options else None
    if not second and "time_offset" in certain:
        options["time_offset"] = "estimate"
        second = _solved_with(snapshot, options)
    second = _reviewed(second, {*settled, *options}) if second else None
    if not second or any(map(_speaks_against_repair, second.check.findings)):
        return None
    what = [each.what for each in findings if {*each.options} & {*options}]
    done = ", ".join(f"{name} {value}" for name, value in options.items())
    undo = ", ".join(f"{name} {getattr(CalibratorConfig, name)}" for name in options)
    told = (
        f"repaired: {'; '.join(what)}. Solved with {done}: {second.calibration.verdict.value}; as "
        f"the streams are: {as_they_are} (undo with {undo})"
    )
    second = _saying(second, {**options, **second.options}, (told, *second.told))
    # The child may have a scale of its own instead.
    doubtful = [each for each in findings if (each.code, each.stream) == ("units", "parent")]
    doubts = [replace(each, severity=Severity.WARNING, options={}) for each in doubtful]
    return _doubting(second, [*doubts, *(each for each in findings if each.code == "ambiguous")])


def _speaks_against_repair(found: Finding) -> bool:
    """Whether a finding shows that the streams do not agree after a repair. Lengths that may be
    read in two ways do not.
    """
    return found.makes_unusable and found.code != "unit_or_scale"


def _doubting(found: Run, doubts: Collection[Finding]) -> Run:
    """Add findings about options that were set; a large offset that nobody gave is one."""
    offset_s = found.calibration.time_offset_s
    if "time_offset" in found.options and abs(offset_s) > UNASKED_S:
        large = finding("large_time_offset", "child", **checking.offset_values(offset_s))
        doubts = [*doubts, *([] if large in found.calibration.findings else [large])]
    if not doubts:
        return found
    calibration, check = found.calibration, found.check
    return replace(
        found,
        calibration=replace(calibration, findings=gravest_first((*calibration.findings, *doubts))),
        check=replace(check, findings=gravest_first((*check.findings, *doubts))),
    )


def _saying(found: Run, options: Options, told: tuple[str, ...]) -> Run:
    """Add options that were set, and say so among the warnings."""
    warnings = tuple(dict.fromkeys((*told, *found.calibration.warnings)))
    calibration = replace(found.calibration, warnings=warnings)
    return replace(found, calibration=calibration, options=dict(options), told=told)


def with_options(snapshot: Snapshot, options: Options) -> Snapshot:
    """The snapshot with other options. Poses that were paired with another time offset are paired
    anew, from the stamps of the pairs.
    """
    if not options:
        return snapshot
    config = replace(snapshot.config, **options)
    if "time_offset" not in options:
        return replace(snapshot, config=config)
    if not len(snapshot.kept):
        return replace(snapshot, config=config, time_offset=None)
    # As they came in: what is put right is put right once.
    usual: Options = {name: getattr(CalibratorConfig, name) for name in _REPAIRS}
    parent, child = replace(snapshot, config=replace(snapshot.config, **usual)).streams
    return replace(
        snapshot,
        config=replace(config, max_gap=snapshot.max_gap_s),
        kept=PosePairs.empty(),
        buffered_parent=parent,
        buffered_child=child,
        paired_at=None,
        time_offset=None,
    )


def _checked(calibration: Calibration, snapshot: Snapshot) -> Run:
    found = check(snapshot, calibration)
    return Run(replace(calibration, findings=found.findings), snapshot, found)


def _solved_with(snapshot: Snapshot, options: Options) -> Run | None:
    """What other options give; None if nothing can be solved with them."""
    try:
        other = with_options(snapshot, options)
        return _checked(other.estimate(), other)
    except HandEyeCalibError:
        return None


def _telling(found: Run, options: Options, findings: Collection[Finding]) -> Run:
    """Add warnings about options that were set because of findings, and what they gave."""
    what = {name: each.what for each in findings for name in each.options}
    offset_s = found.calibration.time_offset_s
    what["time_offset"] = (
        f"the child's clock is {abs(offset_s):.4f} +/- {found.calibration.time_offset_sigma_s:.4f} "
        f"s {checking.offset_values(offset_s)['direction']} the parent's"
    )
    if (rate := found.calibration.clock_rate) and rate.is_used:
        what["time_offset"] += f" and {rate}"
    told = tuple(
        f"{what[name]}: solved with {name} {value}; to take the stream as it is, give {name} "
        f"{getattr(CalibratorConfig, name)}"
        for name, value in options.items()
    )
    return _doubting(_saying(found, options, told), ())


def _certain(findings: Collection[Finding], given: Collection[str]) -> dict[str, float | str]:
    """Options that repair a stream for certain and that the user did not set, by name.

    Units and conventions are set as they are. Anything else is estimated, so that its uncertainty
    counts. Lengths that differ by a few per cent only give a warning: odometry whose scale drifts
    looks like that, too.
    """
    certain = {}
    for each in findings:
        is_warning = each.severity is Severity.WARNING
        for name, value in each.options.items():
            is_sure = each.makes_unusable or (name == "time_offset" and is_warning)
            is_known = each.code in _MENDED or name.endswith(("invert", "quaternion"))
            if is_sure and is_known and name not in given:
                certain[name] = "estimate" if each.code in _ESTIMATES else value
    return certain


def check(snapshot: Snapshot, calibration: Calibration | None = None) -> checking.CheckResult:
    """Check the streams of a snapshot; of streams that are no poses, their sampling, and what the
    solve itself found. Time offset and scale of the result from them count as known; without one,
    those of the options, if they are given in numbers.
    """
    if snapshot.config.measured != "poses":
        return checking.CheckResult(gravest_first(_check_parts(snapshot, calibration)))
    offset_s = calibration.time_offset_s if calibration else snapshot.config.time_offset
    scale = calibration.scale if calibration else snapshot.config.scale
    known = None
    if calibration:
        sigmas = np.sqrt(np.diag(calibration.covariance_measured))
        is_known = not calibration.unobservable()
        known = calibration.T_parent_child, np.where(is_known, sigmas, np.inf)
    result = checking.check_streams(
        *snapshot.streams,
        time_offset_s=0.0 if isinstance(offset_s, str) else offset_s,
        scale=1.0 if isinstance(scale, str) else scale,
        max_gap_s=snapshot.max_gap_s,
        correlate=lambda: snapshot.correlation,
        known=known,
        are_exact=snapshot.config.parent_kind == snapshot.config.child_kind == "exact",
    )
    obsolete = set()
    if len(snapshot.kept):
        obsolete.add("gaps")  # pairs may have gaps where the streams have none
    if calibration and all(
        dof.verdict not in (DofVerdict.UNOBSERVABLE, DofVerdict.PRIOR)
        for dof in calibration.observability[:3]
    ):
        obsolete.add("one_axis")  # the result has shown otherwise
    findings = [found for found in result.findings if found.code not in obsolete]
    if calibration and snapshot.config.scale == "none":
        findings += checking.check_model_scale(calibration.scale, calibration.scale_sigma)
    findings = answered(findings, snapshot.config)
    if _INVERSIONS & snapshot.config.given:
        # Whether both streams are inverse is the user's word.
        is_said = [found.code == "inverse_both" for found in findings]
        findings = [
            replace(found, severity=Severity.NOTE) if said else found
            for found, said in zip(findings, is_said, strict=True)
        ]
    return replace(result, findings=gravest_first(findings))


def _check_parts(snapshot: Snapshot, calibration: Calibration | None) -> list[Finding]:
    """Findings about streams that are no poses; of the solve, those of its result."""
    found = [*calibration.findings] if calibration else []
    known_s = float(snapshot.resolved.config.time_offset)
    parent, child = snapshot.streams
    if not len(snapshot.kept):  # pairs may have gaps where the streams have none
        scale = calibration.scale if calibration else snapshot.config.scale
        in_metres = child.scaled(1.0 if isinstance(scale, str) else scale)
        found += checking.check_parts(parent, in_metres.shifted(known_s), snapshot.config.max_gap)
    hidden = calibration.hidden if calibration else []
    if len(hidden) == 3 or any(each.code == "unrelated" for each in found):
        of_speed, max_gap_s = snapshot.config.measured == "positions", snapshot.config.max_gap
        correlation = correlate_rates(parent, child.shifted(known_s), max_gap_s, of_speed)
        if correlation.is_clear and abs(correlation.offset_s) >= _FOUND_BY_SOLVE_S:
            sigma_s = max(parent.interval_s, child.interval_s) / 5
            offset = TimeOffset(correlation.offset_s, sigma_s, correlation)
            found += checking.check_offset(offset, known_s)
    codes = {each.code for each in found}
    if calibration and len(hidden) < 3 and "time_offset" not in codes:
        least = _NAMES_UNRELATED if "unrelated" in codes else 0.0
        found += parts.check_solved(parent, child, calibration, snapshot.config, least)
    if hidden and not any(each.makes_unusable for each in found):
        found.append(checking.unseen(hidden))
    return [each for index, each in enumerate(found) if each not in found[:index]]
