"""Detection of lengths in another unit than metres, by the scale between two streams."""

from typing import Any, NamedTuple

from hand_eye_calib.core.checks.findings import Finding, finding
from hand_eye_calib.core.checks.streams import is_too_fast, is_too_slow
from hand_eye_calib.core.geometry.trajectory import Trajectory

_UNITS = {1e-3: "millimetres", 1e-2: "centimetres", 0.0254: "inches", 0.3048: "feet"}

# Largest distance of a scale from a unit, in standard deviations of the scale.
UNIT_SIGMAS = 3.0
# Largest distance of a scale without noise from the child's unit, as a share of the unit.
_UNIT_ROUNDING = 1e-6
# Largest distance of a scale from the parent's unit, as a share of the unit. Noise of the child
# biases the scale: by 0.2 % for simulated arms, which is several standard deviations.
_PARENT_UNIT_SHARE = 0.005
# A scale this close to a unit (share) may be that unit times a scale error of the odometry.
_UNIT_NEAR = 0.05


def in_other_units(
    scale: float, sigma: float, parent: Trajectory, child: Trajectory, known: float = 1.0
) -> Finding | None:
    """Return the finding that a stream's lengths are in another unit, or None.

    A scale below 1 that is within three standard deviations of a unit means that the child is in
    that unit. Any other scale below 1 is a scale of the child. A scale above 1 has two
    explanations: the parent is in a unit, or the child has a scale of its own, as that of a single
    camera. The ratio of lengths alone never changes the parent. The motion decides. A parent that
    would be too fast in metres is in that unit. A child that would hardly move in metres has a
    scale of its own. If both are plausible in metres, the finding names both explanations. It is an
    error within three standard deviations or 0.5 % of a unit, and a warning within 5 %. Two streams
    in one wrong unit have no ratio:
    :func:`~hand_eye_calib.core.checks.streams.check_lengths` detects them.

    Parameters
    ----------
    scale, sigma : float
        Factor of the child's lengths beside the known one, and its standard deviation.
    parent, child : Trajectory
        Streams as they are, without the known scale.
    known : float
        Known factor of the child's lengths.
    """
    # The solve may have found a known factor near 1 itself: the unit is then in the product.
    totals = (scale * known, scale) if 0.5 < known < 2.0 else (scale,)
    for total in totals:
        values: dict[str, Any] = {"scale": total, "sigma": sigma * total / scale}
        unit = _unit_of(total, values["sigma"])
        if unit and total > 1.0:
            return _parent_or_child(unit, values, parent, child)
        if unit and unit.is_exact:
            options = {"scale": round(unit.size_m * known * scale / total, 9)}
            values |= {"other": "parent", "unit": _UNITS[unit.size_m]}
            return finding("units", "child", options=options, **values)
    return None


class _Unit(NamedTuple):
    """A unit of length (m), and whether a scale is that of the unit within its uncertainty."""

    size_m: float
    is_exact: bool


def _unit_of(total: float, sigma: float) -> _Unit | None:
    """Return the unit near a scale, or near its inverse if the scale is above 1; None if none."""
    for unit_m in _UNITS:
        if total < 1.0:
            factor = unit_m
            share = _UNIT_ROUNDING
        else:
            factor = 1.0 / unit_m
            share = _PARENT_UNIT_SHARE
        difference = abs(total - factor)
        is_exact = difference <= max(UNIT_SIGMAS * sigma, share * factor)
        if is_exact or difference <= _UNIT_NEAR * factor:
            return _Unit(unit_m, is_exact)
    return None


def _parent_or_child(
    unit: _Unit, values: dict[str, Any], parent: Trajectory, child: Trajectory
) -> Finding | None:
    """Return the finding about a child whose lengths are shorter than the parent's by a unit.

    None if the child has a scale of its own.
    """
    if is_too_fast(parent) and not is_too_fast(child):
        options = {"parent_scale": unit.size_m}
        values |= {"other": "child", "unit": _UNITS[unit.size_m]}
        return finding("units", "parent", options=options, **values)
    if is_too_slow(child) and not is_too_slow(parent):
        return None
    options = {"scale": float(f"{values['scale']:.4g}")}
    values |= {"unit": _UNITS[unit.size_m], "factor": unit.size_m, "is_exact": unit.is_exact}
    return finding("unit_or_scale", "parent", options=options, **values)
