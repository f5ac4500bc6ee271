"""Outcomes in the folder of the results, so that a second run does only what is left."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hand_eye_calib.calibration import Calibration
from hand_eye_calib.cli.batch.calibrating import Outcome
from hand_eye_calib.cli.batch.rows import row_of
from hand_eye_calib.cli.batch.tasks import STATE, Task
from hand_eye_calib.cli.reporting import REPORT, save_page
from hand_eye_calib.errors import InputError


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

    if outcome["calibration"]:
        save_result(
            Calibration.from_dict(outcome["calibration"]), directory / task.name, outcome["inputs"]
        )
    if page:
        save_page(directory / task.name / REPORT, page)
    # What failed is done again in any case, and its bag may be out of reach.
    key = "" if outcome["error"] else task.key()
    write(directory / task.name / STATE, {"key": key, "outcome": outcome})


def write(path: Path, document: Any) -> None:
    """Write a JSON document in one step.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    from hand_eye_calib.io.files import write_atomically

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically({path: json.dumps(document, indent=2, allow_nan=False) + "\n"})
    except OSError as error:
        raise InputError(
            f"cannot write {path}: {error.strerror}; choose another directory with --out"
        ) from None
