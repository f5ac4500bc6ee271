"""Module search path without the current folder, for processes that the package starts.

``python -m`` and ``python -c`` search the current folder first. A file ``queue.py`` in this folder
would run instead of the module of the standard library.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_PACKAGE_PARENT = str(Path(__file__).resolve().parents[3])


def trusted_path() -> list[str]:
    """Return the folders of ``sys.path`` without the current folder.

    The current folder is kept if the package lies in it, or if ``PYTHONPATH`` names it.
    """
    current = os.path.realpath(os.getcwd())
    named = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    trusted = {os.path.realpath(folder) for folder in named if folder}
    trusted.add(_PACKAGE_PARENT)
    if current in trusted:
        return [folder or current for folder in sys.path]
    return [
        folder for folder in sys.path if os.path.realpath(folder) != current
    ]


def trusted_environment() -> dict[str, str]:
    """Return the environment for a Python process that must find the same modules.

    ``PYTHONSAFEPATH`` prevents the process from searching its current folder.
    """
    return {**os.environ, **_settings()}


@contextmanager
def starting_trusted() -> Iterator[None]:
    """Set the environment of :func:`trusted_environment` for processes that start in the block.

    The environment is restored at the end of the block. ``multiprocessing`` needs this, because it
    has no argument for the environment.
    """
    settings = _settings()
    before = {name: os.environ.get(name) for name in settings}
    os.environ.update(settings)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _settings() -> dict[str, str]:
    return {
        "PYTHONPATH": os.pathsep.join(trusted_path()),
        "PYTHONSAFEPATH": "1",
    }
