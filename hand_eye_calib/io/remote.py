"""Bags in object storage and on web servers: whatever fsspec reaches, such as
``s3://bucket/run_1``, ``gs://...``, ``https://host/run_1.mcap``.

A bag is copied by fsspec to a temporary folder, read there, and the copy removed.
"""

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from hand_eye_calib.errors import HandEyeCalibError, InputError, MissingDependencyError
from hand_eye_calib.io.limits import MOST_BAG_FILES

AsGiven = Callable[[Any], Any]

_MARK = "://"
# Files of a bag, as their names end.
_SUFFIXES = (".yaml", ".mcap", ".db3", ".bag", ".zstd")


def is_url(path: object) -> bool:
    """Whether a bag is named by a URL rather than a path."""
    return _MARK in str(path)


def public(url: str) -> str:
    """A URL without what gives access: user and password, and a signature in its query.

    Paths stay as they are.
    """
    if not is_url(url):
        return url
    protocol, _, rest = url.partition("?")[0].partition(_MARK)
    host, slash, path = rest.partition("/")
    return f"{protocol}{_MARK}{host.rpartition('@')[2]}{slash}{path}"


def expanded(pattern: str) -> list[str]:
    """URLs that a pattern with ``*`` stands for, sorted.

    Raises
    ------
    InputError
        If the store cannot be reached.
    MissingDependencyError
        If fsspec, or what it needs for the store, is not installed.
    """
    with _reached(pattern) as (system, path):
        return sorted(system.unstrip_protocol(found) for found in system.glob(path.rstrip("/")))


def states(url: str) -> list[str]:
    """What the store says of each file of a bag, such as size, date and digest, from which one sees
    whether it has changed.

    Raises
    ------
    InputError
        If the store cannot be reached, or there is no bag.
    """
    with _reached(url) as (system, path):
        return [str(sorted(system.info(name).items())) for name in _files(system, path)]


@contextmanager
def local_copies(paths: Sequence[Any]) -> Iterator[tuple[list[Any], AsGiven]]:
    """Paths of the same bags on this machine; what is remote is copied for as long as the block
    lasts. Errors raised in the block name the URLs.

    Yields
    ------
    paths : list
    as_given : callable
        Puts the URLs back into plain values that name the copies.

    Raises
    ------
    InputError
        If a store cannot be reached, there is no bag, or it would fill more than half of the disk.
    """
    if not any(map(is_url, paths)):
        yield list(paths), lambda value: value
        return
    with tempfile.TemporaryDirectory(prefix="hand_eye_calib_") as folder:
        names: dict[str, str] = {}
        local = []
        for number, path in enumerate(paths):
            if is_url(path):
                local.append(_copied(str(path), Path(folder, str(number))))
                names[str(local[-1])] = public(str(path)).rstrip("/")
            else:
                local.append(path)

        def renamed(value: Any) -> Any:
            text = json.dumps(value)
            for copy, url in names.items():
                text = text.replace(json.dumps(copy)[1:-1], json.dumps(url)[1:-1])
            return json.loads(text)

        try:
            yield local, renamed
        except HandEyeCalibError as error:
            error.args = tuple(renamed(list(error.args)))
            raise


def _copied(url: str, folder: Path) -> Path:
    """Copy the files of a bag into a new folder; returns where it is."""
    folder.mkdir()
    # Half of the free space is left to the copies of other processes.
    largest = shutil.disk_usage(folder).free // 2
    with _reached(url) as (system, path):
        from fsspec.callbacks import Callback

        class Room(Callback):
            """Ends a copy that is too large, whatever size the store gave for it."""

            def relative_update(self, inc: int = 1) -> None:
                super().relative_update(inc)
                if self.value > largest:
                    raise InputError(
                        f"it is larger than {largest / 1e9:.3g} GB, half of the free space of "
                        f"{tempfile.gettempdir()}; set TMPDIR to a folder with more space"
                    )

        files, room = _files(system, path), Room()
        for file in files:
            # The name's last part only: a store does not choose where things go.
            system.get_file(file, str(folder / _name(file)), callback=room)
        return folder / _name(path) if files == [path] else folder


def _files(system: Any, path: str) -> list[str]:
    """Paths of the files of a bag."""
    if PurePosixPath(_name(path)).suffix in _SUFFIXES:
        return [path]
    names = [each["name"] for each in system.ls(path, detail=True) if each.get("type") == "file"]
    files = sorted(name for name in names if PurePosixPath(_name(name)).suffix in _SUFFIXES)
    if not files:
        raise InputError(f"no bag there: expected files that end in {', '.join(_SUFFIXES)}")
    if len(files) > MOST_BAG_FILES:
        raise InputError(f"more than {MOST_BAG_FILES} files; read them in parts")
    return files


def _name(path: str) -> str:
    """Last part of a path, without the query of a URL."""
    return PurePosixPath(path.partition("?")[0]).name


@contextmanager
def _reached(url: str) -> Iterator[tuple[Any, str]]:
    """The file system of a URL, and the path in it. Whatever a store answers becomes one line: each
    kind has errors of its own, and only code of fsspec runs inside.
    """
    try:
        from fsspec.core import url_to_fs
    except ModuleNotFoundError:
        raise MissingDependencyError(
            f"{public(url)} needs the package fsspec, which is not installed: "
            "pip install 'hand_eye_calib[fleet]'"
        ) from None
    try:
        yield url_to_fs(url)
    except ImportError as error:
        raise MissingDependencyError(f"cannot read {public(url)}: {error}") from None
    except HandEyeCalibError as error:
        raise InputError(f"cannot read {public(url)}: {error}") from None
    except Exception as error:
        reason = " ".join([f"{type(error).__name__}:", *str(error).split()]).rstrip(".:")
        raise InputError(
            f"cannot read {public(url)}: {reason}; check the address and the permission to read it"
        ) from error
