"""What a robot has installed: compared with a result, and changed in its description."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from hand_eye_calib.cli.console import note, waiting_for
from hand_eye_calib.errors import ConfigError, InputError
from hand_eye_calib.text import listing

if TYPE_CHECKING:
    from hand_eye_calib.geometry.extrinsic import Extrinsic
    from hand_eye_calib.geometry.frames import FrameTree
    from hand_eye_calib.results.calibration import Calibration


def add_robot_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options about what is installed on the robot."""
    group = parser.add_argument_group("what is installed")
    group.add_argument(
        "--installed",
        metavar="SOURCE",
        help="compare the result with this: a URDF, an earlier extrinsic.yaml, a file of another "
        'program, a bag with /tf_static, or "X Y Z ROLL PITCH YAW" in m and rad. Default: '
        "--urdf, if it is given",
    )
    group.add_argument(
        "--base-frame",
        metavar="FRAME",
        help="state the child's pose in this frame too, as --urdf or the bag's /tf_static has it",
    )
    add_description_arguments(group)


def add_description_arguments(parser: argparse._ActionsContainer) -> None:
    """Add ``--urdf`` and ``--write``."""
    parser.add_argument(
        "--urdf", metavar="FILE", type=Path, help="robot description with both sensors' frames"
    )
    parser.add_argument(
        "--write",
        metavar="FILE",
        type=Path,
        help="write the description of --urdf with the result in it: one joint's origin changes, "
        "nothing else",
    )


def with_robot(calibration: "Calibration", arguments: argparse.Namespace) -> "Calibration":
    """The result with its comparison and its pose in the base frame, if they were asked for.

    Raises
    ------
    HandEyeCalibError
        If what is installed cannot be read.
    """
    require_description(arguments)
    if calibration.status.failure:
        return calibration
    if (installed := _installed(calibration, arguments)) is not None:
        from hand_eye_calib.session.compare import with_comparison

        calibration = with_comparison(calibration, installed)
    if arguments.base_frame:
        T_base_parent = _frames(arguments).pose(arguments.base_frame, calibration.parent_frame)
        calibration = replace(
            calibration, base_frame=arguments.base_frame, T_base_parent=T_base_parent
        )
    return calibration


def require_description(arguments: argparse.Namespace) -> None:
    """Refuse ``--write`` without ``--urdf``."""
    if arguments.write and not arguments.urdf:
        raise ConfigError("--write needs --urdf: the description to change")


def write_description(calibration: "Calibration", arguments: argparse.Namespace) -> None:
    """Write the changed robot description, if it was asked for.

    Raises
    ------
    InputError
        If an axis is not known, or the description is not understood.
    """
    if not arguments.write:
        return
    from hand_eye_calib.cli.reporting import save_text
    from hand_eye_calib.io.urdf import RobotDescription
    from hand_eye_calib.results.calibration import SolveStatus, Verdict

    if calibration.status is not SolveStatus.OK:
        unknown = listing(calibration.unobservable()) or "the whole result"
        raise InputError(
            f"{arguments.write} is not written: {unknown} not known; measure by hand and give "
            "--prior"
        )
    if calibration.verdict is Verdict.DO_NOT_USE:
        raise InputError(f"{arguments.write} is not written: {calibration.headline}")
    description = RobotDescription(arguments.urdf)
    frames = calibration.parent_frame, calibration.child_frame
    save_text(arguments.write, description.patched(*frames, calibration.T_parent_child))
    note(f"wrote {arguments.write}: joint {description.joint_name(*frames)} changed")


def _installed(calibration: "Calibration", arguments: argparse.Namespace) -> "Extrinsic | None":
    if not arguments.installed and not arguments.urdf:
        return None
    from hand_eye_calib.io.installed import of_frames, read_installed

    frames = calibration.parent_frame, calibration.child_frame
    if arguments.installed:
        with waiting_for(f"reading {arguments.installed}"):
            return read_installed(arguments.installed, *frames)
    return of_frames(_frames(arguments), *frames, str(arguments.urdf))


def _frames(arguments: argparse.Namespace) -> "FrameTree":
    from hand_eye_calib.io.installed import frames_of_bag
    from hand_eye_calib.io.urdf import RobotDescription

    if arguments.urdf:
        return RobotDescription(arguments.urdf).frames
    if getattr(arguments, "is_of_bags", False):
        return frames_of_bag(arguments.paths[0])
    raise ConfigError("--base-frame needs --urdf: the description that has the frame")
