"""Files: the limits of what is read from them, and text that is written in one step.

A file is never believed about its own size. Text and YAML are refused before memory is allocated
for them. Bags are read by libraries: while they do so, a command gives the process no more memory
than :data:`LARGEST`; the poses that are kept come on top.
"""

import os
import stat
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path

from hand_eye_calib.core.base.errors import InputError, printable

# ---- all files

#: Bytes of a trajectory file, and of memory that reading a bag may take, in a command
LARGEST = 512 << 20

# ---- bags

#: A compressed file may unpack to this many times its own size.
LARGEST_RATIO = 256
#: Bytes of the name of a topic, a type or a frame.
LONGEST_NAME = 1_024
#: A block of messages is passed on when it has reached this many bytes.
BLOCK_BYTES = 4 << 20

# ---- YAML

#: Bytes of a YAML file.
LARGEST_YAML = 1 << 20
#: Whole numbers are smaller: they fit 64 bits, as in messages and files of other programs.
LARGEST_INT = 1 << 63
#: Levels of nesting.
DEEPEST_YAML = 32

# ---- .npz

#: Bytes of all arrays of a file. The poses of 100,000 stops take 26 million.
LARGEST_ARRAYS = 64 << 20

# ---- trajectory files

#: Characters of one line.
LONGEST_LINE = 65_536


_STATM = Path("/proc/self/statm")
_is_limited = False

# Limits before each reading of those that go on, in several threads perhaps: the last to end puts
# back those before the first.
_before: list[tuple[int, int]] = []
_lock = threading.Lock()


def limit_memory() -> None:
    """Limit the memory of reading from now on, where the system can (Linux). That is for commands:
    the limit is one of the whole process, which may have other threads.
    """
    global _is_limited
    _is_limited = _STATM.exists()


@contextmanager
def reading_memory() -> Iterator[None]:
    """Lets the process grow by :data:`LARGEST` and no more, after :func:`limit_memory`; what asks
    for more gets a MemoryError.
    """
    if not _is_limited:
        yield
        return
    import resource

    with _lock:
        limits = resource.getrlimit(resource.RLIMIT_AS)
        _before.append(limits)
        # Virtual memory, which is what the limit counts.
        most = int(_STATM.read_text().split()[0]) * resource.getpagesize() + LARGEST
        allowed = [limit for limit in limits if limit != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_AS, (min([most, *allowed]), limits[1]))
    try:
        yield
    finally:
        with _lock:
            if len(_before) == 1:
                resource.setrlimit(resource.RLIMIT_AS, _before[0])
            _before.pop()


def open_regular(path: str | Path) -> BufferedReader:
    """Open a file for reading; an InputError if that is not possible, or it is a pipe or a device,
    for which reading may wait for ever.
    """
    try:
        file = open(  # noqa: SIM115
            path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)
        )
    except (OSError, ValueError) as error:  # a ValueError for a path with a zero byte
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"cannot read {printable(str(path))}: {reason}") from None
    if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        return file
    file.close()
    raise InputError(f"cannot read {path}: it is not a regular file; save its content to one first")


def read_bytes(path: str | Path, largest: int = LARGEST) -> bytes:
    """Read a whole file; an InputError if that is not possible, or it is larger than ``largest``
    bytes.
    """
    with open_regular(path) as file:
        if os.fstat(file.fileno()).st_size > largest:
            raise InputError(f"cannot read {path}: it is larger than {largest} bytes")
        return file.read()


def read_text(path: str | Path, expected: str, largest: int = LARGEST) -> str:
    """Read a whole text file; see :func:`decoded`. Raises as :func:`read_bytes`."""
    return decoded(path, read_bytes(path, largest), expected)


def decoded(path: str | Path, data: bytes, expected: str) -> str:
    """The text of a file in UTF-8, with or without a byte order mark; ``expected`` is what an error
    says that it should be.
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; expected {expected}") from None


@contextmanager
def writing(path: str | Path) -> Iterator[None]:
    """Turns what the system says of a file at or below a path into an InputError that names it."""
    try:
        yield
    except OSError as error:
        name = error.filename or path
        raise InputError(f"cannot write {name}: {error.strerror}; choose another place") from None


def write_atomically(contents: Mapping[Path, str | bytes]) -> None:
    """Write files, each in one step, once all of them are on the disk under other names. Text is
    written in UTF-8.

    A reader sees the old file or the new one, never half of it. A symbolic link is replaced by the
    file; what it led to stays as it is. If one cannot be written, what was there stays; the OSError
    has its name.
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
