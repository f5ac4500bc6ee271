"""Digests of the monitor for the command ``compare``: on the terminal, and as a page of a fleet."""

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.text import amount, distinct_names
from hand_eye_calib.extras.mount.digest import FOLDER, read_digests
from hand_eye_calib.extras.mount.history import History
from hand_eye_calib.extras.mount.monitor import TUNING
from hand_eye_calib.formats.results import save_text
from hand_eye_calib.offline.cli.options import note, print_result
from hand_eye_calib.online.live.progress import AXIS_KEYS

# Width of the column of an axis on the terminal, in letters.
_WIDTH = 26


def compare_digests(arguments: argparse.Namespace) -> int | None:
    """Print the history of a mount, and return the exit code of ``compare``.

    With ``--fleet``, print the verdict of each vehicle, and write the page of the fleet. The code
    is 4 after a change between sessions, and after an alarm of the monitor within one. None is
    returned if the arguments are no digests.

    Raises
    ------
    ConfigError
        If the arguments name an installed transform, because the digests already contain it.
    """
    paths = [Path(path) for path in arguments.results]
    histories = (
        _histories_of_fleet(paths)
        if arguments.fleet
        else _histories_of_mount(paths)
    )
    if not histories:
        return None
    if arguments.installed:
        raise ConfigError(
            "digests contain their installed transform: omit --with"
        )
    if arguments.fleet:
        names = distinct_names(arguments.results)
        _write_fleet(dict(zip(names, histories, strict=True)), arguments)
    else:
        document = histories[0].document() if arguments.json else None
        print_result(_lines(histories[0]), document)
    return 4 if any(history.has_moved for history in histories) else 0


def _histories_of_mount(paths: list[Path]) -> list[History]:
    """Return the history of the mount whose digests are in all paths; nothing without digests."""
    for path in paths:
        if path.name == FOLDER and not path.exists():
            raise ConfigError(f"no digests: {_no_digests(path)}")
    sessions = read_digests(paths)
    return [] if sessions is None else [History.of(sessions)]


def _no_digests(path: Path) -> str:
    """Return the sentence about a path without digests: the cause, and what writes digests."""
    return (
        f"{path} has none: the node writes them into {FOLDER}/ of its output_directory if monitor "
        f"and installed are set, at the end of a session with more than {TUNING.learning_s} s of "
        "motion; the log of the node states why a shorter session has none"
    )


def _histories_of_fleet(paths: list[Path]) -> list[History]:
    """Return the history of each vehicle. Each path contains the digests of one vehicle."""
    histories = []
    for path in paths:
        sessions = read_digests([path])
        if sessions is None:
            raise ConfigError(f"--fleet needs digests; {_no_digests(path)}")
        histories.append(History.of(sessions))
    return histories


def _write_fleet(
    histories: Mapping[str, History], arguments: argparse.Namespace
) -> None:
    """Write the page of a fleet, and print a line for each vehicle."""
    from hand_eye_calib.extras.mount.fleet_page import render_fleet

    save_text(arguments.fleet, render_fleet(histories))
    document = None
    if arguments.json:
        document = {
            name: history.document() for name, history in histories.items()
        }
    lines = (
        f"{name}: {history.sentence}" for name, history in histories.items()
    )
    print_result(lines, document)
    note(f"wrote {arguments.fleet}")


def _lines(history: History) -> Iterator[str]:
    """Yield the lines for the terminal: the verdict, then a line for each session and change."""
    yield history.sentence
    names = "".join(
        f"{key.replace('_', ' '):>{_WIDTH}}" for key in AXIS_KEYS.values()
    )
    yield f"  {'session':<18}{'motion':>8}{names}"
    events = {event.index: event for event in history.events}
    for index, (digest, offset) in enumerate(
        zip(history.digests, history.offsets, strict=True)
    ):
        if event := events.get(index):
            yield f"  -- {event.when}: {event.what}"
        cells = [
            f"{amount(axis, row.difference)} +/- {amount(axis, row.sigma)}"
            for axis, row in offset.axes.items()
        ]
        yield f"  {digest.day:<18}{digest.seconds:>6} s" + "".join(
            f"{cell:>{_WIDTH}}" for cell in cells
        )
