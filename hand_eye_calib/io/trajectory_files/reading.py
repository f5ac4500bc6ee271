"""Reading trajectories: TUM, KITTI, EuRoC, tables with named columns, files of other programs
(``foreign.py``), bags, and numbers in memory.
"""

import csv
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from decimal import Decimal
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from hand_eye_calib.arrays import IntArray
from hand_eye_calib.config import PAIR_BY, STAMP_UNITS, TRAJECTORY_FORMATS
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry.trajectory import ROTATION_TOLERANCE, Trajectory, TrajectoryLike
from hand_eye_calib.io.files import LONGEST_LINE, decoded, read_bytes, read_text
from hand_eye_calib.io.trajectory_files.foreign import PROGRAMS, foreign_table
from hand_eye_calib.io.trajectory_files.poses import in_order, poses_of, stamps_in_ns
from hand_eye_calib.io.trajectory_files.table import (
    DIGITS,
    MATRIX,
    NUMBER,
    PLANAR_POSITIONS,
    POSITION,
    QUATERNION,
    RATES,
    SCALAR_FIRST,
    TUM_COLUMNS,
    UNNAMED,
    Table,
    named_columns,
    table_of_object,
)
from hand_eye_calib.text import told_apart

#: The format that the lines look like.
AUTO = "auto"

# Of the formats whose columns have an order: their names, and what a row is.
_FORMATS: dict[str, tuple[Sequence[str], str]] = {
    "tum": (("t", *POSITION, *QUATERNION), f"8 numbers, {TUM_COLUMNS}"),
    "kitti": (MATRIX, "12 numbers, the first three rows of a pose"),
    "euroc": (
        ("t [ns]", *POSITION, "qw", "qx", "qy", "qz"),
        "8 numbers or more, timestamp, px, py, pz, qw, qx, qy, qz",
    ),
}
_EXPECTED = (
    "lines of a trajectory: save the poses of MATLAB, HDF5, Arrow, spreadsheets, receivers and "
    "autopilots as csv, a model of COLMAP as text"
)
# A stamp, a position and a quaternion, whose order is to be found.
_UNNAMED = ("t", *POSITION, *UNNAMED)
# Rows of numbers that have a matrix, all or the first three rows of it, by how many there are.
_LAST_ROW = tuple(f"m4{column}" for column in "1234")
_BY_NUMBER = {
    13: ("t", *MATRIX),
    16: (*MATRIX, *_LAST_ROW),
    17: ("t", *MATRIX, *_LAST_ROW),
}
_TIMES = "times.txt"
_LINE = re.compile(r"\S[^\r\n]*")
_COMMENTS = ("#", "//")
_DECIMAL_COMMA = re.compile(r"([-+]?\d*),(\d+([eE][-+]?\d+)?)")
# Time between poses that are paired without stamps.
_STEP_NS = 100_000_000


@dataclass(frozen=True, kw_only=True)
class FileOptions:
    """How to read a text file; see :func:`hand_eye_calib.read_trajectory`. ``pair_by`` is of all
    files that belong together: "time", or "row" or "name" (of images) in place of stamps. A
    ConfigError for what is not known or does not go together.
    """

    format: str = "tum"
    columns: str | None = None
    times: str | Path | None = None
    stamp_unit: str | None = None
    repair: bool = False
    measures: str = AUTO
    pair_by: str = PAIR_BY[0]

    def __post_init__(self) -> None:
        for what, given, known in (
            ("unit of stamps", self.stamp_unit or "s", (*STAMP_UNITS,)),
            ("trajectory format", self.format, (*TRAJECTORY_FORMATS, AUTO)),
        ):
            if given not in known:
                raise ConfigError(f"unknown {what} {given!r}; known are {', '.join(known)}")
        for value, of, what in (
            (self.columns, "csv", "columns are named for"),
            (self.times, "kitti", "a file of times belongs to"),
        ):
            if value is not None and self.format not in (of, AUTO):
                raise ConfigError(f"{what} format {of} only; the format is {self.format}")


class FileReading(NamedTuple):
    """A trajectory; what was wrong with its stamps; and what the file does not say and had to be
    found or assumed.
    """

    trajectory: Trajectory
    repairs: list[str]
    guesses: list[str]


