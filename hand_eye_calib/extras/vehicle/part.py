"""Part of a result with the parameters of the wheels: lines and files for the user."""

from typing import Any

from hand_eye_calib.core.base.text import with_sigma
from hand_eye_calib.core.results.parts import Part
from hand_eye_calib.extras.vehicle.controllers import controller_text
from hand_eye_calib.extras.vehicle.parameters import VehicleParameters

# Units of the parameters, by the last word of their names. Other parameters have no unit.
_UNITS = {
    "separation": " m",
    "wheelbase": " m",
    "offset": " rad",
    "curvature": " 1/m",
}


class WheelPart(Part):
    """Part of results with the parameters of the wheels."""

    file_names = ("controller_parameters.yaml",)

    def __init__(self) -> None:
        super().__init__("wheels", lambda: VehicleParameters)

    def headline(self, value: VehicleParameters) -> str:
        """Return the radius of the wheels. It is wrong if speeds have another unit."""
        if not value.radius:
            return ""
        unit = ", a factor for speeds in m/s" if value.is_factor else " m"
        return f"wheel radius {value.radius:.4f}{unit}"

    def details(self, value: VehicleParameters, result: Any) -> list[str]:
        """Return a line for each parameter, and the share of slip."""
        lines = []
        for parameter in value.parameters:
            value_and_sigma = with_sigma(parameter.value, parameter.sigma, 4)
            unit = _UNITS.get(parameter.name.rpartition("_")[2], "")
            if parameter.name.endswith("wheel_radius") and not value.is_factor:
                unit = " m"
            lines.append(f"{parameter.name}: {value_and_sigma}{unit}")
        return [*lines, f"the wheels slip {value.slip_share:.0%} of the time"]

    def files(self, value: VehicleParameters, result: Any) -> dict[str, str]:
        """Return the parameter file of a controller; empty for an unknown kind of wheels."""
        text = controller_text(value, result.headline)
        return {name: text for name in self.file_names if text}
