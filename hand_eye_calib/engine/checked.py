"""A result with what the stream checks found; solved again if they are certain of an option that
nobody gave.
"""

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

from hand_eye_calib.calibration import Calibration
from hand_eye_calib.checks.findings import Confidence, Finding, Severity
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.estimation import fixed_time_offset
from hand_eye_calib.engine.snapshot import Snapshot
from hand_eye_calib.errors import HandEyeCalibError

# Options that a check can be certain of.
_MENDED = ("time_offset", "scale")

# A model's own time offset moves poses along their velocities. From this one (s) on, poses are
# paired anew instead.
_MOST_MOVED_S = 0.003


def checked(
    calibration: Calibration, snapshot: Snapshot, given: Collection[str] | None = None
) -> tuple[Calibration, Snapshot]:
    """Check the streams of a result.

    If a check is certain of the time offset or of the scale, and the option was not given, the
    extrinsic is solved again with it, and a warning of the result says so.

    Parameters
    ----------
    calibration : Calibration
    snapshot : Snapshot
        The poses it comes from.
    given : collection of str, optional
        Names of the options that were set. None: nothing is solved again.

    Returns
    -------
    calibration : Calibration
        With its findings.
    snapshot : Snapshot
        With the options that gave it.
    """
    if calibration.measured != "poses":
        return calibration, snapshot  # the checks are of poses; the solve has its own findings
    findings = snapshot.check(calibration).findings
    found = _with(calibration, findings)
    if given is None or len(snapshot.kept):
        return found, snapshot
    certain = _certain(findings, given)
    options = _offset_of_model(calibration, snapshot, given) | certain
    if not options:
        return found, snapshot
    mended = replace(snapshot, config=replace(snapshot.config, **options), time_offset=None)
    try:
        again = mended.estimate()
        again = _with(again, mended.check(again).findings)
    except HandEyeCalibError:
        return found, snapshot
    if _serious(again) > _serious(found) - bool(certain):
        return found, snapshot
    told = _told(findings, options) or (
        f"the child's clock is {again.time_offset_s:.4f} s off: solved with time_offset estimate",
    )
    warnings = dict.fromkeys((*told, *calibration.warnings, *again.warnings))
    return replace(again, warnings=tuple(warnings)), mended


def _told(findings: Collection[Finding], options: Mapping[str, Any]) -> tuple[str, ...]:
    """Warnings about findings that these options mend."""
    return tuple(
        f"{finding.what}: solved with {name} {options[name]}; to take the stream as it is, give "
        f"{name} {getattr(CalibratorConfig, name)}"
        for finding in findings
        for name, _ in finding.options
        if name in options
    )


def _with(calibration: Calibration, findings: Collection[Finding]) -> Calibration:
    return replace(calibration, findings=tuple(finding.to_dict() for finding in findings))


def _certain(findings: Collection[Finding], given: Collection[str]) -> dict[str, Any]:
    """Options that mend a finding for certain and were not given, by name.

    A unit is set as it is. Anything else is estimated, so that its uncertainty counts. Lengths that
    differ by a few per cent only give a warning: odometry whose scale drifts looks like that, too.
    """
    return {
        name: value if finding.code == "units" else "estimate"
        for finding in findings
        if finding.confidence is Confidence.CERTAIN
        for name, value in finding.options
        if name in _MENDED and name not in given and _is_grave(finding, name)
    }


def _offset_of_model(
    calibration: Calibration, snapshot: Snapshot, given: Collection[str]
) -> dict[str, Any]:
    """The option that pairs the poses anew if the model found a large time offset by itself."""
    moved_s = calibration.time_offset_s - fixed_time_offset(snapshot.resolved().config)
    return (
        {}
        if "time_offset" in given or abs(moved_s) < _MOST_MOVED_S
        else {"time_offset": "estimate"}
    )


def _is_grave(finding: Finding, option: str) -> bool:
    least = (Severity.ERROR,) if option == "scale" else (Severity.ERROR, Severity.WARNING)
    return finding.severity in least


def _serious(calibration: Calibration) -> int:
    return sum(finding["severity"] != Severity.NOTE.value for finding in calibration.findings)
