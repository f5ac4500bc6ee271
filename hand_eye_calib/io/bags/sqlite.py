"""sqlite3 files of rosbag2."""

import sqlite3
from collections.abc import Container, Iterator
from pathlib import Path
from urllib.parse import quote

from hand_eye_calib.errors import printable
from hand_eye_calib.io.bags.blocks import Message, MessageKind, message_blocks
from hand_eye_calib.io.bags.decompression import Budget
from hand_eye_calib.io.bags.storage import LATEST_NS, Losses, add_topic, check_encoding
from hand_eye_calib.io.limits import LARGEST_MESSAGE, LONGEST_NAME

_TABLES = ("topics", "messages")

# Steps of SQLite's virtual machine: a damaged tree of pages may have no end.
_STEPS_AT_ONCE = 100_000
_FEWEST_STEPS, _STEPS_PER_BYTE = 10_000_000, 100


class SqliteFile:
    """A sqlite3 file of a rosbag2 opened for reading; a Storage.

    Parameters
    ----------
    path : pathlib.Path

    Raises
    ------
    ValueError, sqlite3.Error
        If it is no such file.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.losses = path, Losses()
        self._size = path.stat().st_size
        # The path is quoted, as it may hold ?, # or %. Nothing is written, not even a lock.
        uri = f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1"
        self._database = sqlite3.connect(uri, uri=True, check_same_thread=False)
        try:
            self._limit()
            self._check_tables()
            self._read_topics()
            self._note_log()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def _limit(self) -> None:
        self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST_MESSAGE + 1024)
        self._database.execute("PRAGMA trusted_schema = OFF")
        self._restart()

    def _restart(self) -> None:
        """Allow as many steps of the virtual machine as the size of the file justifies."""
        rounds = (_FEWEST_STEPS + _STEPS_PER_BYTE * self._size) // _STEPS_AT_ONCE
        left = iter(range(rounds))
        self._database.set_progress_handler(lambda: next(left, None) is None, _STEPS_AT_ONCE)

    def _check_tables(self) -> None:
        """Refuse tables whose rows are computed rather than stored."""
        for table in _TABLES:
            found = self._database.execute(
                "SELECT type, sql FROM sqlite_master WHERE name = ?", (table,)
            ).fetchone()
            if not found or found[0] != "table" or "VIRTUAL" in str(found[1])[:40].upper():
                raise ValueError(f"it has no table {table!r}")
            columns = self._database.execute(f"PRAGMA table_xinfo({table})").fetchall()
            if any(column[-1] for column in columns):
                raise ValueError(f"its table {table!r} has computed columns")

    def _read_topics(self) -> None:
        counts: dict[int, int] = {}
        times: list[int] = []
        for key, n_messages, first_ns, last_ns in self._database.execute(
            "SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp) FROM messages "
            "GROUP BY topic_id"
        ):
            counts[key] = n_messages
            times += [first_ns, last_ns]
        if not all(isinstance(time, int) and 0 <= time <= LATEST_NS for time in times):
            raise ValueError("a message has no time that is a positive integer")
        self.start_ns: int | None = min(times, default=None)
        self.end_ns: int | None = max(times, default=None)
        self.topics: dict[str, tuple[str, int]] = {}
        self._connections: dict[int, tuple[str, str, str]] = {}
        for key, *texts in self._database.execute(
            "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
        ):
            name, message_type, encoding = map(_checked_text, texts)
            add_topic(self.topics, name, message_type, counts.get(key, 0))
            self._connections[key] = (name, message_type, encoding)

    def _note_log(self) -> None:
        log = self.path.with_name(self.path.name + "-wal")
        if log.exists() and log.stat().st_size:
            self.losses.add(
                "what the recorder had not yet moved out of its log beside it (-wal) is left out; "
                "open the file once with sqlite3 to have it moved"
            )

    def messages(self, topics: Container[str]) -> Iterator[list[Message]]:
        """Iterate over the messages of some topics in the order of bag time, many at once.

        Raises
        ------
        ValueError
            If a message is not bytes with a time, or the messages are not CDR.
        sqlite3.Error
            If the file is damaged.
        """
        kinds = {}
        for key, (name, message_type, encoding) in self._connections.items():
            if name in topics:
                check_encoding(name, encoding)
                kinds[key] = MessageKind(name, message_type, False)
        return message_blocks(self._checked_messages(kinds))

    def _checked_messages(self, kinds: dict[int, MessageKind]) -> Iterator[Message]:
        budget = Budget(self._size)
        for key, bag_ns, data in self._rows(list(kinds)):
            if not isinstance(data, bytes):
                found = type(data).__name__
                raise ValueError(f"a message of {kinds[key].topic} is {found}, expected bytes")
            if not isinstance(bag_ns, int):
                raise ValueError(f"a message of {kinds[key].topic} has no time that is an integer")
            budget.spend(len(data))
            yield kinds[key], bag_ns, data

    def _rows(self, keys: list[int]) -> Iterator[tuple[int, object, object]]:
        """Topic, time and content of messages in the order of time."""
        self._restart()
        marks = ",".join("?" * len(keys))
        part = f"FROM messages WHERE topic_id IN ({marks}) ORDER BY timestamp"
        query = f"SELECT topic_id, timestamp, data {part}"
        plan = self._database.execute(f"EXPLAIN QUERY PLAN {query}", keys).fetchall()
        if not any("TEMP B-TREE" in str(step) for step in plan):
            yield from self._database.execute(query, keys)
            return
        # Without an index of the times, the rows are sorted; but not their content with them.
        for row, key, bag_ns in self._database.execute(
            f"SELECT rowid, topic_id, timestamp {part}", keys
        ):
            content = self._database.execute("SELECT data FROM messages WHERE rowid = ?", (row,))
            yield key, bag_ns, content.fetchone()[0]


def _checked_text(value: object) -> str:
    if not isinstance(value, str) or len(value) > LONGEST_NAME:
        raise ValueError(f"a topic's name, type or encoding is {str(value)[:40]!r}")
    return printable(value)
