"""The storage files of bags: found, unpacked, and read through the library rosbags.

An mcap file that rosbags cannot open, or not read to its end, is read record by record: see
recovery.py.
"""

import re
import sys
import tempfile
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from itertools import dropwhile, islice
from operator import itemgetter
from pathlib import Path, PurePath
from typing import Any

from hand_eye_calib.errors import InputError, MissingDependencyError
from hand_eye_calib.io.bags.indexed import messages_of
from hand_eye_calib.io.bags.recovery import (
    Lose,
    Message,
    MessageKind,
    in_order,
    reason_of,
    recovered_messages,
)
from hand_eye_calib.io.limits import (
    BLOCK_BYTES,
    LARGEST_RATIO,
    MOST_BAG_FILES,
    MOST_TOPICS,
    SMALLEST_UNPACKED,
    ReadingMemory,
)

#: Messages that are unpacked at once, and a part of them.
BLOCK_SIZE, _PIECE_SIZE = 2048, 64

_EXPECTED = "a rosbag2 directory, a .mcap or .db3 file of one, or a rosbag1 .bag file"
_REPAIRS = {
    ".mcap": "'mcap recover'",
    ".db3": "sqlite3's '.recover'",
    ".bag": "'rosbag reindex'",
}
_ENCODINGS = ("cdr", "ros1", "json")
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_PIECE_BYTES = 1 << 20
_MOST_LOSSES = 10
# At the end of an mcap: where the index begins, two more numbers, and the magic bytes.
_MCAP_FOOTER_SIZE = 8 + 8 + 4 + 8


