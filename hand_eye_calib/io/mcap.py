"""Reading mcap files: those that are whole, those that end in the middle, and those with damaged
chunks.

Only records of the topics that are asked for are looked at. Where a file has an index, the bytes of
other topics - camera images - are not even read; where it has none, because the recorder never came
to write it, everything up to the last whole record is found by walking through the file. The
format: https://mcap.dev/spec
"""

import struct
from bisect import bisect_left
from collections import Counter
from typing import NamedTuple

_MAGIC = b"\x89MCAP0\r\n"
(
    _FOOTER,
    _SCHEMA,
    _CHANNEL,
    _MESSAGE,
    _CHUNK,
    _MESSAGE_INDEX,
    _CHUNK_INDEX,
    _STATISTICS,
    _DATA_END,
) = 2, 3, 4, 5, 6, 7, 8, 11, 15
_FOOTER_SIZE = 9 + 20 + len(_MAGIC)

_RECORD = struct.Struct("<BQ")  # opcode, length
_MESSAGE_HEADER = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK_HEADER = struct.Struct("<QQQI")  # start, end, uncompressed size, checksum
_UINT16, _UINT32, _UINT64 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")
_ENTRY = struct.Struct("<QQ")

# No chunk of a recorder is larger; a size beyond it is damage, and must not be believed and
# allocated.
_LARGEST_CHUNK = 1 << 31

# What parsing bytes that are not what they should be may raise.
_MALFORMED = (struct.error, ValueError, IndexError, EOFError)


class Channel(NamedTuple):
    """A topic's channel: its name, message type and how its messages are encoded."""

    topic: str
    type: str
    encoding: str


class _Chunk(NamedTuple):
    """Where a chunk's record begins, the time it covers, and for an indexed one where each
    channel's message index is.
    """

    offset: int
    start_ns: int
    end_ns: int
    index_offsets: dict


