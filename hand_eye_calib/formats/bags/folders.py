"""Find the storage files of a bag, unpack them and open them."""

import shlex
import shutil
import sqlite3
import tempfile
from collections.abc import Iterable
from contextlib import ExitStack, closing, suppress
from importlib.util import find_spec
from operator import attrgetter
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.text import listing, share
from hand_eye_calib.formats import files
from hand_eye_calib.formats.bags.roles import parent_and_child
from hand_eye_calib.formats.bags.storage import (
    REPAIRS,
    RosbagsFile,
    Storage,
    printable_name,
    reason_of,
    zstd_module,
)
from hand_eye_calib.formats.saved_results import refuse_saved_result
from hand_eye_calib.formats.trajectory_files.file_options import (
    AUTO,
    FileOptions,
)
from hand_eye_calib.formats.trajectory_files.text_files import read_table
from hand_eye_calib.formats.yaml_files import read_yaml

# Possible paths of a bag, for messages.
_EXPECTED = (
    "a rosbag2 directory, a .mcap or .db3 file of one, or a rosbag1 .bag file"
)
# Endings of files that SQLite keeps beside a .db3 while writing. If the recorder was killed, they
# contain the newest messages.
_UNFINISHED = ("-wal", "-journal")
_METADATA = "metadata.yaml"
# Largest number of missing files that a message lists by name.
_MOST_NAMED = 5
# Suffixes of files that may be trajectories.
_TABLES = (".tum", ".csv", ".txt", ".tsv")
# Largest number of such files that are read in a folder without a bag.
_MOST_TABLES = 20
# Smallest number of poses of such a trajectory: the default of min_pairs.
_FEWEST_POSES = 10


def open_bags(paths: Iterable[Path], opened: ExitStack) -> list[Storage]:
    """Open the storage files of bags. Return them in the order of their first messages.

    Completely compressed files are unpacked into a temporary folder. ``opened`` closes the files
    and removes these folders.

    Raises
    ------
    InputError
        If a path is not a bag, or a bag cannot be read.
    """
    storages = list[Storage]()
    for file in [file for path in paths for file in _files_of(path)]:
        unfinished = _unfinished(file)
        readable = file
        loss = ""
        if file.suffix == ".zstd" or unfinished:
            folder = opened.enter_context(
                tempfile.TemporaryDirectory(prefix="hand_eye_calib_")
            )
            readable = Path(folder, f"unpacked{_suffix(file)}")
            if unfinished:
                _complete(file, unfinished, readable)
            else:
                loss = _unpack(file, readable)
        storage_type: type[Storage] = RosbagsFile
        if readable.suffix == ".mcap" and find_spec("mcap"):
            from hand_eye_calib.formats.bags.mcap_file import McapFile

            storage_type = McapFile
        storage = storage_type([file, *unfinished], readable, opened)
        if loss:
            storage.losses.insert(0, loss)
        storages.append(storage)
    return sorted(storages, key=attrgetter("span_ns"))


def _unfinished(file: Path) -> list[Path]:
    """Return the files beside a .db3 with the newest messages, which are not merged yet."""
    if file.suffix != ".db3":
        return []
    paths = [file.with_name(f"{file.name}{suffix}") for suffix in _UNFINISHED]
    return [path for path in paths if path.is_file() and path.stat().st_size]


