"""Read the trajectory files of two or more sensors, and solve a recording of two streams."""

import dataclasses
import itertools
import re
from argparse import Namespace
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.base.option import Options
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.engine.run import run
from hand_eye_calib.core.engine.snapshot import Snapshot, whole_snapshot
from hand_eye_calib.core.geometry.span import Span
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.formats.bags.patterns import has_suffix_of_bag
from hand_eye_calib.offline.cli.options import (
    FILE_OPTIONS,
    STREAMS,
    flag,
    note,
    waiting_for,
    with_progress,
)

if TYPE_CHECKING:
    from hand_eye_calib.formats.trajectory_files.file_options import FileOptions

# Ends of the names of archives, which are not read.
_ARCHIVES = (".zip", ".tar", ".tar.gz", ".tgz", ".tar.xz", ".7z", ".rar")
# Options that only the method dnlo uses.
_OPTIONS_OF_DNLO = ("threshold", "min_inlier_fraction")


@dataclass
class Recording:
    """Both streams of a recording.

    Attributes
    ----------
    snapshot : Snapshot
        Streams with their options.
    inputs : dict
        Origin of the data, such as paths and topics, in plain values.
    files : list of pathlib.Path
        Files that were read.
    warnings : tuple of str
        Warnings for the result.
    """

    snapshot: Snapshot
    inputs: Document
    files: list[Path]
    warnings: tuple[str, ...] = ()

    def solved(self, with_fingerprints: bool) -> Calibration:
        """Solve, check the streams, and solve again if a check sets an option.

        The snapshot and the inputs of the recording are changed: they get the options of the
        result. With fingerprints, the inputs also get name, size and SHA-256 of the files.
        """
        with waiting_for("solving, and checking the streams"):
            checked_run = run(self.snapshot)
        self.snapshot = checked_run.snapshot
        self.inputs["options"] = self.snapshot.config.to_options()
        if with_fingerprints:
            from hand_eye_calib.formats.results import fingerprint

            files = with_progress(self.files, len(self.files), "hashing")
            self.inputs["files"] = [fingerprint(file) for file in files]
        calibration = checked_run.calibration
        ignored = _ignored_options(self.snapshot.config, calibration.method)
        warnings = (*calibration.warnings, *self.warnings, *ignored)
        return dataclasses.replace(calibration, warnings=warnings)


def _ignored_options(config: CalibratorConfig, method: str) -> list[str]:
    """Return a warning for each option that the user has changed but the method does not use."""
    if method == "dnlo":
        return []
    defaults = CalibratorConfig()
    return [
        f"the option {name} has no effect with method {method}: only dnlo uses it"
        for name in _OPTIONS_OF_DNLO
        if getattr(config, name) != getattr(defaults, name)
    ]


def are_bags(paths: Sequence[Path | str]) -> bool:
    """Return True if all paths are bags, and False if all are trajectory files. URLs are bags.

    Raises
    ------
    ConfigError
        If bags and other paths are mixed, if there is only one trajectory file, or if a path is
        repeated.
    """
    refuse_repeated_paths(paths)
    urls = [path for path in paths if isinstance(path, str)]
    local_bags = [
        path
        for path in paths
        if isinstance(path, Path) and looks_like_bag(path)
    ]
    n_bags = len(urls) + len(local_bags)
    # If a single path does not exist, opening it as a bag reports the error.
    if n_bags == len(paths) or (
        len(paths) == 1 and not Path(paths[0]).is_file()
    ):
        return True
    if n_bags:
        _refuse_folders_without_bag(local_bags)
        raise ConfigError(
            f"{[*urls, *local_bags][0]} is a bag, and another path is not: "
            "pass two trajectory files, or the parts of one bag"
        )
    for path in paths:
        if str(path).lower().endswith(_ARCHIVES):
            raise ConfigError(
                f"{path} is an archive: unpack it, and pass the bag or the files in it"
            )
    if len(paths) == 1:
        raise ConfigError(
            f"{paths[0]} is one trajectory file: pass the files of two sensors, PARENT CHILD, or a "
            "bag"
        )
    return False


def refuse_repeated_paths(paths: Sequence[Path | str]) -> None:
    """Raise a ConfigError if a path appears twice."""
    for path, count in Counter(map(str, paths)).items():
        if count > 1:
            raise ConfigError(
                f"{path} appears twice: pass one file for each sensor, or a bag once"
            )


def _refuse_folders_without_bag(folders: Sequence[Path]) -> None:
    """Raise a ConfigError if a folder contains no file of a bag."""
    for folder in folders:
        if folder.is_dir() and not any(
            map(has_suffix_of_bag, folder.iterdir())
        ):
            raise ConfigError(
                f"{folder} is a folder without a bag: pass a trajectory file of each sensor, or a "
                "bag"
            )


def is_plain_file(path: Path | str) -> bool:
    """Return whether a path is an existing file that does not have the name of a bag."""
    return (
        isinstance(path, Path)
        and path.is_file()
        and not has_suffix_of_bag(path)
    )


def looks_like_bag(path: Path) -> bool:
    """Return whether a path is a folder, or has the name of a bag's file."""
    return has_suffix_of_bag(path) or path.is_dir()


# ----------------------------------------------------------------------- files


