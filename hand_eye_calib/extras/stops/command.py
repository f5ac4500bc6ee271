"""Stops for ``calibrate``: the samples of an arm, the poses of two files by their rows, or poses of
a hand and images of a target.
"""

from argparse import Namespace
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.base.option import Options
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.base.registry import TARGET_IMAGES
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.extras.stops.calibrate import calibrate_arm, calibrate_stops
from hand_eye_calib.extras.stops.samples import read_arm_samples
from hand_eye_calib.offline.cli.options import (
    FILE_OPTIONS,
    STREAMS,
    flag,
    note,
    options_from,
    with_progress,
)
from hand_eye_calib.offline.cli.reading import read_files


def solved(arguments: Namespace) -> tuple[Calibration, Document]:
    """The calibration, and where the poses came from in plain values."""
    options = options_from(arguments)
    config = CalibratorConfig.from_options(options)
    _refuse_ignored(arguments)
    if len(arguments.paths) == 1:
        path = arguments.paths[0]
        samples = read_arm_samples(path)
        inputs = {"samples": {"file": str(path), "poses": len(samples.robot)}}
        result = calibrate_arm(
            samples.robot, samples.tracking, config, samples.frames, arguments.setup
        )
        return result, inputs
    if len(arguments.paths) != 2:
        raise ConfigError("--order none takes two trajectory files, or the samples of an arm")
    parent_path, child_path = map(Path, arguments.paths)
    images: list[Path] = []
    if arguments.target:
        target_images = TARGET_IMAGES["folder"]()
        if not child_path.is_dir():
            raise ConfigError("--target takes the poses of a hand and images: FILE FOLDER")
        images = target_images.images_in(child_path)
    of_poses = [parent_path] if arguments.target else arguments.paths
    arguments.pair_by = arguments.pair_by or "row"
    files = read_files(arguments, of_poses, options)
    note(*files.repairs, *files.warnings)
    parent, *others = files.trajectories
    n_child = len(others[0]) if others else len(images)
    if len(parent) != n_child:
        raise InputError(
            f"{parent_path} has {len(parent)} poses and {child_path} {n_child}: stops are paired "
            "by the rows, and by the names of images; give as many of both"
        )
    config = _measuring(config, dict(zip(STREAMS, (parent, *others), strict=False)))
    if others:
        found = calibrate_stops(parent.poses, others[0].poses, config)
    else:
        target = target_images.Target.parse(arguments.target)
        finder = target_images.TargetFinder(target, target_images.read_camera(arguments.camera))
        for image in with_progress(images, len(images), "finding the target"):
            finder.look(target_images.read_image(image))
        seen = finder.found()
        n_child = len(seen.images)
        note(str(seen))
        found = calibrate_arm(
            parent.poses[seen.images], seen.Ts_camera_target, config, setup=arguments.setup
        )
    counts = zip(STREAMS, arguments.paths, (len(parent), n_child), strict=True)
    return found, {each: {"file": str(path), "poses": count} for each, path, count in counts}


def _refuse_ignored(arguments: Namespace) -> None:
    """Refuse arguments that stops have no use for."""
    names = ["topics", *(f"{stream}_{name}" for stream in STREAMS for name in ("topic", "fields"))]
    if arguments.pair_by == "time":
        raise ConfigError("--pair-by time has no meaning for stops, which have no stamps; give row")
    if len(arguments.paths) == 1:
        names += [*FILE_OPTIONS, "pair_by"]
        names += [f"{stream}_{name}" for stream in STREAMS for name in FILE_OPTIONS]
    for name in names:
        if getattr(arguments, name, None):
            raise ConfigError(f"--{flag(name)} has no meaning for stops; leave it out")


def _measuring(config: CalibratorConfig, streams: Mapping[str, Trajectory]) -> CalibratorConfig:
    """The options with what the files measure, where the user has not said it."""
    for stream, trajectory in streams.items():
        name = f"{stream}_measures"
        if trajectory.measures not in ("poses", "rotations"):
            raise ConfigError(
                f"stops need poses or rotations; those of the {stream} are {trajectory.measures}"
            )
        if name not in config.given or getattr(config, name) == "auto":
            measures: Options = {name: trajectory.measures}
            config = replace(config, **measures)
    return config
