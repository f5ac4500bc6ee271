"""Reading a batch file: which recordings, with which options, under which names."""

import hashlib
import json
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from glob import glob, has_magic
from itertools import chain, count
from pathlib import Path, PurePosixPath
from typing import Any

from hand_eye_calib.cli.options import Options
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import ConfigError

SOURCES = ("parent_topic", "child_topic", "parent_tf", "child_tf")
_KEYS = ("bag", "name", "vehicle", "options", *SOURCES)
STATE = "batch.json"
SUMMARY, TABLE, INDEX = "summary.json", "rows.csv", "index.html"
# Names of files in the folder of the results, which a recording cannot have.
_TAKEN = (SUMMARY, STATE, TABLE, INDEX)
# Bytes of the name of a folder.
_LONGEST_NAME = 200


@dataclass(frozen=True, kw_only=True)
class Task:
    """One recording to calibrate from, in plain values: it travels to other processes and machines.

    Attributes
    ----------
    name : str
        Of its row and its folder.
    bags : tuple of str
        Paths or URLs.
    vehicle : str
        The rig; recordings of one are compared with each other. Empty if it is not known.
    options, sources : dict
    with_fingerprints, with_report : bool
    """

    name: str
    bags: tuple[str, ...]
    vehicle: str = ""
    options: Options = field(default_factory=dict)
    sources: dict[str, str] = field(default_factory=dict)
    with_fingerprints: bool = False
    with_report: bool = False

    def key(self) -> str:
        """Digest of the task, its options and its bags, so that no older result is taken for this
        one's.

        Raises
        ------
        OSError
            If a file of a bag cannot be looked at.
        InputError
            If a store cannot be reached.
        """
        state = [_state(bag) for bag in self.bags]
        return hashlib.sha256(
            json.dumps([asdict(self), state], sort_keys=True).encode()
        ).hexdigest()


def _state(bag: str) -> list[Any]:
    """What changes if a bag does."""
    from hand_eye_calib.io import remote

    if remote.is_url(bag):
        return remote.states(bag)
    return [[file, os.path.getsize(file), os.stat(file).st_mtime_ns] for file in _files(bag)]


def _files(bag: str) -> list[str]:
    path = Path(bag)
    return sorted(map(str, path.iterdir())) if path.is_dir() else [bag] if path.exists() else []


def read_batch(
    path: Path,
    options: Options,
    sources: Mapping[str, str],
    *,
    with_fingerprints: bool = False,
    with_report: bool = False,
) -> list[Task]:
    """The tasks of a batch file.

    Parameters
    ----------
    path : pathlib.Path
    options, sources : dict
        What holds if the file says nothing else.
    with_fingerprints : bool
        Whether the results shall say which bytes were read.
    with_report : bool
        Whether they shall come with a report.

    Returns
    -------
    list of Task

    Raises
    ------
    InputError
        If the file cannot be read.
    ConfigError
        If it says something that cannot be.
    """
    from hand_eye_calib.io.yaml_files import read_yaml

    document = read_yaml(path)
    if isinstance(document, list):
        document = {"bags": document}
    bags = document.get("bags") if isinstance(document, dict) else None
    if not isinstance(bags, list) or not bags:
        raise ConfigError(f"{path}: expected a list of bags, or a mapping with one under 'bags'")
    common = {name: value for name, value in document.items() if name != "bags"}
    given = {"options": options} | dict(sources)
    defaults = _merged(given, _checked(path, common, "beside 'bags'"))
    wanted = {"with_fingerprints": with_fingerprints, "with_report": with_report}
    recordings = list(_recordings(path, bags, defaults))
    names = _names(recordings)
    return [
        _task(where, name, paths, entry, wanted)
        for name, (where, paths, entry) in zip(names, recordings, strict=True)
    ]


_Recording = tuple[str, list[str], dict[str, Any]]


def _recordings(
    path: Path, bags: Sequence[Any], defaults: Mapping[str, Any]
) -> Iterator[_Recording]:
    """Each recording of a batch file: where it stands in the file, its bags, what holds for it."""
    for number, entry in enumerate(bags, start=1):
        where = f"entry {number}"
        entry = _checked(path, entry if isinstance(entry, dict) else {"bag": entry}, where)
        for paths in _expanded(path, entry, where):
            yield f"{path}, {where}", paths, _merged(defaults, entry)


