"""Axes that the streams of a result can determine, with their sigmas and targets."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from hand_eye_calib.core.base.text import (
    amount,
    amount_beside,
    axes_in_words,
    listing,
)
from hand_eye_calib.core.results.records import (
    ROTATIONS,
    TRANSLATIONS,
    DofVerdict,
)
from hand_eye_calib.core.results.result import Result


class ReachableAxis(NamedTuple):
    """An axis that the streams can determine.

    Attributes
    ----------
    name : str
        x, y, z, roll, pitch or yaw.
    sigma : float
        Measured standard deviation, m or rad.
    total : float
        Standard deviation with the allowance for constant errors.
    target : float
        Largest acceptable standard deviation.
    is_hidden : bool
        Whether this recording does not determine the axis.
    is_known_by_hand : bool
        Whether mostly or only a prior determines the axis.
    """

    name: str
    sigma: float
    total: float
    target: float
    is_hidden: bool
    is_known_by_hand: bool

    def sigma_beside_target(self) -> str:
        """Return the standard deviation with enough digits to distinguish it from the target."""
        return amount_beside(self.name, self.total, self.target)


def axes_within_reach(result: Result) -> list[ReachableAxis]:
    """Return the axes that the streams can determine, observable or not."""
    hidden = result.unobservable()
    totals = result.sigmas.tolist()
    return [
        ReachableAxis(
            name=dof.name,
            sigma=dof.sigma,
            total=total,
            target=target_of(dof.name, result),
            is_hidden=dof.name in hidden,
            is_known_by_hand=dof.verdict is DofVerdict.PRIOR,
        )
        for dof, total in zip(
            result.observability_measured, totals, strict=True
        )
        if dof.name not in result.out_of_reach
    ]


def target_of(axis: str, result: Result) -> float:
    """Return the target of an axis: the largest acceptable standard deviation (m or rad)."""
    default = (
        result.target_rotation
        if axis in ROTATIONS
        else result.target_translation
    )
    return float(result.target_axes.get(axis, default))


def amounts_in_words(
    axes: Iterable[tuple[str, float]], between: str = " "
) -> str:
    """List axes with their sizes (m or rad) in words."""
    texts = [
        f"{axes_in_words([name])}{between}{amount(name, size)}"
        for name, size in axes
    ]
    return listing(texts)


def targets_in_words(axes: Sequence[ReachableAxis]) -> str:
    """Return the targets of axes in words, without repetitions."""
    return listing(
        [*dict.fromkeys(amount(axis.name, axis.target) for axis in axes)]
    )


def kinds_to_declare(result: Result) -> list[str]:
    """Return the options, with their values, that would remove a part of the allowance."""
    # The allowance of a vehicle with wheels is for its sensor alone.
    streams = (
        ("child",) if result.reference == "windows" else ("parent", "child")
    )
    return [
        f"{stream}_kind exact"
        for stream in streams
        if stream not in result.exact_streams
    ]


def cause_of_allowance(result: Result) -> str:
    """Return the errors in words that the allowance is for."""
    if kinds_to_declare(result):
        of = "" if result.measured == "positions" else "odometry "
        return f"constant {of}errors"
    if result.measured == "positions":
        return "errors of a sensor's reference point"
    return "a delay of positions after their orientations"


def _differ_from_angles(result: Result) -> bool:
    """Return whether the sigmas about the axes differ from those of the printed angles."""
    sigmas_rad = (result.sigmas[3:].max(), result.sigmas_rpy.max())
    about, of_angles = [amount("roll", float(sigma)) for sigma in sigmas_rad]
    return about != of_angles


def what_is_known(result: Result) -> str:
    """Return the accuracy in words: the largest sigmas of translation and of rotation."""
    axes = axes_within_reach(result)
    texts = []
    for names in (TRANSLATIONS, ROTATIONS):
        if totals := [axis.total for axis in axes if axis.name in names]:
            texts.append(amount(names[0], max(totals)))
    if not result.out_of_reach:
        if _differ_from_angles(result):
            along, about = texts
            return (
                f"good to {along} along and {about} about each axis (1 sigma)"
            )
        return f"good to {listing(texts)} on every axis (1 sigma)"
    within_reach = listing([axis.name for axis in axes])
    hidden = listing(result.out_of_reach)
    good_to = f"{within_reach} are good to {listing(texts)} (1 sigma)"
    verb = "is" if len(result.out_of_reach) == 1 else "are"
    return f"{good_to}; {hidden} {verb} out of reach of these streams"
