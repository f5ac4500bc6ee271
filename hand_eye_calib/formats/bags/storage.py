"""Read one storage file of a bag through the library rosbags: sqlite3 and rosbag1."""

import struct
import sys
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias
from urllib.parse import quote

from hand_eye_calib.core.base.errors import InputError, MissingDependencyError, printable, required
from hand_eye_calib.formats import files

# Tool that repairs a damaged file, by the suffix of the storage file.
REPAIRS = {".mcap": "'mcap recover'", ".db3": "sqlite3's '.recover'", ".bag": "'rosbag reindex'"}
# First bytes of a message that zstd has compressed. Plain CDR never begins with these bytes.
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
# Length (uint32) of the header or of the data of a rosbag1 record.
_LENGTH = struct.Struct("<I")
# Field of a rosbag1 record header that marks a message.
_MESSAGE_OP = b"op=\x02"


class MessageKind(NamedTuple):
    """Topic, type, encoding and definition of messages.

    Attributes
    ----------
    topic, type : str
        Printable names.
    encoding : str
        Only "cdr", "ros1", "json" and "protobuf" can be read.
    definition : (str, bytes)
        Language and content of the type definition; empty if the bag stores none.
    """

    topic: str
    type: str
    encoding: str
    definition: tuple[str, bytes] = ("", b"")

    @property
    def is_ros1(self) -> bool:
        """Return whether ROS 1 serialised the messages."""
        return self.encoding == "ros1"


# A recorded message: kind, bag time (ns) and bytes.
Message: TypeAlias = tuple[MessageKind, int, bytes]


@lru_cache
def kind_of(topic: str, name: str, encoding: str, language: str, content: bytes) -> MessageKind:
    """Return the kind of a connection; the cache returns one object for equal connections."""
    # ROS 1 writes package/Type.
    if encoding == "ros1" and name.count("/") == 1:
        name = name.replace("/", "/msg/")
    return MessageKind(printable_name(topic), printable_name(name), encoding, (language, content))


def printable_name(name: str) -> str:
    """Return a name in printable characters, cut to the largest length of names."""
    return printable(name[: files.LONGEST_NAME])


