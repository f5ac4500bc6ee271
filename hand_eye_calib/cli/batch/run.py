"""The commands ``calibrate --batch`` and ``calibrate RECORDING RECORDING ...``: tasks, workers,
results, and what is printed of them.
"""

import argparse
import contextlib
import json
import os
import sys
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hand_eye_calib.cli.batch.results import Row, row_of, store, stored, write_rows
from hand_eye_calib.cli.batch.tasks import (
    INDEX,
    SOURCES,
    SUMMARY,
    TABLE,
    VEHICLES,
    Task,
    read_batch,
)
from hand_eye_calib.cli.batch.workers import Outcome, on_cores, on_dask
from hand_eye_calib.cli.console import note, print_table, waiting_for, with_progress
from hand_eye_calib.cli.options import options_from
from hand_eye_calib.cli.present import deliver, wrapped
from hand_eye_calib.cli.reporting import REPORT, can_draw, save_text
from hand_eye_calib.errors import InputError
from hand_eye_calib.plain import json_text
from hand_eye_calib.results.calibration import Calibration, Verdict
from hand_eye_calib.session.together import together
from hand_eye_calib.text import counted, listing, with_sigma

_HEADINGS = (" x m", " y m", " z m", " roll deg", " pitch deg", " yaw deg", " poses", " warnings")
# The worst come first on the terminal; rows.csv has all.
_MOST_LINES = 200
_GRAVITY = ("failed", *(each.value for each in reversed(Verdict)))
_EXIT_FAILED, _EXIT_NOT_ALL = 1, 3


class _Done(NamedTuple):
    """A recording that is done: its row, and its outcome as text, which takes little memory."""

    row: Row
    text: str
    code: int
    is_new: bool

    @property
    def outcome(self) -> Outcome:
        return dict(json.loads(self.text))

    @property
    def verdict(self) -> str:
        return "failed" if self.row["error"] else str(self.row["verdict"])

    @property
    def rig(self) -> tuple[str, ...]:
        """Vehicle and frames: recordings of other frames are another rig."""
        return tuple(self.row[name] for name in ("vehicle", "parent_frame", "child_frame"))


def run_batch(arguments: argparse.Namespace) -> int:
    """Calibrate from many recordings; returns the exit code. A bag that fails is a row."""
    out: Path | None = arguments.out
    title = " ".join(map(str, arguments.batch))
    with waiting_for(f"reading {title}"):
        tasks = _tasks(arguments, arguments.batch, arguments.vehicle or "")
    done = _all_done(tasks, arguments)
    rigs: dict[tuple[str, ...], list[_Done]] = {}
    for one in done:
        if one.row["vehicle"] and one.row["verdict"]:
            rigs.setdefault(one.rig, []).append(one)
    vehicles = {}
    changed = set()
    for rig, group in sorted(rigs.items()):
        name = rig[0] if rig[0] not in vehicles else " ".join(rig)
        with contextlib.suppress(InputError):  # no recording of it can be used
            if len(group) > 1:
                vehicles[name] = _together(group)
        if any(one.is_new for one in group):
            changed.add(name)
    if out:
        _write_summary(out, title, done, vehicles, changed)
    if arguments.json:
        _print_document(title, done, vehicles)
    else:
        _print_results(done, vehicles)
    alone = sum(bool(one.row["verdict"] and not one.row["vehicle"]) for one in done)
    if alone > 1:
        note(
            f"{alone} recordings are not compared with each other: give --vehicle with the place "
            "of the vehicle in their paths, such as 'fleet/{vehicle}/*'"
        )
    return _exit_code(done)


