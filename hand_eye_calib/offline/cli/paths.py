"""Paths that a user gives by mistake: a saved result, two names in one argument, files to replay.

Each of them gets an error with the command that the user meant.
"""

import re
import shlex
from collections.abc import Sequence
from pathlib import Path

from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.base.text import AXIS_UNITS, shown_value
from hand_eye_calib.formats.bags.patterns import has_suffix_of_bag
from hand_eye_calib.formats.files import open_regular
from hand_eye_calib.offline.cli.options import argument_type

# Line that only the file of a result has.
_LINE_OF_RESULT = re.compile(
    rb"^format: hand_eye_calib/extrinsic\s*$", re.MULTILINE
)
# The line is among the first bytes of the file.
_BEGINNING = 4096


def refuse_wrong_paths(command: str, paths: Sequence[Path | str]) -> None:
    """Raise an error for a path that no command can calibrate from, and name the right command.

    Raises
    ------
    ConfigError
        If an argument holds the names of two files, or files are given to ``replay``.
    InputError
        If a path is a saved result.
    """
    from hand_eye_calib.offline.cli.reading import is_plain_file

    for path in paths:
        names = re.split(r"[\s,]+", str(path).strip(" ,"))
        are_several = len(names) > 1 and not Path(path).exists()
        if are_several and all(Path(name).exists() for name in names):
            raise ConfigError(
                f"{len(names)} files in one argument: leave out the quotes and commas: "
                f"{shlex.join(names)}"
            )
        if isinstance(path, Path) and _is_result(path):
            raise InputError(
                f"{path} is a saved result: show it with hand_eye_calib info "
                f"{shlex.quote(str(path))}, or pass the streams again"
            )
    if (
        command == "replay"
        and len(paths) > 1
        and all(map(is_plain_file, paths))
    ):
        raise ConfigError(
            "replay is for bags and journals; for trajectory files: hand_eye_calib "
            f"calibrate {shlex.join(map(str, paths))}"
        )


def calibrating(words: Sequence[str]) -> str:
    """Return the command line for arguments that begin with a file instead of a command.

    The result is empty if the first word is no existing file or folder.
    """
    first = Path(words[0])
    if not first.exists():
        return ""
    command = "info" if _is_result(first) else "calibrate"
    return f"hand_eye_calib {command} {shlex.join(words)}"


def misplaced(command: str, rest: Sequence[str]) -> str:
    """Return the error about the first unused argument of a command, if its purpose is clear."""
    first = rest[0]
    if first.startswith("-"):
        return ""
    if re.match(rf"({'|'.join(AXIS_UNITS)})=", first):
        return f"{first} follows no option: repeat --prior before each axis"
    if command == "watch" and Path(first).exists():
        return (
            "watch takes no file: it displays the running node; for files: hand_eye_calib "
            f"calibrate {shlex.join(rest)}"
        )
    return ""


@argument_type
def directory(text: str) -> Path:
    """Return the directory of an option; a ConfigError if the text is empty."""
    if not text.strip():
        raise ConfigError(
            f"the name is empty, got {shown_value(text)}: name a directory"
        )
    return Path(text)


def _is_result(path: Path) -> bool:
    """Return whether a path is a saved result: its file, or its folder without a recording."""
    if path.is_dir():
        # These modules load numpy, which the start of a command does not need.
        from hand_eye_calib.formats.journal import has_session
        from hand_eye_calib.formats.results import FILE_NAME

        if not (path / FILE_NAME).is_file():
            return False
        # A session writes its result beside its journal and its recording.
        has_journal = any(map(has_session, [path, *path.iterdir()]))
        return not (has_journal or any(map(has_suffix_of_bag, path.rglob("*"))))
    if path.suffix not in (".yaml", ".yml") or not path.is_file():
        return False
    with open_regular(path) as file:
        return bool(_LINE_OF_RESULT.search(file.read(_BEGINNING)))
