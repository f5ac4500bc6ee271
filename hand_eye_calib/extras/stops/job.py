"""Command ``arm``: calibrate the camera of an arm from its stops."""

from typing import Any

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.offline.cli.jobs import Job

_BRIEF = """\
PATH:
  samples.yaml           samples of MoveIt, easy_handeye2, OpenCV (YAML, JSON, .npz)
  poses/                 a folder with a file for each pose
  hand.csv camera.csv    the stops of hand and camera, one a row in the same order
  hand.tum images/       the stops of the hand, and an image of a target for each

most used options:
  --target charuco:5x7:0.04:0.03   target in the images (squares, side and marker in m)
  --camera camera.yaml   intrinsics of the camera, with --target
  --setup hand|beside    where the camera is. Default: as the samples fit
  --parent-angles ur     angles of the robot: abb, fanuc, kawasaki, kuka, ur, yaskawa
  --out DIR              save the result, the files for ROS and report.html

examples:
  hand_eye_calib arm sample:arm.yaml
  hand_eye_calib arm hand.csv camera.csv --parent-angles ur --out result
  hand_eye_calib arm hand.tum images/ --target charuco:5x7:0.04:0.03 --camera camera.yaml"""


def _prepare(arguments: Any) -> None:
    if len(arguments.paths) not in (1, 2):
        raise ConfigError(
            "arm needs the samples of an arm, or the stops of its hand and camera: "
            f"expected one or two paths, got {len(arguments.paths)}"
        )
    if len(arguments.paths) == 2 and not arguments.target:
        arguments.order = "none"


ARM = Job("[OPTION ...] PATH [PATH]", _BRIEF, _prepare)
