"""The storage files of bags: found, unpacked, and read through the library rosbags.

An mcap file that rosbags cannot open is read record by record: see mcap_files.py.
"""

import sys
import tempfile
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from operator import attrgetter
from pathlib import Path, PurePath
from typing import Any
from urllib.parse import quote

import numpy as np

from hand_eye_calib.errors import InputError, MissingDependencyError
from hand_eye_calib.io.bags.mcap_files import (
    Message,
    MessageKind,
    indexed_messages,
    message_kind,
    reason_of,
    recovered_messages,
)
from hand_eye_calib.io.limits import BLOCK_BYTES, LARGEST_RATIO, SMALLEST_UNPACKED, reading_memory

# Messages that are unpacked at once.
_BLOCK_SIZE = 2048

_EXPECTED = "a rosbag2 directory, a .mcap or .db3 file of one, or a rosbag1 .bag file"
_REPAIRS = {".mcap": "'mcap recover'", ".db3": "sqlite3's '.recover'", ".bag": "'rosbag reindex'"}
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


class Storage:
    """A storage file opened for reading: ``path`` is its name for a person, ``file`` where it is,
    unpacked. An InputError if nothing in it can be read.

    ``counts`` has the number of messages of each kind, ``span_ns`` the bag times of the first and
    the last, if there are any, and ``losses`` what could not be read, one line each.
    """

    def __init__(self, path: Path, file: Path) -> None:
        self.path, self._file = path, file
        self.counts = Counter[MessageKind]()
        self.span_ns: tuple[int, ...] = ()
        self.losses: list[str] = []
        self._reader: Any = None
        self._kinds: dict[int, MessageKind] = {}
        with self._guarded():
            try:
                self._open()
            except (ImportError, MemoryError):
                raise
            except Exception as error:
                if self._file.suffix != ".mcap":
                    raise
                self.close()
                self._search(error)

    def close(self) -> None:
        """Close the file."""
        if self._reader is not None:
            self._reader.close()
        self._reader = None

    def _open(self) -> None:
        library = rosbags()[self._file.suffix != ".bag"]
        reader = library.Reader(self._file)
        if self._file.suffix == ".db3":  # whose path SQLite reads as an address
            reader.storage.path = Path(quote(str(self._file)))
        reader.open()
        self._reader = reader
        if self._file.suffix == ".mcap":
            counts = (sum(each.channel_count.values()) for each in reader.storage.chunks)
            if sum(counts) != reader.message_count:
                raise ValueError("it has no index of its messages")
        for each in reader.connections:
            encoding = getattr(each.ext, "serialization_format", "ros1")
            kind = message_kind(each.topic, each.msgtype, encoding, each.msgdef)
            self._kinds[each.id] = kind
            self.counts[kind] += each.msgcount
        if reader.message_count:
            self.span_ns = reader.start_time, reader.end_time - 1

    def _search(self, reason: Exception) -> None:
        """Go through a file that rosbags cannot open."""
        times_ns = []
        for kind, bag_ns, _ in recovered_messages(self._file, self.losses.append):
            self.counts[kind] += 1
            times_ns.append(bag_ns)
        if self.losses and not times_ns:
            raise ValueError(f"{self.losses[0]}, and nothing before that can be read") from reason
        if times_ns:
            self.span_ns = min(times_ns), max(times_ns)
            about = f"{len(times_ns)} messages covering {np.ptp(self.span_ns) * 1e-9:.1f}"
            self.losses = [f"{loss}; recovered are {about} s" for loss in self.losses]

    def blocks(self, topics: Collection[str]) -> Iterator[list[Message]]:
        """Iterate over the messages of some topics in the order of bag time, many at once. Chunks
        of mcap that overlap come one after the other.
        """
        blocks, block = message_blocks(self._messages(topics)), None
        while block != []:
            with self._guarded():
                block = next(blocks, [])
            yield block

    def _messages(self, topics: Collection[str]) -> Iterable[Message]:
        if self._reader is None:  # what is lost was said when it was opened
            found = recovered_messages(self._file, lambda _: None)
            return (message for message in found if message[0].topic in topics)
        kinds = {key: kind for key, kind in self._kinds.items() if kind.topic in topics}
        if self._file.suffix == ".mcap":
            return indexed_messages(self._reader.storage, kinds)
        wanted = [each for each in self._reader.connections if each.id in kinds]
        messages = self._reader.messages(wanted) if wanted else ()
        return ((kinds[each.id], bag_ns, data) for each, bag_ns, data in messages)

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Limit the memory, and turn whatever a reader stumbles over into one line.

        Damaged files make the libraries raise errors of many kinds. Only they and the recovery run
        inside, so no defect of the rest is hidden.
        """
        try:
            with reading_memory():
                yield
        except MissingDependencyError:
            raise
        except Exception as error:
            why = (
                f"it is cut off, damaged or of an unsupported kind ({reason_of(error)}); repair it "
                f"with {_REPAIRS[_suffix(self.path)]}, or record it again"
            )
            # NoMemError is SQLite's, as rosbags uses it.
            if isinstance(error, MemoryError) or type(error).__name__ == "NoMemError":
                why = "reading it takes more memory than any bag should; it is damaged, or hostile"
            raise InputError(f"cannot read bag {self.path}: {why}") from error


def rosbags() -> tuple[Any, Any]:
    """The modules of the library for bags of ROS 1 and ROS 2."""
    try:
        from rosbags import rosbag1, rosbag2
    except ImportError as error:
        raise MissingDependencyError(
            "bags need rosbags, which is not installed: pip install rosbags"
        ) from error
    return rosbag1, rosbag2


def message_blocks(messages: Iterable[Message]) -> Iterator[list[Message]]:
    """Messages in blocks that are neither long nor large; those compressed one by one unpacked. A
    ValueError at the first that is not bytes with a time.
    """
    rows, size = list[Message](), 0
    for kind, bag_ns, data in messages:
        if type(data) is not bytes or type(bag_ns) is not int or not 0 <= bag_ns < 1 << 63:
            raise ValueError(f"a message on {kind.topic} is not bytes with a time")
        if data.startswith(_ZSTD_MAGIC):  # as plain CDR never does
            data = bytes(_zstd().decompress(data))
        rows.append((kind, bag_ns, data))
        size += len(data)
        if len(rows) == _BLOCK_SIZE or size > BLOCK_BYTES:
            yield rows
            rows, size = [], 0
    if rows:
        yield rows


def _zstd() -> Any:
    """The zstd module: Python's own from 3.14 on, its backport before."""
    if sys.version_info >= (3, 14):
        from compression import zstd as module
    else:
        import backports.zstd as module
    return module


