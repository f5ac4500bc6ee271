"""Which recordings a batch has, under which names."""

import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from glob import glob, has_magic
from itertools import chain, count
from pathlib import Path
from typing import Any

from hand_eye_calib.cli.console import told_apart
from hand_eye_calib.cli.options import Options
from hand_eye_calib.errors import ConfigError
from hand_eye_calib.io import remote

STATE, TABLE, INDEX, VEHICLES = "batch.json", "rows.csv", "index.html", "vehicles"
_BAGS = (".bag", ".mcap", ".db3")


@dataclass(frozen=True, kw_only=True)
class Task:
    """One recording to calibrate from, in plain values: it travels to other processes and machines.

    Attributes
    ----------
    name : str
        Of its row and its folder.
    bags : tuple of str
        Paths or URLs of its parts, the directory of a journal, or the files of parent and child.
    vehicle : str
        The rig; recordings of one are put together. Empty if it is not known.
    options : dict
    sources : dict
        "parent" and "child" to a topic or WORLD:SENSOR, if they are given.
    with_fingerprints, with_report : bool
    are_files : bool
        They are trajectory files.
    """

    name: str
    bags: tuple[str, ...]
    vehicle: str = ""
    options: Options = field(default_factory=dict)
    sources: dict[str, str] = field(default_factory=dict)
    with_fingerprints: bool = False
    with_report: bool = False
    are_files: bool = False

    def key(self) -> str:
        """Digest of the task, its options, and names, sizes and times of its files, so that no
        older result is taken for this one's.
        """
        text = json.dumps([asdict(self), list(map(_state, self.bags))], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def _state(bag: str) -> list[Any]:
    path = Path(bag)  # none of a URL
    files = sorted(path.iterdir()) if path.is_dir() else [path] if path.exists() else []
    return [[str(file), file.stat().st_size, file.stat().st_mtime_ns] for file in files]


def tasks_of(groups: Sequence[Sequence[str]], vehicle: str = "", **common: Any) -> list[Task]:
    """A task for each group of bags or files that are one recording; ``vehicle`` is its name, or
    has ``{vehicle}`` at its place in their paths. The other values are those of every Task.
    """
    pattern = re.escape(vehicle).replace(r"\*\*", ".*").replace(r"\*", "[^/]*")
    pattern = pattern.replace(re.escape("{vehicle}"), "([^/]+)")
    # A path as "." has no name of its own.
    paths = [
        bag.partition("?")[0] if remote.is_url(bag) else str(Path(bag).resolve())
        for bag, *_ in groups
    ]
    stems = told_apart([str(Path(path).with_suffix("")) for path in paths])
    tasks: list[Task] = []
    names = {STATE, TABLE, INDEX, VEHICLES}
    for group, stem in zip(groups, stems, strict=True):
        name = stem.replace("/", "_")
        numbered = chain([name], (f"{name}_{number}" for number in count(2)))
        name = next(one for one in numbered if one not in names)
        names.add(name)
        of = vehicle
        if "{vehicle}" in vehicle:
            match = re.search(pattern, group[0])
            of = match[1].strip(".") if match else ""
        tasks.append(Task(name=name, bags=tuple(group), vehicle=of, **common))
    return tasks


def matching(pattern: str) -> list[str]:
    """The bags that a pattern stands for, or a ConfigError; a path stands for itself. ``**`` finds
    bags alone.
    """
    found = [pattern]
    if remote.is_url(pattern):  # a question mark begins its query
        found = remote.expanded(pattern) if "*" in pattern else found
    elif has_magic(pattern) and not Path(pattern).exists():
        found = sorted(glob(pattern, recursive=True))
        if "**" in pattern:
            found = [each for each in found if _is_recording(Path(each))]
    if not found:
        raise ConfigError(f"no bag matches {pattern}")
    return found


def _is_recording(path: Path) -> bool:
    """Whether a path is a bag, and not a file of one."""
    if path.is_dir():
        return (path / "metadata.yaml").exists()
    return path.suffix in _BAGS and not (path.parent / "metadata.yaml").exists()
