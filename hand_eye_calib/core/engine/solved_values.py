"""Findings and notes about clock offset and lengths, with the values of the solution."""

from dataclasses import replace

from hand_eye_calib.core.base.text import with_sigma
from hand_eye_calib.core.checks.clock_and_scale import offset_values
from hand_eye_calib.core.checks.findings import Finding
from hand_eye_calib.core.checks.findings import finding as new_finding
from hand_eye_calib.core.checks.streams import is_too_fast, is_too_slow
from hand_eye_calib.core.engine.snapshot import Snapshot
from hand_eye_calib.core.results.calibration import Calibration

# Two streams agree in length if the ratio of their lengths differs from 1 by less: the scale error
# of odometry.
_SAME_LENGTHS = 0.05


def with_solved_scale(finding: Finding, calibration: Calibration) -> Finding:
    """Return a finding about the scale with the scale of a result. Other findings are unchanged."""
    if (
        finding.code not in ("scale", "unit_or_scale")
        or not calibration.scale_sigma
    ):
        return finding
    scale = {"scale": calibration.scale, "sigma": calibration.scale_sigma}
    return replace(finding, values={**finding.values, **scale})


def with_solved_offset(finding: Finding, calibration: Calibration) -> Finding:
    """Return a finding about the clock offset with the time offset of a result; others unchanged.

    The check estimates its offset without a noise model, so it differs from the offset of the
    result.
    """
    if finding.key != "time_offset" or not calibration.time_offset_sigma_s:
        return finding
    values = offset_values(calibration.time_offset_s)
    sigma_s = calibration.time_offset_sigma_s
    size = with_sigma(abs(calibration.time_offset_s), sigma_s, 4)
    values |= {"sigma_s": sigma_s, "size": size, "beyond": ""}
    options = {"time_offset": values["total_s"]}
    return replace(
        finding, values={**finding.values, **values}, options=options
    )


def with_given_factor(
    finding: Finding, calibration: Calibration, factor: float
) -> Finding:
    """Return a finding about sensors in one place with its cause: a factor that the user gave.

    The finding is unchanged if the streams disagree in length without the parent's factor.
    """
    ratio = calibration.scale / factor
    is_same = finding.key in ("same_position", "same_frame")
    if not is_same or abs(ratio - 1.0) > _SAME_LENGTHS:
        return finding
    return new_finding(
        "given_factor",
        "parent",
        finding.severity,
        {"parent_scale": 1.0},
        **finding.values,
        factor=factor,
    )


def note_on_unit(snapshot: Snapshot) -> str:
    """Return a note that the parent may be in metres, and the child's scale wrong.

    The streams agree equally well with a unit of the parent and with a scale of the child, but the
    lengths of both results differ by a factor. The note is empty in these cases:

    - the user set the child's scale;
    - the user set no unit of the parent;
    - the parent would be too fast or too slow if its lengths were metres.
    """
    config = snapshot.config
    factor = config.parent_scale
    is_unit_given = "parent_scale" in config.given and factor != 1.0
    if not is_unit_given or "scale" in config.given:
        return ""
    as_metres = snapshot.streams[0].scaled(1.0 / factor)
    if is_too_fast(as_metres) or is_too_slow(as_metres):
        return ""
    return (
        f"the parent's lengths were multiplied by {factor:g}, as given. If they are metres, and "
        "the child's scale is wrong, give scale estimate instead: all lengths of the result are "
        f"then {1.0 / factor:.4g} times as long, and the streams agree equally well"
    )