def _complete(file: Path, unfinished: Iterable[Path], copy: Path) -> None:
    """Copy a database with its unfinished files, and merge them in the copy.

    SQLite writes into the folder of a database even to read it, and the folder of the user must not
    change. So a copy is needed.
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
            f"cannot read bag {file}: its recorder was stopped, and its "
            "newest messages are in "
            f"{', '.join(path.name for path in unfinished)}. Merging them "
            f"into a copy in {copy.parent.parent} failed "
            f"({reason_of(error)}); set TMPDIR to a folder with more space, "
            f"or repair the bag with {REPAIRS['.db3']}"
        ) from error


def _unpack(file: Path, target: Path) -> str:
    """Unpack a completely compressed file.

    A damaged file is unpacked up to the damage. The result is a line about the damage, and empty
    for an intact file.
    """
    zstd = zstd_module()
    max_bytes = files.LARGEST_RATIO * file.stat().st_size
    n_bytes = 0
    with zstd.open(file, "rb") as packed, target.open("wb") as unpacked:
        try:
            while piece := packed.read(files.BLOCK_BYTES):
                n_bytes += unpacked.write(piece)
                if n_bytes > max_bytes:
                    raise InputError(
                        f"cannot read bag {file}: it unpacks to more than "
                        f"{files.LARGEST_RATIO} times its size, so it is damaged; copy it again"
                    )
        except (EOFError, zstd.ZstdError) as error:
            return f"its compression is damaged ({reason_of(error)})"
    return ""


def _files_of(path: Path) -> list[Path]:
    """Return the storage files of a bag.

    A compressed file is skipped if the same file also exists uncompressed.

    Raises
    ------
    InputError
        If the path is not a bag, or its folder contains no storage files.
    """
    if not path.is_dir():
        if _suffix(path) and path.is_file():
            return [path]
        if path.exists():
            raise InputError(f"{path} is not a bag; expected {_EXPECTED}")
        raise InputError(
            f"no bag at {path}{files.similar(path) or f'; expected {_EXPECTED}'}"
        )
    paths = {
        file for file in path.iterdir() if _suffix(file) and file.is_file()
    }
    if not paths:
        raise InputError(_no_files(path))
    return sorted(
        file
        for file in paths
        if file.suffix != ".zstd" or file.with_suffix("") not in paths
    )


def _no_files(folder: Path) -> str:
    """Return the message for a folder without storage files: what is missing, or where bags are.

    Raises
    ------
    InputError
        If the folder is a saved result.
    """
    missing = missing_files(folder).n_messages
    if missing:
        return (
            f"no messages in {folder}: its {_METADATA} lists "
            f"{_listing(missing)}, and no such file is there; copy the whole "
            "bag"
        )
    refuse_saved_result(folder)
    for subfolder in sorted(
        file.parent for file in [*folder.glob("*/*"), *folder.glob("*/*/*")]
    ):
        if any(map(_suffix, subfolder.iterdir())):
            return (
                f"no bag in {folder} itself, but in {subfolder}: pass {subfolder}, or all bags "
                f"below: hand_eye_calib batch {folder}"
            )
    trajectories = _trajectories_in(folder)
    if len(trajectories) > 1:
        task = "run" if len(trajectories) == 2 else "for two of them, run"
        return (
            f"no bag in {folder}, but {len(trajectories)} trajectory files; {task}: hand_eye_calib "
            f"calibrate {shlex.join(map(str, trajectories[:2]))} (parent first)"
        )
    return f"no bag in {folder}: expected files that end in {', '.join(REPAIRS)}; check the path"


def _trajectories_in(folder: Path) -> list[Path]:
    """Return the files of a folder that are trajectories with stamps, the likeliest parent first.

    Of files with the same stem, only one is returned. A file of a few poses is no trajectory: it
    may contain an extrinsic.
    """
    trajectories = {}
    candidates = [
        path for path in sorted(folder.iterdir()) if path.suffix in _TABLES
    ]
    for path in candidates[:_MOST_TABLES]:
        with suppress(InputError):
            table = read_table(path, FileOptions(format=AUTO))
            has_poses = len(table.rows) >= _FEWEST_POSES
            if has_poses and table.stamps and table.at:
                trajectories[path.stem] = path
    stems = parent_and_child([*trajectories], {}, {})
    return [trajectories[stem] for stem in stems]


class MissingFiles(NamedTuple):
    """Files that the metadata of a bag list, but that are missing in its folder.

    Attributes
    ----------
    n_messages : dict of str to int
        Number of messages of each missing file, by file name. None if the metadata have no number;
        any type if they are damaged.
    n_in_bag : int
        Number of messages of the whole bag, or None or any type for the same reasons.
    """

    n_messages: dict[str, Any]
    n_in_bag: Any


def missing_files(folder: Path) -> MissingFiles:
    """Compare the files that ``metadata.yaml`` lists with those in the folder of a bag."""
    present = {file.name.removesuffix(".zstd") for file in folder.iterdir()}
    missing = {}
    n_in_bag = None
    # The metadata may be missing or damaged.
    with suppress(InputError, AttributeError, TypeError, KeyError):
        metadata = read_yaml(folder / _METADATA)["rosbag2_bagfile_information"]
        counts = {
            file["path"]: file["message_count"]
            for file in metadata.get("files") or ()
        }
        for path in map(str, metadata["relative_file_paths"]):
            name = printable_name(PurePath(path).name)
            if name.removesuffix(".zstd") not in present:
                missing[name] = counts.get(path)
        n_in_bag = metadata.get("message_count")
    return MissingFiles(missing, n_in_bag)


def _listing(names: Iterable[str]) -> str:
    """Return names as text; of a long list, the first names and the number of the rest."""
    listed = [*names]
    if len(listed) > _MOST_NAMED:
        listed[_MOST_NAMED:] = [f"{len(listed) - _MOST_NAMED} more"]
    return listing(listed)


def losses_of(path: Path, n_present: int) -> list[str]:
    """Return a line about missing files of a bag, and the share of the messages in these files.

    The line is in a list, which is empty if no file is missing. ``n_present`` is the number of
    messages in the present files.
    """
    if not path.is_dir():
        return []
    missing, n_in_bag = missing_files(path)
    if not missing:
        return []
    counts = [count for count in missing.values() if isinstance(count, int)]
    n_missing = sum(counts)
    # If the number is unknown for a file, use the number of messages of the whole bag.
    if len(counts) < len(missing):
        n_missing = (
            max(n_in_bag - n_present, 0) if isinstance(n_in_bag, int) else 0
        )
    verb = "is" if len(missing) == 1 else "are"
    line = (
        f"{path}: {_METADATA} lists {_listing(missing)}, which {verb} missing"
    )
    if n_missing:
        n_all = n_missing + n_present
        line += f": {n_missing:,} of {n_all:,} messages ({share(n_missing / n_all)}) are not read"
    return [f"{line}; copy the whole bag"]


def _suffix(file: Path) -> str:
    """Return .mcap, .db3 or .bag, also for a compressed file; empty for other files."""
    suffix = PurePath(file.name.removesuffix(".zstd")).suffix
    return suffix if suffix in REPAIRS else ""
