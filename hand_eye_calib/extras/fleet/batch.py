"""Commands ``calibrate --batch`` and ``calibrate RECORDING RECORDING ...``.

Results of an earlier run are reused. Results of the same vehicle are combined.
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

from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.base.plain import json_text
from hand_eye_calib.core.base.text import counted, listing, shown_value
from hand_eye_calib.core.results.calibration import Calibration, Verdict
from hand_eye_calib.extras.fleet import work
from hand_eye_calib.extras.fleet.records import CONTRADICTIONS, is_in_headline
from hand_eye_calib.extras.fleet.together import together
from hand_eye_calib.extras.fleet.work import (
    Outcome,
    Row,
    Task,
    outcomes,
    tasks_of,
)
from hand_eye_calib.formats.bags.patterns import is_other_file, matching
from hand_eye_calib.formats.results import save_result, save_text
from hand_eye_calib.offline.beside_motion import switched_off
from hand_eye_calib.offline.cli.config_file import options_from
from hand_eye_calib.offline.cli.options import (
    Exit,
    note,
    sources_from,
    waiting_for,
    with_progress,
)
from hand_eye_calib.offline.cli.present import (
    deliver,
    exit_code,
    gravest_code,
    wrapped,
)
from hand_eye_calib.offline.cli.reading import span_from
from hand_eye_calib.offline.cli.reporting import REPORT

# Largest number of results on the terminal. rows.csv contains all results.
_MOST_LINES = 200

# Verdicts of outcomes, the gravest first.
_GRAVITY = ("failed", *(verdict.value for verdict in reversed(Verdict)))

# First characters of formulas in spreadsheets; some spreadsheets also accept full-width characters.
_FORMULA = ("=", "+", "-", "@", *"＝＋－＠")


def run_batch(arguments: argparse.Namespace) -> int:
    """Calibrate many recordings. Return the exit code.

    A recording that fails becomes a row with its error.

    Raises
    ------
    ConfigError
        If no bag matches, or if all paths are files of another kind.
    """
    title = " ".join(arguments.batch)
    with waiting_for(f"looking for {title}"):
        paths = [
            path for pattern in arguments.batch for path in matching(pattern)
        ]
    if all(is_other_file(path) for path in paths):
        raise ConfigError(
            f"{paths[0]} is not a bag, and batch takes bags: for trajectory files, use calibrate "
            "PARENT CHILD, or calibrate_many in Python"
        )
    groups = [[path] for path in paths]
    done = _all_done(groups, arguments.vehicle or "", arguments)
    vehicles = _vehicles(done, arguments.out)
    if arguments.out:
        _write_rows_and_page(arguments.out, title, done, vehicles, work.INDEX)
    if arguments.json:
        _print_json(title, done, vehicles)
    else:
        _print_results(done, vehicles)
    _note_recordings_without_vehicle(done, arguments.vehicle)
    codes = [outcome.code for outcome in done]
    codes += [_code_of_vehicle(result) for result in vehicles.values()]
    return gravest_code(codes)


def _note_recordings_without_vehicle(
    done: Sequence[Outcome], pattern: str | None
) -> None:
    """Print that results without a vehicle are not compared, and how to name the vehicle."""
    n_alone = 0
    for outcome in done:
        if outcome.row["verdict"] and not outcome.row["vehicle"]:
            n_alone += 1
    if n_alone <= 1:
        return
    why = "set --vehicle to"
    if pattern:
        why = f"--vehicle {shown_value(pattern)} fits none of their paths; set it to"
    note(
        f"{n_alone} recordings are not compared with each other: {why} the position of the "
        "vehicle in their paths, such as 'fleet/{vehicle}/*'"
    )


def _code_of_vehicle(result: Calibration) -> int:
    """Return the exit code of a vehicle: MOVED if its recordings contradict each other."""
    together = result.parts.get("together")
    if together and together.kind in CONTRADICTIONS:
        return max(exit_code(result), Exit.MOVED)
    return exit_code(result)


def _print_json(
    title: str, done: Sequence[Outcome], vehicles: Mapping[str, Calibration]
) -> None:
    """Print one JSON document with all outcomes. Each outcome already is a JSON text."""
    document = {
        "batch": title,
        "counts": dict(Counter(outcome.verdict for outcome in done)),
        "failures": [
            outcome.row["name"] for outcome in done if outcome.row["error"]
        ],
        "vehicles": {
            name: result.to_dict() for name, result in vehicles.items()
        },
    }
    print(json_text(document).removesuffix("\n}") + ',\n  "results": [')
    print(",\n".join(f"    {outcome.text}" for outcome in done) + "\n  ]\n}")


def run_together(
    arguments: argparse.Namespace, groups: Sequence[Sequence[Path | str]]
) -> int:
    """Calibrate from several recordings of one rig to one result; return the exit code.

    ``groups`` are the bags of each recording.
    """
    done = _all_done([[*map(str, group)] for group in groups], "rig", arguments)
    usable = {
        outcome.row["name"]: outcome.calibration
        for outcome in done
        if outcome.row["verdict"]
    }
    if not usable:
        errors = [
            f"{outcome.row['name']}: {outcome.row['error']}" for outcome in done
        ]
        raise InputError("; ".join(errors))
    result = together(usable)
    if arguments.out:
        _write_rows_and_page(
            arguments.out,
            "recordings of one rig",
            done,
            {"rig": result},
            REPORT,
        )
    inputs = {
        "recordings": {outcome.row["name"]: outcome.inputs for outcome in done}
    }
    code = deliver(result, inputs, arguments)
    return 1 if any(outcome.row["error"] for outcome in done) else code


def _all_done(
    groups: Sequence[Sequence[str]], vehicle: str, arguments: argparse.Namespace
) -> list[Outcome]:
    """Return the outcomes of all recordings in order; outcomes of an earlier run are reused."""
    out: Path | None = arguments.out
    tasks = tasks_of(
        groups,
        vehicle,
        options=options_from(arguments),
        sources=sources_from(arguments),
        without=tuple(switched_off(vars(arguments))),
        span=span_from(arguments),
        with_fingerprints=bool(out),
        with_report=bool(out) and not arguments.no_report,
    )
    done = _earlier_outcomes(tasks, out) if out else {}
    waiting = [task for task in tasks if task.name not in done]
    running = outcomes(
        waiting, arguments.jobs or os.cpu_count() or 1, arguments.dask
    )
    for task, outcome in with_progress(running, len(waiting), "calibrating"):
        done[task.name] = outcome._replace(page="")
        if out:
            _store(task, outcome, out)
        error = outcome.row["error"]
        if error or not sys.stderr.isatty():
            note(
                f"{len(done)} of {len(tasks)}: {task.name}: {error or outcome.row['headline']}"
            )
    return [done[task.name] for task in tasks]


def _earlier_outcomes(
    tasks: Sequence[Task], directory: Path
) -> dict[str, Outcome]:
    """Return the outcomes of an earlier run by the names of their tasks."""
    done: dict[str, Outcome] = {}
    for task in with_progress(tasks, len(tasks), "looking for earlier results"):
        earlier = stored(task, directory)
        if earlier:
            done[task.name] = earlier
    if done:
        note(
            f"{len(done)} of {len(tasks)} bags are done already; their results are in {directory}"
        )
    return done


def stored(task: Task, directory: Path) -> Outcome | None:
    """Return the outcome of an earlier run; None if it is missing, failed, or for other data.

    A failed run has an empty key, see :func:`_store`. No task has an empty key.
    """
    try:
        about, text = (
            (directory / task.name / work.STATE)
            .read_text(encoding="utf-8")
            .splitlines()
        )
        state = json.loads(about)
        return (
            Outcome(state["row"], state["code"], text)
            if state["key"] == task.key()
            else None
        )
    # The task is repeated for any problem with the file.
    except Exception:
        return None


def _store(task: Task, outcome: Outcome, directory: Path) -> None:
    """Write the results of a task into its folder."""
    folder = directory / task.name
    if outcome.row["verdict"]:
        save_result(outcome.calibration, folder, outcome.inputs)
    if outcome.page:
        save_text(folder / REPORT, outcome.page)
    # A failed task has no key, so that it is repeated. Its bag may be unreadable.
    key = "" if outcome.row["error"] else task.key()
    about = json.dumps({"key": key, "row": outcome.row, "code": outcome.code})
    save_text(folder / work.STATE, f"{about}\n{outcome.text}\n")


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write a CSV file of rows: texts in quotes, numbers without quotes, unknown values empty."""
    text = io.StringIO()
    # Rows of failures lack columns; the longest row has all columns.
    columns = [*max(rows, key=len)]
    writer = csv.DictWriter(
        text, columns, None, lineterminator="\n", quoting=csv.QUOTE_NONNUMERIC
    )
    writer.writeheader()
    for row in rows:
        safe = dict(row)
        for name, value in row.items():
            # An apostrophe prevents a spreadsheet from reading the text as a formula.
            if isinstance(value, str) and value.lstrip()[:1] in _FORMULA:
                safe[name] = f"'{value}"
        writer.writerow(safe)
    save_text(path, text.getvalue())


