"""The command ``calibrator``, which runs the node."""

import argparse
import json
import textwrap

from hand_eye_calib.core.base.config import CalibratorConfig, NodeConfig

# Short help that fits on one screen.
_BRIEF = """\
examples:
  hand_eye_calib calibrator --ros-args -r parent_odom:=/lidar/odometry -r child_odom:=/camera/odom
  hand_eye_calib calibrator --ros-args --params-file calibrator.yaml

subscribed topics (-r NAME:=TOPIC):
  parent_odom, child_odom        poses of both sensors: Odometry, PoseStamped, TransformStamped ...
  child2_odom, child3_odom, ...  poses of further child sensors (other_children)
  /tf, /tf_static                with parent_tf, child_tf, base_frame, installed:=tf, publish_tf

published topics:
  ~/extrinsic                    geometry_msgs/TransformStamped: pose of the child in the parent
  ~/extrinsic_with_covariance    geometry_msgs/PoseWithCovarianceStamped
  ~/markers                      visualization_msgs/MarkerArray: the result for RViz
  ~/progress                     std_msgs/String: the whole state as JSON
  /diagnostics                   diagnostic_msgs/DiagnosticArray
  /tf_static                     with publish_tf, once the goal is reached

services:
  ~/solve, ~/save, ~/reset       std_srvs/Trigger
  ~/set_enabled                  std_srvs/SetBool: stop or resume accepting poses"""

_PARAMETERS = "All parameters (-p NAME:=VALUE) are in config/calibrator.yaml, with their defaults."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare usage and help of the command. The node itself reads its arguments."""
    parser.usage = "%(prog)s [--ros-args -p NAME:=VALUE ... --params-file FILE -r FROM:=TO ...]"
    parser.set_defaults(brief=f"{_BRIEF}\n\n{_PARAMETERS}")
    epilog = f"{_BRIEF}\n\nparameters (-p NAME:=VALUE):\n"
    for name, field in (
        CalibratorConfig.by_name() | NodeConfig.by_name()
    ).items():
        value = " ".join(
            filter(None, (json.dumps(field.default), field.metadata["unit"]))
        )
        doc = textwrap.indent(
            textwrap.fill(field.metadata["doc"], 90), "      "
        )
        epilog += f"  {name} ({value})\n{doc}\n"
    parser.epilog = epilog.replace("%", "%%")


def run(arguments: argparse.Namespace) -> int:
    """Run the node until a signal; return the exit code."""
    from hand_eye_calib.online.ros.node import main

    return main(arguments.passed_on)
