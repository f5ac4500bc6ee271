"""All rows of the study, on several processes, and where they are kept."""

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hand_eye_calib.errors import InputError
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

HERE = Path(__file__).parent
BASELINE = HERE / "baseline.json"

TABLES = ("simulated", "mixed", "levels", "known answer", "rig", "parts", "cycle", "refused")

# Digits that are kept of a case: more than noise, less than rounding.
_DIGITS = 4


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
    return [row for row in rows + together if row.cases]


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


def save(rows: Iterable[Row], path: Path) -> None:
    """Keep the rows, one per line."""
    lines = [json.dumps(_document(row), allow_nan=False, separators=(",", ":")) for row in rows]
    path.write_text('{"rows": [\n' + ",\n".join(lines) + "\n]}\n", encoding="utf-8")


def _document(row: Row) -> dict[str, object]:
    cases = {
        kind: {key: float(f"{value:.{_DIGITS}g}") for key, value in found.items()}
        for kind, found in row.cases.items()
    }
    return {
        "table": row.table,
        "name": row.name,
        "method": row.method,
        "seconds": round(row.seconds, 4),
        "cases": cases,
    }


def load(path: Path) -> dict[str, Row]:
    """Kept rows by their keys. Raises InputError if the file cannot be read."""
    try:
        documents = json.loads(path.read_text(encoding="utf-8"))["rows"]
        rows = [Row(**document) for document in documents]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"cannot read the rows in {path}: {error}; store new ones with --update-baseline"
        ) from None
    return {row.key: row for row in rows}