def run_together(
    arguments: argparse.Namespace, groups: Sequence[Sequence[Path | str]], are_files: bool
) -> int:
    """Calibrate from several recordings of one rig, each given by its bags or files, for one
    result; returns the exit code.
    """
    out: Path | None = arguments.out
    entries = [{"bag": list(map(str, group))} for group in groups]
    done = _all_done(_tasks(arguments, entries, "rig", are_files=are_files), arguments)
    if not any(one.row["verdict"] for one in done):
        raise InputError("; ".join(f"{one.row['name']}: {one.row['error']}" for one in done))
    found = _together([one for one in done if one.row["verdict"]])
    if out:
        _write_rows_and_page(out, "recordings of one rig", done, {"rig": found}, REPORT)
    inputs = {"recordings": {one.row["name"]: one.outcome["inputs"] for one in done}}
    code = deliver(found, arguments, inputs, None)
    failed = any(one.row["error"] for one in done)
    _note_errors(done)
    return _EXIT_FAILED if failed else code


def _tasks(arguments: argparse.Namespace, given: Any, vehicle: str, **flags: bool) -> list[Task]:
    sources = {
        name: value if isinstance(value, str) else ":".join(value)
        for name in SOURCES
        if (value := getattr(arguments, name))
    }
    with_report = bool(arguments.out) and not arguments.no_report and can_draw(REPORT)
    flags |= {"with_fingerprints": bool(arguments.out), "with_report": with_report}
    return read_batch(given, options_from(arguments), sources, vehicle, **flags)


def _all_done(tasks: Sequence[Task], arguments: argparse.Namespace) -> list[_Done]:
    """The recordings of an earlier run, and of this one, in the order of the tasks."""
    out: Path | None = arguments.out
    found: dict[str, _Done] = {}
    if out:
        for task in with_progress(tasks, len(tasks), "looking for earlier results"):
            if outcome := stored(task, out):
                found[task.name] = _done(outcome, is_new=False)
    if found:
        note(f"{len(found)} of {len(tasks)} bags are done already; their results are in {out}")
    waiting = [task for task in tasks if task.name not in found]
    jobs = min(arguments.jobs or os.cpu_count() or 1, max(len(waiting), 1))
    with on_dask(arguments.dask) if arguments.dask else on_cores(jobs) as do:
        for task, outcome in with_progress(do(waiting), len(waiting), "calibrating"):
            page = outcome.pop("page", None)
            found[task.name] = one = _done(outcome, is_new=True)
            if out:
                store(task, outcome, page, out)
            if not sys.stderr.isatty():
                told = one.row["error"] or one.row["headline"]
                note(f"{len(found)} of {len(tasks)}: {task.name}: {told}")
    return [found[task.name] for task in tasks]


def _done(outcome: Outcome, is_new: bool) -> _Done:
    calibration, code = outcome["calibration"], 0
    if outcome["error"] or not calibration:
        code = _EXIT_FAILED
    else:
        silent = {"rotations": "xyz", "positions": "rollpitchyaw"}.get(calibration["measured"], "")
        hidden = any(
            dof["verdict"] == "unobservable" and dof["name"] not in silent
            for dof in calibration["observability"]
        )
        is_poor = calibration["verdict"] == Verdict.DO_NOT_USE.name
        code = _EXIT_NOT_ALL if hidden or is_poor else 0
    return _Done(row_of(outcome), json.dumps(outcome, separators=(",", ":")), code, is_new)


def _together(group: Sequence[_Done]) -> Calibration:
    return together(
        {one.row["name"]: Calibration.from_dict(one.outcome["calibration"]) for one in group}
    )


def _exit_code(done: Sequence[_Done]) -> int:
    _note_errors(done)
    codes = {one.code for one in done}
    return _EXIT_FAILED if _EXIT_FAILED in codes else max(codes)


def _note_errors(done: Sequence[_Done]) -> None:
    failed = [one.row for one in done if one.row["error"]]
    for row in failed[:_MOST_LINES]:
        note(f"{row['name']} failed: {row['error']}")


