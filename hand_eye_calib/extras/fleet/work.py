"""Which recordings a batch has, the work of one of them, and who does many: processes of this
machine, or a Dask cluster.
"""

import hashlib
import json
import multiprocessing
import os
import re
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from itertools import chain, count
from pathlib import Path
from typing import Any, NamedTuple

from hand_eye_calib.core.base.errors import HandEyeCalibError, InputError, required
from hand_eye_calib.core.base.option import Options
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.base.python_path import starting_trusted
from hand_eye_calib.core.base.text import told_apart
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.extras.fleet.together import row_of_result
from hand_eye_calib.formats import remote
from hand_eye_calib.formats.files import limit_memory
from hand_eye_calib.offline.cli.bags import read_recording
from hand_eye_calib.offline.cli.options import STREAMS
from hand_eye_calib.offline.cli.present import exit_code

STATE = "batch.jsonl"
TABLE = "rows.csv"
INDEX = "index.html"
VEHICLES = "vehicles"

Row = Document


@dataclass(frozen=True, kw_only=True)
class Task:
    """One recording to calibrate from, in plain values: it travels to other processes and machines.

    Attributes
    ----------
    name : str
        Of its row and its folder.
    bags : tuple of str
        Paths or URLs of its parts, or the directory of a journal.
    vehicle : str
        The rig; recordings of one are put together. Empty if it is not known.
    options : dict
    sources : dict
        "parent" and "child" to a topic or WORLD:SENSOR, if they are given.
    with_fingerprints, with_report : bool
    """

    name: str
    bags: tuple[str, ...]
    vehicle: str = ""
    options: Options = field(default_factory=dict)
    sources: dict[str, str] = field(default_factory=dict)
    with_fingerprints: bool = False
    with_report: bool = False

    def key(self) -> str:
        """Digest of the task, its options, and names, sizes and times of its files, so that no
        older result is taken for this one's.
        """
        text = json.dumps([asdict(self), list(map(_state, self.bags))], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def _state(bag: str) -> list[Any]:
    path = Path(bag)  # none of a URL
    files = sorted(path.iterdir()) if path.is_dir() else [path] if path.exists() else []
    return [[str(file), file.stat().st_size, file.stat().st_mtime_ns] for file in files]


def tasks_of(groups: Sequence[Sequence[str]], vehicle: str = "", **common: Any) -> list[Task]:
    """A task for each group of bags that are one recording; ``vehicle`` is its name, or has
    ``{vehicle}`` at its place in their paths. The other values are those of every Task.
    """
    pattern = re.escape(vehicle).replace(r"\*\*", ".*").replace(r"\*", "[^/]*")
    pattern = pattern.replace(re.escape("{vehicle}"), "([^/]+)")
    # A path as "." has no name of its own.
    paths = [
        bag.partition("?")[0] if remote.is_url(bag) else str(Path(bag).resolve())
        for bag, *_ in groups
    ]
    stems = told_apart([str(_without_suffix(Path(path))) for path in paths])
    tasks: list[Task] = []
    names = {STATE, TABLE, INDEX, VEHICLES}
    for group, stem in zip(groups, stems, strict=True):
        name = stem.replace("/", "_")
        numbered = chain([name], (f"{name}_{number}" for number in count(2)))
        name = next(one for one in numbered if one not in names)
        names.add(name)
        of = vehicle
        if "{vehicle}" in vehicle:
            match = re.search(pattern, group[0])
            of = match[1].strip(".") if match else ""
        tasks.append(Task(name=name, bags=tuple(group), vehicle=of, **common))
    return tasks


def _without_suffix(path: Path) -> Path:
    """Return a path without the last suffix; the root of the file system has no name."""
    return path.with_suffix("") if path.name else path


# ------------------------------------------------------------------ one recording


class Outcome(NamedTuple):
    """What came of a recording.

    Attributes
    ----------
    row : dict
        Its row of the table, in plain values.
    code : int
        The exit code of its own.
    text : str
        JSON of ``name``, ``vehicle``, ``bags``, ``calibration`` (Calibration.to_dict or null),
        ``inputs``, ``error`` (text or null), and a ``traceback`` for defects of the program. As
        text it takes little memory.
    page : str
        Its report, if it is wanted.
    """

    row: Row
    code: int
    text: str
    page: str = ""

    @classmethod
    def of(
        cls,
        task: Task,
        error: str | None,
        result: Calibration | None = None,
        inputs: Mapping[str, Any] | None = None,
        page: str = "",
        as_given: remote.AsGiven = lambda value: value,
        **more: str,
    ) -> "Outcome":
        """The outcome of a task, from its error, or its result with inputs and page; ``as_given``
        puts URLs back, and ``more`` goes into the text.
        """
        inputs = inputs or {}
        row: Row = {"name": task.name, "vehicle": task.vehicle, "error": error}
        bags = [remote.public(bag) for bag in task.bags]
        found = as_given(result.to_dict()) if result else None
        whole = row | {"bags": bags, "calibration": found, "inputs": as_given(inputs), **more}
        row |= dict.fromkeys(("start", "duration_s", "verdict", "headline"))
        row["bags"] = " ".join(bags)
        stamps = [inputs[each] for each in STREAMS if each in inputs]
        starts = [stream["first_stamp_ns"] for stream in stamps]
        if starts and None not in starts:
            date = datetime.fromtimestamp(max(starts) // 1_000_000_000, UTC)
            row["start"] = date.isoformat(timespec="seconds")
            row["duration_s"] = (min(one["last_stamp_ns"] for one in stamps) - max(starts)) * 1e-9
        if found and result:
            row |= row_of_result(found) | {"warnings": "; ".join(found["warnings"])}
            row["findings"] = " ".join(finding.code for finding in result.findings)
        code = exit_code(result) if result and not error else 1
        return cls(row, code, json.dumps(whole, separators=(",", ":")), as_given(page))

    @property
    def calibration(self) -> Calibration:
        """The result; only of a row with a verdict."""
        return Calibration.from_dict(json.loads(self.text)["calibration"])

    @property
    def inputs(self) -> Document:
        """Where the data came from."""
        return json.loads(self.text)["inputs"]

    @property
    def verdict(self) -> str:
        """The verdict of the result, or "failed"."""
        return "failed" if self.row["error"] else str(self.row["verdict"])


# Does a task.
Work = Callable[[Task], Outcome]


def work(task: Task) -> Outcome:
    """Do a task; what goes wrong becomes part of the outcome, so that the others go on."""
    from hand_eye_calib.offline.report.report import render

    limit_memory()  # this may be a process of its own
    try:
        with remote.local_copies(task.bags) as (paths, as_given):
            recording = read_recording([*map(Path, paths)], task.sources, task.options)
            result = recording.solved(task.with_fingerprints)
            inputs = recording.inputs
            page = render(result, recording.snapshot, inputs) if task.with_report else ""
            failure = result.status.failure or None
            return Outcome.of(task, failure, result, inputs, page, as_given)
    except HandEyeCalibError as error:
        return Outcome.of(task, str(error))
    except Exception as error:
        text = " ".join(f"unexpected {type(error).__name__}: {error}".split())
        return Outcome.of(task, text, traceback=traceback.format_exc())


# ---------------------------------------------------------------------- many of them


def outcomes(
    tasks: Sequence[Task], jobs: int, dask: str | None = None, do: Work = work
) -> Iterator[tuple[Task, Outcome]]:
    """Do tasks in so many processes of this machine, or on the Dask cluster at an address, whose
    workers must see the bags under the same paths; yields each with its outcome when it is done.

    If a worker dies, those tasks that may be to blame are done again one by one, and then the rest.
    """
    waiting = [[*tasks]] if tasks else []
    while waiting:
        some = waiting.pop(0)
        lost = dict[str, str]()
        with _cluster(dask) if dask else _processes(min(jobs, len(some))) as executor:
            futures = {executor.submit(do, task): task for task in some}
            for future in as_completed([*futures]):
                task = futures.pop(future)
                if error := future.exception():
                    lost[task.name] = " ".join(str(error).split())
                else:
                    yield task, future.result()
        left = [task for task in some if task.name in lost]
        if dask or len(some) == 1:
            told = "worker processes die of it, perhaps for lack of memory: --jobs 1"
            for task in left:
                why = f"the cluster lost it: {lost[task.name]}" if dask else told
                yield task, Outcome.of(task, why)
        else:
            # A pool begins its tasks in their order.
            waiting[:0] = [[task] for task in left[:jobs]] + [left[jobs:]] * bool(left[jobs:])


@contextmanager
def _processes(jobs: int) -> Iterator[Executor]:
    """Worker processes, spawned: forking a program with threads is not safe."""
    spawning = multiprocessing.get_context("spawn")
    # A worker is `python -c`, which would import modules from the current folder.
    with starting_trusted():
        executor = ProcessPoolExecutor(jobs, spawning, initializer=_begin)
        try:
            yield executor
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise
        executor.shutdown()


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
def _cluster(address: str) -> Iterator[Executor]:
    distributed = required("dask.distributed", "--dask", "cluster")
    try:
        client = distributed.Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"no Dask scheduler at {address}: {reason}") from None
    with client:
        yield client.get_executor(pure=False)
