"""What ``--out`` adds to a calibration: cross-checks and ``report.html``; and ``check.html`` of the
command ``check``.
"""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hand_eye_calib.calibration import Calibration
from hand_eye_calib.cli.console import note, waiting_for
from hand_eye_calib.cli.publishing import static_transform_command
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import InputError

if TYPE_CHECKING:
    from hand_eye_calib.engine.evidence import Evidence
    from hand_eye_calib.engine.snapshot import Snapshot

REPORT, CHECK = "report.html", "check.html"
_OPTIONAL = ("jinja2", "markupsafe", "matplotlib")


def with_cross_check(
    calibration: Calibration, snapshot: "Snapshot"
) -> "tuple[Calibration, Evidence]":
    """Cross-check a calibration with other methods, other references and the two halves of the
    recording.

    Parameters
    ----------
    calibration : Calibration
    snapshot : Snapshot
        The poses and options that gave it.

    Returns
    -------
    calibration : Calibration
        With the cross-checks' scatter.
    evidence : Evidence
        For a report.
    """
    from hand_eye_calib.engine.evidence import gather

    # The time offset is settled; estimating it again would cost time.
    config = dataclasses.replace(snapshot.config, time_offset=calibration.time_offset_s)
    pose_pairs = dataclasses.replace(snapshot, config=config).pose_pairs()
    streams = dict(zip(("parent", "child"), snapshot.streams, strict=True))
    evidence = gather(calibration, snapshot.config, pose_pairs, streams)
    checked = dataclasses.replace(calibration, cross_check=evidence.cross_check.to_dict())
    return checked, evidence


def write_report(
    directory: Path,
    calibration: Calibration,
    evidence: "Evidence",
    config: CalibratorConfig,
    inputs: Mapping[str, Any],
) -> None:
    """Write the report into a directory; if a library for it is missing, say so and go on.

    Parameters
    ----------
    directory : path-like
    calibration, evidence, config, inputs
        Those of :func:`rendered`.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    if can_draw(REPORT):
        given = (calibration, evidence, config, inputs)
        _write(Path(directory) / REPORT, "the report", rendered, *given)


def write_check(directory: Path, *arguments: Any) -> None:
    """Write the page of the stream checks into a directory; if a library for it is missing, say so
    and go on.

    Parameters
    ----------
    directory : path-like
    *arguments
        Those of :func:`~hand_eye_calib.report.check_page.render_check`.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    if can_draw(CHECK):
        from hand_eye_calib.report.check_page import render_check

        _write(Path(directory) / CHECK, "the page", render_check, *arguments)


def write_rig_report(directory: Path, *arguments: Any) -> None:
    """Write the report of a rig into a directory; if a library for it is missing, say so and go on.

    Parameters
    ----------
    directory : path-like
    *arguments
        Those of :func:`~hand_eye_calib.report.rig_page.render_rig`.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    if can_draw(REPORT):
        from hand_eye_calib.report.rig_page import render_rig

        _write(Path(directory) / REPORT, "the report", render_rig, *arguments)


def _write(path: Path, what: str, render: Callable[..., str], *arguments: Any) -> None:
    with waiting_for(f"writing {what}"):
        save_page(path, render(*arguments))
    note(f"wrote {path}")


def can_draw(file_name: str) -> bool:
    """Whether the libraries for pages are installed; prints which one is missing."""
    try:
        import hand_eye_calib.report.report  # noqa: F401
    except ModuleNotFoundError as error:
        library = (error.name or "").partition(".")[0]
        if library not in _OPTIONAL:
            raise
        note(f"no {file_name}: {library} is missing; pip install {library}")
        return False
    return True


def rendered(
    calibration: Calibration,
    evidence: "Evidence",
    config: CalibratorConfig,
    inputs: Mapping[str, Any],
) -> str:
    """The report as HTML.

    Parameters
    ----------
    calibration, evidence
        As :func:`with_cross_check` returns them.
    config : CalibratorConfig
        The options that gave the result.
    inputs : dict
        Where the data came from, in plain values.

    Returns
    -------
    str
    """
    from hand_eye_calib.report.report import render

    command = static_transform_command(calibration)
    return render(calibration, config, evidence, inputs=inputs, command=command)


def save_page(path: Path, text: str) -> Path:
    """Write a page in one step, into a directory that is made if it is missing; returns its path.

    A link at that path is replaced, not followed.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    from hand_eye_calib.io.files import write_atomically

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically({path: text})
    except OSError as error:
        raise InputError(
            f"cannot write {error.filename or path}: {error.strerror}; choose another directory"
        ) from None
    return path
