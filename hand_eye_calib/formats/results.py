"""Write and read the files of calibrations and rigs.

``extrinsic.yaml`` and ``rig.yaml`` contain the complete result. The xacro file and the launch file
contain only the transforms.
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

from hand_eye_calib.core.base.errors import (
    InputError,
    located,
    printable,
    require_type,
)
from hand_eye_calib.core.base.registry import RESULT_METHODS
from hand_eye_calib.core.base.spelling import Interface
from hand_eye_calib.core.base.version import version_of
from hand_eye_calib.core.results.calibration import Calibration, Verdict
from hand_eye_calib.core.results.document import (
    transform_arguments,
    usable_angles,
    usable_numbers,
)
from hand_eye_calib.core.results.parts import all_parts, part
from hand_eye_calib.core.results.records import ROTATIONS, TRANSLATIONS
from hand_eye_calib.core.results.verdict import Judged
from hand_eye_calib.formats.bags.patterns import has_suffix_of_bag
from hand_eye_calib.formats.files import (
    open_regular,
    path_of,
    read_bytes,
    write_atomically,
    writing,
)
from hand_eye_calib.formats.yaml_files import (
    UnreadableYamlError,
    read_yaml,
    yaml_text,
)

FILE_NAME = "extrinsic.yaml"
RIG_NAME = "rig.yaml"
REPORT_NAME = "report.html"
XACRO_NAME = "extrinsic.urdf.xacro"
LAUNCH_NAME = "static_transform.launch.py"
_NAMES = (XACRO_NAME, LAUNCH_NAME, FILE_NAME)
# A file was written by this program if it contains one of these texts: the name of the program, or
# the column of headlines in a table of calibrations.
_MARKS = (b"hand_eye_calib", b'"headline"')


def save_result(
    calibration: Calibration,
    directory: str | Path,
    inputs: Mapping[str, Any] | None = None,
) -> Path:
    """Write ``extrinsic.yaml``, ``extrinsic.urdf.xacro`` and ``static_transform.launch.py``.

    Parts of the result may add files. If the verdict is DO NOT USE, only ``extrinsic.yaml`` is
    written, and the other files of an earlier result are removed. If a file cannot be written, no
    file changes.

    Parameters
    ----------
    calibration : Calibration
    directory : str or path-like
        A missing directory is made.
    inputs : mapping, optional
        Origin of the data as plain values, for the provenance in ``extrinsic.yaml``. Its entry
        ``options`` is stored as the entry ``parameters``.

    Returns
    -------
    pathlib.Path
        Path of ``extrinsic.yaml``.

    Raises
    ------
    InputError
        If the files cannot be written.
    """
    require_type("the result", calibration, Calibration)
    directory = path_of("directory", directory)
    is_usable = calibration.verdict is not Verdict.DO_NOT_USE
    texts: dict[str, str | None] = dict.fromkeys(_names_of_parts())
    for name, value in calibration.parts.items() if is_usable else ():
        texts |= part(name).files(value, calibration)
    texts |= {
        XACRO_NAME: xacro_text(calibration) if is_usable else None,
        LAUNCH_NAME: launch_text([calibration]) if is_usable else None,
        FILE_NAME: _yaml_text(calibration.to_dict(), inputs),
    }
    return _written(directory, texts)


def _names_of_parts() -> list[str]:
    """Return the names of the files that parts of results add."""
    return [name for extra in all_parts() for name in extra.file_names]


def save(
    calibration: Calibration,
    directory: str | Path,
    inputs: Mapping[str, Any] | None = None,
) -> Path:
    """Save a result and its report; earlier files are kept in the folder ``previous``.

    For files, parameters and errors see :func:`save_result`. The report of the earlier result is
    also moved to ``previous``, because it does not belong to the new result.

    Examples
    --------
    >>> hec.save(result, "saved")
    PosixPath('saved/extrinsic.yaml')
    """
    require_type("the result", calibration, Calibration)
    directory = path_of("directory", directory)
    # A report that was written before the first save belongs to this result.
    has_earlier = Path(directory, FILE_NAME).exists()
    # The folder of a rig has its own launch file, which this result replaces.
    if any(Path(directory, name).exists() for name in (*_NAMES, RIG_NAME)):
        keep_earlier_results(directory)
    path = save_result(calibration, directory, inputs)
    if has_earlier:
        with writing(directory):
            Path(directory, REPORT_NAME).unlink(missing_ok=True)
    # A result from a file has no poses to draw.
    if calibration.motion_residuals and "report" in RESULT_METHODS:
        RESULT_METHODS["report"](calibration, Path(directory, REPORT_NAME))
    return path


def save_rig(
    document: Mapping[str, Any],
    calibrations: Sequence[Calibration],
    directory: str | Path,
    inputs: Mapping[str, Any] | None = None,
) -> Path:
    """Write the files of a rig, and return the path of ``rig.yaml``.

    ``rig.yaml`` contains ``document``, the rig in plain values. ``static_transform.launch.py``
    contains all usable transforms. Each sensor has a directory with the files of
    :func:`save_result`; its earlier files are kept in ``previous``.
    """
    folders = {RIG_NAME, LAUNCH_NAME, REPORT_NAME}
    for calibration in calibrations:
        # Replace characters that are not suitable for the name of a folder.
        frame = calibration.child_frame.strip("/")
        name = re.sub(r"[^\w.-]", "_", frame).lstrip(".") or "sensor"
        while name in folders:
            name += "_2"
        folders.add(name)
        keep_earlier_results(Path(directory, name))
        save_result(calibration, Path(directory, name), inputs)
    usable = [
        calibration
        for calibration in calibrations
        if calibration.verdict is not Verdict.DO_NOT_USE
    ]
    launch = launch_text(usable) if usable else None
    texts = {LAUNCH_NAME: launch, RIG_NAME: _yaml_text(document, inputs)}
    return _written(Path(directory), texts)


def save_text(path: Path, text: str) -> Path:
    """Write a file in one step, and return its path. A missing directory is made.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    return _written(path.parent, {path.name: text})


