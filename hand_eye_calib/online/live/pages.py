"""The process that writes report and rig of a session, so that the node does not wait for them."""

import os
import pickle
import sys
from pathlib import Path

from hand_eye_calib.core.base.errors import HandEyeCalibError, printable
from hand_eye_calib.core.base.registry import SESSION_PAGES
from hand_eye_calib.core.engine.session_result import SessionResult

# Nice value of the process (0 is normal, 19 the lowest priority). With 15, the pages took half a
# minute while other programs were busy.
_NICENESS = 3


def write_session() -> None:
    """Read a session from standard input, and write its pages into a directory.

    The directory is the only argument of the process. ``online/live/saving.py`` starts the process
    and passes a pickled SessionResult.
    """
    os.nice(_NICENESS)
    session: SessionResult = pickle.load(sys.stdin.buffer)
    directory = Path(sys.argv[1])
    try:
        for write in SESSION_PAGES.values():
            write(directory, session)
    except (HandEyeCalibError, OSError) as error:
        sys.exit(f"hand_eye_calib: error: {printable(str(error))}")
