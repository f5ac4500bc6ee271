"""Paths that a user passes by mistake: a saved result, two names in one argument, files to replay.

Each error contains the command that the user probably wants.
"""

import os
import re
import shlex
from collections.abc import Collection, Sequence
from pathlib import Path

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.text import AXIS_UNITS, shown_value
from hand_eye_calib.formats.saved_results import (
    is_saved_result,
    refuse_saved_result,
)
from hand_eye_calib.offline.cli.options import argument_type


def refuse_wrong_paths(command: str, paths: Sequence[Path | str]) -> None:
    """Raise an error for a path that no command can calibrate from, and name the right command.

    Raises
    ------
    ConfigError
        If an argument contains the names of two files, or if ``replay`` gets files.
    InputError
        If a path is a saved result.
    """
    from hand_eye_calib.offline.cli.reading import is_plain_file

    for path in paths:
        _refuse_wrong_path(path)
    if len(paths) == 3:
        last = Path(paths[-1])
        may_be_input = last.suffix or last.exists() or "*" in str(last)
        if not may_be_input:
            raise ConfigError(
                f"no file {last}; to save the result in a folder, give --out {last}"
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


def _refuse_wrong_path(path: Path | str) -> None:
    """Raise an error for one path that no command can calibrate from."""
    if Path(path).name == "metadata.yaml":
        raise ConfigError(
            f"{path} describes a bag: pass its folder, {Path(path).parent}"
        )
    names = re.split(r"[\s,]+", str(path).strip(" ,"))
    are_several = len(names) > 1 and not Path(path).exists()
    if are_several and all(Path(name).exists() for name in names):
        raise ConfigError(
            f"{len(names)} files in one argument: leave out the quotes and commas: "
            f"{shlex.join(names)}"
        )
    if isinstance(path, Path):
        refuse_saved_result(path)


def calibrating(words: Sequence[str]) -> str:
    """Return the command for arguments that begin with a file instead of a command.

    The result is empty unless the first word is an existing file or folder.
    """
    first = Path(words[0])
    if not first.exists():
        return ""
    command = "info" if is_saved_result(first) else "calibrate"
    return f"hand_eye_calib {command} {shlex.join(words)}"


def misplaced(
    command: str, rest: Sequence[str], flags: Collection[str] = ()
) -> str:
    """Return the error about the first unused argument of a command, if its purpose is clear.

    ``rest`` has the unused arguments, and ``flags`` the options of the command as typed.
    """
    first = rest[0]
    if first.startswith("-"):
        return ""
    if command == "export" or "--json" in flags or "--as" in flags:
        return (
            f"{first} has no meaning: the document is printed; to save it, end the command with "
            f"> {shlex.quote(first)}"
        )
    if re.match(rf"({'|'.join(AXIS_UNITS)})=", first):
        return (
            f"{first} has no option before it: repeat --prior before each axis"
        )
    if command == "watch" and Path(first).exists():
        return (
            "watch takes no file: it displays the running node; for files: hand_eye_calib "
            f"calibrate {shlex.join(rest)}"
        )
    return ""


@argument_type
def directory(text: str) -> Path:
    """Return the directory of an option.

    Raises a ConfigError if the text is empty, if the path is a file, or without write permission.
    """
    if not text.strip():
        raise ConfigError(
            f"the name is empty, got {shown_value(text)}: name a directory"
        )
    path = Path(text)
    for folder in (path, *path.parents):
        if folder.is_file():
            raise ConfigError(
                f"{folder} is a file; give a folder, such as drive/"
            )
    existing = next(
        (folder for folder in (path, *path.parents) if folder.is_dir()), None
    )
    if existing and not os.access(existing, os.W_OK | os.X_OK):
        raise ConfigError(
            f"{existing} is write-protected; choose another directory, or change its permissions"
        )
    return path
