"""``calibrator``: the node."""

import argparse

_INTERFACE = """\
examples:
  hand_eye_calib calibrator --ros-args -r parent_odom:=/lidar/odometry -r child_odom:=/camera/odom
  hand_eye_calib calibrator --ros-args --params-file calibrator.yaml

It takes the poses of both sensors from parent_odom and child_odom and publishes ~/extrinsic.
docs/node.md has all topics, services and parameters (-p NAME:=VALUE)."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments: all are the node's, and passed on to it."""
    parser.usage = "%(prog)s [--ros-args -p NAME:=VALUE ... --params-file FILE -r FROM:=TO ...]"
    parser.epilog = _INTERFACE


def run(arguments: argparse.Namespace) -> int:
    """Run the node until it is told to end; returns the exit code."""
    from hand_eye_calib.ros.node import main

    return main(arguments.passed_on)
