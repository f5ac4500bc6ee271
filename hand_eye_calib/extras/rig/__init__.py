"""Three sensors or more."""

from pathlib import Path
from typing import Any

from hand_eye_calib.registry import SESSION_PAGES


def register() -> None:
    """Register the pages of a session with further sensors."""
    SESSION_PAGES["rig"] = _session_rig


def _session_rig(directory: Path, session: Any) -> None:
    if session.others:
        from hand_eye_calib.report.rig_page import write_session_rig

        write_session_rig(directory, session)
