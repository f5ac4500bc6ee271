"""Copy bags from object storage and web servers.

fsspec copies a bag to a temporary folder, which is removed after the bag was read. Examples of URLs
are ``s3://bucket/run_1``, ``gs://...`` and ``https://host/run_1.mcap``.
"""

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from hand_eye_calib.core.base.errors import (
    HandEyeCalibError,
    InputError,
    MissingDependencyError,
    installing,
)

#: Function that replaces the paths of copies by the URLs of the bags in plain values.
RestoreUrls = Callable[[Any], Any]

# Endings of the files of a bag that are copied.
_SUFFIXES = (".yaml", ".mcap", ".db3", ".bag", ".zstd")
# Endings of files that SQLite keeps beside a .db3 while writing. If the recorder was killed, they
# contain the newest messages.
_JOURNALS = (".db3-wal", ".db3-journal")


def is_url(path: object) -> bool:
    """Return whether the name of a bag is a URL instead of a path."""
    return "://" in str(path)


def public(url: str) -> str:
    """Return a URL without user, password and query, which are secret; return a path unchanged."""
    if not is_url(url):
        return url
    protocol, mark, rest = url.partition("?")[0].partition("://")
    host, slash, path = rest.partition("/")
    return f"{protocol}{mark}{host.rpartition('@')[2]}{slash}{path}"


def expanded(pattern: str) -> list[str]:
    """Return the URLs that match a pattern with ``*``, sorted.

    Raises the errors of :func:`local_copies`.
    """
    with _reached(pattern) as (system, path):
        return sorted(
            system.unstrip_protocol(name)
            for name in system.glob(path.rstrip("/"))
        )


@contextmanager
def local_copies(
    paths: Sequence[Any],
) -> Iterator[tuple[list[Any], RestoreUrls]]:
    """Copy remote bags to this machine. The copies are removed at the end of the context.

    Errors that are raised in the context name the URLs instead of the copies.

    Yields
    ------
    paths : list of path-like
        Paths of all bags on this machine.
    restore_urls : callable
        Function that replaces the paths of the copies by the URLs in plain values.

    Raises
    ------
    InputError
        If a store cannot be reached or has no bag, or if the bag would fill more than half of the
        free disk space.
    MissingDependencyError
        If a package that the store needs is not installed.
    """
    if not any(map(is_url, paths)):
        yield [*paths], lambda value: value
        return
    with tempfile.TemporaryDirectory(prefix="hand_eye_calib_") as folder:
        local = [
            _copied(str(path), Path(folder, str(number)))
            if is_url(path)
            else path
            for number, path in enumerate(paths)
        ]

        def restore_urls(value: Any) -> Any:
            text = json.dumps(value)
            for copy, path in zip(local, paths, strict=True):
                url = public(str(path)).rstrip("/")
                text = text.replace(
                    json.dumps(str(copy))[1:-1], json.dumps(url)[1:-1]
                )
            return json.loads(text)

        try:
            yield local, restore_urls
        except HandEyeCalibError as error:
            error.args = tuple(restore_urls(list(error.args)))
            raise


def _copied(url: str, folder: Path) -> Path:
    """Copy the files of a bag into a new folder, and return the path of the bag."""
    folder.mkdir()
    with _reached(url) as (system, path):
        is_file = _name(path).endswith(_SUFFIXES)
        entries = (
            _entries_of_file(system, path)
            if is_file
            else system.ls(path, detail=True)
        )
        suffixes = (*_SUFFIXES, *_JOURNALS)
        files = [
            entry
            for entry in entries
            if _name(entry["name"]).endswith(suffixes)
        ]
        if not files:
            raise InputError(
                f"no bag there: expected files that end in {', '.join(_SUFFIXES)}"
            )
        # Use at most half of the free space: other processes may copy bags at the same time.
        largest = shutil.disk_usage(folder).free // 2
        if sum(entry.get("size") or 0 for entry in files) > largest:
            raise InputError(
                f"it is larger than {largest / 1e9:.3g} GB, half of the free space of "
                f"{tempfile.gettempdir()}; set TMPDIR to a folder with more space"
            )
        for entry in files:
            # Use only the last part of the name. Otherwise a store could choose another folder.
            system.get_file(entry["name"], str(folder / _name(entry["name"])))
        return folder / _name(path) if is_file else folder


def _entries_of_file(system: Any, path: str) -> list[dict[str, Any]]:
    """Return the entries (name, size, ...) of a file in a store, and of its SQLite journals."""
    paths = [path]
    if path.endswith(".db3"):
        journals = [path.removesuffix(".db3") + suffix for suffix in _JOURNALS]
        paths += [journal for journal in journals if system.exists(journal)]
    return [system.info(name) | {"name": name} for name in paths]


def _name(path: str) -> str:
    """Return the last part of a path, without the query of a URL."""
    return PurePosixPath(path.partition("?")[0]).name


@contextmanager
def _reached(url: str) -> Iterator[tuple[Any, str]]:
    """Yield the file system of a URL, and the path in this file system.

    Any error in the context becomes an InputError of one line, because stores raise errors of many
    types. Hardly any code except fsspec runs in the context, so defects of this package are not
    hidden.
    """
    try:
        from fsspec.core import url_to_fs

        yield url_to_fs(url)
    except ImportError as error:
        raise MissingDependencyError(
            f"{public(url)} needs a package that is not installed: {error}; "
            f"{installing('fleet')}, and the package of the store"
        ) from None
    except HandEyeCalibError as error:
        raise InputError(f"cannot read {public(url)}: {error}") from None
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split()).rstrip(
            ".:"
        )
        raise InputError(
            f"cannot read {public(url)}: {reason}; check the address and the read permission"
        ) from error
