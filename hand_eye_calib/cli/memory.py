"""Memory of a command that computes."""

import atexit
import ctypes
import gc

# Names of glibc's malloc.h, and the largest values that are of use here, bytes.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_MOST_KEPT, _LARGEST_KEPT = 256 << 20, 32 << 20

# New containers after which Python looks for cycles of them: imports alone make 50,000 that stay.
_NEW_CONTAINERS = 100_000


def prepare_to_solve() -> None:
    """Save time that the process would spend on memory; to be called before the imports.

    If the C library is glibc, the process keeps up to 256 MB that it has freed. A solve takes and
    frees arrays of a few MB by the thousand. By default glibc gives each back to the system, which
    has to clear its pages the next time: a tenth of the time of a command. At the exit Python would
    search all that it has imported for cycles: a twentieth.
    """
    gc.set_threshold(_NEW_CONTAINERS)
    atexit.register(gc.freeze)
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        set_option(_M_TRIM_THRESHOLD, _MOST_KEPT)
        set_option(_M_MMAP_THRESHOLD, _LARGEST_KEPT)
