"""The extrinsics of a rig in files: everything, all transforms as one launch file, and each sensor
by itself.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hand_eye_calib.errors import InputError
from hand_eye_calib.io.files import write_atomically
from hand_eye_calib.io.results import LAUNCH_NAME, RIG_NAME, launch_text, provenance, save_result
from hand_eye_calib.io.yaml_files import yaml_text
from hand_eye_calib.results.calibration import Calibration, Verdict


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
    texts = {RIG_NAME: yaml_text(whole)}
    usable = [each for each in calibrations if each.verdict is not Verdict.DO_NOT_USE]
    if usable:
        texts[LAUNCH_NAME] = launch_text(usable)
    for calibration, name in zip(calibrations, directories(calibrations), strict=True):
        save_result(calibration, directory / name, inputs)
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


def directories(calibrations: Sequence[Calibration]) -> list[str]:
    """Names of the sensors' directories: their frames, with what a name of a directory should not
    have replaced, and a number if two would be the same.
    """
    names: list[str] = []
    for calibration in calibrations:
        name = re.sub(r"[^\w.-]", "_", calibration.child_frame.strip("/")).lstrip(".") or "sensor"
        taken = sum(other == name for other in names)
        names.append(f"{name}_{taken + 1}" if taken else name)
    return names
