"""The storage files of bags: found, unpacked, and read through the libraries rosbags (sqlite3,
rosbag1) and mcap.
"""

import shutil
import sqlite3
import struct
import sys
import tempfile
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import lru_cache
from importlib import import_module
from importlib.util import find_spec
from io import BufferedReader, BytesIO
from operator import attrgetter, itemgetter
from pathlib import Path, PurePath
from typing import Any, NamedTuple, TypeAlias
from urllib.parse import quote

import numpy as np

from hand_eye_calib.core.base.errors import InputError, MissingDependencyError, printable, required
from hand_eye_calib.core.base.text import listing, share
from hand_eye_calib.formats import files
from hand_eye_calib.formats.yaml_files import read_yaml

_EXPECTED = "a rosbag2 directory, a .mcap or .db3 file of one, or a rosbag1 .bag file"
_REPAIRS = {".mcap": "'mcap recover'", ".db3": "sqlite3's '.recover'", ".bag": "'rosbag reindex'"}
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
# Files of SQLite beside a .db3 whose recorder was killed: they hold its newest messages.
_UNFINISHED = ("-wal", "-journal")
_METADATA = "metadata.yaml"
# Missing files that a message names.
_MOST_NAMED = 5


class MessageKind(NamedTuple):
    """What the messages of a topic have in common; encoding is "cdr", "ros1", "json" or "protobuf"
    of what can be read, definition the language and the content of what describes them.
    """

    topic: str
    type: str
    encoding: str
    definition: tuple[str, bytes] = ("", b"")

    @property
    def is_ros1(self) -> bool:
        """Whether they are packed as by ROS 1."""
        return self.encoding == "ros1"


# A message as it was recorded: its kind, its bag time in ns and its bytes.
Message: TypeAlias = tuple[MessageKind, int, bytes]


@lru_cache
def _kind(topic: str, name: str, encoding: str, language: str, content: bytes) -> MessageKind:
    """The kind of a connection, one for all that are alike, with names as they can be printed."""
    if encoding == "ros1" and name.count("/") == 1:  # as ROS 1 itself names types
        name = name.replace("/", "/msg/")
    topic, name = (printable(each[: files.LONGEST_NAME]) for each in (topic, name))
    return MessageKind(topic, name, encoding, (language, content))


