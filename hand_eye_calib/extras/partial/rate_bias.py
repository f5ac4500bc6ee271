"""Bias of angular rates, stored in a result."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class RateBias:
    """Bias of angular rates.

    Attributes
    ----------
    of : str
        Sensor that has the bias, in whose axes the bias is: "parent", "child", or a sentence about
        the difference of two gyroscopes.
    rad_per_s, sigma : tuple of float
        Bias about x, y, z and its standard deviations, rad/s.
    """

    of: str
    rad_per_s: tuple[float, ...]
    sigma: tuple[float, ...]
