"""Outcomes in the folder of the results, so that a second run does only what is left; and one row
of plain values for each recording, for tables of other programs.
"""

import csv
import hashlib
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path, PurePath
from typing import Any

from hand_eye_calib.cli.batch.tasks import STATE, Task
from hand_eye_calib.cli.batch.workers import Outcome
from hand_eye_calib.cli.options import STREAMS
from hand_eye_calib.cli.reporting import REPORT, save_text
from hand_eye_calib.errors import InputError
from hand_eye_calib.plain import json_text
from hand_eye_calib.results.calibration import Calibration

Row = dict[str, Any]

_LENGTHS, _ANGLES = ("x", "y", "z"), ("roll", "pitch", "yaw")
# Of the calibration, as they are.
_TAKEN = (
    *("verdict", "headline", "status", "parent_frame", "child_frame"),
    *("method", "reference", "n_poses", "n_pairs", "n_inliers"),
    *("time_offset_s", "time_offset_sigma_s", "scale", "scale_sigma"),
)
COLUMNS = (
    *("name", "vehicle", "bags", "start", "sha256", "start_ns", "duration_s", "bytes"),
    *_TAKEN[:5],
    *(f"{name}_m" for name in _LENGTHS),
    *(f"sigma_{name}_m" for name in _LENGTHS),
    *(f"{name}_deg" for name in _ANGLES),
    *(f"sigma_{name}_deg" for name in _ANGLES),
    *(f"{name}_is" for name in (*_LENGTHS, *_ANGLES)),
    *_TAKEN[5:],
    *("findings", "warnings", "error"),
)
# Text that begins with one of these is a formula to spreadsheets, with full width to some.
_FORMULA = tuple("=+-@＝＋－＠")


def stored_outcomes(tasks: Sequence[Task], directory: Path) -> dict[str, Outcome]:
    """Outcomes of an earlier run, by the tasks' names.

    Raises
    ------
    InputError
        If the folder of a task is a link that leads out of the directory.
    """
    for task in tasks:
        if not (directory / task.name).resolve().is_relative_to(directory.resolve()):
            raise InputError(f"{directory / task.name} is a link out of {directory}; remove it")
    found = {task.name: stored(task, directory) for task in tasks}
    return {name: outcome for name, outcome in found.items() if outcome}


def stored(task: Task, directory: Path) -> Outcome | None:
    """The outcome of an earlier run; None if there is none, it failed, or something has changed
    since.
    """
    try:
        state = json.loads((directory / task.name / STATE).read_text(encoding="utf-8"))
        outcome = state["outcome"]
        if state["key"] == task.key() and not outcome["error"]:
            Calibration.from_dict(outcome["calibration"])
            row_of(outcome)
            return dict(outcome)
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return None  # to be done again, whatever is wrong with it
    return None


def store(task: Task, outcome: Outcome, page: str | None, directory: Path) -> None:
    """Write the results of a task into its folder.

    Raises
    ------
    InputError
        If they cannot be written.
    """
    from hand_eye_calib.io.results import save_result

    folder = directory / task.name
    if outcome["calibration"]:
        save_result(Calibration.from_dict(outcome["calibration"]), folder, outcome["inputs"])
    if page:
        save_text(folder / REPORT, page)
    # What failed is done again in any case, and its bag may be out of reach.
    key = "" if outcome["error"] else task.key()
    save_text(folder / STATE, json_text({"key": key, "outcome": outcome}) + "\n")


def write_rows(path: Path, outcomes: Iterable[Outcome]) -> None:
    """Write a CSV file with a row for each outcome: text in quotes, numbers without, None empty.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n", quoting=csv.QUOTE_NONNUMERIC)
    writer.writeheader()
    for outcome in outcomes:
        writer.writerow({name: _as_cell(value) for name, value in row_of(outcome).items()})
    save_text(path, text.getvalue())


def _as_cell(value: Any) -> Any:
    """A value of a cell; an apostrophe stands before text that would be a formula."""
    is_formula = isinstance(value, str) and value.lstrip().startswith(_FORMULA)
    return f"'{value}" if is_formula else value


def row_of(outcome: Outcome) -> Row:
    """The row of an outcome; what is not known is None.

    Nothing in it depends on when or where the work was done.
    """
    row: Row = dict.fromkeys(COLUMNS)
    row |= {name: outcome[name] for name in ("name", "vehicle", "error")}
    row["bags"] = " ".join(outcome["bags"])
    row |= _recording(outcome["inputs"])
    row["findings"] = " ".join(finding["code"] for finding in outcome["findings"])
    if calibration := outcome["calibration"]:
        row |= {name: calibration[name] for name in _TAKEN} | _extrinsic(calibration)
        row["warnings"] = "; ".join(calibration["warnings"])
    return row


def _recording(inputs: Mapping[str, Any]) -> Row:
    """When a recording was made, for how long, and the digest of its content."""
    row: Row = {}
    streams = [inputs[stream] for stream in STREAMS if stream in inputs]
    starts = [stream["first_stamp_ns"] for stream in streams]
    if starts and None not in starts:
        start_ns, end_ns = max(starts), min(stream["last_stamp_ns"] for stream in streams)
        date = datetime.fromtimestamp(start_ns // 1_000_000_000, UTC)
        row |= {"start_ns": start_ns, "duration_s": (end_ns - start_ns) * 1e-9}
        row["start"] = date.isoformat(timespec="seconds")
    if files := inputs.get("files"):
        row |= {"sha256": content_hash(files), "bytes": sum(file["bytes"] for file in files)}
    return row


def content_hash(files: list[Mapping[str, Any]]) -> str:
    """Digest of the files of a recording.

    That of a single file is its SHA-256; that of several is what ``sha256sum FILE ... | sha256sum``
    prints in their folder, for the files in the order of their names.
    """
    if len(files) == 1:
        return str(files[0]["sha256"])
    lines = sorted((PurePath(file["file"]).name, file["sha256"]) for file in files)
    text = "".join(f"{digest}  {name}\n" for name, digest in lines)
    return hashlib.sha256(text.encode()).hexdigest()


def _extrinsic(calibration: Mapping[str, Any]) -> Row:
    """The pose of the child in the parent with its standard deviations, axis by axis."""
    transform = calibration["T_parent_child"]
    row: Row = {}
    for names, values, sigmas, unit in (
        (_LENGTHS, transform["translation"], transform["sigma_translation"], "m"),
        (_ANGLES, transform["rpy_deg"], transform["sigma_rpy_deg"], "deg"),
    ):
        for name, value, sigma in zip(names, values, sigmas, strict=True):
            is_known = sigma is not None and math.isfinite(sigma)
            row |= {f"{name}_{unit}": value, f"sigma_{name}_{unit}": sigma if is_known else None}
    return row | {f"{dof['name']}_is": dof["verdict"] for dof in calibration["observability"]}