def _vehicles(
    done: Sequence[Outcome], directory: Path | None
) -> dict[str, Calibration]:
    """Return the result of each vehicle by its name.

    A vehicle with a single recording has the result of this recording. Several recordings have a
    common result. If an earlier run had the same recordings, its result is reused.
    """
    groups: dict[str, list[Outcome]] = {}
    for outcome in done:
        if outcome.row["vehicle"] and outcome.row["verdict"]:
            groups.setdefault(outcome.row["vehicle"], []).append(outcome)
    results: dict[str, Calibration] = {}
    for vehicle, group in sorted(groups.items()):
        texts = "\n".join(outcome.text for outcome in group)
        digest = hashlib.sha256(texts.encode()).hexdigest()
        task = Task(
            name=f"{work.VEHICLES}/{vehicle}",
            bags=(),
            options={"results": digest},
        )
        earlier = stored(task, directory) if directory else None
        if earlier:
            results[vehicle] = earlier.calibration
            continue
        recordings = {
            outcome.row["name"]: outcome.calibration for outcome in group
        }
        if len(recordings) == 1:
            (results[vehicle],) = recordings.values()
        else:
            try:
                results[vehicle] = together(recordings)
            except InputError as error:
                note(f"{vehicle} has no common result: {error}")
                continue
        if directory:
            _store(task, Outcome.of(task, None, results[vehicle]), directory)
    return results


