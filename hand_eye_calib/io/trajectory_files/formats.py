"""The formats of trajectory files whose columns have fixed places, and how to read a file."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from hand_eye_calib.config import STAMP_UNITS, TRAJECTORY_FORMATS
from hand_eye_calib.errors import ConfigError
from hand_eye_calib.io.trajectory_files.columns import MATRIX, POSITION, QUATERNION

#: The format that the lines look like.
AUTO = "auto"
TUM_COLUMNS = "timestamp tx ty tz qx qy qz qw"


class Format(NamedTuple):
    """A format whose columns have fixed places, a stamp first unless they are elsewhere."""

    expected: str
    quantities: tuple[str, ...]
    separator: str | None = None
    stamp_unit: str = ""

    @property
    def n_columns(self) -> int:
        return len(self.quantities) + (self.quantities != MATRIX)


FIXED_FORMATS = {
    "tum": Format(f"8 numbers, {TUM_COLUMNS}", (*POSITION, *QUATERNION)),
    "kitti": Format("12 numbers, the first three rows of a pose", MATRIX),
    "euroc": Format(
        "8 numbers or more, timestamp, px, py, pz, qw, qx, qy, qz",
        (*POSITION, "qw", "qx", "qy", "qz"),
        ",",
        "ns",
    ),
}


@dataclass(frozen=True, kw_only=True)
class FileOptions:
    """How to read a text file; see :func:`hand_eye_calib.read_trajectory`.

    Raises
    ------
    ConfigError
        For what is not known or does not go together.
    """

    format: str = "tum"
    columns: str | None = None
    times: str | Path | None = None
    stamp_unit: str | None = None
    repair: bool = False
    measures: str = AUTO

    def __post_init__(self) -> None:
        if self.stamp_unit is not None and self.stamp_unit not in STAMP_UNITS:
            raise ConfigError(
                f"unknown unit of stamps {self.stamp_unit!r}; known are {', '.join(STAMP_UNITS)}"
            )
        known = (*TRAJECTORY_FORMATS, AUTO)
        if self.format not in known:
            raise ConfigError(
                f"unknown trajectory format {self.format!r}; known are {', '.join(known)}"
            )
        for given, of, what in (
            (self.columns, "csv", "columns are named for"),
            (self.times, "kitti", "a file of times belongs to"),
        ):
            if given is not None and self.format not in (of, AUTO):
                raise ConfigError(f"{what} format {of} only; the format is {self.format}")
