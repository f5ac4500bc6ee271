"""Recordings as the engine takes them, and the trajectory files of two or more sensors."""

import dataclasses
import re
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.option import Options
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.engine.run import run
from hand_eye_calib.core.engine.snapshot import Snapshot, whole_snapshot
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.offline.cli.options import (
    FILE_OPTIONS,
    STREAMS,
    flag,
    note,
    waiting_for,
    with_progress,
)

_BAG_SUFFIXES = (".bag", ".db3", ".mcap", ".zstd")


@dataclass
class Recording:
    """Both streams of a recording with their options, where they came from in plain values, the
    files that were read, and what there is to say of them.
    """

    snapshot: Snapshot
    inputs: Document
    files: list[Path]
    warnings: tuple[str, ...] = ()

    def solved(self, with_fingerprints: bool) -> Calibration:
        """Solve, check the streams, and solve again if a check is certain of an option; the
        snapshot and the inputs have the options that gave the result. With name, size and SHA-256
        of the files among the inputs, if they are wanted.
        """
        with waiting_for("solving, and checking the streams"):
            found = run(self.snapshot)
        self.snapshot = found.snapshot
        self.inputs["options"] = self.snapshot.config.to_options()
        if with_fingerprints:
            from hand_eye_calib.formats.results import fingerprint

            files = with_progress(self.files, len(self.files), "hashing")
            self.inputs["files"] = [fingerprint(file) for file in files]
        warnings = (*found.calibration.warnings, *self.warnings)
        return dataclasses.replace(found.calibration, warnings=warnings)


def are_bags(paths: Sequence[Path | str]) -> bool:
    """Whether these are bags, or parts of one, rather than trajectory files; a ConfigError if some
    are bags and others are not, or a file stands alone.
    """
    urls = [path for path in paths if isinstance(path, str)]
    files = [path for path in paths if isinstance(path, Path)]
    bags = [*urls, *(path for path in files if path.suffix in _BAG_SUFFIXES or path.is_dir())]
    if len(bags) == len(paths) or (len(paths) == 1 and not Path(paths[0]).is_file()):
        return True
    folder = next((bag for bag in bags if isinstance(bag, Path) and not _has_bag(bag)), None)
    if folder:
        raise ConfigError(
            f"{folder} is a folder without a bag: give a trajectory file of each sensor, or a bag"
        )
    if bags:
        raise ConfigError(
            f"{bags[0]} is a bag, but not all of the others are: give two trajectory files, or the "
            "parts of one bag"
        )
    if len(paths) == 1:
        raise ConfigError(
            f"{paths[0]} is one trajectory file: give those of two sensors, PARENT CHILD, or a bag"
        )
    return False


def _has_bag(path: Path) -> bool:
    """Whether a path is a bag's file, or a folder with one."""
    if not path.is_dir():
        return True
    return any(inside.suffix in _BAG_SUFFIXES for inside in path.iterdir())


# ----------------------------------------------------------------------- files


def read_pair(arguments: Namespace, options: Options) -> Recording:
    """The recording of the trajectory files of parent and child."""
    files = read_files(arguments, arguments.paths, options)
    parent, child = files.trajectories
    note(*files.repairs)
    inputs: Document = {}
    for path, stream, poses in zip(arguments.paths, STREAMS, (parent, child), strict=True):
        first_ns, last_ns = poses.stamps_ns[[0, -1]].tolist()
        inputs[stream] = {"file": str(path), "poses": len(poses)}
        inputs[stream] |= {"first_stamp_ns": first_ns, "last_stamp_ns": last_ns}
    times = {arguments.times, arguments.parent_times, arguments.child_times} - {None}
    snapshot = whole_snapshot(parent, child, options)
    read = [*map(Path, arguments.paths), *times]
    return Recording(snapshot, inputs, read, tuple(files.warnings))


class FilesRead(NamedTuple):
    """The trajectories of files, what was wrong with the files and was repaired, and what a result
    has to be warned of.
    """

    trajectories: list[Trajectory]
    repairs: list[str]
    warnings: list[str]


def read_files(arguments: Namespace, paths: Sequence[Path | str], options: Options) -> FilesRead:
    """The trajectories of files; a note says what was guessed. How each is read is among the
    arguments: of two, its own options go before those for both. ``options`` say what the sensors
    measure.
    """
    from hand_eye_calib.formats.trajectory_files.reading import FileOptions, read_trajectory_files

    streams = STREAMS[: len(paths)] if len(paths) < 3 else [""] * len(paths)
    for name in (f"{stream}_{name}" for stream in STREAMS for name in FILE_OPTIONS):
        if len(paths) > 2 and getattr(arguments, name):
            raise ConfigError(f"--{flag(name)} is of two files; give it for all of a rig's")
    files = []
    for path, stream in zip(paths, streams, strict=True):
        given = {name: getattr(arguments, f"{stream}_{name}", None) for name in FILE_OPTIONS}
        given = {name: value or getattr(arguments, name) for name, value in given.items()}
        given["pair_by"] = arguments.pair_by
        given = {"format": "auto"} | {name: value for name, value in given.items() if value}
        measures = options.get(f"{stream}_measures", "auto")
        files.append((Path(path), FileOptions(**given, measures=measures, repair=True)))
    with waiting_for(f"reading {' and '.join(map(str, paths))}"):
        readings = read_trajectory_files(files)
    for (path, _), reading, stream in zip(files, readings, streams, strict=True):
        for text in reading.guesses:
            named_as = rf"`{stream}_\1`" if stream else r"`\1`"
            text = text.replace(str(path), path.name)
            note(re.sub(f"`({'|'.join(FILE_OPTIONS)})`", named_as, text))
    return FilesRead(
        [reading.trajectory for reading in readings],
        _with_short_names(files, [reading.repairs for reading in readings]),
        _with_short_names(files, [reading.warnings for reading in readings]),
    )


def _with_short_names(files: Sequence[tuple[Path, Any]], texts: Sequence[list[str]]) -> list[str]:
    """Texts of files with their names in place of their paths."""
    both = zip(files, texts, strict=True)
    return [text.replace(str(path), path.name) for (path, _), of_file in both for text in of_file]