# ---- files


def open_bags(paths: Iterable[Path], opened: ExitStack) -> list[Storage]:
    """The storage files of bags in the order of their start; those compressed as a whole are
    unpacked first. An InputError if there is no bag or it cannot be read.
    """
    found = list[Storage]()
    for file in [file for path in paths for file in _files_of(path)]:
        readable, lost = file, ""
        if file.suffix == ".zstd":
            folder = tempfile.TemporaryDirectory(prefix="hand_eye_calib_")
            readable = Path(opened.enter_context(folder), f"unpacked{_suffix(file)}")
            lost = _unpack(file, readable)
        storage = Storage(file, readable)
        opened.callback(storage.close)
        storage.losses[:0] = [lost] * bool(lost)
        found.append(storage)
    return sorted(found, key=attrgetter("span_ns"))


def _unpack(file: Path, target: Path) -> str:
    """Unpack a file that is compressed as a whole, as far as it goes; what is lost."""
    zstd, most = _zstd(), SMALLEST_UNPACKED + LARGEST_RATIO * file.stat().st_size
    with zstd.open(file, "rb") as packed, target.open("wb") as unpacked:
        try:
            for piece in iter(lambda: packed.read(BLOCK_BYTES), b""):
                if unpacked.tell() + unpacked.write(piece) > most:
                    raise InputError(
                        f"cannot read bag {file}: its content unpacks to more than "
                        f"{LARGEST_RATIO} times its size, which is not believable"
                    )
        except (EOFError, zstd.ZstdError) as error:
            return f"its compression is damaged ({reason_of(error)})"
    return ""


def _files_of(path: Path) -> list[Path]:
    """The files of a bag that hold messages; those that are there unpacked, too, once."""
    if not path.is_dir():
        if not (_suffix(path) and path.is_file()):
            what = f"{path} is not a bag" if path.exists() else f"no bag at {path}"
            raise InputError(f"{what}; expected {_EXPECTED}")
        return [path]
    found = {file for file in path.iterdir() if _suffix(file) and file.is_file()}
    found -= {file for file in found if file.suffix == ".zstd" and file.with_suffix("") in found}
    if not found:
        raise InputError(
            f"no bag in {path}: expected files that end in {', '.join(_REPAIRS)}; check the path"
        )
    return sorted(found)


def _suffix(file: Path) -> str:
    """.mcap, .db3 or .bag, also of a compressed file; empty for any other."""
    suffix = PurePath(file.name.removesuffix(".zstd")).suffix
    return suffix if suffix in _REPAIRS else ""
