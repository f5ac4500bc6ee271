"""Text files: read within limits, and written in one step."""

import os
import stat
from collections.abc import Mapping
from pathlib import Path

from hand_eye_calib.errors import InputError


def open_regular(path: str | Path) -> int:
    """Open a file for reading and return its descriptor.

    A pipe or a device is refused, as reading it may wait for ever.

    Raises
    ------
    OSError
    InputError
        If it is not a regular file.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return descriptor
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(21, "Is a directory", str(path))
    raise InputError(f"cannot read {path}: it is not a regular file; save its content to one first")


def read_bytes(path: str | Path, largest: int) -> bytes:
    """Read a whole file.

    Raises
    ------
    OSError
    InputError
        If it is not a regular file, or larger than ``largest`` bytes.
    """
    with open(open_regular(path), "rb") as file:
        if os.fstat(file.fileno()).st_size > largest:
            raise InputError(f"cannot read {path}: it is larger than {largest} bytes")
        return file.read()


def read_text(path: str | Path, expected: str, largest: int) -> str:
    """Read a whole text file in UTF-8, with or without a byte order mark.

    Raises
    ------
    InputError
        If it cannot be read, or is larger than ``largest`` bytes; one line that names the file, and
        what was expected.
    """
    try:
        return read_bytes(path, largest).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; expected {expected}") from None
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from None


def write_atomically(contents: Mapping[Path, str | bytes]) -> None:
    """Write files, each in one step, once all of them are on the disk under other names.

    A reader sees the old file or the new one, never half of it. A symbolic link is replaced by the
    file; what it led to stays as it is.

    Parameters
    ----------
    contents : mapping of pathlib.Path to str or bytes
        Text is written in UTF-8.

    Raises
    ------
    OSError
        If one cannot be written, with its name; what was there stays.
    """
    temporaries = {
        path: path.with_name(f".{path.name[:100]}.{os.urandom(8).hex()}") for path in contents
    }
    path = Path()
    try:
        for path, temporary in temporaries.items():
            content = contents[path]
            with open(temporary, "xb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
                file.flush()
                os.fsync(file.fileno())
        for path, temporary in temporaries.items():
            os.replace(temporary, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        for temporary in temporaries.values():
            temporary.unlink(missing_ok=True)
