"""Parameters of the wheels, as a part of results."""

from dataclasses import dataclass
from typing import Any

from hand_eye_calib.core.base.text import with_sigma

# Units of parameters, by the end of their names. Radii have none: see VehicleParameters.
_UNITS = {"separation": " m", "wheelbase": " m", "offset": " rad", "curvature": " 1/m"}


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


def details(wheels: VehicleParameters, result: Any) -> list[str]:
    """Return lines about the wheels for a person."""
    lines = []
    for parameter in wheels.parameters:
        value_and_sigma = with_sigma(parameter.value, parameter.sigma, 4)
        unit = _UNITS.get(parameter.name.rpartition("_")[2], "")
        lines.append(f"{parameter.name}: {value_and_sigma}{unit}")
    return [*lines, f"the wheels slip {wheels.slip_share:.1%} of the time"]
