"""Kinds of data on the road from streams to a result, and what each of them supplies.

The road is the same for all kinds (:mod:`hand_eye_calib.core.engine.run`). A kind is registered in
``KINDS`` (:mod:`hand_eye_calib.core.base.registry`) under what both sensors measure together
(``measured`` of :class:`~hand_eye_calib.core.base.config.CalibratorConfig`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.registry import KINDS
from hand_eye_calib.core.checks.check import CheckResult
from hand_eye_calib.core.results.calibration import Calibration


@dataclass(frozen=True)
class Kind:
    """What differs between kinds of data.

    :mod:`hand_eye_calib.core.engine.snapshot` has the snapshots, and imports this module.

    Attributes
    ----------
    solve : callable
        ``solve(snapshot, cross_check)`` returns a calibration without frame names. The snapshot has
        a time offset in seconds and enough pairs. If ``cross_check`` is None, the options decide.
    check : callable
        ``check(snapshot, calibration)`` checks the streams; the calibration may be None.
    least_clock_change_s : float
        Smallest change of the time offset (s) after which the poses are paired anew.
    is_timed_by_speed : bool
        Whether the time offset is estimated from speeds, rather than from angular rates.
    allowed : mapping
        Options of whole poses that this kind cannot obey: the name of each option, and the values
        that may be set all the same.
    has_conventions : bool
        Whether checks detect wrong conventions, units and clocks even if no solve succeeds.
    """

    solve: Callable[[Any, bool | None], Calibration]
    check: Callable[[Any, Calibration | None], CheckResult]
    least_clock_change_s: float
    allowed: Mapping[str, tuple[object, ...]] = field(default_factory=dict)
    is_timed_by_speed: bool = False
    has_conventions: bool = False

    def require_allowed(self, config: CalibratorConfig) -> None:
        """Check that no option is set that this kind of data cannot obey.

        Raises
        ------
        ConfigError
            If such an option is set; the message names the option.
        """
        for name, values in self.allowed.items():
            value = getattr(config, name)
            if value not in values:
                config.require_poses(f"{name} {value}")


def kind_of(config: CalibratorConfig) -> Kind:
    """Return the kind of data that two streams with these options make together."""
    kind: Kind = KINDS[config.measured]()
    return kind