class Storage(ABC):
    """A storage file opened for reading, until ``opened`` is closed: ``path`` is its name for a
    person, ``file`` where it is, unpacked, ``files`` are those that it was read from. An InputError
    if nothing in it can be read.

    ``counts`` has the number of messages of each kind, ``span_ns`` the bag times of the first and
    the last, if there are any, and ``losses`` what could not be read, one line each.
    """

    repair = ""

    def __init__(self, path: Path, file: Path, opened: ExitStack) -> None:
        self.path = path
        self._file = file
        self.files = [path, *_unfinished(path)]
        self.counts = Counter[MessageKind]()
        self.span_ns: tuple[int, ...] = ()
        self.losses: list[str] = []
        # By the number of a topic or channel in the file.
        self._kinds: dict[int, MessageKind] = {}
        with self._guarded():
            self._open(opened)

    @abstractmethod
    def _open(self, opened: ExitStack) -> None: ...

    @abstractmethod
    def _messages(self, kinds: Mapping[int, MessageKind]) -> Iterable[Message]: ...

    def blocks(self, topics: Collection[str]) -> Iterator[list[Message]]:
        """Iterate over the messages of some topics in the order of bag time, many at once. Chunks
        of mcap that overlap come one after the other.
        """
        kinds = {key: kind for key, kind in self._kinds.items() if kind.topic in topics}
        blocks = message_blocks(self._messages(kinds) if kinds else ())
        block = None
        while block != []:
            with self._guarded():
                block = next(blocks, [])
            yield block

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Limit the memory, and turn whatever a reader stumbles over into one line.

        Damaged files make the libraries raise errors of many kinds. Only they and the recovery run
        inside, so no defect of the rest is hidden.
        """
        try:
            with files.reading_memory():
                yield
        except MissingDependencyError:
            raise
        except Exception as error:
            why = (
                f"it is cut off, damaged or of an unsupported kind ({_reason_of(error)}); repair "
                f"it with {self.repair or _REPAIRS[_suffix(self.path)]}, or record it again"
            )
            # NoMemError is SQLite's, as rosbags uses it.
            if isinstance(error, MemoryError) or type(error).__name__ == "NoMemError":
                why = "reading it takes more memory than any bag should; it is damaged, or hostile"
            raise InputError(f"cannot read bag {self.path}: {why}") from error


class RosbagsFile(Storage):
    """A .db3 or .bag file, through the library rosbags; and a whole .mcap file of ROS 2 where the
    library mcap, which rosdep does not have, is not installed.
    """

    def _open(self, opened: ExitStack) -> None:
        self._reader = reader = rosbags(1 if self._file.suffix == ".bag" else 2).Reader(self._file)
        if self._file.suffix == ".db3":  # whose path SQLite reads as an address
            reader.storage.path = Path(quote(str(self._file)))
        if self._file.suffix == ".mcap":
            self.repair = "the library that reads what is left, 'pip install mcap'"
        reader.open()
        opened.callback(reader.close)
        if self.repair:
            counts = (sum(each.channel_count.values()) for each in reader.storage.chunks)
            if sum(counts) != reader.message_count:
                raise ValueError("it has no index of its messages")
        for each in reader.connections:
            encoding = getattr(each.ext, "serialization_format", "ros1")
            definition = each.msgdef.format.name, each.msgdef.data.encode()
            self._kinds[each.id] = _kind(each.topic, each.msgtype, encoding, *definition)
            self.counts[self._kinds[each.id]] += each.msgcount
        if reader.message_count:
            self.span_ns = reader.start_time, reader.end_time - 1

    def _messages(self, kinds: Mapping[int, MessageKind]) -> Iterable[Message]:
        if self._file.suffix == ".bag":
            return self._of_chunks(kinds)
        wanted = [each for each in self._reader.connections if each.id in kinds]
        messages = self._reader.messages(wanted)
        return ((kinds[each.id], bag_ns, data) for each, bag_ns, data in messages)

    def _of_chunks(self, kinds: Mapping[int, MessageKind]) -> Iterator[Message]:
        """Messages of rosbag1, from where the library has found them: its own reading is slow."""
        reader = self._reader
        at = -1
        chunk = b""
        found = [(each, kind) for key, kind in kinds.items() for each in reader.indexes[key]]
        for entry, kind in sorted(found, key=lambda each: each[0].time):
            if entry.chunk_pos != at:
                at = entry.chunk_pos
                about = reader.chunks[entry.chunk_pos]
                reader.bio.seek(about.datapos)
                chunk = about.decompressor(reader.bio.read(about.datasize))
            end = entry.offset
            is_message = False
            while not is_message:  # or the record of a connection, before its first message
                begin = end + _LENGTH.size + _LENGTH.unpack_from(chunk, end)[0]
                is_message = b"op=\x02" in chunk[end:begin]
                end = begin + _LENGTH.size + _LENGTH.unpack_from(chunk, begin)[0]
            if end > len(chunk):
                raise EOFError("a chunk ends in the middle of a record")
            yield kind, entry.time, chunk[begin + _LENGTH.size : end]


# Opcode and length of a record; channel, number, log time and time of publication of a message.
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<H4xQ8x")
_LENGTH = struct.Struct("<I")


class McapFile(Storage):
    """An mcap file, through the library mcap: by its index if it is whole, otherwise record by
    record up to the first that is damaged; of a chunk that is cut off, what is there.
    """

    def _open(self, opened: ExitStack) -> None:
        from mcap.reader import make_reader

        self._stream = _WholeReads(opened.enter_context(self._file.open("rb", buffering=0)))
        self._chunks: list[Any] | None = None
        try:
            summary: Any = make_reader(self._stream).get_summary()
            about = summary.statistics
            chunks = summary.chunk_indexes
            found = len(summary.channels), len(chunks), bool(chunks)
            if found != (about.channel_count, about.chunk_count, about.message_count > 0):
                raise ValueError("it has no index of its messages")
        except MemoryError:
            raise
        except Exception as error:
            self._search(error)
            return
        self._chunks = sorted(chunks, key=attrgetter("message_start_time"))
        for key, channel in summary.channels.items():
            self._add_kind(channel, summary.schemas)
            self.counts[self._kinds[key]] += about.channel_message_counts.get(key, 0)
        if about.message_count:
            self.span_ns = about.message_start_time, about.message_end_time

    def _add_kind(self, channel: Any, schemas: Mapping[int, Any]) -> None:
        schema = schemas.get(channel.schema_id)
        definition = (schema.encoding, schema.data) if schema else ("", b"")
        about = schema.name if schema else "", channel.message_encoding, *definition
        self._kinds[channel.id] = _kind(channel.topic, *about)

    def _search(self, reason: Exception) -> None:
        """Count what is in a file without an index."""
        schemas = {}
        times_ns = []
        for record in self._records(self.losses):
            kind = type(record).__name__
            if kind == "Schema":
                schemas[record.id] = record
            elif kind == "Channel":
                self._add_kind(record, schemas)
            elif kind == "Message" and record.channel_id in self._kinds:
                self.counts[self._kinds[record.channel_id]] += 1
                times_ns.append(record.log_time)
        if self.losses and not times_ns:
            raise ValueError(f"{self.losses[0]}, and nothing before that can be read") from reason
        if times_ns:
            self.span_ns = min(times_ns), max(times_ns)
            about = f"{len(times_ns)} messages covering {np.ptp(self.span_ns) * 1e-9:.1f}"
            self.losses = [f"{loss}; recovered are {about} s" for loss in self.losses]

    def _messages(self, kinds: Mapping[int, MessageKind]) -> Iterable[Message]:
        from mcap import data_stream, records, stream_reader

        if self._chunks is None:
            for record in self._records([]):  # what is lost was told when it was opened
                if isinstance(record, records.Message) and record.channel_id in kinds:
                    yield kinds[record.channel_id], record.log_time, record.data
        for index in self._chunks or ():
            channels = index.message_index_offsets
            if not channels or kinds.keys() & channels.keys():
                self._stream.seek(index.chunk_start_offset + _RECORD.size)
                chunk = records.Chunk.read(data_stream.ReadDataStream(self._stream))
                stream, size = stream_reader.get_chunk_data_stream(chunk, validate_crc=True)
                found = _messages_of_chunk(bytes(stream.read(size)), kinds)
                yield from sorted(found, key=itemgetter(1))

    def _records(self, losses: list[str]) -> Iterator[Any]:
        from mcap import data_stream, opcode, records, stream_reader

        position = self._stream.seek(0)
        try:
            for record in stream_reader.StreamReader(self._stream, validate_crcs=True).records:
                yield record
                position = self._stream.tell()
        except MemoryError:
            raise
        except Exception as error:
            losses.append(f"it is cut off or damaged ({_reason_of(error)}), the rest is lost")
            if not isinstance(error, EOFError):
                return
            # Of a chunk that is cut off, the records before that.
            with suppress(Exception), self._file.open("rb") as file:
                file.seek(position)
                if file.read(_RECORD.size)[0] == opcode.Opcode.CHUNK:
                    chunk = records.Chunk.read(data_stream.ReadDataStream(file))
                    if chunk.compression == "zstd":
                        zstd = stream_reader.zstandard.ZstdDecompressor().decompressobj()
                        chunk.data = zstd.decompress(chunk.data)
                    elif chunk.compression == "lz4":
                        # Before 1.6 the module has the package of that name instead of its part.
                        lz4 = getattr(stream_reader.lz4, "frame", stream_reader.lz4)
                        chunk.data = lz4.LZ4FrameDecompressor().decompress(chunk.data)
                    rest = _WholeReads(BytesIO(chunk.data))
                    yield from stream_reader.StreamReader(rest, skip_magic=True).records


def _messages_of_chunk(content: bytes, kinds: Mapping[int, MessageKind]) -> Iterator[Message]:
    """The messages of some channels in the records of an mcap chunk. The library's own iteration
    takes several times as long.
    """
    from mcap.opcode import Opcode

    position = 0
    of_message = int(Opcode.MESSAGE)
    while position < len(content):
        opcode, size = _RECORD.unpack_from(content, position)
        start = position + _RECORD.size
        position = position + _RECORD.size + size
        if position > len(content):
            raise EOFError("a chunk ends in the middle of a record")
        if opcode == of_message:
            key, bag_ns = _MESSAGE.unpack_from(content, start)
            if key in kinds:
                yield kinds[key], bag_ns, content[start + _MESSAGE.size : position]


class _WholeReads(BufferedReader):
    """A file that never returns less than was asked for: the library mcap takes that for a whole
    record.
    """

    def read(self, size: int | None = -1) -> bytes:
        # A damaged length is not worth the memory: before 1.6 the library believes it.
        data = super().read(size) if (size or 0) < files.LARGEST else b""
        if len(data) < (size or 0):
            raise EOFError("it ends in the middle of a record")
        return data


def _reason_of(error: BaseException) -> str:
    """Kind and text of an error in one line."""
    return " ".join([f"{type(error).__name__}:", *str(error).split()]).rstrip(".:")


def rosbags(version: int) -> Any:
    """The library's module for bags of ROS 1 or ROS 2."""
    return required(f"rosbags.rosbag{version}", "this bag", "rosbags")


