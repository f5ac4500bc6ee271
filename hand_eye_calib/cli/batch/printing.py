"""The outcomes as a table for a terminal."""

import textwrap
from collections.abc import Sequence

from hand_eye_calib.cli.batch.calibrating import Outcome
from hand_eye_calib.cli.batch.summary import Vehicle
from hand_eye_calib.cli.listing import print_table
from hand_eye_calib.errors import printable
from hand_eye_calib.report.words import with_sigma

_HEADINGS = ("x m", "y m", "z m", "roll deg", "pitch deg", "yaw deg", "poses", "warnings")
_WIDTH = 100


def print_results(outcomes: Sequence[Outcome], vehicles: Sequence[Vehicle]) -> None:
    """Print a row for each recording, and what those of each vehicle say together."""
    from rich import box
    from rich.table import Table

    with_vehicles = any(outcome["vehicle"] for outcome in outcomes)
    table = Table(box=box.SIMPLE, pad_edge=False)
    for heading in ("recording", *(["vehicle"] if with_vehicles else []), "verdict"):
        table.add_column(heading)
    for heading in _HEADINGS:
        table.add_column(heading, justify="right")
    for outcome in outcomes:
        of_vehicle = [outcome["vehicle"]] if with_vehicles else []
        table.add_row(outcome["name"], *of_vehicle, *_cells(outcome))
    print_table(table)
    failed = sum(bool(outcome["error"]) for outcome in outcomes)
    print(f"{len(outcomes) - failed} of {len(outcomes)} bags calibrated, {failed} failed")
    for vehicle in vehicles:
        if len(vehicle.rows) > 1:
            print(textwrap.fill(printable(_said(vehicle)), _WIDTH, subsequent_indent="  "))


def _said(vehicle: Vehicle) -> str:
    """What all recordings say, and the newest against the earlier ones."""
    head = f"{vehicle.name}: " if vehicle.name else ""
    newest = vehicle.rows[-1]["name"]
    tail = (
        f" {newest} against the earlier ones: {vehicle.newest.sentence}." if vehicle.newest else ""
    )
    return f"{head}{vehicle.sentence}{tail}"


def _cells(outcome: Outcome) -> list[str]:
    """Verdict, numbers with their standard deviations, counts."""
    calibration = outcome["calibration"]
    if outcome["error"] or not calibration:
        return ["failed", *[""] * len(_HEADINGS)]
    transform = calibration["T_parent_child"]
    lengths = zip(transform["translation"], transform["sigma_translation"], strict=True)
    angles = zip(transform["rpy_deg"], transform["sigma_rpy_deg"], strict=True)
    return [
        calibration["verdict"],
        *(with_sigma(value, sigma, 3) for value, sigma in lengths),
        *(with_sigma(value, sigma, 2) for value, sigma in angles),
        str(calibration["n_poses"]),
        str(len(calibration["warnings"])),
    ]
