"""Calibration of rigs: three sensors or more on one body."""

from pathlib import Path
from typing import Any

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.registry import (
    COMMANDS,
    FINDING_WORDS,
    PUBLIC_NAMES,
    ROUTES,
    SESSION_PAGES,
    Command,
    Route,
)


def register() -> None:
    """Register the command ``rig``, its findings, and the files of a session with a rig."""
    PUBLIC_NAMES["RigCalibration"] = "hand_eye_calib.extras.rig.rig"
    PUBLIC_NAMES["calibrate_rig"] = "hand_eye_calib.extras.rig.rig"
    FINDING_WORDS["rig"] = _words
    COMMANDS["rig"] = Command("calibrate three sensors or more together", _rig)
    ROUTES["rig"] = Route(_add_arguments, _is_rig, _calibrate_rig)
    SESSION_PAGES["rig"] = _session_rig


def _rig() -> Any:
    """Return the command ``rig``."""
    from hand_eye_calib.extras.rig.job import RIG

    return RIG


def _words() -> Any:
    """Return the sentences of the findings about rigs."""
    from hand_eye_calib.extras.rig.words import WORDS

    return WORDS


def _session_rig(directory: Path, session: Any) -> None:
    """Write the files of a rig for a session with further sensors."""
    if session.others:
        from hand_eye_calib.extras.rig.page import write_session_rig

        write_session_rig(directory, session)


def _add_arguments(parser: Any) -> None:
    """Add the option for the topics of a rig to ``calibrate``."""
    topics = (
        "topics with poses of three sensors or more, or frames such as "
        "odom:lidar: all are solved together, in the frame of the first "
        "sensor"
    )
    parser.add_argument("--topics", metavar="TOPIC", nargs="+", help=topics)


def _is_rig(arguments: Any) -> bool:
    """Whether ``calibrate`` or ``replay`` was called for a rig: several topics, or three files.

    Raises
    ------
    ConfigError
        For options that a rig does not have.
    """
    if arguments.topics:
        for name in ("parent_topic", "child_topic", "batch", "list"):
            if getattr(arguments, name, None):
                flag = name.replace("_", "-")
                raise ConfigError(f"--topics cannot be combined with --{flag}")
        _refuse_files(arguments.paths)
        return True
    if len(arguments.paths) < 3 or arguments.command == "replay":
        return False
    from hand_eye_calib.offline.cli.reading import are_bags

    return not are_bags(arguments.paths)


def _refuse_files(paths: Any) -> None:
    """Raise a ConfigError if a path is a trajectory file, which has no topics."""
    from hand_eye_calib.offline.cli.reading import is_plain_file

    for path in paths:
        if is_plain_file(path):
            raise ConfigError(
                f"--topics applies to bags only; {path} is a trajectory file"
            )


def _calibrate_rig(arguments: Any, restore_urls: Any) -> int:
    """Calibrate a rig, and return the exit code."""
    from hand_eye_calib.extras.rig.command import calibrate_rig

    return calibrate_rig(arguments, restore_urls)