def read_trajectory(
    source: TrajectoryLike,
    format: str = "tum",
    *,
    topic: str | None = None,
    columns: str | None = None,
    times: str | PathLike[str] | ArrayLike | None = None,
    stamp_unit: str | None = None,
    repair: bool = False,
    measures: str = "auto",
) -> Trajectory:
    """Read a trajectory from a text file, from a bag if ``topic`` is given, or from numbers in
    memory.

    Parameters
    ----------
    source : str, path-like or object
        A file or a bag; or matrices (N, 4, 4) with ``times``, rows (N, 8) of t, x, y, z, qx, qy,
        qz, qw or (N, 7) without t, or a pandas DataFrame with columns named as in csv files.
    format : str
        "tum", "kitti", "euroc", "csv", or "auto" for what the file looks like.
    topic : str, optional
        Of a bag: the topic of the poses; or two frames, ``world:sensor``, whose transform is the
        trajectory, from ``/tf`` and ``/tf_static``. Only ``measures`` can be combined with it.
    columns : str, optional
        For csv without a header: the columns' names, such as
        ``"t,x,y,z,qw,qx,qy,qz"`` or ``"t,lat,lon,height,roll_deg,pitch_deg,heading_deg"``. Other
        names are columns to skip.
    times : str, path-like or (N,) array-like, optional
        For kitti: the file of the stamps. For an object: the stamps, as seconds, whole numbers
        or datetimes.
    stamp_unit : str, optional
        "s", "ms", "us" or "ns"; if left out, recognised from the stamps' size or taken from the
        header (``timestamp [ns]``).
    measures : str
        What to read: "poses", or only "positions", "rotations" or angular "rates"; "auto" for what
        the columns are, and of a bag for what the messages are.
    repair : bool
        Sort poses that are out of order and drop those with a stamp that is there already, with a
        ``UserWarning`` that says how many; otherwise they are an error.

    Returns
    -------
    Trajectory
        Stamps are exactly the decimal numbers of the file, in nanoseconds; frame names are empty,
        from a bag those of the messages. Latitude and longitude become metres east and north of
        the first position. What had to be guessed is a ``UserWarning``.

    Raises
    ------
    InputError
        If the file cannot be read or a line cannot be used; the message names file, line and what
        was found.
    ConfigError
        For a format or unit that is not known, and options that do not go together.

    Examples
    --------
    >>> hec.read_trajectory("lidar.tum").measures
    'poses'
    >>> rows = np.array([[0.0, 1, 2, 3, 0, 0, 0, 1], [0.1, 1, 2, 3, 0, 0, 0, 1]])
    >>> hec.read_trajectory(rows)
    Trajectory(2 poses over 0.100 s)
    """
    path = Path(source) if isinstance(source, str | PathLike) else None
    file_of_times = Path(times) if isinstance(times, str | PathLike) else None
    is_named = format not in (FileOptions.format, AUTO)
    has_options = is_named or columns is not None or file_of_times is not None
    if isinstance(source, Trajectory):
        return source
    if topic:
        if has_options or times is not None or stamp_unit or repair or not path:
            raise ConfigError("topic is for bags and cannot be combined with options of text files")
        return _of_bag(path, topic, measures)
    if (has_options and not path) or (path and times is not None and not file_of_times):
        raise ConfigError(
            "format, columns and a file of times are for text files, other times for objects"
        )
    options = FileOptions(
        format=format,
        columns=columns,
        times=file_of_times,
        stamp_unit=stamp_unit,
        repair=repair,
        measures=measures,
    )
    table = read_table(path, options) if path else table_of_object(source, times)
    trajectory, repairs, guesses = _read(table, options)
    for text in [*guesses, *repairs]:
        warnings.warn(text, UserWarning, stacklevel=2)
    return trajectory


def _of_bag(path: Path, topic: str, measures: str) -> Trajectory:
    from hand_eye_calib.io.bags.reader import PoseBag
    from hand_eye_calib.io.bags.sources import source_of

    with PoseBag(path) as bag:
        trajectory, notes = bag.trajectory(source_of(topic), measures)
        for text in [*bag.warnings, *notes]:
            warnings.warn(text, UserWarning, stacklevel=3)
    return trajectory


