"""mcap files: whole ones, those that end in the middle, and those with damaged chunks.

Only records of the topics that are asked for are read. If a file has an index, the bytes of other
topics, such as camera images, are skipped. If it has none, because the recorder did not live to
write it, the file is searched record by record up to the last whole one. The format:
https://mcap.dev/spec
"""

import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Container, Iterator
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from hand_eye_calib.errors import printable
from hand_eye_calib.io.bags.blocks import Message, MessageKind, regrouped
from hand_eye_calib.io.bags.decompression import Budget, unpack
from hand_eye_calib.io.bags.storage import (
    LATEST_NS,
    Losses,
    add_topic,
    check_encoding,
    in_order,
)
from hand_eye_calib.io.limits import (
    LARGEST_CHUNK,
    LARGEST_DESCRIPTION,
    LARGEST_MESSAGE,
    LONGEST_NAME,
    MOST_CHUNKS,
    MOST_MESSAGES_PER_CHUNK,
    MOST_TOPICS,
)

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 2, 3, 4, 5, 6
_MESSAGE_INDEX, _CHUNK_INDEX, _STATISTICS, _DATA_END = 7, 8, 11, 15
_FOOTER_SIZE = 9 + 20 + len(_MAGIC)

_RECORD = struct.Struct("<BQ")  # opcode, length
_MESSAGE_HEADER = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK_HEADER = struct.Struct("<QQQI")  # start, end, uncompressed size, checksum
_UINT16, _UINT32, _UINT64 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")
_ENTRY = struct.Struct("<QQ")
_SMALLEST_MESSAGE = _RECORD.size + _MESSAGE_HEADER.size

# Messages outside chunks are read in runs of this many bytes.
_RUN_BYTES = 1 << 20

# What parsing bytes that are not what they should be may raise.
_MALFORMED = (struct.error, ValueError, IndexError, EOFError)

Bytes = bytes | memoryview


class Channel(NamedTuple):
    """A topic's channel: its name, message type and encoding."""

    topic: str
    type: str
    encoding: str


class _Chunk(NamedTuple):
    """A part of the file that holds messages.

    Attributes
    ----------
    offset, size : int
        Of the chunk's record; of a run of messages outside chunks, of their records.
    start_ns, end_ns : int
        The bag time it covers.
    index_offset : int
        Where the record of the index is that describes the chunk; 0 if there is none.
    is_run : int
        1 for a run of messages outside chunks.
    """

    offset: int
    size: int
    start_ns: int
    end_ns: int
    index_offset: int
    is_run: int


class _ChunkTable:
    """Chunks of a file, without an object for each: a file may have a million."""

    def __init__(self) -> None:
        self._values = array("Q")

    def __len__(self) -> int:
        return len(self._values) // len(_Chunk._fields)

    def add(self, chunk: _Chunk) -> None:
        """Append a chunk; one whose times cannot be right raises ValueError."""
        if len(self) >= MOST_CHUNKS:
            raise ValueError(f"it has more than {MOST_CHUNKS} chunks")
        if not chunk.start_ns <= chunk.end_ns <= LATEST_NS:
            raise ValueError("a chunk has times that cannot be right")
        self._values.extend(chunk)

    def rows(self) -> NDArray[np.uint64]:
        """(N, fields of a chunk) array."""
        return np.array(self._values, dtype=np.uint64).reshape(-1, len(_Chunk._fields))

    def in_order_of_time(self) -> NDArray[np.uint64]:
        """Rows in the order of their start; of those with one start in the order of the file."""
        rows = self.rows()
        return rows[np.argsort(rows[:, 2], kind="stable")]

    def check_apart(self, end: int) -> None:
        """Refuse chunks that share bytes of the file or end behind ``end``."""
        rows = self.rows()
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        ends = rows[:, 0] + rows[:, 1]
        is_apart = (ends[:-1] <= rows[1:, 0]).all() and (ends >= rows[:, 0]).all()
        if not is_apart or int(ends.max(initial=0)) > end:
            raise ValueError("its index names chunks that share bytes of the file")


