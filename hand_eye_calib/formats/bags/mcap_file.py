"""Read an mcap file through the library mcap."""

import struct
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, suppress
from io import BufferedReader, BytesIO
from operator import attrgetter, itemgetter
from typing import Any

from mcap import records, stream_reader
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from hand_eye_calib.formats import files
from hand_eye_calib.formats.bags.storage import (
    DamageError,
    Message,
    MessageKind,
    Span,
    Storage,
    kind_of,
    reason_of,
)

# Header of a record in an mcap file: opcode (uint8) and length of the content in bytes (uint64).
_RECORD = struct.Struct("<BQ")
# Header of a message: channel (uint16) and log time in ns (uint64). The sequence number (4 bytes)
# and the publish time (8 bytes) are skipped.
_MESSAGE = struct.Struct("<H4xQ8x")
# Schema for a channel without a schema; some channels with JSON have none.
_NO_SCHEMA = records.Schema(id=0, name="", encoding="", data=b"")


class McapFile(Storage):
    """An .mcap file, read by the library mcap.

    An intact file is read with its index. From a damaged file, all records before the damage are
    read, including the first records of a chunk whose end is missing.
    """

    def _open(self, opened: ExitStack) -> None:
        self._stream = _WholeReads(
            opened.enter_context(self._file.open("rb", buffering=0))
        )
        # Indexes of the chunks, sorted by time. The list is empty if the file has no usable index.
        self._chunks: list[Any] = []
        try:
            summary = self._checked_summary()
        except MemoryError:
            raise
        except Exception as error:
            self._scan(error)
            return
        statistics = summary.statistics
        self._chunks = sorted(
            summary.chunk_indexes, key=attrgetter("message_start_time")
        )
        for key, channel in summary.channels.items():
            self._add_kind(channel, summary.schemas)
            self.counts[self._kinds[key]] += (
                statistics.channel_message_counts.get(key, 0)
            )
        if statistics.message_count:
            self.span_ns = (
                statistics.message_start_time,
                statistics.message_end_time,
            )

    def _checked_summary(self) -> Any:
        """Return the summary of the file. Raise an error of any type if the summary is incomplete.

        A summary without the index of all chunks is incomplete.
        """
        summary: Any = make_reader(self._stream).get_summary()
        statistics = summary.statistics
        is_complete = (
            len(summary.channels) == statistics.channel_count
            and len(summary.chunk_indexes) == statistics.chunk_count
            and bool(summary.chunk_indexes) == bool(statistics.message_count)
        )
        if not is_complete:
            raise ValueError("it has no index of its messages")
        return summary

    def _add_kind(self, channel: Any, schemas: Mapping[int, Any]) -> None:
        """Store the kind of the messages of a channel. ``schemas`` has the file's schemas by id."""
        schema = schemas.get(channel.schema_id, _NO_SCHEMA)
        description = (
            schema.name,
            channel.message_encoding,
            schema.encoding,
            schema.data,
        )
        self._kinds[channel.id] = kind_of(channel.topic, *description)

    def _scan(self, reason: Exception) -> None:
        """Read a file without a usable index once, to count its messages and to find the damage.

        ``reason`` is the error raised when the index was read.

        Raises
        ------
        DamageError
            If the file is damaged and contains no readable message.
        """
        schemas = {}
        times_ns = []
        for record in self._records(self.losses):
            if isinstance(record, records.Schema):
                schemas[record.id] = record
            elif isinstance(record, records.Channel):
                self._add_kind(record, schemas)
            elif (
                isinstance(record, records.Message)
                and record.channel_id in self._kinds
            ):
                self.counts[self._kinds[record.channel_id]] += 1
                times_ns.append(record.log_time)
        if times_ns:
            self.span_ns = min(times_ns), max(times_ns)
            seconds = (self.span_ns[1] - self.span_ns[0]) * 1e-9
            recovered = (
                f"{len(times_ns)} messages over {seconds:.1f} s were recovered"
            )
            self.losses = [
                f"it is truncated or damaged ({loss}); the rest is lost; {recovered}"
                for loss in self.losses
            ]
        elif self.losses:
            raise DamageError(
                f"{self.losses[0]}, and no message before the damage can be read"
            ) from reason

    def _messages(
        self, kinds: Mapping[int, MessageKind], span_ns: Span
    ) -> Iterable[Message]:
        if not self._chunks:
            # The damage is already in `losses`, so pass another list.
            for record in self._records([]):
                if (
                    isinstance(record, records.Message)
                    and record.channel_id in kinds
                ):
                    yield kinds[record.channel_id], record.log_time, record.data
        start_ns, stop_ns = span_ns
        for index in self._chunks:
            is_outside = (
                index.message_end_time < start_ns
                or index.message_start_time >= stop_ns
            )
            if is_outside:
                continue
            channels = index.message_index_offsets
            # Skip chunks without messages of these kinds. A chunk may lack an index of channels.
            if not channels or kinds.keys() & channels.keys():
                messages = _messages_of_chunk(
                    self._content(index.chunk_start_offset), kinds
                )
                yield from sorted(messages, key=itemgetter(1))

    def _content(self, start: int) -> bytes:
        """Return the unpacked records of the chunk that begins at byte ``start`` of the file."""
        self._stream.seek(start + _RECORD.size)
        chunk = records.Chunk.read(ReadDataStream(self._stream))
        stream, size = stream_reader.get_chunk_data_stream(
            chunk, validate_crc=True
        )
        return bytes(stream.read(size))

    def _records(self, losses: list[str]) -> Iterator[Any]:
        """Iterate over all records of the file, or over the records before the damage.

        The reason of the damage is appended to ``losses``.
        """
        position = self._stream.seek(0)
        try:
            reader = StreamReader(self._stream, validate_crcs=True)
            for record in reader.records:
                yield record
                position = self._stream.tell()
        except MemoryError:
            raise
        except Exception as error:
            losses.append(reason_of(error))
            if isinstance(error, EOFError):
                # The file is truncated. Reading the records of its last chunk also ends in an
                # error.
                with suppress(Exception):
                    yield from self._records_of_cut_chunk(position)

    def _records_of_cut_chunk(self, position: int) -> Iterator[Any]:
        """Iterate over the records of a truncated chunk at byte ``position``.

        There are none if the record at this position is not a chunk.
        """
        with self._file.open("rb") as file:
            file.seek(position)
            if file.read(_RECORD.size)[0] != Opcode.CHUNK:
                return
            chunk = records.Chunk.read(ReadDataStream(file))
            if chunk.compression == "zstd":
                zstd = (
                    stream_reader.zstandard.ZstdDecompressor().decompressobj()
                )
                chunk.data = zstd.decompress(chunk.data)
            elif chunk.compression == "lz4":
                # Before mcap 1.6, `stream_reader.lz4` is the package instead of its module frame.
                lz4 = getattr(stream_reader.lz4, "frame", stream_reader.lz4)
                chunk.data = lz4.LZ4FrameDecompressor().decompress(chunk.data)
            stream = _WholeReads(BytesIO(chunk.data))
            yield from StreamReader(stream, skip_magic=True).records