def read_pair(arguments: Namespace, options: Options) -> Recording:
    """Read the trajectory files of parent and child, the two paths of the arguments."""
    files = read_files(arguments, arguments.paths, options)
    note(*files.repairs)
    inputs: Document = {}
    for path, stream, poses in zip(
        arguments.paths, STREAMS, files.trajectories, strict=True
    ):
        inputs[stream] = {
            "file": str(path),
            "poses": len(poses),
            "first_stamp_ns": int(poses.stamps_ns[0]),
            "last_stamp_ns": int(poses.stamps_ns[-1]),
        }
    stamp_files = {
        arguments.times,
        arguments.parent_times,
        arguments.child_times,
    }
    paths = [*map(Path, arguments.paths), *(stamp_files - {None})]
    parent, child = files.trajectories
    snapshot = whole_snapshot(parent, child, options)
    return Recording(snapshot, inputs, paths, tuple(files.warnings))


class FilesRead(NamedTuple):
    """Trajectories of files, notes on repairs of their stamps, and warnings for the result."""

    trajectories: list[Trajectory]
    repairs: list[str]
    warnings: list[str]


def read_files(
    arguments: Namespace,
    paths: Sequence[Path | str],
    options: Options,
    streams: Sequence[str] = STREAMS,
) -> FilesRead:
    """Read trajectory files. Print notes about what was recognised from their content.

    Parameters
    ----------
    arguments : argparse.Namespace
        Options of the files. With two files, an option of one file, such as ``--child-format``,
        overrides the option of both, ``--format``.
    paths : sequence of path-like
    options : dict
        Options of the engine. Only the kinds of data, "parent_measures" and "child_measures", are
        used.
    streams : sequence of str
        Stream of each path, if there are at most two.
    """
    from hand_eye_calib.formats.trajectory_files.reading import (
        read_trajectory_files,
    )

    streams = streams[: len(paths)] if len(paths) < 3 else [""] * len(paths)
    refuse_offset_without_stamps(arguments, options)
    if len(paths) > 2:
        _refuse_options_of_two_files(arguments)
    files = []
    for path, stream in zip(paths, streams, strict=True):
        files.append((Path(path), _options_of_file(arguments, stream, options)))
    try:
        with waiting_for(f"reading {' and '.join(map(str, paths))}"):
            readings = read_trajectory_files(files)
    except InputError as error:
        raise type(error)(
            _with_option_of_file(str(error), paths, streams)
        ) from None
    repairs: list[str] = []
    warnings: list[str] = []
    for (path, _), reading, stream in zip(
        files, readings, streams, strict=True
    ):
        repairs += [
            text.replace(str(path), path.name) for text in reading.repairs
        ]
        warnings += [
            text.replace(str(path), path.name) for text in reading.warnings
        ]
        for text in reading.guesses:
            text = _with_option_of_file(text, [path], [stream])
            note(text.replace(str(path), path.name))
    trajectories = [reading.trajectory for reading in readings]
    return FilesRead(
        _part_of(trajectories, arguments, paths), repairs, warnings
    )


def refuse_offset_without_stamps(
    arguments: Namespace, options: Options
) -> None:
    """Raise a ConfigError if a time offset is set, but poses are paired without their stamps."""
    if arguments.pair_by in ("row", "name") and "time_offset" in options:
        raise ConfigError(
            f"`time_offset` needs stamps, and `pair_by` {arguments.pair_by} ignores them: omit one "
            "of both"
        )


def _part_of(
    trajectories: list[Trajectory],
    arguments: Namespace,
    paths: Sequence[Path | str],
) -> list[Trajectory]:
    """Return the part of the trajectories that the user has named.

    Raises a ConfigError if the poses are paired without their times.
    """
    span = span_from(arguments)
    if span and arguments.pair_by in ("row", "name"):
        raise ConfigError(
            f"`start` and `end` are times, and `pair_by` {arguments.pair_by} uses none: omit "
            "them, and remove rows from the files instead"
        )
    return span.cut(trajectories, [*map(str, paths)])


def span_from(arguments: Namespace) -> Span:
    """Return the part of the recording that the user has named.

    Raises a ConfigError if the part is empty.
    """
    return Span.of(arguments.start, arguments.end)


def _with_option_of_file(
    text: str, paths: Sequence[Path | str], streams: Sequence[str]
) -> str:
    """Return a message with the option of one file, such as `parent_columns` for `columns`.

    The file is the one whose path begins the message. Without a stream, the message is unchanged.
    """
    for path, stream in zip(paths, streams, strict=True):
        if stream and text.startswith(str(path)):
            names = "|".join([*FILE_OPTIONS, "invert"])
            return re.sub(f"`({names})`", rf"`{stream}_\1`", text)
    return text


def _refuse_options_of_two_files(arguments: Namespace) -> None:
    """Raise a ConfigError if an option of the parent's or the child's file is set."""
    for stream, name in itertools.product(STREAMS, FILE_OPTIONS):
        if getattr(arguments, f"{stream}_{name}"):
            raise ConfigError(
                f"--{flag(f'{stream}_{name}')} is for two files; for a rig, use --{flag(name)}"
            )


def _options_of_file(
    arguments: Namespace, stream: str, options: Options
) -> "FileOptions":
    """Return how to read the file of a stream; ``stream`` is empty with three files or more."""
    from hand_eye_calib.formats.trajectory_files.file_options import FileOptions

    settings: dict[str, Any] = {"format": "auto"}
    for name in (*FILE_OPTIONS, "pair_by"):
        value = getattr(arguments, f"{stream}_{name}", None) or getattr(
            arguments, name
        )
        if value:
            settings[name] = value
    measures = options.get(f"{stream}_measures", "auto")
    return FileOptions(**settings, measures=measures, repair=True)
