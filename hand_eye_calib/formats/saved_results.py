"""Recognise a saved result that a user passes instead of a recording.

This module loads numpy only if the path is a folder.
"""

import re
import shlex
from pathlib import Path

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.formats.files import open_regular

# Line that occurs only in the file of a result.
_LINE_OF_RESULT = re.compile(
    rb"^format: hand_eye_calib/extrinsic\s*$", re.MULTILINE
)
# This line is in the first bytes of the file (number of bytes).
_BEGINNING = 4096


def refuse_saved_result(path: Path) -> None:
    """Raise an InputError if a path is a saved result. The error contains what to do instead."""
    if is_saved_result(path):
        raise InputError(
            f"{path} is a saved result, not a recording: display it with hand_eye_calib info "
            f"{shlex.quote(str(path))}; to calibrate again, pass the files or the bag that it was "
            "computed from"
        )


def is_saved_result(path: Path) -> bool:
    """Return whether a path is a saved result: its file, or its folder without a recording."""
    if path.is_dir():
        # These modules load numpy, which the start of a command does not need.
        from hand_eye_calib.formats.bags.patterns import has_suffix_of_bag
        from hand_eye_calib.formats.journal import has_session
        from hand_eye_calib.formats.results import FILE_NAME

        if not (path / FILE_NAME).is_file():
            return False
        # A session writes its result into the folder of its journal and its recording.
        has_journal = any(map(has_session, [path, *path.iterdir()]))
        return not (has_journal or any(map(has_suffix_of_bag, path.rglob("*"))))
    if path.suffix not in (".yaml", ".yml") or not path.is_file():
        return False
    with open_regular(path) as file:
        return bool(_LINE_OF_RESULT.search(file.read(_BEGINNING)))
