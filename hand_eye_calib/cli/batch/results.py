"""Outcomes in the folder of the results, so that a second run does only what is left; and one row
of plain values for each recording, for tables of other programs.
"""

import csv
import io
import json
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hand_eye_calib.cli.batch.tasks import STATE, Task
from hand_eye_calib.cli.batch.workers import Outcome
from hand_eye_calib.cli.options import STREAMS
from hand_eye_calib.cli.reporting import REPORT, save_text
from hand_eye_calib.errors import InputError
from hand_eye_calib.plain import json_text
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.session.together import TAKEN, row_of_result

Row = dict[str, Any]

_VALUES = [*(f"{axis}_m" for axis in "xyz"), *(f"{axis}_deg" for axis in ("roll", "pitch", "yaw"))]
COLUMNS = (
    *("name", "vehicle", "bags", "start", "start_ns", "duration_s", "bytes"),
    *TAKEN[:5],
    *(
        name
        for part in (_VALUES[:3], _VALUES[3:])
        for to in ("", "sigma_")
        for name in map(to.__add__, part)
    ),
    *(f"{name.partition('_')[0]}_is" for name in _VALUES),
    *TAKEN[5:],
    *("findings", "warnings", "error"),
)
# Text that begins with one of these is a formula to spreadsheets, with full width to some.
_FORMULA = tuple("=+-@＝＋－＠")


def stored(task: Task, directory: Path) -> Outcome | None:
    """The outcome of an earlier run; None if there is none, it failed, or something has changed
    since.
    """
    folder = directory / task.name
    if folder.is_symlink() and not folder.resolve().is_relative_to(directory.resolve()):
        raise InputError(f"{folder} is a link out of {directory}; remove it")
    try:
        state = json.loads((folder / STATE).read_text(encoding="utf-8"))
        outcome = dict(state["outcome"])
        if state["key"] == task.key() and not outcome["error"]:
            row_of(outcome)
            return outcome
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return None  # to be done again, whatever is wrong with it
    return None


def store(task: Task, outcome: Outcome, page: str | None, directory: Path) -> None:
    """Write the results of a task into its folder."""
    from hand_eye_calib.io.results import save_result

    folder = directory / task.name
    if outcome["calibration"]:
        save_result(Calibration.from_dict(outcome["calibration"]), folder, outcome["inputs"])
    if page:
        save_text(folder / REPORT, page)
    # What failed is done again in any case, and its bag may be out of reach.
    key = "" if outcome["error"] else task.key()
    save_text(folder / STATE, json_text({"key": key, "outcome": outcome}) + "\n")


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """Write a CSV file of rows: text in quotes, numbers without, None empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n", quoting=csv.QUOTE_NONNUMERIC)
    writer.writeheader()
    for row in rows:
        writer.writerow({name: _as_cell(value) for name, value in row.items()})
    save_text(path, text.getvalue())


def _as_cell(value: Any) -> Any:
    """A value of a cell; an apostrophe stands before text that would be a formula."""
    is_formula = isinstance(value, str) and value.lstrip().startswith(_FORMULA)
    return f"'{value}" if is_formula else value


def row_of(outcome: Outcome) -> Row:
    """The row of an outcome, whenever and wherever it was done; what is not known is None."""
    row: Row = dict.fromkeys(COLUMNS)
    row |= {name: outcome[name] for name in ("name", "vehicle", "error")}
    row["bags"] = " ".join(outcome["bags"])
    streams = [outcome["inputs"][each] for each in STREAMS if each in outcome["inputs"]]
    starts = [stream["first_stamp_ns"] for stream in streams]
    if starts and None not in starts:
        start_ns, end_ns = max(starts), min(stream["last_stamp_ns"] for stream in streams)
        date = datetime.fromtimestamp(start_ns // 1_000_000_000, UTC)
        row |= {"start_ns": start_ns, "duration_s": (end_ns - start_ns) * 1e-9}
        row["start"] = date.isoformat(timespec="seconds")
    if files := outcome["inputs"].get("files"):
        row["bytes"] = sum(file["bytes"] for file in files)
    row["findings"] = " ".join(finding["code"] for finding in outcome["findings"])
    if calibration := outcome["calibration"]:
        row |= row_of_result(calibration) | {"warnings": "; ".join(calibration["warnings"])}
    return row
