"""Where the tasks are done: in processes of this machine, or on a Dask cluster."""

import multiprocessing
import os
import signal
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

from hand_eye_calib.cli.batch.calibrating import Outcome, failed, work
from hand_eye_calib.cli.batch.tasks import Task
from hand_eye_calib.errors import InputError, MissingDependencyError

# Does a task.
Work = Callable[[Task], Outcome]
# Does tasks, and yields each with its outcome.
Workers = Callable[[Sequence[Task]], Iterable[tuple[Task, Outcome]]]

# A task is tried so often if worker processes die of it.
_MOST_DEATHS = 3


@contextmanager
def on_cores(jobs: int, do: Work = work) -> Iterator[Workers]:
    """Processes of this machine. If one dies, the others of its pool end with it; their tasks are
    done again, one at a time.
    """
    # One thread each: the matrices are small, and all cores are taken already.
    threads = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = threads or "1"
    pool = _Pool(jobs)
    try:
        yield lambda tasks: _outcomes(pool, tasks, do)
    except BaseException:
        pool.kill()
        raise
    finally:
        pool.close()
        if threads is None:
            del os.environ["OMP_NUM_THREADS"]


class _Pool:
    """Worker processes, spawned: forking a program with threads is not safe."""

    def __init__(self, jobs: int) -> None:
        self.jobs = jobs
        self._executor = self._started()

    def _started(self) -> ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(self.jobs, context, initializer=_ignore_interrupts)

    def submit(self, do: Work, task: Task) -> "Future[Outcome]":
        """Start a task, in new processes if the old ones have died."""
        try:
            return self._executor.submit(do, task)
        except BrokenProcessPool:
            self.close()
            self._executor = self._started()
            return self._executor.submit(do, task)

    def kill(self) -> None:
        """End the processes at once."""
        self._executor.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.terminate()

    def close(self) -> None:
        """End the processes when their tasks are done."""
        self._executor.shutdown()


def _outcomes(pool: _Pool, tasks: Sequence[Task], do: Work) -> Iterator[tuple[Task, Outcome]]:
    waiting, suspects = deque(tasks), deque[Task]()
    deaths: Counter[str] = Counter()
    running: dict[Future[Outcome], Task] = {}
    while waiting or suspects or running:
        while waiting and len(running) < pool.jobs:
            task = waiting.popleft()
            running[pool.submit(do, task)] = task
        if not running:
            # Alone, so that a task of which processes die takes no other along.
            task = suspects.popleft()
            running[pool.submit(do, task)] = task
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            task = running.pop(future)
            if not isinstance(future.exception(), BrokenProcessPool):
                yield task, future.result()
                continue
            deaths[task.name] += 1
            if deaths[task.name] < _MOST_DEATHS:
                suspects.append(task)
            else:
                yield task, failed(task, "worker processes die of it, perhaps for lack of memory")


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
        raise InputError(
            f"no Dask scheduler at {address}: {' '.join(str(error).split())}"
        ) from None

    def outcomes(tasks: Sequence[Task]) -> Iterator[tuple[Task, Outcome]]:
        futures = {client.submit(do, task, pure=False): task for task in tasks}
        for future in as_completed_on_dask(futures):
            task = futures[future]
            error = future.exception()
            if error:
                reason = f"the cluster lost it: {' '.join(str(error).split())}"
                yield task, failed(task, reason)
            else:
                yield task, future.result()

    with client:
        yield outcomes


def _ignore_interrupts() -> None:
    """Ctrl-C is for the process that waits for the workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