class Storage:
    """A storage file opened for reading.

    Parameters
    ----------
    path : pathlib.Path
        Its name, for a person.
    file : pathlib.Path
        Where it is, unpacked.
    memory : ReadingMemory
        Of the whole bag.
    number : int
        Of the bag, of those that are read together.

    Attributes
    ----------
    topics : dict of str to (str, int)
        Message type and number of messages by topic. The type is empty if publishers disagree.
    start_ns, end_ns : int or None
        Bag time of the first and last message; None if there is none.
    losses : list of str
        What could not be read, one line each; complete after reading.

    Raises
    ------
    InputError
        If nothing in it can be read.
    """

    def __init__(self, path: Path, file: Path, memory: ReadingMemory, number: int) -> None:
        self.path, self._file, self._memory, self._number = path, file, memory, number
        self._reader: Any = None
        self.losses: list[str] = []
        self._clear()
        with self._errors_in_one_line(), self._memory:
            try:
                self._open()
            except MissingDependencyError:
                raise
            except Exception as error:
                self.close()
                self._clear()
                if self._file.suffix != ".mcap":
                    raise
                self._search(error)
        log = file.with_name(file.name + "-wal")
        if log.exists() and log.stat().st_size:
            self._lose(
                "what the recorder had not yet moved out of its log beside it (-wal) is left out; "
                "open the file once with sqlite3 to have it moved"
            )

    def _clear(self) -> None:
        self.topics: dict[str, tuple[str, int]] = {}
        self.start_ns: int | None = None
        self.end_ns: int | None = None

    def close(self) -> None:
        """Close the file."""
        if self._reader is not None:
            self._reader.close()
        self._reader = None

    def _open(self) -> None:
        self._reader = reader = _opened(self._file)
        chunks = getattr(getattr(reader, "storage", None), "chunks", None)
        n_indexed = sum(sum(each.channel_count.values()) for each in chunks or ())
        if chunks is not None and n_indexed != reader.message_count:
            raise ValueError("it has no index")  # of all messages: rosbags would miss the others
        for connection in reader.connections:
            self._add(_kind_of(connection), connection.msgcount)
        if reader.message_count:
            self._cover(reader.start_time)
            self._cover(reader.end_time - 1)

    def _search(self, reason: Exception) -> None:
        """Go through a file that rosbags cannot open."""
        n_messages, losses = 0, list[str]()
        for kind, bag_ns, _ in recovered_messages(self._file, losses.append):
            self._add(kind, 1)
            self._cover(bag_ns)
            n_messages += 1
        if not n_messages and losses:
            raise ValueError(f"{losses[0]}, and nothing before that can be recovered") from reason
        if losses:
            seconds = ((self.end_ns or 0) - (self.start_ns or 0)) * 1e-9
            said = "; ".join(losses[:_MOST_LOSSES])
            self._lose(f"{said}; recovered are {n_messages} messages covering {seconds:.1f} s")

    def _add(self, kind: MessageKind, n_messages: int) -> None:
        known, before = self.topics.get(kind.topic, (kind.type, 0))
        self.topics[kind.topic] = (kind.type if kind.type == known else "", before + n_messages)
        if len(self.topics) > MOST_TOPICS:
            raise ValueError(f"it has more than {MOST_TOPICS} topics")

    def _cover(self, bag_ns: int) -> None:
        if not 0 <= bag_ns < 1 << 63:
            raise ValueError("it has times that cannot be right")
        self.start_ns = bag_ns if self.start_ns is None else min(bag_ns, self.start_ns)
        self.end_ns = bag_ns if self.end_ns is None else max(bag_ns, self.end_ns)

    def definition(self, topic: str) -> Any:
        """How the messages of a topic are built, as rosbags has it; None if it is not known."""
        connections = self._reader.connections if self._reader is not None else ()
        return next((each.msgdef for each in connections if each.topic == topic), None)

    def _lose(self, text: str) -> None:
        if text not in self.losses and len(self.losses) < _MOST_LOSSES:
            self.losses.append(text)

    # ---- messages

    def blocks(self, topics: Collection[str]) -> Iterator[list[Message]]:
        """Iterate over the messages of some topics in the order of bag time, many at once.

        Raises
        ------
        InputError
            If they are not encoded as CDR or as ROS 1 does, or take too much memory.
        """
        blocks = self._blocks(topics)
        while True:
            with self._errors_in_one_line(), self._memory:
                block = next(blocks, None)
            if block is None:
                return
            yield block

    def _blocks(self, topics: Collection[str]) -> Iterator[list[Message]]:
        """Messages as rosbags has them; from where it fails, as far as they can be recovered."""
        # The losses of a file that rosbags cannot open were noted when it was opened.
        said: list[str] = []
        lose: Lose = said.append if self._reader is None else self._lose
        last: list[Message] = []
        if self._reader is not None:
            try:
                for last in message_blocks(self._indexed(topics), self._lose):
                    yield last
                return
            except Exception as error:
                if _is_out_of_memory(error) or self._file.suffix != ".mcap":
                    raise
                self._lose(f"it is damaged ({reason_of(error)}), and was read record by record")
        own: dict[MessageKind, MessageKind] = {}
        found = (
            (own.setdefault(kind, kind._replace(bag=self._number)), bag_ns, data)
            for kind, bag_ns, data in recovered_messages(self._file, lose)
        )
        ordered = in_order(each for each in found if self._is_wanted(each[0], topics))
        if last:  # those before, and these at the last time, were given already
            end_ns = last[-1][1]
            later = dropwhile(lambda message: message[1] < end_ns, ordered)
            ordered = islice(later, sum(each[1] == end_ns for each in last), None)
        yield from message_blocks(ordered, self._lose)

    def _indexed(self, topics: Collection[str]) -> Iterator[Message]:
        """Messages of some topics as rosbags has them."""
        connections = self._reader.connections
        kinds = {each.id: _kind_of(each)._replace(bag=self._number) for each in connections}
        wanted = [each for each in connections if self._is_wanted(kinds[each.id], topics)]
        if not wanted:
            return
        n_missing = sum(each.msgcount for each in wanted)
        for message in messages_of(self._reader, {each.id: kinds[each.id] for each in wanted}):
            n_missing -= 1
            yield message
        if n_missing:
            self._lose(f"{n_missing} of the messages that its index has are missing")

    def _is_wanted(self, kind: MessageKind, topics: Collection[str]) -> bool:
        """Whether it is of one of the topics, whose messages must be encoded as CDR or of ROS 1."""
        if kind.topic in topics and kind.encoding not in _ENCODINGS:
            raise InputError(
                f"cannot read bag {self.path}: messages of {kind.topic} are encoded as "
                f"{kind.encoding[:40]!r}, expected 'cdr'"
            )
        return kind.topic in topics

    @contextmanager
    def _errors_in_one_line(self) -> Iterator[None]:
        """Turn whatever a reader stumbles over into one line.

        Damaged files make the libraries raise errors of many kinds. Only their code and that of the
        recovery runs inside, so no defect of the rest is hidden.
        """
        try:
            yield
        except (InputError, MissingDependencyError):
            raise
        except Exception as error:
            if _is_out_of_memory(error):
                raise InputError(
                    f"cannot read bag {self.path}: reading it takes more memory than any bag "
                    "should; it is damaged, or was made to do harm"
                ) from error
            raise InputError(
                f"cannot read bag {self.path}: it is cut off, damaged or of an unsupported kind "
                f"({reason_of(error)}); repair it with {_REPAIRS[_suffix(self.path)]}, or record "
                "it again"
            ) from error


