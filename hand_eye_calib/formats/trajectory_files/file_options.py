"""Options for reading a text file with a trajectory."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hand_eye_calib.core.base.config import (
    PAIR_BY,
    STAMP_UNITS,
    TRAJECTORY_FORMATS,
)
from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.option import did_you_mean

#: Value of the options ``format`` and ``measures`` with which the content of the file decides.
AUTO = "auto"


@dataclass(frozen=True, kw_only=True)
class FileOptions:
    """Options for reading a text file; see :func:`hand_eye_calib.read_trajectory`.

    Attributes
    ----------
    pair_by : str
        How poses of several files are paired: by "time"; without stamps by "row", or by the "name"
        of their images. All files of a calibration have the same value.

    Raises
    ------
    ConfigError
        If a value is unknown, or options cannot be combined.
    """

    format: str = "tum"
    columns: str | None = None
    times: str | Path | None = None
    stamp_unit: str | None = None
    repair: bool = False
    measures: str = AUTO
    pair_by: str = PAIR_BY[0]

    def __post_init__(self) -> None:
        _refuse_unknown(
            "unit of stamps", self.stamp_unit or "s", (*STAMP_UNITS,)
        )
        _refuse_unknown(
            "trajectory format", self.format, (*TRAJECTORY_FORMATS, AUTO)
        )
        reason = ""
        if self.columns is not None and self.format not in ("csv", AUTO):
            reason = "columns can be set for format csv only"
        elif self.times is not None and self.format not in ("kitti", AUTO):
            reason = "a file of times belongs to format kitti only"
        if reason:
            raise ConfigError(f"{reason}; the format is {self.format}")


def _refuse_unknown(setting: str, value: str, choices: Sequence[str]) -> None:
    """Raise a ConfigError for a value that is not among the choices."""
    if value not in choices:
        raise ConfigError(
            f"unknown {setting} {value!r}; known are {', '.join(choices)}"
            f"{did_you_mean(value, choices)}"
        )
