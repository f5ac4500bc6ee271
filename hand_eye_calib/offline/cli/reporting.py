"""Write ``report.html`` for a calibration or for a session of the node."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.base.spelling import Interface
from hand_eye_calib.core.engine.session_result import SessionResult
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.formats.results import save_text
from hand_eye_calib.offline.cli.options import note, waiting_for

if TYPE_CHECKING:
    from hand_eye_calib.core.engine.snapshot import Snapshot

REPORT = "report.html"


def write_report(
    directory: Path,
    calibration: Calibration,
    snapshot: "Snapshot | None",
    inputs: Document,
    interface: Interface = Interface.TERMINAL,
    pictures: Sequence[Callable[[Calibration], list[Any]]] = (),
) -> None:
    """Write the report of a result into a directory, and print its path.

    Parameters
    ----------
    directory : pathlib.Path
    calibration : Calibration
    snapshot : Snapshot or None
        Poses and options of the result; None for the stops of an arm.
    inputs : dict
        Origin of the data, such as paths and topics, in plain values.
    interface : Interface
        Interface of the user, which decides the spelling of options.
    pictures : sequence of callable
        Functions that draw further figures, given the result.
    """
    from hand_eye_calib.offline.report.report import render

    write_page(
        directory,
        lambda: render(calibration, snapshot, inputs, interface, pictures),
    )


def write_page(directory: Path, page: Callable[[], str]) -> None:
    """Write the HTML that ``page()`` returns to ``report.html``, and print the path."""
    with waiting_for(f"writing {REPORT}"):
        path = save_text(directory / REPORT, page())
    note(f"wrote {path}")


def write_session_report(directory: Path, session: SessionResult) -> None:
    """Check the streams of a session, then write its result and its report with the findings.

    The check is repeated, because the last check of the session may be older than its result.
    Without the option ``report``, nothing is written.
    """
    if not session.with_report:
        return
    from hand_eye_calib.core.engine.attempts import check
    from hand_eye_calib.formats.results import save_result

    checked = check(session.snapshot, session.calibration)
    calibration = replace(session.calibration, findings=checked.findings)
    save_result(calibration, directory, session.inputs)
    write_report(
        directory, calibration, session.snapshot, session.inputs, Interface.NODE
    )
