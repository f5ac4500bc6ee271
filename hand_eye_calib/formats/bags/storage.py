"""Read one storage file of a bag: base class, and formats of the library rosbags.

These formats are sqlite3 (.db3) and rosbag1 (.bag).
"""

import math
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

from hand_eye_calib.core.base.errors import (
    InputError,
    MissingDependencyError,
    printable,
    required,
)
from hand_eye_calib.formats import files

# Tool that repairs a damaged storage file with this suffix.
REPAIRS = {
    ".mcap": "'mcap recover'",
    ".db3": "sqlite3's '.recover'",
    ".bag": "'rosbag reindex'",
}
# First bytes of a message that is compressed with zstd. Plain CDR never has these first bytes.
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
# Length in bytes (uint32) before the header and before the data of a rosbag1 record.
_LENGTH = struct.Struct("<I")
# Field in the header of a rosbag1 record that is a message.
_MESSAGE_OP = b"op=\x02"


class MessageKind(NamedTuple):
    """Common properties of the messages of a connection or channel.

    Attributes
    ----------
    topic, type : str
        Printable names.
    encoding : str
        Serialisation of the messages. Only "cdr", "ros1", "json" and "protobuf" can be read.
    definition : (str, bytes)
        Language and text of the type definition; empty if the bag does not contain the definition.
    """

    topic: str
    type: str
    encoding: str
    definition: tuple[str, bytes] = ("", b"")

    @property
    def is_ros1(self) -> bool:
        """Whether the messages are serialised as in ROS 1."""
        return self.encoding == "ros1"


# A recorded message: kind, bag time (ns) and bytes.
Message: TypeAlias = tuple[MessageKind, int, bytes]

# Half-open interval of bag times (ns): the first is included, the second is not.
Span: TypeAlias = tuple[float, float]
ALWAYS: Span = (-math.inf, math.inf)


@lru_cache
def kind_of(
    topic: str, name: str, encoding: str, language: str, content: bytes
) -> MessageKind:
    """Return the kind of a connection's messages. Equal connections get the same object.

    ``name`` is the name of the message type. ``content`` defines the type in ``language``.
    """
    # A type name is package/Type in ROS 1, and package/msg/Type in ROS 2.
    if encoding == "ros1" and name.count("/") == 1:
        name = name.replace("/", "/msg/")
    return MessageKind(
        printable_name(topic),
        printable_name(name),
        encoding,
        (language, content),
    )


def printable_name(name: str) -> str:
    """Return a name with its control characters escaped, cut to ``LONGEST_NAME`` characters."""
    return printable(name[: files.LONGEST_NAME])


class DamageError(ValueError):
    """Error for a damaged file without a readable message. Its text is the complete reason."""


