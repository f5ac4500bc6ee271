"""Reading trajectories: TUM, KITTI, EuRoC, tables with named columns, files of other programs
(``foreign.py``), bags, and numbers in memory.
"""

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from decimal import Decimal
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from hand_eye_calib.core.base.arrays import IntArray
from hand_eye_calib.core.base.config import PAIR_BY, STAMP_UNITS, TRAJECTORY_FORMATS
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.base.registry import FILE_READERS
from hand_eye_calib.core.base.text import MUCH_NULL, shortened, told_apart, without_poses
from hand_eye_calib.core.geometry.trajectory import Trajectory, TrajectoryLike
from hand_eye_calib.formats.files import LONGEST_NAME, decoded, read_bytes, read_text
from hand_eye_calib.formats.trajectory_files.columns import (
    MATRIX,
    POSITION,
    TUM_COLUMNS,
    named_columns,
    stamp_columns,
)
from hand_eye_calib.formats.trajectory_files.dates import notes_on_stamps
from hand_eye_calib.formats.trajectory_files.layout import (
    STAMPED_POSE,
    TUM,
    Layout,
    layout_of,
    lines_of,
)
from hand_eye_calib.formats.trajectory_files.poses import poses_of
from hand_eye_calib.formats.trajectory_files.stamps import (
    in_order,
    refuse_coarse,
    stamps_in_ns,
)
from hand_eye_calib.formats.trajectory_files.table import Table, table_of_object

#: The format that the lines look like.
AUTO = "auto"

