"""``replay --batch FILE``: many recordings, on all cores or on a Dask cluster. What is done already
is not done again.

The file is YAML: a list of bags, or a mapping with the list under ``bags`` and, beside it, what
holds for all of them::

    parent_topic: /lidar/odometry          # or parent_tf: odom:lidar; the same for child_...
    child_topic: /camera/odometry
    options: {method: dnlo, max_gap: 0.3}  # of the engine, by name
    bags:
      - monday/*                           # paths are relative to this file
      - bag: [tuesday/drive_0, tuesday/drive_1]
        name: tuesday                      # of its folder in --out; by default the bag's own
        child_topic: /camera/slam
        options: {reference: B10}

What is given for a bag goes before what holds for all, and that before the command line.
"""

import argparse
import hashlib
import json
import multiprocessing
import os
import signal
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from glob import glob, has_magic
from itertools import chain, count
from pathlib import Path
from typing import Any

from hand_eye_calib.calibration import Calibration
from hand_eye_calib.cli.console import note, with_progress
from hand_eye_calib.cli.findings import with_findings
from hand_eye_calib.cli.listing import print_table
from hand_eye_calib.cli.options import Options, options_from
from hand_eye_calib.cli.replaying import fingerprints, replay
from hand_eye_calib.cli.reporting import REPORT, can_draw, rendered, save_page, with_cross_check
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import ConfigError, HandEyeCalibError, InputError, MissingDependencyError
from hand_eye_calib.report.words import with_sigma

_SOURCES = ("parent_topic", "child_topic", "parent_tf", "child_tf")
_KEYS = ("bag", "name", "options", *_SOURCES)
_STATE = "batch.json"
_SUMMARY = "summary.json"
# Bytes of the name of a folder.
_LONGEST_NAME = 200

_HEADINGS = ("x m", "y m", "z m", "roll deg", "pitch deg", "yaw deg", "poses", "warnings")

# What came of a task, in plain values.
Outcome = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Task:
    """One bag to calibrate from, in plain values: it travels to other processes and machines."""

    name: str
    bags: tuple[str, ...]
    options: Options = field(default_factory=dict)
    sources: dict[str, str] = field(default_factory=dict)
    with_fingerprints: bool = False
    with_report: bool = False

    def key(self) -> str:
        """Digest of the task, its options and its bags, so that no older result is taken for this
        one's.
        """
        state = [
            [file, os.path.getsize(file), os.stat(file).st_mtime_ns]
            for bag in self.bags
            for file in _files(bag)
        ]
        return hashlib.sha256(
            json.dumps([asdict(self), state], sort_keys=True).encode()
        ).hexdigest()


def run_batch(arguments: argparse.Namespace) -> int:
    """Calibrate from all bags of the file; returns the exit code.

    Raises
    ------
    HandEyeCalibError
        If the file cannot be used; a bag that fails is a row in the result.
    """
    out: Path | None = arguments.out
    tasks = read_batch(
        arguments.batch,
        options_from(arguments),
        _sources_from(arguments),
        with_fingerprints=bool(out),
        with_report=bool(out) and can_draw(REPORT),
    )
    documents = _stored_outcomes(tasks, out) if out else {}
    waiting = [task for task in tasks if task.name not in documents]
    if documents:
        note(f"{len(documents)} of {len(tasks)} bags are done already; their results are in {out}")
    on_dask = arguments.dask
    workers = _on_dask(on_dask) if on_dask else _on_cores(arguments.jobs or os.cpu_count())
    with workers as outcomes:
        shown = with_progress(outcomes(waiting), len(waiting), "calibrating")
        for task, document in shown:
            page = document.pop("page", None)
            documents[task.name] = document
            if out:
                _store(task, document, page, out)
    return _finish([documents[task.name] for task in tasks], arguments)


def _sources_from(arguments: argparse.Namespace) -> dict[str, str]:
    """Topics and frames that the command line gives for all bags."""
    given = {name: getattr(arguments, name) for name in _SOURCES}
    return {
        name: value if isinstance(value, str) else ":".join(value)
        for name, value in given.items()
        if value
    }


