"""The work of one task, and where tasks are done: in processes of this machine, or on a Dask
cluster.
"""

import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from hand_eye_calib.cli.batch.tasks import Task
from hand_eye_calib.cli.console import silence
from hand_eye_calib.cli.options import STREAMS
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
# Does tasks, and yields each with its outcome.
Workers = Callable[[Sequence[Task]], Iterable[tuple[Task, Outcome]]]

# A task is tried so often if worker processes die of it.
_MOST_DEATHS = 3


def work(task: Task) -> Outcome:
    """Do a task; what goes wrong becomes part of the outcome, so that the others go on.

    Returns
    -------
    dict
        ``name``, ``vehicle``, ``bags``, ``calibration`` (Calibration.to_dict or None), ``findings``
        of the stream checks, ``inputs``, ``error`` (text or None), the ``page`` of the report if
        the task wants one, and a ``traceback`` for errors that are defects of the program.
    """
    try:
        with silence(), local_copies(task.bags) as (paths, as_given):
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
    from hand_eye_calib.io.transforms import TfSource

    ReadingMemory.switch_on()  # this may be a process of its own
    sources: dict[str, Any] = {
        stream: task.sources.get(f"{stream}_topic")
        or (f"{stream}_tf" in task.sources and TfSource.parse(task.sources[f"{stream}_tf"]))
        or None
        for stream in STREAMS
    }
    recording = read_paths(list(map(Path, paths)), sources, task.options, task.are_files)
    calibration = recording.solved()
    if task.with_fingerprints:
        recording.with_fingerprints()
    found: Outcome = {"inputs": recording.inputs}
    if task.with_report:
        found["page"] = rendered(calibration, recording.snapshot, recording.inputs)
    if calibration.status.failure:
        found["error"] = calibration.status.failure
    return found | {
        "calibration": calibration.to_dict(),
        "findings": plain(calibration.findings),
    }


@contextmanager
def on_cores(jobs: int, do: Work = work) -> Iterator[Workers]:
    """Processes of this machine. What a process that dies had to do is done again at the end, one
    task at a time: it may have died for lack of memory.
    """
    # One process each, so that one that dies takes no other task along.
    processes: SimpleQueue[ProcessPoolExecutor] = SimpleQueue()
    for _ in range(jobs):
        processes.put(_process())

    def attempt(task: Task) -> Outcome | None:
        process = processes.get()
        try:
            return process.submit(do, task).result()
        except BrokenProcessPool:
            process = _process()
            return None
        finally:
            processes.put(process)

    def outcomes(tasks: Sequence[Task]) -> Iterator[tuple[Task, Outcome]]:
        futures = {lanes.submit(attempt, task): task for task in tasks}
        died = []
        for future in as_completed(futures):
            task = futures.pop(future)
            if found := future.result():
                yield task, found
            else:
                died.append(task)
        for task in died:
            tries = (attempt(task) for _ in range(_MOST_DEATHS - 1))
            reason = "worker processes die of it, perhaps for lack of memory"
            yield task, next(filter(None, tries), failed(task, reason))

    lanes = ThreadPoolExecutor(jobs)
    try:
        yield outcomes
    except BaseException:
        lanes.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        lanes.shutdown()
        for _ in range(jobs):
            processes.get().shutdown()


def _process() -> ProcessPoolExecutor:
    """A worker process, spawned: forking a program with threads is not safe."""
    return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=_begin)


def _begin() -> None:
    """Ctrl-C is for the process that waits for the workers; when that ends, they end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Wait until the parent has ended, even if it was killed, and end with it."""
    parent = multiprocessing.parent_process()
    assert parent is not None, "a worker is started by another process"
    parent.join()
    os._exit(1)


@contextmanager
def on_dask(address: str, do: Work = work) -> Iterator[Workers]:
    """Workers of a Dask cluster, which must see the bags under the same paths. What a worker that
    dies had to do is done by the others.
    """
    try:
        from dask.distributed import Client
        from dask.distributed import as_completed as as_completed_on_dask
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

    def outcomes(tasks: Sequence[Task]) -> Iterator[tuple[Task, Outcome]]:
        futures = {client.submit(do, task, pure=False): task for task in tasks}
        for future in as_completed_on_dask(list(futures)):
            task = futures.pop(future)
            if error := future.exception():
                yield task, failed(task, f"the cluster lost it: {' '.join(str(error).split())}")
            else:
                yield task, future.result()

    with client:
        yield outcomes
