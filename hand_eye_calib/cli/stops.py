"""Stops for ``calibrate``: the samples of an arm, the poses of two files by their rows, or poses of
a hand and images of a target.
"""

from argparse import Namespace
from pathlib import Path
from typing import Any

from hand_eye_calib.cli.console import STREAMS, note, with_progress
from hand_eye_calib.cli.options import config_from, options_from
from hand_eye_calib.cli.reading import file_settings, read_files
from hand_eye_calib.engine.stops import calibrate_arm, calibrate_stops
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.io.stops import read_arm_samples
from hand_eye_calib.results.calibration import Calibration

_SUFFIXES = (".json", ".yaml", ".yml", ".samples", ".npz")


def are_stops(arguments: Namespace) -> bool:
    """Whether the paths are the samples of an arm, or two files whose order does not count; a
    ConfigError if the order of something else is not to count.
    """
    if bool(arguments.target) != bool(arguments.camera):
        raise ConfigError("--target and --camera go together: a target and a camera's intrinsics")
    if arguments.target and not (len(arguments.paths) == 2 and Path(arguments.paths[1]).is_dir()):
        raise ConfigError("--target takes the poses of a hand and a folder of images: FILE FOLDER")
    is_one = len(arguments.paths) == 1 and Path(arguments.paths[0]).suffix in _SUFFIXES
    if arguments.order == "none" and not is_one and len(arguments.paths) != 2:
        raise ConfigError("--order none takes two trajectory files, or the samples of an arm")
    return is_one or bool(arguments.target) or arguments.order == "none"


def solved(arguments: Namespace) -> tuple[Calibration, dict[str, Any]]:
    """The calibration, and where the poses came from in plain values."""
    config = config_from(arguments)
    if len(arguments.paths) == 1:
        path = arguments.paths[0]
        samples = read_arm_samples(path)
        inputs = {"samples": {"file": str(path), "poses": len(samples.robot)}}
        return calibrate_arm(samples.robot, samples.tracking, config, samples.frames), inputs
    parent_path, child_path = map(Path, arguments.paths)
    settings = file_settings(arguments)
    if not arguments.target:
        (parent, child), _ = read_files(arguments.paths, settings, options_from(arguments))
        n_child, what = len(child), "poses"
    else:
        from hand_eye_calib.io import target_images

        target = target_images.Target.parse(arguments.target)
        camera = target_images.read_camera(arguments.camera)
        (parent,), _ = read_files([parent_path], settings[:1], {})
        images = target_images.images_in(child_path)
        n_child, what = len(images), "images"
    if len(parent) != n_child:
        raise InputError(
            f"{parent_path} has {len(parent)} poses and {child_path} {n_child} {what}: without an "
            "order they are paired by the rows, and by the names of images; give as many of both"
        )
    if not arguments.target:
        found = calibrate_stops(parent.poses, child.poses, config)
    else:
        shown = with_progress(target_images.read_images(images), n_child, "finding the target")
        seen = target_images.poses_of_target(shown, target, camera)
        n_child = len(seen.images)
        note(
            f"the target is seen in {n_child} of {len(images)} images, its corners to "
            f"{float((seen.rms_px**2).mean() ** 0.5):.2f} pixels (rms)"
        )
        tracking = seen.Ts_camera_target
        found = calibrate_arm(parent.poses[seen.images], tracking, config)
    counts = zip(STREAMS, arguments.paths, (len(parent), n_child), strict=True)
    return found, {each: {"file": str(path), "poses": count} for each, path, count in counts}
