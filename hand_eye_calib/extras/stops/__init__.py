"""Calibration from stops: samples of an arm, rows of two files, or a hand and images."""

from pathlib import Path
from typing import Any

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.registry import (
    COMMANDS,
    FINDING_WORDS,
    PUBLIC_NAMES,
    RESULT_PARTS,
    ROUTES,
    Command,
    Route,
)

# Suffixes of files with the samples of an arm.
_SAMPLES = (".json", ".yaml", ".yml", ".samples", ".npz")


def register() -> None:
    """Register the command ``arm``, and stops for ``calibrate``."""
    COMMANDS["arm"] = Command(
        "calibrate the camera of an arm from its stops", _arm
    )
    RESULT_PARTS["worlds"] = _worlds
    RESULT_PARTS["stops"] = _stops
    FINDING_WORDS["stops"] = _words
    PUBLIC_NAMES["calibrate_arm"] = "hand_eye_calib.extras.stops.calibrate"
    PUBLIC_NAMES["calibrate_stops"] = "hand_eye_calib.extras.stops.calibrate"
    PUBLIC_NAMES["read_arm_samples"] = "hand_eye_calib.extras.stops.samples"
    PUBLIC_NAMES["robot_poses"] = "hand_eye_calib.extras.stops.robot_angles"
    ROUTES["stops"] = Route(_add_arguments, _are_stops, _calibrate)


def _arm() -> Any:
    from hand_eye_calib.extras.stops.job import ARM

    return ARM


def _add_arguments(parser: Any) -> None:
    order = (
        "none: the poses of two files are stops without an order, paired by their rows. So are the "
        "samples of an arm (MoveIt, easy_handeye2, OpenCV, .npz, a folder with a file for each "
        "pose), given as the only PATH"
    )
    parser.add_argument(
        "--order", choices=("time", "none"), default="time", help=order
    )
    setup = (
        "where the camera of an arm is: on the hand, or beside the robot with the target on the "
        "hand. Default: as the samples fit"
    )
    parser.add_argument("--setup", choices=("hand", "beside"), help=setup)
    angles = (
        "convention of the angles in the file of the hand, the first PATH, with a pose on each "
        "line: abb, fanuc, kawasaki, kuka, ur or yaskawa"
    )
    parser.add_argument("--parent-angles", metavar="ROBOT", help=angles)
    add = parser.add_argument_group("images of a target").add_argument
    target = (
        "what the images of --child-topic show, or those of a folder, the second PATH, one for "
        "each pose of a hand (a file or a folder): such as "
        "charuco:5x7:0.04:0.03:4X4_50 (squares, side of a square and of a marker in m, markers; "
        "charuco-old for boards made before OpenCV 4.6), aprilgrid:6x6:0.088:0.0264 (tags, side of "
        "a tag, gap), chessboard:8x5:0.03 (inner corners, side) or marker:26:0.1:APRILTAG_36h11 "
        "(number, side, markers)"
    )
    add("--target", metavar="TARGET", help=target)
    camera = (
        "intrinsics: YAML of camera_info, Kalibr or OpenCV, XML of ViSP; a bag may have its own "
        "camera_info"
    )
    add("--camera", metavar="FILE", type=Path, help=camera)


def _are_stops(arguments: Any) -> bool:
    """Return whether the arguments name stops. Raise ConfigError for contradicting arguments."""
    if arguments.target and arguments.target[0] in "-.0123456789":
        raise ConfigError(
            "--target is a printed target in images, such as charuco:5x7:0.04:0.03:4X4_50; the "
            "accuracy is --target-translation, --target-rotation"
        )
    are_images = bool(arguments.target) and not arguments.child_topic
    if not arguments.child_topic and are_images != bool(arguments.camera):
        raise ConfigError(
            "--target and --camera go together: a target and a camera's intrinsics"
        )
    are_samples = len(arguments.paths) == 1 and _has_samples(arguments.paths[0])
    are_stops = are_samples or are_images or arguments.order == "none"
    if arguments.command == "arm" and not (are_stops or arguments.child_topic):
        raise ConfigError(
            f"{arguments.paths[0]} contains no samples of an arm: expected a file that ends in "
            f"{', '.join(sorted(_SAMPLES))}, a folder with files such as robot_1.txt and "
            "target_1.txt, or two files with a row for each stop"
        )
    _refuse_without_stops(
        arguments, are_stops, has_hand_file=are_stops and not are_samples
    )
    return are_stops


def _refuse_without_stops(
    arguments: Any, are_stops: bool, has_hand_file: bool
) -> None:
    """Raise ConfigError if an option of an arm, or of the file of its hand, has no such input."""
    if arguments.setup and not are_stops:
        raise ConfigError(
            "--setup is the place of the camera of an arm: run arm with the samples of an arm, or "
            "with the files of hand and camera"
        )
    if arguments.parent_angles and not has_hand_file:
        raise ConfigError(
            "--parent-angles is the convention of a robot; it needs two files and --order none, or "
            "--target"
        )


def _has_samples(path: Any) -> bool:
    """Return whether a path is a file or a folder with the samples of an arm."""
    from hand_eye_calib.extras.stops.pose_files import is_pose_folder

    return path.suffix in _SAMPLES or is_pose_folder(Path(path))


def _calibrate(arguments: Any, _: Any) -> int:
    from hand_eye_calib.extras.stops import command as stops
    from hand_eye_calib.offline.cli.options import refuse_options_of_bags
    from hand_eye_calib.offline.cli.present import deliver

    refuse_options_of_bags(arguments)
    result, inputs, pictures = stops.solved(arguments)
    return deliver(result, inputs, arguments, pictures=pictures)


def _worlds() -> Any:
    from hand_eye_calib.extras.stops.worlds import WorldsPart

    return WorldsPart()


def _stops() -> Any:
    from hand_eye_calib.extras.stops.stop_table import StopsPart

    return StopsPart()


def _words() -> Any:
    from hand_eye_calib.extras.stops.words import WORDS

    return WORDS
