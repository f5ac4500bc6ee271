"""Calibrations in files: ``extrinsic.yaml``."""

import os
import threading
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

import yaml

from hand_eye_calib.calibration import Calibration
from hand_eye_calib.errors import InputError

FILE_NAME = "extrinsic.yaml"


def save_result(calibration, directory, inputs=None):
    """Write ``extrinsic.yaml``, in one step: a reader sees the old file or the new one, never half of it.

    Parameters
    ----------
    calibration : Calibration
    directory : str or path-like
        Made where it is missing.
    inputs : mapping, optional
        Where the data came from, in plain values; it goes into the file's provenance.

    Returns
    -------
    pathlib.Path
        The file that was written.

    Raises
    ------
    InputError
        Where it cannot be written.
    """
    provenance = {
        "package": "hand_eye_calib",
        "package_version": _package_version(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "inputs": dict(inputs or {}),
    }
    document = calibration.to_dict() | {"provenance": provenance}
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True)
    path = Path(directory) / FILE_NAME
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _replace(path, text)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}; choose another directory") from None
    return path


def load_result(path):
    """Read a calibration that :func:`save_result` wrote.

    Parameters
    ----------
    path : str or path-like
        The file, or the directory that holds it.

    Returns
    -------
    Calibration

    Raises
    ------
    InputError
        Where it cannot be read, is no calibration or is of an unknown version.
    """
    path = Path(path)
    if path.is_dir():
        path = path / FILE_NAME
    try:
        return Calibration.from_dict(yaml.safe_load(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}; expected a result or the directory of one") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not YAML: {' '.join(str(error).split())}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _replace(path, text):
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}")
    try:
        with open(temporary, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _package_version():
    try:
        return metadata.version("hand_eye_calib")
    except metadata.PackageNotFoundError:
        return "not installed"
