"""The extrinsics of a rig in files: everything, all transforms as one launch file, and each sensor
by itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from hand_eye_calib.calibration import Calibration, Verdict
from hand_eye_calib.errors import InputError
from hand_eye_calib.io.files import write_atomically
from hand_eye_calib.io.results import LAUNCH_NAME, launch_text, provenance, save_result

RIG_NAME = "rig.yaml"


def save_rig(
    document: Mapping[str, Any],
    calibrations: Sequence[Calibration],
    directory: str | Path,
    inputs: Mapping[str, Any] | None = None,
) -> Path:
    """Write ``rig.yaml``, ``static_transform.launch.py`` with all transforms that may be used, and
    a directory for each sensor with the files of
    :func:`~hand_eye_calib.io.results.save_result`.

    Parameters
    ----------
    document : mapping
        The rig in plain values.
    calibrations : sequence of Calibration
        All in the frame of one sensor.
    directory : str or path-like
        Made if it is missing.
    inputs : mapping, optional
        Where the data came from, in plain values.

    Returns
    -------
    pathlib.Path
        ``rig.yaml``.

    Raises
    ------
    InputError
        If they cannot be written.
    """
    directory = Path(directory)
    whole = {**document, "provenance": provenance(inputs or {})}
    texts = {
        RIG_NAME: yaml.safe_dump(
            whole, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True
        )
    }
    usable = [each for each in calibrations if each.verdict is not Verdict.DO_NOT_USE]
    if usable:
        texts[LAUNCH_NAME] = launch_text(usable)
    for calibration in calibrations:
        save_result(calibration, directory / directory_of(calibration), inputs)
    try:
        write_atomically({directory / name: text for name, text in texts.items()})
        if not usable:
            (directory / LAUNCH_NAME).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(
            f"cannot write {error.filename or directory}: {error.strerror}; choose another "
            "directory"
        ) from None
    return directory / RIG_NAME


def directory_of(calibration: Calibration) -> str:
    """Name of the directory of a sensor: its frame, a slash replaced."""
    return calibration.child_frame.strip("/").replace("/", "_") or "sensor"
