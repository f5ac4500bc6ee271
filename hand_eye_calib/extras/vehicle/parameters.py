"""Parameters of the wheels, as a part of results."""

from dataclasses import dataclass
from typing import Any

from hand_eye_calib.core.base.text import with_sigma


@dataclass(frozen=True)
class VehicleParameter:
    """Parameter of the wheels and its standard deviation, in m, rad, 1/m or without a unit."""

    name: str
    value: float
    sigma: float


@dataclass(frozen=True)
class VehicleParameters:
    """Parameters of the wheels of a vehicle.

    Attributes
    ----------
    parameters : tuple of VehicleParameter
        Radii are metres per unit of the wheel data: metres if the data are in rad/s, and factors
        if they are in m/s. Multipliers multiply the values that an odometry was made with.
    slip_share : float
        Share of the time in which wheels and sensor disagree, because the wheels slip.
    """

    parameters: tuple[VehicleParameter, ...]
    slip_share: float

    def __getitem__(self, name: str) -> VehicleParameter:
        """Return a parameter by its name."""
        return {parameter.name: parameter for parameter in self.parameters}[name]


def details(value: VehicleParameters, result: Any) -> list[str]:
    """Return lines about the wheels for a person."""
    lines = []
    for parameter in value.parameters:
        lines.append(f"{parameter.name}: {with_sigma(parameter.value, parameter.sigma, 4)}")
    return [*lines, f"the wheels slip {value.slip_share:.1%} of the time"]
