"""The command ``calibrate --batch``: tasks, workers, results, and what is printed of them."""

import argparse
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from hand_eye_calib.cli.batch.results import row_of, store, stored_outcomes, write_rows
from hand_eye_calib.cli.batch.tasks import INDEX, SOURCES, SUMMARY, TABLE, Task, read_batch
from hand_eye_calib.cli.batch.vehicles import Vehicle, vehicles_of
from hand_eye_calib.cli.batch.workers import Outcome, on_cores, on_dask
from hand_eye_calib.cli.console import note, print_table, waiting_for, with_progress
from hand_eye_calib.cli.options import options_from
from hand_eye_calib.cli.present import exit_code, wrapped
from hand_eye_calib.cli.reporting import REPORT, can_draw, save_text
from hand_eye_calib.plain import json_text
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.text import listing, with_sigma

_HEADINGS = (" x m", " y m", " z m", " roll deg", " pitch deg", " yaw deg", " poses", " warnings")


def run_batch(arguments: argparse.Namespace) -> int:
    """Calibrate from all bags of the file; returns the exit code.

    Raises
    ------
    HandEyeCalibError
        If the file cannot be used; a bag that fails is a row in the result.
    """
    out: Path | None = arguments.out
    given = {name: getattr(arguments, name) for name in SOURCES}
    sources = {
        name: value if isinstance(value, str) else ":".join(value)
        for name, value in given.items()
        if value
    }
    with waiting_for(f"reading {arguments.batch}"):
        tasks = read_batch(
            arguments.batch,
            options_from(arguments),
            sources,
            with_fingerprints=bool(out),
            with_report=bool(out) and can_draw(REPORT),
        )
    found = _outcomes(tasks, arguments)
    outcomes = [found[task.name] for task in tasks]
    vehicles = vehicles_of(outcomes)
    written = write_summary(out, str(arguments.batch), outcomes, vehicles) if out else []
    if arguments.json:
        print(json_text(_document(str(arguments.batch), outcomes, vehicles)))
    else:
        _print_results(outcomes, vehicles)
    alone = sum(bool(one["calibration"] and not one["vehicle"]) for one in outcomes)
    if alone > 1:
        note(
            f"{alone} recordings are not compared with each other: name their vehicles with "
            f"'vehicle:' in {arguments.batch}"
        )
    errors = {one["name"]: one["error"] for one in outcomes if one["error"]}
    for name, error in errors.items():
        note(f"{name} failed: {error}")
    for path in written:
        note(f"wrote {path}")
    if errors:
        return 1
    return max(exit_code(Calibration.from_dict(outcome["calibration"])) for outcome in outcomes)


def _outcomes(tasks: Sequence[Task], arguments: argparse.Namespace) -> dict[str, Outcome]:
    """Outcome of each task by its name: of an earlier run, or of this one."""
    out: Path | None = arguments.out
    with waiting_for("looking for earlier results"):
        found = stored_outcomes(tasks, out) if out else {}
    if found:
        note(f"{len(found)} of {len(tasks)} bags are done already; their results are in {out}")
    waiting = [task for task in tasks if task.name not in found]
    jobs = arguments.jobs or os.cpu_count() or 1
    with on_dask(arguments.dask) if arguments.dask else on_cores(jobs) as do:
        for task, outcome in with_progress(do(waiting), len(waiting), "calibrating"):
            page = outcome.pop("page", None)
            found[task.name] = outcome
            if out:
                store(task, outcome, page, out)
    return found


def _document(
    batch: str, outcomes: Sequence[Outcome], vehicles: Sequence[Vehicle]
) -> dict[str, object]:
    """Everything as plain values."""
    return {
        "batch": batch,
        "results": list(outcomes),
        "failures": [outcome["name"] for outcome in outcomes if outcome["error"]],
        "vehicles": [vehicle.to_dict() for vehicle in vehicles],
    }


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
    with waiting_for("writing the summary"):
        text = json_text(_document(batch, outcomes, vehicles))
        save_text(directory / SUMMARY, text + "\n")
        paths = [directory / TABLE]
        write_rows(paths[0], outcomes)
        if can_draw(INDEX):
            from hand_eye_calib.report.batch_page import render_batch

            rows = [row_of(outcome) for outcome in outcomes]
            with_report = {
                row["name"] for row in rows if (directory / row["name"] / REPORT).exists()
            }
            paths.append(directory / INDEX)
            save_text(paths[1], render_batch(batch, rows, [*map(vars, vehicles)], with_report))
    return paths


def _print_results(outcomes: Sequence[Outcome], vehicles: Sequence[Vehicle]) -> None:
    """Print a row for each recording, and what those of each vehicle say together."""
    of_vehicle = ["vehicle"] if any(outcome["vehicle"] for outcome in outcomes) else []
    headings = ("recording", *of_vehicle, "verdict", *_HEADINGS)
    print_table("", headings, (_cells(outcome, of_vehicle) for outcome in outcomes))
    verdicts = Counter(
        "failed" if one["error"] else one["calibration"]["verdict"] for one in outcomes
    )
    solved = len(outcomes) - verdicts["failed"]
    print(f"{solved} of {len(outcomes)} bags calibrated, {verdicts.pop('failed', 0)} failed")
    if verdicts:
        print(listing([f"{count} {verdict}" for verdict, count in verdicts.most_common()]))
    for vehicle in vehicles:
        if len(vehicle.rows) > 1:
            text = f"{vehicle.name}: {vehicle.sentence} {vehicle.of_newest}"
            print("\n".join(wrapped(text, "", "  ")))


def _cells(outcome: Outcome, of_vehicle: Sequence[str]) -> Iterator[str]:
    """Names, verdict, numbers with their standard deviations, counts."""
    calibration = outcome["calibration"]
    yield from (outcome[name] for name in ("name", *of_vehicle))
    if outcome["error"] or not calibration:
        yield "failed"
        return
    transform = calibration["T_parent_child"]
    yield calibration["verdict"]
    for kind, sigma, decimals in (("translation", "translation", 3), ("rpy_deg", "rpy_deg", 2)):
        numbers = zip(transform[kind], transform[f"sigma_{sigma}"], strict=True)
        yield from (with_sigma(*each, decimals) for each in numbers)
    yield str(calibration["n_poses"])
    yield str(len(calibration["warnings"]))
