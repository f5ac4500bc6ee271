"""Bags that a pattern with ``*`` or a folder stands for."""

from glob import glob, has_magic
from pathlib import Path

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.formats import remote

_BAGS = (".bag", ".mcap", ".db3")


def matching(pattern: str) -> list[str]:
    """The bags that a pattern stands for, or a ConfigError; a bag stands for itself, another folder
    for all bags below it. ``**`` finds bags alone.
    """
    found = [pattern]
    if not remote.is_url(pattern) and _is_folder_of_bags(Path(pattern)):
        pattern = str(Path(pattern) / "**")
    if remote.is_url(pattern):  # a question mark begins its query
        found = remote.expanded(pattern) if "*" in pattern else found
    elif has_magic(pattern) and not Path(pattern).exists():
        found = sorted(glob(pattern, recursive=True))
        if "**" in pattern:
            found = [each for each in found if _is_recording(Path(each))]
    if not found:
        raise ConfigError(f"no bag matches {pattern}")
    return found


def _is_folder_of_bags(path: Path) -> bool:
    """Whether a path is a folder that is no bag itself."""
    return path.is_dir() and not any(
        file.name == "metadata.yaml" or file.suffix in _BAGS for file in path.iterdir()
    )


def _is_recording(path: Path) -> bool:
    """Whether a path is a bag, and not a file of one."""
    if path.is_dir():
        return (path / "metadata.yaml").exists()
    return path.suffix in _BAGS and not (path.parent / "metadata.yaml").exists()