def _written(directory: Path, texts: Mapping[str, str | None]) -> Path:
    """Write texts into files of a directory, and return the path of the last file.

    ``texts`` has the contents by file name. A file with None is removed. If a file cannot be
    written, no file changes.
    """
    contents = {
        directory / name: text
        for name, text in texts.items()
        if text is not None
    }
    paths = [directory / name for name in texts]
    with writing(directory):
        directory.mkdir(parents=True, exist_ok=True)
        for path in paths:
            _keep_foreign(path)
        write_atomically(contents)
        for path in paths:
            if path not in contents:
                path.unlink(missing_ok=True)
    return [*contents][-1]


def _yaml_text(
    document: Mapping[str, Any], inputs: Mapping[str, Any] | None
) -> str:
    """Return a document as YAML, with the versions, options and inputs of the result."""
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
    """Keep a copy of a file that will be replaced, unless this program has written it.

    The copy has the name of the file with ``.kept``, ``.kept2`` and so on. Links need no copy,
    because their targets do not change. Files with a copy in ``previous`` need no second copy.
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
    """Return the first unused path among ``path.kept``, ``path.kept2`` and so on."""
    names = (
        path.with_name(f"{path.name}.kept{number}")
        for number in ("", *range(2, 10_000))
    )
    return next(name for name in names if not os.path.lexists(name))


def keep_earlier_results(directory: str | Path) -> str:
    """Copy the result files and the report of a directory into its folder ``previous``.

    Returns
    -------
    str
        Note for the user; empty if there were no such files.

    Raises
    ------
    InputError
        If a file cannot be copied.
    """
    previous = Path(directory, "previous")
    paths = [
        Path(directory, name)
        for name in (*_NAMES, *_names_of_parts(), RIG_NAME, REPORT_NAME)
    ]
    copies = {
        previous / path.name: read_bytes(path)
        for path in paths
        if path.exists()
    }
    if not copies:
        return ""
    with writing(previous):
        previous.mkdir(exist_ok=True)
        for copy in copies:
            _keep_foreign(copy)
        write_atomically(copies)
    return f"; the earlier files are in {previous}"


def fingerprint(path: str | Path) -> dict[str, str | int]:
    """Return path, size and SHA-256 of an input file, for the provenance."""
    with open_regular(path) as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        return {"file": str(path), "bytes": file.tell(), "sha256": digest}


def recording_of(path: str | Path) -> frozenset[str]:
    """Return the SHA-256 of the input files of a saved result; empty if there are none."""
    path = Path(path, FILE_NAME) if Path(path).is_dir() else Path(path)
    provenance = read_yaml(path).get("provenance") or {}
    files = (provenance.get("inputs") or {}).get("files") or []
    return frozenset(
        str(file.get("sha256")) for file in files if isinstance(file, Mapping)
    )


def _bag_instead(path: Path) -> InputError:
    """Return the error about a bag in place of a result."""
    return InputError(
        f"{path} is a bag, not a saved result: calibrate {path} --out DIR saves a result in DIR"
    )


def _result_in(folder: Path) -> Path:
    """Return the file of the result in a folder; raise an InputError if there is none."""
    path = folder / FILE_NAME
    if path.exists():
        return path
    if (folder / RIG_NAME).exists():
        sensors = sorted(
            str(file.parent) for file in folder.glob(f"*/{FILE_NAME}")
        )
        raise InputError(
            f"{folder} has the results of a rig; pass the folder of one sensor: "
            f"{', '.join(sensors)}"
        )
    if any(map(has_suffix_of_bag, folder.iterdir())):
        raise _bag_instead(folder)
    raise InputError(
        f"{folder} has no {FILE_NAME}: name the folder of a result (--out)"
    )


def load_result(path: str | Path) -> Calibration:
    """Read a calibration that :func:`save_result` wrote: the file, or its directory.

    Raises
    ------
    InputError
        If the file cannot be read, is not a calibration, or has an unknown version.

    Examples
    --------
    >>> path = hec.save(result, "saved")
    >>> hec.load(path) == result
    True
    """
    path = path_of("path", path)
    if path.is_dir():
        path = _result_in(path)
    elif has_suffix_of_bag(path) and path.exists():
        raise _bag_instead(path)
    if path.suffix in (".urdf", ".xacro"):
        raise InputError(
            f"{path} is a robot description, not a saved result: pass it to compare RESULT --with "
            f"{path.name}, or to --installed"
        )
    if path.suffix in (".tum", ".txt", ".csv") and path.exists():
        raise InputError(
            f"{path} is a file of poses, not a saved result: calibrate PARENT CHILD --out DIR "
            f"saves a result in DIR; then run info DIR, or compare DIR --with {path.name} if the "
            "file has a single pose"
        )
    try:
        document = read_yaml(path)
    except UnreadableYamlError as error:
        raise InputError(
            f"{error}; restore the file, or calibrate again"
        ) from None
    if document is None:
        raise InputError(
            f"{path}: the file is empty; restore it, or calibrate again"
        )
    with located(path):
        return Calibration.from_dict(document)


def xacro_text(calibration: Judged) -> str:
    """Return a xacro file with a fixed joint between the parent's link and the child's link."""
    parent = calibration.mounting[0]
    child = calibration.child_frame
    numbers = usable_numbers(calibration) | usable_angles(calibration)
    comment = "\n".join(f"     {line}" for line in _remarks(calibration))
    # XML forbids two hyphens in a comment. Separate them by a space.
    return _template(XACRO_NAME).format(
        comment=re.sub("-(?=-)", "- ", comment),
        joint=_quoted(f"{parent}_to_{child}"),
        parent=_quoted(parent),
        child=_quoted(child),
        xyz=" ".join(str(numbers[name]) for name in TRANSLATIONS),
        rpy=" ".join(str(numbers[name]) for name in ROTATIONS),
    )


def _quoted(text: str) -> str:
    """Quote a text for XML, so that xacro does not evaluate it."""
    return quoteattr(printable(text).replace("$", "$$"))


def launch_text(calibrations: Sequence[Judged]) -> str:
    """Return a launch file that publishes extrinsics as static transforms."""
    comments = []
    transforms = []
    for calibration in calibrations:
        comments += [f"# {line}" for line in _remarks(calibration)]
        arguments = [*map(printable, transform_arguments(calibration, 12))]
        transforms.append(f"    {arguments},")
    return _template(LAUNCH_NAME).format(
        comment="\n".join(comments), transforms="\n".join(transforms)
    )


def _template(name: str) -> str:
    """Return the template of a file, with fields in braces."""
    folder = Path(__file__).with_name("templates")
    return (folder / f"{name}.in").read_text("utf-8")


def _remarks(calibration: Judged) -> list[str]:
    """Return lines for the user who opens the file: verdict, direction and origin."""
    parent = calibration.mounting[0]
    child = calibration.child_frame
    remarks = [
        calibration.headline,
        *(
            f"{reason.sentence}: {reason.advice_on(Interface.NODE)}"
            for reason in calibration.reasons
        ),
        f"Pose of {child} in {parent}: maps coordinates of {child} into {parent}.",
        f"Made by hand_eye_calib {version_of()}; {FILE_NAME} beside this file "
        "contains the covariance and the origin.",
    ]
    return [printable(" ".join(remark.split())) for remark in remarks]


# Names in the public interface of the package.
load = load_result
