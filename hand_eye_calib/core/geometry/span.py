"""Part of a recording between two times."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

from hand_eye_calib.core.base.arrays import BoolArray, IntArray
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.base.text import shown_value
from hand_eye_calib.core.geometry.trajectory import Trajectory

# Smallest time (s) that is a stamp: the year 1973 of the wall clock. A smaller time counts from
# the start of the recording; no recording has three years.
_LEAST_STAMP_S = 1e8


class Span(NamedTuple):
    """Start and end of the part of a recording that is used, both included.

    A time counts in seconds from the start of the recording: the first instant at which all streams
    have poses. If the streams never overlap, because their clocks differ, the time counts from the
    first pose of each stream. From 1e8 s on, a time is a stamp.

    Attributes
    ----------
    start_s, end_s : float or None
        None if the part begins or ends with the recording.
    """

    start_s: float | None = None
    end_s: float | None = None

    @classmethod
    def of(cls, start: Any = None, end: Any = None) -> Self:
        """Return the span from two options. Raise a ConfigError if they are not usable."""
        span = cls(_seconds("start", start), _seconds("end", end))
        if span.start_s is not None and span.end_s is not None:
            are_alike = _is_stamp(span.start_s) == _is_stamp(span.end_s)
            if are_alike and span.start_s >= span.end_s:
                raise ConfigError(
                    f"`start` {span.start_s:g} must be smaller than `end` {span.end_s:g}"
                )
        return span

    def __bool__(self) -> bool:
        return self != (None, None)

    def rows(
        self, stamps_ns: Sequence[IntArray], names: Sequence[str]
    ) -> list[BoolArray]:
        """Return masks of the poses of each stream in the span.

        Parameters
        ----------
        stamps_ns : sequence of (N,) arrays
            Stamps of each stream.
        names : sequence of str
            Names of the streams for messages.

        Raises
        ------
        InputError
            If a stream has no poses in the span.
        """
        first_ns = [int(stamps.min()) for stamps in stamps_ns]
        last_ns = [int(stamps.max()) for stamps in stamps_ns]
        if max(first_ns) < min(last_ns):
            first_ns = [max(first_ns)] * len(first_ns)
        masks = []
        for stamps, origin_ns, name in zip(
            stamps_ns, first_ns, names, strict=True
        ):
            mask = (
                stamps >= self._at_ns(self.start_s, origin_ns, -math.inf)
            ) & (stamps <= self._at_ns(self.end_s, origin_ns, math.inf))
            if not mask.any():
                duration_s = (int(stamps.max()) - origin_ns) * 1e-9
                raise InputError(
                    f"{name} has no poses {self}: it ends {duration_s:.1f} s after the start"
                )
            masks.append(mask)
        return masks

    def cut(
        self, trajectories: Sequence[Trajectory], names: Sequence[str]
    ) -> list[Trajectory]:
        """Return the parts of trajectories in the span; for parameters and errors see `rows`."""
        if not self:
            return [*trajectories]
        stamps_ns = [trajectory.stamps_ns for trajectory in trajectories]
        return [
            trajectory[mask]
            for trajectory, mask in zip(
                trajectories, self.rows(stamps_ns, names), strict=True
            )
        ]

    def _at_ns(
        self, seconds: float | None, origin_ns: int, default: float
    ) -> float:
        """Return a time of the span as a stamp (ns); ``default`` if it is not set."""
        if seconds is None:
            return default
        time_ns = round(seconds * 1e9)
        return time_ns if _is_stamp(seconds) else origin_ns + time_ns

    def __str__(self) -> str:
        parts = []
        if self.start_s is not None:
            parts.append(f"from `start` {self.start_s:.12g} s")
        if self.end_s is not None:
            parts.append(f"until `end` {self.end_s:.12g} s")
        return " ".join(parts)


#: The whole recording.
WHOLE = Span()


def _is_stamp(seconds: float) -> bool:
    return seconds >= _LEAST_STAMP_S


def _seconds(name: str, value: Any) -> float | None:
    """Return a time of a span in seconds; None if the option is not set."""
    if value is None:
        return None
    try:
        seconds = float(value)
    except (TypeError, ValueError):
        seconds = math.nan
    if not 0.0 <= seconds < math.inf:
        raise ConfigError(
            f"`{name}` must be seconds after the start of the recording, at least 0, or a stamp "
            f"in seconds; got {shown_value(value)}"
        )
    return seconds