def _messages_of_chunk(
    content: bytes, kinds: Mapping[int, MessageKind]
) -> Iterator[Message]:
    """Iterate over the messages of some channels in the unpacked records of an mcap chunk.

    This takes a fraction of the time of the iteration in the library mcap.
    """
    message_opcode = int(Opcode.MESSAGE)
    end = 0
    while end < len(content):
        opcode, size = _RECORD.unpack_from(content, end)
        start = end + _RECORD.size
        end = start + size
        if end > len(content):
            raise EOFError("a chunk ends in the middle of a record")
        if opcode == message_opcode:
            channel, bag_ns = _MESSAGE.unpack_from(content, start)
            if channel in kinds:
                yield (
                    kinds[channel],
                    bag_ns,
                    content[start + _MESSAGE.size : end],
                )


class _WholeReads(BufferedReader):
    """File whose ``read`` raises EOFError if fewer bytes than requested are left.

    The library mcap would accept fewer bytes as a whole record.
    """

    def read(self, size: int | None = -1) -> bytes:
        n_bytes = size or 0
        # Before version 1.6, the library mcap requests any length that a damaged file states, which
        # could fill the memory.
        data = super().read(size) if n_bytes < files.LARGEST else b""
        if len(data) < n_bytes:
            raise EOFError("it ends in the middle of a record")
        return data
