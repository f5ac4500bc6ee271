"""``python -m reproduction.vehicles``: calibrate sensors on simulated machines with wheels.

The machines drive figures of eight for three minutes. The motion of further drives does not
determine the pose of the sensor, or disturbs the estimate.
"""

import argparse
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.extras.vehicle.calibrate import calibrate_vehicle
from hand_eye_calib.offline.cli.main import exit_code_of
from reproduction.coverage.measures import HALF_WIDTH_90
from reproduction.machines import Machine, simulate_machine
from reproduction.writing import counted, markdown_table, seed_of, show

# Machines; "driving" is a machine with two driven wheels and without wheel data.
_MODELS = ("wheels", "steering", "tricycle", "omni", "mecanum", "driving")
_DEGENERATE = ("straight", "circle", "bend", "left", "spin")
# Drives that disturb the estimate: machine, course, factor of the slips, and slope of ramps (deg).
_DISTURBED = {
    "no slip": ("wheels", "eights", 0.0, 0.0),
    "slip 6 % of the time": ("wheels", "eights", 1.0, 0.0),
    "slip 30 % of the time": ("wheels", "eights", 5.0, 0.0),
    "slip in every curve": ("wheels", "eights", 15.0, 0.0),
    "ramps of 3 deg": ("wheels", "eights", 1.0, 3.0),
    "ramps of 8 deg": ("wheels", "eights", 1.0, 8.0),
    "tracks": ("skid", "eights", 1.0, 0.0),
    "articulated, tight curves": ("articulated", "eights", 1.0, 0.0),
    "articulated, wide curves": ("articulated", "wide", 1.0, 0.0),
}
# A result is wrong if an error exceeds this number of its standard deviations.
_BEYOND = 3.3


class Drive(NamedTuple):
    """Errors of a result and their standard deviations by name, and its verdict."""

    errors: Mapping[str, float]
    sigmas: Mapping[str, float]
    verdict: str
    headline: str

    @property
    def ratios(self) -> Mapping[str, float]:
        """Absolute errors divided by their standard deviations, of all determined unknowns."""
        ratios = {}
        for name, error in self.errors.items():
            if np.isfinite(self.sigmas[name]):
                ratios[name] = abs(error) / self.sigmas[name]
        return ratios


def drive(
    seed: int,
    model: str,
    course: str = "eights",
    slip: float = 1.0,
    ramp_deg: float = 0.0,
) -> Drive:
    """Simulate a machine and calibrate its sensor."""
    machine = simulate_machine(
        seed,
        "wheels" if model == "driving" else model,
        course,
        slip=slip,
        ramp_rad=np.radians(ramp_deg),
    )
    wheels = None if model == "driving" else machine.wheels
    result = calibrate_vehicle(machine.sensor, wheels, child_kind="exact")
    errors, sigmas = _errors_of(result, machine)
    return Drive(errors, sigmas, result.verdict.value, result.headline)


