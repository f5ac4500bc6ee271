"""``replay --batch FILE``: many bags, on all cores or on a Dask cluster; what is done already is
not done again.

The file is YAML: a list of bags, or a mapping with the list under ``bags`` and, beside it, what
holds for all of them::

    parent_topic: /lidar/odometry          # or parent_tf: odom:lidar; the same for child_...
    child_topic: /camera/odometry
    options: {method: dnlo, max_gap: 0.3}  # of the engine, by name
    bags:
      - monday/*                           # paths are relative to this file
      - bag: [tuesday/drive_0, tuesday/drive_1]
        name: tuesday                      # of its folder in --out; the bag's own name where left
        out child_topic: /camera/slam options: {reference: B10}

What is said of a bag goes before what holds for all, and that before the command line.
"""

import hashlib
import json
import multiprocessing
import os
import signal
import traceback
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from glob import glob
from pathlib import Path

from hand_eye_calib.calibration import Calibration
from hand_eye_calib.cli.console import note, with_progress
from hand_eye_calib.cli.findings import with_findings
from hand_eye_calib.cli.options import options_from, read_yaml
from hand_eye_calib.cli.replaying import fingerprints, replay
from hand_eye_calib.cli.reporting import REPORT, can_draw, rendered, save_page, with_consistency
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import ConfigError, HandEyeCalibError, InputError, MissingDependencyError

_SOURCES = ("parent_topic", "child_topic", "parent_tf", "child_tf")
_KEYS = ("bag", "name", "options", *_SOURCES)
_STATE = "batch.json"
_SUMMARY = "summary.json"


@dataclass(frozen=True)
class Task:
    """One bag to calibrate from, in plain values: it travels to other processes and machines."""

    name: str
    bags: tuple
    options: dict = field(default_factory=dict)
    sources: dict = field(default_factory=dict)
    with_fingerprints: bool = False
    with_report: bool = False

    def key(self):
        """Changes where the task, the bag or its options change, so that an older result is not
        taken for this one's.
        """
        state = [
            [file, os.path.getsize(file), os.stat(file).st_mtime_ns]
            for bag in self.bags
            for file in _files(bag)
        ]
        return hashlib.sha256(
            json.dumps([asdict(self), state], sort_keys=True).encode()
        ).hexdigest()


def run_batch(arguments):
    """Calibrate from all bags of the file; returns the exit code.

    Raises
    ------
    HandEyeCalibError
        Where the file cannot be used; a bag that fails is a row in the result.
    """
    defaults = {
        name: str(getattr(arguments, name))
        for name in ("parent_topic", "child_topic")
        if getattr(arguments, name)
    }
    defaults |= {
        name: ":".join(getattr(arguments, name))
        for name in ("parent_tf", "child_tf")
        if getattr(arguments, name)
    }
    with_report = bool(arguments.out) and can_draw(REPORT)
    tasks = read_batch(
        arguments.batch, options_from(arguments), defaults, bool(arguments.out), with_report
    )
    documents = {task.name: _stored(task, arguments.out) for task in tasks} if arguments.out else {}
    waiting = [task for task in tasks if not documents.get(task.name)]
    if len(waiting) < len(tasks):
        note(
            f"{len(tasks) - len(waiting)} of {len(tasks)} bags are done already; their results are in {arguments.out}"
        )
    run = (
        _on_dask(arguments.dask) if arguments.dask else _on_cores(arguments.jobs or os.cpu_count())
    )
    with run as outcomes:
        for task, document in with_progress(outcomes(waiting), len(waiting), "calibrating"):
            page = document.pop("page", None)
            documents[task.name] = document
            if arguments.out:
                _store(task, document, page, arguments.out)
    rows = [documents[task.name] for task in tasks]
    summary = {
        "batch": str(arguments.batch),
        "results": rows,
        "failures": [row["name"] for row in rows if row["error"]],
    }
    if arguments.out:
        _write(arguments.out / _SUMMARY, summary)
    if arguments.json:
        print(json.dumps(summary, indent=2, allow_nan=False))
    else:
        _print_table(rows)
    for row in rows:
        if row["error"]:
            note(f"{row['name']} failed: {row['error']}")
    if summary["failures"]:
        return 1
    return 3 if any(row["calibration"]["status"] != "ok" for row in rows) else 0