def message_blocks(messages: Iterable[Message]) -> Iterator[list[Message]]:
    """Messages in blocks; those compressed one by one are unpacked."""
    rows = list[Message]()
    size = 0
    for kind, bag_ns, data in messages:
        if data.startswith(_ZSTD_MAGIC):  # as plain CDR never does
            data = bytes(_zstd().decompress(data))
        rows.append((kind, int(bag_ns), data))
        size += len(data)
        if size > files.BLOCK_BYTES:
            yield rows
            rows = []
            size = 0
    if rows:
        yield rows


def _zstd() -> Any:
    """The zstd module: Python's own from 3.14 on, its backport before."""
    return import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")


# ---- files


def open_bags(paths: Iterable[Path], opened: ExitStack) -> list[Storage]:
    """The storage files of bags in the order of their start; those compressed as a whole are
    unpacked first. An InputError if there is no bag or it cannot be read.
    """
    storages = list[Storage]()
    for file in [file for path in paths for file in _files_of(path)]:
        readable, loss = _readable(file, opened)
        is_mcap = _suffix(file) == ".mcap" and find_spec("mcap")
        kind = McapFile if is_mcap else RosbagsFile
        storage: Storage = kind(file, readable, opened)
        if loss:
            storage.losses.insert(0, loss)
        storages.append(storage)
    return sorted(storages, key=attrgetter("span_ns"))


