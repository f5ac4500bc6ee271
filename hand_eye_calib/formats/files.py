"""Open, read and write files of unknown origin, with limits of their size.

Text and YAML that are too large are refused before memory is allocated. Bags are read by libraries,
which may trust a wrong size in a damaged bag. While a bag is read, a command limits the growth of
its memory to :data:`LARGEST`. This limit does not include the poses that are kept.
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

# Folder of the sample recordings in the package, which users name ``sample:NAME``.
_SAMPLES = Path(__file__).parents[1] / "sample"

# ---- all files

#: Largest size of a trajectory file, and largest growth of memory while a command reads a bag
#: (bytes).
LARGEST = 512 << 20

# ---- bags

#: Largest ratio of the size of a file to its compressed size.
LARGEST_RATIO = 256
#: Largest size of the name of a topic, a type or a frame (bytes).
LONGEST_NAME = 1_024
#: A block of messages is complete if it has more than this size (bytes).
BLOCK_BYTES = 4 << 20

# ---- YAML

#: Largest size of a YAML file (bytes).
LARGEST_YAML = 1 << 20
#: Largest number of nested levels in a YAML file.
DEEPEST_YAML = 32

# ---- .npz

#: Largest size of all arrays of a file (bytes). The poses of 100,000 stops take 26 million bytes.
LARGEST_ARRAYS = 64 << 20

# ---- trajectory files

#: Largest number of characters of a line.
LONGEST_LINE = 65_536


# File of Linux with the memory of this process.
_STATM = Path("/proc/self/statm")
# Whether `reading_memory` limits the memory.
_is_limited = False

# Limits of the process before each reading in progress. Several threads may read: the last one to
# end restores the limits from before the first reading.
_before: list[tuple[int, int]] = []
_lock = threading.Lock()


def limit_memory() -> None:
    """Limit the memory of all later readings, if the system allows this (Linux).

    Only commands call this function, because the limit applies to the whole process.
    """
    global _is_limited
    _is_limited = _STATM.exists()


@contextmanager
def reading_memory() -> Iterator[None]:
    """Limit the growth of memory within this context to :data:`LARGEST`.

    Larger growth raises a MemoryError. There is no limit if :func:`limit_memory` was not called.
    """
    if not _is_limited:
        yield
        return
    import resource

    with _lock:
        limits = resource.getrlimit(resource.RLIMIT_AS)
        _before.append(limits)
        # The system limits the virtual memory, which is the first number of statm, in pages.
        largest = (
            int(_STATM.read_text().split()[0]) * resource.getpagesize()
            + LARGEST
        )
        allowed = [limit for limit in limits if limit != resource.RLIM_INFINITY]
        resource.setrlimit(
            resource.RLIMIT_AS, (min([largest, *allowed]), limits[1])
        )
    try:
        yield
    finally:
        with _lock:
            if len(_before) == 1:
                resource.setrlimit(resource.RLIMIT_AS, _before[0])
            _before.pop()


def local_path(source: str | Path) -> Path:
    """Return the path of a source; ``sample:NAME`` is a sample recording in the package.

    Raises
    ------
    InputError
        If the package has no sample of this name.
    """
    if not str(source).startswith("sample:"):
        return Path(source)
    name = str(source).removeprefix("sample:")
    samples = sorted(path.name for path in _SAMPLES.iterdir())
    if name not in samples:
        wanted = printable(str(source))
        raise InputError(
            f"there is no {wanted}; the samples are {', '.join(samples)}"
        )
    return _SAMPLES / name


def path_of(name: str, value: Any) -> Path:
    """Return an argument of the Python interface as a path; see :func:`local_path`.

    Raises
    ------
    InputError
        If the value is neither text nor path-like. The message names the argument ``name``.
    """
    require_type(name, value, str, PathLike)
    return local_path(os.fspath(value))


def similar(path: str | Path) -> str:
    """Return ``; did you mean NAME?`` for a missing file; empty if no similar name exists there."""
    # The folder may not exist, or the path may contain a zero byte.
    with suppress(OSError, ValueError):
        if not Path(path).exists():
            wanted = Path(path)
            # Compare the names without suffixes first: a common suffix makes short names similar.
            names = [
                name
                for name in os.listdir(wanted.parent)
                if did_you_mean(wanted.stem, [Path(name).stem])
            ]
            return did_you_mean(wanted.name, names)
    return ""


def open_regular(path: str | Path) -> BufferedReader:
    """Open a file for reading.

    Raises
    ------
    InputError
        If the file cannot be opened, or is a pipe or a device, whose reading may never end.
    """
    try:
        file = open(  # noqa: SIM115
            path,
            "rb",
            opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK),
        )
    # A path with a zero byte raises a ValueError.
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(
            f"cannot read {printable(str(path))}: {reason}{similar(path)}"
        ) from None
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
            raise InputError(
                f"cannot read {path}: it is larger than the limit of {largest} bytes; pass a "
                "smaller file"
            )
        return file.read()


def read_text(path: str | Path, expected: str, largest: int = LARGEST) -> str:
    """Read a whole text file. Raises the errors of :func:`read_bytes` and :func:`decoded`."""
    return decoded(path, read_bytes(path, largest), expected)


def decoded(path: str | Path, data: bytes, expected: str) -> str:
    """Return the text of a file in UTF-8, with or without a byte order mark.

    Raises
    ------
    InputError
        If the data are not text. The message describes the expected file by ``expected``.
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(
            f"{path}: not a text file; expected {expected}"
        ) from None


@contextmanager
def writing(path: str | Path) -> Iterator[None]:
    """Convert an OSError in this context to an InputError that names the file, or ``path``."""
    try:
        yield
    except OSError as error:
        name = error.filename or path
        raise InputError(
            f"cannot write {name}: {error.strerror}; choose another directory"
        ) from None


def write_atomically(contents: Mapping[Path, str | bytes]) -> None:
    """Write files under temporary names, and then rename them.

    Other programs therefore always read a complete file, old or new. Text is written in UTF-8. A
    symbolic link is replaced by the file; its target does not change.

    Raises
    ------
    OSError
        If a file cannot be written or renamed; the error names the file. If writing fails, no old
        file has changed. If renaming fails, the earlier files in the list are already replaced.
    """
    temporaries = {
        path: path.with_name(f".{path.name[:100]}.{os.urandom(8).hex()}")
        for path in contents
    }
    path = Path()
    try:
        for path, temporary in temporaries.items():
            content = contents[path]
            with open(temporary, "xb") as file:
                file.write(
                    content.encode() if isinstance(content, str) else content
                )
                file.flush()
                os.fsync(file.fileno())
        for path, temporary in temporaries.items():
            os.replace(temporary, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        for temporary in temporaries.values():
            temporary.unlink(missing_ok=True)
