"""mcap and rosbag1 files record by record, for tests of files that no recorder writes."""

import bz2
import struct

from backports import zstd

ODOMETRY = "nav_msgs/msg/Odometry"
MAGIC = b"\x89MCAP0\r\n"


def text(value):
    return struct.pack("<I", len(value.encode())) + value.encode()


def record(opcode, body):
    return struct.pack("<BQ", opcode, len(body)) + body


def schema(key=1, name=ODOMETRY):
    return record(3, struct.pack("<H", key) + text(name) + text("ros2msg") + text(""))


def channel(key=1, topic="/a", encoding="cdr", schema_key=1):
    head = struct.pack("<HH", key, schema_key)
    return record(4, head + text(topic) + text(encoding) + struct.pack("<I", 0))


def message(data, log_ns=1, key=1):
    return record(5, struct.pack("<HIQQ", key, 0, log_ns, log_ns) + data)


def chunk(records, compression="zstd", start_ns=0, end_ns=10**9, size=None):
    data = zstd.compress(records) if compression == "zstd" else records
    size = len(records) if size is None else size
    head = struct.pack("<QQQI", start_ns, end_ns, size, 0) + text(compression)
    return record(6, head + struct.pack("<Q", len(data)) + data)


def message_index(key, entries):
    return record(7, struct.pack("<HI", key, 16 * len(entries)) + b"".join(
        struct.pack("<QQ", log_ns, offset) for log_ns, offset in entries
    ))  # fmt: skip


def chunk_index(offset, length, index_offsets=None, start_ns=0, end_ns=10**9):
    offsets = b"".join(struct.pack("<HQ", *item) for item in (index_offsets or {}).items())
    body = struct.pack("<QQQQI", start_ns, end_ns, offset, length, len(offsets)) + offsets
    return record(8, body + struct.pack("<Q", 0) + text("") + struct.pack("<QQ", 0, 0))


def statistics(counts, start_ns=0, end_ns=10**9):
    body = struct.pack("<QHIIIIQQ", 0, 0, 0, 0, 0, 0, start_ns, end_ns)
    items = b"".join(struct.pack("<HQ", *item) for item in counts.items())
    return record(11, body + struct.pack("<I", len(items)) + items)


def footer(summary_start=0):
    return record(2, struct.pack("<QQI", summary_start, 0, 0)) + MAGIC


def whole(records, summary=b""):
    """A file of records and, if it is given, of an index."""
    data = MAGIC + record(1, text("ros2") + text("test")) + records + record(15, bytes(4))
    return data + summary + footer(len(data) if summary else 0)


def offset_of(records):
    """Where the records of :func:`whole` that follow some others begin."""
    return len(MAGIC + record(1, text("ros2") + text("test")) + records)


# ---- rosbag1


def header(**fields):
    parts = [name.encode() + b"=" + value for name, value in fields.items()]
    joined = b"".join(struct.pack("<I", len(part)) + part for part in parts)
    return struct.pack("<I", len(joined)) + joined


def record1(data=b"", **fields):
    return header(**fields) + struct.pack("<I", len(data)) + data


def u32(value):
    return struct.pack("<I", value)


def rosbag1(chunks, counts, topic=b"/a", repeats=1):
    """A file of chunks ``(compression, size, data)``; the index names each ``repeats`` times."""
    connection = record1(
        header(topic=topic, type=b"nav_msgs/Odometry", md5sum=b"*", message_definition=b"")[4:],
        op=b"\x07",
        conn=u32(0),
        topic=topic,
    )
    start, position, body, infos = 13 + 4096, 13 + 4096, b"", b""
    for compression, size, data in chunks:
        info = record1(
            u32(0) + u32(counts),
            op=b"\x06",
            ver=u32(1),
            chunk_pos=struct.pack("<Q", position),
            start_time=bytes(8),
            end_time=struct.pack("<II", 5, 0),
            count=u32(1),
        )
        infos += info * repeats
        part = record1(data, op=b"\x05", compression=compression, size=u32(size))
        body, position = body + part, position + len(part)
    head = header(
        op=b"\x03",
        index_pos=struct.pack("<Q", start + len(body)),
        conn_count=u32(1),
        chunk_count=u32(len(chunks) * repeats),
    )
    padding = 4096 - len(head) - 4
    return b"#ROSBAG V2.0\n" + head + u32(padding) + b" " * padding + body + connection + infos


def message1(data, seconds=1):
    return record1(data, op=b"\x02", conn=u32(0), time=struct.pack("<II", seconds, 0))


def bz2_chunk(content):
    return b"bz2", len(content) & 0xFFFFFFFF, bz2.compress(content)
