"""Findings about the clock offset, the scale and the unit of length between two streams."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from hand_eye_calib.core.alignment.similarity import SimilarityFit
from hand_eye_calib.core.alignment.time_offset import TimeOffset
from hand_eye_calib.core.base.text import with_sigma
from hand_eye_calib.core.checks.findings import Finding, finding, graded
from hand_eye_calib.core.checks.stream_pair import StreamPair
from hand_eye_calib.core.checks.units import in_other_units

# Code of the finding about rounded positions. Its severity depends on the unit of length.
ROUNDED = "coarse_positions"
# A smaller clock offset (s) is printed as none: half of the last digit, in milliseconds.
_NO_OFFSET_S = 0.0005


def check_offset(offset: TimeOffset, added_s: float) -> list[Finding]:
    """Return the finding about a clock offset, or an empty list.

    ``added_s`` (s) was already added to the child's stamps.
    """
    values = offset_values(offset.seconds, added_s) | {
        "sigma_s": offset.sigma_s,
        "size": with_sigma(abs(offset.seconds), offset.sigma_s, 4),
    }
    values["beyond"] = (
        f" beyond the {added_s:.4f} s that were added" if added_s else ""
    )
    values["options"] = {"time_offset": values["total_s"]}
    clocks_differ = graded(
        "time_offset", "child", offset.seconds, offset.sigma_s, **values
    )
    if not clocks_differ:
        return []
    if added_s and abs(values["total_s"]) <= max(
        3.0 * offset.sigma_s, _NO_OFFSET_S
    ):
        # The recorded clocks agree, so the added offset was wrong.
        values["options"] = {"time_offset": 0.0}
        severity = clocks_differ.severity
        return [finding("needless_time_offset", "child", severity, **values)]
    return [clocks_differ]


def offset_values(offset_s: float, added_s: float = 0.0) -> dict[str, Any]:
    """Return the values of a finding about a clock offset ``offset_s`` (s).

    ``total_s`` (s) is its sum with ``added_s`` (s), the offset that was added before.
    """
    values: dict[str, Any] = {"offset_s": offset_s, "size_s": abs(offset_s)}
    values["direction"] = "behind" if offset_s > 0 else "ahead of"
    return values | {"total_s": round(added_s + offset_s, 4)}


def check_model_scale(scale: float, sigma: float) -> list[Finding]:
    """Return the finding about the scale in the solution of the noise model, or an empty list.

    Parameters
    ----------
    scale, sigma : float
        Factor of the child's lengths, and its standard deviation; 0 if the scale was not
        estimated.
    """
    if sigma <= 0.0:
        return []
    # The factor corrects the child's lengths, so these are 1 / scale times too long.
    excess = 1.0 / scale - 1.0
    sigma_excess = sigma / scale**2
    other_scale = graded(
        "model_scale",
        "child",
        excess,
        sigma_excess,
        scale=scale,
        sigma=sigma,
        size=with_sigma(100.0 * abs(excess), 100.0 * sigma_excess, 1),
        than="longer" if excess > 0.0 else "shorter",
    )
    return [other_scale] if other_scale else []


def own_unit(
    streams: StreamPair, fit: SimilarityFit, used_scale: float
) -> Finding | None:
    """Return the finding that the child has another unit of length or another scale, or None.

    The result is None if the scale is near 1. The child's lengths already contain the factor
    ``used_scale``.
    """
    original_child = streams.child.scaled(1.0 / used_scale)
    sigma_and_bias = float(np.hypot(fit.scale_sigma, fit.scale_bias))
    unit = in_other_units(
        fit.scale, sigma_and_bias, streams.parent, original_child, used_scale
    )
    if unit:
        return unit
    total_scale = used_scale * fit.scale
    return graded(
        "scale",
        "child",
        fit.scale - 1.0,
        scale=total_scale,
        sigma=used_scale * fit.scale_sigma,
        options={"scale": float(f"{total_scale:.4g}")},
    )


def beside_solved_scale(found: Finding, scale: float, sigma: float) -> Finding:
    """Return a finding about the scale of streams whose scale was estimated by the solve.

    The finding then contradicts the solution, and no option repairs the streams. Other findings are
    unchanged.

    Parameters
    ----------
    found : Finding
    scale, sigma : float
        Solution: the factor of the child's lengths and its standard deviation.
    """
    if found.key != "scale":
        return found
    values: dict[str, Any] = {
        **found.values,
        "solved": scale,
        "solved_sigma": sigma,
    }
    return finding("scale_contradicted", found.stream, found.severity, **values)


def in_metres(
    findings: Sequence[Finding], units: Sequence[Finding], scale: float
) -> list[Finding]:
    """Return the findings, with the severity of rounded positions by their rounding in metres.

    Parameters
    ----------
    findings : sequence of Finding
        Findings about streams with the child's lengths multiplied by ``scale``.
    units : sequence of Finding
        Findings about the unit of length of a stream. Their options convert its lengths to metres.
    scale : float
        Factor of the child's lengths in ``findings``.
    """
    options: dict[str, Any] = {}
    for unit in units:
        if unit.code in ("units", "lengths"):
            options.update(unit.options)
    # Factors from the lengths in ``findings`` to metres.
    factors = {
        "parent": float(options.get("parent_scale", 1.0)),
        "child": float(options.get("scale", scale)) / scale,
    }
    graded_findings: list[Finding] = []
    for found in findings:
        if found.code != ROUNDED:
            graded_findings.append(found)
            continue
        step_m = found.evidence["step_m"] * factors[found.stream]
        if rounded := graded(ROUNDED, found.stream, step_m, step_m=step_m):
            graded_findings.append(rounded)
    return graded_findings
