"""Detect lengths in another unit than metres from the scale between two streams."""

from typing import Any, NamedTuple

from hand_eye_calib.core.checks.findings import Finding, finding
from hand_eye_calib.core.checks.streams import is_too_fast, is_too_slow
from hand_eye_calib.core.geometry.trajectory import Trajectory

# Names of the detected units of length, by their size in metres.
_UNITS = {
    1e-3: "millimetres",
    1e-2: "centimetres",
    0.0254: "inches",
    0.3048: "feet",
}

# A scale equals a unit if their difference is below the largest of the next limits. Limit in
# standard deviations of the scale.
UNIT_SIGMAS = 3.0
# Limit for a unit of the child, as a share of the unit. It covers rounding in data without noise.
_UNIT_ROUNDING = 1e-6
# Limit for a unit of the parent, as a share of the unit. It covers the bias of the scale by noise
# of the child: 0.2 % for simulated arms, which is several standard deviations.
_PARENT_UNIT_SHARE = 0.005
# A scale within this share of a unit may be that unit times a scale error of the odometry.
_NEAR_UNIT_SHARE = 0.05


def in_other_units(
    scale: float,
    sigma: float,
    parent: Trajectory,
    child: Trajectory,
    known: float = 1.0,
) -> Finding | None:
    """Return the finding that a stream's lengths are in another unit, or None.

    A scale below 1 and within three standard deviations of a unit means that the child has that
    unit. Any other scale below 1 is a scale error of the child.

    A scale above 1 near the inverse of a unit has two explanations: the parent has that unit, or
    the child has an unknown scale, like a single camera. The motion decides:

    - The parent has that unit if it would be too fast in metres.
    - The child has an unknown scale if it would hardly move in metres.
    - If both motions are plausible in metres, the finding names both explanations. It is an error
      if the scale is within three standard deviations or 0.5 % of the inverse unit, and a warning
      within 5 %.

    Two streams in the same wrong unit have the ratio 1:
    :func:`~hand_eye_calib.core.checks.streams.check_lengths` detects them.

    Parameters
    ----------
    scale, sigma : float
        Estimated factor of the child's lengths in addition to ``known``, and its standard
        deviation.
    parent, child : Trajectory
        Recorded streams, without the factor ``known``.
    known : float
        Factor of the child's lengths that the user gave.
    """
    # If the given factor is near 1, it may come from an earlier solve of the same streams. Try the
    # product of both factors first in this case.
    totals = (scale * known, scale) if 0.5 < known < 2.0 else (scale,)
    for total in totals:
        values: dict[str, Any] = {
            "scale": total,
            "sigma": sigma * total / scale,
        }
        unit = _unit_of(total, values["sigma"])
        if unit and total > 1.0:
            return _parent_or_child(unit, values, parent, child)
        if unit and unit.is_exact:
            options = {"scale": round(unit.size_m * known * scale / total, 9)}
            values |= {"other": "parent", "unit": _UNITS[unit.size_m]}
            return finding("units", "child", options=options, **values)
    return None


class _Unit(NamedTuple):
    """Unit of length (m), and whether a scale equals the unit within its uncertainty."""

    size_m: float
    is_exact: bool


def _unit_of(total: float, sigma: float) -> _Unit | None:
    """Return the unit near a scale, or None. A scale above 1 is compared with inverse units."""
    for unit_m in _UNITS:
        if total < 1.0:
            factor = unit_m
            share = _UNIT_ROUNDING
        else:
            factor = 1.0 / unit_m
            share = _PARENT_UNIT_SHARE
        difference = abs(total - factor)
        is_exact = difference <= max(UNIT_SIGMAS * sigma, share * factor)
        if is_exact or difference <= _NEAR_UNIT_SHARE * factor:
            return _Unit(unit_m, is_exact)
    return None


def _parent_or_child(
    unit: _Unit, values: dict[str, Any], parent: Trajectory, child: Trajectory
) -> Finding | None:
    """Return the finding that the parent may have a unit, because the scale is the inverse of it.

    The result is None if the child would be too slow in metres: its scale is then unknown.
    """
    if is_too_fast(parent) and not is_too_fast(child):
        options = {"parent_scale": unit.size_m}
        values |= {"other": "child", "unit": _UNITS[unit.size_m]}
        return finding("units", "parent", options=options, **values)
    if is_too_slow(child) and not is_too_slow(parent):
        return None
    options = {"scale": float(f"{values['scale']:.4g}")}
    values |= {
        "unit": _UNITS[unit.size_m],
        "factor": unit.size_m,
        "is_exact": unit.is_exact,
    }
    return finding("unit_or_scale", "parent", options=options, **values)
