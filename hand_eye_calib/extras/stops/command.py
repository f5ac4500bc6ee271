"""Command ``calibrate`` for stops.

The input is one of:

- a file with the samples of an arm,
- two files whose rows belong together,
- poses of a hand (a file, or a folder with a file for each pose), and a folder with images of a
  target.
"""

from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.base.option import Options, did_you_mean
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.base.registry import TARGET_IMAGES
from hand_eye_calib.core.base.text import shown_value
from hand_eye_calib.core.checks.findings import finding
from hand_eye_calib.core.geometry.frames import words_of
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import Calibration, Verdict
from hand_eye_calib.core.results.records import gravest_first
from hand_eye_calib.extras.stops.calibrate import (
    calibrate_arm,
    calibrate_hand_and_camera,
    calibrate_stops,
)
from hand_eye_calib.extras.stops.pose_files import read_robot_folder
from hand_eye_calib.extras.stops.robot_angles import ROBOTS, read_robot_poses
from hand_eye_calib.extras.stops.samples import read_arm_samples
from hand_eye_calib.offline.cli.config_file import options_from
from hand_eye_calib.offline.cli.options import (
    FILE_OPTIONS,
    STREAMS,
    flag,
    note,
    with_progress,
)
from hand_eye_calib.offline.cli.reading import read_files, refuse_repeated_paths

# Result, origin of the data as plain values, and functions that draw further figures of the report.
SolvedInput: TypeAlias = tuple[
    Calibration, Document, Sequence[Callable[[Calibration], list[Any]]]
]


# Words in the names of files with poses of a robot's hand, and of files with poses of a camera or a
# target.
_ROBOT_WORDS = {
    *("robot", "arm", "base", "hand", "gripper", "flange", "ee", "eef"),
    *("effector", "tool", "tcp"),
}
_TARGET_WORDS = {
    *("target", "board", "marker", "tag", "apriltag", "aruco", "charuco"),
    *("chessboard", "checkerboard", "pattern", "camera", "cam", "object"),
}

# Ends of files that contain the poses of robot and camera.
_OF_BOTH_SIDES = (".yaml", ".yml", ".samples")


def solved(arguments: Namespace) -> SolvedInput:
    """Calibrate from the stops that the arguments name.

    Returns
    -------
    result : Calibration
    sources : Document
        Files and numbers of poses, for the result file.
    pictures : sequence of callable
        Functions that draw further figures of the report, given the result.
    """
    options = options_from(arguments)
    config = CalibratorConfig.from_options(options)
    _refuse_ignored(arguments)
    paths = [Path(path) for path in arguments.paths]
    if arguments.target:
        return _from_images(arguments, config, options)
    if len(paths) == 1:
        samples = read_arm_samples(paths[0])
        if samples.calibration is not None:
            note(
                f"place of the camera and names of frames: {samples.calibration}"
            )
        setup = arguments.setup or samples.setup
        result = calibrate_arm(
            samples.robot, samples.tracking, config, samples.frames, setup
        )
        return result, {"samples": _input(paths[0], len(samples.robot))}, ()
    if len(paths) != 2:
        raise ConfigError(
            "--order none takes two trajectory files, or the samples of an arm"
        )
    refuse_repeated_paths(paths)
    for path in paths:
        if path.suffix in _OF_BOTH_SIDES:
            raise ConfigError(
                f"{path} has the samples of both sides: pass it alone"
            )
    arguments.pair_by = arguments.pair_by or "row"
    return _from_two_files(arguments, config, options)


def _from_two_files(
    arguments: Namespace, config: CalibratorConfig, options: Options
) -> SolvedInput:
    """Calibrate an arm or two sensors from two files whose rows belong together."""
    image = Path(arguments.paths[1])
    if image.suffix.lower() in TARGET_IMAGES["folder"]().IMAGE_SUFFIXES:
        raise ConfigError(
            f"{image} is an image: pass the folder of images, --target and --camera"
        )
    if arguments.parent_angles:
        parent = _robot(arguments)
        (child,) = _read(arguments, arguments.paths[1:], options, STREAMS[1:])
    else:
        parent, child = _read(arguments, arguments.paths, options)
    _require_equal(arguments.paths, len(parent), len(child))
    config = _measuring(config, {"parent": parent, "child": child})
    if arguments.command == "arm" or arguments.setup:
        result = calibrate_hand_and_camera(
            parent.poses, child.poses, config, arguments.setup
        )
        result = _with_order(result, *map(Path, arguments.paths))
    else:
        result = calibrate_stops(parent.poses, child.poses, config)
    return result, _inputs(arguments, len(parent), len(child)), ()


def _with_order(result: Calibration, robot: Path, target: Path) -> Calibration:
    """Return the result with a note on the order of both files, or a doubt from their names.

    Exchanged files fit equally well, so only their names can contradict the order.
    """
    if result.verdict is Verdict.DO_NOT_USE:
        return result
    of_robot = words_of(robot.stem)
    of_target = words_of(target.stem)
    is_target_first = not of_robot.isdisjoint(
        _TARGET_WORDS
    ) and of_robot.isdisjoint(_ROBOT_WORDS)
    is_robot_second = not of_target.isdisjoint(
        _ROBOT_WORDS
    ) and of_target.isdisjoint(_TARGET_WORDS)
    if is_target_first and is_robot_second:
        doubt = finding("exchanged_files", robot=str(robot), target=str(target))
        findings = gravest_first([doubt, *result.findings])
        return replace(result, findings=findings)
    order = f"read as robot: {robot.name}; read as target: {target.name}"
    return replace(result, warnings=(order, *result.warnings))


