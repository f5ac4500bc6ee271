"""Estimated parameters of the wheels of a vehicle, as a part of its result."""

from dataclasses import dataclass
from typing import Any

from hand_eye_calib.core.base.text import with_sigma

# Units of parameters, by the last word of their names. Other parameters are written without a unit.
_UNITS = {"separation": " m", "wheelbase": " m", "offset": " rad", "curvature": " 1/m"}


@dataclass(frozen=True)
class VehicleParameter:
    """Parameter of the wheels, with its standard deviation in the same unit."""

    name: str
    value: float
    sigma: float


@dataclass(frozen=True)
class VehicleParameters:
    """Parameters of the wheels of a vehicle.

    Attributes
    ----------
    parameters : tuple of VehicleParameter
        Lengths are in m, angles in rad, curvatures in 1/m. A radius is in m if the wheel data are
        in rad/s, and a factor if they are in m/s. A multiplier is the factor by which the value in
        the configuration of the wheel odometry must be multiplied.
    slip_share : float
        Share of the time (0 to 1) in which wheels and sensor disagree, because the wheels slip.
    """

    parameters: tuple[VehicleParameter, ...]
    slip_share: float

    def __getitem__(self, name: str) -> VehicleParameter:
        """Return a parameter by its name."""
        return {parameter.name: parameter for parameter in self.parameters}[name]


def details(wheels: VehicleParameters, result: Any) -> list[str]:
    """Return lines for the user about the parameters of the wheels."""
    lines = []
    for parameter in wheels.parameters:
        value_and_sigma = with_sigma(parameter.value, parameter.sigma, 4)
        unit = _UNITS.get(parameter.name.rpartition("_")[2], "")
        lines.append(f"{parameter.name}: {value_and_sigma}{unit}")
    return [*lines, f"the wheels slip {wheels.slip_share:.1%} of the time"]
