"""Messages of mcap files: of whole ones by the index that the library rosbags has read, of those
that are cut off record by record with the library mcap.
"""

import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from io import BytesIO
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeAlias

from hand_eye_calib.errors import MissingDependencyError, printable
from hand_eye_calib.io.limits import LONGEST_NAME


class MessageKind(NamedTuple):
    """What the messages of one connection have in common; encoding is "cdr", "ros1" or "json" of
    what can be read, and bag counts those that are read together.
    """

    topic: str
    type: str
    encoding: str
    bag: int

    @classmethod
    def of(cls, topic: str, message_type: str, encoding: str, bag: int) -> "MessageKind":
        """With names as they can be printed."""
        topic, message_type = (printable(name[:LONGEST_NAME]) for name in (topic, message_type))
        return cls(topic, message_type, encoding, bag)


# A message as it was recorded: its kind, its bag time in ns and its bytes.
Message: TypeAlias = tuple[MessageKind, int, bytes]

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


class _WholeReads:
    """A file that never returns less than was asked for: the library mcap takes that for a whole
    record.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def read(self, size: int) -> bytes:
        """Read exactly so many bytes."""
        data = self._file.read(size)
        if len(data) < size:
            raise EOFError("it ends in the middle of a record")
        return data


def recovered_messages(path: Path, bag: int, lose: Callable[[str], None]) -> Iterator[Message]:
    """Messages of an mcap file in the order of the file, as far as it goes; what is lost is told.

    Raises
    ------
    MissingDependencyError
        Without the library mcap.
    """
    try:
        from mcap import records as mcap
        from mcap.stream_reader import StreamReader, get_chunk_data_stream
    except ImportError as error:
        raise MissingDependencyError(
            f"{path} is cut off or has no index; to read it needs mcap, which is not installed: "
            "pip install mcap"
        ) from error
    schemas: dict[int, str] = {}
    kinds: dict[int, MessageKind] = {}

    def records(source: Any, is_chunk: bool = False) -> Iterator[Any]:
        whole_reads: Any = _WholeReads(source)
        return StreamReader(whole_reads, skip_magic=is_chunk, emit_chunks=True).records

    def messages(found: Iterable[Any]) -> Iterator[Message]:
        for record in found:
            if isinstance(record, mcap.Schema):
                schemas[record.id] = record.name
            elif isinstance(record, mcap.Channel):
                names = record.topic, schemas.get(record.schema_id, ""), record.message_encoding
                kinds[record.id] = MessageKind.of(*names, bag)
            elif isinstance(record, mcap.Message) and record.channel_id in kinds:
                yield kinds[record.channel_id], record.log_time, record.data

    def inside(chunk: mcap.Chunk, is_whole: bool = True) -> Iterator[Message]:
        stream, size = get_chunk_data_stream(chunk, validate_crc=is_whole)
        with suppress(EOFError):  # the end of the chunk
            yield from messages(records(BytesIO(stream.read(size)), is_chunk=True))

    position = 0
    with path.open("rb") as file:
        try:
            for record in records(file):
                yield from inside(record) if isinstance(record, mcap.Chunk) else messages([record])
                position = file.tell()
        except MemoryError:
            raise
        except Exception as error:
            size = file.seek(0, 2)
            lose(
                f"it is cut off or damaged after {position / max(size, 1):.0%} of its {size} bytes "
                f"({reason_of(error)}), what came later is lost"
            )
            file.seek(position)
            chunk = _chunk_cut_off(file)
            if chunk is not None and not chunk.compression:  # its first messages
                yield from inside(chunk, is_whole=False)


def _chunk_cut_off(file: BinaryIO) -> Any:
    """The chunk at the end of a file; None if there is something else."""
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Chunk

    opcode = file.read(_RECORD.size)[:1]
    chunk = Chunk.read(ReadDataStream(file)) if opcode == bytes([Opcode.CHUNK]) else None
    return chunk if file.read(1) == b"" else None


def reason_of(error: BaseException) -> str:
    """Kind and text of an error in one line."""
    return " ".join([f"{type(error).__name__}:", *str(error).split()]).rstrip(".:")