def _from_images(
    arguments: Namespace, config: CalibratorConfig, options: Options
) -> SolvedInput:
    """Calibrate an arm from poses of its hand and a folder with images of a target.

    A single path is a folder that contains the poses and the images.
    """
    arguments.pair_by = arguments.pair_by or "row"
    hand_path = Path(arguments.paths[0])
    folder = Path(arguments.paths[-1])
    target_images = TARGET_IMAGES["folder"]()
    if len(arguments.paths) > 2 or not folder.is_dir():
        raise ConfigError(
            "--target takes the poses of a hand and images: FILE FOLDER, or FOLDER with both"
        )
    images = target_images.images_in(folder)
    if arguments.parent_angles:
        hand = _robot(arguments)
    elif hand_path.is_dir():
        robot_poses = read_robot_folder(hand_path)
        hand = Trajectory(np.arange(len(robot_poses)), robot_poses)
    else:
        (hand,) = _read(arguments, [hand_path], options)
    _require_equal([hand_path, folder], len(hand), len(images))
    config = _measuring(config, {"parent": hand})
    finder = target_images.TargetFinder.parse(
        arguments.target, arguments.camera
    )
    for image in with_progress(images, len(images), "finding the target"):
        finder.look(target_images.read_image(image))
    detections = finder.found()
    note(str(detections))
    result = calibrate_arm(
        hand.poses[detections.images],
        detections.Ts_camera_target,
        config,
        setup=arguments.setup,
    )
    figures_of_corners = partial(
        TARGET_IMAGES["corners"]().figures_of_corners,
        detections=detections,
        camera=finder.camera,
        names=[image.name for image in images],
        read=lambda number: target_images.read_image(images[number]),
    )
    inputs = _inputs(arguments, len(hand), len(detections.images))
    return result, inputs, [figures_of_corners]


def _read(
    arguments: Namespace,
    paths: Sequence[str | Path],
    options: Options,
    streams: Sequence[str] = STREAMS,
) -> Sequence[Trajectory]:
    """Read the trajectory files of streams, and print their repairs and warnings."""
    files = read_files(arguments, paths, options, streams)
    note(*files.repairs, *files.warnings)
    return files.trajectories


def _robot(arguments: Namespace) -> Trajectory:
    """Read the poses of the hand, the first path, in the convention of its robot."""
    robot = arguments.parent_angles
    if robot not in ROBOTS:
        raise ConfigError(
            f"--parent-angles must be one of {', '.join(ROBOTS)}; got {shown_value(robot)}"
            f"{did_you_mean(robot, ROBOTS)}"
        )
    poses = read_robot_poses(Path(arguments.paths[0]), arguments.parent_angles)
    return Trajectory(np.arange(len(poses)), poses)


def _require_equal(
    paths: Sequence[str | Path], n_parent: int, n_child: int
) -> None:
    """Raise InputError if the sides have different numbers of stops."""
    if n_parent != n_child:
        raise InputError(
            f"{paths[0]} has {n_parent} poses and {paths[1]} {n_child}: stops are paired by the "
            "rows, and by the names of images; give as many of both"
        )


def _input(path: str | Path, n_poses: int) -> Document:
    return {"file": str(path), "poses": n_poses}


def _inputs(arguments: Namespace, n_parent: int, n_child: int) -> Document:
    """Return file and number of poses of both sides, for the result file."""
    parent_path = arguments.paths[0]
    child_path = arguments.paths[-1]
    return {
        "parent": _input(parent_path, n_parent),
        "child": _input(child_path, n_child),
    }


def _refuse_ignored(arguments: Namespace) -> None:
    """Raise ConfigError if an argument has no effect on stops."""
    if arguments.pair_by == "time":
        raise ConfigError(
            "--pair-by time has no meaning for stops, which have no stamps; give row"
        )
    names = ["topics", "start", "end"]
    of_streams = ["topic", "fields"]
    if len(arguments.paths) == 1:
        names += [*FILE_OPTIONS, "pair_by"]
        of_streams += FILE_OPTIONS
    for stream in STREAMS:
        names += [f"{stream}_{name}" for name in of_streams]
    for name in names:
        if getattr(arguments, name, None):
            raise ConfigError(
                f"--{flag(name)} has no meaning for stops; leave it out"
            )


def _measuring(
    config: CalibratorConfig, streams: Mapping[str, Trajectory]
) -> CalibratorConfig:
    """Return the options with the kind of data of each stream taken from its file.

    An option of the user has priority, except ``auto``.
    """
    for stream, trajectory in streams.items():
        if trajectory.measures not in ("poses", "rotations"):
            raise ConfigError(
                f"stops need poses or rotations; those of the {stream} are {trajectory.measures}"
            )
        name = f"{stream}_measures"
        if name not in config.given or getattr(config, name) == "auto":
            measures: Options = {name: trajectory.measures}
            config = replace(config, **measures)
    return config
