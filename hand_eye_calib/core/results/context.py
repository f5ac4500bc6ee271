"""Comparison of a result with what is installed, or of two results.

All are plain values under names, as in :mod:`hand_eye_calib.core.results.records`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class AxisDifference:
    """Difference on one axis (m, rad), its standard deviation (infinite if unknown), the change
    that would have been seen nine times out of ten, and the verdict: same, moved or cannot tell.
    """

    difference: float
    sigma: float
    visible: float
    verdict: str


@dataclass(frozen=True, kw_only=True)
class Difference:
    """How an extrinsic differs from another, axis by axis: ``second`` minus ``first``."""

    first: str
    second: str
    verdict: str
    sentence: str
    axes: Mapping[str, AxisDifference]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Comparison of a result with what is installed: where that comes from, its ``values`` by axis
    (m, rad), and the differences.
    """

    sentence: str
    verdict: str = ""
    installed: str = ""
    values: Mapping[str, float] = field(default_factory=dict)
    moved: tuple[str, ...] = ()
    differences: tuple[Difference, ...] = ()