def _readable(file: Path, opened: ExitStack) -> tuple[Path, str]:
    """Return a file that can be read as it is, and what could not be unpacked.

    This is the file itself, or a temporary copy until ``opened`` is closed: unpacked if the file is
    compressed as a whole, complete if its recorder was killed.
    """
    unfinished = _unfinished(file)
    if file.suffix != ".zstd" and not unfinished:
        return file, ""
    folder = tempfile.TemporaryDirectory(prefix="hand_eye_calib_")
    copy = Path(opened.enter_context(folder), f"unpacked{_suffix(file)}")
    if file.suffix == ".zstd":
        return copy, _unpack(file, copy)
    _complete(file, unfinished, copy)
    return copy, ""


def _unfinished(file: Path) -> list[Path]:
    """Return the files of SQLite beside a .db3 without which messages would be missing."""
    if file.suffix != ".db3":
        return []
    beside = [file.with_name(f"{file.name}{suffix}") for suffix in _UNFINISHED]
    return [path for path in beside if path.is_file() and path.stat().st_size]


def _complete(file: Path, unfinished: Iterable[Path], copy: Path) -> None:
    """Copy a database with the files beside it, and let SQLite finish the copy.

    SQLite writes beside a database even if it only reads, and the user's folder must stay as it is.
    """
    try:
        shutil.copyfile(file, copy)
        for path in unfinished:
            shutil.copyfile(path, f"{copy}{path.name.removeprefix(file.name)}")
        with closing(sqlite3.connect(copy)) as database:
            database.execute("PRAGMA journal_mode=DELETE").fetchall()
            database.execute("SELECT count(*) FROM sqlite_master").fetchall()
    except (OSError, sqlite3.Error) as error:
        raise InputError(
            f"cannot read bag {file}: its recorder was stopped, and its newest messages are in "
            f"{', '.join(path.name for path in unfinished)}, which cannot be added to a copy in "
            f"{copy.parent.parent} ({_reason_of(error)}); set TMPDIR to a folder with more space, "
            f"or repair the bag with {_REPAIRS['.db3']}"
        ) from error


