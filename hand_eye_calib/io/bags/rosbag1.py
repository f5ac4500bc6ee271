"""rosbag1 files, version 2.0. The format: https://wiki.ros.org/Bags/Format/2.0"""

import struct
from array import array
from collections import Counter
from collections.abc import Container, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hand_eye_calib.errors import printable
from hand_eye_calib.io.bags.blocks import Message, MessageKind, regrouped
from hand_eye_calib.io.bags.decompression import Budget, unpack
from hand_eye_calib.io.bags.storage import LATEST_NS, Losses, add_topic, in_order
from hand_eye_calib.io.limits import (
    LARGEST_CHUNK,
    LARGEST_DESCRIPTION,
    LARGEST_MESSAGE,
    LONGEST_NAME,
    MOST_CHUNKS,
    MOST_MESSAGES_PER_CHUNK,
    MOST_TOPICS,
)

_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 5, 6, 7
_COMPRESSIONS = {"none": "", "bz2": "bz2", "lz4": "lz4"}

_UINT32, _UINT64, _TIME = struct.Struct("<I"), struct.Struct("<Q"), struct.Struct("<II")
_NS_PER_S = 1_000_000_000

# What parsing bytes that are not what they should be may raise.
_MALFORMED = (struct.error, ValueError, LookupError, EOFError)

Buffer = bytes | memoryview


class _Chunk(NamedTuple):
    """A chunk as the index describes it.

    Attributes
    ----------
    offset, limit : int
        Where its record begins, and where it must have ended.
    start_ns, end_ns : int
        The bag time it covers.
    info_offset, n_connections : int
        Where the index has its numbers of messages, and how many there are.
    """

    offset: int
    limit: int
    start_ns: int
    end_ns: int
    info_offset: int
    n_connections: int


class _Connection(NamedTuple):
    """A publisher's connection."""

    topic: str
    type: str


