"""Stops for ``calibrate``: the samples of an arm, the poses of two files by their rows, or poses of
a hand and images of a target.
"""

from argparse import Namespace
from pathlib import Path
from typing import Any

from hand_eye_calib.cli.console import note, with_progress
from hand_eye_calib.cli.options import config_from
from hand_eye_calib.cli.reading import read_files
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.stops import calibrate_arm, calibrate_stops
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.stops import read_arm_samples
from hand_eye_calib.results.calibration import Calibration

_SUFFIXES = (".json", ".yaml", ".yml", ".samples", ".npz")


def are_stops(arguments: Namespace) -> bool:
    """Whether the paths are the samples of an arm, or two files whose order does not count.

    Raises
    ------
    ConfigError
        If the order of something else is not to count.
    """
    if bool(arguments.target) != bool(arguments.camera):
        raise ConfigError("--target and --camera go together: a target and a camera's intrinsics")
    if arguments.target and not (len(arguments.paths) == 2 and Path(arguments.paths[1]).is_dir()):
        raise ConfigError("--target takes the poses of a hand and a folder of images: FILE FOLDER")
    is_one = len(arguments.paths) == 1 and Path(arguments.paths[0]).suffix in _SUFFIXES
    if arguments.order == "none" and not is_one and len(arguments.paths) != 2:
        raise ConfigError("--order none takes two trajectory files, or the samples of an arm")
    return is_one or bool(arguments.target) or arguments.order == "none"


def solved(arguments: Namespace) -> tuple[Calibration, Namespace, dict[str, Any]]:
    """The calibration, the arguments, and where the poses came from in plain values.

    Raises
    ------
    HandEyeCalibError
        If a file cannot be read, or the stops are too few.
    """
    config = config_from(arguments)
    if len(arguments.paths) == 1:
        path = arguments.paths[0]
        samples = read_arm_samples(path)
        inputs = {"samples": {"file": str(path), "poses": len(samples.robot)}}
        found = calibrate_arm(samples.robot, samples.tracking, config, samples.frames)
        return found, arguments, inputs
    if arguments.target:
        return _of_images(arguments, config)
    trajectories, _ = read_files(arguments)
    parent, child = trajectories.values()
    if len(parent) != len(child):
        raise InputError(
            f"{' and '.join(map(str, arguments.paths))} have {len(parent)} and {len(child)} poses: "
            "without an order they are paired by their rows; give as many of both"
        )
    inputs = {
        stream: {"file": str(path), "poses": len(poses)}
        for path, (stream, poses) in zip(arguments.paths, trajectories.items(), strict=True)
    }
    return calibrate_stops(parent.poses, child.poses, config), arguments, inputs


def _of_images(
    arguments: Namespace, config: CalibratorConfig
) -> tuple[Calibration, Namespace, dict[str, Any]]:
    """From the poses of a hand, and an image for each."""
    from hand_eye_calib.io import target_images
    from hand_eye_calib.io.trajectory_files import FileOptions, read_trajectory_files

    hand_file, folder = map(Path, arguments.paths)
    target = target_images.Target.parse(arguments.target)
    camera = target_images.read_camera(arguments.camera)
    options = FileOptions(format=arguments.parent_format or arguments.format or "auto", repair=True)
    hand = read_trajectory_files([(hand_file, options)])[0].trajectory
    images = target_images.images_in(folder)
    if len(images) != len(hand):
        raise InputError(
            f"{hand_file} has {len(hand)} poses and {folder} {len(images)} images: they are paired "
            "in the order of the rows and of the names; give as many of both"
        )
    shown = with_progress(target_images.read_images(images), len(images), "finding the target")
    found = target_images.poses_of_target(shown, target, camera)
    note(
        f"the target is seen in {len(found.images)} of {len(images)} images, its corners to "
        f"{float((found.rms_px**2).mean() ** 0.5):.2f} pixels (rms)"
    )
    inputs = {
        "parent": {"file": str(hand_file), "poses": len(hand)},
        "child": {"file": str(folder), "poses": len(found.images)},
    }
    tracking = se3.inverse(found.Ts_target_camera)
    return calibrate_arm(hand.poses[found.images], tracking, config), arguments, inputs