def _write_rows_and_page(
    directory: Path,
    title: str,
    done: Sequence[Outcome],
    vehicles: Mapping[str, Calibration],
    page: str,
) -> None:
    from hand_eye_calib.extras.fleet.batch_page import render_batch

    rows = [outcome.row for outcome in done]
    write_rows(directory / work.TABLE, rows)
    linked = {
        row["name"]
        for row in rows
        if (directory / row["name"] / REPORT).exists()
    }
    # The rows of the page contain the results of vehicles with a single recording.
    with_several = {
        name: result
        for name, result in vehicles.items()
        if "together" in result.parts
    }
    save_text(directory / page, render_batch(title, rows, with_several, linked))
    for name in (work.TABLE, page):
        note(f"wrote {directory / name}")


def _print_results(
    done: Sequence[Outcome], vehicles: Mapping[str, Calibration]
) -> None:
    """Print a line for each recording, the worst first, and the results of the vehicles."""
    in_order = sorted(done, key=lambda outcome: _GRAVITY.index(outcome.verdict))
    for outcome in in_order[:_MOST_LINES]:
        row = outcome.row
        text = f"failed: {row['error']}" if row["error"] else row["headline"]
        _print_line(row["name"], text)
    if len(done) > _MOST_LINES:
        print(f"{len(done) - _MOST_LINES} more, none with a worse verdict")
    counts = Counter(outcome.verdict for outcome in in_order)
    failed = counts.pop("failed", 0)
    print(
        f"{len(done) - failed} of {counted(len(done), 'bag')} calibrated, {failed} failed"
    )
    if counts:
        print(_counts_in_words(counts))
    if vehicles:
        _print_vehicles(vehicles)


def _print_vehicles(vehicles: Mapping[str, Calibration]) -> None:
    """Print the number of vehicles by verdict, and a line for each vehicle."""
    counts = Counter(result.verdict.value for result in vehicles.values())
    print(f"{counted(len(vehicles), 'vehicle')}: {_counts_in_words(counts)}")
    for name, result in vehicles.items():
        text = result.headline
        together = result.parts.get("together")
        if together and not is_in_headline(result):
            text = f"{text}. {together.sentence}"
        _print_line(name, text)


def _counts_in_words(counts: Mapping[str, int]) -> str:
    """Return the number of results by verdict as text, such as "3 USE and 1 DO NOT USE"."""
    return listing([f"{count} {verdict}" for verdict, count in counts.items()])


def _print_line(name: str, text: str) -> None:
    """Print the result of a recording or of a vehicle after its name."""
    print("\n".join(wrapped(f"{name}: {text}", "", "  ")))
