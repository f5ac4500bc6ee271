"""What ``--out`` adds to a calibration: other answers to the same question, ``report.html``; and
``check.html`` of the command ``check``.
"""

import dataclasses
from pathlib import Path

from hand_eye_calib.cli.console import note, waiting_for
from hand_eye_calib.cli.publishing import static_transform_command
from hand_eye_calib.engine.cross_check import consistency
from hand_eye_calib.engine.estimation import estimate_extrinsic
from hand_eye_calib.errors import InputError
from hand_eye_calib.methods import METHODS

REPORT, CHECK = "report.html", "check.html"
_OPTIONAL = ("jinja2", "markupsafe", "matplotlib")


def with_consistency(calibration, snapshot):
    """A calibration with how far other methods, other references and the drive's halves lie from
    it; and the Evidence for a report.

    Parameters
    ----------
    calibration : Calibration
    snapshot : Snapshot
        The poses and options that gave it.
    """
    from hand_eye_calib.engine.evidence import gather

    # The clock is settled; estimating it again would cost time.
    config = dataclasses.replace(snapshot.config, time_offset=calibration.time_offset_s)
    pose_pairs = dataclasses.replace(snapshot, config=config).pose_pairs()
    streams = dict(zip(("parent", "child"), snapshot.streams, strict=True))
    evidence = gather(calibration, snapshot.config, pose_pairs, estimate_extrinsic, streams)
    others, halves = (
        [one.calibration for one in answers] for answers in (evidence.comparison, evidence.halves)
    )
    # Where there are jumps, methods that use every pair disagree for a reason that says nothing
    # about the result.
    robust = [other for other in others if METHODS[other.method].rejects_outliers]
    found = consistency(calibration, robust, halves)
    warnings = (*calibration.warnings, *found.warnings())
    return dataclasses.replace(
        calibration, consistency=found.to_dict(), warnings=warnings
    ), evidence


def write_report(directory, *arguments):
    """Write the report; without the libraries that it takes, say so and go on.

    Parameters
    ----------
    directory : path-like
        One that exists.
    *arguments
        Those of :func:`rendered`.

    Raises
    ------
    InputError
        Where it cannot be written.
    """
    if can_draw(REPORT):
        with waiting_for("writing the report"):
            path = save_page(Path(directory) / REPORT, rendered(*arguments))
        note(f"wrote {path}")


def write_check(directory, *arguments):
    """Write the page of the stream checks into a directory, which is made; without the libraries,
    say so and go on.

    Parameters
    ----------
    directory : path-like
    *arguments
        Those of :func:`~hand_eye_calib.report.check_page.render_check`.

    Raises
    ------
    InputError
        Where it cannot be written.
    """
    if can_draw(CHECK):
        from hand_eye_calib.report.check_page import render_check

        path = save_page(Path(directory) / CHECK, render_check(*arguments))
        note(f"wrote {path}")


def can_draw(file_name):
    """Whether the libraries for pages are there; says which is missing."""
    try:
        import hand_eye_calib.report.report  # noqa: F401
    except ModuleNotFoundError as error:
        library = error.name.partition(".")[0]
        if library not in _OPTIONAL:
            raise
        note(f"no {file_name}: {library} is missing; pip install {library}")
        return False
    return True


def rendered(calibration, evidence, config, inputs, findings=()):
    """The report as HTML.

    Parameters
    ----------
    calibration, evidence
        As :func:`with_consistency` returns them.
    config : CalibratorConfig
        The options that gave the result.
    inputs : dict
        Where the data came from, in plain values.
    findings : sequence of dict
        What the stream checks found.

    Returns
    -------
    str
    """
    from hand_eye_calib.report.report import render

    command = static_transform_command(calibration)
    return render(calibration, config, evidence, inputs=inputs, findings=findings, command=command)


def save_page(path, text):
    """Write a page, in a directory that is made where it is missing; returns its path.

    Raises
    ------
    InputError
        Where it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(
            f"cannot write {error.filename or path}: {error.strerror}; choose another directory"
        ) from None
    return path
