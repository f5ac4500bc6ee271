"""The work of one task, and who does many: processes of this machine, or a Dask cluster."""

import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from hand_eye_calib.cli.batch.tasks import Task
from hand_eye_calib.cli.reading import read_paths
from hand_eye_calib.cli.reporting import rendered
from hand_eye_calib.errors import HandEyeCalibError, InputError, MissingDependencyError
from hand_eye_calib.io.limits import ReadingMemory
from hand_eye_calib.io.remote import local_copies, public
from hand_eye_calib.plain import plain

# What came of a task, in plain values.
Outcome = dict[str, Any]
# Does a task.
Work = Callable[[Task], Outcome]

# A task is tried so often if worker processes die of it.
_MOST_DEATHS = 3


def work(task: Task) -> Outcome:
    """Do a task; what goes wrong becomes part of the outcome, so that the others go on.

    It has ``name``, ``vehicle``, ``bags``, ``calibration`` (Calibration.to_dict or None),
    ``findings``, ``inputs``, ``error`` (text or None), the ``page`` of the report if it is wanted,
    and a ``traceback`` for defects of the program.
    """
    ReadingMemory.switch_on()  # this may be a process of its own
    try:
        with local_copies(task.bags) as (paths, as_given):
            return failed(task, None) | as_given(_calibrated(task, paths))
    except HandEyeCalibError as error:
        return failed(task, str(error))
    except Exception as error:
        text = " ".join(f"unexpected {type(error).__name__}: {error}".split())
        return failed(task, text) | {"traceback": traceback.format_exc()}


def failed(task: Task, reason: str | None) -> Outcome:
    """The outcome of a task that gave no calibration."""
    return {
        "name": task.name,
        "vehicle": task.vehicle,
        "bags": [public(bag) for bag in task.bags],
        "calibration": None,
        "findings": [],
        "inputs": {},
        "error": reason,
    }


def _calibrated(task: Task, paths: list[str]) -> Outcome:
    """What a task adds to its outcome if nothing goes wrong."""
    recording = read_paths(list(map(Path, paths)), task.sources, task.options, task.are_files)
    calibration = recording.solved()
    if task.with_fingerprints:
        recording.with_fingerprints()
    found: Outcome = {"inputs": recording.inputs, "error": calibration.status.failure or None}
    if task.with_report:
        found["page"] = rendered(calibration, recording.snapshot, recording.inputs)
    return found | {
        "calibration": calibration.to_dict(),
        "findings": plain(calibration.findings),
    }


def outcomes(
    tasks: Sequence[Task], jobs: int, dask: str | None = None, do: Work = work
) -> Iterator[tuple[Task, Outcome]]:
    """Do tasks in so many processes of this machine, or on the Dask cluster at an address, whose
    workers must see the bags under the same paths; yields each with its outcome when it is done.
    What a worker that dies had to do is done again.
    """
    with _on_dask(dask, do) if dask else _on_cores(jobs, do) as (executor, attempt):
        futures = {executor.submit(attempt, task): task for task in tasks}
        for future in as_completed([*futures]):
            task = futures.pop(future)
            if error := future.exception():
                yield task, failed(task, f"the cluster lost it: {' '.join(str(error).split())}")
            else:
                yield task, future.result()


@contextmanager
def _on_cores(jobs: int, do: Work) -> Iterator[tuple[Executor, Work]]:
    """One pool for each process, so that one that dies takes no other task along."""
    pools: SimpleQueue[ProcessPoolExecutor] = SimpleQueue()
    for _ in range(jobs):
        pools.put(_one_process())
    is_over = threading.Event()

    def attempt(task: Task) -> Outcome:
        pool = pools.get()
        try:
            for _ in range(_MOST_DEATHS):
                try:
                    return pool.submit(do, task).result()
                except BrokenProcessPool:
                    pool = _one_process()
                    if is_over.is_set():
                        break
        finally:
            pools.put(pool)
        return failed(task, "worker processes die of it, perhaps for lack of memory: --jobs 1")

    with ThreadPoolExecutor(jobs) as threads:
        try:
            yield threads, attempt
        except BaseException:
            is_over.set()
            threads.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise
        finally:
            for _ in range(jobs):
                pools.get().shutdown()


def _one_process() -> ProcessPoolExecutor:
    """A worker process, spawned: forking a program with threads is not safe."""
    return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=_begin)


def _begin() -> None:
    """Ctrl-C is for the process that waits for the workers. Their notes are in the results."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.stderr = open(os.devnull, "w")  # noqa: SIM115
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Wait until the parent has ended, even if it was killed, and end with it."""
    parent = multiprocessing.parent_process()
    assert parent is not None, "a worker is started by another process"
    parent.join()
    os._exit(1)


@contextmanager
def _on_dask(address: str, do: Work) -> Iterator[tuple[Executor, Work]]:
    try:
        from dask.distributed import Client
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            f"--dask needs the package dask.distributed ({error.name} is missing): "
            "pip install 'hand_eye_calib[cluster]'"
        ) from None
    try:
        client = Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"no Dask scheduler at {address}: {reason}") from None
    with client:
        yield client.get_executor(pure=False), do
