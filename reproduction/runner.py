"""Run tasks in several processes, and keep their results in a file.

An interrupted study continues with the tasks whose results the file does not contain.
"""

import contextlib
import json
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

# Environment variables that limit a process to one thread. The processes share the cores, and the
# order of sums must not depend on the number of cores.
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def in_parallel(
    function: Callable[..., Any], tasks: Iterable[tuple[Any, ...]], jobs: int
) -> Iterator[Any]:
    """Yield ``function(*task)`` of every task, in the order of tasks, from ``jobs`` processes."""
    tasks = list(tasks)
    if jobs == 1 or not tasks:
        yield from (function(*task) for task in tasks)
        return
    for name in _ONE_THREAD:
        os.environ.setdefault(name, "1")
    spawning = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(jobs, len(tasks)), spawning) as executor:
        for future in [executor.submit(function, *task) for task in tasks]:
            yield future.result()


def kept(
    path: Path,
    function: Callable[..., Any],
    tasks: Mapping[str, tuple[Any, ...]],
    jobs: int,
) -> dict[str, Any]:
    """Return ``function(*task)`` by the names of the tasks, and store new results in a file.

    Results must be plain values. Tasks whose result is in the file are not solved again, so remove
    the file after a change of the code. Results of earlier runs with other names are returned, too.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = []
    if path.exists():
        lines = path.read_text(encoding="utf-8").splitlines()
    outcomes: dict[str, Any] = {}
    for line in lines:
        # An interrupted run may have left an incomplete line.
        with contextlib.suppress(ValueError):
            outcomes |= json.loads(line)
    missing = [name for name in tasks if name not in outcomes]
    results = in_parallel(function, [tasks[name] for name in missing], jobs)
    with path.open("a", encoding="utf-8") as file:
        for name, result in zip(missing, results, strict=True):
            outcomes[name] = result
            print(
                "",
                json.dumps({name: result}),
                sep="\n",
                end="",
                file=file,
                flush=True,
            )
    return outcomes