def _finish(rows: Sequence[Outcome], arguments: argparse.Namespace) -> int:
    """Write and print the summary; returns the exit code."""
    failures = [row["name"] for row in rows if row["error"]]
    summary = {"batch": str(arguments.batch), "results": list(rows), "failures": failures}
    if arguments.out:
        _write(arguments.out / _SUMMARY, summary)
    if arguments.json:
        print(json.dumps(summary, indent=2, allow_nan=False))
    else:
        _print_results(rows)
    for row in rows:
        if row["error"]:
            note(f"{row['name']} failed: {row['error']}")
    if failures:
        return 1
    return 3 if any(row["calibration"]["status"] != "ok" for row in rows) else 0


def read_batch(
    path: Path,
    options: Options,
    sources: Mapping[str, str],
    *,
    with_fingerprints: bool = False,
    with_report: bool = False,
) -> list[Task]:
    """The tasks of a batch file.

    Parameters
    ----------
    path : pathlib.Path
    options, sources : dict
        What holds if the file says nothing else.
    with_fingerprints : bool
        Whether the results shall say which bytes were read.
    with_report : bool
        Whether they shall come with a report.

    Returns
    -------
    list of Task

    Raises
    ------
    InputError
        If the file cannot be read.
    ConfigError
        If it says something that cannot be.
    """
    from hand_eye_calib.io.yaml_files import read_yaml

    document = read_yaml(path)
    if isinstance(document, list):
        document = {"bags": document}
    bags = document.get("bags") if isinstance(document, dict) else None
    if not isinstance(bags, list) or not bags:
        raise ConfigError(f"{path}: expected a list of bags, or a mapping with one under 'bags'")
    common = {name: value for name, value in document.items() if name != "bags"}
    given = {"options": options} | dict(sources)
    defaults = _merged(given, _checked(path, common, "beside 'bags'"))
    wanted = {"with_fingerprints": with_fingerprints, "with_report": with_report}
    recordings = list(_recordings(path, bags, defaults))
    names = _names(path, recordings)
    return [
        _task(where, name, paths, entry, wanted)
        for name, (where, paths, entry) in zip(names, recordings, strict=True)
    ]


_Recording = tuple[str, list[str], dict[str, Any]]


def _recordings(
    path: Path, bags: Sequence[Any], defaults: Mapping[str, Any]
) -> Iterator[_Recording]:
    """Each recording of a batch file: where it stands in the file, its bags, what holds for it."""
    for number, entry in enumerate(bags, start=1):
        where = f"entry {number}"
        entry = _checked(path, entry if isinstance(entry, dict) else {"bag": entry}, where)
        for paths in _expanded(path, entry, where):
            yield f"{path}, {where}", paths, _merged(defaults, entry)


def _checked(path: Path, entry: dict[str, Any], where: str) -> dict[str, Any]:
    unknown = [str(name) for name in entry if name not in _KEYS]
    if unknown:
        raise ConfigError(
            f"{path}, {where}: unknown key {unknown[0]!r}; known are {', '.join(_KEYS)}"
        )
    if not isinstance(entry.get("options", {}), dict):
        raise ConfigError(f"{path}, {where}: options must be a mapping of names to values")
    return entry


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """``over`` before ``base``; the topic of a stream replaces its frames, and the reverse."""
    merged = {name: value for name, value in base.items() if _other(name) not in over} | dict(over)
    return merged | {"options": base.get("options", {}) | over.get("options", {})}


def _other(name: str) -> str | None:
    stream, _, kind = name.partition("_")
    return {"topic": f"{stream}_tf", "tf": f"{stream}_topic"}.get(kind)


def _expanded(path: Path, entry: Mapping[str, Any], where: str) -> list[list[str]]:
    """Bags of each recording: one recording, or several if a pattern stands for many."""
    bags = entry.get("bag")
    named: list[Any] = bags if isinstance(bags, list) else [bags]
    if not named or not all(isinstance(bag, str) and bag for bag in named):
        raise ConfigError(
            f"{path}, {where}: expected a bag's path or a list of paths; got {bags!r}"
        )
    if any("\0" in bag for bag in named):
        raise ConfigError(f"{path}, {where}: a bag's path has a zero byte")
    places = [str(path.parent / str(bag)) for bag in named]
    if len(places) > 1 or Path(places[0]).exists() or not has_magic(places[0]):
        return [places]
    found = sorted(glob(places[0]))
    if not found:
        raise ConfigError(f"{path}, {where}: no bag matches {named[0]}")
    return [[place] for place in found]


