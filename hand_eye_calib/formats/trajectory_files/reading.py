"""Read trajectories from files, bags, and numbers in memory.

Files have the format TUM, KITTI or EuRoC, are tables with named columns, or have formats of other
programs (``extras/sensors/foreign.py``).
"""

import shlex
import warnings
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike, fspath
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from hand_eye_calib.core.base.arrays import IntArray
from hand_eye_calib.core.base.config import PAIR_BY
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.base.text import (
    MUCH_NULL,
    distinct_names,
    listing,
    without_poses,
)
from hand_eye_calib.core.geometry.trajectory import (
    Trajectory,
    TrajectoryLike,
)
from hand_eye_calib.formats.bags.patterns import has_suffix_of_bag
from hand_eye_calib.formats.files import local_path
from hand_eye_calib.formats.saved_results import refuse_saved_result
from hand_eye_calib.formats.trajectory_files.file_options import (
    AUTO,
    FileOptions,
)
from hand_eye_calib.formats.trajectory_files.objects import table_of_object
from hand_eye_calib.formats.trajectory_files.poses import poses_of
from hand_eye_calib.formats.trajectory_files.stamps import (
    in_order,
    refuse_coarse,
    refuse_milliseconds,
    require_nanoseconds,
    stamps_in_ns,
)
from hand_eye_calib.formats.trajectory_files.table import Table
from hand_eye_calib.formats.trajectory_files.text_files import read_table

# Interval (ns) of the regular stamps that poses get if they are paired without stamps.
_STEP_NS = 100_000_000