class McapFile:
    """An mcap file opened for reading; a Storage.

    Parameters
    ----------
    path : pathlib.Path

    Attributes
    ----------
    channels : dict of int to Channel
    counts : dict of int to int
        Messages per channel.

    Raises
    ------
    ValueError
        If it is no mcap file or nothing in it can be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = open(path, "rb")  # noqa: SIM115 - closed by close()
        self.losses = Losses()
        try:
            self._size = self._file.seek(0, 2)
            if self._read(0, len(_MAGIC)) != _MAGIC:
                raise ValueError("it does not begin as an mcap file")
            self._open()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def topics(self) -> dict[str, tuple[str, int]]:
        """Message type and number of messages by topic."""
        topics: dict[str, tuple[str, int]] = {}
        for key, channel in self.channels.items():
            add_topic(topics, channel.topic, channel.type, self.counts.get(key, 0))
        return topics

    def _open(self) -> None:
        reason = ""
        try:
            self._clear()
            if self._read_summary():
                return
        except _MALFORMED as error:
            reason = str(error)
        self._clear()
        self._search(reason)

    def _clear(self) -> None:
        self.channels: dict[int, Channel] = {}
        self.counts: Counter[int] = Counter()
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        self._chunks = _ChunkTable()
        self._schemas: dict[int, str] = {}

    def _read(self, offset: int, size: int) -> bytes:
        """Read exactly these bytes."""
        if offset + size > self._size:
            raise EOFError(f"the file ends at byte {self._size}, in the middle of a record")
        self._file.seek(offset)
        return self._file.read(size)

    def _record_at(self, offset: int) -> tuple[int, int]:
        """Opcode and size of the body of the record at an offset."""
        opcode, size = _RECORD.unpack(self._read(offset, _RECORD.size))
        return opcode, size

    # ---- the index at the end

    def _read_summary(self) -> bool:
        """Read the index; False if the file is whole without one."""
        start = self._summary_start()
        if start == 0:
            return False
        offset, end, statistics = start, self._size - _FOOTER_SIZE, b""
        while offset < end:
            opcode, size = self._record_at(offset)
            if offset + _RECORD.size + size > end:
                raise ValueError("a record of the index does not fit")
            if opcode == _CHUNK_INDEX:
                head = self._read(offset + _RECORD.size, 32)
                start_ns, end_ns, chunk_offset, chunk_size = struct.unpack("<QQQQ", head)
                self._chunks.add(_Chunk(chunk_offset, chunk_size, start_ns, end_ns, offset, 0))
            elif opcode == _STATISTICS:
                statistics = self._description(offset, size)
            elif opcode in (_SCHEMA, _CHANNEL):
                self._note_channel(opcode, self._description(offset, size))
            offset += _RECORD.size + size
        if not len(self._chunks) or not statistics or not self.channels:
            return False
        self._chunks.check_apart(start)
        self._read_statistics(statistics)
        return True

    def _summary_start(self) -> int:
        if self._size < len(_MAGIC) + _FOOTER_SIZE:
            raise EOFError(f"the file ends at byte {self._size}, before its index")
        footer = self._read(self._size - _FOOTER_SIZE, _FOOTER_SIZE)
        if footer[-len(_MAGIC) :] != _MAGIC or _RECORD.unpack_from(footer) != (_FOOTER, 20):
            raise EOFError(f"the file ends at byte {self._size}, before its index")
        start: int = _UINT64.unpack_from(footer, _RECORD.size)[0]
        if start and not len(_MAGIC) <= start <= self._size - _FOOTER_SIZE:
            raise ValueError("the index is not where the file says")
        return start

    def _description(self, offset: int, size: int) -> bytes:
        """Body of a record that describes others."""
        if size > LARGEST_DESCRIPTION:
            raise ValueError(f"a description of {size} bytes is not believable")
        return self._read(offset + _RECORD.size, size)

    def _read_statistics(self, body: bytes) -> None:
        self.start_ns, self.end_ns = _ENTRY.unpack_from(body, 26)
        if not self.start_ns <= self.end_ns <= LATEST_NS:
            raise ValueError("the index has times that cannot be right")
        (size,) = _UINT32.unpack_from(body, 42)
        for position in range(46, 46 + size, 10):
            (key,) = _UINT16.unpack_from(body, position)
            (self.counts[key],) = _UINT64.unpack_from(body, position + 2)

    def _note_channel(self, opcode: int, body: Bytes) -> None:
        if opcode == _SCHEMA:
            (key,) = _UINT16.unpack_from(body)
            self._schemas[key] = _text(body, 2)[0]
        else:
            key, schema = struct.unpack_from("<HH", body)
            topic, position = _text(body, 4)
            encoding, _ = _text(body, position)
            self.channels[key] = Channel(topic, self._schemas.get(schema, ""), encoding)
        if max(len(self.channels), len(self._schemas)) > MOST_TOPICS:
            raise ValueError(f"it has more than {MOST_TOPICS} channels")

    # ---- searching a file that has no index

    def _search(self, reason: str) -> None:
        """Find channels and chunks record by record, as far as it goes."""
        searched, problem = self._search_records()
        rows = self._chunks.rows()
        if len(rows):
            self.start_ns, self.end_ns = int(rows[:, 2].min()), int(rows[:, 3].max())
        reason = problem or reason
        if not reason:
            return
        count = sum(self.counts.values())
        if not count:
            raise ValueError(f"{reason}, and nothing before that can be recovered")
        covers = f" covering {self._duration_s():.1f} s" if count > 1 else ""
        self.losses.add(
            f"{reason}; recovered are {count} messages{covers}, from the first "
            f"{searched / self._size:.0%} of its {self._size} bytes; what came later is lost"
        )

    def _duration_s(self) -> float:
        return ((self.end_ns or 0) - (self.start_ns or 0)) * 1e-9

    def _search_records(self) -> tuple[int, str]:
        """Note all records up to the first that is not whole: its offset, and what is wrong."""
        offset, run, budget = len(_MAGIC), _Run(), Budget(self._size)
        try:
            while offset < self._size:
                opcode, size = self._record_at(offset)
                if opcode in (_FOOTER, _DATA_END):
                    break
                end = offset + _RECORD.size + size
                if opcode == _CHUNK:
                    self._search_chunk(offset, size, budget)
                elif opcode == _MESSAGE:
                    head = self._read(offset + _RECORD.size, _MESSAGE_HEADER.size)
                    self._read(end - 1, 1)
                    key, _, log_ns, _ = _MESSAGE_HEADER.unpack(head)
                    self.counts[key] += 1
                    if not run.takes(offset, end):
                        run.finish(self._chunks)
                        run = _Run()
                    run.add(offset, end, log_ns)
                elif opcode in (_SCHEMA, _CHANNEL):
                    self._note_channel(opcode, self._description(offset, size))
                offset = end
        except _MALFORMED as error:
            run.finish(self._chunks)
            return offset, str(error)
        run.finish(self._chunks)
        return offset, ""

    def _search_chunk(self, offset: int, size: int, budget: Budget) -> None:
        """Note the records of a chunk; of one that is cut off, those that are whole."""
        first_ns, last_ns = LATEST_NS, -1
        end = offset + _RECORD.size + size
        try:
            for opcode, body in _chunk_records(self._content(offset, size, budget)):
                if opcode == _MESSAGE:
                    key, _, log_ns, _ = _MESSAGE_HEADER.unpack_from(body)
                    self.counts[key] += 1
                    if log_ns <= LATEST_NS:
                        first_ns, last_ns = min(first_ns, log_ns), max(last_ns, log_ns)
                elif opcode in (_SCHEMA, _CHANNEL):
                    self._note_channel(opcode, body)
        except ValueError as error:
            if end > self._size:
                raise
            self.losses.add(
                f"the chunk at byte {offset} is damaged ({error}); "
                "what follows the damage in it was left out"
            )
        finally:
            if last_ns >= 0:
                self._chunks.add(_Chunk(offset, _RECORD.size + size, first_ns, last_ns, 0, 0))
        if end > self._size:
            raise EOFError(f"the file ends at byte {self._size}, in the middle of a chunk")

    # ---- messages

    def messages(self, topics: Container[str]) -> Iterator[list[Message]]:
        """Iterate over the messages of some topics in the order of bag time, many at once.

        Raises
        ------
        ValueError
            If the messages are not CDR, or too many of them overlap in time.
        """
        kinds = {}
        for key, channel in self.channels.items():
            if channel.topic in topics:
                check_encoding(channel.topic, channel.encoding)
                kinds[key] = MessageKind(channel.topic, channel.type, False)
        rows, budget = self._chunks.in_order_of_time(), Budget(self._size)

        def read(index: int) -> list[Message]:
            return self._chunk_messages(_Chunk(*rows[index].tolist()), kinds, budget)

        return regrouped(in_order(rows[:, 2].tolist(), read))

    def _chunk_messages(
        self, chunk: _Chunk, kinds: dict[int, MessageKind], budget: Budget
    ) -> list[Message]:
        """Wanted messages of a chunk; what is damaged is noted and left out."""
        try:
            return self._wanted_messages(chunk, kinds, budget)
        except _MALFORMED as error:
            seconds = (chunk.end_ns - chunk.start_ns) * 1e-9
            self.losses.add(
                f"a chunk of {seconds:.1f} s at byte {chunk.offset} is damaged ({error}) "
                "and was left out"
            )
            return []

    def _wanted_messages(
        self, chunk: _Chunk, kinds: dict[int, MessageKind], budget: Budget
    ) -> list[Message]:
        if chunk.is_run:
            if chunk.size > _RUN_BYTES and not self._begins_with(chunk.offset, kinds):
                return []
            content = memoryview(self._read(chunk.offset, chunk.size))
            return self._selected(_records(content), kinds)
        offsets = self._index_offsets(chunk)
        wanted = offsets.keys() & kinds.keys()
        if offsets and not wanted:
            return []
        opcode, size = self._record_at(chunk.offset)
        if opcode != _CHUNK:
            raise ValueError("there is no chunk where one should be")
        if chunk.index_offset and _RECORD.size + size != chunk.size:
            raise ValueError("its size is not that of the index")
        is_partly_wanted = offsets and (offsets.keys() - wanted or size > LARGEST_CHUNK)
        if is_partly_wanted and self._is_plain(chunk.offset):
            return self._indexed_messages(chunk, {key: offsets[key] for key in wanted}, kinds)
        return self._selected(_chunk_records(self._content(chunk.offset, size, budget)), kinds)

    def _begins_with(self, offset: int, kinds: dict[int, MessageKind]) -> bool:
        """Whether the message at an offset is wanted."""
        (key,) = _UINT16.unpack(self._read(offset + _RECORD.size, _UINT16.size))
        return key in kinds

    def _selected(
        self, records: Iterator[tuple[int, memoryview]], kinds: dict[int, MessageKind]
    ) -> list[Message]:
        """Wanted messages among records, copied, so that the chunk can be dropped."""
        found: list[Message] = []
        unpack_header, header_size = _MESSAGE_HEADER.unpack_from, _MESSAGE_HEADER.size
        for opcode, body in records:
            if opcode == _MESSAGE:
                key, _, log_ns, _ = unpack_header(body)
                if key in kinds:
                    self._append(found, kinds[key], log_ns, bytes(body[header_size:]))
        return found

    def _append(self, found: list[Message], kind: MessageKind, log_ns: int, data: bytes) -> None:
        if log_ns > LATEST_NS:
            self.losses.add(f"{kind.topic}: a message of time {log_ns} ns was left out")
        elif len(data) > LARGEST_MESSAGE:
            self.losses.add(f"{kind.topic}: a message of {len(data)} bytes was left out")
        else:
            found.append((kind, log_ns, data))

    def _index_offsets(self, chunk: _Chunk) -> dict[int, int]:
        """Where the message index of each channel of a chunk is; empty if that is not known."""
        if not chunk.index_offset:
            return {}
        _, size = self._record_at(chunk.index_offset)
        body = self._description(chunk.index_offset, size)
        (size,) = _UINT32.unpack_from(body, 32)
        if 36 + size > len(body):
            raise ValueError("its index does not fit")
        return dict(struct.iter_unpack("<HQ", body[36 : 36 + size]))

    def _is_plain(self, offset: int) -> bool:
        """Whether the chunk is not compressed."""
        return self._read(offset + _RECORD.size + _CHUNK_HEADER.size, 4) == b"\0\0\0\0"

    def _indexed_messages(
        self, chunk: _Chunk, offsets: dict[int, int], kinds: dict[int, MessageKind]
    ) -> list[Message]:
        """Wanted messages of a chunk that is not compressed; images may fill the rest."""
        found: list[Message] = []
        start, end = (
            chunk.offset + _RECORD.size + _CHUNK_HEADER.size + 12,
            chunk.offset + chunk.size,
        )
        # Messages do not overlap: what an index names more than once does not fit.
        left = min(end - start, LARGEST_CHUNK)
        for key, position in offsets.items():
            for log_ns, offset in self._index_entries(key, position, left // _SMALLEST_MESSAGE):
                opcode, size = self._record_at(start + offset)
                left -= _RECORD.size + size
                if left < 0 or start + offset + _RECORD.size + size > end:
                    raise ValueError("its index leads to more messages than fit")
                head = self._read(start + offset + _RECORD.size, _MESSAGE_HEADER.size)
                if opcode != _MESSAGE or _UINT16.unpack_from(head)[0] != key:
                    raise ValueError("its index does not lead to messages")
                data = self._file.read(size - _MESSAGE_HEADER.size)
                self._append(found, kinds[key], log_ns, data)
        return found

    def _index_entries(self, key: int, position: int, most: int) -> Iterator[tuple[int, int]]:
        """Log time and offset of the messages of a channel in a chunk."""
        opcode, size = self._record_at(position)
        if opcode != _MESSAGE_INDEX or size < 6 or (size - 6) % _ENTRY.size:
            raise ValueError("its index is not readable")
        if size // _ENTRY.size > min(most, MOST_MESSAGES_PER_CHUNK):
            raise ValueError("its index leads to more messages than fit")
        index = self._read(position + _RECORD.size, size)
        if _UINT16.unpack_from(index)[0] != key:
            raise ValueError("its index is of another channel")
        return _ENTRY.iter_unpack(index[6:])

    def _content(self, offset: int, size: int, budget: Budget) -> tuple[memoryview, bool]:
        """Records of a chunk, and whether they are all; of a plain one that the file cuts off,
        what is there.
        """
        available = min(size, self._size - offset - _RECORD.size)
        if available > LARGEST_CHUNK:
            raise ValueError(f"a chunk of {size} bytes is larger than {LARGEST_CHUNK}")
        data = memoryview(self._read(offset + _RECORD.size, available))
        _, _, unpacked_size, crc = _CHUNK_HEADER.unpack_from(data)
        compression, position = _text(data, _CHUNK_HEADER.size)
        (compressed_size,) = _UINT64.unpack_from(data, position)
        content = data[position + 8 : position + 8 + compressed_size]
        is_whole = len(content) == compressed_size
        if compression == "":
            if is_whole:
                _check_content(content, unpacked_size, crc)
            return content, is_whole
        if not is_whole:
            raise EOFError(f"the file ends at byte {self._size}, in the middle of a chunk")
        if unpacked_size > LARGEST_CHUNK:
            raise ValueError(f"a chunk of {unpacked_size} bytes is larger than {LARGEST_CHUNK}")
        unpacked = unpack(content, compression, unpacked_size, budget)
        _check_content(unpacked, unpacked_size, crc)
        return memoryview(unpacked), True


class _Run:
    """Messages outside chunks that follow one another, while they are being found."""

    def __init__(self) -> None:
        self._start = self._end = 0
        self._first_ns, self._last_ns = LATEST_NS, -1

    def takes(self, offset: int, end: int) -> bool:
        """Whether a message belongs to the run."""
        return offset == self._end and end - self._start <= _RUN_BYTES

    def add(self, offset: int, end: int, log_ns: int) -> None:
        """Add a message."""
        self._start = self._start or offset
        self._end = end
        if log_ns <= LATEST_NS:
            self._first_ns, self._last_ns = min(self._first_ns, log_ns), max(self._last_ns, log_ns)

    def finish(self, chunks: _ChunkTable) -> None:
        """Add the run to the chunks."""
        if self._last_ns >= 0:
            size = self._end - self._start
            chunks.add(_Chunk(self._start, size, self._first_ns, self._last_ns, 0, 1))


def _check_content(content: Bytes, size: int, crc: int) -> None:
    if len(content) != size:
        raise ValueError(f"it has {len(content)} bytes, expected {size}")
    if crc and zlib.crc32(content) != crc:
        raise ValueError("its checksum is wrong")


def _chunk_records(content: tuple[memoryview, bool]) -> Iterator[tuple[int, memoryview]]:
    """Opcode and body of the records of a chunk."""
    records, is_whole = content
    n_messages = 0
    for opcode, body in _records(records, may_end_early=not is_whole):
        n_messages += opcode == _MESSAGE
        if opcode not in (_MESSAGE, _SCHEMA, _CHANNEL):
            raise ValueError(f"it has a record of kind {opcode}")
        if n_messages > MOST_MESSAGES_PER_CHUNK:
            raise ValueError(f"it has more than {MOST_MESSAGES_PER_CHUNK} messages")
        yield opcode, body


def _records(data: memoryview, may_end_early: bool = False) -> Iterator[tuple[int, memoryview]]:
    """Opcode and body of records that follow one another."""
    position, end, unpack_head = 0, len(data), _RECORD.unpack_from
    while position + _RECORD.size <= end:
        opcode, size = unpack_head(data, position)
        start = position + _RECORD.size
        position = start + size
        if position > end:
            break
        yield opcode, data[start:position]
    if position != end and not may_end_early:
        raise ValueError("a record does not fit")


def _text(data: Bytes, position: int) -> tuple[str, int]:
    """A text without control characters, and where it ends."""
    (size,) = _UINT32.unpack_from(data, position)
    end = position + 4 + size
    if end > len(data):
        raise ValueError("a text does not fit into its record")
    if size > LONGEST_NAME:
        raise ValueError(f"a name of {size} bytes is longer than {LONGEST_NAME}")
    return printable(str(data[position + 4 : end], "utf-8")), end
