"""``replay BAG --list``: what is in a bag."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hand_eye_calib.cli.console import note, waiting_for
from hand_eye_calib.errors import printable

if TYPE_CHECKING:
    from rich.table import Table


def list_bag(paths: Sequence[Path], as_json: bool) -> int:
    """Print the topics of a bag; returns the exit code.

    Parameters
    ----------
    paths : list of path-like
        One bag, or several parts of one recording.
    as_json : bool
        One JSON document instead of a table.

    Raises
    ------
    InputError
        If the bag cannot be read.
    """
    from hand_eye_calib.io.bags import PoseBag

    with PoseBag(*paths) as bag:
        with waiting_for(f"reading {bag}"):
            topics = bag.describe()
        document: dict[str, Any] = {
            "bag": str(bag),
            "start_ns": bag.start_ns,
            "end_ns": bag.end_ns,
            "duration_s": bag.duration_s,
            "topics": [topic._asdict() for topic in topics],
            "warnings": bag.warnings,
        }
    for text in document["warnings"]:
        note(text)
    if as_json:
        print(json.dumps(document, indent=2))
    else:
        _print_topics(document, topics)
    return 0


def _print_topics(document: dict[str, Any], topics: Sequence[Any]) -> None:
    from rich import box
    from rich.table import Table

    if not topics:
        print(f"{document['bag']} has no topics")
        return
    title = f"{document['bag']}, {document['duration_s']:.1f} s"
    table = Table(title=title, box=box.SIMPLE, title_justify="left", pad_edge=False)
    for heading in ("topic", "type"):
        table.add_column(heading, overflow="fold")
    for heading in ("count", "rate", "duration"):
        table.add_column(heading, justify="right", overflow="fold")
    table.add_column("frames", overflow="fold")
    for topic in topics:
        table.add_row(*_cells(topic), style="bold" if topic.is_usable else None)
    print_table(table)
    if any(topic.is_usable for topic in topics):
        print(
            "Poses: --parent-topic and --child-topic take the topics in bold, --parent-tf and "
            "--child-tf frames of /tf: odom:lidar"
        )


def _cells(topic: Any) -> list[str]:
    return [
        printable(topic.name),
        topic.type or "several types",
        str(topic.count),
        "" if topic.rate_hz is None else f"{topic.rate_hz:.1f} Hz",
        "" if topic.duration_s is None else f"{topic.duration_s:.1f} s",
        "\n".join(printable(frame) for frame in topic.frames),
    ]


def print_table(table: "Table") -> None:
    """Print a table; through a pipe with whole lines, not those of a terminal of 80 columns."""
    from rich.console import Console

    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console = Console(highlight=False, markup=False, width=240)
    console.print(table)