def read_batch(path, options, sources, with_fingerprints=False, with_report=False):
    """The tasks of a batch file.

    Parameters
    ----------
    path : pathlib.Path
    options, sources : dict
        What holds where the file says nothing else.
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
        Where the file cannot be read.
    ConfigError
        Where it says something that cannot be.
    """
    document = read_yaml(path)
    if isinstance(document, list):
        document = {"bags": document}
    if (
        not isinstance(document, dict)
        or not isinstance(document.get("bags"), list)
        or not document["bags"]
    ):
        raise ConfigError(f"{path}: expected a list of bags, or a mapping with one under 'bags'")
    common = {name: value for name, value in document.items() if name != "bags"}
    defaults = _merged({"options": options} | sources, _checked(path, common, "beside 'bags'"))
    tasks = []
    for number, entry in enumerate(document["bags"], start=1):
        entry = _checked(
            path, entry if isinstance(entry, dict) else {"bag": entry}, f"entry {number}"
        )
        merged = _merged(defaults, entry)
        for bags in _expanded(path, entry, number):
            tasks.append(
                _task(
                    path,
                    number,
                    bags,
                    merged,
                    {task.name for task in tasks},
                    with_fingerprints,
                    with_report,
                )
            )
    return tasks


def _checked(path, entry, where):
    unknown = [str(name) for name in entry if name not in _KEYS]
    if unknown:
        raise ConfigError(
            f"{path}, {where}: unknown key {unknown[0]!r}; known are {', '.join(_KEYS)}"
        )
    if not isinstance(entry.get("options", {}), dict):
        raise ConfigError(f"{path}, {where}: options must be a mapping of names to values")
    return entry


def _merged(base, over):
    """``over`` before ``base``; the topic of a stream replaces its frames and the other way round."""
    merged = {name: value for name, value in base.items() if _other(name) not in over} | over
    return merged | {"options": base.get("options", {}) | over.get("options", {})}


def _other(name):
    stream, _, kind = name.partition("_")
    return {"topic": f"{stream}_tf", "tf": f"{stream}_topic"}.get(kind)


def _expanded(path, entry, number):
    """Lists of the bags of each drive: one drive, or several where a pattern stands for many."""
    bags = entry.get("bag")
    named = bags if isinstance(bags, list) else [bags]
    if not named or not all(isinstance(bag, str) and bag for bag in named):
        raise ConfigError(
            f"{path}, entry {number}: expected a bag's path or a list of paths; got {bags!r}"
        )
    places = [str(path.parent / bag) for bag in named]
    if len(places) > 1 or glob(places[0]) in ([], places):
        return [places]
    return [[place] for place in sorted(glob(places[0]))]


def _task(path, number, bags, entry, taken, *extras):
    from hand_eye_calib.io.transforms import TfSource

    try:
        CalibratorConfig.from_options(entry["options"])
        for name in ("parent_tf", "child_tf"):
            if name in entry:
                TfSource.parse(str(entry[name]))
    except ConfigError as error:
        raise ConfigError(f"{path}, entry {number}: {error}") from None
    base = name = str(entry.get("name") or Path(bags[0]).stem).replace("/", "_")
    while name in taken:
        name = (
            f"{base}_{1 + sum(other.startswith(base) for other in taken)}"
            if name == base
            else name + "_"
        )
    sources = {source: str(entry[source]) for source in _SOURCES if source in entry}
    return Task(name, tuple(bags), entry["options"], sources, *extras)


def work(task):
    """Do a task; what goes wrong becomes part of the outcome, in plain values, for the others shall
    go on.

    Returns
    -------
    dict
        ``name``, ``bags``, ``calibration`` (Calibration.to_dict or None), ``findings`` of the
        stream checks, ``inputs``, ``error`` (text or None), the ``page`` of the report where the
        task wants one, and a ``traceback`` for errors that are defects of the program.
    """
    from hand_eye_calib.io.transforms import TfSource

    outcome = _failed(task, None)
    frames = {stream: task.sources.get(f"{stream}_tf") for stream in ("parent", "child")}
    sources = [
        task.sources.get(f"{stream}_topic") or (text and TfSource.parse(text))
        for stream, text in frames.items()
    ]
    try:
        replayed = replay(
            list(task.bags), *sources, CalibratorConfig.from_options(task.options), quiet=True
        )
        if task.with_fingerprints:
            replayed.inputs["files"] = fingerprints(replayed.files, quiet=True)
        snapshot = replayed.calibrator.snapshot()
        calibration, findings = with_findings(replayed.calibration, snapshot)
        calibration, evidence = with_consistency(calibration, snapshot)
        if task.with_report:
            outcome["page"] = rendered(
                calibration, evidence, snapshot.config, replayed.inputs, findings
            )
    except HandEyeCalibError as error:
        return outcome | {"error": str(error)}
    except Exception as error:
        text = " ".join(f"unexpected {type(error).__name__}: {error}".split())
        return outcome | {"error": text, "traceback": traceback.format_exc()}
    outcome |= {
        "calibration": calibration.to_dict(),
        "findings": findings,
        "inputs": replayed.inputs,
    }
    if calibration.status.value == "not_converged":
        outcome["error"] = "the solver did not converge"
    return outcome