class Rosbag1File:
    """A rosbag1 file opened for reading; a Storage.

    Parameters
    ----------
    path : pathlib.Path

    Raises
    ------
    ValueError, LookupError, EOFError, struct.error
        If it is no such file, or has no index.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.losses = path, Losses()
        self._file = open(path, "rb")  # noqa: SIM115 - closed by close()
        try:
            self._size = self._file.seek(0, 2)
            self._open()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read(self, offset: int, size: int) -> bytes:
        """Read exactly these bytes."""
        if offset + size > self._size:
            raise EOFError(f"the file ends at byte {self._size}, in the middle of a record")
        self._file.seek(offset)
        return self._file.read(size)

    def _head(self, offset: int, kind: int) -> tuple[dict[str, bytes], int, int]:
        """Header of a record, and where its data begins and ends."""
        (size,) = _UINT32.unpack(self._read(offset, 4))
        if size > LARGEST_DESCRIPTION:
            raise ValueError(f"a header of {size} bytes is not believable")
        fields = _fields(self._read(offset + 4, size))
        if fields["op"] != bytes([kind]):
            raise ValueError(f"there is no record of kind {kind} where one should be")
        start = offset + 8 + size
        (data_size,) = _UINT32.unpack(self._read(start - 4, 4))
        if start + data_size > self._size:
            raise EOFError(f"the file ends at byte {self._size}, in the middle of a record")
        return fields, start, start + data_size

    # ---- the index

    def _open(self) -> None:
        if self._read(0, len(_MAGIC)) != _MAGIC:
            raise ValueError("it does not begin as a rosbag1 file of version 2.0")
        fields, _, _ = self._head(len(_MAGIC), _BAG)
        if fields.get("encryptor"):
            raise ValueError("it is encrypted")
        offset = _uint64(fields["index_pos"])
        if offset == 0:
            raise ValueError("it has no index")
        self._connections: dict[int, _Connection] = {}
        for _ in range(min(_uint32(fields["conn_count"]), MOST_TOPICS + 1)):
            offset = self._read_connection(offset)
        if len(self._connections) > MOST_TOPICS:
            raise ValueError(f"it has more than {MOST_TOPICS} connections")
        self._read_chunk_infos(offset, _uint32(fields["chunk_count"]))
        self.topics: dict[str, tuple[str, int]] = {}
        for key, connection in self._connections.items():
            add_topic(self.topics, connection.topic, connection.type, self._counts[key])

    def _read_connection(self, offset: int) -> int:
        """Note a connection; returns where its record ends."""
        fields, start, end = self._head(offset, _CONNECTION)
        if end - start > LARGEST_DESCRIPTION:
            raise ValueError(f"a description of {end - start} bytes is not believable")
        described = _fields(self._read(start, end - start))
        topic, message_type = _text(fields["topic"]), _text(described["type"])
        names = [name for name in topic.split("/") if name]
        self._connections[_uint32(fields["conn"])] = _Connection(
            "/" * topic.startswith("/") + "/".join(names), _ros2_type(message_type)
        )
        return end

    def _read_chunk_infos(self, offset: int, count: int) -> None:
        if count > MOST_CHUNKS:
            raise ValueError(f"it has more than {MOST_CHUNKS} chunks")
        self._counts: Counter[int] = Counter()
        values = array("Q")
        for _ in range(count):
            fields, start, end = self._head(offset, _CHUNK_INFO)
            n_connections = _uint32(fields["count"])
            if fields["ver"] != _UINT32.pack(1) or end - start != 8 * n_connections:
                raise ValueError("its index is not readable")
            if n_connections > MOST_TOPICS:
                raise ValueError(f"a chunk has more than {MOST_TOPICS} connections")
            self._counts.update(self._chunk_counts(start, n_connections))
            times = _time_ns(fields["start_time"]), _time_ns(fields["end_time"])
            values.extend((_uint64(fields["chunk_pos"]), 0, *times, start, n_connections))
            offset = end
        rows = np.array(values, dtype=np.uint64).reshape(-1, len(_Chunk._fields))
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        rows[:, 1] = [*rows[1:, 0].tolist(), self._size][: len(rows)]
        if (rows[:, 1] <= rows[:, 0]).any():
            raise ValueError("its index names a chunk more than once or outside the file")
        has_messages = rows[rows[:, 5] > 0]
        self._chunks = has_messages[np.argsort(has_messages[:, 2], kind="stable")]
        self.start_ns = int(self._chunks[:, 2].min()) if len(self._chunks) else None
        self.end_ns = int(self._chunks[:, 3].max()) if len(self._chunks) else None

    def _chunk_counts(self, offset: int, n_connections: int) -> dict[int, int]:
        """Number of messages by connection, as the index says it of a chunk."""
        return dict(struct.iter_unpack("<II", self._read(offset, 8 * n_connections)))

    # ---- messages

    def messages(self, topics: Container[str]) -> Iterator[list[Message]]:
        """Iterate over the messages of some topics in the order of bag time, many at once.

        Raises
        ------
        ValueError
            If too many messages overlap in time.
        """
        kinds = {
            key: MessageKind(connection.topic, connection.type, True)
            for key, connection in self._connections.items()
            if connection.topic in topics
        }
        budget = Budget(self._size)

        def read(index: int) -> list[Message]:
            return self._chunk_messages(_Chunk(*self._chunks[index].tolist()), kinds, budget)

        return regrouped(in_order(self._chunks[:, 2].tolist(), read))

    def _chunk_messages(
        self, chunk: _Chunk, kinds: dict[int, MessageKind], budget: Budget
    ) -> list[Message]:
        """Wanted messages of a chunk; what is damaged is noted and left out."""
        try:
            counts = self._chunk_counts(chunk.info_offset, chunk.n_connections)
            if not counts.keys() & kinds.keys():
                return []
            found, found_counts = self._wanted_messages(self._content(chunk, budget), kinds)
            if found_counts != counts:
                raise ValueError("it does not have the messages that the index says")
            return found
        except _MALFORMED as error:
            seconds = (chunk.end_ns - chunk.start_ns) * 1e-9
            self.losses.add(
                f"a chunk of {seconds:.1f} s at byte {chunk.offset} is damaged ({error}) "
                "and was left out"
            )
            return []

    def _content(self, chunk: _Chunk, budget: Budget) -> memoryview:
        fields, start, end = self._head(chunk.offset, _CHUNK)
        size, compression = _uint32(fields["size"]), _COMPRESSIONS[_text(fields["compression"])]
        if end > chunk.limit:
            raise ValueError("it reaches into the next chunk")
        if max(size, end - start) > LARGEST_CHUNK:
            raise ValueError(f"{max(size, end - start)} bytes are more than {LARGEST_CHUNK}")
        content = self._read(start, end - start)
        content = unpack(content, compression, size, budget) if compression else content
        if len(content) != size:
            raise ValueError(f"it has {len(content)} bytes, expected {size}")
        return memoryview(content)

    def _wanted_messages(
        self, data: memoryview, kinds: dict[int, MessageKind]
    ) -> tuple[list[Message], Counter[int]]:
        """Wanted messages, and how many there are of each connection."""
        found: list[Message] = []
        counts: Counter[int] = Counter()
        layout: _MessageHead | None = None
        position, end, uint32 = 0, len(data), _UINT32.unpack_from
        while position < end:
            head = bytes(data[position + 4 : position + 4 + uint32(data, position)[0]])
            start = position + 8 + len(head)
            position = start + uint32(data, start - 4)[0]
            if position > end:
                raise ValueError("a record does not fit")
            if layout is None or not layout.fits(head):
                if _fields(head)["op"] == bytes([_CONNECTION]):
                    continue
                layout = _MessageHead(head)
            key, bag_ns = layout.read(head)
            counts[key] += 1
            if counts[key] > MOST_MESSAGES_PER_CHUNK:
                raise ValueError(f"it has more than {MOST_MESSAGES_PER_CHUNK} messages of a topic")
            if key in kinds:
                self._append(found, kinds[key], bag_ns, bytes(data[start:position]))
        return found, counts

    def _append(self, found: list[Message], kind: MessageKind, bag_ns: int, data: bytes) -> None:
        if len(data) > LARGEST_MESSAGE:
            self.losses.add(f"{kind.topic}: a message of {len(data)} bytes was left out")
        else:
            found.append((kind, bag_ns, data))


class _MessageHead:
    """Where connection and time are in the headers of messages, which are nearly all alike.

    Parameters
    ----------
    head : bytes
        The first of such headers.
    """

    def __init__(self, head: bytes) -> None:
        fields = _fields(head)
        if fields["op"] != bytes([_MESSAGE]) or (len(fields["conn"]), len(fields["time"])) != (
            4,
            8,
        ):
            raise ValueError("a message has no readable header")
        self._conn, self._time = (
            head.index(_UINT32.pack(5 + len(fields[name])) + name.encode() + b"=") + 9
            for name in ("conn", "time")
        )
        self._size, self._rest = len(head), self._without_values(head)

    def _without_values(self, head: bytes) -> bytes:
        if self._conn < self._time:
            between = head[self._conn + 4 : self._time]
            return head[: self._conn] + between + head[self._time + 8 :]
        between = head[self._time + 8 : self._conn]
        return head[: self._time] + between + head[self._conn + 4 :]

    def fits(self, head: bytes) -> bool:
        """Whether a header is like the first one, but for its values."""
        return len(head) == self._size and self._without_values(head) == self._rest

    def read(self, head: bytes) -> tuple[int, int]:
        """Connection and time in ns."""
        seconds, nanoseconds = _TIME.unpack_from(head, self._time)
        return _UINT32.unpack_from(head, self._conn)[0], seconds * _NS_PER_S + nanoseconds


def _fields(head: bytes) -> dict[str, bytes]:
    """Fields of a header by name."""
    fields, position = {}, 0
    while position < len(head):
        (size,) = _UINT32.unpack_from(head, position)
        position += 4 + size
        name, separator, value = head[position - size : position].partition(b"=")
        if position > len(head) or not separator:
            raise ValueError("a header is not readable")
        fields[str(name, "ascii", "replace")] = value
    return fields


def _uint32(value: bytes) -> int:
    return int(_UINT32.unpack(value)[0])


def _uint64(value: bytes) -> int:
    number = int(_UINT64.unpack(value)[0])
    if number > LATEST_NS:
        raise ValueError("an offset is not believable")
    return number


def _time_ns(value: bytes) -> int:
    seconds, nanoseconds = _TIME.unpack(value)
    return int(seconds * _NS_PER_S + nanoseconds)


def _text(value: bytes) -> str:
    if len(value) > LONGEST_NAME:
        raise ValueError(f"a name of {len(value)} bytes is longer than {LONGEST_NAME}")
    return printable(value.decode())


def _ros2_type(name: str) -> str:
    """``nav_msgs/Odometry`` as ROS 2 writes it: ``nav_msgs/msg/Odometry``."""
    package, _, rest = name.partition("/")
    return name if rest.startswith("msg/") else f"{package}/msg/{rest}"
