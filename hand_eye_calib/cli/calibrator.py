"""``calibrator``: the ROS 2 node."""

import argparse

EXAMPLES = """\
examples:
  hand_eye_calib calibrator --ros-args -r parent_odom:=/lidar/odometry -r child_odom:=/camera/odom
  hand_eye_calib calibrator --ros-args --params-file calibrator.yaml"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments: all are the node's, and passed on to it."""
    parser.usage = (
        "hand_eye_calib calibrator [--ros-args -p NAME:=VALUE ... --params-file FILE "
        "-r FROM:=TO ...]"
    )
    parser.epilog = EXAMPLES
    parser.set_defaults(passed_on=())


def run(arguments: argparse.Namespace) -> int:
    """Run the node until it is told to end; returns the exit code."""
    from hand_eye_calib.ros.node import main

    return main(arguments.passed_on)
