"""The command ``replay --batch``: tasks, workers, results, summary."""

import argparse
import json
import os
from collections.abc import Sequence
from pathlib import Path

from hand_eye_calib.calibration import Calibration
from hand_eye_calib.cli.batch.calibrating import Outcome
from hand_eye_calib.cli.batch.printing import print_results
from hand_eye_calib.cli.batch.store import store, stored_outcomes
from hand_eye_calib.cli.batch.summary import document_of, vehicles_of, write_summary
from hand_eye_calib.cli.batch.tasks import SOURCES, Task, read_batch
from hand_eye_calib.cli.batch.workers import on_cores, on_dask
from hand_eye_calib.cli.console import note, waiting_for, with_progress
from hand_eye_calib.cli.options import options_from
from hand_eye_calib.cli.present import exit_code
from hand_eye_calib.cli.reporting import REPORT, can_draw


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
        print(json.dumps(document, indent=2, allow_nan=False))
    else:
        print_results(outcomes, vehicles)
    for outcome in outcomes:
        if outcome["error"]:
            note(f"{outcome['name']} failed: {outcome['error']}")
    for path in written:
        note(f"wrote {path}")
    if any(outcome["error"] for outcome in outcomes):
        return 1
    return max(exit_code(Calibration.from_dict(outcome["calibration"])) for outcome in outcomes)
