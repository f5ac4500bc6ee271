"""Messages of damaged storage files, record by record, as far as they go: mcap with the library
mcap, which rosbags has no part of; rosbag1 and sqlite3 here.
"""

import heapq
import shutil
import sqlite3
import tempfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from io import BytesIO
from itertools import count
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeAlias
from urllib.parse import quote

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

# Bytes of a page of SQLite; the largest is written as 1.
_SMALLEST_PAGE, _LARGEST_PAGE = 512, 1 << 16
# After a damaged page of a database, twice as many rows are skipped each time, up to this power.
_MOST_DOUBLINGS = 40


def recovered_messages(file: Path, lose: Lose) -> Iterator[Message]:
    """Messages of a file in the order of the file.

    Raises
    ------
    MissingDependencyError
        Without the library mcap, for a file of that kind.
    ValueError, sqlite3.Error
        If nothing can be read.
    """
    recover = {".mcap": _mcap, ".bag": _rosbag1, ".db3": _sqlite3}[file.suffix]
    return recover(file, lose)


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


def _from_chunk(chunk: Iterable[Any], position: int, lose: Lose) -> Iterator[Any]:
    """What comes out of the chunk at a position, up to where it is damaged."""
    try:
        yield from chunk
    except MemoryError:
        raise
    except Exception as error:
        lose(f"the chunk at byte {position} is damaged ({reason_of(error)})")


def _stop(file: BinaryIO, position: int, error: Exception) -> str:
    """What is said when nothing after a position can be read."""
    if isinstance(error, MemoryError):
        raise error
    size = file.seek(0, 2)
    return (
        f"it is cut off or damaged after {position / max(size, 1):.0%} of its {size} bytes "
        f"({reason_of(error)}), what came later is lost"
    )


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


def _mcap(path: Path, lose: Lose) -> Iterator[Message]:
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
                found = inside(record) if isinstance(record, mcap.Chunk) else [record]
                yield from _from_chunk(messages(found), position, lose)
                position = file.tell()
        except Exception as error:
            lose(_stop(file, position, error))
            file.seek(position)
            if file.read(1) == bytes([Opcode.CHUNK]):
                # Of an uncompressed chunk that is cut off, the first messages.
                file.seek(8, 1)
                chunk = mcap.Chunk.read(ReadDataStream(file))
                if not chunk.compression:
                    yield from messages(inside(chunk, is_whole=False))


def _rosbag1(path: Path, lose: Lose) -> Iterator[Message]:
    from rosbags.rosbag1 import reader as rosbag1

    kinds: dict[int, MessageKind] = {}

    def records(source: BinaryIO) -> Iterator[tuple[Any, bytes]]:
        while source.read(1):
            source.seek(-1, 1)
            header = rosbag1.Header.read(source)
            size = rosbag1.read_uint32(source)
            data = source.read(size)
            is_chunk = header.get("op") == bytes([rosbag1.RecordType.CHUNK])
            if is_chunk or len(data) == size:  # of a chunk that is cut off, the first messages
                yield header, data
            if len(data) < size:
                raise EOFError("it ends in the middle of a record")

    def messages(source: BinaryIO) -> Iterator[Message]:
        for header, data in records(source):
            op = header.get_uint8("op")
            if op == rosbag1.RecordType.CONNECTION:
                about = rosbag1.Header.read(BytesIO(len(data).to_bytes(4, "little") + data))
                message_type = rosbag1.normalize_msgtype(about.get_string("type"))
                topic = rosbag1.normalize(header.get_string("topic"))
                kinds[header.get_uint32("conn")] = MessageKind.of(topic, message_type, "ros1")
            elif op == rosbag1.RecordType.MSGDATA and header.get_uint32("conn") in kinds:
                yield kinds[header.get_uint32("conn")], header.get_time("time"), data

    def inside(header: Any, data: bytes) -> Iterator[Message]:
        unpack = rosbag1.decompressors[header.get_string("compression")]
        yield from messages(BytesIO(unpack(data)))

    position, has_index = 0, False
    with path.open("rb") as file:
        try:
            if not file.readline(20).startswith(b"#ROSBAG V2.0"):
                raise ValueError("it does not begin as a rosbag1 file")
            position = file.tell()
            # Topics are described in the first chunk, which may be damaged, and again at the end.
            with suppress(Exception):  # what is wrong is said below
                deque(messages(file), maxlen=0)
            file.seek(position)
            for header, data in records(file):
                op = header.get_uint8("op")
                has_index |= op == rosbag1.RecordType.CHUNK_INFO
                if op == rosbag1.RecordType.CHUNK:
                    yield from _from_chunk(inside(header, data), position, lose)
                position = file.tell()
            if not has_index:
                raise EOFError("it has no index at its end")
        except Exception as error:
            lose(_stop(file, position, error))


def _sqlite3(path: Path, lose: Lose) -> Iterator[Message]:
    """Rows in the order in which they were written, past damaged pages."""
    with path.open("rb") as file, tempfile.NamedTemporaryFile(prefix="hand_eye_calib_") as copy:
        page_size = int.from_bytes(file.read(18)[16:], "big")
        page_size = _LARGEST_PAGE if page_size < _SMALLEST_PAGE else page_size
        size = path.stat().st_size // page_size * page_size
        if size < path.stat().st_size:
            # SQLite takes what lacks of the last page for zeros, and would return them as poses.
            file.seek(0)
            shutil.copyfileobj(file, copy)
            copy.truncate(size)
            path = Path(copy.name)
        yield from _rows(path, lose)


def _rows(path: Path, lose: Lose) -> Iterator[Message]:
    # The path is quoted, as it may hold ?, # or %.
    uri = f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1"
    database = sqlite3.connect(uri, uri=True, check_same_thread=False)
    database.text_factory = lambda text: text.decode("utf-8", "replace")
    try:
        # Without it, SQLite refuses a file that is shorter than it says.
        database.execute("PRAGMA writable_schema = ON")
        tables = database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        if not {("topics",), ("messages",)} <= set(tables):
            raise ValueError("it has no tables 'topics' and 'messages'")
        rows = database.execute("SELECT id, name, type, serialization_format FROM topics")
        kinds = {key: MessageKind.of(*map(str, texts)) for key, *texts in rows}
        query = (
            "SELECT rowid, topic_id, timestamp, data FROM messages NOT INDEXED WHERE rowid > ? "
            "ORDER BY rowid"
        )
        last, step, problem = 0, 1, ""
        while step < 1 << _MOST_DOUBLINGS:
            try:
                for row, key, bag_ns, data in database.execute(query, (last,)):
                    if row <= last:  # a damaged tree of pages may lead back
                        raise sqlite3.DatabaseError("its rows are not in order")
                    last, step = row, 1
                    if key in kinds:
                        yield kinds[key], bag_ns, data
                break
            except sqlite3.DatabaseError as error:
                problem = problem or reason_of(error)
                last, step = last + step, 2 * step
        if problem:
            lose(f"it is cut off or damaged ({problem}), rows that cannot be read are lost")
    finally:
        database.close()