class FileReading(NamedTuple):
    """Trajectory from a file, with notes for the user.

    Attributes
    ----------
    trajectory : Trajectory
    repairs : list of str
        Notes about faults of the file that were repaired.
    guesses : list of str
        Notes about guessed properties, which the file does not state.
    warnings : list of str
        Warnings about the data, to be added to those of the calibration result.
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
    """Read a trajectory from a text file, a bag or numbers in memory.

    Parameters
    ----------
    source : str, path-like or object
        A file, or a bag together with ``topic``; ``sample:NAME`` for a sample of the package;
        matrices (N, 4, 4) with ``times``; rows (N, 8) of t, x, y, z, qx, qy, qz, qw, or (N, 7)
        without t; or a pandas DataFrame with the column names of csv files.
    format : str
        "tum", "kitti", "euroc", "csv", or "auto" to recognise the format.
    topic : str, optional
        Topic of the poses in a bag; or two frames, ``world:sensor``, whose transform in ``/tf``
        and ``/tf_static`` is the trajectory. Only ``measures`` can be combined with a topic.
    columns : str, optional
        Names of the columns of a csv file without a header, such as
        ``"t,x,y,z,qw,qx,qy,qz"`` or ``"t,lat,lon,height,roll_deg,pitch_deg,heading_deg"``. Columns
        with other names are skipped.
    times : str, path-like or (N,) array-like, optional
        For kitti, the file of the stamps. For an object, the stamps as seconds, whole numbers or
        datetimes.
    stamp_unit : str, optional
        "s", "ms", "us" or "ns". By default, the unit is that of the header (``timestamp [ns]``).
        Without it, the unit is inferred from the magnitude of the stamps.
    repair : bool
        Sort poses that are not in order of time, and drop poses with a repeated stamp. A
        ``UserWarning`` states their number. By default, such poses are an error.
    measures : str
        Kind of data to read: "poses", "positions", "rotations" or (angular) "rates". "auto" stands
        for the kind that a file's columns or a bag's messages have.

    Returns
    -------
    Trajectory
        Stamps are the decimal numbers of the file, in nanoseconds without rounding. Frame names are
        those of the messages of a bag, otherwise empty. Latitude and longitude become metres east
        and north of the first position. A ``UserWarning`` reports properties that were guessed.

    Raises
    ------
    InputError
        If the file or one of its lines cannot be read; the message names file, line and content.
    ConfigError
        For an unknown format or unit, and for options that cannot be combined.

    Examples
    --------
    >>> hec.read_trajectory("lidar.tum").measures
    'poses'
    >>> rows = np.array([[0.0, 1, 2, 3, 0, 0, 0, 1], [0.1, 1, 2, 3, 0, 0, 0, 1]])
    >>> hec.read_trajectory(rows)
    Trajectory(2 poses over 0.100 s)
    """
    if isinstance(source, Trajectory):
        require_nanoseconds("the trajectory", source)
        return source
    path = (
        local_path(fspath(source))
        if isinstance(source, str | PathLike)
        else None
    )
    file_of_times = Path(times) if isinstance(times, str | PathLike) else None
    is_format_set = format not in (FileOptions.format, AUTO)
    has_file_options = (
        is_format_set or columns is not None or file_of_times is not None
    )
    has_times_in_memory = times is not None and file_of_times is None
    if topic:
        has_other_options = any(
            [has_file_options, has_times_in_memory, stamp_unit, repair]
        )
        if has_other_options or not path:
            raise ConfigError(
                "topic is for bags and cannot be combined with options of text files"
            )
        return _of_bag(path, topic, measures)
    _refuse_misplaced_options(path, has_file_options, has_times_in_memory)
    options = FileOptions(
        format=format,
        columns=columns,
        times=file_of_times,
        stamp_unit=stamp_unit,
        repair=repair,
        measures=measures,
    )
    table = (
        read_table(path, options) if path else table_of_object(source, times)
    )
    reading = _read(table, options)
    _warn_of(reading)
    return reading.trajectory


def _refuse_misplaced_options(
    path: Path | None, has_file_options: bool, has_times_in_memory: bool
) -> None:
    """Raise a ConfigError for a folder, and for options that belong to another kind of source.

    ``path`` is the text file, or None for an object.
    """
    if path and (path.is_dir() or has_suffix_of_bag(path)):
        refuse_saved_result(path)
        kind = "folder" if path.is_dir() else "bag"
        raise ConfigError(
            f"{path} is a {kind}: name the topic of the bag, such as topic='/odom'"
        )
    has_unusable_options = has_times_in_memory if path else has_file_options
    if has_unusable_options:
        raise ConfigError(
            "format, columns and a file of times apply to text files only; "
            "pass arrays of times for objects"
        )


def _warn_of(reading: FileReading) -> None:
    """Emit the notes of a reading as warnings.

    Python then reports the line that called the public function.
    """
    for text in (*reading.guesses, *reading.repairs, *reading.warnings):
        warnings.warn(text, UserWarning, stacklevel=3)


def _of_bag(path: Path, topic: str, measures: str) -> Trajectory:
    """Return the trajectory of a topic, or of two frames ``world:sensor``, in a bag.

    Notes about the data become warnings, for which Python reports the line of the caller's caller.
    """
    from hand_eye_calib.formats.bags.reader import PoseBag
    from hand_eye_calib.formats.bags.sources import source_of

    with PoseBag(path) as bag:
        trajectory, notes = bag.trajectory(source_of(topic), measures)
        for text in [*bag.warnings, *notes]:
            warnings.warn(text, UserWarning, stacklevel=3)
    return trajectory


def read_trajectory_files(
    files: Sequence[tuple[Path, FileOptions]],
) -> list[FileReading]:
    """Read the text files of a calibration. Sensors without a name get the name of their file.

    Files with the same columns come from the same program, so their angles have one convention.

    Parameters
    ----------
    files : sequence of (Path, FileOptions)

    Raises
    ------
    InputError
        If a file cannot be read, or if no convention fits the motion of all files with the same
        columns.
    """
    tables = [read_table(path, options) for path, options in files]
    rows_of_tables: Sequence[IntArray | None] = [None] * len(files)
    pair_by = files[0][1].pair_by
    if pair_by != PAIR_BY[0]:
        rows_of_tables = _rows_without_stamps(tables, pair_by)
    readings = [
        _read(table, options, rows)
        for (_, options), table, rows in zip(
            files, tables, rows_of_tables, strict=True
        )
    ]
    for number, convention in _corrected_conventions(tables).items():
        path, options = files[number]
        # Read the table again, because its notes state the convention of its angles.
        table = read_table(path, options)
        readings[number] = _read(
            table, options, rows_of_tables[number], convention
        )
    if pair_by == PAIR_BY[0]:
        refuse_milliseconds(
            tables,
            [reading.trajectory.stamps_ns for reading in readings],
            [options.stamp_unit for _, options in files],
        )
    names = _sensor_names([path for path, _ in files])
    return [
        reading._replace(
            trajectory=replace(
                reading.trajectory,
                sensor_frame=reading.trajectory.sensor_frame or name,
            )
        )
        for reading, name in zip(readings, names, strict=True)
    ]


def _corrected_conventions(tables: Sequence[Table]) -> dict[int, str]:
    """Return the conventions of angles with which tables must be read again, by table number.

    Tables with the same columns must have one convention. If their conventions differ, the first
    one that fits the motion of all these tables is used.

    Raises
    ------
    InputError
        If tables with the same columns have no common convention.
    """
    conventions = {}
    for names in {table.names for table in tables if table.conventions}:
        numbers = [
            number
            for number, table in enumerate(tables)
            if table.names == names
        ]
        common = tables[numbers[0]].conventions
        for number in numbers:
            common = [
                name for name in common if name in tables[number].conventions
            ]
        if not common:
            raise InputError(
                f"{' and '.join(str(tables[number].path) for number in numbers)} "
                "have the same columns, but no convention of their angles "
                "fits the motion of all. Write quaternions, or name the "
                "columns yaw (counterclockwise) and heading (clockwise from "
                "north) if the conventions differ"
            )
        for number in numbers:
            if tables[number].conventions[0] != common[0]:
                conventions[number] = common[0]
    return conventions


def _sensor_names(paths: Sequence[Path]) -> list[str]:
    """Return a name for the sensor of each file.

    The name is the file name without suffix. If files have the same name, folders are added to it.
    All names are empty if two paths differ only in the suffix, or not at all.
    """
    names = [path.stem for path in paths]
    if len({*names}) < len(names):
        names = distinct_names([str(path.with_suffix("")) for path in paths])
    return names if len({*names}) == len(names) else [""] * len(names)


def read_trajectories(*sources: TrajectoryLike) -> list[Trajectory]:
    """Read the trajectories of a calibration, whose formats are recognised.

    Guesses and repairs are reported as warnings, as in :func:`read_trajectory`.
    """
    paths = [
        local_path(fspath(source))
        for source in sources
        if isinstance(source, str | PathLike)
    ]
    if len(paths) < len(sources):
        return [read_trajectory(source, AUTO) for source in sources]
    readings = read_trajectory_files(
        [(path, FileOptions(format=AUTO)) for path in paths]
    )
    for reading in readings:
        _warn_of(reading)
    return [reading.trajectory for reading in readings]


def _rows_without_stamps(
    tables: Sequence[Table], pair_by: str
) -> list[IntArray]:
    """Pair the poses of several tables by row, or by the name of their image.

    The result has the indices (N,) of poses in each table. Poses at the same place in all results
    are a pair. A row or name without a pose in one table is skipped in all tables.
    """
    n_rows = [table.n_rows for table in tables]
    if pair_by == "row" and len({*n_rows}) > 1:
        counts = listing(
            [f"{table.n_rows:,} in {table.path}" for table in tables]
        )
        paths = shlex.join(str(table.path) for table in tables)
        raise InputError(
            f"pairing by row needs as many poses in each file; found {counts}: write a row for "
            "each stop into both, or calibrate streams with stamps by time: hand_eye_calib "
            f"calibrate {paths}"
        )
    # For each table, the index of the pose with each name, or in each row of the file.
    indices: list[dict[Any, int]] = []
    for table in tables:
        keys: Sequence[Any] = table.images if pair_by == "name" else table.rows
        indices.append({key: index for index, key in enumerate(keys)})
    common = sorted(set.intersection(*map(set, indices)))
    if not common:
        n_names = []
        for table, index_of in zip(tables, indices, strict=True):
            n_names.append(f"{len(index_of):,} in {table.path}")
        raise InputError(
            f"no name of an image is in all files; names found: {listing(n_names)}; "
            "pair by time or row"
        )
    return [np.array([index_of[key] for key in common]) for index_of in indices]


def _read(
    table: Table,
    options: FileOptions,
    rows: IntArray | None = None,
    convention: str = "",
) -> FileReading:
    """Return the trajectory of a table.

    Parameters
    ----------
    table : Table
    options : FileOptions
    rows : (N,) array of int, optional
        Indices of the used poses, if poses are paired without stamps. These poses get regular
        stamps. By default, all poses are used, with the stamps of the table.
    convention : str, optional
        Convention of the table's angles; by default, it is inferred from the motion.
    """
    if not table.line_numbers:
        raise InputError(
            f"{table.path}: the file contains no poses{_why_no_poses(table)}"
        )
    repairs, doubts = _notes_on_skipped_rows(table)
    if rows is None:
        stamps_ns = stamps_in_ns(table, options.stamp_unit)
        refuse_coarse(table, stamps_ns, table.values())
        rows = np.arange(len(stamps_ns))
    else:
        stamps_ns = np.zeros(len(table.line_numbers), dtype=np.int64)
        stamps_ns[rows] = np.arange(len(rows)) * _STEP_NS
    values = poses_of(table, convention)
    if (np.diff(stamps_ns[rows]) <= 0).any():
        rows, stamp_repairs = in_order(table, stamps_ns, options.repair)
        repairs += stamp_repairs
    if table.measures == "rates":
        trajectory = Trajectory.from_rates(stamps_ns[rows], values[0][rows])
    else:
        positions, quats_xyzw = values
        trajectory = Trajectory.from_quat_xyzw(
            stamps_ns[rows],
            positions[rows],
            quats_xyzw[rows],
            table.sensor_frame,
        )
    if table.measures not in ("poses", "rates"):
        table.guess(f"{table.measures} only, by its columns{table.unread}")
    measures = table.measures if options.measures == AUTO else options.measures
    if measures != "poses":
        trajectory = replace(trajectory, measures=measures)
    return FileReading(trajectory, repairs, table.guesses, doubts)


def _why_no_poses(table: Table) -> str:
    """Return the end of the message about a table without poses: no rows, or no usable rows."""
    if not table.n_rows:
        return f"; expected lines of {table.expected}"
    return (
        f": all {table.n_rows} rows are empty, zero or not finite, the first on line "
        f"{table.first_skipped}"
    )


def _notes_on_skipped_rows(table: Table) -> tuple[list[str], list[str]]:
    """Return notes about skipped rows without a pose: a list of repairs and a list of warnings.

    A few skipped rows are a repair. Many skipped rows are a warning.
    """
    if not table.n_left_out:
        return [], []
    counts = without_poses(table.n_left_out, table.n_rows)
    text = f"{table.path}: {counts}; the first is on line {table.first_skipped}"
    if table.n_left_out <= MUCH_NULL * table.n_rows:
        return [text], []
    return [], [text]
