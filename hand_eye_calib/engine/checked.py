"""A result with what the stream checks found; solved again if they are certain of an option that
nobody gave.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from hand_eye_calib.alignment.time_offset import refine_time_offset
from hand_eye_calib.checks.check import CheckResult
from hand_eye_calib.checks.findings import Confidence, Finding, Severity
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.estimation import fixed_time_offset
from hand_eye_calib.engine.snapshot import GAP_INTERVALS, Snapshot, noise_fits
from hand_eye_calib.errors import HandEyeCalibError
from hand_eye_calib.methods import METHODS
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.results.calibration import Calibration

# Options that a check can be certain of.
_MENDED = ("time_offset", "scale")

# A model's own time offset moves poses along their velocities. From this one (s) on, poses are
# paired anew instead; positions alone later, as their model knows the offset better than speeds do.
_MOST_MOVED_S, _MOST_MOVED_POSITIONS_S = 0.003, 0.05


@dataclass(frozen=True)
class Mended:
    """A result after the stream checks.

    Attributes
    ----------
    calibration : Calibration
        With its findings.
    snapshot : Snapshot
        With the options that gave it.
    check : CheckResult
        Of its streams.
    options : dict
        What was set because a check is certain of it; empty if nothing was.
    told : tuple of str
        Warnings about that.
    """

    calibration: Calibration
    snapshot: Snapshot
    check: CheckResult
    options: dict[str, Any] = field(default_factory=dict)
    told: tuple[str, ...] = ()


def at_clear_offset(snapshot: Snapshot) -> Snapshot:
    """The snapshot with an estimated time offset if :func:`mend` would set that after a solve
    without: the solve without it is left out.
    """
    if "time_offset" in snapshot.config.given or not _has_clock(snapshot.config):
        return snapshot
    if not snapshot.correlation.is_clear:
        return snapshot
    config = snapshot.config
    clock = refine_time_offset(
        snapshot.parent, snapshot.child, snapshot.correlation, config.max_gap, least_s=_MOST_MOVED_S
    )
    if not clock.is_agreed or abs(clock.seconds) - 0.5 * clock.spread_s < _MOST_MOVED_S:
        return snapshot
    moved = replace(snapshot, config=replace(config, time_offset="estimate"), time_offset=clock)
    can_solve = all(len(each.pose_pairs()) >= config.min_pairs for each in (snapshot, moved))
    return moved if can_solve else snapshot


def _has_clock(config: CalibratorConfig) -> bool:
    """Whether the method may find a time offset of poses by itself."""
    uses_reference = METHODS[config.method].uses_reference or config.reference != "auto"
    return config.measured == "poses" and not uses_reference


def checked(
    calibration: Calibration, snapshot: Snapshot, *, may_mend: bool = True
) -> tuple[Calibration, Snapshot]:
    """Check the streams of a result, and mend what a check is certain of.

    Parameters
    ----------
    calibration : Calibration
    snapshot : Snapshot
        The poses it comes from.
    may_mend : bool
        False: nothing is solved again.

    Returns
    -------
    calibration : Calibration
        With its findings, and with a warning about each option that was set.
    snapshot : Snapshot
        With the options that gave it.
    """
    if not may_mend:
        return _with(calibration, snapshot.check(calibration).findings), snapshot
    found = mend(calibration, snapshot)
    warnings = dict.fromkeys((*found.told, *calibration.warnings, *found.calibration.warnings))
    return replace(found.calibration, warnings=tuple(warnings)), found.snapshot


def mend(calibration: Calibration, snapshot: Snapshot, settled: Collection[str] = ()) -> Mended:
    """Check the streams of a result. If a check is certain of the time offset or of the scale, and
    the user did not set it, solve again with it, and keep that if there is less to say against it.
    ``settled`` names options that an earlier check has set.
    """
    given = snapshot.config.given.union(settled)
    ahead = _set_ahead(calibration, snapshot, given)
    if ahead and _is_sound(ahead) and _is_large(ahead.calibration.time_offset_s, calibration):
        return replace(ahead, told=_told((), ahead.options, ahead.calibration))
    if ahead:
        snapshot = with_options(snapshot, {"time_offset": CalibratorConfig.time_offset})
        calibration = snapshot.estimate()
    by_model = _offset_of_model(calibration, snapshot, given)
    again = ahead if by_model and ahead else _solved_with(snapshot, by_model)
    if again and _is_sound(again):
        return replace(again, told=_told((), by_model, again.calibration))
    check = snapshot.check(calibration)
    found = Mended(_with(calibration, check.findings), snapshot, check)
    certain = _certain(check.findings, given)
    options = by_model | certain
    if options != by_model:
        again = _solved_with(snapshot, options)
    if again is None or (
        _serious(again.calibration) > _serious(found.calibration) - bool(certain)
        or (noise_fits(calibration) and not noise_fits(again.calibration))
    ):
        return found
    return replace(again, told=_told(check.findings, options, again.calibration))


def _set_ahead(
    calibration: Calibration, snapshot: Snapshot, given: Collection[str]
) -> Mended | None:
    """The result as it is if :func:`at_clear_offset` has set its time offset, otherwise None."""
    options = {"time_offset": snapshot.config.time_offset}
    if "time_offset" in given or options["time_offset"] != "estimate":
        return None
    check = snapshot.check(calibration)
    return Mended(_with(calibration, check.findings), snapshot, check, options)


def _solved_with(snapshot: Snapshot, options: Mapping[str, Any]) -> Mended | None:
    """What other options give; None without any, or if nothing can be solved with them."""
    if not options:
        return None
    try:
        other = with_options(snapshot, options)
        again = other.estimate()
        check = other.check(again)
    except HandEyeCalibError:
        return None
    return Mended(_with(again, check.findings), other, check, dict(options))


def with_options(snapshot: Snapshot, options: Mapping[str, Any]) -> Snapshot:
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
    parent, child = snapshot.streams
    max_gap_s = max(config.max_gap, GAP_INTERVALS * parent.interval_s)
    return replace(
        snapshot,
        config=replace(config, max_gap=max_gap_s),
        kept=PosePairs.empty(),
        buffered_parent=parent,
        buffered_child=child,
        paired_at=None,
        time_offset=None,
    )


def _with(calibration: Calibration, findings: Collection[Finding]) -> Calibration:
    return replace(calibration, findings=tuple(findings))


def _told(
    findings: Collection[Finding], options: Mapping[str, Any], calibration: Calibration
) -> tuple[str, ...]:
    """Warnings about options that were set, and what they gave."""
    what = {name: finding.what for finding in findings for name in finding.options}
    offset_s = calibration.time_offset_s
    what["time_offset"] = (
        f"the child's clock is {abs(offset_s):.4f} +/- {calibration.time_offset_sigma_s:.4f} s "
        f"{'behind' if offset_s > 0 else 'ahead of'} the parent's"
    )
    return tuple(
        f"{what[name]}: solved with {name} {value}; to take the stream as it is, give {name} "
        f"{getattr(CalibratorConfig, name)}"
        for name, value in options.items()
    )


def _certain(findings: Collection[Finding], given: Collection[str]) -> dict[str, Any]:
    """Options that mend a finding for certain and were not given, by name.

    A unit is set as it is. Anything else is estimated, so that its uncertainty counts. Lengths that
    differ by a few per cent only give a warning: odometry whose scale drifts looks like that, too.
    """
    return {
        name: value if finding.code == "units" else "estimate"
        for finding in findings
        if finding.confidence is Confidence.CERTAIN
        for name, value in finding.options.items()
        if name in _MENDED and name not in given and _is_grave(finding, name)
    }


def _offset_of_model(
    calibration: Calibration, snapshot: Snapshot, given: Collection[str]
) -> dict[str, Any]:
    """The option that pairs the poses anew if the model found a large time offset by itself."""
    moved_s = calibration.time_offset_s - fixed_time_offset(snapshot.resolved().config)
    is_set = "time_offset" not in given and _is_large(moved_s, calibration)
    return {"time_offset": "estimate"} if is_set else {}


def _is_large(moved_s: float, calibration: Calibration) -> bool:
    """Whether a model should not move poses by so much."""
    most_s = _MOST_MOVED_POSITIONS_S if calibration.measured == "positions" else _MOST_MOVED_S
    return abs(moved_s) >= most_s


def _is_grave(finding: Finding, option: str) -> bool:
    least = (Severity.ERROR,) if option == "scale" else (Severity.ERROR, Severity.WARNING)
    return finding.severity in least


def _is_sound(found: Mended) -> bool:
    """Whether there cannot be less to say against another result."""
    return noise_fits(found.calibration) and not _serious(found.calibration)


def _serious(calibration: Calibration) -> int:
    return sum(finding.severity is not Severity.NOTE for finding in calibration.findings)
