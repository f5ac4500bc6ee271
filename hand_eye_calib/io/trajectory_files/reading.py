"""Reading a trajectory from a text file in any format."""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import ArrayLike

from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.trajectory_files.objects import PoseObject, trajectory_from_object
from hand_eye_calib.io.trajectory_files.poses import in_order, poses_of, rates_of, stamps_in_ns
from hand_eye_calib.io.trajectory_files.table import AUTO, FileOptions, Table, read_table
from hand_eye_calib.io.transforms import TfSource

_Path = str | Path
_USUAL = FileOptions.format


class FileReading(NamedTuple):
    """A trajectory; what was wrong with its stamps; and what the file does not say and had to be
    found or assumed.
    """

    trajectory: Trajectory
    repairs: list[str]
    guesses: list[str]


def read_trajectory(
    source: str | Path | PoseObject,
    format: str = "tum",
    *,
    topic: str | None = None,
    tf: str | None = None,
    columns: str | None = None,
    times: str | Path | ArrayLike | None = None,
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
        qz, qw or (N, 7) without t, or a pandas DataFrame with columns of these names.
    format : str
        "tum", "kitti", "euroc", "csv", or "auto" for what the file looks like.
    topic : str, optional
        Of a bag: the topic of the poses. No other option goes with it.
    tf : str, optional
        Of a bag: the two frames, ``world:sensor``, whose transform is the trajectory, from ``/tf``
        and ``/tf_static``.
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
    if topic or tf:
        of_text = (format != _USUAL, columns, times is not None, stamp_unit, repair)
        if any(of_text) or (topic and tf) or not isinstance(source, _Path):
            raise ConfigError(
                "topic and tf are for bags: give one of them and none of the options of text files"
            )
        from hand_eye_calib.io.bags import PoseBag

        with PoseBag(source) as bag:
            of = TfSource.parse(tf) if tf else topic or ""
            trajectory, notes = bag.trajectory(of, measures)
            notes = [*bag.warnings, *notes]
    elif isinstance(source, _Path):
        if not isinstance(times, _Path | None):
            raise ConfigError("stamps in memory are for poses in memory; of a kitti file name one")
        trajectory, repairs, guesses = read_trajectory_file(
            source,
            format,
            columns=columns,
            times=times,
            stamp_unit=stamp_unit,
            repair=repair,
            measures=measures,
        )
        notes = [*guesses, *repairs]
    else:
        if format != _USUAL or columns or isinstance(times, _Path) or measures != AUTO:
            raise ConfigError("format, columns, measures and a file of times are for text files")
        trajectory, notes = trajectory_from_object(source, times, stamp_unit, repair)
    for text in notes:
        warnings.warn(text, UserWarning, stacklevel=2)
    return trajectory


def read_trajectory_file(path: _Path, format: str = _USUAL, **options: Any) -> FileReading:
    """Read a text file as :func:`read_trajectory`, with the options of FileOptions, and without
    warnings.
    """
    return read_trajectory_files([(path, FileOptions(format=format, **options))])[0]


def read_trajectory_files(files: Sequence[tuple[_Path, FileOptions]]) -> list[FileReading]:
    """Read text files that belong together: those with the same columns, which come from one
    exporter, by one convention of their angles.

    Raises
    ------
    InputError
        If a file cannot be read, or no convention fits the motion of all with the same columns.
    """
    read = [_read(*each) for each in files]
    for header in {table.header for _, table in read if table.conventions}:
        rows = [row for row, (_, table) in enumerate(read) if table.header == header]
        tables = [read[row][1] for row in rows]
        if len({table.conventions[0] for table in tables}) > 1:
            common = set(tables[0].conventions).intersection(*(each.conventions for each in tables))
            if not common:
                raise InputError(
                    f"{' and '.join(str(table.path) for table in tables)} have the same columns, "
                    "but no convention of their angles fits the motion of all; write quaternions "
                    "instead, or name the column of one yaw (counterclockwise) and of the other "
                    "heading (clockwise from north) if that is what they are"
                )
            way = next(each for each in tables[0].conventions if each in common)
            for row in rows:
                read[row] = _read(*files[row], convention=way)
    return [reading for reading, _ in read]


def _read(path: _Path, options: FileOptions, convention: str = "") -> tuple[FileReading, Table]:
    """The trajectory of a file, and the table it was made from."""
    table = read_table(path, options)
    if not table.stamps:
        raise InputError(f"{path}: no poses in it; expected lines of {table.expected}")
    stamps_ns = stamps_in_ns(table, options.stamp_unit)
    measures = table.columns.measures
    if measures == "rates":
        rates = rates_of(table)
        keep, repairs = in_order(table, stamps_ns, options.repair)
        trajectory = Trajectory.from_rates(stamps_ns[keep], rates[keep])
        return FileReading(trajectory, repairs, table.guesses), table
    positions, quats_xyzw = poses_of(table, convention)
    keep, repairs = in_order(table, stamps_ns, options.repair)
    trajectory = Trajectory.from_quat_xyzw(stamps_ns[keep], positions[keep], quats_xyzw[keep])
    if measures != "poses":
        table.guess(f"{measures} alone, as its columns have it")
    kind = measures if options.measures == AUTO else options.measures
    if kind != "poses":
        trajectory = replace(trajectory, measures=kind)
    return FileReading(trajectory, repairs, table.guesses), table