def read_trajectory_files(files: Sequence[tuple[Path, FileOptions]]) -> list[FileReading]:
    """Read text files that belong together, with sensors named after the files: those with the same
    columns, which come from one exporter, by one convention of their angles. An InputError if a
    file cannot be read, or no convention fits the motion of all with the same columns.
    """
    tables = [read_table(*each) for each in files]
    pairs: Sequence[IntArray | None] = [None] * len(files)
    if files[0][1].pair_by != PAIR_BY[0]:
        pairs = _pairs(tables, files[0][1].pair_by)
    read = [
        _read(table, options, rows)
        for (_, options), table, rows in zip(files, tables, pairs, strict=True)
    ]
    for header in {table.names for table in tables if table.conventions}:
        of_one = [k for k, table in enumerate(tables) if table.names == header]
        conventions = [tables[k].conventions for k in of_one]
        common = [way for way in conventions[0] if all(way in each for each in conventions)]
        if not common:
            raise InputError(
                f"{' and '.join(str(files[k][0]) for k in of_one)} have the same columns, but no "
                "convention of their angles fits the motion of all; write quaternions instead, or "
                "name the column of one yaw (counterclockwise) and of the other heading (clockwise "
                "from north) if that is what they are"
            )
        for k in of_one:
            if tables[k].conventions[0] != common[0]:
                read[k] = _read(read_table(*files[k]), files[k][1], pairs[k], common[0])
    names = [path.stem for path, _ in files]
    if len({*names}) < len(names):
        names = told_apart([str(path.with_suffix("")) for path, _ in files])
    names = names if len({*names}) == len(names) else [""] * len(names)
    return [
        each._replace(trajectory=replace(each.trajectory, sensor_frame=name))
        for each, name in zip(read, names, strict=True)
    ]


def read_trajectories(*sources: TrajectoryLike) -> list[Trajectory]:
    """Trajectories that belong together from whatever each is: files as they look like, with
    warnings as of :func:`read_trajectory`.
    """
    paths = [Path(each) for each in sources if isinstance(each, str | PathLike)]
    if len(paths) < len(sources):
        return [read_trajectory(each, AUTO) for each in sources]
    readings = read_trajectory_files([(path, FileOptions(format=AUTO)) for path in paths])
    for reading in readings:
        for text in (*reading.repairs, *reading.guesses):
            warnings.warn(text, UserWarning, stacklevel=3)
    return [reading.trajectory for reading in readings]


def _pairs(tables: Sequence[Table], pair_by: str) -> list[IntArray]:
    """The rows of each table that belong to those of the others, without their stamps."""
    counts = [len(table.line_numbers) for table in tables]
    if pair_by == "row" and len({*counts}) > 1:
        raise InputError(f"to be paired by row, files need as many poses each; found {counts}")
    keys = [
        [*table.images] if pair_by == "name" else [*range(count)]
        for table, count in zip(tables, counts, strict=True)
    ]
    common = sorted(set.intersection(*map(set, keys)))
    if not common:
        named = [len(each) for each in keys]
        raise InputError(
            f"no image has a name that is in all files; found {named} names; pair by time or row"
        )
    places = [{key: row for row, key in enumerate(each)} for each in keys]
    return [np.array([place[key] for key in common]) for place in places]


def _read(
    table: Table, options: FileOptions, rows: IntArray | None = None, convention: str = ""
) -> FileReading:
    """The trajectory of a table, or of some of its rows in place of its stamps."""
    if not table.line_numbers:
        raise InputError(f"{table.path}: no poses in it; expected lines of {table.expected}")
    repairs: list[str] = []
    if rows is None:
        stamps_ns = stamps_in_ns(table, options.stamp_unit)
        rows = np.arange(len(stamps_ns))
    else:
        stamps_ns = np.zeros(len(table.line_numbers), dtype=np.int64)
        stamps_ns[rows] = np.arange(len(rows)) * _STEP_NS
    values = poses_of(table, convention)
    if (np.diff(stamps_ns[rows]) <= 0).any():
        rows, repairs = in_order(table, stamps_ns, options.repair)
    builders: dict[str, Callable[..., Trajectory]] = {"rates": Trajectory.from_rates}
    build = builders.get(table.measures, Trajectory.from_quat_xyzw)
    trajectory = build(stamps_ns[rows], *(each[rows] for each in values))
    if table.measures not in ("poses", "rates"):
        table.guess(f"{table.measures} alone, as its columns have it")
    kind = table.measures if options.measures == AUTO else options.measures
    if kind != "poses":
        trajectory = replace(trajectory, measures=kind)
    return FileReading(trajectory, repairs, table.guesses)


