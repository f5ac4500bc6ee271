"""Faults of two streams, entered by decorators: what is wrong, how much, and who names it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from hand_eye_calib.core.geometry.trajectory import Trajectory
from reproduction.changed_streams import Random

Streams = tuple[Trajectory, Trajectory]
_OfChild = Callable[[Trajectory, float, Random], Trajectory]
_OfBoth = Callable[[Trajectory, Trajectory, float, Random], Streams]


@dataclass(frozen=True)
class Fault:
    """A fault: its code, and what is wrong in words."""

    code: str
    what: str
    # The weakest first; one if it has no degrees.
    severities: tuple[float, ...]
    unit: str
    # ``damage(parent, child, severity, generator)``.
    damage: _OfBoth
    # Codes of findings that name it; empty if the checks were built without it.
    named: frozenset[str] = frozenset()
    # Of the calibration, besides its method.
    options: Mapping[str, Any] = field(default_factory=dict)


_ENTERED: list[Fault] = []
THREE = (0.0, 1.0, 2.0)
SECONDS = (0.05, 0.1, 0.2)


def both(
    code: str,
    what: str,
    severities: Any,
    unit: str = "",
    named: str = "",
    **options: Any,
) -> Callable[[_OfBoth], _OfBoth]:
    """Enter a fault of both streams; ``named`` has the codes, a space between them."""

    def enter(damage: _OfBoth) -> _OfBoth:
        names = frozenset(named.split())
        _ENTERED.append(
            Fault(code, what, severities, unit, damage, names, options)
        )
        return damage

    return enter


def child_alone(**about: Any) -> Callable[[_OfChild], _OfChild]:
    """Enter a fault of the child's stream alone; arguments are those of :func:`_both`."""

    def enter(change: _OfChild) -> _OfChild:
        def damage(
            parent: Trajectory, child: Trajectory, value: float, random: Random
        ) -> Streams:
            return parent, change(child, value, random)

        both(**about)(damage)
        return change

    return enter


def group(initials: str) -> tuple[Fault, ...]:
    """Return the entered faults whose codes have one of these initials."""
    return tuple(fault for fault in _ENTERED if fault.code[0] in initials)
