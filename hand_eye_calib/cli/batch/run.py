"""The commands ``calibrate --batch`` and ``calibrate RECORDING RECORDING ...``: what was done
already, what is left, and what all results say.
"""

import argparse
import csv
import io
import json
import os
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from hand_eye_calib.cli.batch import tasks as names
from hand_eye_calib.cli.batch.tasks import Task, matching, tasks_of
from hand_eye_calib.cli.batch.work import Outcome, outcomes
from hand_eye_calib.cli.console import STREAMS, note, waiting_for, with_progress
from hand_eye_calib.cli.options import options_from, sources_from
from hand_eye_calib.cli.present import deliver, exit_code, wrapped
from hand_eye_calib.cli.reporting import REPORT, save_text
from hand_eye_calib.errors import InputError
from hand_eye_calib.plain import json_text
from hand_eye_calib.results.calibration import Calibration, Verdict
from hand_eye_calib.session.together import row_of_result, together
from hand_eye_calib.text import counted, listing

# The worst come first on the terminal; rows.csv has all.
_MOST_LINES = 200
_GRAVITY = ("failed", *(each.value for each in reversed(Verdict)))
# Text that begins with one of these is a formula to spreadsheets, with full width to some.
_FORMULA = ("=", "+", "-", "@", *"＝＋－＠")

Row = dict[str, Any]


class Done(NamedTuple):
    """A recording that is done: its row, and its outcome as text, which takes little memory."""

    row: Row
    text: str
    code: int

    @classmethod
    def of(cls, outcome: Outcome) -> "Done":
        """Raises the errors of damaged values."""
        found, code = outcome["calibration"], 1
        if found and not outcome["error"]:
            code = exit_code(Calibration.from_dict(found))
        return cls(row_of(outcome), json.dumps(outcome, separators=(",", ":")), code)

    @property
    def calibration(self) -> Calibration:
        return Calibration.from_dict(json.loads(self.text)["calibration"])

    @property
    def verdict(self) -> str:
        return "failed" if self.row["error"] else str(self.row["verdict"])


def run_batch(arguments: argparse.Namespace) -> int:
    """Calibrate from many recordings; returns the exit code. A bag that fails is a row."""
    title = " ".join(arguments.batch)
    with waiting_for(f"looking for {title}"):
        groups = [[bag] for pattern in arguments.batch for bag in matching(pattern)]
    done = _all_done(groups, arguments.vehicle or "", arguments)
    vehicles = _vehicles(done)
    if arguments.out:
        from hand_eye_calib.io.results import save_result

        for name, each in vehicles.items():
            save_result(each, arguments.out / names.VEHICLES / name)
        _write_rows_and_page(arguments.out, title, done, vehicles, names.INDEX)
    if arguments.json:
        document = {
            "batch": title,
            "counts": dict(Counter(one.verdict for one in done)),
            "failures": [one.row["name"] for one in done if one.row["error"]],
            "vehicles": {name: each.to_dict() for name, each in vehicles.items()},
        }
        # Their outcomes one by one: they may be many.
        print(json_text(document).removesuffix("\n}") + ',\n  "results": [')
        print(",\n".join(f"    {one.text}" for one in done) + "\n  ]\n}")
    else:
        _print_results(done, vehicles)
    alone = sum(bool(one.row["verdict"] and not one.row["vehicle"]) for one in done)
    if alone > 1:
        note(
            f"{alone} recordings are not compared with each other: give --vehicle with the place "
            "of the vehicle in their paths, such as 'fleet/{vehicle}/*'"
        )
    codes = {one.code for one in done}
    return 1 if 1 in codes else max(codes)


def run_together(
    arguments: argparse.Namespace, groups: Sequence[Sequence[Path | str]], are_files: bool
) -> int:
    """Calibrate from several recordings of one rig, each given by its bags or files, for one
    result; returns the exit code.
    """
    done = _all_done([[*map(str, group)] for group in groups], "rig", arguments, are_files)
    usable = {one.row["name"]: one.calibration for one in done if one.row["verdict"]}
    if not usable:
        raise InputError("; ".join(f"{one.row['name']}: {one.row['error']}" for one in done))
    found = together(usable)
    if arguments.out:
        _write_rows_and_page(arguments.out, "recordings of one rig", done, {"rig": found}, REPORT)
    inputs = {"recordings": {one.row["name"]: json.loads(one.text)["inputs"] for one in done}}
    code = deliver(found, arguments, inputs)
    return 1 if any(one.row["error"] for one in done) else code


def _all_done(
    groups: Sequence[Sequence[str]],
    vehicle: str,
    arguments: argparse.Namespace,
    are_files: bool = False,
) -> list[Done]:
    """The recordings of an earlier run, and of this one, in their order."""
    out: Path | None = arguments.out
    tasks = tasks_of(
        groups,
        vehicle,
        options=options_from(arguments),
        sources=sources_from(arguments),
        with_fingerprints=bool(out),
        with_report=bool(out) and not arguments.no_report,
        are_files=are_files,
    )
    found: dict[str, Done] = {}
    for task in with_progress(tasks, len(tasks), "looking for earlier results") if out else ():
        if earlier := stored(task, arguments.out):
            found[task.name] = earlier
    if found:
        note(f"{len(found)} of {len(tasks)} bags are done already; their results are in {out}")
    waiting = [task for task in tasks if task.name not in found]
    jobs = min(arguments.jobs or os.cpu_count() or 1, len(waiting))
    doing = outcomes(waiting, jobs, arguments.dask) if waiting else ()
    for task, outcome in with_progress(doing, len(waiting), "calibrating"):
        page = outcome.pop("page", None)
        found[task.name] = one = Done.of(outcome)
        if out:
            _store(task, outcome, page, out)
        told = one.row["error"] or one.row["headline"]
        if one.row["error"] or not sys.stderr.isatty():
            note(f"{len(found)} of {len(tasks)}: {task.name}: {told}")
    return [found[task.name] for task in tasks]


