"""Which recordings a batch has, with which options, under which names."""

import hashlib
import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from glob import glob, has_magic
from itertools import chain, count
from pathlib import Path, PurePosixPath
from typing import Any

from hand_eye_calib.cli.options import STREAMS, Options
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import ConfigError
from hand_eye_calib.io import remote
from hand_eye_calib.text import split_frames

SOURCES = ("parent_topic", "child_topic", "parent_tf", "child_tf")
_KEYS = ("bag", "name", "vehicle", "options", *SOURCES)
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
    options, sources : dict
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
    if remote.is_url(bag):
        return remote.states(bag)
    path = Path(bag)
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

        shown = str(given[0])
        folder = Path(shown).parent
        document = read_yaml(Path(shown))
    if isinstance(document, list):
        document = {"bags": document}
    bags = document.get("bags") if isinstance(document, dict) else None
    if not isinstance(bags, list) or not bags:
        raise ConfigError(f"{shown}: expected a list of bags, or a mapping with one under 'bags'")
    common = {name: value for name, value in document.items() if name != "bags"}
    base = {"options": options, "vehicle": vehicle} | dict(sources)
    defaults = _merged(base, _checked(f"{shown}, beside 'bags'", common))
    recordings: list[_Recording] = []
    for number, entry in enumerate(bags, start=1):
        where = f"{shown}, entry {number}"
        entry = _checked(where, entry if isinstance(entry, dict) else {"bag": entry})
        merged = _merged(defaults, entry)
        recordings += [(where, found, merged) for found in _expanded(folder, entry, where)]
    return [
        Task(name=name, bags=tuple(found), **_settings(where, entry, found[0]), **flags)
        for name, (where, found, entry) in zip(_names(recordings), recordings, strict=True)
    ]


# Where it stands in the file, its bags, what holds for it.
_Recording = tuple[str, list[str], dict[str, Any]]


def _checked(where: str, entry: dict[str, Any]) -> dict[str, Any]:
    unknown = [str(name) for name in entry if name not in _KEYS]
    if unknown:
        raise ConfigError(f"{where}: unknown key {unknown[0]!r}; known are {', '.join(_KEYS)}")
    if not isinstance(entry.get("options", {}), dict):
        raise ConfigError(f"{where}: options must be a mapping of names to values")
    return entry


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """``over`` before ``base``; the topic of a stream replaces its frames, and the reverse."""
    replaced = {
        f"{stream}_{other}"
        for stream in STREAMS
        for kind, other in (("topic", "tf"), ("tf", "topic"))
        if f"{stream}_{kind}" in over
    }
    merged = {name: value for name, value in base.items() if name not in replaced} | dict(over)
    return merged | {"options": base.get("options", {}) | over.get("options", {})}


def _expanded(folder: Path, entry: Mapping[str, Any], where: str) -> Iterator[list[str]]:
    """Bags of each recording: one recording, or several if a pattern stands for many."""
    bags = entry.get("bag")
    named: list[Any] = bags if isinstance(bags, list) else [bags]
    if not named or not all(isinstance(bag, str) and bag for bag in named):
        raise ConfigError(f"{where}: expected a bag's path or a list of paths; got {bags!r}")
    if any("\0" in bag for bag in named):
        raise ConfigError(f"{where}: a bag's path has a zero byte")
    places = [bag if remote.is_url(bag) else str(folder / bag) for bag in named]
    found = matching(places[0])
    if len(places) > 1 or found is None:
        yield places
    elif not found:
        raise ConfigError(f"{where}: no bag matches {named[0]}")
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


def _settings(where: str, entry: Mapping[str, Any], place: str) -> dict[str, Any]:
    """Vehicle, options and sources of a recording."""
    sources = {source: str(entry[source]) for source in SOURCES if source in entry}
    given = entry.get("vehicle", "")
    if isinstance(given, bool) or not isinstance(given, (str, int, float)):
        raise ConfigError(f"{where}: expected the name of a vehicle; got {given!r}")
    vehicle = str(given)
    if _PLACE in vehicle:
        pattern = re.escape(vehicle).replace(re.escape(_PLACE), "([^/]+)")
        pattern = pattern.replace(r"\*\*", ".*").replace(r"\*", "[^/]*")
        match = re.search(pattern, place)
        vehicle = match[1] if match else ""
    if not vehicle.isprintable() or len(vehicle.encode()) > _LONGEST_NAME:
        raise ConfigError(f"{where}: {vehicle[:_LONGEST_NAME]!r} cannot name a vehicle")
    try:
        CalibratorConfig.from_options(entry["options"])
        for source, text in sources.items():
            if source.endswith("_tf"):
                split_frames(text)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
    return {"vehicle": vehicle, "options": dict(entry["options"]), "sources": sources}


def _names(recordings: Sequence[_Recording]) -> list[str]:
    """A name for each recording, none twice: its own, or that of its first bag. Bags that are
    called alike are named by the folders in which they differ, as monday and tuesday of monday/bag
    and tuesday/bag.
    """
    unnamed = [_place(paths[0]) for _, paths, entry in recordings if not entry.get("name")]
    places = list(dict.fromkeys(unnamed))
    stems = Counter(place[-1] for place in places)
    alike = [place for place in places if stems[place[-1]] > 1]
    first = last = 0
    if alike:  # the parts in which they differ
        first = next(k for k in count() if len({one[k : k + 1] for one in alike}) > 1)
        last = next(k for k in count(1) if len({one[-k : len(one) - k + 1] for one in alike}) > 1)
    names: dict[str, None] = {}
    numbers: Counter[str] = Counter()
    for where, paths, entry in recordings:
        place = _place(paths[0])
        distinct = place[first : len(place) - last + 1] if stems[place[-1]] > 1 else ()
        name = _folder(where, entry.get("name") or "_".join(distinct or place[-1:]))
        numbered = chain([name], (f"{name}_{number}" for number in count(max(numbers[name], 2))))
        unique = next(one for one in numbered if one not in names)
        numbers[name] = int(unique.rpartition("_")[2]) if unique != name else 0
        names[unique] = None
    return [*names]


def _place(bag: str) -> tuple[str, ...]:
    """Folders and name of a bag, the latter without its suffix."""
    path = PurePosixPath(bag.partition("?")[0])
    return (*path.parts[:-1], path.stem)


def _folder(where: str, given: Any) -> str:
    """Name of a recording, and of its folder in ``--out``."""
    if not isinstance(given, (str, int, float)):
        raise ConfigError(f"{where}: expected a name; got {given!r}")
    name = str(given).replace("/", "_")
    is_file_name = name.isprintable() and len(name.encode()) <= _LONGEST_NAME
    if not is_file_name or name.strip(". ") == "" or name.lower() in _TAKEN:
        raise ConfigError(
            f"{where}: {name[:_LONGEST_NAME]!r} cannot name a folder of results; give another name"
        )
    return name