def _document(title: str, done: Sequence[_Done], vehicles: Mapping[str, Calibration]) -> Row:
    """What there is to say of all together, as plain values."""
    return {
        "batch": title,
        "counts": dict(Counter(one.verdict for one in done)),
        "failures": [one.row["name"] for one in done if one.row["error"]],
        "vehicles": {name: each.to_dict() for name, each in vehicles.items()},
    }


def _print_document(title: str, done: Sequence[_Done], vehicles: Mapping[str, Calibration]) -> None:
    """Print the document with the outcome of every recording, one by one: they may be many."""
    print(json_text(_document(title, done, vehicles)).rstrip().removesuffix("}").rstrip() + ",")
    print('  "results": [')
    for number, one in enumerate(done, start=1):
        print(f"    {one.text}{',' if number < len(done) else ''}")
    print("  ]\n}")


def _write_summary(
    directory: Path,
    title: str,
    done: Sequence[_Done],
    vehicles: Mapping[str, Calibration],
    changed: Collection[str],
) -> None:
    """Write everything that is said of all together, and the results of vehicles that changed."""
    from hand_eye_calib.io.results import save_result

    with waiting_for("writing the summary"):
        text = json_text(_document(title, done, vehicles)) + "\n"
        save_text(directory / SUMMARY, text)
        for name, each in vehicles.items():
            folder = directory / VEHICLES / name.replace("/", "_")
            if name in changed or not folder.exists():
                save_result(each, folder)
        _write_rows_and_page(directory, title, done, vehicles, INDEX)


def _write_rows_and_page(
    directory: Path,
    title: str,
    done: Sequence[_Done],
    vehicles: Mapping[str, Calibration],
    page: str,
) -> None:
    paths = [directory / TABLE]
    rows = [one.row for one in done]
    write_rows(paths[0], rows)
    if can_draw(page):
        from hand_eye_calib.report.batch_page import render_batch

        linked = {row["name"] for row in rows if (directory / row["name"] / REPORT).exists()}
        paths.append(directory / page)
        save_text(paths[1], render_batch(title, rows, vehicles, linked))
    for path in paths:
        note(f"wrote {path}")


def _print_results(done: Sequence[_Done], vehicles: Mapping[str, Calibration]) -> None:
    """Print a row for each recording, the worst first if they are many, and what those of each
    vehicle say together.
    """
    shown = list(done)
    if len(done) > _MOST_LINES:
        shown = sorted(done, key=lambda one: _GRAVITY.index(one.verdict))[:_MOST_LINES]
    of_vehicle = ["vehicle"] if any(one.row["vehicle"] for one in done) else []
    headings = ("recording", *of_vehicle, "verdict", *_HEADINGS)
    print_table("", headings, (_cells(one, of_vehicle) for one in shown))
    if len(shown) < len(done):
        print(f"{len(done) - len(shown)} more, none with a worse verdict")
    counts = Counter(one.verdict for one in done)
    failed = counts.pop("failed", 0)
    print(f"{len(done) - failed} of {counted(len(done), 'bag')} calibrated, {failed} failed")
    if counts:
        print(listing([f"{count} {verdict}" for verdict, count in counts.most_common()]))
    for name, each in vehicles.items():
        sentence = each.together.sentence if each.together else ""
        print("\n".join(wrapped(f"{name}: {each.headline}. {sentence}", "", "  ")))


def _cells(one: _Done, of_vehicle: Sequence[str]) -> Iterator[str]:
    """Names, verdict, numbers with their standard deviations, counts."""
    row = one.row
    yield from (row[name] for name in ("name", *of_vehicle))
    yield one.verdict
    if one.verdict == "failed":
        return
    for axis in ("x", "y", "z", "roll", "pitch", "yaw"):
        unit, decimals = ("m", 3) if axis in "xyz" else ("deg", 2)
        yield with_sigma(row[f"{axis}_{unit}"], row[f"sigma_{axis}_{unit}"], decimals)
    yield str(row["n_poses"])
    yield str(len(row["warnings"].split("; ")) if row["warnings"] else 0)