def _opened(file: Path) -> Any:
    """A reader of rosbags, open."""
    try:
        from rosbags import rosbag1, rosbag2
    except ImportError as error:
        raise MissingDependencyError(
            "reading bags needs rosbags, which is not installed: pip install rosbags"
        ) from error
    if file.suffix == ".mcap":
        with file.open("rb") as mcap:
            mcap.seek(-min(_MCAP_FOOTER_SIZE, file.stat().st_size), 2)
            if mcap.read(8) == bytes(8):
                raise ValueError("it has no index")
    reader: Any = rosbag1.Reader(file) if file.suffix == ".bag" else rosbag2.Reader(file)
    reader.open()
    return reader


def _kind_of(connection: Any) -> MessageKind:
    encoding = getattr(connection.ext, "serialization_format", "ros1")
    return MessageKind.of(connection.topic, connection.msgtype, encoding)


def _is_out_of_memory(error: BaseException) -> bool:
    """Also in SQLite as rosbags uses it, whose error is of a kind of its own."""
    return isinstance(error, MemoryError) or type(error).__name__ == "NoMemError"


def message_blocks(messages: Iterable[Message], lose: Lose) -> Iterator[list[Message]]:
    """Messages in blocks that are neither long nor, if they do not grow suddenly, large; those that
    are not bytes with a time are left out, and those compressed one by one unpacked.
    """
    iterator = iter(messages)
    while rows := _next_rows(iterator):
        good = [row for row in rows if type(row[2]) is bytes and type(row[1]) is int]
        good = [row for row in good if 0 <= row[1] < 1 << 63]
        if len(good) < len(rows):
            lose("messages that are not bytes with a time were left out")
        # Plain CDR never begins so.
        if any(data.startswith(_ZSTD_MAGIC) for _, _, data in good):
            unpacked = [(kind, bag_ns, _unpacked(data)) for kind, bag_ns, data in good]
            good = [(kind, bag_ns, data) for kind, bag_ns, data in unpacked if data is not None]
            if len(good) < len(unpacked):
                lose("compressed messages that are damaged were left out")
        if good:
            yield good


def _next_rows(messages: Iterator[Message]) -> list[Message]:
    rows: list[Message] = []
    size = 0
    while len(rows) < BLOCK_SIZE and size < BLOCK_BYTES:
        piece = list(islice(messages, _PIECE_SIZE))
        if not piece:
            break
        rows += piece
        size += sum(map(sys.getsizeof, map(itemgetter(2), piece)))
    return rows


def _unpacked(data: bytes) -> bytes | None:
    """A message, unpacked if it is compressed; None if it is damaged."""
    zstd = _zstd()
    try:
        is_packed = data.startswith(_ZSTD_MAGIC)
        return bytes(zstd.decompress(data)) if is_packed else data
    except zstd.ZstdError:
        return None


def _zstd() -> Any:
    """The zstd module: Python's own from 3.14 on, its backport before."""
    if sys.version_info >= (3, 14):
        from compression import zstd as module
    else:
        import backports.zstd as module
    return module


