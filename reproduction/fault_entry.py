"""Register of deliberate faults of two streams: damage, severities, and codes of findings.

Decorators add the faults to the register.
"""

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
    """A deliberate fault of two streams."""

    code: str
    # Description in words.
    what: str
    # Weakest severity first; a single value if the fault has only one strength.
    severities: tuple[float, ...]
    # Unit of the severities.
    unit: str
    # ``damage(parent, child, severity, generator)`` returns the streams with the fault.
    damage: _OfBoth
    # Codes of findings that name the fault; empty if no check was made for this fault.
    named: frozenset[str] = frozenset()
    # Options of the calibration, besides its method.
    options: Mapping[str, Any] = field(default_factory=dict)


_ENTERED: list[Fault] = []
# Severities of a fault with three variants.
THREE = (0.0, 1.0, 2.0)
# Severities of filters and delays (s).
SECONDS = (0.05, 0.1, 0.2)


def both(
    code: str,
    what: str,
    severities: Any,
    unit: str = "",
    named: str = "",
    **options: Any,
) -> Callable[[_OfBoth], _OfBoth]:
    """Register a fault of both streams; ``named`` contains the codes, separated by spaces."""

    def enter(damage: _OfBoth) -> _OfBoth:
        names = frozenset(named.split())
        _ENTERED.append(
            Fault(code, what, severities, unit, damage, names, options)
        )
        return damage

    return enter


def child_alone(**about: Any) -> Callable[[_OfChild], _OfChild]:
    """Register a fault of the child's stream alone; the arguments are those of :func:`both`."""

    def enter(change: _OfChild) -> _OfChild:
        def damage(
            parent: Trajectory, child: Trajectory, value: float, random: Random
        ) -> Streams:
            return parent, change(child, value, random)

        both(**about)(damage)
        return change

    return enter


def group(initials: str) -> tuple[Fault, ...]:
    """Return the registered faults whose codes begin with one of these letters."""
    return tuple(fault for fault in _ENTERED if fault.code[0] in initials)