def stored(task: Task, directory: Path) -> Done | None:
    """What an earlier run did; None if there is nothing, it failed, or something has changed since.
    A folder that is a link out of the directory is an InputError.
    """
    folder = directory / task.name
    if folder.is_symlink() and not folder.resolve().is_relative_to(directory.resolve()):
        raise InputError(f"{folder} is a link out of {directory}; remove it")
    try:
        state = json.loads((folder / names.STATE).read_text(encoding="utf-8"))
        is_same = state["key"] == task.key() and not state["outcome"]["error"]
        return Done.of(state["outcome"]) if is_same else None
    except Exception:  # to be done again, whatever is wrong with it
        return None


def _store(task: Task, outcome: Outcome, page: str | None, directory: Path) -> None:
    """Write the results of a task into its folder."""
    from hand_eye_calib.io.results import save_result

    folder = directory / task.name
    if outcome["calibration"]:
        save_result(Calibration.from_dict(outcome["calibration"]), folder, outcome["inputs"])
    if page:
        save_text(folder / REPORT, page)
    # What failed is done again in any case, and its bag may be out of reach.
    key = "" if outcome["error"] else task.key()
    save_text(folder / names.STATE, json_text({"key": key, "outcome": outcome}) + "\n")


def row_of(outcome: Outcome) -> Row:
    """The row of an outcome in plain values, for tables of other programs."""
    inputs, calibration = outcome["inputs"], outcome["calibration"]
    row: Row = {name: outcome[name] for name in ("name", "vehicle", "error")}
    row |= dict.fromkeys(("start", "duration_s", "verdict", "headline"))
    row["bags"] = " ".join(outcome["bags"])
    stamps = [inputs[each] for each in STREAMS if each in inputs]
    starts = [stream["first_stamp_ns"] for stream in stamps]
    if starts and None not in starts:
        date = datetime.fromtimestamp(max(starts) // 1_000_000_000, UTC)
        row["start"] = date.isoformat(timespec="seconds")
        row["duration_s"] = (min(each["last_stamp_ns"] for each in stamps) - max(starts)) * 1e-9
    if calibration:
        row |= row_of_result(calibration) | {"warnings": "; ".join(calibration["warnings"])}
        row["findings"] = " ".join(finding["code"] for finding in outcome["findings"])
    return row


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write a CSV file of rows: text in quotes, numbers without, what is not known empty."""
    text = io.StringIO()
    columns = [*max(rows, key=len)]
    writer = csv.DictWriter(text, columns, None, lineterminator="\n", quoting=csv.QUOTE_NONNUMERIC)
    writer.writeheader()
    for row in rows:
        texts = {name: value for name, value in row.items() if isinstance(value, str)}
        # An apostrophe stands before text that would be a formula.
        are = {name: f"'{text}" for name, text in texts.items() if text.lstrip()[:1] in _FORMULA}
        writer.writerow(row | are)
    save_text(path, text.getvalue())


def _vehicles(done: Sequence[Done]) -> dict[str, Calibration]:
    """What the recordings of each vehicle say together."""
    groups: dict[str, list[Done]] = {}
    for one in done:
        if one.row["vehicle"] and one.row["verdict"]:
            groups.setdefault(one.row["vehicle"], []).append(one)
    found: dict[str, Calibration] = {}
    for vehicle, group in sorted(groups.items()):
        try:
            if len(group) > 1:
                found[vehicle] = together({one.row["name"]: one.calibration for one in group})
        except InputError as error:
            note(f"{vehicle} has no common result: {error}")
    return found


def _write_rows_and_page(
    directory: Path,
    title: str,
    done: Sequence[Done],
    vehicles: Mapping[str, Calibration],
    page: str,
) -> None:
    from hand_eye_calib.report.batch_page import render_batch

    rows = [one.row for one in done]
    write_rows(directory / names.TABLE, rows)
    linked = {row["name"] for row in rows if (directory / row["name"] / REPORT).exists()}
    save_text(directory / page, render_batch(title, rows, vehicles, linked))
    for name in (names.TABLE, page):
        note(f"wrote {directory / name}")


def _print_results(done: Sequence[Done], vehicles: Mapping[str, Calibration]) -> None:
    """Print a line for each recording, the worst first, and what those of each vehicle say."""
    in_order = sorted(done, key=lambda one: _GRAVITY.index(one.verdict))
    for one in in_order[:_MOST_LINES]:
        told = f"failed: {one.row['error']}" if one.row["error"] else one.row["headline"]
        print("\n".join(wrapped(f"{one.row['name']}: {told}", "", "  ")))
    if len(done) > _MOST_LINES:
        print(f"{len(done) - _MOST_LINES} more, none with a worse verdict")
    counts = Counter(one.verdict for one in in_order)
    failed = counts.pop("failed", 0)
    print(f"{len(done) - failed} of {counted(len(done), 'bag')} calibrated, {failed} failed")
    if counts:
        print(listing([f"{count} {verdict}" for verdict, count in counts.items()]))
    for name, each in vehicles.items():
        sentence = each.together.sentence if each.together else ""
        print("\n".join(wrapped(f"{name}: {each.headline}. {sentence}", "", "  ")))
