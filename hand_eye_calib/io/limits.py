"""Limits of what is read from files.

A file is never believed about its own size. Text and YAML are refused before memory is allocated
for them. Bags are read by libraries: while they do so, a command gives the process no more memory
than :data:`LARGEST_GROWTH`; the poses that are kept come on top.
"""

from pathlib import Path
from typing import Self

_MIB = 1 << 20

# ---- bags

#: Bytes of memory that reading a bag may take, in a command
LARGEST_GROWTH = 512 * _MIB
#: Bytes that a compressed file may unpack to: this much ...
SMALLEST_UNPACKED = 64 * _MIB
#: ... plus this many times its own size.
LARGEST_RATIO = 256
#: Bytes of the name of a topic, a type or a frame.
LONGEST_NAME = 1_024
#: A block of messages is passed on when it has reached this many bytes.
BLOCK_BYTES = 4 * _MIB

# ---- YAML

#: Bytes of a YAML file.
LARGEST_YAML = 1 * _MIB
#: Levels of nesting.
DEEPEST_YAML = 32

# ---- trajectory files

#: Bytes of a trajectory file.
LARGEST_TEXT = 512 * _MIB
#: Characters of one line.
LONGEST_LINE = 65_536


class ReadingMemory:
    """Lets the process grow by :data:`LARGEST_GROWTH` in all while a bag is read, and no more; a
    context manager, entered as often as the bag is read from. What asks for more gets a
    MemoryError.

    It does nothing until :meth:`switch_on` was called, as the limit is one of the whole process:
    commands call it, a program that reads bags in one of its threads may not want it.
    """

    _is_on = False

    def __init__(self) -> None:
        self._left = LARGEST_GROWTH

    @classmethod
    def switch_on(cls) -> None:
        """Limit the memory from now on, where the system can (Linux)."""
        cls._is_on = _STATM.exists()

    def __enter__(self) -> Self:
        if self._is_on:
            import resource

            self._before = _address_space()
            self._limits = resource.getrlimit(resource.RLIMIT_AS)
            allowed = [limit for limit in self._limits if limit != resource.RLIM_INFINITY]
            soft = min([self._before + self._left, *allowed])
            resource.setrlimit(resource.RLIMIT_AS, (soft, self._limits[1]))
        return self

    def __exit__(self, *_: object) -> None:
        if self._is_on:
            import resource

            resource.setrlimit(resource.RLIMIT_AS, self._limits)
            self._left -= _address_space() - self._before


_STATM = Path("/proc/self/statm")


def _address_space() -> int:
    """Bytes of virtual memory of this process, which is what the limit counts."""
    import resource

    return int(_STATM.read_text().split()[0]) * resource.getpagesize()
