"""The command ``replay --batch``: tasks, workers, results, and what is printed of them."""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from hand_eye_calib.cli.batch.results import (
    row_of,
    store,
    stored_outcomes,
    write_json,
    write_rows,
)
from hand_eye_calib.cli.batch.tasks import INDEX, SOURCES, SUMMARY, TABLE, Task, read_batch
from hand_eye_calib.cli.batch.vehicles import Vehicle, document_of, n_without_vehicle, vehicles_of
from hand_eye_calib.cli.batch.workers import Outcome, on_cores, on_dask
from hand_eye_calib.cli.console import note, print_table, waiting_for, with_progress
from hand_eye_calib.cli.options import options_from
from hand_eye_calib.cli.present import exit_code, wrapped
from hand_eye_calib.cli.reporting import REPORT, can_draw, save_page
from hand_eye_calib.errors import printable
from hand_eye_calib.plain import json_text
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.text import with_sigma

_HEADINGS = ("x m", "y m", "z m", "roll deg", "pitch deg", "yaw deg", "poses", "warnings")


def run_batch(arguments: argparse.Namespace) -> int:
    """Calibrate from all bags of the file; returns the exit code.

    Raises
    ------
    HandEyeCalibError
        If the file cannot be used; a bag that fails is a row in the result.
    """
    out: Path | None = arguments.out
    with waiting_for(f"reading {arguments.batch}"):
        tasks = read_batch(
            arguments.batch,
            options_from(arguments),
            _sources_from(arguments),
            with_fingerprints=bool(out),
            with_report=bool(out) and can_draw(REPORT),
        )
    outcomes = _outcomes(tasks, arguments)
    return _finish([outcomes[task.name] for task in tasks], arguments)


def _outcomes(tasks: Sequence[Task], arguments: argparse.Namespace) -> dict[str, Outcome]:
    """Outcome of each task by its name: of an earlier run, or of this one."""
    out: Path | None = arguments.out
    with waiting_for("looking for earlier results"):
        found = stored_outcomes(tasks, out) if out else {}
    if found:
        note(f"{len(found)} of {len(tasks)} bags are done already; their results are in {out}")
    waiting = [task for task in tasks if task.name not in found]
    on_dask_or_here = (
        on_dask(arguments.dask)
        if arguments.dask
        else on_cores(arguments.jobs or os.cpu_count() or 1)
    )
    with on_dask_or_here as do:
        for task, outcome in with_progress(do(waiting), len(waiting), "calibrating"):
            page = outcome.pop("page", None)
            found[task.name] = outcome
            if out:
                store(task, outcome, page, out)
    return found


def _sources_from(arguments: argparse.Namespace) -> dict[str, str]:
    """Topics and frames that the command line gives for all bags."""
    given = {name: getattr(arguments, name) for name in SOURCES}
    return {
        name: value if isinstance(value, str) else ":".join(value)
        for name, value in given.items()
        if value
    }


def _finish(outcomes: Sequence[Outcome], arguments: argparse.Namespace) -> int:
    """Write and print the summary; returns the exit code."""
    vehicles = vehicles_of(outcomes)
    written = []
    if arguments.out:
        with waiting_for("writing the summary"):
            written = write_summary(arguments.out, str(arguments.batch), outcomes, vehicles)
    if arguments.json:
        document = document_of(str(arguments.batch), outcomes, vehicles)
        print(json_text(document))
    else:
        print_results(outcomes, vehicles)
    if (alone := n_without_vehicle(outcomes)) > 1:
        note(
            f"{alone} recordings are not compared with each other: name their vehicles with "
            f"'vehicle:' in {arguments.batch}"
        )
    for outcome in outcomes:
        if outcome["error"]:
            note(f"{outcome['name']} failed: {outcome['error']}")
    for path in written:
        note(f"wrote {path}")
    if any(outcome["error"] for outcome in outcomes):
        return 1
    return max(exit_code(Calibration.from_dict(outcome["calibration"])) for outcome in outcomes)


def write_summary(
    directory: Path, batch: str, outcomes: Sequence[Outcome], vehicles: Sequence[Vehicle]
) -> list[Path]:
    """Write everything as JSON, the rows as a table, and the index page; returns the paths of the
    last two.

    Raises
    ------
    InputError
        If they cannot be written.
    """
    write_json(directory / SUMMARY, document_of(batch, outcomes, vehicles))
    write_rows(directory / TABLE, outcomes)
    paths = [directory / TABLE]
    if can_draw(INDEX):
        from hand_eye_calib.report.batch_page import render_batch

        rows = [row_of(outcome) for outcome in outcomes]
        with_report = [(directory / row["name"] / REPORT).exists() for row in rows]
        page = render_batch(batch, rows, [vars(vehicle) for vehicle in vehicles], with_report)
        paths.append(save_page(directory / INDEX, page))
    return paths


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
            newest = vehicle.rows[-1]["name"]
            tail = (
                f" {newest} against the earlier ones: {vehicle.newest.sentence}."
                if vehicle.newest
                else ""
            )
            for line in wrapped(f"{vehicle.name}: {vehicle.sentence}{tail}", "", "  "):
                print(printable(line))


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
