"""The files of a bag: found, unpacked and opened."""

import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import Any

from hand_eye_calib.errors import InputError, MissingDependencyError
from hand_eye_calib.io.bags.decompression import Budget, open_zstd
from hand_eye_calib.io.bags.mcap import McapFile
from hand_eye_calib.io.bags.rosbag1 import Rosbag1File
from hand_eye_calib.io.bags.sqlite import SqliteFile
from hand_eye_calib.io.bags.storage import Storage
from hand_eye_calib.io.limits import MOST_BAG_FILES
from hand_eye_calib.io.yaml_files import read_yaml

_EXPECTED = "a rosbag2 directory, a .mcap or .db3 file of one, or a rosbag1 .bag file"
_READERS: dict[str, Callable[[Path], Storage]] = {
    ".mcap": McapFile,
    ".db3": SqliteFile,
    ".bag": Rosbag1File,
}
_REPAIRS = {
    ".bag": "'rosbag reindex'",
    ".db3": "sqlite3's '.recover'",
    ".mcap": "'mcap recover'",
}
_PIECE = 1 << 20


class BagFiles:
    """The storage files of a bag, opened; those compressed as a whole are unpacked first.

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
        self._temporary: tempfile.TemporaryDirectory[str] | None = None

    def open(self, path: Path) -> None:
        """Open the files of a bag.

        Raises
        ------
        InputError
            If there is no bag or it cannot be read; one line that names the path.
        """
        _check_path(path)
        for file in [path] if path.is_file() else self._files_in(path):
            with reading(file):
                unpacked = self._unpacked(file) if file.suffix == ".zstd" else file
                storage = _READERS[unpacked.suffix](unpacked)
                storage.path = file
            self.storages.append(storage)
            if len(self.storages) > MOST_BAG_FILES:
                raise InputError(f"{path} has more than {MOST_BAG_FILES} files; read it in parts")
        self.storages.sort(key=lambda storage: (storage.start_ns is None, storage.start_ns or 0))

    def close(self) -> None:
        """Close the files, and remove what was unpacked."""
        for storage in self.storages:
            storage.close()
        if self._temporary:
            self._temporary.cleanup()

    def _files_in(self, path: Path) -> list[Path]:
        """The files that hold a bag's messages, in order."""
        files = self._listed_files(path) if (path / "metadata.yaml").exists() else None
        if files is None:
            files = sorted(filter(_storage_suffix, path.iterdir()), key=_natural_order)
        if not files:
            raise InputError(
                f"no bag in {path}: expected metadata.yaml or files that end in "
                f"{', '.join(_READERS)}; check the path"
            )
        return files

    def _listed_files(self, path: Path) -> list[Path] | None:
        """The files that metadata.yaml names; None if it cannot be used."""
        try:
            names = _relative_file_paths(read_yaml(path / "metadata.yaml"))
        except InputError as error:
            self.notes.append(
                f"{path / 'metadata.yaml'} is damaged ({error}); "
                "the files beside it were read instead"
            )
            return None
        named = [path / name for name in dict.fromkeys(names)]
        found = [file for file in named if file.is_file() and _storage_suffix(file)]
        if not found:
            self.notes.append(
                f"{path / 'metadata.yaml'} names none of the files beside it; "
                "they were read instead"
            )
            return None
        missing = [file.name for file in named if not file.is_file()]
        if missing:
            self.notes.append(
                f"{path}: {', '.join(missing[:10])} of {len(names)} files in metadata.yaml is "
                "missing; its messages are left out"
            )
        return found

    def _unpacked(self, file: Path) -> Path:
        """Unpack a file into a temporary folder; returns where it is."""
        self._temporary = self._temporary or tempfile.TemporaryDirectory(prefix="hand_eye_calib_")
        target = Path(self._temporary.name, f"{len(self.storages)}_{file.stem}")
        budget = Budget(file.stat().st_size)
        with file.open("rb") as raw, open_zstd(raw) as source, target.open("wb") as unpacked:
            while piece := source.read(_PIECE):
                budget.spend(len(piece))
                unpacked.write(piece)
        return target


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn whatever a reader stumbles over into one line.

    Damaged files make sqlite3, lz4 and zstd raise errors of many kinds. Only the code of readers
    runs inside, so no defect of the rest is hidden.
    """
    try:
        yield
    except (InputError, MissingDependencyError, ModuleNotFoundError):
        raise
    except Exception as error:
        reason = " ".join([f"{type(error).__name__}:", *str(error).split()]).rstrip(".:")
        repair = _REPAIRS.get(_storage_suffix(path), "'mcap recover'")
        raise InputError(
            f"cannot read bag {path}: it is cut off, damaged or of an unsupported kind ({reason}); "
            f"repair it with {repair}, or record it again"
        ) from error


def _relative_file_paths(document: Any) -> list[str]:
    """Names of the storage files in a metadata.yaml."""
    try:
        names = document["rosbag2_bagfile_information"]["relative_file_paths"]
        return [PurePath(name).name for name in names]
    except (LookupError, TypeError) as error:
        raise InputError(f"it names no files: {type(error).__name__}") from None


def _storage_suffix(file: Path) -> str:
    """.mcap, .db3 or .bag, also of a compressed file; empty for any other."""
    suffix = PurePath(file.name.removesuffix(".zstd")).suffix
    return suffix if suffix in _READERS else ""


def _natural_order(file: Path) -> list[tuple[int, str]]:
    """Sort part 10 after part 9."""
    parts = re.split(r"(\d{1,18})", file.name)
    return [(int(text), "") if text.isdecimal() else (-1, text) for text in parts]


def _check_path(path: Path) -> None:
    """Refuse mistakes that are easily made and easily explained."""
    if not path.exists():
        raise InputError(f"no bag at {path}; expected {_EXPECTED}")
    if not path.is_dir() and not _storage_suffix(path):
        raise InputError(f"{path} is not a bag; expected {_EXPECTED}")
    if not path.is_dir() and not path.is_file():
        raise InputError(f"{path} is not a regular file; expected {_EXPECTED}")
    if path.is_file() and path.stat().st_size == 0:
        raise InputError(f"bag {path} is an empty file; record it again")
