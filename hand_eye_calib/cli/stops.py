"""Stops for ``calibrate``: the samples of an arm, the poses of two files by their rows, or poses of
a hand and images of a target.
"""

from argparse import Namespace
from pathlib import Path
from typing import Any

from hand_eye_calib.cli.console import STREAMS, note, with_progress
from hand_eye_calib.cli.options import options_from
from hand_eye_calib.cli.reading import read_files
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.stops import calibrate_arm, calibrate_stops
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.io.stops import read_arm_samples
from hand_eye_calib.results.calibration import Calibration


def solved(arguments: Namespace) -> tuple[Calibration, dict[str, Any]]:
    """The calibration, and where the poses came from in plain values."""
    options = options_from(arguments)
    config = CalibratorConfig.from_options(options)
    if len(arguments.paths) == 1:
        path = arguments.paths[0]
        samples = read_arm_samples(path)
        inputs = {"samples": {"file": str(path), "poses": len(samples.robot)}}
        return calibrate_arm(samples.robot, samples.tracking, config, samples.frames), inputs
    if len(arguments.paths) != 2:
        raise ConfigError("--order none takes two trajectory files, or the samples of an arm")
    parent_path, child_path = map(Path, arguments.paths)
    if not arguments.target:
        (parent, child), _ = read_files(arguments, arguments.paths, options)
        _check_counts(arguments, len(parent), len(child))
        n_child, found = len(child), calibrate_stops(parent.poses, child.poses, config)
    else:
        from hand_eye_calib.io import target_images

        if not child_path.is_dir():
            raise ConfigError("--target takes the poses of a hand and images: FILE FOLDER")
        target = target_images.Target.parse(arguments.target)
        finder = target_images.TargetFinder(target, target_images.read_camera(arguments.camera))
        (parent,), _ = read_files(arguments, [parent_path], options)
        images = target_images.images_in(child_path)
        _check_counts(arguments, len(parent), len(images))
        for image in with_progress(images, len(images), "finding the target"):
            finder.look(target_images.image_in(image.read_bytes(), image))
        seen = finder.found()
        n_child = len(seen.images)
        note(str(seen))
        found = calibrate_arm(parent.poses[seen.images], seen.Ts_camera_target, config)
    counts = zip(STREAMS, arguments.paths, (len(parent), n_child), strict=True)
    return found, {each: {"file": str(path), "poses": count} for each, path, count in counts}


def _check_counts(arguments: Namespace, n_parent: int, n_child: int) -> None:
    if n_parent != n_child:
        parent, child = arguments.paths
        raise InputError(
            f"{parent} has {n_parent} poses and {child} {n_child}: stops are paired by the rows, "
            "and by the names of images; give as many of both"
        )
