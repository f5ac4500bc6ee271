"""The bias of angular rates, as a part of results."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class RateBias:
    """Bias of angular rates, in the axes of the sensor that has it (``of``), rad/s."""

    of: str
    rad_per_s: tuple[float, ...]
    sigma: tuple[float, ...]
