"""Estimated parameters of a vehicle's wheels, as a part of its result."""

from dataclasses import dataclass

# A radius in this range counts as a factor: the wheel data are then in m/s instead of rad/s. Wheels
# usually deviate from the drawing by less than 2 %, and only tractors have radii of a metre.
_FACTORS = (0.8, 1.25)


@dataclass(frozen=True)
class VehicleParameter:
    """Parameter of the wheels, with a standard deviation in the same unit."""

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
        in rad/s; it is a factor if they are in m/s. The value in the configuration of the wheel
        odometry must be multiplied by a multiplier.
    slip_share : float
        Share of the time (0 to 1) in which wheels and sensor disagree, because wheels slip.
    measures : str
        Kind of wheel data; empty in files of earlier versions.
    nominal_radius_m, nominal_separation_m : float
        Radius of a wheel, and distance between left and right wheels, from the options; 0 if
        unknown.
    """

    parameters: tuple[VehicleParameter, ...]
    slip_share: float
    measures: str = ""
    nominal_radius_m: float = 0.0
    nominal_separation_m: float = 0.0

    def __getitem__(self, name: str) -> VehicleParameter:
        """Return a parameter by its name."""
        return {parameter.name: parameter for parameter in self.parameters}[
            name
        ]

    @property
    def radius(self) -> float:
        """Mean radius of the wheels (m) or its factor; 0 for odometry, which has multipliers."""
        radii = [
            item.value
            for item in self.parameters
            if item.name.endswith("wheel_radius")
        ]
        return sum(radii) / len(radii) if radii else 0.0

    @property
    def is_factor(self) -> bool:
        """Whether the radius seems to be a factor, because the wheel data are in m/s."""
        lowest, highest = _FACTORS
        nominal = self.nominal_radius_m
        is_nominal = lowest * nominal <= self.radius <= highest * nominal
        return lowest <= self.radius <= highest and not is_nominal