# ---- files


class BagFiles:
    """The storage files of bags, opened; those compressed as a whole are unpacked first.

    Attributes
    ----------
    storages : list of Storage
        In the order of their start.
    notes : list of str
        What a person should know.
    """

    def __init__(self) -> None:
        self.storages: list[Storage] = []
        self.notes: list[str] = []
        self._memory = ReadingMemory()
        self._temporary: tempfile.TemporaryDirectory[str] | None = None

    def open(self, path: Path, number: int = 0) -> None:
        """Open the files of a bag, the one of this number.

        Raises
        ------
        InputError
            If there is no bag or it cannot be read; one line that names the path.
        """
        _check_path(path)
        for file in [path] if path.is_file() else _files_in(path):
            self.storages.append(Storage(file, self._readable(file), self._memory, number))
            if len(self.storages) > MOST_BAG_FILES:
                raise InputError(f"{path} has more than {MOST_BAG_FILES} files; read it in parts")
        self.storages.sort(key=lambda storage: (storage.start_ns is None, storage.start_ns or 0))

    def close(self) -> None:
        """Close the files, and remove what was unpacked."""
        for storage in self.storages:
            storage.close()
        if self._temporary:
            self._temporary.cleanup()

    def _readable(self, file: Path) -> Path:
        """The file as rosbags can read it: unpacked, and under a name that is not read as an
        address (``?``, ``#`` and ``%`` have a meaning for SQLite).
        """
        is_packed = file.suffix == ".zstd"
        if not is_packed and not re.search("[?#%]", str(file.absolute())):
            return file
        self._temporary = self._temporary or tempfile.TemporaryDirectory(prefix="hand_eye_calib_")
        target = Path(self._temporary.name, f"{len(self.storages)}{_suffix(file)}")
        if is_packed:
            self._unpack(file, target)
        else:
            target.symlink_to(file.absolute())
        return target

    def _unpack(self, file: Path, target: Path) -> None:
        """Unpack a file that is compressed as a whole, as far as it goes."""
        zstd, left = _zstd(), SMALLEST_UNPACKED + LARGEST_RATIO * file.stat().st_size
        with zstd.open(file, "rb") as packed, target.open("wb") as unpacked:
            while left >= 0:
                try:
                    piece = packed.read(_PIECE_BYTES)
                except (EOFError, zstd.ZstdError) as error:
                    self.notes.append(f"{file}: its compression is damaged ({reason_of(error)})")
                    return
                if not piece:
                    return
                left -= len(piece)
                unpacked.write(piece)
        raise InputError(
            f"cannot read bag {file}: its content unpacks to more than {LARGEST_RATIO} times its "
            "size, which is not believable"
        )


def _files_in(path: Path) -> list[Path]:
    """The files of a directory that hold messages; those that are there unpacked, too, once."""
    found = {file for file in path.iterdir() if _suffix(file) and file.is_file()}
    found -= {
        file for file in found if file.name.endswith(".zstd") and file.with_suffix("") in found
    }
    if not found:
        raise InputError(
            f"no bag in {path}: expected files that end in {', '.join(_REPAIRS)}; check the path"
        )
    return sorted(found)


def _suffix(file: Path) -> str:
    """.mcap, .db3 or .bag, also of a compressed file; empty for any other."""
    suffix = PurePath(file.name.removesuffix(".zstd")).suffix
    return suffix if suffix in _REPAIRS else ""


def _check_path(path: Path) -> None:
    """Refuse mistakes that are easily made and easily explained."""
    if not path.exists():
        raise InputError(f"no bag at {path}; expected {_EXPECTED}")
    if not path.is_dir() and not _suffix(path):
        raise InputError(f"{path} is not a bag; expected {_EXPECTED}")
    if not path.is_dir() and not path.is_file():
        raise InputError(f"{path} is not a regular file; expected {_EXPECTED}")
    if path.is_file() and path.stat().st_size == 0:
        raise InputError(f"bag {path} is an empty file; record it again")
