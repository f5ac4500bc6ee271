"""``python -m reproduction.coverage``: do the stated intervals contain the true values?

Simulated recordings are also compared with the Cramer-Rao bound, the smallest possible covariance.
Real recordings have known extrinsics, or are calibrated several times.
"""

import os
import sys
from collections.abc import Sequence
from operator import call
from pathlib import Path
from typing import Any

from hand_eye_calib.offline.cli.main import exit_code_of
from reproduction.coverage import scores
from reproduction.coverage.classes import CLASSES
from reproduction.coverage.measures import KINDS, POOLED, Row, pooled
from reproduction.coverage.page import page
from reproduction.published import LEVELS, SIMULATED
from reproduction.recordings import CYCLE, Rig, real_rigs
from reproduction.runner import in_parallel
from reproduction.writing import seed_of, study_parser, write_csv

METHODS = tuple(scores.METHODS)
TABLES = (
    "simulated",
    "levels",
    "known answer",
    "rig",
    "parts",
    "cycle",
    "refused",
)

# Task that measures a row: its table, a function, and the arguments of the function.
_Task = tuple[Any, ...]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study, and return the exit code."""
    parser = study_parser(
        "reproduction.coverage", __doc__, page="write the page there"
    )
    add = parser.add_argument
    add(
        "--methods",
        nargs="+",
        choices=METHODS,
        default=METHODS,
        help="default: both",
    )
    add(
        "--tables",
        nargs="+",
        choices=TABLES,
        default=TABLES,
        help="default: all",
    )
    add(
        "--seeds",
        type=int,
        default=10,
        help="recordings per class. Default: 10",
    )
    add(
        "--seed",
        type=int,
        help="seed of the first recording. Default: a random seed at every run",
    )
    add("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    add("--rows", metavar="FILE", type=Path, help="write all rows there (CSV)")
    arguments = parser.parse_args(argv)

    def run() -> int:
        first = seed_of(arguments.seed)
        folder = arguments.data_folder
        seeds = range(first, first + arguments.seeds)
        rigs, absent = (
            real_rigs(folder) if folder else ([], ["every real recording"])
        )
        tasks = [
            task
            for method in arguments.methods
            for task in tasks_of(method, seeds, rigs, folder)
            if task[0] in arguments.tables
        ]
        rows = measure(tasks, arguments.methods, arguments.jobs)
        text = page(rows, absent, seeds)
        print(text)
        if arguments.page:
            arguments.page.write_text(text, encoding="utf-8")
        if arguments.rows:
            write_csv(arguments.rows, [_record_of(row) for row in rows])
        return 0

    return exit_code_of(run)


def _record_of(row: Row) -> dict[str, object]:
    """Return the values of a row by the names of the columns of a CSV file."""
    names = {name: getattr(row, name) for name in ("table", "name", "method")}
    values = {kind: row.value(kind) for kind in KINDS}
    return {**names, **values}


def measure(
    tasks: Sequence[_Task], methods: Sequence[str], jobs: int
) -> list[Row]:
    """Return the rows of all tasks, then the pooled rows; rows without values are left out."""
    rows: list[Row] = [*in_parallel(call, [task[1:] for task in tasks], jobs)]
    rows += [
        pooled(table, name, method, rows)
        for method in methods
        for table, name in POOLED.items()
    ]
    return [row for row in rows if any(row.cases.values())]


def tasks_of(
    method: str, seeds: range, rigs: Sequence[Rig], folder: Path | None
) -> list[_Task]:
    """Return the tasks of a method."""
    tasks: list[_Task] = [
        ("simulated", scores.class_row, name, method, seeds) for name in CLASSES
    ]
    if folder is not None:
        tasks += _tasks_of_levels(method, folder / "valimaki2023")
    for rig in rigs:
        tasks += _tasks_of_rig(method, rig)
    by_name = {rig.name: rig for rig in rigs}
    if set(CYCLE) <= set(by_name):
        cycle = {name: by_name[name] for name in CYCLE}
        tasks.append(("cycle", scores.cycle_row, cycle, method))
    return tasks


def _tasks_of_levels(method: str, folder: Path) -> list[_Task]:
    """Return the tasks of the published simulated data; none if the folder is absent."""
    if not folder.is_dir():
        return []
    return [
        ("levels", scores.level_row, folder, dataset, level, method)
        for dataset in SIMULATED
        for level in LEVELS[dataset]
    ]


def _tasks_of_rig(method: str, rig: Rig) -> list[_Task]:
    """Return the tasks of the recordings of a real rig."""
    names = list(rig.recordings)
    if rig.is_refused:
        return [
            ("refused", scores.refused_row, rig, name, method) for name in names
        ]
    tasks: list[_Task] = []
    if rig.truth is not None:
        tasks += [
            ("known answer", scores.truth_row, rig, name, method)
            for name in names
        ]
    if len(names) > 1:
        tasks.append(("rig", scores.scatter_row, rig, method))
    if rig.is_cut:
        tasks += [
            ("parts", scores.parts_row, rig, name, method) for name in names
        ]
    return tasks


if __name__ == "__main__":
    sys.exit(main())
