"""All rows of the study, on several processes."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reproduction.coverage.classes import CLASSES
from reproduction.coverage.measures import POOLED, Row, pooled
from reproduction.coverage.mixed import MIXED
from reproduction.coverage.scores import (
    class_row,
    cycle_row,
    level_row,
    parts_row,
    refused_row,
    scatter_row,
    truth_row,
)
from reproduction.published import LEVELS, SIMULATED
from reproduction.recordings import CYCLE, Rig
from reproduction.runner import in_parallel

TABLES = ("simulated", "mixed", "levels", "known answer", "rig", "parts", "cycle", "refused")


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What to measure."""

    methods: tuple[str, ...]
    tables: tuple[str, ...] = TABLES
    rigs: tuple[Rig, ...] = ()
    # Folder of the paper's data.
    published: Path | None = None
    # Recordings per simulated class.
    seeds: int = 10


def measure(plan: Plan, jobs: int) -> list[Row]:
    """Rows of every class, level, rig and cycle for every method, then the pooled ones."""
    tasks = [task for method in plan.methods for task in _tasks(plan, method)]
    chosen = [tuple(rest) for table, *rest in tasks if table in plan.tables]
    rows: list[Row] = [*in_parallel(_measured, chosen, jobs)]
    together = [
        pooled(table, name, method, rows)
        for method in plan.methods
        for table, name in POOLED.items()
    ]
    return [row for row in rows + together if any(row.cases.values())]


def _tasks(plan: Plan, method: str) -> list[tuple[Any, ...]]:
    """Table, function and its arguments of every row."""
    tasks: list[tuple[Any, ...]] = [
        ("simulated", class_row, name, method, plan.seeds) for name in CLASSES
    ]
    tasks += [("mixed", class_row, name, method, plan.seeds) for name in MIXED]
    if plan.published is not None:
        tasks += [
            ("levels", level_row, plan.published, dataset, level, method)
            for dataset in SIMULATED
            for level in LEVELS[dataset]
        ]
    for rig in plan.rigs:
        names = list(rig.recordings)
        if rig.is_refused:
            tasks += [("refused", refused_row, rig, name, method) for name in names]
            continue
        if rig.truth is not None:
            tasks += [("known answer", truth_row, rig, name, method) for name in names]
        if len(names) > 1:
            tasks.append(("rig", scatter_row, rig, method))
        if rig.is_cut:
            tasks += [("parts", parts_row, rig, name, method) for name in names]
    by_name = {rig.name: rig for rig in plan.rigs}
    if set(CYCLE) <= set(by_name):
        tasks.append(("cycle", cycle_row, {name: by_name[name] for name in CYCLE}, method))
    return tasks


def _measured(function: Callable[..., Row], *arguments: Any) -> Row:
    return function(*arguments)