def _task(
    where: str,
    name: str,
    bags: Sequence[str],
    entry: Mapping[str, Any],
    wanted: Mapping[str, bool],
) -> Task:
    from hand_eye_calib.io.transforms import TfSource

    try:
        CalibratorConfig.from_options(entry["options"])
        for source in ("parent_tf", "child_tf"):
            if source in entry:
                TfSource.parse(str(entry[source]))
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
    sources = {source: str(entry[source]) for source in _SOURCES if source in entry}
    return Task(
        name=name, bags=tuple(bags), options=dict(entry["options"]), sources=sources, **wanted
    )


def _names(path: Path, recordings: Sequence[_Recording]) -> list[str]:
    """A name for each recording, none twice: its own or that of its first bag, with the folder if
    several bags are called alike, as monday/bag and tuesday/bag.
    """
    stems = Counter(Path(paths[0]).stem for _, paths, entry in recordings if not entry.get("name"))
    names: list[str] = []
    for where, paths, entry in recordings:
        bag = Path(paths[0])
        is_alone = stems[bag.stem] == 1 or bag.parent == path.parent
        usual = bag.stem if is_alone else f"{bag.parent.name}_{bag.stem}"
        names.append(_free(_name(where, entry.get("name") or usual), set(names)))
    return names


def _free(name: str, taken: set[str]) -> str:
    """The name, with a number if it is taken."""
    numbered = (f"{name}_{number}" for number in count(2))
    return next(one for one in chain([name], numbered) if one not in taken)


def _name(where: str, given: Any) -> str:
    """Name of a recording, and of its folder in ``--out``."""
    if not isinstance(given, (str, int, float)):
        raise ConfigError(f"{where}: expected a name; got {given!r}")
    name = str(given).replace("/", "_")
    is_file_name = name.isprintable() and len(name.encode()) <= _LONGEST_NAME
    if not is_file_name or name.strip(". ") == "" or name.lower() in (_SUMMARY, _STATE):
        raise ConfigError(
            f"{where}: {name[:_LONGEST_NAME]!r} cannot name a folder of results; give another name"
        )
    return name


def work(task: Task) -> Outcome:
    """Do a task; what goes wrong becomes part of the outcome, so that the others go on.

    Returns
    -------
    dict
        ``name``, ``bags``, ``calibration`` (Calibration.to_dict or None), ``findings`` of the
        stream checks, ``inputs``, ``error`` (text or None), the ``page`` of the report if the
        task wants one, and a ``traceback`` for errors that are defects of the program.
    """
    outcome = _failed(task, None)
    try:
        return outcome | _calibrated(task)
    except HandEyeCalibError as error:
        return outcome | {"error": str(error)}
    except Exception as error:
        text = " ".join(f"unexpected {type(error).__name__}: {error}".split())
        return outcome | {"error": text, "traceback": traceback.format_exc()}


def _calibrated(task: Task) -> Outcome:
    """What a task adds to its outcome if nothing goes wrong."""
    config = CalibratorConfig.from_options(task.options)
    sources = (_source(task, "parent"), _source(task, "child"))
    replayed = replay(list(task.bags), *sources, config=config, quiet=True)
    if task.with_fingerprints:
        replayed.inputs["files"] = fingerprints(replayed.files, quiet=True)
    snapshot = replayed.calibrator.snapshot()
    calibration, findings = with_findings(replayed.calibration, snapshot)
    calibration, evidence = with_cross_check(calibration, snapshot)
    found: Outcome = {
        "calibration": calibration.to_dict(),
        "findings": findings,
        "inputs": replayed.inputs,
    }
    if calibration.status.failure:
        found["error"] = calibration.status.failure
    if task.with_report:
        found["page"] = rendered(calibration, evidence, snapshot.config, replayed.inputs)
    return found


def _source(task: Task, stream: str) -> Any:
    """Topic, pair of frames or nothing."""
    from hand_eye_calib.io.transforms import TfSource

    if frames := task.sources.get(f"{stream}_tf"):
        return TfSource.parse(frames)
    return task.sources.get(f"{stream}_topic")


# ---- where the work is done

# Does tasks, and yields each with its outcome.
_Worker = Callable[[Sequence[Task]], Iterable[tuple[Task, Outcome]]]


