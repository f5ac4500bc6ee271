"""Which recordings a batch has, with which options, under which names."""

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from glob import glob, has_magic
from itertools import chain, count
from pathlib import Path
from typing import Any

from hand_eye_calib.cli.console import STREAMS, told_apart
from hand_eye_calib.cli.options import Options
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import ConfigError
from hand_eye_calib.io import remote
from hand_eye_calib.text import split_frames

_KEYS = (
    *("bag", "name", "vehicle", "options"),
    *(f"{stream}_{kind}" for stream in STREAMS for kind in ("topic", "tf")),
)
STATE = "batch.json"
SUMMARY, TABLE, INDEX, VEHICLES = "summary.json", "rows.csv", "index.html", "vehicles"
# Names in the folder of the results, which a recording cannot have.
_TAKEN = (SUMMARY, STATE, TABLE, INDEX, VEHICLES)
# Bytes of the name of a folder.
_LONGEST_NAME = 200
_BAGS = (".bag", ".mcap", ".db3")
# The place of the vehicle in a pattern of paths.
_PLACE = "{vehicle}"


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


def read_batch(
    given: Sequence[Path | str | dict[str, Any]],
    options: Options,
    sources: Mapping[str, str],
    vehicle: str = "",
    **flags: Any,
) -> list[Task]:
    """The tasks of a batch file; or of bags, patterns of bags, and entries as in such a file.

    ``given`` is one YAML file, or what can stand in its list; options, sources and vehicle hold if
    the file says nothing else, the flags are those of every Task.
    """
    document: Any = [each if isinstance(each, dict) else str(each) for each in given]
    shown, folder = "recordings", Path()
    files = [each for each in given if str(each).endswith((".yaml", ".yml"))]
    if files and len(given) > 1:
        raise ConfigError(f"--batch takes one file, or bags: {files[0]} is a file")
    if files:
        from hand_eye_calib.io.yaml_files import read_yaml

        shown, folder = str(given[0]), Path(str(given[0])).parent
        document = read_yaml(Path(shown))
    if isinstance(document, list):
        document = {"bags": document}
    bags = document.pop("bags", None) if isinstance(document, dict) else None
    if not isinstance(bags, list) or not bags:
        raise ConfigError(f"{shown}: expected a list of bags, or a mapping with one under 'bags'")
    base = {"vehicle": vehicle, "options": options, **sources}
    base = _merged(base, document, f"{shown}, beside 'bags'")
    recordings: list[tuple[str, dict[str, Any], list[str]]] = []
    for number, each in enumerate(bags, start=1):
        where = f"{shown}, entry {number}"
        entry = _merged(base, each if isinstance(each, dict) else {"bag": each}, where)
        found = _expanded(folder, entry.get("bag"), where)
        recordings += [(where, entry, places) for places in found]
    unnamed = [places[0] for _, entry, places in recordings if not entry.get("name")]
    stems = [str(Path(place.partition("?")[0]).with_suffix("")) for place in unnamed]
    by_path = iter(told_apart(stems))
    tasks: dict[str, Task] = {}
    for where, entry, places in recordings:
        name = _name(entry.get("name") or next(by_path), where)
        numbered = chain([name], (f"{name}_{number}" for number in count(2)))
        name = next(one for one in numbered if one not in tasks)
        tasks[name] = Task(
            name=name,
            bags=tuple(places),
            vehicle=_vehicle(entry, places[0], where),
            options=entry["options"],
            sources={stream: entry[stream] for stream in STREAMS if stream in entry},
            **flags,
        )
    return [*tasks.values()]


def _merged(base: Mapping[str, Any], over: Mapping[str, Any], where: str) -> dict[str, Any]:
    """``over`` before ``base``, with the source of each stream under its name."""
    unknown = [str(name) for name in over if name not in _KEYS]
    if unknown:
        raise ConfigError(f"{where}: unknown key {unknown[0]!r}; known are {', '.join(_KEYS)}")
    options = over.get("options", {})
    if not isinstance(options, dict):
        raise ConfigError(f"{where}: options must be a mapping of names to values")
    merged = {**base, **over, "options": base["options"] | options}
    try:
        CalibratorConfig.from_options(merged["options"])
        for stream in STREAMS:
            if f"{stream}_topic" in over:
                merged[stream] = str(over[f"{stream}_topic"])
            elif f"{stream}_tf" in over:
                merged[stream] = ":".join(split_frames(str(over[f"{stream}_tf"])))
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
    return merged


def _expanded(folder: Path, given: Any, where: str) -> Iterator[list[str]]:
    """Bags of each recording: one recording, or several if a pattern stands for many."""
    bags = given if isinstance(given, list) else [given]
    if not bags or not all(isinstance(bag, str) and bag and "\0" not in bag for bag in bags):
        raise ConfigError(f"{where}: expected a bag's path or a list of paths; got {given!r}")
    places = [bag if remote.is_url(bag) else str(folder / bag) for bag in bags]
    found = matching(places[0])
    if len(places) > 1 or found is None:
        yield places
    elif not found:
        raise ConfigError(f"{where}: no bag matches {bags[0]}")
    else:
        yield from ([place] for place in found)


def matching(pattern: str) -> list[str] | None:
    """The bags that a pattern stands for; None if it is a path. ``**`` finds bags alone."""
    if remote.is_url(pattern):  # a question mark begins its query
        return remote.expanded(pattern) if "*" in pattern else None
    if not has_magic(pattern) or Path(pattern).exists():
        return None
    found = sorted(glob(pattern, recursive=True))
    return [each for each in found if "**" not in pattern or _is_recording(Path(each))]


def _is_recording(path: Path) -> bool:
    """Whether a path is a bag, and not a file of one."""
    if path.is_dir():
        return (path / "metadata.yaml").exists()
    return path.suffix in _BAGS and not (path.parent / "metadata.yaml").exists()


def _vehicle(entry: Mapping[str, Any], place: str, where: str) -> str:
    """The vehicle's name, which may stand in the path."""
    vehicle = entry["vehicle"]
    if isinstance(vehicle, str) and _PLACE in vehicle:
        pattern = re.escape(vehicle).replace(re.escape(_PLACE), "([^/]+)")
        pattern = pattern.replace(r"\*\*", ".*").replace(r"\*", "[^/]*")
        match = re.search(pattern, place)
        vehicle = match[1] if match else ""
    return _name(vehicle, where) if vehicle else ""


def _name(given: Any, where: str) -> str:
    """A name that a folder of results can have."""
    name = str(given).replace("/", "_")
    is_file_name = name.isprintable() and len(name.encode()) <= _LONGEST_NAME and name.strip(". ")
    if not is_file_name or not isinstance(given, str | int | float) or name.lower() in _TAKEN:
        raise ConfigError(
            f"{where}: {name[:_LONGEST_NAME]!r} cannot name a folder of results; give another name"
        )
    return name
