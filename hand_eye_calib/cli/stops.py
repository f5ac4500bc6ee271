"""Stops for ``calibrate``: the samples of an arm, or the poses of two files by their rows."""

from argparse import Namespace
from pathlib import Path
from typing import Any

from hand_eye_calib.cli.options import config_from
from hand_eye_calib.cli.reading import read_files
from hand_eye_calib.engine.stops import calibrate_arm, calibrate_stops
from hand_eye_calib.errors import ConfigError, InputError
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
    is_one = len(arguments.paths) == 1 and Path(arguments.paths[0]).suffix in _SUFFIXES
    if arguments.order == "none" and not is_one and len(arguments.paths) != 2:
        raise ConfigError("--order none takes two trajectory files, or the samples of an arm")
    return is_one or arguments.order == "none"


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
