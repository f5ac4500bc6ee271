"""Solves the cells of an experiment on several cores and stores them, so that an interrupted run
continues.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import multiprocessing
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from reproduction.rows import Cell, Row, solve_cell

if TYPE_CHECKING:
    from reproduction.sources import Source

_HERE = Path(__file__).parent
_PACKAGE = Path(se3.__file__).parents[1]
# The code that results depend on: if it changes, stored results are discarded.
_CODE = (
    *(_HERE / f"{name}.py" for name in ("published", "ali_as_published", "sources", "rows")),
    _PACKAGE / "assessment" / "metrics.py",
    *(_PACKAGE / name for name in ("pairing", "solvers", "geometry", "simulation")),
)

# One thread each: the processes share the cores, and sums are taken in one order whatever the
# number of cores.
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class Store:
    """Solved cells in a folder, one file each.

    Parameters
    ----------
    folder : pathlib.Path
        Created if absent. Results that an earlier run stored for another configuration are
        removed.
    configuration : dict
        Settings that the results depend on, besides the code.

    Raises
    ------
    InputError
        If the folder cannot be made.
    """

    def __init__(self, folder: Path, configuration: Mapping[str, Any]) -> None:
        self._folder = folder
        manifest = folder / "configuration.json"
        wanted = json.loads(json.dumps({**configuration, **_versions()}))
        try:
            if manifest.exists() and _read(manifest) != wanted:
                shutil.rmtree(folder)
            folder.mkdir(parents=True, exist_ok=True)
            _write(manifest, wanted)
        except OSError as error:
            raise InputError(
                f"cannot keep results in {folder}: {error.strerror}; choose another "
                "directory with --out"
            ) from None

    def load(self, cell: Cell) -> list[Row] | None:
        """Rows of a cell; None if it is not solved yet."""
        rows = _read(self._path(cell))
        return (
            None
            if rows is None
            else [Row(**{name: _frozen(value) for name, value in row.items()}) for row in rows]
        )

    def save(self, cell: Cell, rows: Sequence[Row]) -> None:
        """Store the rows of a cell."""
        _write(self._path(cell), [vars(row) for row in rows])

    def _path(self, cell: Cell) -> Path:
        return self._folder / f"{cell.name}.json"


def run(
    source: Source,
    cells: Sequence[Cell],
    store: Store,
    jobs: int,
    on_done: Callable[[Cell], object] = lambda cell: None,
) -> dict[Cell, list[Row]]:
    """Solve the cells that are not in the store yet.

    Parameters
    ----------
    source : PublishedSource or SimulatedSource
    cells : sequence of Cell
    store : Store
    jobs : int
        Number of processes.
    on_done : callable, optional
        Called with every cell as it becomes available, in any order.

    Returns
    -------
    dict
        Cell to list of Row, in the order of ``cells``.
    """
    found = {}
    for cell in cells:
        rows = store.load(cell)
        if rows is not None:
            found[cell] = rows
            on_done(cell)
    missing = [cell for cell in cells if cell not in found]
    if missing:
        with _workers(min(jobs, len(missing))) as executor:
            with _interrupts_held():
                futures = {executor.submit(solve_cell, source, cell): cell for cell in missing}
            for future in as_completed(futures):
                cell, rows = futures[future], future.result()
                store.save(cell, rows)
                found[cell] = rows
                on_done(cell)
    return {cell: found[cell] for cell in cells}


def in_parallel(
    function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], jobs: int
) -> list[Any]:
    """``function(*task)`` of every task on ``jobs`` processes; a list in the order of tasks."""
    with _workers(min(jobs, len(tasks))) as executor:
        with _interrupts_held():
            futures = [executor.submit(function, *task) for task in tasks]
        return [future.result() for future in futures]


@contextmanager
def _workers(count: int) -> Iterator[ProcessPoolExecutor]:
    """Worker processes that are killed if the block raises: one that waits to hand over a result
    which nobody takes would not see a signal that Python handles.
    """
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    others = set(multiprocessing.active_children())
    os.environ.update(_ONE_THREAD)
    executor = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), _start_worker)
    try:
        yield executor
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
    else:
        executor.shutdown()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Block SIGINT: processes started in this block inherit that and are ended by their parent."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker() -> None:
    """End with the parent process, however it ends."""
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)


def _versions() -> dict[str, str]:
    code = hashlib.sha256()
    for entry in _CODE:
        for path in sorted(entry.rglob("*.py")) or [entry]:
            code.update(path.read_bytes())
    return {"code": code.hexdigest()} | {
        name: importlib.metadata.version(name) for name in ("numpy", "scipy")
    }


def _frozen(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None


def _write(path: Path, document: object) -> None:
    """Write atomically: an interrupted run leaves no partial file."""
    unfinished = path.with_suffix(".unfinished")
    unfinished.write_text(json.dumps(document), encoding="utf-8")
    os.replace(unfinished, path)
