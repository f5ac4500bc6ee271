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

from hand_eye_calib.core.base.errors import (
    HandEyeCalibError,
    InputError,
    MissingDependencyError,
    installing,
)

AsGiven = Callable[[Any], Any]

# Files of a bag, as their names end.
_SUFFIXES = (".yaml", ".mcap", ".db3", ".bag", ".zstd")
# Files beside a .db3 that hold its newest messages if its recorder was killed.
_BESIDE = (".db3-wal", ".db3-journal")


def is_url(path: object) -> bool:
    """Whether a bag is named by a URL rather than a path."""
    return "://" in str(path)


def public(url: str) -> str:
    """A URL without what gives access: user, password and query; a path stays as it is."""
    if not is_url(url):
        return url
    protocol, mark, rest = url.partition("?")[0].partition("://")
    host, slash, path = rest.partition("/")
    return f"{protocol}{mark}{host.rpartition('@')[2]}{slash}{path}"


def expanded(pattern: str) -> list[str]:
    """URLs that a pattern with ``*`` stands for, sorted. Raises as :func:`local_copies`."""
    with _reached(pattern) as (system, path):
        return sorted(system.unstrip_protocol(found) for found in system.glob(path.rstrip("/")))


@contextmanager
def local_copies(paths: Sequence[Any]) -> Iterator[tuple[list[Any], AsGiven]]:
    """Copy remote bags to this machine for as long as the block lasts.

    Yields the paths on this machine, and a function that puts the URLs back into plain values that
    name the copies; errors that are raised in the block name the URLs. An InputError if a store
    cannot be reached, there is no bag, or it would fill more than half of the disk; a
    MissingDependencyError if a package that the store needs is not installed.
    """
    if not any(map(is_url, paths)):
        yield [*paths], lambda value: value
        return
    with tempfile.TemporaryDirectory(prefix="hand_eye_calib_") as folder:
        local = [
            _copied(str(path), Path(folder, str(number))) if is_url(path) else path
            for number, path in enumerate(paths)
        ]

        def as_given(value: Any) -> Any:
            text = json.dumps(value)
            for copy, path in zip(local, paths, strict=True):
                url = public(str(path)).rstrip("/")
                text = text.replace(json.dumps(str(copy))[1:-1], json.dumps(url)[1:-1])
            return json.loads(text)

        try:
            yield local, as_given
        except HandEyeCalibError as error:
            error.args = tuple(as_given(list(error.args)))
            raise


def _copied(url: str, folder: Path) -> Path:
    """Copy the files of a bag into a new folder; returns where it is."""
    folder.mkdir()
    with _reached(url) as (system, path):
        is_file = _name(path).endswith(_SUFFIXES)
        found = _file_and_beside(system, path) if is_file else system.ls(path, detail=True)
        names = (*_SUFFIXES, *_BESIDE)
        files = [about for about in found if _name(about["name"]).endswith(names)]
        if not files:
            raise InputError(f"no bag there: expected files that end in {', '.join(_SUFFIXES)}")
        # Half of the free space is left to the copies of other processes.
        largest = shutil.disk_usage(folder).free // 2
        if sum(about.get("size") or 0 for about in files) > largest:
            raise InputError(
                f"it is larger than {largest / 1e9:.3g} GB, half of the free space of "
                f"{tempfile.gettempdir()}; set TMPDIR to a folder with more space"
            )
        for about in files:
            # The name's last part only: a store does not choose where things go.
            system.get_file(about["name"], str(folder / _name(about["name"])))
        return folder / _name(path) if is_file else folder


def _file_and_beside(system: Any, path: str) -> list[dict[str, Any]]:
    """Return what a store says of a file, and of those beside it that belong to it."""
    paths = [path]
    if path.endswith(".db3"):
        beside = [path.removesuffix(".db3") + suffix for suffix in _BESIDE]
        paths += [name for name in beside if system.exists(name)]
    return [system.info(name) | {"name": name} for name in paths]


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

        yield url_to_fs(url)
    except ImportError as error:
        raise MissingDependencyError(
            f"{public(url)} needs a package that is not installed: {error}; "
            f"{installing('fleet')}, and that of the store"
        ) from None
    except HandEyeCalibError as error:
        raise InputError(f"cannot read {public(url)}: {error}") from None
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split()).rstrip(".:")
        raise InputError(
            f"cannot read {public(url)}: {reason}; check the address and the permission to read it"
        ) from error
