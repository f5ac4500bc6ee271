"""Smallest errors that a recording contradicts: a part of results, and a rule of the verdict."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from hand_eye_calib.core.base.text import (
    ABOUT,
    amount,
    axes_in_words,
    listing,
    two_digits,
)
from hand_eye_calib.core.results.axes import target_of
from hand_eye_calib.core.results.parts import Part
from hand_eye_calib.core.results.reasons import Ground
from hand_eye_calib.core.results.records import AXES, DofVerdict

#: An injected error is contradicted above this number of standard deviations (textbook: 1 of 370 by
#: chance).
SIGMAS = 3.0

#: Share of the trials that must find an error.
FOUND_SHARE = 0.9
# A normal variable exceeds this number of standard deviations, in size, in 1 - FOUND_SHARE of all
# cases.
_SIGMAS_OF_SHARE = 1.645

# Size of the control error, as a multiple of the error that should be detectable by the standard
# deviation. For 60 simulated recordings without faults, the largest ratio was 2.4.
_CONTROL = 3.0


class SizesAtFirstUse(Mapping[str, float]):
    """Sizes by axis. They are computed when the first of them is read.

    Most callers do not use these sizes, and the computation takes longer than a solve of DNLO. A
    copy for another process is a plain dictionary.

    Parameters
    ----------
    compute : callable
        Function ``compute()`` that returns the sizes by axis.
    """

    def __init__(self, compute: Callable[[], Mapping[str, float]]) -> None:
        self._compute = compute

    @cached_property
    def _sizes(self) -> dict[str, float]:
        sizes = dict(self._compute())
        # The function holds the poses, which are no longer needed.
        del self._compute
        return sizes

    def __getitem__(self, axis: str) -> float:
        return self._sizes[axis]

    def __iter__(self) -> Iterator[str]:
        return iter(self._sizes)

    def __len__(self) -> int:
        return len(self._sizes)

    def __repr__(self) -> str:
        return repr(self._sizes)

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (self._sizes,)


@dataclass(frozen=True)
class Detectability:
    """Smallest errors that the recording of a result contradicts; infinite if there are none.

    Attributes
    ----------
    errors : mapping of str to float
        Errors of the result along (m) and about (rad) the axes of the parent sensor. The allowance
        for constant errors does not explain them.
    shifts : mapping of str to float
        Shifts of the mount in the middle of the recording, along (m) and about (rad) these axes.
    time_offset_s : float
        Error of the time offset, s.
    scale : float
        Relative error of the scale.
    """

    errors: Mapping[str, float]
    shifts: Mapping[str, float]
    time_offset_s: float
    scale: float


class DetectabilityPart(Part):
    """Part of results with a :class:`Detectability`."""

    def __init__(self) -> None:
        super().__init__("detectability", lambda: Detectability)

    def invert(self, value: Detectability) -> None:
        """Return None: the axes of the other sensor have other errors."""

    def facts(self, value: Detectability | None, result: Any) -> list[str]:
        """Return sentences about the errors that would have been noticed."""
        if value is None:
            return []
        facts = []
        if errors := _amounts(value.errors):
            facts.append(
                f"Errors larger than {errors}{_of_streams(value)} would have been noticed: "
                "half of the recording contradicts such errors in nine of ten trials"
            )
        if shifts := _amounts(value.shifts):
            facts.append(
                f"Shifts of the mount half-way larger than {shifts} would have been noticed: the "
                "stream checks report such shifts in nine of ten trials"
            )
        return facts

    def brief_facts(
        self, value: Detectability | None, result: Any
    ) -> list[str]:
        """Return a sentence about the largest errors that would have been noticed."""
        if value is None:
            return []
        largest = []
        for axes in (AXES[:3], AXES[3:]):
            sizes = {axis: value.errors.get(axis, math.inf) for axis in axes}
            finite = [axis for axis in axes if math.isfinite(sizes[axis])]
            if not finite:
                continue
            text = amount(axes[0], max(sizes[axis] for axis in finite))
            if len(finite) < len(axes):
                names = listing([ABOUT.get(axis, axis) for axis in finite])
                text += (
                    f" about {names}" if axes[0] in ABOUT else f" along {names}"
                )
            largest.append(text)
        if not largest:
            return []
        return [f"Errors above {' or '.join(largest)} would have been noticed"]


def _of_streams(value: Detectability) -> str:
    """Return the detectable errors of clock and scale; empty if there are none."""
    if not (math.isfinite(value.time_offset_s) and math.isfinite(value.scale)):
        return ""
    milliseconds = two_digits(1e3 * value.time_offset_s)
    percent = two_digits(1e2 * value.scale)
    return f", {milliseconds} ms between the clocks and {percent}% of the child's lengths"


def _amounts(sizes: Mapping[str, float]) -> str:
    """List finite sizes with their axes, such as "2 cm along x and 0.12 deg about y"."""
    texts = []
    for axis, size in sizes.items():
        if math.isfinite(size):
            direction = (
                f"about {ABOUT[axis]}" if axis in ABOUT else f"along {axis}"
            )
            texts.append(f"{amount(axis, size)} {direction}")
    return listing(texts)


def _revealed(sizes: Mapping[str, float]) -> str:
    """Describe the errors that a recording reveals; none on axes with an infinite size."""
    hidden = tuple(
        axis for axis, size in sizes.items() if not math.isfinite(size)
    )
    texts = []
    if amounts := _amounts(sizes):
        texts.append(f"only errors above {amounts}")
    if hidden:
        texts.append(f"no error in {axes_in_words(hidden)}")
    return " and ".join(texts)


def promised_error(measured: float, allowance: float) -> float:
    """Return the detectable error that follows from the standard deviation of a result.

    One half of the recording judges an error in the result of the other half. The difference of
    both halves has twice the standard deviation of the whole recording.

    Parameters
    ----------
    measured, allowance : float
        Both parts of the standard deviation, m or rad.
    """
    threshold = SIGMAS * math.hypot(2.0 * measured, allowance)
    return threshold + _SIGMAS_OF_SHARE * 2.0 * measured


def find_undetectable(result: Any) -> Iterator[Ground]:
    """Yield a ground if a control error on some axes is not found in the recording."""
    detectability = result.parts.get("detectability")
    if detectability is None:
        return
    if any(
        dof.verdict is DofVerdict.PRIOR for dof in result.observability_measured
    ):
        # A prior or the ground may determine more than the motion can contradict.
        return
    sizes = {}
    promises = {}
    for axis, measured, allowance in zip(
        AXES, result.sigmas_measured, result.allowance, strict=True
    ):
        size = detectability.errors[axis]
        promised = promised_error(float(measured), float(allowance))
        is_large = size > SIGMAS * target_of(axis, result)
        if math.isfinite(promised) and is_large and size > _CONTROL * promised:
            sizes[axis] = size
            promises[axis] = promised
    if sizes:
        sentence = (
            f"the recording reveals {_revealed(sizes)}; by its standard "
            f"deviations, it should reveal errors above {_amounts(promises)}"
        )
        axes = tuple(sizes)
        advice = (
            f"compare {axes_in_words(axes)} with a drawing or a tape measure, or record longer "
            "with more varied motion"
        )
        yield Ground(sentence, advice, axes)
