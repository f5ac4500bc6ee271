"""Tasks of a batch, and their distribution over processes or a Dask cluster."""

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

from hand_eye_calib.core.base.errors import (
    HandEyeCalibError,
    InputError,
    required,
)
from hand_eye_calib.core.base.option import Options
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.base.python_path import starting_trusted
from hand_eye_calib.core.base.text import distinct_names
from hand_eye_calib.core.geometry.span import WHOLE, Span
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.extras.fleet.together import row_of_result
from hand_eye_calib.formats import remote
from hand_eye_calib.formats.files import limit_memory
from hand_eye_calib.offline.cli.bags import read_recording
from hand_eye_calib.offline.cli.options import STREAMS
from hand_eye_calib.offline.cli.present import exit_code

# File with the outcome of a task, in the folder of the task.
STATE = "batch.jsonl"
# Table, page and folder of the vehicles, in the directory of a batch.
TABLE = "rows.csv"
INDEX = "index.html"
VEHICLES = "vehicles"

# Row of the table of a batch.
Row = Document


@dataclass(frozen=True, kw_only=True)
class Task:
    """A recording to calibrate from, in plain values for other processes and machines.

    Attributes
    ----------
    name : str
        Name of the row and of the folder.
    bags : tuple of str
        Paths or URLs of the bags of the recording, or the directory of a journal.
    vehicle : str
        Name of the rig; empty if unknown. Recordings of one rig get a common result.
    options : dict
    sources : dict
        Topics or WORLD:SENSOR of "parent" and "child", if the user set them.
    without : tuple of str
        Names of the measurements without motion that are switched off.
    span : Span
        Part of the recording to use.
    with_fingerprints, with_report : bool
        Whether to compute hashes of the input files, and to render a report.
    """

    name: str
    bags: tuple[str, ...]
    vehicle: str = ""
    options: Options = field(default_factory=dict)
    sources: dict[str, str] = field(default_factory=dict)
    without: tuple[str, ...] = ()
    span: Span = WHOLE
    with_fingerprints: bool = False
    with_report: bool = False

    def key(self) -> str:
        """Return a digest of the task: its options, and names, sizes and times of its files.

        A stored result with another key is for other data or options.
        """
        states = list(map(_state, self.bags))
        text = json.dumps([asdict(self), states], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def _state(bag: str) -> list[Any]:
    """Return name, size and time of the files of a bag; empty for a URL."""
    path = Path(bag)
    files: list[Path] = []
    if path.is_dir():
        files = sorted(path.iterdir())
    elif path.exists():
        files = [path]
    return [
        [str(file), file.stat().st_size, file.stat().st_mtime_ns]
        for file in files
    ]


def tasks_of(
    groups: Sequence[Sequence[str]], vehicle: str = "", **common: Any
) -> list[Task]:
    """Return a task for each recording.

    Parameters
    ----------
    groups : sequence of sequences of str
        Bags of each recording.
    vehicle : str
        Name of the vehicle, or a pattern of the paths with ``{vehicle}`` in place of the name.
    **common
        Further fields of all tasks.
    """
    paths = [_without_suffix(_full_path(first_bag)) for first_bag, *_ in groups]
    stems = distinct_names([str(path) for path in paths])
    tasks: list[Task] = []
    names = {STATE, TABLE, INDEX, VEHICLES}
    for group, stem in zip(groups, stems, strict=True):
        name = stem.replace("/", "_")
        numbered = chain([name], (f"{name}_{number}" for number in count(2)))
        name = next(
            candidate for candidate in numbered if candidate not in names
        )
        names.add(name)
        vehicle_name = _vehicle_of(group[0], vehicle)
        tasks.append(
            Task(name=name, bags=tuple(group), vehicle=vehicle_name, **common)
        )
    return tasks


def _vehicle_of(bag: str, vehicle: str) -> str:
    """Return the name of the vehicle of a bag.

    ``vehicle`` is the name, or a pattern of the path with ``{vehicle}`` in place of the name. The
    name is empty if the path does not match the pattern.
    """
    if "{vehicle}" not in vehicle:
        return vehicle
    pattern = re.escape(vehicle).replace(r"\*\*", ".*").replace(r"\*", "[^/]*")
    pattern = pattern.replace(re.escape("{vehicle}"), "([^/]+)")
    match = re.search(pattern, bag)
    return match[1].strip(".") if match else ""


def _full_path(bag: str) -> Path:
    """Return the path of a bag, or a URL without its query.

    The path is absolute, because a path such as "." contains no name.
    """
    if remote.is_url(bag):
        return Path(bag.partition("?")[0])
    return Path(bag).resolve()


def _without_suffix(path: Path) -> Path:
    """Return a path without the last suffix; the root of the file system is unchanged."""
    return path.with_suffix("") if path.name else path


# ------------------------------------------------------------------ one recording


class Outcome(NamedTuple):
    """Outcome of a task.

    Attributes
    ----------
    row : dict
        Row of the table, in plain values.
    code : int
        Exit code of this recording alone.
    text : str
        JSON of ``name``, ``vehicle``, ``bags``, ``calibration`` (Calibration.to_dict or null),
        ``inputs``, ``error`` (text or null), and a ``traceback`` for defects of the program. Text
        needs little memory.
    page : str
        Report as HTML; empty without one.
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
        restore_urls: remote.RestoreUrls = lambda value: value,
        **more: str,
    ) -> "Outcome":
        """Return the outcome of a task from its error, or from its result with inputs and page.

        ``restore_urls`` replaces paths of copies by URLs in plain values. ``more`` are further
        fields of the text.
        """
        inputs = inputs or {}
        row: Row = {"name": task.name, "vehicle": task.vehicle, "error": error}
        bags = [remote.public(bag) for bag in task.bags]
        document = restore_urls(result.to_dict()) if result else None
        whole = row | {
            "bags": bags,
            "calibration": document,
            "inputs": restore_urls(inputs),
            **more,
        }
        row |= _times_of(
            [inputs[stream] for stream in STREAMS if stream in inputs]
        )
        row |= {"verdict": None, "headline": None, "bags": " ".join(bags)}
        if document and result:
            row |= row_of_result(document) | {
                "warnings": "; ".join(document["warnings"])
            }
            row["findings"] = " ".join(
                finding.code for finding in result.findings
            )
        code = exit_code(result) if result and not error else 1
        return cls(
            row,
            code,
            json.dumps(whole, separators=(",", ":")),
            restore_urls(page),
        )

    @property
    def calibration(self) -> Calibration:
        """Result of a task that did not fail."""
        return Calibration.from_dict(json.loads(self.text)["calibration"])

    @property
    def inputs(self) -> Document:
        """Sources of the data."""
        return json.loads(self.text)["inputs"]

    @property
    def verdict(self) -> str:
        """Verdict of the result, or "failed"."""
        return "failed" if self.row["error"] else str(self.row["verdict"])


def _times_of(streams: Sequence[Mapping[str, Any]]) -> Row:
    """Return start and duration (s) of the time in which all streams have data.

    Both are None if the stamps of a stream are unknown.
    """
    starts_ns = [stream["first_stamp_ns"] for stream in streams]
    if not starts_ns or None in starts_ns:
        return {"start": None, "duration_s": None}
    start_ns = max(starts_ns)
    end_ns = min(stream["last_stamp_ns"] for stream in streams)
    date = datetime.fromtimestamp(start_ns // 1_000_000_000, UTC)
    return {
        "start": date.isoformat(timespec="seconds"),
        "duration_s": (end_ns - start_ns) * 1e-9,
    }


# Function that performs a task.
Work = Callable[[Task], Outcome]


def work(task: Task) -> Outcome:
    """Perform a task. Errors become part of the outcome, so that other tasks continue."""
    from hand_eye_calib.offline.report.report import render

    # Limit the memory of this worker process.
    limit_memory()
    try:
        with remote.local_copies(task.bags) as (paths, restore_urls):
            bags = [*map(Path, paths)]
            recording = read_recording(
                bags, task.sources, task.options, task.without, task.span
            )
            result = recording.solved(task.with_fingerprints)
            inputs = recording.inputs
            page = (
                render(result, recording.snapshot, inputs)
                if task.with_report
                else ""
            )
            error = result.reasons[0].sentence if result.has_failed else None
            return Outcome.of(task, error, result, inputs, page, restore_urls)
    except HandEyeCalibError as error:
        return Outcome.of(task, str(error))
    except Exception as error:
        text = " ".join(f"unexpected {type(error).__name__}: {error}".split())
        return Outcome.of(task, text, traceback=traceback.format_exc())


# ---------------------------------------------------------------------- many of them


def outcomes(
    tasks: Sequence[Task], jobs: int, dask: str | None = None, do: Work = work
) -> Iterator[tuple[Task, Outcome]]:
    """Perform tasks in worker processes. Yield each finished task with its outcome.

    If a worker dies, the tasks that may have killed it are repeated separately. Other unfinished
    tasks are then repeated together.

    Parameters
    ----------
    tasks : sequence of Task
    jobs : int
        Number of processes of this machine.
    dask : str, optional
        Address of a Dask cluster to use instead. Its workers need the bags at the same paths.
    do : callable
        Function that performs a task.
    """
    waiting = [[*tasks]] if tasks else []
    while waiting:
        group = waiting.pop(0)
        lost = dict[str, str]()
        with (
            _cluster(dask)
            if dask
            else _processes(min(jobs, len(group))) as executor
        ):
            futures = {executor.submit(do, task): task for task in group}
            for future in as_completed([*futures]):
                task = futures.pop(future)
                error = future.exception()
                if error:
                    lost[task.name] = " ".join(str(error).split())
                else:
                    yield task, future.result()
        unfinished = [task for task in group if task.name in lost]
        if dask or len(group) == 1:
            for task in unfinished:
                yield (
                    task,
                    Outcome.of(task, _reason_of_loss(lost[task.name], dask)),
                )
        else:
            waiting[:0] = _groups_to_repeat(unfinished, jobs)


def _reason_of_loss(error: str, dask: str | None) -> str:
    """Return a message about a task whose worker died again."""
    if dask:
        return f"the cluster lost it: {error}"
    return (
        "worker processes crash on it, perhaps for lack of memory: use --jobs 1"
    )


def _groups_to_repeat(
    unfinished: Sequence[Task], jobs: int
) -> list[list[Task]]:
    """Return groups of tasks to repeat after a worker died.

    Workers begin tasks in order, so one of the first ``jobs`` tasks has killed the worker. Each of
    these tasks gets its own group; the other tasks form one group.
    """
    groups = [[task] for task in unfinished[:jobs]]
    others = [*unfinished[jobs:]]
    return [*groups, others] if others else groups


@contextmanager
def _processes(jobs: int) -> Iterator[Executor]:
    """Start worker processes by spawning: forking a program with threads is not safe."""
    spawning = multiprocessing.get_context("spawn")
    # A worker starts as `python -c`, which would import modules from the current folder.
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
    """Prepare a worker: ignore Ctrl-C, print no notes, and end with the parent process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.stderr = open(os.devnull, "w")  # noqa: SIM115
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Wait for the end of the parent process, even if it is killed, and end this process."""
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