def _unpack(file: Path, target: Path) -> str:
    """Unpack a file that is compressed as a whole, as far as it goes; what is lost."""
    zstd = _zstd()
    most = files.LARGEST_RATIO * file.stat().st_size
    with zstd.open(file, "rb") as packed, target.open("wb") as unpacked:
        try:
            for piece in iter(lambda: packed.read(files.BLOCK_BYTES), b""):
                if unpacked.tell() + unpacked.write(piece) > most:
                    raise InputError(
                        f"cannot read bag {file}: its content unpacks to more than "
                        f"{files.LARGEST_RATIO} times its size, which is not believable"
                    )
        except (EOFError, zstd.ZstdError) as error:
            return f"its compression is damaged ({_reason_of(error)})"
    return ""


def _files_of(path: Path) -> list[Path]:
    """The files of a bag that hold messages; those that are there unpacked, too, once."""
    if not path.is_dir():
        if not (_suffix(path) and path.is_file()):
            what = f"{path} is not a bag" if path.exists() else f"no bag at {path}"
            raise InputError(f"{what}; expected {_EXPECTED}")
        return [path]
    found = {file for file in path.iterdir() if _suffix(file) and file.is_file()}
    found -= {file for file in found if file.suffix == ".zstd" and file.with_suffix("") in found}
    if not found:
        missing, _ = missing_files(path)
        if missing:
            raise InputError(
                f"no messages in {path}: its {_METADATA} lists {_listing(missing)}, missing there; "
                "copy the whole bag"
            )
        near = sorted(file.parent for depth in ("*/*", "*/*/*") for file in path.glob(depth))
        below = next((folder for folder in near if any(map(_suffix, folder.iterdir()))), "")
        raise InputError(
            f"no bag in {path}: expected files that end in {', '.join(_REPAIRS)}; "
            + (
                f"give {below}, or all below it with calibrate --batch {path}"
                if below
                else "check the path"
            )
        )
    return sorted(found)


class Listed(NamedTuple):
    """A storage file that the metadata of a rosbag2 lists; messages are None if not counted."""

    name: str
    messages: int | None


def missing_files(path: Path) -> tuple[list[Listed], int | None]:
    """Return the files that ``metadata.yaml`` lists and the directory of a bag lacks.

    The second value is the number of messages of the whole bag; None if it is not stated.
    """
    listed: list[Listed] = []
    total = None
    with suppress(InputError, AttributeError, TypeError, KeyError):  # damaged, or not there
        about = read_yaml(path / _METADATA)["rosbag2_bagfile_information"]
        counts = {file["path"]: file["message_count"] for file in about.get("files") or ()}
        paths = [str(name) for name in about["relative_file_paths"]]
        listed = [Listed(_name_of(name), counts.get(name)) for name in paths]
        total = about.get("message_count")
    present = {file.name.removesuffix(".zstd") for file in path.iterdir()}
    missing = [file for file in listed if file.name.removesuffix(".zstd") not in present]
    return missing, total if isinstance(total, int) else None


def _name_of(path: str) -> str:
    return printable(PurePath(path).name[: files.LONGEST_NAME])


def _listing(missing: Collection[Listed]) -> str:
    names = [file.name for file in missing]
    if len(names) > _MOST_NAMED:
        names[_MOST_NAMED:] = [f"{len(names) - _MOST_NAMED} more"]
    return listing(names)


def losses_of(path: Path, n_present: int) -> list[str]:
    """Return a line that names the listed files which a directory lacks, and what share that is.

    ``n_present`` is the number of messages in the files that are there.
    """
    if not path.is_dir():
        return []
    missing, total = missing_files(path)
    if not missing:
        return []
    counts = [file.messages for file in missing if isinstance(file.messages, int)]
    n_missing = sum(counts)
    if len(counts) < len(missing):
        n_missing = max((total or 0) - n_present, 0)
    are = "is" if len(missing) == 1 else "are"
    line = f"{path}: {_METADATA} lists {_listing(missing)}, which {are} missing"
    if n_missing:
        lost = n_missing / (n_missing + n_present)
        line += (
            f": {n_missing:,} of {n_missing + n_present:,} messages ({share(lost)}) are not read"
        )
    return [f"{line}; copy the whole bag"]


def _suffix(file: Path) -> str:
    """.mcap, .db3 or .bag, also of a compressed file; empty for any other."""
    suffix = PurePath(file.name.removesuffix(".zstd")).suffix
    return suffix if suffix in _REPAIRS else ""
