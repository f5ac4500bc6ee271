"""``calibrator``: the node."""

import argparse
import dataclasses
import json
import textwrap

from hand_eye_calib.config import CalibratorConfig, NodeConfig
from hand_eye_calib.option import option_name

_INTERFACE = """\
examples:
  hand_eye_calib calibrator --ros-args -r parent_odom:=/lidar/odometry -r child_odom:=/camera/odom
  hand_eye_calib calibrator --ros-args --params-file calibrator.yaml

It takes the poses of both sensors from parent_odom and child_odom and publishes ~/extrinsic.
docs/node.md has all topics and services.

parameters (-p NAME:=VALUE):
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments: all are the node's, and passed on to it."""
    parser.usage = "%(prog)s [--ros-args -p NAME:=VALUE ... --params-file FILE -r FROM:=TO ...]"
    epilog = _INTERFACE
    for field in (*dataclasses.fields(CalibratorConfig), *dataclasses.fields(NodeConfig)):
        value = " ".join(filter(None, (json.dumps(field.default), field.metadata["unit"])))
        doc = textwrap.indent(textwrap.fill(field.metadata["doc"], 90), 6 * " ")
        epilog += f"  {option_name(field)} ({value})\n{doc}\n"
    parser.epilog = epilog.replace("%", "%%")


def run(arguments: argparse.Namespace) -> int:
    """Run the node until it is told to end; returns the exit code."""
    from hand_eye_calib.ros.node import main

    return main(arguments.passed_on)
