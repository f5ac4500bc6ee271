"""Calibrations and rigs in files: ``extrinsic.yaml`` or ``rig.yaml`` with everything, and the
transforms alone as xacro and as launch file.
"""

import hashlib
import os
import platform
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

from hand_eye_calib.core.base.errors import InputError, located, printable
from hand_eye_calib.core.base.version import version_of
from hand_eye_calib.core.results.calibration import Calibration, Verdict
from hand_eye_calib.core.results.document import transform_arguments, usable_angles, usable_numbers
from hand_eye_calib.core.results.records import ROTATIONS, TRANSLATIONS
from hand_eye_calib.formats.files import open_regular, read_bytes, write_atomically, writing
from hand_eye_calib.formats.yaml_files import read_yaml, yaml_text

FILE_NAME = "extrinsic.yaml"
RIG_NAME = "rig.yaml"
XACRO_NAME = "extrinsic.urdf.xacro"
LAUNCH_NAME = "static_transform.launch.py"
_NAMES = (XACRO_NAME, LAUNCH_NAME, FILE_NAME)
# Every file that this program writes has its name in it; tables have a column of headlines.
_MARKS = (b"hand_eye_calib", b'"headline"')


def save_result(
    calibration: Calibration, directory: str | Path, inputs: Mapping[str, Any] | None = None
) -> Path:
    """Write ``extrinsic.yaml``, ``extrinsic.urdf.xacro`` and ``static_transform.launch.py``.

    If the verdict is DO NOT USE, only the first, and files of an earlier result with the other two
    names are removed. If one cannot be written, none changes.

    Parameters
    ----------
    calibration : Calibration
    directory : str or path-like
        Made if it is missing.
    inputs : mapping, optional
        Where the data came from, in plain values; it goes into the file's provenance. Its
        ``options`` are the parameters there.

    Returns
    -------
    pathlib.Path
        ``extrinsic.yaml``.

    Raises
    ------
    InputError
        If they cannot be written.

    Examples
    --------
    >>> hec.save(result, "saved")
    PosixPath('saved/extrinsic.yaml')
    """
    is_usable = calibration.verdict is not Verdict.DO_NOT_USE
    texts = {
        XACRO_NAME: _xacro_text(calibration) if is_usable else None,
        LAUNCH_NAME: _launch_text([calibration]) if is_usable else None,
        FILE_NAME: _yaml_text(calibration.to_dict(), inputs),
    }
    return _written(Path(directory), texts)


def save_rig(
    document: Mapping[str, Any],
    calibrations: Sequence[Calibration],
    directory: str | Path,
    inputs: Mapping[str, Any] | None = None,
) -> Path:
    """Write ``rig.yaml``, the rig in plain values, ``static_transform.launch.py`` with all
    transforms that may be used, and a directory for each sensor with the files of
    :func:`save_result`; returns the first.
    """
    folders = {RIG_NAME, LAUNCH_NAME, "report.html"}
    for calibration in calibrations:
        # A frame's name, with what a folder's should not have replaced.
        name = re.sub(r"[^\w.-]", "_", calibration.child_frame.strip("/")).lstrip(".") or "sensor"
        while name in folders:
            name += "_2"
        folders.add(name)
        save_result(calibration, Path(directory, name), inputs)
    usable = [each for each in calibrations if each.verdict is not Verdict.DO_NOT_USE]
    launch = _launch_text(usable) if usable else None
    texts = {LAUNCH_NAME: launch, RIG_NAME: _yaml_text(document, inputs)}
    return _written(Path(directory), texts)


def save_text(path: Path, text: str) -> Path:
    """Write a file in one step, into a directory that is made if it is missing; returns its path.
    Raises InputError if it cannot be written.
    """
    return _written(path.parent, {path.name: text})


def _written(directory: Path, texts: Mapping[str, str | None]) -> Path:
    """Write the texts into a directory by their names, all or none, and remove what has none;
    returns the last file.
    """
    kept = {directory / name: text for name, text in texts.items() if text is not None}
    with writing(directory):
        directory.mkdir(parents=True, exist_ok=True)
        for name in texts:
            _keep_foreign(directory / name)
        write_atomically(kept)
        for path in {directory / name for name in texts} - kept.keys():
            path.unlink(missing_ok=True)
    return [*kept][-1]


def _yaml_text(document: Mapping[str, Any], inputs: Mapping[str, Any] | None) -> str:
    """A document with where it came from."""
    inputs = {**(inputs or {})}
    provenance = {
        "package": "hand_eye_calib",
        "package_version": version_of(),
        "versions": {"python": platform.python_version()}
        | {name: version_of(name) for name in ("numpy", "scipy")},
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "parameters": inputs.pop("options", {}),
        "inputs": inputs,
    }
    return yaml_text({**document, "provenance": provenance})