@contextmanager
def _on_cores(jobs: int | None) -> Iterator[_Worker]:
    """Processes of this machine, spawned: forking a program with threads is not safe."""
    # One thread each: the matrices are small, and all cores are taken already.
    threads = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = threads or "1"
    executor = ProcessPoolExecutor(
        jobs, multiprocessing.get_context("spawn"), initializer=_ignore_interrupts
    )

    def outcomes(tasks: Sequence[Task]) -> Iterator[tuple[Task, Outcome]]:
        futures = {executor.submit(work, task): task for task in tasks}
        for future in as_completed(futures):
            task = futures[future]
            try:
                yield task, future.result()
            except BrokenProcessPool:
                reason = "a worker process died, perhaps for lack of memory; try --jobs 1"
                yield task, _failed(task, reason)

    try:
        yield outcomes
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        executor.shutdown()
        if threads is None:
            del os.environ["OMP_NUM_THREADS"]


@contextmanager
def _on_dask(address: str) -> Iterator[_Worker]:
    """Workers of a Dask cluster, which must see the bags under the same paths."""
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
        futures = {client.submit(work, task, pure=False): task for task in tasks}
        for future in as_completed_on_dask(futures):
            task = futures[future]
            error = future.exception()
            if error:
                reason = f"the cluster lost it: {' '.join(str(error).split())}"
                yield task, _failed(task, reason)
            else:
                yield task, future.result()

    with client:
        yield outcomes


def _failed(task: Task, reason: str | None) -> Outcome:
    return {
        "name": task.name,
        "bags": list(task.bags),
        "calibration": None,
        "findings": [],
        "inputs": {},
        "error": reason,
    }


def _ignore_interrupts() -> None:
    """Ctrl-C is for the process that waits for the workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


# ---- results on disk


def _files(bag: str) -> list[str]:
    path = Path(bag)
    return sorted(map(str, path.iterdir())) if path.is_dir() else [bag] if path.exists() else []


def _stored_outcomes(tasks: Sequence[Task], directory: Path) -> dict[str, Outcome]:
    """Outcomes of an earlier run, by the tasks' names.

    Raises
    ------
    InputError
        If the folder of a task is a link that leads out of the directory.
    """
    for task in tasks:
        if not (directory / task.name).resolve().is_relative_to(directory.resolve()):
            raise InputError(f"{directory / task.name} is a link out of {directory}; remove it")
    stored = {task.name: _stored(task, directory) for task in tasks}
    return {name: outcome for name, outcome in stored.items() if outcome}


def _stored(task: Task, directory: Path) -> Outcome | None:
    """The outcome of an earlier run; None if there is none, it failed, or something has changed
    since.
    """
    try:
        state = json.loads((directory / task.name / _STATE).read_text(encoding="utf-8"))
        outcome = state["outcome"]
        if state["key"] == task.key() and not outcome["error"]:
            Calibration.from_dict(outcome["calibration"])
            return dict(outcome)
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return None  # to be done again, whatever is wrong with it
    return None


def _store(task: Task, outcome: Outcome, page: str | None, directory: Path) -> None:
    from hand_eye_calib.io.results import save_result

    if outcome["calibration"]:
        save_result(
            Calibration.from_dict(outcome["calibration"]), directory / task.name, outcome["inputs"]
        )
    if page:
        save_page(directory / task.name / REPORT, page)
    _write(directory / task.name / _STATE, {"key": task.key(), "outcome": outcome})


def _write(path: Path, document: Any) -> None:
    from hand_eye_calib.io.files import write_atomically

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically({path: json.dumps(document, indent=2, allow_nan=False) + "\n"})
    except OSError as error:
        raise InputError(
            f"cannot write {path}: {error.strerror}; choose another directory with --out"
        ) from None


def _print_results(rows: Sequence[Outcome]) -> None:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE, pad_edge=False)
    table.add_column("bag")
    table.add_column("status")
    for heading in _HEADINGS:
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(row["name"], *_cells(row))
    print_table(table)
    failed = sum(bool(row["error"]) for row in rows)
    print(f"{len(rows) - failed} of {len(rows)} bags calibrated, {failed} failed")


def _cells(row: Outcome) -> list[str]:
    """Status, numbers with their standard deviations, counts."""
    calibration = row["calibration"]
    if row["error"] or not calibration:
        return ["failed", *[""] * len(_HEADINGS)]
    transform = calibration["T_parent_child"]
    lengths = zip(transform["translation"], transform["sigma_translation"], strict=True)
    angles = zip(transform["rpy_deg"], transform["sigma_rpy_deg"], strict=True)
    return [
        calibration["status"],
        *(with_sigma(value, sigma, 3) for value, sigma in lengths),
        *(with_sigma(value, sigma, 2) for value, sigma in angles),
        str(calibration["n_poses"]),
        str(len(calibration["warnings"])),
    ]
