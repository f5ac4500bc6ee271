"""Tables of plain values: as CSV, and as Parquet if pyarrow is installed."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hand_eye_calib.errors import InputError
from hand_eye_calib.io.files import write_atomically


def write_table(
    directory: Path, stem: str, columns: Mapping[str, type], rows: Sequence[Mapping[str, Any]]
) -> list[Path]:
    """Write ``stem``.csv, and ``stem``.parquet if pyarrow is installed; returns their paths.

    Parameters
    ----------
    directory : pathlib.Path
    stem : str
    columns : dict
        Name of each column to the type of its values: str, int or float.
    rows : list of dict
        Values by the columns' names; None is an empty cell.

    Raises
    ------
    InputError
        If they cannot be written.
    """
    contents: dict[Path, str | bytes] = {directory / f"{stem}.csv": _csv_text(columns, rows)}
    if (data := _parquet(columns, rows)) is not None:
        contents[directory / f"{stem}.parquet"] = data
    try:
        directory.mkdir(parents=True, exist_ok=True)
        write_atomically(contents)
    except OSError as error:
        raise InputError(
            f"cannot write {error.filename or directory}: {error.strerror}; choose another "
            "directory"
        ) from None
    return list(contents)


def _csv_text(columns: Mapping[str, type], rows: Sequence[Mapping[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _as_text(row[name]) for name in columns} for row in rows)
    return text.getvalue()


def _as_text(value: Any) -> Any:
    """A value of a cell; text that a spreadsheet would take for a formula gets an apostrophe."""
    if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r")):
        return f"'{value}"
    return value


def _parquet(columns: Mapping[str, type], rows: Sequence[Mapping[str, Any]]) -> bytes | None:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:  # not installed, or for another version of NumPy
        return None
    types = {str: pa.string(), int: pa.int64(), float: pa.float64()}
    schema = pa.schema([(name, types[kind]) for name, kind in columns.items()])
    buffer = io.BytesIO()
    pq.write_table(pa.Table.from_pylist([dict(row) for row in rows], schema), buffer)
    return buffer.getvalue()
