"""``replay BAG --list``: what is in a bag."""

import json

from hand_eye_calib.cli.console import note, waiting_for


def list_bag(paths, as_json):
    """Print the topics of a bag; returns the exit code.

    Parameters
    ----------
    paths : list of path-like
        One bag, or several of one drive.
    as_json : bool
        One JSON document instead of a table.

    Raises
    ------
    InputError
        Where the bag cannot be read.
    """
    from hand_eye_calib.io.bags import PoseBag

    with PoseBag(*paths) as bag:
        with waiting_for(f"reading {bag}"):
            topics = bag.describe()
        duration_s = (bag.end_ns - bag.start_ns) * 1e-9 if bag.start_ns is not None else 0.0
        document = {
            "bag": str(bag),
            "start_ns": bag.start_ns,
            "end_ns": bag.end_ns,
            "duration_s": duration_s,
            "topics": [topic._asdict() for topic in topics],
            "warnings": bag.warnings,
        }
    for text in document["warnings"]:
        note(text)
    if as_json:
        print(json.dumps(document, indent=2))
    else:
        _print_table(document, topics)
    return 0


def _print_table(document, topics):
    from rich import box
    from rich.console import Console
    from rich.table import Table

    if not topics:
        print(f"{document['bag']} has no topics")
        return
    table = Table(
        title=f"{document['bag']}, {document['duration_s']:.1f} s",
        box=box.SIMPLE,
        title_justify="left",
        pad_edge=False,
    )
    for heading, justify in (("topic", "left"), ("type", "left"), ("count", "right"), ("rate", "right"), ("duration", "right"),
                             ("frames", "left")):  # fmt: skip
        table.add_column(heading, justify=justify, overflow="fold")
    for topic in topics:
        rate = "" if topic.rate_hz is None else f"{topic.rate_hz:.1f} Hz"
        duration = "" if topic.duration_s is None else f"{topic.duration_s:.1f} s"
        cells = [
            topic.name,
            topic.type or "several types",
            str(topic.count),
            rate,
            duration,
            "\n".join(topic.frames),
        ]
        table.add_row(*cells, style="bold" if topic.is_usable else None)
    # Whoever reads through a pipe wants whole lines, not those of a terminal of eighty columns.
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console = Console(highlight=False, markup=False, width=240)
    console.print(table)
    if any(topic.is_usable for topic in topics):
        print(
            "Poses: --parent-topic and --child-topic take the topics in bold, --parent-tf and --child-tf frames of /tf: odom:lidar"
        )
