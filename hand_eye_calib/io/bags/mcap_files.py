"""Messages of mcap files: of whole ones by the index that the library rosbags has read, of those
that are cut off record by record with the library mcap.
"""

import struct
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from io import BufferedReader
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeAlias

from hand_eye_calib.errors import MissingDependencyError, printable
from hand_eye_calib.io.limits import LONGEST_NAME


class MessageKind(NamedTuple):
    """What the messages of a topic have in common; encoding is "cdr", "ros1" or "json" of what can
    be read, definition that of rosbags, or None.
    """

    topic: str
    type: str
    encoding: str
    definition: Any = None

    @property
    def is_ros1(self) -> bool:
        """Whether they are packed as by ROS 1."""
        return self.encoding == "ros1"


# A message as it was recorded: its kind, its bag time in ns and its bytes.
Message: TypeAlias = tuple[MessageKind, int, bytes]


@lru_cache
def message_kind(topic: str, message_type: str, *others: Any) -> MessageKind:
    """One for all connections that are alike, with names as they can be printed."""
    return MessageKind(
        printable(topic[:LONGEST_NAME]), printable(message_type[:LONGEST_NAME]), *others
    )


# Of a chunk: opcode and length of the record, times of its messages, size and checksum.
_CHUNK = struct.Struct("<BQQQQI")
_RECORD, _MESSAGE_OPCODE = struct.Struct("<BQ"), 5
# Channel and log time of a message; with its number and time of publication, 22 bytes.
_MESSAGE, _MESSAGE_SIZE = struct.Struct("<H4xQ"), 22


def indexed_messages(storage: Any, kinds: Mapping[int, MessageKind]) -> Iterator[Message]:
    """Messages of some channels, in the order of time within each chunk. The library's own
    iteration takes twice as long.
    """
    from rosbags.rosbag2.storage_mcap import decompress

    file: BinaryIO = storage.bio
    for chunk in sorted(storage.chunks, key=attrgetter("message_start_time")):
        if kinds.keys() & chunk.channel_count.keys():
            file.seek(chunk.chunk_start_offset)
            *_, size, checksum = _CHUNK.unpack(file.read(_CHUNK.size))
            file.seek(4 + len(chunk.compression) + 8, 1)
            packed = file.read(chunk.compressed_size)
            content = decompress(packed, chunk.compression, size, checksum)
            yield from sorted(_messages_of_chunk(content, kinds), key=itemgetter(1))


def _messages_of_chunk(content: bytes, kinds: Mapping[int, MessageKind]) -> Iterator[Message]:
    position = 0
    while position < len(content):
        opcode, size = _RECORD.unpack_from(content, position)
        start, position = position + _RECORD.size, position + _RECORD.size + size
        if position > len(content):
            raise EOFError("a chunk ends in the middle of a record")
        if opcode == _MESSAGE_OPCODE:
            key, bag_ns = _MESSAGE.unpack_from(content, start)
            if key in kinds:
                yield kinds[key], bag_ns, content[start + _MESSAGE_SIZE : position]


class _WholeReads(BufferedReader):
    """A file that never returns less than was asked for: the library mcap takes that for a whole
    record.
    """

    def read(self, size: int | None = -1) -> bytes:
        data = super().read(size)
        if len(data) < (size or 0):
            raise EOFError("it ends in the middle of a record")
        return data


def recovered_messages(path: Path, lose: Callable[[str], None]) -> Iterator[Message]:
    """Messages of an mcap file in their order, as far as it goes; what is lost is told."""
    try:
        from mcap import records as mcap
        from mcap.stream_reader import StreamReader
    except ImportError as error:
        raise MissingDependencyError(
            f"{path} is cut off or has no index; to read it needs mcap, which is not installed: "
            "pip install mcap"
        ) from error
    schemas: dict[int, str] = {}
    kinds: dict[int, MessageKind] = {}
    position = 0
    with _WholeReads(path.open("rb", buffering=0)) as file:
        try:
            for record in StreamReader(file, validate_crcs=True).records:
                if isinstance(record, mcap.Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, mcap.Channel):
                    schema = schemas.get(record.schema_id, "")
                    kinds[record.id] = message_kind(record.topic, schema, record.message_encoding)
                elif isinstance(record, mcap.Message) and record.channel_id in kinds:
                    yield kinds[record.channel_id], record.log_time, record.data
                position = file.tell()
        except MemoryError:
            raise
        except Exception as error:
            share = position / max(file.seek(0, 2), 1)
            lose(
                f"it is cut off or damaged after {share:.0%} of its bytes ({reason_of(error)}), "
                "what came later is lost"
            )


def reason_of(error: BaseException) -> str:
    """Kind and text of an error in one line."""
    return " ".join([f"{type(error).__name__}:", *str(error).split()]).rstrip(".:")