def _checked(path: Path, entry: dict[str, Any], where: str) -> dict[str, Any]:
    unknown = [str(name) for name in entry if name not in _KEYS]
    if unknown:
        raise ConfigError(
            f"{path}, {where}: unknown key {unknown[0]!r}; known are {', '.join(_KEYS)}"
        )
    if not isinstance(entry.get("options", {}), dict):
        raise ConfigError(f"{path}, {where}: options must be a mapping of names to values")
    return entry


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """``over`` before ``base``; the topic of a stream replaces its frames, and the reverse."""
    merged = {name: value for name, value in base.items() if _other(name) not in over} | dict(over)
    return merged | {"options": base.get("options", {}) | over.get("options", {})}


def _other(name: str) -> str | None:
    stream, _, kind = name.partition("_")
    return {"topic": f"{stream}_tf", "tf": f"{stream}_topic"}.get(kind)


def _expanded(path: Path, entry: Mapping[str, Any], where: str) -> list[list[str]]:
    """Bags of each recording: one recording, or several if a pattern stands for many."""
    from hand_eye_calib.io import remote

    bags = entry.get("bag")
    named: list[Any] = bags if isinstance(bags, list) else [bags]
    if not named or not all(isinstance(bag, str) and bag for bag in named):
        raise ConfigError(
            f"{path}, {where}: expected a bag's path or a list of paths; got {bags!r}"
        )
    if any("\0" in bag for bag in named):
        raise ConfigError(f"{path}, {where}: a bag's path has a zero byte")
    places = [bag if remote.is_url(bag) else str(path.parent / bag) for bag in named]
    if len(places) > 1 or not _is_pattern(places[0]):
        return [places]
    found = remote.expanded(places[0]) if remote.is_url(places[0]) else sorted(glob(places[0]))
    if not found:
        raise ConfigError(f"{path}, {where}: no bag matches {named[0]}")
    return [[place] for place in found]


def _is_pattern(place: str) -> bool:
    from hand_eye_calib.io import remote

    # A question mark begins the query of a URL.
    return "*" in place if remote.is_url(place) else has_magic(place) and not Path(place).exists()


def _task(
    where: str,
    name: str,
    bags: Sequence[str],
    entry: Mapping[str, Any],
    wanted: Mapping[str, bool],
) -> Task:
    from hand_eye_calib.io.transforms import TfSource

    try:
        CalibratorConfig.from_options(entry["options"])
        for source in ("parent_tf", "child_tf"):
            if source in entry:
                TfSource.parse(str(entry[source]))
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
    sources = {source: str(entry[source]) for source in SOURCES if source in entry}
    return Task(
        name=name,
        bags=tuple(bags),
        vehicle=_vehicle(where, entry.get("vehicle", "")),
        options=dict(entry["options"]),
        sources=sources,
        **wanted,
    )


def _vehicle(where: str, given: Any) -> str:
    if isinstance(given, bool) or not isinstance(given, (str, int, float)):
        raise ConfigError(f"{where}: expected the name of a vehicle; got {given!r}")
    vehicle = str(given)
    if not vehicle.isprintable() or len(vehicle.encode()) > _LONGEST_NAME:
        raise ConfigError(f"{where}: {vehicle[:_LONGEST_NAME]!r} cannot name a vehicle")
    return vehicle


def _names(recordings: Sequence[_Recording]) -> list[str]:
    """A name for each recording, none twice: its own, or that of its first bag. Bags that are
    called alike are named by the folders in which they differ, as monday and tuesday of monday/bag
    and tuesday/bag.
    """
    unnamed = [_place(paths[0]) for _, paths, entry in recordings if not entry.get("name")]
    places = list(dict.fromkeys(unnamed))
    stems = Counter(place[-1] for place in places)
    alike = [place for place in places if stems[place[-1]] > 1]
    names: list[str] = []
    for where, paths, entry in recordings:
        place = _place(paths[0])
        usual = "_".join(_distinct(place, alike) if place in alike else place[-1:])
        names.append(_free(_name(where, entry.get("name") or usual), set(names)))
    return names


def _place(bag: str) -> tuple[str, ...]:
    """Folders and name of a bag, the latter without its suffix."""
    path = PurePosixPath(bag.partition("?")[0])
    return (*path.parts[:-1], path.stem)


def _distinct(place: tuple[str, ...], others: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    """The parts of a place in which several places differ; the last part if it has none."""
    first = next(k for k in count() if len({one[k : k + 1] for one in others}) > 1)
    last = next(k for k in count(1) if len({one[-k : len(one) - k + 1] for one in others}) > 1)
    return place[first : len(place) - last + 1] or place[-1:]


def _free(name: str, taken: set[str]) -> str:
    """The name, with a number if it is taken."""
    numbered = (f"{name}_{number}" for number in count(2))
    return next(one for one in chain([name], numbered) if one not in taken)


def _name(where: str, given: Any) -> str:
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
