"""Read tables from text files, whose format and columns are stated by options or recognised."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from decimal import Decimal
from pathlib import Path

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.registry import FILE_READERS
from hand_eye_calib.core.base.text import shortened
from hand_eye_calib.formats.files import (
    LONGEST_NAME,
    decoded,
    read_bytes,
    read_text,
)
from hand_eye_calib.formats.saved_results import refuse_saved_result
from hand_eye_calib.formats.trajectory_files.cells import are_whole
from hand_eye_calib.formats.trajectory_files.columns import (
    MATRIX,
    POSITION,
    TUM_COLUMNS,
    named_columns,
    stamp_columns,
)
from hand_eye_calib.formats.trajectory_files.dates import notes_on_stamps
from hand_eye_calib.formats.trajectory_files.file_options import (
    AUTO,
    FileOptions,
)
from hand_eye_calib.formats.trajectory_files.layout import (
    DECIMAL_COMMAS,
    TUM,
    Layout,
    layout_of,
    lines_of,
)
from hand_eye_calib.formats.trajectory_files.recognition import STAMPED_POSE
from hand_eye_calib.formats.trajectory_files.table import Table

# Formats with a fixed order of columns: these columns, and a description of a row for messages.
_FORMATS: dict[str, tuple[Sequence[str], str]] = {
    "tum": (TUM, f"8 numbers, {TUM_COLUMNS}"),
    "kitti": (MATRIX, "12 numbers, the first three rows of a pose"),
    "euroc": (
        ("t [ns]", *POSITION, "qw", "qx", "qy", "qz"),
        "8 numbers or more, timestamp, px, py, pz, qw, qx, qy, qz",
    ),
}
# Remedy in the message for a file that is not a text.
_EXPECTED = (
    "lines of a trajectory: save the poses of MATLAB, HDF5, Arrow, spreadsheets, receivers and "
    "autopilots as csv, a model of COLMAP as text"
)
# Examples of columns for the message about a file without names of columns, by their number.
_EXAMPLES = {4: "t,wx,wy,wz", 7: "t,x,y,z,roll_deg,pitch_deg,yaw_deg"}
_EXAMPLE = "t,x,y,z,qx,qy,qz,qw"
# Name of the file with the stamps of the poses in another file of the same folder, as in KITTI.
_TIMES = "times.txt"
# Bytes of Latin-1 that are usual in headers: degree, squared, micro, and letters with accents.
_LATIN_1 = [bytes([code]) for code in (0xB0, 0xB2, 0xB5, *range(0xC0, 0x100))]
# Bytes of the printable characters of ASCII, and of white space.
_ASCII = bytes([*b"\t\n\r", *range(32, 127)])
# A text is in Latin-1 only if less than this share of its bytes are not ASCII.
_FEW_LETTERS = 0.05


def read_table(path: str | Path, options: FileOptions) -> Table:
    """Return the rows of a file, in the format of the options or in the recognised format.

    Raises
    ------
    InputError
        If the file or one of its lines cannot be read, or if its columns have no names.
    """
    refuse_saved_result(Path(path))
    if Path(path).is_dir():
        raise InputError(
            f"{path} is a folder: pass a trajectory file; a bag is calibrated alone, with its "
            "topics"
        )
    data = read_bytes(path)
    for read in FILE_READERS.values():
        table: Table | None = read(path, data, options)
        if table is not None:
            return table
    # A text contains no zero bytes. Replace them by a byte that is invalid in UTF-8, so that the
    # file is rejected.
    text = decoded(path, _in_utf8(data).replace(b"\0", b"\xff"), _EXPECTED)
    needs_names = not options.columns and options.format in (AUTO, "csv")
    layout = layout_of(path, text, needs_names)
    guesses = []
    if options.format != AUTO or options.columns or options.times:
        layout = _with_options(layout, options)
    else:
        guesses = [f"{path}{guess}" for guess in _guesses_of(layout)]
    table = _empty_table(path, layout, options)
    table.guesses = guesses
    if layout.row:
        table.fill(lines_of(path, text, layout.rows_after), layout.cells_of)
        stamp_cells = [
            layout.row[place]
            for place in table.stamp_at
            if place < len(layout.row)
        ]
        for note in notes_on_stamps(table.stamp_names, stamp_cells):
            table.guess(note)
    _add_times(table, options)
    return table


def _in_utf8(data: bytes) -> bytes:
    """Convert a text in UTF-16, or in Latin-1 with a few letters such as °, to UTF-8.

    Other data is returned unchanged.
    """
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        with suppress(UnicodeDecodeError):
            return data.decode("utf-16").encode()
    try:
        data.decode()
    except UnicodeDecodeError:
        n_latin = sum(data.count(letter) for letter in _LATIN_1)
        n_other = len(data.translate(None, _ASCII)) - n_latin
        if n_other == 0 and n_latin < _FEW_LETTERS * len(data):
            return data.decode("latin-1").encode()
    return data


def _with_options(layout: Layout, options: FileOptions) -> Layout:
    """Return the layout with the format and columns from the options.

    Matrices in stated columns are not transposable: no transposition is guessed.
    """
    format = options.format
    columns = layout.names
    if options.columns:
        format = "csv"
        columns = tuple(name.strip() for name in options.columns.split(","))
    elif format == AUTO:
        # Only the option `times` is set, which is for poses without stamps. A layout without a
        # stamp is kept. Any other file must have the format kitti.
        if layout.columns and not stamp_columns(
            named_columns(layout.columns)[0]
        ):
            return layout
        format = "kitti"
        columns = MATRIX
    elif format != "csv":
        columns = tuple(_FORMATS[format][0])
    return replace(
        layout, format=format, columns=columns, is_transposable=False
    )


def _guesses_of(layout: Layout) -> list[str]:
    """Return notes about the recognised format and columns, as they follow the file's path."""
    if layout.format == "tum":
        return []
    order = ", qw qx qy qz" if layout.format == "euroc" else ""
    guesses = [
        f" is read as format {layout.format}{order}; to change this, set `format`"
    ]
    is_usual = layout.columns in (STAMPED_POSE, STAMPED_POSE[1:])
    if (
        layout.names is None
        and layout.format == "csv"
        and layout.columns
        and not is_usual
    ):
        columns = ",".join(name or "-" for name in layout.columns).rstrip(",-")
        guesses.append(
            ": no columns are named; the numbers fit "
            f"{shortened(columns, LONGEST_NAME)}; to change this, set "
            "`columns`"
        )
    return guesses


