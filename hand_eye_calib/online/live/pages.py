"""The process that writes the pages of a session, apart from the node."""

import os
import pickle
import sys
from pathlib import Path

from hand_eye_calib.core.base.errors import HandEyeCalibError, printable
from hand_eye_calib.core.base.registry import SESSION_PAGES
from hand_eye_calib.core.engine.session_result import SessionResult

# Priority of the process. The pages took half a minute with 15, while other programs were busy.
_NICENESS = 3


def write_session() -> None:
    """Write the pages of a session into the directory that is the only argument of this process.

    The result comes from standard input, as ``online/live/saving.py`` writes it.
    """
    os.nice(_NICENESS)
    session: SessionResult = pickle.load(sys.stdin.buffer)
    directory = Path(sys.argv[1])
    try:
        for write in SESSION_PAGES.values():
            write(directory, session)
    except (HandEyeCalibError, OSError) as error:
        sys.exit(f"hand_eye_calib: error: {printable(str(error))}")
