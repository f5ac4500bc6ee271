"""Files: limits of their size, and writing in one step.

A size that a file states may be wrong. So text and YAML that are too large are refused before
memory is allocated. Bags are read by libraries: during this time, a command limits the growth of
its process to :data:`LARGEST`. The poses that are kept take memory of their own.
"""

import os
import stat
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from io import BufferedReader
from os import PathLike
from pathlib import Path
from typing import Any

from hand_eye_calib.core.base.errors import InputError, printable, require_type
from hand_eye_calib.core.base.option import did_you_mean

# Folder of the recordings in the package, for ``sample:NAME``.
_SAMPLES = Path(__file__).parents[1] / "sample"

# ---- all files

#: Bytes of the largest trajectory file, and of the memory for reading a bag in a command.
LARGEST = 512 << 20

# ---- bags

#: Largest ratio of a file to its compressed size.
LARGEST_RATIO = 256
#: Bytes of the longest name of a topic, a type or a frame.
LONGEST_NAME = 1_024
#: Bytes at which a block of messages is complete.
BLOCK_BYTES = 4 << 20

# ---- YAML

#: Bytes of the largest YAML file.
LARGEST_YAML = 1 << 20
#: Whole numbers must be smaller than this, so that they fit into a signed integer of 64 bits.
LARGEST_INT = 1 << 63
#: Largest number of levels of nesting.
DEEPEST_YAML = 32

# ---- .npz

#: Bytes of all arrays of the largest file. The poses of 100,000 stops have 26 million.
LARGEST_ARRAYS = 64 << 20

# ---- trajectory files

#: Characters of the longest line.
LONGEST_LINE = 65_536


_STATM = Path("/proc/self/statm")
_is_limited = False

# Limits of the process before each reading in progress. Readings may run in several threads; the
# last one to end restores the limits before the first one.
_before: list[tuple[int, int]] = []
_lock = threading.Lock()


def limit_memory() -> None:
    """Limit the memory of all later readings, if the system allows this (Linux).

    Only commands call this function, because the limit is for the whole process.
    """
    global _is_limited
    _is_limited = _STATM.exists()


@contextmanager
def reading_memory() -> Iterator[None]:
    """Limit the growth of the process to :data:`LARGEST` while the block runs.

    The limit is set only after a call of :func:`limit_memory`. A growth beyond it raises a
    MemoryError.
    """
    if not _is_limited:
        yield
        return
    import resource

    with _lock:
        limits = resource.getrlimit(resource.RLIMIT_AS)
        _before.append(limits)
        # The limit is for virtual memory.
        largest = int(_STATM.read_text().split()[0]) * resource.getpagesize() + LARGEST
        allowed = [limit for limit in limits if limit != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_AS, (min([largest, *allowed]), limits[1]))
    try:
        yield
    finally:
        with _lock:
            if len(_before) == 1:
                resource.setrlimit(resource.RLIMIT_AS, _before[0])
            _before.pop()


def local_path(source: str | Path) -> Path:
    """Return a source as path; ``sample:NAME`` is a recording in the package.

    Raises
    ------
    InputError
        If the package has no sample of this name.
    """
    scheme, _, name = str(source).partition(":")
    if scheme != "sample":
        return Path(source)
    samples = sorted(path.name for path in _SAMPLES.iterdir())
    if name not in samples:
        wanted = printable(str(source))
        raise InputError(f"there is no {wanted}; the samples are {', '.join(samples)}")
    return _SAMPLES / name


def path_of(name: str, value: Any) -> Path:
    """Return the path that an argument of the Python interface names, as :func:`local_path`.

    Raises
    ------
    InputError
        If the argument is no path.
    """
    require_type(name, value, str, PathLike)
    return local_path(os.fspath(value))


def similar(path: str | Path) -> str:
    """Return ``; did you mean NAME?`` for a missing file if its folder has a similar name."""
    # The folder may not exist, or the path may contain a zero byte.
    with suppress(OSError, ValueError):
        if not Path(path).exists():
            return did_you_mean(Path(path).name, os.listdir(Path(path).parent))
    return ""


def open_regular(path: str | Path) -> BufferedReader:
    """Open a file for reading.

    Raises
    ------
    InputError
        If the file cannot be opened, or is a pipe or a device, which may block for ever.
    """
    try:
        file = open(  # noqa: SIM115
            path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)
        )
    # A path with a zero byte raises a ValueError.
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"cannot read {printable(str(path))}: {reason}{similar(path)}") from None
    if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        return file
    file.close()
    raise InputError(
        f"cannot read {path}: it is not a regular file; save its content to a file first"
    )


def read_bytes(path: str | Path, largest: int = LARGEST) -> bytes:
    """Read a whole file.

    Raises
    ------
    InputError
        If the file cannot be read, or has more than ``largest`` bytes.
    """
    with open_regular(path) as file:
        if os.fstat(file.fileno()).st_size > largest:
            raise InputError(f"cannot read {path}: it is larger than {largest} bytes")
        return file.read()


def read_text(path: str | Path, expected: str, largest: int = LARGEST) -> str:
    """Read a whole text file; see :func:`decoded`. Raises as :func:`read_bytes`."""
    return decoded(path, read_bytes(path, largest), expected)


def decoded(path: str | Path, data: bytes, expected: str) -> str:
    """Return the text of a file in UTF-8, with or without a byte order mark.

    Raises
    ------
    InputError
        If the data is not text. The message contains ``expected``, a description of the file.
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; expected {expected}") from None


@contextmanager
def writing(path: str | Path) -> Iterator[None]:
    """Turn an OSError in the block into an InputError that names the file or the path."""
    try:
        yield
    except OSError as error:
        name = error.filename or path
        raise InputError(
            f"cannot write {name}: {error.strerror}; choose another directory"
        ) from None


def write_atomically(contents: Mapping[Path, str | bytes]) -> None:
    """Write files under temporary names, and then rename them.

    So a reader gets the whole old file or the whole new file. Text is written in UTF-8. A symbolic
    link is replaced by the file; the target of the link is not changed.

    Raises
    ------
    OSError
        If a file cannot be written; the error names the file. The old files are not changed.
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