def _empty_table(
    path: str | Path, layout: Layout, options: FileOptions
) -> Table:
    """Return a table without rows, whose columns are those of the layout.

    Raises
    ------
    InputError
        If the order of the columns is unknown.
    """
    n_columns = len(layout.row)
    columns = layout.columns
    if columns is None and n_columns:
        raise InputError(f"{path}: {_advice_on_columns(layout.row)}")
    columns = columns or STAMPED_POSE
    if layout.format == "euroc":
        columns += ("",) * (n_columns - len(columns))
    measures = options.measures if layout.format == "csv" else AUTO
    expected = _FORMATS.get(layout.format, ("", ""))[1]
    return Table(
        path, columns, measures, expected, layout.format, layout.is_transposable
    )


def _advice_on_columns(row: Sequence[str]) -> str:
    """Return the message about rows whose columns are unnamed and fit no known order."""
    if len(row) > len(TUM) and are_whole(row):
        return f"rows of {len(row)} cells without a decimal point; {DECIMAL_COMMAS}"
    example = _EXAMPLES.get(len(row), _EXAMPLE)
    naming = f"name the {len(row)} columns with `columns`, such as {example}"
    if len(row) == len(TUM) - 1:
        return (
            "7 numbers in a line, tum has 8 (t x y z qx qy qz qw): is one missing? Otherwise "
            f"{naming}"
        )
    return f"the first line does not name the columns, so their order is unknown; {naming}"


def _add_times(table: Table, options: FileOptions) -> None:
    """Add stamps to poses without stamps, from the file of the option ``times``.

    By default, the file times.txt in the folder of the poses is used, if it exists.
    """
    if table.stamp_at:
        return
    path = Path(str(table.path)).with_name(_TIMES)
    is_auto = options.format == AUTO and not options.columns
    if options.times is not None:
        mismatch = "they belong to different recordings"
        table.stamps = _stamps_of(options.times, table, mismatch)
    elif is_auto and path.is_file():
        table.guess(f"stamps read from {path}; to change this, set `times`")
        mismatch = (
            f"{_TIMES} beside it was taken, because no column of stamps was found; name this "
            "column t, or give the right stamps with `times`"
        )
        table.stamps = _stamps_of(path, table, mismatch)


def _stamps_of(times: str | Path, poses: Table, mismatch: str) -> list[Decimal]:
    """Return the stamp of each pose, from a file with a stamp for each row of the poses.

    ``mismatch`` ends the message about a file with another number of stamps.
    """
    lines = lines_of(times, read_text(times, "stamps"), after=0)
    table = Table(times, ["t"], "stamps", "a stamp")
    table.fill(lines, lambda text: text.split()[:1])
    if len(table.stamps) != poses.n_rows:
        raise InputError(
            f"{poses.path}: {poses.n_rows} poses, but {times} has "
            f"{len(table.stamps)} stamps; {mismatch}"
        )
    return [table.stamps[row] for row in poses.rows]