class Storage(ABC):
    """Storage file that is open for reading until ``opened`` is closed.

    Parameters
    ----------
    paths : list of Path
        The file of the user, and its unfinished files.
    file : Path
        The unpacked file, which is read.
    opened : ExitStack
        Closes the file at its end.

    Attributes
    ----------
    counts : Counter of MessageKind
        Number of messages of each kind.
    span_ns : (first, last) or ()
        Bag times of the first and the last message; empty without messages.
    losses : list of str
        One line for each part that could not be read.

    Raises
    ------
    InputError
        If nothing in the file can be read.
    """

    def __init__(self, paths: list[Path], file: Path, opened: ExitStack) -> None:
        self.paths = paths
        self.counts = Counter[MessageKind]()
        self.span_ns: tuple[int, ...] = ()
        self.losses: list[str] = []
        self._file = file
        # Tool that repairs the file.
        self._repair = REPAIRS[file.suffix]
        # The keys are the numbers of connections or channels in the file.
        self._kinds: dict[int, MessageKind] = {}
        with self._guarded():
            self._open(opened)

    @abstractmethod
    def _open(self, opened: ExitStack) -> None: ...

    @abstractmethod
    def _messages(self, kinds: Mapping[int, MessageKind]) -> Iterable[Message]: ...

    def blocks(self, topics: Collection[str]) -> Iterator[list[Message]]:
        """Iterate over blocks of messages of some topics in the order of bag time.

        Chunks of an mcap file that overlap in time are read one after the other. Their messages are
        in order only within each chunk.
        """
        kinds = {key: kind for key, kind in self._kinds.items() if kind.topic in topics}
        if not kinds:
            return
        blocks = message_blocks(self._messages(kinds))
        while True:
            with self._guarded():
                block = next(blocks, None)
            if block is None:
                return
            yield block

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Limit the memory, and turn any error of the block into an InputError of one line.

        The libraries raise errors of many kinds for damaged files. Only the libraries and the
        recovery of damaged files run in the block, so no other defect is hidden.
        """
        try:
            with files.reading_memory():
                yield
        except MissingDependencyError:
            raise
        except Exception as error:
            # rosbags reads SQLite with apsw, whose NoMemError is no MemoryError.
            if isinstance(error, MemoryError) or type(error).__name__ == "NoMemError":
                why = "reading it needs too much memory; the file is damaged or malicious"
            else:
                why = (
                    "it is truncated, damaged or of an unsupported kind "
                    f"({reason_of(error)}); repair it with {self._repair}, or "
                    "record it again"
                )
            raise InputError(f"cannot read bag {self.paths[0]}: {why}") from error


class RosbagsFile(Storage):
    """A .db3 or .bag file, read by the library rosbags.

    If the library mcap is missing, this class also reads intact .mcap files of ROS 2. rosdep cannot
    install that library.
    """

    def _open(self, opened: ExitStack) -> None:
        suffix = self._file.suffix
        reader = rosbags(1 if suffix == ".bag" else 2).Reader(self._file)
        self._reader = reader
        # SQLite reads the path as a URI.
        if suffix == ".db3":
            reader.storage.path = Path(quote(str(self._file)))
        if suffix == ".mcap":
            self._repair = "the library for damaged mcap files, 'pip install mcap'"
        reader.open()
        opened.callback(reader.close)
        if suffix == ".mcap":
            n_indexed = sum(sum(chunk.channel_count.values()) for chunk in reader.storage.chunks)
            if n_indexed != reader.message_count:
                raise ValueError("it has no index of its messages")
        for connection in reader.connections:
            encoding = getattr(connection.ext, "serialization_format", "ros1")
            language = connection.msgdef.format.name
            definition = connection.msgdef.data.encode()
            kind = kind_of(connection.topic, connection.msgtype, encoding, language, definition)
            self._kinds[connection.id] = kind
            self.counts[kind] += connection.msgcount
        if reader.message_count:
            self.span_ns = reader.start_time, reader.end_time - 1

    def _messages(self, kinds: Mapping[int, MessageKind]) -> Iterable[Message]:
        if self._file.suffix == ".bag":
            yield from self._rosbag1_messages(kinds)
            return
        wanted = [connection for connection in self._reader.connections if connection.id in kinds]
        for connection, bag_ns, data in self._reader.messages(wanted):
            yield kinds[connection.id], bag_ns, data

    def _rosbag1_messages(self, kinds: Mapping[int, MessageKind]) -> Iterator[Message]:
        """Iterate over messages of rosbag1 in the order of bag time.

        The index of the library states the position of each message. The library's own iteration
        takes 1.7 times as long.
        """
        reader = self._reader
        entries = [(entry, kind) for key, kind in kinds.items() for entry in reader.indexes[key]]
        entries.sort(key=lambda item: item[0].time)
        chunk_pos = -1
        chunk = b""
        for entry, kind in entries:
            if entry.chunk_pos != chunk_pos:
                chunk_pos = entry.chunk_pos
                header = reader.chunks[chunk_pos]
                reader.bio.seek(header.datapos)
                chunk = header.decompressor(reader.bio.read(header.datasize))
            yield kind, entry.time, _rosbag1_message(chunk, entry.offset)


def _rosbag1_message(chunk: bytes, start: int) -> bytes:
    """Return the message at a position in a chunk, or after the connection record there."""
    end = start
    is_message = False
    while not is_message:
        header_end = end + _LENGTH.size + _LENGTH.unpack_from(chunk, end)[0]
        is_message = _MESSAGE_OP in chunk[end:header_end]
        end = header_end + _LENGTH.size + _LENGTH.unpack_from(chunk, header_end)[0]
    if end > len(chunk):
        raise EOFError("a chunk ends in the middle of a record")
    return chunk[header_end + _LENGTH.size : end]


def reason_of(error: BaseException) -> str:
    """Return the kind and the text of an error in one line."""
    words = " ".join(str(error).split())
    return f"{type(error).__name__}: {words}".rstrip(".: ")


def rosbags(version: int) -> Any:
    """Import the module of rosbags for bags of ROS 1 or ROS 2."""
    return required(f"rosbags.rosbag{version}", "this bag", "rosbags")


def message_blocks(messages: Iterable[Message]) -> Iterator[list[Message]]:
    """Group messages into blocks; unpack messages that zstd has compressed."""
    block = list[Message]()
    size = 0
    for kind, bag_ns, data in messages:
        if data.startswith(_ZSTD_MAGIC):
            data = bytes(zstd_module().decompress(data))
        block.append((kind, int(bag_ns), data))
        size += len(data)
        if size > files.BLOCK_BYTES:
            yield block
            block = []
            size = 0
    if block:
        yield block


def zstd_module() -> Any:
    """Import the zstd module of Python 3.14 and later, or its backport."""
    return import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")
