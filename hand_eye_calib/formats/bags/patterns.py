"""Find the bags in a folder, or the bags that match a pattern with ``*``."""

from fnmatch import fnmatchcase
from glob import escape, glob, has_magic
from pathlib import Path

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.formats import remote

# Endings of the storage files of bags.
_SUFFIXES = (".bag", ".mcap", ".db3")


def matching(pattern: str) -> list[str]:
    """Return the bags that match a pattern.

    The pattern may be the path of a bag. A folder that is not a bag matches all bags below it. A
    pattern with ``**`` matches only bags; other files, and files inside bags, are skipped.

    Raises
    ------
    ConfigError
        If no bag matches.
    """
    # In a URL, a question mark begins the query.
    if remote.is_url(pattern):
        paths = remote.expanded(pattern) if "*" in pattern else [pattern]
    else:
        if _is_folder_of_bags(Path(pattern)):
            pattern = str(Path(pattern) / "**")
        paths = _local_bags(pattern)
    if not paths:
        raise ConfigError(_no_match(pattern))
    return paths


def _no_match(pattern: str) -> str:
    """Return the message for a pattern without a match: what was expected, and what exists."""
    path = Path(pattern)
    if has_magic(path.name) and path.suffix and path.suffix not in _SUFFIXES:
        advice = "check the folder and the name"
        if names := _names_in_other_case(path):
            advice = f"did you mean {names[0]}? Upper and lower case differ"
        return f"no file matches {pattern}: {advice}"
    return (
        f"no bag matches {pattern}: expected folders with a metadata.yaml, or files that end "
        f"in {', '.join(_SUFFIXES)}; for trajectory files, use calibrate PARENT CHILD, or "
        "calibrate_many in Python"
    )


def _names_in_other_case(pattern: Path) -> list[str]:
    """Return the files that match a pattern if case is ignored."""
    if has_magic(str(pattern.parent)) or not pattern.parent.is_dir():
        return []
    return sorted(
        str(path)
        for path in pattern.parent.iterdir()
        if fnmatchcase(path.name.lower(), pattern.name.lower())
    )


def has_suffix_of_bag(path: Path) -> bool:
    """Return whether a path has the suffix of a bag's file, which may be compressed."""
    return path.suffix in (*_SUFFIXES, ".zstd")


def is_other_file(path: str) -> bool:
    """Return whether a path is a file that does not belong to a bag."""
    return Path(path).is_file() and not has_suffix_of_bag(Path(path))


def _local_bags(pattern: str) -> list[str]:
    """Return the paths on this computer that match a pattern. A plain path is not checked.

    A folder that is not a bag is replaced by the bags below it, if there are any.
    """
    if not has_magic(pattern) or Path(pattern).exists():
        return [pattern]
    paths = sorted(glob(pattern, recursive=True))
    if "**" in pattern:
        return [path for path in paths if _is_recording(Path(path))]
    bags = []
    for path in paths:
        below = []
        if _is_folder_of_bags(Path(path)):
            below = _local_bags(str(Path(escape(path), "**")))
        bags += below or [path]
    return [*dict.fromkeys(bags)]


def _is_folder_of_bags(path: Path) -> bool:
    """Whether a path is a folder, but not a bag."""
    return path.is_dir() and not any(
        file.name == "metadata.yaml" or file.suffix in _SUFFIXES
        for file in path.iterdir()
    )


def _is_recording(path: Path) -> bool:
    """Return whether a path is a bag, instead of a file inside a bag."""
    if path.is_dir():
        return (path / "metadata.yaml").exists()
    return (
        path.suffix in _SUFFIXES
        and not (path.parent / "metadata.yaml").exists()
    )