def _errors_of(
    result: Calibration, machine: Machine
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the errors of a result, and their standard deviations, by name."""
    T = result.T_parent_child
    T_true = machine.T_base_sensor
    turn = se3.rotation_of(T) @ se3.rotation_of(T_true).T
    roll, pitch, yaw = se3.rotation_log(turn).tolist()
    errors = {
        "x": float(T[0, 3] - T_true[0, 3]),
        "y": float(T[1, 3] - T_true[1, 3]),
        "roll": roll,
        "pitch": pitch,
        "yaw": yaw,
    }
    rows = {"x": 0, "y": 1, "roll": 3, "pitch": 4, "yaw": 5}
    sigmas = {name: float(result.sigmas[row]) for name, row in rows.items()}
    wheels = result.parts.get("wheels")
    if wheels is not None:
        errors["clock"] = result.time_offset_s - machine.clock_s
        sigmas["clock"] = result.time_offset_sigma_s
        for item, truth in zip(
            wheels.parameters, machine.parameters, strict=True
        ):
            unit = 1.0 if item.name.endswith("offset") else truth
            errors[item.name] = (item.value - truth) / unit
            sigmas[item.name] = item.sigma / unit
    return errors, sigmas


def disturbed(seed: int, n_drives: int) -> list[dict[str, object]]:
    """Return a row for each disturbed drive: largest errors of x, y and yaw, and verdicts."""
    rows: list[dict[str, object]] = []
    for name, (model, course, slip, ramp_deg) in _DISTURBED.items():
        results = [
            drive(seed + row, model, course, slip, ramp_deg)
            for row in range(n_drives)
        ]
        largest = {}
        ratios = []
        for axis in ("x", "y", "yaw"):
            errors = [abs(item.errors[axis]) for item in results]
            largest[axis] = _with_unit(axis, max(errors))
            ratios += [
                item.ratios[axis] for item in results if axis in item.ratios
            ]
        rows.append(
            {
                "Drive": name,
                **largest,
                "Largest, sigma": f"{max(ratios, default=np.nan):.1f}",
                "Verdicts": counted(item.verdict for item in results),
            }
        )
    return rows


def accuracy(drives: Iterable[Drive]) -> list[dict[str, object]]:
    """Return a row for each unknown: errors, and coverage of the 90 % intervals."""
    rows: list[dict[str, object]] = []
    drives = list(drives)
    for name in drives[0].errors:
        ratios = np.array(
            [item.ratios[name] for item in drives if name in item.ratios]
        )
        errors = np.array(
            [abs(item.errors[name]) for item in drives if name in item.ratios]
        )
        if not len(errors):
            continue
        rows.append(
            {
                "Unknown": name,
                "90 % of errors below": _with_unit(
                    name, float(np.quantile(errors, 0.9))
                ),
                "Largest": _with_unit(name, float(errors.max())),
                "90 % intervals cover": f"{np.mean(ratios < HALF_WIDTH_90):.0%}",
                "Largest, sigma": f"{ratios.max():.1f}",
            }
        )
    return rows


def _with_unit(name: str, error: float) -> str:
    if name in ("x", "y"):
        return f"{1e3 * error:.1f} mm"
    if name in ("roll", "pitch", "yaw", "steering_offset"):
        return f"{np.degrees(error):.3f} deg"
    return f"{1e3 * error:.1f} ms" if name == "clock" else f"{error:.2%}"


def summary(drives: Iterable[Drive]) -> str:
    """Return a line with the verdicts, and the coverage of the 90 % intervals of all unknowns."""
    drives = list(drives)
    ratios: list[float] = []
    n_wrong = 0
    for item in drives:
        ratios += item.ratios.values()
        n_wrong += item.verdict == "USE" and max(item.ratios.values()) > _BEYOND
    coverage = np.mean(np.array(ratios) < HALF_WIDTH_90)
    return (
        f"{counted(item.verdict for item in drives)}; the 90 % intervals cover {coverage:.1%} of "
        f"{len(ratios)} errors; USE beyond {_BEYOND} sigma: {n_wrong}"
    )


def main() -> int:
    """Simulate machines, calibrate their sensors, and print the tables."""
    parser = argparse.ArgumentParser(
        prog="python -m reproduction.vehicles", description=__doc__
    )
    parser.add_argument(
        "--drives",
        type=int,
        default=30,
        help="drives of each machine. Default: 30",
    )
    parser.add_argument(
        "--seed", type=int, help="default: a random seed at every run"
    )
    arguments = parser.parse_args()
    seed = seed_of(arguments.seed)
    print(f"seeds from {seed}\n")
    for model in _MODELS:
        drives = [drive(seed + row, model) for row in range(arguments.drives)]
        table = markdown_table(accuracy(drives))
        text = f"## {model}\n\n{summary(drives)}\n\n{table}\n"
        show(None, {model: text})
    rows = degenerate(seed, arguments.drives // 3)
    show(None, {"degenerate": markdown_table(rows)})
    rows = disturbed(seed, arguments.drives // 3)
    show(None, {"disturbed": markdown_table(rows)})
    return 0


def degenerate(seed: int, n_drives: int) -> list[dict[str, object]]:
    """Return a row for each course that does not determine the pose, and each machine."""
    rows: list[dict[str, object]] = []
    for course in _DEGENERATE:
        for model in _MODELS:
            drives = [
                drive(seed + row, model, course) for row in range(n_drives)
            ]
            n_wrong = 0
            for item in drives:
                largest = max(item.ratios.values(), default=0.0)
                n_wrong += item.verdict == "USE" and largest > _BEYOND
            headlines = Counter(item.headline for item in drives)
            [(headline, _)] = headlines.most_common(1)
            rows.append(
                {
                    "Course": course,
                    "Machine": model,
                    "Verdicts": counted(item.verdict for item in drives),
                    f"USE beyond {_BEYOND}": n_wrong,
                    "Most frequent headline": headline,
                }
            )
    return rows


if __name__ == "__main__":
    raise SystemExit(exit_code_of(main))
