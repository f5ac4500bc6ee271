"""Read arrays from ``.npz`` files of unknown origin.

The size of the arrays is checked before memory is allocated.
"""

import math
import zipfile
import zlib
from pathlib import Path
from typing import IO

import numpy as np

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.text import shortened
from hand_eye_calib.formats.files import LARGEST_ARRAYS, open_regular

# Types of errors that numpy and zipfile raise for damaged archives and arrays.
_NO_ARRAYS = (
    OSError,
    ValueError,
    TypeError,
    SyntaxError,
    EOFError,
    RuntimeError,
    NotImplementedError,
    MemoryError,
    zipfile.BadZipFile,
    zlib.error,
)


def read_arrays(
    path: str | Path, largest: int = LARGEST_ARRAYS
) -> dict[str, np.ndarray]:
    """Return the arrays of an ``.npz`` file by their names.

    Raises
    ------
    InputError
        If the file cannot be read, or if its arrays take more than ``largest`` bytes. The limit
        applies to unpacked arrays: compressed zeros take a thousandth of their size.
    """
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            sizes = {
                member.filename: member.file_size
                for member in archive.infolist()
            }
            if sum(sizes.values()) > largest:
                raise InputError(
                    f"cannot read {path}: its arrays take more than {largest} bytes"
                )
            for name, size in sizes.items():
                with archive.open(name) as member:
                    _check_array_size(member, size)
            file.seek(0)
            with np.load(file, allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
    except InputError:
        raise
    except _NO_ARRAYS as error:
        reason = shortened(" ".join(str(error).split())) or type(error).__name__
        raise InputError(f"cannot read {path}: {reason}") from None


def _check_array_size(member: IO[bytes], size: int) -> None:
    """Raise a ValueError if the header of an array states more bytes than the file contains."""
    version = np.lib.format.read_magic(member)
    read_header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if read_header is None:
        raise ValueError(f"an array of format version {version}")
    shape, _, dtype = read_header(member)
    if math.prod(shape) * dtype.itemsize > size:
        raise ValueError("an array is truncated")
