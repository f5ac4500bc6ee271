"""Messages of damaged mcap files, record by record as far as they go, with the library mcap."""

import heapq
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from io import BytesIO
from itertools import count
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeAlias

from hand_eye_calib.errors import MissingDependencyError, printable
from hand_eye_calib.io.limits import (
    LARGEST_DISORDER,
    LARGEST_RATIO,
    LONGEST_NAME,
    SMALLEST_UNPACKED,
)


class MessageKind(NamedTuple):
    """What the messages of one connection have in common; encoding is "cdr" or "ros1" of what can
    be read, and bag counts those that are read together.
    """

    topic: str
    type: str
    encoding: str
    bag: int = 0

    @classmethod
    def of(cls, topic: str, message_type: str, encoding: str) -> "MessageKind":
        """With names as they can be printed; one that is too long raises ValueError."""
        longest = max(len(topic), len(message_type))
        if longest > LONGEST_NAME:
            raise ValueError(f"a name of {longest} characters is longer than {LONGEST_NAME}")
        return cls(printable(topic), printable(message_type), encoding)


# A message as it was recorded: its kind, its bag time in ns and its bytes.
Message: TypeAlias = tuple[MessageKind, int, bytes]
# Is told what is lost, one line each.
Lose: TypeAlias = Callable[[str], None]


def in_order(messages: Iterable[Message]) -> Iterator[Message]:
    """Messages that are nearly in the order of time, in that order, with little memory."""
    waiting: list[tuple[int, int, Message]] = []
    sequence, size = count(), 0
    for message in messages:
        heapq.heappush(waiting, (message[1], next(sequence), message))
        size += len(message[2])
        while size > LARGEST_DISORDER:
            first = heapq.heappop(waiting)[2]
            size -= len(first[2])
            yield first
    while waiting:
        yield heapq.heappop(waiting)[2]


def reason_of(error: BaseException) -> str:
    """Kind and text of an error in one line."""
    return " ".join([f"{type(error).__name__}:", *str(error).split()]).rstrip(".:")


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


def recovered_messages(path: Path, lose: Lose) -> Iterator[Message]:
    """Messages of an mcap file in the order of the file; what is lost is told, one line each.

    Raises
    ------
    MissingDependencyError
        Without the library mcap.
    """
    try:
        from mcap import records as mcap
        from mcap.data_stream import ReadDataStream
        from mcap.opcode import Opcode
        from mcap.stream_reader import StreamReader, get_chunk_data_stream
    except ImportError as error:
        raise MissingDependencyError(
            f"{path} is damaged or has no index; to read it needs mcap, which is not installed: "
            "pip install mcap"
        ) from error
    schemas: dict[int, str] = {}
    kinds: dict[int, MessageKind] = {}

    def records(source: Any, skip_magic: bool = False) -> Iterator[Any]:
        whole_reads: Any = _WholeReads(source)
        return StreamReader(whole_reads, skip_magic=skip_magic, emit_chunks=True).records

    def messages(found: Iterable[Any]) -> Iterator[Message]:
        for record in found:
            if isinstance(record, mcap.Schema):
                schemas[record.id] = record.name
            elif isinstance(record, mcap.Channel):
                message_type = schemas.get(record.schema_id, "")
                kinds[record.id] = MessageKind.of(
                    record.topic, message_type, record.message_encoding
                )
            elif isinstance(record, mcap.Message) and record.channel_id in kinds:
                yield kinds[record.channel_id], record.log_time, record.data

    def inside(chunk: Any, is_whole: bool = True) -> Iterator[Any]:
        if chunk.uncompressed_size > SMALLEST_UNPACKED + LARGEST_RATIO * len(chunk.data):
            raise ValueError(f"{chunk.uncompressed_size} bytes unpacked are not believable")
        stream, size = get_chunk_data_stream(chunk, validate_crc=is_whole)
        if is_whole and size != chunk.uncompressed_size:
            raise ValueError(f"it unpacks to {size} bytes, not {chunk.uncompressed_size}")
        with suppress(EOFError):  # the end of the chunk
            yield from records(BytesIO(stream.read(size)), skip_magic=True)

    position = 0
    with path.open("rb") as file:
        # Topics are described in the first chunk, which may be damaged, and again at the end.
        with suppress(Exception):  # what is wrong is said below
            deque(messages(records(file)), maxlen=0)
        file.seek(0)
        try:
            for record in records(file):
                try:
                    found = inside(record) if isinstance(record, mcap.Chunk) else [record]
                    yield from messages(found)
                except MemoryError:
                    raise
                except Exception as error:
                    lose(f"the chunk at byte {position} is damaged ({reason_of(error)})")
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
            if file.read(1) == bytes([Opcode.CHUNK]):
                # Of an uncompressed chunk that is cut off, the first messages.
                file.seek(8, 1)
                chunk = mcap.Chunk.read(ReadDataStream(file))
                if not chunk.compression:
                    yield from messages(inside(chunk, is_whole=False))
