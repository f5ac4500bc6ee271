"""Tasks on several processes. What is solved can be kept in a file, so that an interrupted study
goes on.
"""

import contextlib
import json
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

# One thread each: the processes share the cores, and sums are taken in one order whatever the
# number of cores.
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def in_parallel(
    function: Callable[..., Any], tasks: Iterable[tuple[Any, ...]], jobs: int
) -> Iterator[Any]:
    """``function(*task)`` of every task on ``jobs`` processes, in the order of tasks."""
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
    """Plain values of ``function(*task)`` by name, of the tasks and of those that the file has from
    earlier runs. What the file has is not solved again: remove it after a change of the code.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    outcomes: dict[str, Any] = {}
    for line in (
        path.read_text(encoding="utf-8").splitlines() if path.exists() else ()
    ):
        with contextlib.suppress(ValueError):  # a line that was cut off
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
