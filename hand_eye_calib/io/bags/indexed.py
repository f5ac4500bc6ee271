"""Messages of whole mcap files where the index of the library rosbags says that they are.

Its own iteration over the messages of a chunk takes up to twice as long.
"""

import struct
from bisect import bisect_left
from collections.abc import Iterator, Mapping
from itertools import zip_longest
from operator import attrgetter, itemgetter
from typing import Any, BinaryIO

from hand_eye_calib.io.bags.recovery import Message, MessageKind
from hand_eye_calib.io.limits import LARGEST_RATIO, SMALLEST_UNPACKED

# Opcode and length of a record; of a chunk's, also times, size and checksum.
_RECORD, _CHUNK_HEAD = struct.Struct("<BQ"), struct.Struct("<BQQQQI")
# Channel and log time of a message; with its number and time of publication, 22 bytes.
_MESSAGE, _MESSAGE_HEAD, _MESSAGE_SIZE = 5, struct.Struct("<H4xQ"), 22


def messages_of(reader: Any, kinds: Mapping[int, MessageKind]) -> Iterator[Message]:
    """Messages of some connections, by their number, in the order of time."""
    if hasattr(getattr(reader, "storage", None), "chunks"):
        return _mcap_messages(reader.storage, kinds)
    wanted = [each for each in reader.connections if each.id in kinds]
    found = reader.messages(wanted) if wanted else ()
    return ((kinds[connection.id], bag_ns, data) for connection, bag_ns, data in found)


def _mcap_messages(storage: Any, kinds: Mapping[int, MessageKind]) -> Iterator[Message]:
    """Messages of the chunks that the index names; those of chunks that overlap wait."""
    chunks = [each for each in storage.chunks if kinds.keys() & each.channel_count.keys()]
    chunks.sort(key=attrgetter("message_start_time"))
    waiting: list[Message] = []
    for chunk, later in zip_longest(chunks, chunks[1:]):
        waiting += _messages_of_chunk(storage.bio, chunk, kinds)
        waiting.sort(key=itemgetter(1))
        end = len(waiting)
        if later is not None:
            end = bisect_left(waiting, later.message_start_time, key=itemgetter(1))
        yield from waiting[:end]
        waiting = waiting[end:]


def _messages_of_chunk(
    file: BinaryIO, chunk: Any, kinds: Mapping[int, MessageKind]
) -> Iterator[Message]:
    from rosbags.rosbag2.storage_mcap import decompress

    file.seek(chunk.chunk_start_offset)
    head, name = file.read(_CHUNK_HEAD.size), chunk.compression
    *_, uncompressed_size, checksum = _CHUNK_HEAD.unpack(head)
    file.seek(4 + len(name) + 8, 1)
    packed = file.read(chunk.compressed_size)
    if uncompressed_size > SMALLEST_UNPACKED + LARGEST_RATIO * len(packed):
        raise ValueError(f"{uncompressed_size} bytes unpacked are not believable")
    content = decompress(packed, name, uncompressed_size, checksum)
    position = 0
    while position < len(content):
        opcode, size = _RECORD.unpack_from(content, position)
        start, position = position + _RECORD.size, position + _RECORD.size + size
        if position > len(content):
            raise EOFError("a chunk ends in the middle of a record")
        if opcode == _MESSAGE:
            key, bag_ns = _MESSAGE_HEAD.unpack_from(content, start)
            if key in kinds:
                yield kinds[key], bag_ns, content[start + _MESSAGE_SIZE : position]