# ---- where the work is done


@contextmanager
def _on_cores(jobs):
    """Processes of this machine, spawned: forking a program with threads is not safe."""
    # One thread each: the matrices are small, and all cores are taken already.
    threads = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = threads or "1"
    executor = ProcessPoolExecutor(
        jobs, multiprocessing.get_context("spawn"), initializer=_ignore_interrupts
    )

    def outcomes(tasks):
        futures = {executor.submit(work, task): task for task in tasks}
        for future in as_completed(futures):
            task = futures[future]
            try:
                yield task, future.result()
            except BrokenProcessPool:
                yield (
                    task,
                    _failed(
                        task, "a worker process died, perhaps for want of memory; try --jobs 1"
                    ),
                )

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
def _on_dask(address):
    """Workers of a Dask cluster, which must see the bags under the same paths."""
    try:
        from dask.distributed import Client
        from dask.distributed import as_completed as as_completed_on_dask
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            f"--dask needs the package dask.distributed ({error.name} is missing): pip install 'hand_eye_calib[cluster]'"
        ) from None
    try:
        client = Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        raise InputError(
            f"no Dask scheduler at {address}: {' '.join(str(error).split())}"
        ) from None

    def outcomes(tasks):
        futures = {client.submit(work, task, pure=False): task for task in tasks}
        for future in as_completed_on_dask(futures):
            task = futures[future]
            error = future.exception()
            yield (
                task,
                _failed(task, f"the cluster lost it: {' '.join(str(error).split())}")
                if error
                else future.result(),
            )

    with client:
        yield outcomes


def _failed(task, reason):
    return {
        "name": task.name,
        "bags": list(task.bags),
        "calibration": None,
        "findings": [],
        "inputs": {},
        "error": reason,
    }


def _ignore_interrupts():
    """Ctrl-C is for the process that waits for the workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


# ---- results on disk


def _files(bag):
    path = Path(bag)
    return sorted(map(str, path.iterdir())) if path.is_dir() else [bag] if path.exists() else []


def _stored(task, directory):
    """The outcome of an earlier run; None where there is none, it failed, or something has changed
    since.
    """
    try:
        state = json.loads((directory / task.name / _STATE).read_text(encoding="utf-8"))
        if state["key"] == task.key() and not state["outcome"]["error"]:
            return state["outcome"]
    except (OSError, ValueError, LookupError, TypeError):
        return None  # to be done again, whatever is wrong with it
    return None


def _store(task, outcome, page, directory):
    from hand_eye_calib.io.results import save_result

    if outcome["calibration"]:
        save_result(
            Calibration.from_dict(outcome["calibration"]), directory / task.name, outcome["inputs"]
        )
    if page:
        save_page(directory / task.name / REPORT, page)
    _write(directory / task.name / _STATE, {"key": task.key(), "outcome": outcome})


def _write(path, document):
    from hand_eye_calib.io.results import replace_file

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, json.dumps(document, indent=2, allow_nan=False) + "\n")
    except OSError as error:
        raise InputError(
            f"cannot write {path}: {error.strerror}; choose another directory with --out"
        ) from None


def _print_table(rows):
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(box=box.SIMPLE, pad_edge=False)
    for heading in (
        "bag",
        "status",
        "x m",
        "y m",
        "z m",
        "roll deg",
        "pitch deg",
        "yaw deg",
        "poses",
        "warnings",
    ):
        table.add_column(heading, justify="left" if heading in ("bag", "status") else "right")
    for row in rows:
        calibration = row["calibration"]
        if row["error"] or not calibration:
            table.add_row(row["name"], "failed", *[""] * 8)
            continue
        transform = calibration["T_parent_child"]
        numbers = [f"{value:.4f}" for value in transform["translation"]] + [
            f"{value:.3f}" for value in transform["rpy_deg"]
        ]
        table.add_row(
            row["name"],
            calibration["status"],
            *numbers,
            str(calibration["n_poses"]),
            str(len(calibration["warnings"])),
        )
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console = Console(highlight=False, markup=False, width=240)
    console.print(table)
    failed = [row for row in rows if row["error"]]
    print(f"{len(rows) - len(failed)} of {len(rows)} bags calibrated, {len(failed)} failed")
