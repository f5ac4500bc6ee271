"""Limits of what is read from files.

A file is never believed about its own size. Text and YAML are refused before memory is allocated
for them. Bags are read by libraries: while they do so, a command gives the process no more memory
than :data:`LARGEST`; the poses that are kept come on top.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# ---- all files

#: Bytes of a trajectory file, and of memory that reading a bag may take, in a command
LARGEST = 512 << 20

# ---- bags

#: Bytes of the name of a topic, a type or a frame.
LONGEST_NAME = 1_024
#: A block of messages is passed on when it has reached this many bytes.
BLOCK_BYTES = 4 << 20

# ---- YAML

#: Bytes of a YAML file.
LARGEST_YAML = 1 << 20
#: Levels of nesting.
DEEPEST_YAML = 32

# ---- trajectory files

#: Characters of one line.
LONGEST_LINE = 65_536


_STATM = Path("/proc/self/statm")
_is_limited = False


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

    limits = resource.getrlimit(resource.RLIMIT_AS)
    # Virtual memory, which is what the limit counts.
    most = int(_STATM.read_text().split()[0]) * resource.getpagesize() + LARGEST
    allowed = [limit for limit in limits if limit != resource.RLIM_INFINITY]
    resource.setrlimit(resource.RLIMIT_AS, (min([most, *allowed]), limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