# Of the formats whose columns have an order: their names, and what a row is.
_FORMATS: dict[str, tuple[Sequence[str], str]] = {
    "tum": (TUM, f"8 numbers, {TUM_COLUMNS}"),
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
_TIMES = "times.txt"
# Letters and signs of Latin-1 that headers have, and characters of ASCII.
_LATIN_1 = [bytes([code]) for code in (0xB0, 0xB2, 0xB5, *range(0xC0, 0x100))]
_ASCII = bytes([*b"\t\n\r", *range(32, 127)])
# A text has at most this share of them.
_FEW_LETTERS = 0.05
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
    """A trajectory; what was wrong with the file and was repaired; what the file does not say and
    had to be found or assumed; and what a result has to be warned of.
    """

    trajectory: Trajectory
    repairs: list[str]
    guesses: list[str]
    warnings: list[str]


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
    trajectory, repairs, guesses, doubts = _read(table, options)
    for text in [*guesses, *repairs, *doubts]:
        warnings.warn(text, UserWarning, stacklevel=2)
    return trajectory


def _of_bag(path: Path, topic: str, measures: str) -> Trajectory:
    from hand_eye_calib.formats.bags.reader import PoseBag
    from hand_eye_calib.formats.bags.sources import source_of

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
        for text in [*reading.repairs, *reading.guesses, *reading.warnings]:
            warnings.warn(text, UserWarning, stacklevel=3)
    return [reading.trajectory for reading in readings]


def _pairs(tables: Sequence[Table], pair_by: str) -> list[IntArray]:
    """The rows of each table that belong to those of the others, without their stamps; a row
    without a pose is left out of all.
    """
    counts = [table.n_rows for table in tables]
    if pair_by == "row" and len({*counts}) > 1:
        raise InputError(f"to be paired by row, files need as many poses each; found {counts}")
    keys: list[list[Any]] = [
        [*table.images] if pair_by == "name" else [*table.rows] for table in tables
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
        raise InputError(f"{table.path}: no poses in it{_all_left_out(table)}")
    repairs, doubts = _left_out(table)
    if rows is None:
        stamps_ns = stamps_in_ns(table, options.stamp_unit)
        refuse_coarse(table, stamps_ns, table.values())
        rows = np.arange(len(stamps_ns))
    else:
        stamps_ns = np.zeros(len(table.line_numbers), dtype=np.int64)
        stamps_ns[rows] = np.arange(len(rows)) * _STEP_NS
    values = poses_of(table, convention)
    if (np.diff(stamps_ns[rows]) <= 0).any():
        rows, of_stamps = in_order(table, stamps_ns, options.repair)
        repairs += of_stamps
    builders: dict[str, Callable[..., Trajectory]] = {"rates": Trajectory.from_rates}
    build = builders.get(table.measures, Trajectory.from_quat_xyzw)
    trajectory = build(stamps_ns[rows], *(columns[rows] for columns in values))
    if table.measures not in ("poses", "rates"):
        table.guess(f"{table.measures} alone, as its columns have it")
    kind = table.measures if options.measures == AUTO else options.measures
    if kind != "poses":
        trajectory = replace(trajectory, measures=kind)
    return FileReading(trajectory, repairs, table.guesses, doubts)


def _all_left_out(table: Table) -> str:
    if not table.n_rows:
        return f"; expected lines of {table.expected}"
    return (
        f": all {table.n_rows} rows are empty, zero or not finite, the first on line "
        f"{table.first_left_out}"
    )


def _left_out(table: Table) -> tuple[list[str], list[str]]:
    """What was repaired by leaving out rows without a pose, or a warning if they are many."""
    if not table.n_left_out:
        return [], []
    counts = without_poses(table.n_left_out, table.n_rows)
    text = f"{table.path}: {counts}; the first is on line {table.first_left_out}"
    if table.n_left_out <= MUCH_NULL * table.n_rows:
        return [text], []
    return [], [text]


# ---- text


def read_table(path: str | Path, options: FileOptions) -> Table:
    """The rows of a file in its format, or in the one that it looks like; an InputError if it
    cannot be read, a line cannot be used, or columns have no names.
    """
    data = read_bytes(path)
    for read in FILE_READERS.values():
        table: Table | None = read(path, data, options)
        if table is not None:
            return table
    text = decoded(path, _in_utf8(data).replace(b"\0", b"\xff"), _EXPECTED)  # no text has a zero
    needs_names = not options.columns and options.format in (AUTO, "csv")
    layout = layout_of(path, text, needs_names)
    if options.format != AUTO or options.columns or options.times:
        layout = _as_given(layout, options)
        guesses = []
    else:
        guesses = [f"{path}{text}" for text in _guesses_of(layout)]
    table = _empty_table(path, layout, options)
    table.guesses = guesses
    if layout.row:  # a file without data is not gone through again
        table.fill(lines_of(path, text, layout.rows_after), layout.cells_of)
        stamp_cells = [layout.row[place] for place in table.stamp_at if place < len(layout.row)]
        for note in notes_on_stamps(table.stamp_names, stamp_cells):
            table.guess(note)
    _add_times(table, options)
    return table


def _in_utf8(data: bytes) -> bytes:
    """A text as it is, or in UTF-8 if it is in UTF-16 or has some letters of Latin-1, such as °."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        with suppress(UnicodeDecodeError):
            return data.decode("utf-16").encode()
    try:
        data.decode()
    except UnicodeDecodeError:
        n_other = sum(data.count(letter) for letter in _LATIN_1)
        n_odd = len(data.translate(None, _ASCII)) - n_other
        if n_odd == 0 and n_other < _FEW_LETTERS * len(data):
            return data.decode("latin-1").encode()
    return data


def _as_given(layout: Layout, options: FileOptions) -> Layout:
    """The layout with the format and columns that options name."""
    if options.columns:
        names = tuple(name.strip() for name in options.columns.split(","))
        return replace(layout, format="csv", columns=names, is_transposable=False)
    if options.format == "csv":
        return replace(layout, format="csv", columns=layout.names, is_transposable=False)
    if options.format != AUTO:
        columns = tuple(_FORMATS[options.format][0])
        return replace(layout, format=options.format, columns=columns, is_transposable=False)
    has_own_stamps = layout.columns is None or stamp_columns(named_columns(layout.columns)[0])
    # The file of times is for poses without stamps.
    return replace(layout, format="kitti", columns=MATRIX) if has_own_stamps else layout


def _guesses_of(layout: Layout) -> list[str]:
    """What a person should know of a layout that no option names."""
    if layout.format == "tum":
        return []
    order = ", qw qx qy qz" if layout.format == "euroc" else ""
    guesses = [f" looks like format {layout.format}{order}; to change that, give `format`"]
    is_usual = layout.columns in (STAMPED_POSE, STAMPED_POSE[1:])
    if layout.names is None and layout.format == "csv" and layout.columns and not is_usual:
        columns = ",".join(name or "-" for name in layout.columns).rstrip(",-")
        guesses.append(
            f": no columns are named; the numbers fit {shortened(columns, LONGEST_NAME)}; to "
            "change that, give `columns`"
        )
    return guesses


def _empty_table(path: str | Path, layout: Layout, options: FileOptions) -> Table:
    """The table that the rows of a layout go into."""
    n_columns = len(layout.row)
    columns = layout.columns
    if columns is None and n_columns:
        raise InputError(
            f"{path}: the first line names no columns, so that their order is unknown; name the "
            f"{n_columns} with `columns`, such as t,x,y,z,qx,qy,qz,qw, "
            "t,x,y,z,roll_deg,pitch_deg,yaw_deg or t,wx,wy,wz"
        )
    columns = columns or STAMPED_POSE
    if layout.format == "euroc":
        columns += ("",) * (n_columns - len(columns))
    measures = options.measures if layout.format == "csv" else AUTO
    expected = _FORMATS.get(layout.format, ("", ""))[1]
    return Table(path, columns, measures, expected, layout.format, layout.is_transposable)


def _add_times(table: Table, options: FileOptions) -> None:
    """Add stamps from a file of their own to poses without any: that of an option, or times.txt in
    the same folder.
    """
    times = options.times
    is_auto = options.format == AUTO and not options.columns
    beside = Path(str(table.path)).with_name(_TIMES)
    if times is None and is_auto and not table.stamp_at and beside.is_file():
        times = beside
        table.guesses.append(
            f"{table.path}: stamps read from {beside}; to change that, give `times`"
        )
    if times is not None and not table.stamp_at:
        table.stamps = _stamps_of(times, table)


def _stamps_of(times: str | Path, poses: Table) -> list[Decimal]:
    """The stamps of poses from a file of their own."""
    lines = lines_of(times, read_text(times, "stamps"), after=0)
    table = Table(times, ["t"], "stamps", "a stamp")
    table.fill(lines, lambda text: text.split()[:1])
    if len(table.stamps) != poses.n_rows:
        raise InputError(
            f"{poses.path}: {poses.n_rows} poses, but {times} has "
            f"{len(table.stamps)} stamps; they belong to different recordings"
        )
    return [table.stamps[row] for row in poses.rows]
