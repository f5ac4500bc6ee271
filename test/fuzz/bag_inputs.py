"""Structured bags: every length, offset, time and text of a whole file may be wrong."""

import bz2
import sqlite3
import struct
import zlib

import lz4.frame
from backports import zstd
from motions import T_PARENT_CHILD, wandering_poses

from hand_eye_calib.geometry import se3

MAGIC = b"\x89MCAP0\r\n"
POSES = wandering_poses(60)
TYPES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "tf2_msgs/msg/TFMessage",
         "nav_msgs/msg/Path", "std_msgs/msg/String")  # fmt: skip
START_NS = 1_700_000_000_000_000_000
_CHILDREN = se3.inverse(T_PARENT_CHILD) @ POSES @ T_PARENT_CHILD


# ---- messages


class Cdr:
    """A message in CDR or as ROS 1 packs it."""

    def __init__(self, chaos, is_ros1):
        self.chaos, self.is_ros1 = chaos, is_ros1
        self.body = b"" if is_ros1 else struct.pack("<BBH", 0, chaos.number(1, 8), 0)

    def align(self, size):
        if not self.is_ros1:
            self.body += bytes((4 - len(self.body)) % size)

    def number(self, value):
        self.align(4)
        self.body += struct.pack("<I", self.chaos.number(value, 32))

    def text(self, value):
        data = self.chaos.text(value).encode() + b"\0" * (not self.is_ros1)
        self.number(len(data))
        self.body += data

    def header(self, stamp_ns, frame):
        if self.is_ros1:
            self.number(0)
        self.number(stamp_ns // 10**9)
        self.number(stamp_ns % 10**9)
        self.text(frame)

    def pose(self, matrix):
        self.align(8)
        values = [*matrix[:3, 3], *se3.to_quat_xyzw(matrix)]
        self.body += struct.pack("<7d", *map(self.chaos.real, values))


def message(chaos, message_type, stamp_ns, sensor, matrix, is_ros1=False):
    """Bytes of a message."""
    made = Cdr(chaos, is_ros1)
    if message_type == "tf2_msgs/msg/TFMessage":
        made.number(1)
    made.header(stamp_ns, "odom")
    if message_type == "nav_msgs/msg/Path":
        made.number(3)
        for k in range(3):
            made.header(stamp_ns + k, "odom")
            made.pose(matrix)
        return chaos.data(made.body)
    if message_type != "geometry_msgs/msg/PoseStamped":
        made.text(sensor)
    made.pose(matrix)
    return chaos.data(made.body + bytes(600 * (message_type == "nav_msgs/msg/Odometry")))


def streams(chaos, is_ros1=False):
    """Topic, type, bag time and bytes of messages, and the types of the two topics."""
    types = [chaos.choice(TYPES) if chaos.hits(5) else TYPES[0] for _ in range(2)]
    found = []
    for k in range(len(POSES)):
        stamp_ns = START_NS + k * 100_000_000
        for topic, poses in ((0, POSES), (1, _CHILDREN)):
            data = message(chaos, types[topic], stamp_ns, f"s{topic}", poses[k], is_ros1)
            found.append((topic, chaos.number(stamp_ns, 64), data))
    return chaos.items(found), types


# ---- mcap


def text(chaos, value):
    data = chaos.text(value).encode("utf-8", "surrogatepass")
    return struct.pack("<I", chaos.number(len(data), 32)) + data


def record(chaos, opcode, body):
    return struct.pack("<BQ", chaos.number(opcode, 8), chaos.number(len(body), 64)) + body


def mcap(chaos):
    """A file with or without chunks, compression and index."""
    messages, types = streams(chaos)
    head = b""
    for topic, message_type in enumerate(types):
        schema = struct.pack("<H", chaos.number(topic + 1, 16)) + text(chaos, message_type)
        head += record(chaos, 3, schema + text(chaos, "ros2msg") + text(chaos, ""))
        channel = struct.pack("<HH", chaos.number(topic, 16), chaos.number(topic + 1, 16))
        channel += text(chaos, "/" + "ab"[topic]) + text(chaos, "cdr") + struct.pack("<I", 0)
        head += record(chaos, 4, channel)
    data = MAGIC + record(chaos, 1, text(chaos, "ros2") + text(chaos, "fuzz")) + head
    described, size = b"", chaos.choice([5, 20, 100])
    compression = chaos.choice(["", "", "zstd", "lz4"])
    for start in range(0, len(messages), size):
        part = messages[start : start + size]
        records, index = b"", {}
        for topic, bag_ns, body in part:
            index.setdefault(topic, []).append((bag_ns, len(records)))
            fields = struct.pack("<HIQQ", chaos.number(topic, 16), 0, bag_ns, bag_ns)
            records += record(chaos, 5, fields + body)
        if size == 100:  # outside chunks
            data += records
            continue
        offset, chunk = len(data), mcap_chunk(chaos, part, records, compression)
        data += chunk
        offsets = {}
        for topic, entries in index.items():
            offsets[topic] = len(data)
            data += message_index(chaos, topic, chaos.items(entries))
        described += chunk_index(chaos, part, offset, len(chunk), offsets)
    end = record(chaos, 15, bytes(4))
    summary = head + described + statistics(chaos, messages) if described else b""
    start = len(data) + len(end) if chaos.random.random() < 0.8 else 0
    footer = struct.pack("<QQI", chaos.number(start, 64), 0, 0)
    return chaos.data(data + end + summary + record(chaos, 2, footer) + MAGIC)


def mcap_chunk(chaos, part, records, compression):
    compression = chaos.text(compression) if chaos.hits() else compression
    bomb = chaos.hits(0.5)
    content = records if not bomb else records + bytes(chaos.choice([1 << 20, 80 << 20, 200 << 20]))
    packed = {"zstd": zstd.compress, "lz4": lz4.frame.compress}.get(compression, bytes)(content)
    times = [bag_ns for _, bag_ns, _ in part]
    crc = zlib.crc32(content) if chaos.random.random() < 0.3 else 0
    head = struct.pack(
        "<QQQI",
        chaos.number(min(times), 64),
        chaos.number(max(times), 64),
        chaos.number(len(content), 64),
        chaos.number(crc, 32),
    )
    size = struct.pack("<Q", chaos.number(len(packed), 64))
    return record(chaos, 6, head + text(chaos, compression) + size + packed[: 40 << 20])


def message_index(chaos, topic, entries):
    if chaos.hits():
        entries = entries[:1] * 5000
    packed = b"".join(struct.pack("<QQ", t, chaos.number(o, 64)) for t, o in entries)
    head = struct.pack("<HI", chaos.number(topic, 16), chaos.number(len(packed), 32))
    return record(chaos, 7, head + packed)


def chunk_index(chaos, part, offset, length, offsets):
    times = [bag_ns for _, bag_ns, _ in part]
    fields = [min(times), max(times), offset, length]
    packed = b"".join(struct.pack("<HQ", k, chaos.number(o, 64)) for k, o in offsets.items())
    head = struct.pack("<QQQQ", *(chaos.number(field, 64) for field in fields))
    body = head + struct.pack("<I", chaos.number(len(packed), 32)) + packed
    made = record(chaos, 8, body + struct.pack("<QIQQ", 0, 0, 0, 0))
    return made * (1000 if chaos.hits() else 1)


def statistics(chaos, messages):
    times = [bag_ns for _, bag_ns, _ in messages]
    counts = {topic: sum(each[0] == topic for each in messages) for topic in (0, 1)}
    packed = b"".join(struct.pack("<HQ", k, chaos.number(v, 64)) for k, v in counts.items())
    head = struct.pack("<QHIIIIQQ", len(messages), 2, 2, 0, 0, 0, min(times), max(times))
    return record(chaos, 11, head + struct.pack("<I", chaos.number(len(packed), 32)) + packed)


# ---- rosbag1


def header(chaos, **fields):
    parts = [(name + "=").encode() + value for name, value in chaos.items(fields.items())]
    joined = b"".join(struct.pack("<I", chaos.number(len(part), 32)) + part for part in parts)
    return struct.pack("<I", chaos.number(len(joined), 32)) + joined


def record1(chaos, data=b"", **fields):
    return header(chaos, **fields) + struct.pack("<I", chaos.number(len(data), 32)) + data


def u32(chaos, value):
    return struct.pack("<I", chaos.number(value, 32))


def time1(stamp_ns):
    return struct.pack("<II", *(part & 0xFFFFFFFF for part in divmod(stamp_ns, 10**9)))


def rosbag1(chaos):
    """A file of a few chunks, compressed or not."""
    messages, types = streams(chaos, is_ros1=True)
    compression = chaos.choice([b"none", b"bz2", b"lz4"])
    pack = {b"none": bytes, b"bz2": bz2.compress, b"lz4": lz4.frame.compress}[compression]
    position = start = 13 + 4096
    body = infos = b""
    parts = [messages[k : k + 15] for k in range(0, len(messages), 15)]
    for part in parts:
        records = b"".join(
            record1(chaos, data, op=b"\x02", conn=u32(chaos, topic), time=time1(bag_ns))
            for topic, bag_ns, data in part
        )
        if chaos.hits():
            records += bytes(chaos.choice([100, 80 << 20]))
        fields = {"compression": compression, "size": u32(chaos, len(records))}
        chunk = record1(chaos, pack(records), op=b"\x05", **fields)
        infos += chunk_info(chaos, part, position)
        body, position = body + chunk, position + len(chunk)
    connections = b"".join(connection1(chaos, topic, types[topic]) for topic in (0, 1))
    index_pos = struct.pack("<Q", chaos.number(start + len(body), 64))
    counts = {"conn_count": u32(chaos, 2), "chunk_count": u32(chaos, len(parts))}
    head = header(chaos, op=b"\x03", index_pos=index_pos, **counts)
    padding = max(4096 - len(head) - 4, 0)
    head += struct.pack("<I", padding) + b" " * padding
    return chaos.data(b"#ROSBAG V2.0\n" + head + body + connections + infos)


def chunk_info(chaos, part, position):
    counts = [sum(each[0] == topic for each in part) for topic in (0, 1)]
    times = [bag_ns for _, bag_ns, _ in part]
    made = record1(
        chaos,
        b"".join(struct.pack("<I", topic) + u32(chaos, counts[topic]) for topic in (0, 1)),
        op=b"\x06",
        ver=u32(chaos, 1),
        chunk_pos=struct.pack("<Q", chaos.number(position, 64)),
        start_time=time1(min(times)),
        end_time=time1(max(times)),
        count=u32(chaos, 2),
    )
    return made * (1000 if chaos.hits() else 1)


def connection1(chaos, topic, message_type):
    name = chaos.text("/" + "ab"[topic]).encode()
    old_type = chaos.text(message_type.replace("/msg/", "/")).encode()
    described = header(chaos, topic=name, type=old_type, md5sum=b"*", message_definition=b"")[4:]
    return record1(chaos, described, op=b"\x07", conn=u32(chaos, topic), topic=name)


# ---- sqlite3


def write_sqlite3(chaos, path):
    """A database with values of all types, then perhaps with flipped bits."""
    odd = (None, "text", b"", -1, 1e300, 2**63 - 1, "12", 0, b"\xff" * 70, "\0")
    database = sqlite3.connect(path)
    database.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format"
        + chaos.choice([", offered_qos_profiles", "", ", extra AS (zeroblob(10))"])
        + ")"
    )
    database.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
    if chaos.random.random() < 0.7:
        database.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
    messages, types = streams(chaos)
    for topic, message_type in enumerate(types):
        values = [topic, chaos.text("/" + "ab"[topic]), chaos.text(message_type), chaos.text("cdr")]
        values[1:] = [chaos.choice(odd) if chaos.hits(0.3) else value for value in values[1:]]
        names = "id, name, type, serialization_format"
        database.execute(f"INSERT INTO topics({names}) VALUES(?, ?, ?, ?)", values)
    for topic, bag_ns, data in messages:
        data = zstd.compress(data) if chaos.hits() else data
        data = zstd.compress(bytes(100 << 20)) if chaos.hits(0.2) else data
        row = [topic, min(bag_ns, 2**63 - 1), data]
        row = [chaos.choice(odd) if chaos.hits() else value for value in row]
        database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", row)
    if chaos.hits(3):
        statement = chaos.choice(
            ["DROP TABLE topics", "DROP TABLE messages", "ALTER TABLE messages RENAME data TO d",
             "CREATE VIEW v AS SELECT * FROM messages; DROP TABLE topics",
             "CREATE TABLE x AS SELECT * FROM messages; DROP TABLE messages;"
             "CREATE VIEW messages AS WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k+1 FROM n)"
             " SELECT 1 topic_id, k timestamp, zeroblob(1000) data FROM n"]
        )  # fmt: skip
        database.executescript(statement)
    database.commit()
    database.close()
    with open(path, "rb") as file:
        data = file.read()
    with open(path, "wb") as file:
        file.write(chaos.data(data))
