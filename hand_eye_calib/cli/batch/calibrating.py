"""The work of one task: from a recording to its outcome, in whatever process or machine."""

import traceback
from typing import Any

from hand_eye_calib.cli.batch.tasks import Task
from hand_eye_calib.cli.replaying import fingerprints, replay
from hand_eye_calib.cli.reporting import rendered, with_cross_check
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.checked import checked
from hand_eye_calib.errors import HandEyeCalibError

# What came of a task, in plain values.
Outcome = dict[str, Any]


def work(task: Task) -> Outcome:
    """Do a task; what goes wrong becomes part of the outcome, so that the others go on.

    Returns
    -------
    dict
        ``name``, ``vehicle``, ``bags``, ``calibration`` (Calibration.to_dict or None), ``findings``
        of the stream checks, ``inputs``, ``error`` (text or None), the ``page`` of the report if
        the task wants one, and a ``traceback`` for errors that are defects of the program.
    """
    from hand_eye_calib.io.remote import local_copies

    outcome = failed(task, None)
    try:
        with local_copies(task.bags) as (paths, as_given):
            try:
                return outcome | as_given(_calibrated(task, paths))
            except HandEyeCalibError as error:
                return outcome | {"error": as_given(str(error))}
    except HandEyeCalibError as error:
        return outcome | {"error": str(error)}
    except Exception as error:
        text = " ".join(f"unexpected {type(error).__name__}: {error}".split())
        return outcome | {"error": text, "traceback": traceback.format_exc()}


def failed(task: Task, reason: str | None) -> Outcome:
    """The outcome of a task that gave no calibration."""
    from hand_eye_calib.io.remote import public

    return {
        "name": task.name,
        "vehicle": task.vehicle,
        "bags": [public(bag) for bag in task.bags],
        "calibration": None,
        "findings": [],
        "inputs": {},
        "error": reason,
    }


def _calibrated(task: Task, paths: list[str]) -> Outcome:
    """What a task adds to its outcome if nothing goes wrong."""
    config = CalibratorConfig.from_options(task.options)
    sources = (_source(task, "parent"), _source(task, "child"))
    replayed = replay(paths, *sources, config=config, quiet=True)
    if task.with_fingerprints:
        replayed.inputs["files"] = fingerprints(replayed.files, quiet=True)
    snapshot = replayed.calibrator.snapshot()
    calibration, snapshot = checked(replayed.calibration, snapshot, task.options)
    calibration, evidence = with_cross_check(calibration, snapshot)
    inputs = replayed.inputs | {"options": snapshot.config.to_options()}
    found: Outcome = {
        "calibration": calibration.to_dict(),
        "findings": [dict(finding) for finding in calibration.findings],
        "inputs": inputs,
    }
    if calibration.status.failure:
        found["error"] = calibration.status.failure
    if task.with_report:
        found["page"] = rendered(calibration, evidence, snapshot.config, inputs)
    return found


def _source(task: Task, stream: str) -> Any:
    """Topic, pair of frames or nothing."""
    from hand_eye_calib.io.transforms import TfSource

    if frames := task.sources.get(f"{stream}_tf"):
        return TfSource.parse(frames)
    return task.sources.get(f"{stream}_topic")