def _keep_foreign(path: Path) -> None:
    """Give a file that this program has not written a second name, before it is replaced.

    The name is that of the file with ``.kept``, or ``.kept2`` and so on. A link needs none, because
    the file that it leads to stays, nor does a file whose copy lies in ``previous``.
    """
    if path.is_symlink() or not path.is_file():
        return
    content = read_bytes(path)
    copy = path.parent / "previous" / path.name
    is_copied = copy.is_file() and read_bytes(copy) == content
    is_own = any(mark in content for mark in _MARKS)
    if content and not is_copied and not is_own:
        os.link(path, _free_name(path))


def _free_name(path: Path) -> Path:
    """Return the first name that no file has: ``path.kept``, ``path.kept2`` and so on."""
    names = (path.with_name(f"{path.name}.kept{number}") for number in ("", *range(2, 10_000)))
    return next(name for name in names if not os.path.lexists(name))


def keep_earlier_results(directory: str | Path) -> str:
    """Copy the result files and the report of a directory into its folder ``previous`` before they
    are replaced; returns words about it, empty if there are none. An InputError if that fails.
    """
    previous = Path(directory, "previous")
    names = (*_NAMES, "report.html")
    found = [path for name in names if (path := Path(directory, name)).exists()]
    with writing(previous):
        if found:
            previous.mkdir(exist_ok=True)
        for path in found:
            _keep_foreign(previous / path.name)
        write_atomically({previous / path.name: read_bytes(path) for path in found})
    return f"; the files that were there are in {previous}" if found else ""


def fingerprint(path: str | Path) -> dict[str, str | int]:
    """Name, size and SHA-256 of an input file, for the provenance; read piece by piece."""
    with open_regular(path) as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        return {"file": str(path), "bytes": file.tell(), "sha256": digest}


def load_result(path: str | Path) -> Calibration:
    """Read a calibration that :func:`save_result` wrote: the file, or the directory that holds it.

    Raises
    ------
    InputError
        If it cannot be read, is no calibration or is of an unknown version.

    Examples
    --------
    >>> path = hec.save(result, "saved")
    >>> hec.load(path) == result
    True
    """
    path = Path(path)
    if path.is_dir():
        if (path / RIG_NAME).exists() and not (path / FILE_NAME).exists():
            sensors = sorted(str(each.parent) for each in path.glob(f"*/{FILE_NAME}"))
            raise InputError(f"{path} is of a rig; name one of its sensors: {', '.join(sensors)}")
        path = path / FILE_NAME
    document = read_yaml(path)
    with located(path):
        return Calibration.from_dict(document)


def _xacro_text(calibration: Calibration) -> str:
    """A fixed joint from the parent's to the child's link, for a robot description with both."""
    parent = calibration.mounting[0]
    child = calibration.child_frame
    # Quoted for XML, and kept from being evaluated by xacro.
    joint, parent, child = (
        quoteattr(printable(text).replace("$", "$$"))
        for text in (f"{parent}_to_{child}", parent, child)
    )
    numbers = usable_numbers(calibration) | usable_angles(calibration)
    xyz, rpy = (
        " ".join(str(numbers[name]) for name in names) for names in (TRANSLATIONS, ROTATIONS)
    )
    comment = "\n".join(f"     {line}" for line in _remarks(calibration))
    comment = re.sub("-(?=-)", "- ", comment)  # no comment may hold two hyphens
    return _template(XACRO_NAME).format(
        comment=comment, joint=joint, parent=parent, child=child, xyz=xyz, rpy=rpy
    )


def _launch_text(calibrations: Sequence[Calibration]) -> str:
    """A launch file that publishes extrinsics as static transforms."""
    comment = "\n".join(f"# {line}" for each in calibrations for line in _remarks(each))
    arguments = [[*map(printable, transform_arguments(each, 12))] for each in calibrations]
    transforms = "\n".join(f"    {each}," for each in arguments)
    return _template(LAUNCH_NAME).format(comment=comment, transforms=transforms)


def _template(name: str) -> str:
    return Path(__file__).with_name("templates").joinpath(f"{name}.in").read_text("utf-8")


def _remarks(calibration: Calibration) -> list[str]:
    """What a person who opens the file must know, in lines."""
    parent = calibration.mounting[0]
    child = calibration.child_frame
    remarks = [
        calibration.headline,
        *(f"{reason.sentence}: {reason.what_to_do}" for reason in calibration.reasons),
        f"Pose of {child} in {parent}: maps coordinates of {child} into {parent}.",
        f"Made by hand_eye_calib {version_of()}; {FILE_NAME} beside this file has the "
        "covariance and where it came from.",
    ]
    return [printable(" ".join(remark.split())) for remark in remarks]


# Their names in the package's public interface.
load = load_result
save = save_result
