"""Bag with both paths and the transform, for viewers such as RViz, Foxglove and Rerun."""

from pathlib import Path
from typing import Any

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.registry import RESULT_FILES, ResultFile


def register() -> None:
    """Register the option ``--viewer`` of ``calibrate``."""
    RESULT_FILES["viewer"] = ResultFile(_add_arguments, _write)


def _add_arguments(group: Any) -> None:
    """Declare the option with the path of the bag."""
    from hand_eye_calib.offline.cli.options import argument_type

    words = (
        "also write a bag (mcap) for RViz, Foxglove or Rerun: the parent's poses on /tf, the "
        "result on /tf_static, and the paths of both sensors before and after the calibration"
    )
    group.add_argument(
        "--viewer",
        metavar="BAG",
        type=argument_type(_new_folder),
        help=words,
    )


def _new_folder(text: str) -> Path:
    """Return the path of a new folder. Raises a ConfigError if the folder exists."""
    from hand_eye_calib.offline.cli.paths import directory

    path = directory(text)
    if path.exists():
        raise ConfigError(
            f"{path} exists, and no file is overwritten: name a new folder"
        )
    return path


def _write(path: Path, calibration: Any, snapshot: Any) -> None:
    """Write the bag of a result."""
    from hand_eye_calib.extras.viewer.bag import write_viewer_bag

    write_viewer_bag(path, calibration, snapshot)
