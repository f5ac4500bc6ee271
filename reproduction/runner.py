"""Tasks on several processes. What is solved can be kept in a file, so that an interrupted run goes
on.
"""

import hashlib
import importlib.metadata
import json
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing
from pathlib import Path
from typing import Any

from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3

_HERE = Path(__file__).parent
_PACKAGE = Path(se3.__file__).parents[1]
# The code that the paper's results depend on: if it changes, stored results are discarded.
_CODE = (
    *(_HERE / f"{name}.py" for name in ("published", "ali_as_published", "sources", "rows")),
    _PACKAGE / "assessment" / "metrics.py",
    *(_PACKAGE / name for name in ("pairing", "solvers", "geometry", "simulation")),
)

# One thread each: the processes share the cores, and sums are taken in one order whatever the
# number of cores.
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Store:
    """Results by name in a file, one line of JSON each, under a line with what they depend on.

    Results that were stored for another configuration are removed; lines that are cut off are left
    out. Raises InputError if the file cannot be made, or is no such file.
    """

    def __init__(self, path: Path, configuration: Mapping[str, Any]) -> None:
        self._path = path
        self.found: dict[str, Any] = {}
        first = json.dumps({"configuration": configuration})
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
            if lines and not lines[0].startswith('{"configuration"'):
                raise InputError(f"{path} has no stored results: move it, or choose another --out")
            if not lines or lines[0] != first:
                path.write_text(first + "\n", encoding="utf-8")
                return
            if not path.read_text(encoding="utf-8").endswith("\n"):
                self._append("")
        except OSError as error:
            raise InputError(
                f"cannot keep results in {path}: {error.strerror}; choose another directory with "
                "--out"
            ) from None
        for line in lines[1:]:
            try:
                document = json.loads(line)
            except ValueError:
                continue
            self.found[document["name"]] = document["result"]

    def keep(self, name: str, result: object) -> None:
        """Add a result of plain values."""
        self.found[name] = result
        self._append(json.dumps({"name": name, "result": result}))

    def _append(self, line: str) -> None:
        with open(self._path, "a", encoding="utf-8") as file:
            file.write(line + "\n")


def solve(
    function: Callable[..., Any],
    tasks: Mapping[str, tuple[Any, ...]],
    jobs: int,
    store: Store,
    on_done: Callable[[str], object] = lambda name: None,
) -> dict[str, Any]:
    """``function(*task)`` of every named task that is not in the store yet; its results are plain
    values. ``on_done`` is called with every name as its result becomes available, in any order.
    Gives name to result, in the order of ``tasks``.
    """
    missing = [name for name in tasks if name not in store.found]
    for name in tasks.keys() - set(missing):
        on_done(name)

    with closing(_on_processes(function, [tasks[name] for name in missing], jobs)) as results:
        for number, result in results:
            store.keep(missing[number], result)
            on_done(missing[number])
    return {name: store.found[name] for name in tasks}


def in_parallel(
    function: Callable[..., Any], tasks: Iterable[tuple[Any, ...]], jobs: int
) -> list[Any]:
    """``function(*task)`` of every task on ``jobs`` processes; a list in the order of tasks."""
    found = dict(_on_processes(function, list(tasks), jobs))
    return [found[number] for number in sorted(found)]


def _on_processes(
    function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], jobs: int
) -> Generator[tuple[int, Any]]:
    """The number and the result of every task as it ends. The processes are killed if the caller
    ends before: one that waits to hand over a result which nobody takes would not see a signal that
    Python handles.
    """
    if jobs == 1 or not tasks:
        yield from ((number, function(*task)) for number, task in enumerate(tasks))
        return
    for name in _ONE_THREAD:
        os.environ.setdefault(name, "1")
    others = set(multiprocessing.active_children())
    spawning = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(min(jobs, len(tasks)), spawning, _start_worker)
    try:
        # Processes that are started now inherit that SIGINT is blocked: their parent ends them.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        futures = {executor.submit(function, *task): number for number, task in enumerate(tasks)}
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for future in as_completed(futures):
            yield futures[future], future.result()
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        ours = set(multiprocessing.active_children()) - others
        for child in ours:
            child.kill()
        # Not ``join``: it returns at once for a process that the executor's thread has collected,
        # before that thread has noted it.
        while ours.intersection(multiprocessing.active_children()):
            time.sleep(0.01)
        raise
    executor.shutdown()


def _start_worker() -> None:
    """End with the parent process, however it ends."""
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)


def versions() -> dict[str, str]:
    """Of the code and the libraries that the paper's results depend on."""
    code = hashlib.sha256()
    for entry in _CODE:
        for path in sorted(entry.rglob("*.py")) or [entry]:
            code.update(path.read_bytes())
    return {"code": code.hexdigest()} | {
        name: importlib.metadata.version(name) for name in ("numpy", "scipy")
    }