class McapFile:
    """An mcap file opened for reading.

    Parameters
    ----------
    path : pathlib.Path
    decompress : callable
        ``(data, compression, size, crc) -> bytes`` of a chunk; raises where it is damaged.

    Attributes
    ----------
    channels : dict of int to Channel
    counts : dict of int to int
        Messages per channel.
    start_ns, end_ns : int or None
        Bag time of the first and last message.
    losses : list of str
        What could not be read, for a person; grows while reading.

    Raises
    ------
    ValueError
        Where it is no mcap file at all or nothing in it can be read.
    """

    def __init__(self, path, decompress):
        self._decompress = decompress
        self._file = open(path, "rb")  # noqa: SIM115 - closed by close()
        self.channels, self.counts, self.losses = {}, Counter(), []
        self.start_ns = self.end_ns = None
        self._chunks, self._loose = [], False
        try:
            self._size = self._file.seek(0, 2)
            if self._read(0, len(_MAGIC)) != _MAGIC:
                raise ValueError("it does not begin as an mcap file")
            self._open()
        except BaseException:
            self.close()
            raise

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        """Close the file."""
        self._file.close()

    def _open(self):
        try:
            if self._read_summary():
                return
            reason = ""
        except _MALFORMED as error:
            reason = str(error)
        self.channels, self.counts, self._chunks = {}, Counter(), []
        self._walk(reason)

    def _read(self, offset, size):
        """Exactly these bytes."""
        if offset + size > self._size:
            raise EOFError(f"the file ends at byte {self._size}, in the middle of a record")
        self._file.seek(offset)
        return self._file.read(size)

    # ---- the index at the end

    def _read_summary(self):
        """Whether there is one that can be used; a file that is whole need not have one."""
        if self._size < len(_MAGIC) + _FOOTER_SIZE:
            raise EOFError(f"the file ends at byte {self._size}, before its index")
        footer = self._read(self._size - _FOOTER_SIZE, _FOOTER_SIZE)
        if footer[-len(_MAGIC) :] != _MAGIC or _RECORD.unpack_from(footer) != (_FOOTER, 20):
            raise EOFError(f"the file ends at byte {self._size}, before its index")
        (start,) = _UINT64.unpack_from(footer, _RECORD.size)
        if start == 0:
            return False
        if not len(_MAGIC) <= start <= self._size - _FOOTER_SIZE:
            raise ValueError("the index is not where the file says")
        schemas, statistics = {}, None
        for opcode, body in _records(
            memoryview(self._read(start, self._size - _FOOTER_SIZE - start))
        ):
            if opcode == _CHUNK_INDEX:
                self._chunks.append(_chunk_index(body))
            elif opcode == _STATISTICS:
                statistics = body
            else:
                self._note_channel(opcode, body, schemas)
        if not self._chunks or statistics is None or not self.channels:
            return False
        self.start_ns, self.end_ns = _ENTRY.unpack_from(statistics, 26)
        (size,) = _UINT32.unpack_from(statistics, 42)
        for position in range(46, 46 + size, 10):
            self.counts[_UINT16.unpack_from(statistics, position)[0]] = _UINT64.unpack_from(
                statistics, position + 2
            )[0]
        return True

    def _note_channel(self, opcode, body, schemas):
        if opcode == _SCHEMA:
            (key,) = _UINT16.unpack_from(body)
            schemas[key] = _string(body, 2)[0]
        elif opcode == _CHANNEL:
            key, schema = struct.unpack_from("<HH", body)
            topic, position = _string(body, 4)
            encoding, _ = _string(body, position)
            self.channels[key] = Channel(topic, schemas.get(schema, ""), encoding)

    # ---- walking through a file that has no index

    def _walk(self, reason):
        """Find channels and chunks record by record, as far as it goes."""
        schemas, offset, times = {}, len(_MAGIC), []
        first_lost, lost_because = None, ""
        while offset < self._size:
            try:
                opcode, size = _RECORD.unpack(self._read(offset, _RECORD.size))
                if opcode in (_FOOTER, _DATA_END):
                    break
                if opcode == _CHUNK:
                    self._walk_chunk(offset, size, schemas, times)
                elif opcode == _MESSAGE:
                    channel, _, log_ns, _ = _MESSAGE_HEADER.unpack(
                        self._read(offset + _RECORD.size, _MESSAGE_HEADER.size)
                    )
                    self._read(offset + _RECORD.size + size - 1, 1)
                    self._loose = True
                    self.counts[channel] += 1
                    times.append(log_ns)
                elif opcode in (_SCHEMA, _CHANNEL):
                    self._note_channel(
                        opcode, memoryview(self._read(offset + _RECORD.size, size)), schemas
                    )
            except _MALFORMED as error:
                first_lost, lost_because = offset, str(error)
                break
            offset += _RECORD.size + size
        self.start_ns, self.end_ns = (min(times), max(times)) if times else (None, None)
        reason = lost_because or reason
        if reason:
            count, share = sum(self.counts.values()), (first_lost or offset) / self._size
            if not count:
                raise ValueError(f"{reason}, and nothing before that can be recovered")
            covers = f" covering {(self.end_ns - self.start_ns) * 1e-9:.1f} s" if count > 1 else ""
            self.losses.append(
                f"{reason}; recovered are {count} messages{covers}, from the first {share:.0%} of its {self._size} bytes; what came later is lost"
            )

    def _walk_chunk(self, offset, size, schemas, times):
        """The records of a chunk; of one that is cut off, those that are whole."""
        end = offset + _RECORD.size + size
        before = len(times)
        chunk = _Chunk(offset, 0, 0, {})
        try:
            for opcode, body in self._chunk_records(chunk):
                if opcode == _MESSAGE:
                    channel, _, log_ns, _ = _MESSAGE_HEADER.unpack_from(body)
                    self.counts[channel] += 1
                    times.append(log_ns)
                else:
                    self._note_channel(opcode, body, schemas)
        except ValueError as error:
            if end > self._size:
                raise
            self.losses.append(
                f"the chunk at byte {offset} is damaged ({error}); what follows the damage in it was left out"
            )
        inside = times[before:]
        if inside:
            self._chunks.append(chunk._replace(start_ns=min(inside), end_ns=max(inside)))
        if end > self._size:
            raise EOFError(f"the file ends at byte {self._size}, in the middle of a chunk")

    # ---- messages

    def messages(self, topics):
        """Iterate over lists of (channel, bag time in ns, message) of some topics; all in the order
        of bag time.
        """
        wanted = {key: channel for key, channel in self.channels.items() if channel.topic in topics}
        chunks = [
            chunk
            for chunk in self._chunks
            if not chunk.index_offsets or chunk.index_offsets.keys() & wanted.keys()
        ]
        chunks.sort(key=lambda chunk: chunk.start_ns)
        waiting = self._loose_messages(wanted) if self._loose else []
        # Chunks may overlap in time: of what has been read, only that which no later chunk can
        # precede is passed on.
        for chunk in chunks:
            split = bisect_left(waiting, chunk.start_ns, key=_log_time)
            if split:
                yield waiting[:split]
            waiting = waiting[split:] + self._chunk_messages(chunk, wanted)
            waiting.sort(key=_log_time)
        if waiting:
            yield waiting

    def _loose_messages(self, wanted):
        """Messages outside chunks."""
        offset, found = len(_MAGIC), []
        while offset + _RECORD.size <= self._size:
            opcode, size = _RECORD.unpack(self._read(offset, _RECORD.size))
            if opcode in (_FOOTER, _DATA_END) or offset + _RECORD.size + size > self._size:
                break
            if opcode == _MESSAGE:
                body = offset + _RECORD.size
                channel, _, log_ns, _ = _MESSAGE_HEADER.unpack(
                    self._read(body, _MESSAGE_HEADER.size)
                )
                if channel in wanted:
                    data = self._read(body + _MESSAGE_HEADER.size, size - _MESSAGE_HEADER.size)
                    found.append((wanted[channel], log_ns, data))
            offset += _RECORD.size + size
        return sorted(found, key=_log_time)

    def _chunk_messages(self, chunk, wanted):
        """A list of (channel, bag time, message); what is damaged is noted and left out."""
        try:
            if chunk.index_offsets.keys() - wanted.keys() and self._is_plain(chunk):
                return list(self._indexed_messages(chunk, wanted))
            found = []
            unpack, size = _MESSAGE_HEADER.unpack_from, _MESSAGE_HEADER.size
            for opcode, body in self._chunk_records(chunk):
                if opcode == _MESSAGE:
                    key, _, log_ns, _ = unpack(body)
                    if key in wanted:
                        # Copied, so that the rest of the chunk can be let go.
                        found.append((wanted[key], log_ns, bytes(body[size:])))
            return found
        except _MALFORMED as error:
            seconds = (chunk.end_ns - chunk.start_ns) * 1e-9
            self.losses.append(
                f"a chunk of {seconds:.1f} s at byte {chunk.offset} is damaged ({error}) and was left out"
            )
            return []

    def _is_plain(self, chunk):
        """Whether the chunk is not compressed."""
        return self._read(chunk.offset + _RECORD.size + _CHUNK_HEADER.size, 4) == b"\0\0\0\0"

    def _indexed_messages(self, chunk, wanted):
        """Only the wanted bytes of a chunk that is not compressed: images may fill the rest."""
        start = chunk.offset + _RECORD.size + _CHUNK_HEADER.size + 4 + 8
        for key in chunk.index_offsets.keys() & wanted.keys():
            position = chunk.index_offsets[key]
            opcode, size = _RECORD.unpack(self._read(position, _RECORD.size))
            index = self._read(position + _RECORD.size, size) if size < _LARGEST_CHUNK else b""
            if (
                opcode != _MESSAGE_INDEX
                or size < 6
                or (size - 6) % _ENTRY.size
                or _UINT16.unpack_from(index)[0] != key
            ):
                raise ValueError("its index is not readable")
            for log_ns, offset in _ENTRY.iter_unpack(index[6:]):
                opcode, size = _RECORD.unpack(self._read(start + offset, _RECORD.size))
                header = self._read(start + offset + _RECORD.size, _MESSAGE_HEADER.size)
                if (
                    opcode != _MESSAGE
                    or _MESSAGE_HEADER.unpack(header)[0] != key
                    or size > _LARGEST_CHUNK
                ):
                    raise ValueError("its index does not lead to messages")
                yield wanted[key], log_ns, self._file.read(size - _MESSAGE_HEADER.size)

    def _chunk_records(self, chunk):
        """Opcode and body of each record in a chunk. One that the file cuts off gives what is
        whole, if it is not compressed.
        """
        opcode, size = _RECORD.unpack(self._read(chunk.offset, _RECORD.size))
        if opcode != _CHUNK or size > _LARGEST_CHUNK:
            raise ValueError("there is no chunk where one should be")
        available = min(size, self._size - chunk.offset - _RECORD.size)
        data = memoryview(self._read(chunk.offset + _RECORD.size, available))
        _, _, uncompressed_size, crc = _CHUNK_HEADER.unpack_from(data)
        compression, position = _string(data, _CHUNK_HEADER.size)
        (compressed_size,) = _UINT64.unpack_from(data, position)
        content = data[position + 8 : position + 8 + compressed_size]
        if len(content) == compressed_size:
            if uncompressed_size > _LARGEST_CHUNK:
                raise ValueError(f"a chunk of {uncompressed_size} bytes is not believable")
            yield from _records(
                memoryview(self._decompressed(bytes(content), compression, uncompressed_size, crc))
            )
        elif compression == "":
            yield from _records(content, may_end_early=True)
        else:
            raise EOFError(
                f"the file ends at byte {self._size}, in the middle of a compressed chunk"
            )

    def _decompressed(self, content, compression, size, crc):
        # The libraries raise errors of their own kinds; nothing but their code runs here.
        try:
            return self._decompress(content, compression, size, crc)
        except Exception as error:
            raise ValueError(" ".join(str(error).split()) or type(error).__name__) from error


def _log_time(message):
    return message[1]


def _records(data, may_end_early=False):
    """Opcode and body of each of the records that follow one another."""
    position, end, unpack = 0, len(data), _RECORD.unpack_from
    while position + _RECORD.size <= end:
        opcode, size = unpack(data, position)
        start = position + _RECORD.size
        position = start + size
        if position > end:
            break
        yield opcode, data[start:position]
    if position != end and not may_end_early:
        raise ValueError("a record does not fit")


def _string(data, position):
    """Text and where it ends."""
    (size,) = _UINT32.unpack_from(data, position)
    end = position + 4 + size
    if end > len(data):
        raise ValueError("a text does not fit into its record")
    return str(data[position + 4 : end], "utf-8"), end


def _chunk_index(body):
    start_ns, end_ns, offset, _ = struct.unpack_from("<QQQQ", body)
    (size,) = _UINT32.unpack_from(body, 32)
    if 36 + size > len(body):
        raise ValueError("a chunk's index does not fit")
    offsets = dict(struct.iter_unpack("<HQ", body[36 : 36 + size]))
    return _Chunk(offset, start_ns, end_ns, offsets)