# ---- text


def read_table(path: str | Path, options: FileOptions) -> Table:
    """The rows of a file in its format, or in the one that it looks like; an InputError if it
    cannot be read, a line cannot be used, or columns have no names.
    """
    data = read_bytes(path)
    head = data[:LONGEST_LINE].removeprefix(b"\xef\xbb\xbf").lstrip()
    for pattern, read in PROGRAMS.items():
        if re.search(pattern, head):
            return foreign_table(path, data, read, options.columns, options.measures)
    text = decoded(path, data.replace(b"\0", b"\xff"), _EXPECTED)  # no text has a zero
    number, cells, names, format, header = _beginning(path, text)
    columns, times, guesses = options.columns, options.times, list[str]()
    if options.format != AUTO or columns or times:
        format = options.format if options.format != AUTO else "csv" if columns else "kitti"
        header = _FORMATS[format][0] if format != "csv" else names
    else:
        if format != "tum":
            order = ", qw qx qy qz" * (format == "euroc")
            guesses = [f"{path} looks like format {format}{order}; to change that, give `format`"]
        beside = Path(path).with_name(_TIMES)
        if format == "kitti" and beside.is_file():
            times = beside
            guesses.append(f"stamps read from {beside}; to change that, give `times`")
    is_header = not any(map(NUMBER.fullmatch, cells))
    if format == "csv" and header is names and not columns:
        header, number = _completed(header, number, _lines(path, text, number * (names is cells)))
    if columns:
        header = [name.strip() for name in columns.split(",")]
    elif format == "csv":
        is_header = names is cells
    if header is None and cells:
        raise InputError(
            f"{path}: the first line names no columns, so that their order is unknown; name the "
            f"{len(cells)} with `columns`, such as t,x,y,z,qx,qy,qz,qw or t,wx,wy,wz"
        )
    header = (*(header or _UNNAMED),)
    if format == "euroc":
        header += ("",) * (len(cells) - len(header))
    measures = options.measures if format == "csv" else AUTO
    table = Table(path, header, measures, _FORMATS.get(format, ("", ""))[1], format)
    table.guesses = guesses
    if cells:  # a file without data is not gone through again
        table.fill(_lines(path, text, number if is_header else 0), _cells)
    if format == "kitti" and times is not None:
        table.stamps = _stamps_of(times, table)
    return table


def _lines(path: str | Path, text: str, after: int | None = None) -> Iterator[tuple[int, str]]:
    """The lines of a text that are not blank, with their numbers; those after one that are no
    comments.
    """
    number, end = 1, 0
    for line in _LINE.finditer(text):
        number += text.count("\n", end, line.start())
        end = line.end()
        if end - line.start() > LONGEST_LINE:
            raise InputError(f"{path}, line {number}: longer than {LONGEST_LINE} characters")
        if after is None or (number > after and not line[0].startswith(_COMMENTS)):
            yield number, line[0].rstrip()


def _cells(text: str) -> list[str]:
    """The cells of a line: separated by commas, semicolons or white space."""
    if "," not in text and ";" not in text:
        return text.split()
    delimiter = ";" if ";" in text else ","
    row = next(csv.reader([text], delimiter=delimiter, skipinitialspace=True))
    cells = [cell.strip() for cell in row]
    if delimiter == ";" and "," in text:
        return [_DECIMAL_COMMA.sub(r"\1.\2", cell) for cell in cells]
    return cells