class Storage(ABC):
    """Storage file that is open for reading until ``opened`` is closed.

    Parameters
    ----------
    paths : list of Path
        The user's file, and the files that SQLite keeps beside it.
    file : Path
        The file that is read: the user's file, or an unpacked copy.
    opened : ExitStack
        Exit stack that closes the storage file.

    Attributes
    ----------
    counts : Counter of MessageKind
        Number of messages of each kind.
    span_ns : (first, last) or ()
        Bag times of the first and the last message; empty without messages.
    losses : list of str
        A line for each part of the file that is unreadable.

    Raises
    ------
    InputError
        If nothing in the file can be read.
    """

    def __init__(
        self, paths: list[Path], file: Path, opened: ExitStack
    ) -> None:
        self.paths = paths
        self.counts = Counter[MessageKind]()
        self.span_ns: tuple[int, ...] = ()
        self.losses: list[str] = []
        self._file = file
        # Tool that repairs the file.
        self._repair = REPAIRS[file.suffix]
        # Kind of the messages of each connection or channel, by its number in the file.
        self._kinds: dict[int, MessageKind] = {}
        if not file.stat().st_size:
            raise InputError(
                f"cannot read bag {paths[0]}: it is empty, 0 bytes; copy it again, or record again"
            )
        with self._guarded():
            self._open(opened)

    @abstractmethod
    def _open(self, opened: ExitStack) -> None: ...

    @abstractmethod
    def _messages(
        self, kinds: Mapping[int, MessageKind], span_ns: Span
    ) -> Iterable[Message]:
        """Yield the messages of some kinds. Messages outside a span of bag times may be skipped."""

    def blocks(
        self, topics: Collection[str], span_ns: Span = ALWAYS
    ) -> Iterator[list[Message]]:
        """Iterate over blocks of messages of some topics in the order of bag time.

        If chunks of an mcap file overlap in time, their messages are in order only within each
        chunk. Messages outside ``span_ns`` may be missing.
        """
        kinds = {
            key: kind
            for key, kind in self._kinds.items()
            if kind.topic in topics
        }
        if not kinds:
            return
        blocks = message_blocks(self._messages(kinds, span_ns))
        while True:
            with self._guarded():
                block = next(blocks, None)
            if block is None:
                return
            yield block

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Limit memory and convert errors while a library reads the file (context manager).

        For damaged files, the libraries raise errors of many types. They become an InputError of
        one line. Hardly any other code runs in this context, so defects of this package are not
        hidden.
        """
        try:
            with files.reading_memory():
                yield
        except MissingDependencyError:
            raise
        except Exception as error:
            # rosbags reads SQLite with apsw, whose NoMemError is not a subclass of MemoryError.
            is_memory_error = (
                isinstance(error, MemoryError)
                or type(error).__name__ == "NoMemError"
            )
            if is_memory_error:
                why = "reading it needs too much memory; the file is damaged or malicious"
            else:
                why = (
                    "it is truncated, damaged or of an unsupported kind "
                    f"({reason_of(error)}); repair it with {self._repair}, or "
                    "record it again"
                )
            raise InputError(
                f"cannot read bag {self.paths[0]}: {why}"
            ) from error


class RosbagsFile(Storage):
    """A .db3 or .bag file, read by the library rosbags.

    If the library mcap is missing, because rosdep cannot install it, this class also reads intact
    .mcap files of ROS 2.
    """

    def _open(self, opened: ExitStack) -> None:
        suffix = self._file.suffix
        reader = rosbags(1 if suffix == ".bag" else 2).Reader(self._file)
        self._reader = reader
        # rosbags passes the path to SQLite as a URI. Characters such as % must be escaped.
        if suffix == ".db3":
            reader.storage.path = Path(quote(str(self._file)))
        if suffix == ".mcap":
            self._repair = (
                "'mcap recover', or install the library that reads damaged "
                "mcap files ('pip install mcap')"
            )
        reader.open()
        opened.callback(reader.close)
        # rosbags reads only messages in the index of an mcap file. So the index must be complete.
        if suffix == ".mcap":
            n_indexed = sum(
                sum(chunk.channel_count.values())
                for chunk in reader.storage.chunks
            )
            if n_indexed != reader.message_count:
                raise ValueError("it has no index of its messages")
        for connection in reader.connections:
            encoding = getattr(connection.ext, "serialization_format", "ros1")
            language = connection.msgdef.format.name
            definition = connection.msgdef.data.encode()
            kind = kind_of(
                connection.topic,
                connection.msgtype,
                encoding,
                language,
                definition,
            )
            self._kinds[connection.id] = kind
            self.counts[kind] += connection.msgcount
        if reader.message_count:
            self.span_ns = reader.start_time, reader.end_time - 1

    def _messages(
        self, kinds: Mapping[int, MessageKind], span_ns: Span
    ) -> Iterable[Message]:
        if self._file.suffix == ".bag":
            yield from self._rosbag1_messages(kinds, span_ns)
            return
        wanted = [
            connection
            for connection in self._reader.connections
            if connection.id in kinds
        ]
        start_ns, stop_ns = (None, None) if span_ns == ALWAYS else span_ns
        for connection, bag_ns, data in self._reader.messages(
            wanted, start_ns, stop_ns
        ):
            yield kinds[connection.id], bag_ns, data

    def _rosbag1_messages(
        self, kinds: Mapping[int, MessageKind], span_ns: Span
    ) -> Iterator[Message]:
        """Iterate over messages of rosbag1 in the order of bag time.

        The messages are read at the positions in the library's index. The iteration of the library
        takes 1.7 times as long.
        """
        reader = self._reader
        entries = [
            (entry, kind)
            for key, kind in kinds.items()
            for entry in reader.indexes[key]
            if span_ns[0] <= entry.time < span_ns[1]
        ]
        entries.sort(key=lambda item: item[0].time)
        # Position and unpacked content of the chunk of the previous message.
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
    """Return the message at byte ``start`` of a chunk.

    A record consists of a header and data. If a record that describes the connection precedes the
    message, this record is skipped.
    """
    end = start
    is_message = False
    while not is_message:
        header_start = end
        header_end = _end_of_part(chunk, header_start)
        is_message = _MESSAGE_OP in chunk[header_start:header_end]
        end = _end_of_part(chunk, header_end)
    if end > len(chunk):
        raise EOFError("a chunk ends in the middle of a record")
    return chunk[header_end + _LENGTH.size : end]


def _end_of_part(chunk: bytes, start: int) -> int:
    """Return the end of the header or data at byte ``start``, which begins with its length."""
    (length,) = _LENGTH.unpack_from(chunk, start)
    return start + _LENGTH.size + int(length)


def reason_of(error: BaseException) -> str:
    """Return the type and the text of an error in one line.

    An EOFError or a DamageError is clear without its type.
    """
    words = " ".join(str(error).split())
    if isinstance(error, EOFError | DamageError) and words:
        return words
    return f"{type(error).__name__}: {words}".rstrip(".: ")


def rosbags(version: int) -> Any:
    """Return the module of rosbags that reads bags of ROS 1 or of ROS 2."""
    return required(f"rosbags.rosbag{version}", "this bag", "rosbags")


def message_blocks(messages: Iterable[Message]) -> Iterator[list[Message]]:
    """Group messages into blocks of about ``BLOCK_BYTES``. Decompress messages packed with zstd."""
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
    """Return the zstd module of Python 3.14 and later, or its backport."""
    return import_module(
        "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
    )
