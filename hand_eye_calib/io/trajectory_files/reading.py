"""Reading a trajectory from a text file in any format."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from hand_eye_calib.arrays import IntArray
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry.trajectory import Trajectory, TrajectoryLike
from hand_eye_calib.io.trajectory_files.poses import in_order, poses_of, stamps_in_ns
from hand_eye_calib.io.trajectory_files.table import AUTO, FileOptions, Table, read_table
from hand_eye_calib.text import told_apart

# Time between poses that have no stamps.
_STEP_NS = 100_000_000


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
    tf: str | None = None,
    columns: str | None = None,
    times: str | PathLike[str] | ArrayLike | None = None,
    stamp_unit: str | None = None,
    repair: bool = False,
    measures: str = "auto",
) -> Trajectory:
    """Read a trajectory from a text file, from a bag if ``topic`` or ``tf`` is given, or from
    numbers in memory.

    Parameters
    ----------
    source : str, path-like or object
        A file or a bag; or matrices (N, 4, 4) with ``times``, rows (N, 8) of t, x, y, z, qx, qy,
        qz, qw or (N, 7) without t, or a pandas DataFrame with columns named as in csv files.
    format : str
        "tum", "kitti", "euroc", "csv", or "auto" for what the file looks like.
    topic, tf : str, optional
        Of a bag: the topic of the poses; or two frames, ``world:sensor``, whose transform is the
        trajectory, from ``/tf`` and ``/tf_static``. No other option but ``measures`` goes with it.
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
    has_options = format != FileOptions.format or columns is not None or file_of_times is not None
    if isinstance(source, Trajectory):
        return source
    if topic or tf:
        if has_options or times is not None or stamp_unit or repair or (topic and tf) or not path:
            raise ConfigError(
                "topic and tf are for bags: give one of them and none of the options of text files"
            )
        from hand_eye_calib.io.bags import PoseBag
        from hand_eye_calib.io.transforms import TfSource

        with PoseBag(path) as bag:
            of = TfSource.parse(tf) if tf else topic or ""
            trajectory, notes = bag.trajectory(of, measures)
            notes = [*bag.warnings, *notes]
    elif (has_options and not path) or (path and times is not None and not file_of_times):
        raise ConfigError(
            "format, columns and a file of times are for text files, other times for objects"
        )
    else:
        options = FileOptions(
            format=format,
            columns=columns,
            times=file_of_times,
            stamp_unit=stamp_unit,
            repair=repair,
            measures=measures,
        )
        if path is not None:
            table = read_table(path, options)
        else:
            from hand_eye_calib.io.trajectory_files.objects import table_of_object

            table = table_of_object(source, times)
        trajectory, repairs, guesses = _read(table, options)
        notes = [*guesses, *repairs]
    for text in notes:
        warnings.warn(text, UserWarning, stacklevel=2)
    return trajectory


def read_trajectory_file(
    path: str | Path, format: str = FileOptions.format, **options: Any
) -> FileReading:
    """Read a text file as :func:`read_trajectory`, with the options of FileOptions, and without
    warnings.
    """
    of_file = FileOptions(format=format, **options)
    return _read(read_table(path, of_file), of_file)


def read_trajectory_files(files: Sequence[tuple[Path, FileOptions]]) -> list[FileReading]:
    """Read text files that belong together, with sensors named after the files: those with the same
    columns, which come from one exporter, by one convention of their angles.

    Raises
    ------
    InputError
        If a file cannot be read, or no convention fits the motion of all with the same columns.
    """
    tables = [read_table(*each) for each in files]
    pairs = _pairs(tables, files[0][1].pair_by)
    read = [
        _read(table, options, rows)
        for (_, options), table, rows in zip(files, tables, pairs, strict=True)
    ]
    for header in {table.header for table in tables if table.conventions}:
        of_one = [k for k, table in enumerate(tables) if table.header == header]
        conventions = [tables[k].conventions for k in of_one]
        if len({each[0] for each in conventions}) > 1:
            common = [way for way in conventions[0] if all(way in each for each in conventions)]
            if not common:
                raise InputError(
                    f"{' and '.join(str(files[k][0]) for k in of_one)} have the same columns, "
                    "but no convention of their angles fits the motion of all; write quaternions "
                    "instead, or name the column of one yaw (counterclockwise) and of the other "
                    "heading (clockwise from north) if that is what they are"
                )
            for k in of_one:
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
        return [
            read_trajectory(each, AUTO if isinstance(each, str | PathLike) else "tum")
            for each in sources
        ]
    readings = read_trajectory_files([(path, FileOptions(format=AUTO)) for path in paths])
    for text in (text for _, *texts in readings for text in sum(texts, [])):
        warnings.warn(text, UserWarning, stacklevel=3)
    return [reading.trajectory for reading in readings]


def _pairs(tables: Sequence[Table], pair_by: str) -> list[IntArray | None]:
    """The rows of each table that belong to those of the others, if stamps do not tell."""
    if pair_by == "time":
        return [None] * len(tables)
    counts = [len(table) for table in tables]
    if pair_by == "row" and len({*counts}) > 1:
        raise InputError(f"to be paired by row, files need as many poses each; found {counts}")
    keys = [[*table.images] if pair_by == "name" else [*range(len(table))] for table in tables]
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
    if not len(table):
        raise InputError(f"{table.path}: no poses in it; expected lines of {table.expected}")
    if rows is None and not table.stamps:
        raise ConfigError(
            f"{table.path}: the poses have no stamps; name their column t, give `times`, or pair "
            "poses by row with `pair_by`"
        )
    stamps_ns = stamps_in_ns(table, options.stamp_unit) if rows is None else np.array([])
    kind = table.columns.measures
    values = poses_of(table, convention)
    if rows is None:
        rows, repairs = in_order(table, stamps_ns, options.repair)
        stamps_ns = stamps_ns[rows]
    else:
        stamps_ns, repairs = np.arange(len(rows)) * _STEP_NS, []
    builders: Mapping[str, Callable[..., Trajectory]] = {"rates": Trajectory.from_rates}
    build = builders.get(kind, Trajectory.from_quat_xyzw)
    trajectory = build(stamps_ns, *(each[rows] for each in values))
    if kind not in ("poses", "rates"):
        table.guess(f"{kind} alone, as its columns have it")
    kind = kind if options.measures == AUTO else options.measures
    if kind != "poses":
        trajectory = replace(trajectory, measures=kind)
    return FileReading(trajectory, repairs, table.guesses)