def _beginning(
    path: str | Path, text: str
) -> tuple[int, list[str], Sequence[str] | None, str, Sequence[str] | None]:
    """What the beginning of a text tells: number and cells of the first line that is no comment (0
    and none without one); the names of the columns, which are that line, unless it is a row of
    numbers, otherwise the last comment above it that has as many cells, or one that ends in names;
    the format, tum in doubt, so that its reader says what is wrong; and the columns of that format,
    if they are known.
    """
    comments: dict[int, list[str]] = {}
    first = 0, "", list[str](), True
    for number, line in _lines(path, text):
        cells = _cells(line.lstrip("#/").strip())
        is_row = all(NUMBER.fullmatch(cell) for cell in cells if cell)
        if not line.startswith(_COMMENTS):
            first = number, line, cells, is_row
            break
        if not is_row:
            comments[len(cells)] = cells
    number, line, cells, is_row = first
    found: tuple[str, Sequence[str] | None]
    ends = (each[-len(cells) :] for each in comments.values())  # after "format:"
    stated = (end for end in ends if {"x", "qw"} <= named_columns(end)[0].keys())
    names: Sequence[str] | None = cells
    if is_row:
        names = comments.get(len(cells)) or next(stated, None)
    is_separated, n_cells = "," in line or ";" in line, len(cells)
    known = named_columns(names or ())[0].keys()
    if names is cells or any({*group} <= known for group in (*PLANAR_POSITIONS, RATES)):
        is_tum = " ".join((names or ())[1:]).lower() == TUM_COLUMNS.partition(" ")[2]
        found = ("tum", _FORMATS["tum"][0]) if is_tum and not is_separated else ("csv", names)
    elif (by_number := _BY_NUMBER.get(n_cells)) and _has_rotation(cells[by_number.index("m11") :]):
        found = "csv", by_number
    elif not is_separated and n_cells != 4:
        by_default = "tum", _UNNAMED
        found = {7: ("csv", _UNNAMED[1:]), 12: ("kitti", MATRIX)}.get(n_cells, by_default)
    elif n_cells >= 8 and cells[0].isdecimal() and len(cells[0]) >= DIGITS["ns"]:
        found = "euroc", ("t [ns]", *POSITION, *SCALAR_FIRST)
    else:
        found = "csv", _UNNAMED if n_cells == 8 else None
    return number, cells, names, *found


def _completed(
    names: Sequence[str] | None, number: int, lines: Iterator[tuple[int, str]]
) -> tuple[Sequence[str] | None, int]:
    """Names of columns, with units from the row below them, and "t" for a first column without a
    known name that has stamps since 1970; the number of the last line above the rows.
    """
    below, cells = next(((each, _cells(line)) for each, line in lines), (0, [""]))
    if names and below and not any(map(NUMBER.fullmatch, cells)):
        if len(cells) == len(names):
            names = [" ".join(each) for each in zip(names, cells, strict=True)]
        number, cells = below, next((_cells(line) for _, line in lines), [""])
    if names and not {"t", "secs", *named_columns(names[:1])[0]} & named_columns(names)[0].keys():
        names = ["t", *names[1:]] if re.fullmatch(r"\d{10,}(\.\d*)?", cells[0]) else names
    return names, number


def _has_rotation(cells: Sequence[str]) -> bool:
    """Whether rows of a matrix have a rotation in their first three columns."""
    with suppress(ValueError), np.errstate(all="ignore"):  # one may be a time, or empty
        R = np.array(cells[:12], dtype=float).reshape(3, 4)[:, :3]
        return bool(np.allclose(R @ R.T, np.eye(3), atol=ROTATION_TOLERANCE))
    return False


def _stamps_of(times: str | Path, poses: Table) -> list[Decimal]:
    """The stamps of poses from a file of their own."""
    lines = _lines(times, read_text(times, "stamps"), after=0)
    table = Table(times, ["t"], "stamps", "a stamp")
    table.fill(lines, lambda text: text.split()[:1])
    if len(table.stamps) != len(poses.line_numbers):
        raise InputError(
            f"{poses.path}: {len(poses.line_numbers)} poses, but {times} has "
            f"{len(table.stamps)} stamps; they belong to different recordings"
        )
    return table.stamps
