"""Bias of angular rates, as a part of results."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class RateBias:
    """Bias of angular rates and its standard deviation, rad/s, in the axes of the sensor ``of``."""

    of: str
    rad_per_s: tuple[float, ...]
    sigma: tuple[float, ...]
