"""Calibrate recordings, and report the results: commands, Python functions and the report."""

from pathlib import Path
from typing import Any

from hand_eye_calib.core.base.registry import (
    COMMANDS,
    RESULT_METHODS,
    SESSION_PAGES,
    Command,
)


def register() -> None:
    """Register the commands for recordings, the methods of results, and the report of a session."""
    COMMANDS["calibrate"] = Command(
        "calibrate from two trajectory files, a bag or a journal", _calibrate
    )
    COMMANDS["replay"] = Command(
        "the same for bags and journals alone", _calibrate
    )
    COMMANDS["check"] = Command(
        "check two pose streams before any solve", _check
    )
    COMMANDS["info"] = Command("show a saved result", _info)
    COMMANDS["export"] = Command(
        "print a saved result as the file of another program", _export
    )
    RESULT_METHODS["plot"] = _plot
    RESULT_METHODS["report"] = _report
    RESULT_METHODS["html"] = _html
    SESSION_PAGES["report"] = _session_report


def _calibrate() -> Any:
    from hand_eye_calib.offline.cli import calibrate

    return calibrate


def _check() -> Any:
    from hand_eye_calib.offline.cli import check

    return check


def _info() -> Any:
    from hand_eye_calib.offline.cli import info

    return info


def _export() -> Any:
    from hand_eye_calib.offline.cli import export

    return export


def _plot(result: Any, ax: Any) -> Any:
    from hand_eye_calib.offline.report.views import plot

    return plot(result, ax)


def _report(result: Any, path: Path) -> Path:
    from hand_eye_calib.core.base.spelling import Interface
    from hand_eye_calib.formats.results import save_text
    from hand_eye_calib.offline.report.report import render

    return save_text(
        path, render(result, result.recording, interface=Interface.PYTHON)
    )


def _html(result: Any) -> str:
    from hand_eye_calib.offline.report.report import render_brief

    return render_brief(result)


def _session_report(directory: Path, session: Any) -> None:
    from hand_eye_calib.offline.cli.reporting import write_session_report

    write_session_report(directory, session)
