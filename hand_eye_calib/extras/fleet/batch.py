"""The commands ``calibrate --batch`` and ``calibrate RECORDING RECORDING ...``: what was done
already, what is left, and what all results say.
"""

import argparse
import csv
import hashlib
import io
import json
import os
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.plain import json_text
from hand_eye_calib.core.base.text import counted, listing
from hand_eye_calib.core.results.calibration import Calibration, Verdict
from hand_eye_calib.extras.fleet import work
from hand_eye_calib.extras.fleet.together import together
from hand_eye_calib.extras.fleet.work import Outcome, Row, Task, outcomes, tasks_of
from hand_eye_calib.formats.bags.patterns import matching
from hand_eye_calib.formats.results import save_result, save_text
from hand_eye_calib.offline.cli.options import (
    note,
    options_from,
    sources_from,
    waiting_for,
    with_progress,
)
from hand_eye_calib.offline.cli.present import deliver, wrapped
from hand_eye_calib.offline.cli.reporting import REPORT

# The worst come first on the terminal; rows.csv has all.
_MOST_LINES = 200
_GRAVITY = ("failed", *(each.value for each in reversed(Verdict)))
# Text that begins with one of these is a formula to spreadsheets, with full width to some.
_FORMULA = ("=", "+", "-", "@", *"＝＋－＠")


def run_batch(arguments: argparse.Namespace) -> int:
    """Calibrate from many recordings; returns the exit code. A bag that fails is a row."""
    title = " ".join(arguments.batch)
    with waiting_for(f"looking for {title}"):
        groups = [[bag] for pattern in arguments.batch for bag in matching(pattern)]
    done = _all_done(groups, arguments.vehicle or "", arguments)
    vehicles = _vehicles(done, arguments.out)
    if arguments.out:
        _write_rows_and_page(arguments.out, title, done, vehicles, work.INDEX)
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


def run_together(arguments: argparse.Namespace, groups: Sequence[Sequence[Path | str]]) -> int:
    """Calibrate from several recordings of one rig, each given by its bags, for one result; returns
    the exit code.
    """
    done = _all_done([[*map(str, group)] for group in groups], "rig", arguments)
    usable = {one.row["name"]: one.calibration for one in done if one.row["verdict"]}
    if not usable:
        raise InputError("; ".join(f"{one.row['name']}: {one.row['error']}" for one in done))
    found = together(usable)
    if arguments.out:
        _write_rows_and_page(arguments.out, "recordings of one rig", done, {"rig": found}, REPORT)
    code = deliver(found, {"recordings": {one.row["name"]: one.inputs for one in done}}, arguments)
    return 1 if any(one.row["error"] for one in done) else code


def _all_done(
    groups: Sequence[Sequence[str]], vehicle: str, arguments: argparse.Namespace
) -> list[Outcome]:
    """The recordings of an earlier run, and of this one, in their order."""
    out: Path | None = arguments.out
    tasks = tasks_of(
        groups,
        vehicle,
        options=options_from(arguments),
        sources=sources_from(arguments),
        with_fingerprints=bool(out),
        with_report=bool(out) and not arguments.no_report,
    )
    found: dict[str, Outcome] = {}
    for task in with_progress(tasks, len(tasks), "looking for earlier results") if out else ():
        if earlier := stored(task, arguments.out):
            found[task.name] = earlier
    if found:
        note(f"{len(found)} of {len(tasks)} bags are done already; their results are in {out}")
    waiting = [task for task in tasks if task.name not in found]
    doing = outcomes(waiting, arguments.jobs or os.cpu_count() or 1, arguments.dask)
    for task, outcome in with_progress(doing, len(waiting), "calibrating"):
        found[task.name] = outcome._replace(page="")
        if out:
            _store(task, outcome, out)
        if outcome.row["error"] or not sys.stderr.isatty():
            told = outcome.row["error"] or outcome.row["headline"]
            note(f"{len(found)} of {len(tasks)}: {task.name}: {told}")
    return [found[task.name] for task in tasks]


def stored(task: Task, directory: Path) -> Outcome | None:
    """What an earlier run did; None if there is nothing, it failed, or something has changed."""
    try:
        about, text = (directory / task.name / work.STATE).read_text(encoding="utf-8").splitlines()
        state = json.loads(about)
        return Outcome(state["row"], state["code"], text) if state["key"] == task.key() else None
    except Exception:  # to be done again, whatever is wrong with it
        return None


def _store(task: Task, outcome: Outcome, directory: Path) -> None:
    """Write the results of a task into its folder."""
    folder = directory / task.name
    if outcome.row["verdict"]:
        save_result(outcome.calibration, folder, outcome.inputs)
    if outcome.page:
        save_text(folder / REPORT, outcome.page)
    # What failed is done again in any case, and its bag may be out of reach.
    key = "" if outcome.row["error"] else task.key()
    about = json.dumps({"key": key, "row": outcome.row, "code": outcome.code})
    save_text(folder / work.STATE, f"{about}\n{outcome.text}\n")


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


def _vehicles(done: Sequence[Outcome], directory: Path | None) -> dict[str, Calibration]:
    """What the recordings of each vehicle say together, or said in an earlier run, if the same."""
    groups: dict[str, list[Outcome]] = {}
    for one in done:
        if one.row["vehicle"] and one.row["verdict"]:
            groups.setdefault(one.row["vehicle"], []).append(one)
    found: dict[str, Calibration] = {}
    for vehicle, group in sorted(groups.items()):
        if len(group) == 1:
            continue
        of_all = hashlib.sha256("\n".join(one.text for one in group).encode()).hexdigest()
        task = Task(name=f"{work.VEHICLES}/{vehicle}", bags=(), options={"results": of_all})
        if directory and (earlier := stored(task, directory)):
            found[vehicle] = earlier.calibration
            continue
        try:
            found[vehicle] = together({one.row["name"]: one.calibration for one in group})
        except InputError as error:
            note(f"{vehicle} has no common result: {error}")
            continue
        if directory:
            _store(task, Outcome.of(task, None, found[vehicle]), directory)
    return found


def _write_rows_and_page(
    directory: Path,
    title: str,
    done: Sequence[Outcome],
    vehicles: Mapping[str, Calibration],
    page: str,
) -> None:
    from hand_eye_calib.extras.fleet.batch_page import render_batch

    rows = [one.row for one in done]
    write_rows(directory / work.TABLE, rows)
    linked = {row["name"] for row in rows if (directory / row["name"] / REPORT).exists()}
    save_text(directory / page, render_batch(title, rows, vehicles, linked))
    for name in (work.TABLE, page):
        note(f"wrote {directory / name}")


def _print_results(done: Sequence[Outcome], vehicles: Mapping[str, Calibration]) -> None:
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
        together = each.parts.get("together")
        sentence = together.sentence if together else ""
        told = each.headline if sentence in each.headline else f"{each.headline}. {sentence}"
        print("\n".join(wrapped(f"{name}: {told}", "", "  ")))
