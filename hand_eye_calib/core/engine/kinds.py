"""Kinds of data, with the functions and limits that differ between kinds.

The steps to a result are the same for all kinds (:mod:`hand_eye_calib.core.engine.run`). A kind is
registered in ``KINDS`` (:mod:`hand_eye_calib.core.base.registry`) under the data of both sensors
together (``measured`` of :class:`~hand_eye_calib.core.base.config.CalibratorConfig`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.registry import KINDS, KINDS_OF_OPTIONS, MEASURES
from hand_eye_calib.core.checks.check import CheckResult
from hand_eye_calib.core.results.calibration import Calibration


@dataclass(frozen=True)
class Kind:
    """Kind of data, such as poses or positions, with its functions for solves and checks.

    Snapshots have type Any here, because :mod:`hand_eye_calib.core.engine.snapshot` imports this
    module.

    Attributes
    ----------
    solve : callable
        ``solve(snapshot, cross_check)`` returns a calibration without frame names. The snapshot has
        a time offset in seconds and enough pairs. If ``cross_check`` is None, the options decide
        whether the result is cross-checked.
    check : callable
        ``check(snapshot, calibration)`` checks the streams and returns a CheckResult. The
        calibration may be None.
    least_clock_change_s : float
        Smallest change of the time offset (s) for which the poses are paired anew.
    is_timed_by_speed : bool
        Whether the time offset is estimated from speeds instead of angular rates.
    allowed : mapping
        Options that this kind cannot obey, with the values that are still allowed because they
        change nothing.
    has_conventions : bool
        Whether checks detect wrong conventions, units and clocks even if the solve fails.
    """

    solve: Callable[[Any, bool | None], Calibration]
    check: Callable[[Any, Calibration | None], CheckResult]
    least_clock_change_s: float
    allowed: Mapping[str, tuple[object, ...]] = field(default_factory=dict)
    is_timed_by_speed: bool = False
    has_conventions: bool = False

    def require_allowed(self, config: CalibratorConfig) -> None:
        """Raise ConfigError if an option is set that this kind of data cannot obey.

        Raises
        ------
        ConfigError
            The message contains the name and the value of the option.
        """
        for name, kind in KINDS_OF_OPTIONS.items():
            if getattr(config, name) and kind != config.measured:
                words = [
                    word for word in MEASURES if MEASURES[word].kind == kind
                ]
                raise ConfigError(
                    f"{name} needs parent_measures {' or '.join(words)}"
                )
        for name, values in self.allowed.items():
            value = getattr(config, name)
            if value not in values:
                config.require_poses(f"{name} {value}")


def kind_of(config: CalibratorConfig) -> Kind:
    """Return the kind of data of two streams with these options."""
    kind: Kind = KINDS[config.measured]()
    return kind
