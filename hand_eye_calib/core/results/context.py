"""Comparison of a result with the installed transform, or of two results.

The classes have plain values, like the classes in :mod:`hand_eye_calib.core.results.records`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class AxisDifference:
    """Difference of two extrinsics on one axis.

    Attributes
    ----------
    difference : float
        Translation along the axis (m) or rotation about the axis (rad).
    sigma : float
        Standard deviation of the difference; infinite if unknown.
    visible : float
        Smallest change that the comparison detects in nine of ten cases.
    verdict : str
        "same", "moved" or "cannot tell".
    """

    difference: float
    sigma: float
    visible: float
    verdict: str


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Difference of two extrinsics: ``second`` minus ``first``.

    Attributes
    ----------
    first, second : str
        Names of the extrinsics.
    verdict : str
        "same", "moved" or "cannot tell".
    sentence : str
        The verdict with its evidence.
    axes : mapping of str to AxisDifference
    change : str
        Axes that moved and their distances, in words; empty unless the verdict is "moved".
    """

    first: str
    second: str
    verdict: str
    sentence: str
    axes: Mapping[str, AxisDifference]
    change: str = ""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Comparison of a result with the installed transform.

    Attributes
    ----------
    sentence : str
        The verdict with its evidence, or the reason why there is no comparison.
    verdict : str
        "same", "moved" or "cannot tell"; empty without a comparison.
    installed : str
        Origin of the installed transform, such as a file or TF.
    values : mapping of str to float
        Installed transform by axis, m or rad.
    moved : tuple of str
        Names of the results that differ from the installed transform.
    differences : tuple of Difference
    """

    sentence: str
    verdict: str = ""
    installed: str = ""
    values: Mapping[str, float] = field(default_factory=dict)
    moved: tuple[str, ...] = ()
    differences: tuple[Difference, ...] = ()
